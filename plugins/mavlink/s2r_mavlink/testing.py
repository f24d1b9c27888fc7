"""A robot's end of the MAVLink transport, for tests: real sockets and pseudo-terminals on loopback, bytes made by pymavlink.

from s2r_runtime.testing import TransportKit
from s2r_mavlink.testing import MavlinkRig

class TestUdp(TransportKit):
    rig = partial(MavlinkRig, "udp")
    carries, tolerance, numbered, resolution_ns = (), 1e-6, False, 1_000_000
"""

from __future__ import annotations

import math
import socket
import time
from typing import Any, Self

from pymavlink.dialects.v20 import common as mavlink

from s2r_mavlink.rover_lines import Line, TcpServerLine, UdpLine, pseudo_terminal
from s2r_mavlink.transport import MavlinkTransport
from s2r_runtime.messages import Command

STATES, INPUTS = ("x", "y", "theta"), ("v", "w")
GUIDED, HOLD = 15, 4
ARMED = 0x81
NUMBERS_EACH = 3
"""Sequence numbers that one observation takes: of a heartbeat, sent now and then, an attitude and a position."""
HEARTBEAT_S = 0.4


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    """A port on loopback that nobody uses."""
    with socket.socket(socket.AF_INET, kind) as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


class Robot:
    """A robot's end that sends what it is told to, and keeps the velocity targets that it hears."""

    def __init__(self, line: Line, system: int = 1, component: int = 1, *, odometry: bool = False) -> None:
        self.line, self._odometry = line, odometry
        self.mav = mavlink.MAVLink(None, system, component)
        self.mav.robust_parsing = True
        self.heard: list[Any] = []
        self._heartbeat_s = -math.inf

    def pack(self, message: Any, sequence: int | None = None) -> bytes:
        """The frame of a message, numbered by hand or in turn."""
        if sequence is not None:
            self.mav.seq = sequence & 0xFF
        data: bytes = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def heartbeat(self, mode: int = GUIDED, base: int = ARMED, state: int = 4) -> Any:
        """A rover's."""
        return self.mav.heartbeat_encode(10, 3, base, mode, state)

    def messages(self, stamp_ns: int, x: tuple[float, ...]) -> list[Any]:
        """What says that it is at x (x north, y west, theta counter-clockwise) at that time of its clock."""
        north, east, yaw = x[0], -x[1], -x[2]
        if self._odometry:
            half = 0.5 * yaw
            q = (math.cos(half), 0.0, 0.0, math.sin(half)) if math.isfinite(half) else (half, half, half, half)
            none = [math.nan] * 21
            return [
                self.mav.odometry_encode(
                    stamp_ns // 1000, 1, 12, north, east, 0.0, q, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, none, none, reset_counter=3
                )
            ]
        ms = stamp_ns // 1_000_000
        return [
            self.mav.attitude_encode(ms, 0.0, 0.0, yaw, 0.0, 0.0, 0.0),
            self.mav.local_position_ned_encode(ms, north, east, 0.0, 0.0, 0.0, 0.0),
        ]

    def publish(self, seq: int, stamp_ns: int, x: tuple[float, ...]) -> None:
        """One observation; its frames are numbered by it, so that the transport can see what is missing."""
        if time.monotonic() - self._heartbeat_s > HEARTBEAT_S:
            self._heartbeat_s = time.monotonic()
            self.line.write(self.pack(self.heartbeat(), NUMBERS_EACH * seq))
        for place, message in enumerate(self.messages(stamp_ns, x), start=1):
            self.line.write(self.pack(message, NUMBERS_EACH * seq + place))

    def publish_raw(self, data: bytes) -> None:
        """These bytes."""
        self.line.write(data)

    def listen(self) -> list[Any]:
        """Every message that came since the last call."""
        came: list[Any] = []
        while data := self.line.read():
            came += self.mav.parse_buffer(data) or []
        return came

    def received(self) -> list[Command]:
        """Velocity targets since the last call. The protocol has no room for what else a command says."""
        targets = [m for m in self.listen() if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
        return [Command(0, m.time_boot_ms, "external", (m.vx, -m.yaw_rate), 0, 0) for m in targets]


class MavlinkRig:
    """Transport and robot over `udp`, `tcp` or `serial` (a pseudo-terminal)."""

    states, inputs = STATES, INPUTS

    def __init__(self, kind: str = "udp", *, odometry: bool = False, **options: Any) -> None:
        line: Line
        if kind == "udp":
            port = free_port()
            where, line = f"udp:127.0.0.1:{port}", UdpLine("127.0.0.1", port)
        elif kind == "tcp":
            port = free_port(socket.SOCK_STREAM)
            where, line = f"tcp:127.0.0.1:{port}", TcpServerLine("127.0.0.1", port)
        else:
            line, path = pseudo_terminal()
            where = f"serial:{path}:115200"
        self.options: dict[str, Any] = {
            "robot": where,
            "pose": "odometry" if odometry else "local",
            "observation_timeout": 0.3,
            "queue": 16,
            "max_age": 60.0,  # the kit's robot has a clock that jumps as it likes
            **options,
        }
        self.transport = MavlinkTransport(self.options, STATES, INPUTS)
        self.robot = Robot(line, odometry=odometry)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.close()
        self.robot.line.close()
