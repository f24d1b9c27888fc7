"""The MAVLink transport is what the runtime relies on: over UDP, TCP and a pseudo-terminal."""

from __future__ import annotations

from functools import partial

from s2r_mavlink.testing import MavlinkRig

from s2r_runtime.testing import TransportKit


class TestUdp(TransportKit):
    rig = partial(MavlinkRig, "udp")
    carries = ()
    tolerance = 1e-6
    numbered = False
    resolution_ns = 1_000_000


class TestTcp(TestUdp):
    rig = partial(MavlinkRig, "tcp")


class TestSerial(TestUdp):
    rig = partial(MavlinkRig, "serial")


class TestOdometry(TestUdp):
    """Its stamps are in microseconds."""

    rig = partial(MavlinkRig, "udp", odometry=True)
    resolution_ns = 1000
