"""A robot's end of the MAVLink transport, for tests: real sockets and pseudo-terminals on loopback, bytes made by pymavlink.

from s2r_runtime.testing import TransportKit
from s2r_mavlink.testing import MavlinkRig

class TestUdp(TransportKit):
    rig = partial(MavlinkRig, "udp")
    carries, tolerance, numbered, resolution_ns = (), 1e-6, False, 1_000_000
"""

from __future__ import annotations

import json
import math
import os
import random
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Self

from pymavlink.dialects.v20 import common as mavlink

from s2r_mavlink.rover import Rover, parser
from s2r_mavlink.rover_lines import Line, TcpServerLine, UdpLine, line_of, pseudo_terminal
from s2r_mavlink.transport import MavlinkTransport
from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged

STATES, INPUTS = ("x", "y", "theta"), ("v", "w")
GUIDED, HOLD = 15, 4
ARMED = 0x81
NUMBERS_EACH = 3
"""Sequence numbers that one observation takes: of a heartbeat, sent now and then, an attitude and a position."""
HEARTBEAT_S = 0.4
PATIENCE_S = 15.0
"""How long anything may take that takes milliseconds on an idle machine."""


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
        self.robot, self._odometry = Robot(line, odometry=odometry), odometry
        self._twins: list[Robot] = []

    def twin(self) -> Robot:
        """Another robot with the same system id: at another address where there are addresses, on the same line elsewhere."""
        where = self.options["robot"]
        line = UdpLine("127.0.0.1", int(where.rpartition(":")[2])) if where.startswith("udp:") else self.robot.line
        self._twins.append(Robot(line, odometry=self._odometry))
        return self._twins[-1]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.close()
        for robot in (*self._twins, self.robot):
            robot.line.close()


# ---------------------------------------------------------------- the stand-in rover, and a loop like the daemon's


class RoverProcess:
    """The stand-in as a process. What it says comes in `said`, one dict a line."""

    def __init__(self, line: str, *arguments: str) -> None:
        argv = [sys.executable, "-m", "s2r_mavlink.rover", line, "--parent", str(os.getpid()), *arguments]
        theirs_in, self._in = os.pipe()
        self._out, theirs_out = os.pipe()
        self.process = subprocess.Popen(argv, stdin=theirs_in, stdout=theirs_out)
        for descriptor in (theirs_in, theirs_out):
            os.close(descriptor)
        os.set_blocking(self._out, False)
        self._rest = b""
        self._said: list[dict[str, Any]] = []

    def tell(self, line: str) -> None:
        """What a person beside it does: `mode HOLD`, `disarm`, `reboot`, ..."""
        os.write(self._in, line.encode() + b"\n")

    def advance(self) -> None:
        """It does so by itself."""

    @property
    def said(self) -> list[dict[str, Any]]:
        """Everything that happened to it so far."""
        with suppress(BlockingIOError):
            while data := os.read(self._out, 65_536):
                *lines, self._rest = (self._rest + data).split(b"\n")
                self._said += [json.loads(line) for line in lines]
        return self._said

    def end(self) -> None:
        """Ends it, also when it is stopped."""
        self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.wait(PATIENCE_S)
        for descriptor in (self._in, self._out):
            os.close(descriptor)


class RoverHere:
    """The stand-in in this process: it goes on with every turn of the loop, and can be frozen."""

    def __init__(self, line: str, *arguments: str) -> None:
        self._line = line_of(line)
        self.said: list[dict[str, Any]] = []
        self.frozen = False
        self._rover = Rover(self._line, parser().parse_args([line, *arguments]), self.said.append)

    def tell(self, line: str) -> None:
        """As `RoverProcess.tell`."""
        self._rover.obey(line)

    def advance(self) -> None:
        """What is due."""
        if not self.frozen:
            self._rover.advance()

    def end(self) -> None:
        """Ends it."""
        self._line.close()


@contextmanager
def rover(line: str, *arguments: str, process: bool = False) -> Iterator[RoverProcess | RoverHere]:
    """The stand-in while it is needed."""
    made = RoverProcess(line, *arguments) if process else RoverHere(line, *arguments)
    try:
        yield made
    finally:
        made.end()


