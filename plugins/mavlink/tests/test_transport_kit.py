"""The MAVLink transport is what the runtime relies on: over UDP, TCP and a pseudo-terminal."""

from __future__ import annotations

from s2r_mavlink.kits import OdometryKit, SerialKit, TcpKit, UdpKit


class TestUdp(UdpKit):
    pass


class TestTcp(TcpKit):
    pass


class TestSerial(SerialKit):
    pass


class TestOdometry(OdometryKit):
    """Its stamps are in microseconds."""
