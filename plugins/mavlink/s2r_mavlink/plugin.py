"""What this package offers."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl


@hookimpl
def s2r_transports() -> list[Offer]:
    """The MAVLink transport."""
    return [Offer("mavlink", "s2r_mavlink.transport:MavlinkTransport", "autopilots that speak MAVLink: UDP, TCP, serial")]


@hookimpl
def s2r_recordings() -> list[Offer]:
    """Telemetry logs."""
    return [
        Offer(
            "mavlink.tlog",
            "s2r_mavlink.tlog:read",
            "telemetry logs of MAVLink ground stations (.tlog, .tlog.gz)",
            recognises="s2r_mavlink.tlog:is_tlog",
        )
    ]


@hookimpl
def s2r_formats() -> list[Offer]:
    """The log that the autopilot itself writes; and all that a telemetry log holds, for whom its messages are signals."""
    return [
        Offer("dataflash", "s2r_mavlink.dataflash:open_dataflash", "ArduPilot DataFlash logs (.bin, or as text), by pymavlink"),
        Offer("mavlink.tlog", "s2r_mavlink.telemetry:open_tlog", "MAVLink telemetry log (.tlog, .tlog.gz), by pymavlink"),
    ]


@hookimpl
def s2r_kits() -> list[Offer]:
    """How the transport is tried."""
    return [
        Offer("transports.mavlink", "s2r_mavlink.kits:UdpKit"),
        Offer("transports.mavlink.tcp", "s2r_mavlink.kits:TcpKit"),
        Offer("transports.mavlink.serial", "s2r_mavlink.kits:SerialKit"),
        Offer("transports.mavlink.odometry", "s2r_mavlink.kits:OdometryKit"),
    ]
