"""How `s2r plugin check mavlink` tries the transport: over UDP, TCP and a pseudo-terminal."""

from __future__ import annotations

from functools import partial

from s2r_mavlink.testing import MavlinkRig
from s2r_runtime.testing import TransportKit


class UdpKit(TransportKit):
    """Single precision, stamps in ms, and no count of observations but the transport's."""

    rig = partial(MavlinkRig, "udp")
    carries = ()
    tolerance = 1e-6
    numbered = False
    resolution_ns = 1_000_000


class TcpKit(UdpKit):
    """A stream."""

    rig = partial(MavlinkRig, "tcp")


class SerialKit(UdpKit):
    """A line."""

    rig = partial(MavlinkRig, "serial")


class OdometryKit(UdpKit):
    """Its stamps are in microseconds."""

    rig = partial(MavlinkRig, "udp", odometry=True)
    resolution_ns = 1000