class Runtime:
    """A transport and a loop like the daemon's, which answers every good observation with `command` (nothing if it is None)."""

    def __init__(self, robot: str, **options: Any) -> None:
        self.options = {"robot": robot, **options}
        self.transport = MavlinkTransport(self.options, STATES, INPUTS)
        self.frames: list[Frame] = []
        self.messages: list[Observation | ObservationRefused | Command | LinkChanged | OverrideChanged] = []
        self.lines: list[str] = []
        self.command: tuple[float, float] | None = None
        self.source: Any = "sampler"
        self.beside: list[RoverProcess | RoverHere] = []
        self._sent = 0

    def __enter__(self) -> Self:
        self.transport.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.close()

    def turn(self) -> None:
        """One turn, of the robots `beside` it too."""
        for robot in self.beside:
            robot.advance()
        select.select([self.transport.fileno()], [], [], 0.005)
        for frame in self.transport.receive():
            self.frames.append(frame)
            for message in self.transport.decode(frame):
                self.messages.append(message)
                if isinstance(message, Observation) and not message.fault and self.command is not None:
                    self._sent += 1
                    command = Command(self._sent, time.monotonic_ns(), self.source, self.command, message.seq, 10**8)
                    self.transport.send(self.transport.encode(command))
        self.messages += self.transport.poll(time.monotonic_ns())
        self.lines += self.transport.lines()

    def until(self, ready: Callable[[], Any], within_s: float = PATIENCE_S) -> bool:
        """Turns until it is so; False when the time is over."""
        end = time.monotonic() + within_s
        while not ready():
            if time.monotonic() > end:
                return False
            self.turn()
        return True

    def run(self, seconds: float) -> None:
        """Turns for so long."""
        self.until(lambda: False, seconds)

    def more(self, count: int = 20) -> bool:
        """Whether that many good observations more come."""
        wanted = len(self.good) + count
        return self.until(lambda: len(self.good) >= wanted)

    @property
    def observations(self) -> list[Observation]:
        """All, faulty ones too."""
        return [m for m in self.messages if isinstance(m, Observation)]

    @property
    def good(self) -> list[Observation]:
        """Those without a fault."""
        return [o for o in self.observations if not o.fault]

    @property
    def faults(self) -> list[str]:
        """What was wrong with the others."""
        return [o.fault for o in self.observations if o.fault]

    @property
    def ups(self) -> list[bool]:
        """Link changes."""
        return [m.up for m in self.messages if isinstance(m, LinkChanged)]

    @property
    def overrides(self) -> list[OverrideChanged]:
        """Stops by a person, or by the robot itself."""
        return [m for m in self.messages if isinstance(m, OverrideChanged)]

    @property
    def counters(self) -> dict[str, int]:
        """The transport's."""
        return self.transport.counters()


# ---------------------------------------------------------------- spoilt bytes


def fuzzed(draw: random.Random, corpus: list[bytes]) -> bytes:
    """A frame of the corpus, spoilt in one of the ways that lines and attackers have; or noise."""
    data = bytearray(draw.choice(corpus))
    for _ in range(draw.randint(1, 3)):
        way = draw.randrange(7)
        if not data:
            break
        if way == 0:
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        elif way == 1:
            data[draw.randrange(len(data))] = draw.randrange(256)
        elif way == 2:
            del data[draw.randrange(len(data)) :]
        elif way == 3:
            at = draw.randrange(len(data))
            data[at:at] = bytes(draw.randrange(256) for _ in range(draw.randint(1, 20)))
        elif way == 4:
            data += draw.choice(corpus)
        elif way == 5:
            at = draw.randrange(len(data))
            del data[at : at + draw.randint(1, 8)]
        else:
            data = bytearray(draw.randrange(256) for _ in range(draw.randint(0, 300)))
    return bytes(data)


def flipped(draw: random.Random, frame: bytes) -> bytes:
    """One to three bits the other way, which the checksum is sure to find at these lengths; never in the message's number, which decides
    what checksum there is.
    """
    data = bytearray(frame)
    for bit in draw.sample([8 * i + b for i in range(len(data)) if i not in (0, 7, 8, 9) for b in range(8)], draw.randint(1, 3)):
        data[bit // 8] ^= 1 << bit % 8
    return bytes(data)
