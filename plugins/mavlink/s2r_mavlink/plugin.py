"""What this package offers."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl


@hookimpl
def s2r_transports() -> list[Offer]:
    """The MAVLink transport."""
    return [Offer("mavlink", "s2r_mavlink.transport:MavlinkTransport", "autopilots that speak MAVLink: UDP, TCP, serial")]
