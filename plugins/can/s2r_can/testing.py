"""A robot's end of the CAN transport, for tests: real python-can buses, and cantools at the robot's end, which knows nothing of ours.

from s2r_runtime.testing import TransportKit
from s2r_can.testing import ClassicRig

class TestCan(TransportKit):
    rig = ClassicRig
    carries = ()
    tolerance = 1e-6
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from typing import Any, Self

import can
import cantools

from s2r_can.checksums import Covered, crc8_j1850
from s2r_can.hub import Hub
from s2r_can.transport import CanTransport
from s2r_runtime.messages import Command

STATES, INPUTS = ("x", "y", "theta"), ("v", "w")
_NUMBERS = itertools.count()
NOT_AVAILABLE = -2147483648

CLASSIC = """VERSION ""

NS_ :

BS_:

BU_: Base Runtime

BO_ 272 Position: 8 Base
 SG_ X : 0|32@1- (1E-006,0) [-1000|1000] "m" Runtime
 SG_ Y : 32|32@1- (1E-006,0) [-1000|1000] "m" Runtime

BO_ 273 Heading: 8 Base
 SG_ Theta : 7|32@0- (1E-007,0) [-200|200] "rad" Runtime
 SG_ HeadingCounter : 32|16@1+ (1,0) [0|65535] "" Runtime
 SG_ HeadingChecksum : 56|8@1+ (1,0) [0|255] "" Runtime

BO_ 274 Clock: 8 Base
 SG_ Stamp : 0|32@1+ (1,0) [0|4294967295] "us" Runtime
 SG_ ClockCounter : 32|16@1+ (1,0) [0|65535] "" Runtime
 SG_ Stop : 48|1@1+ (1,0) [0|1] "" Runtime
 SG_ ClockChecksum : 56|8@1+ (1,0) [0|255] "" Runtime

BO_ 528 Drive: 8 Runtime
 SG_ V : 0|24@1- (1E-006,0) [-8|8] "m/s" Base
 SG_ W : 31|24@0- (1E-006,0) [-8|8] "rad/s" Base
 SG_ DriveCounter : 48|4@1+ (1,0) [0|15] "" Base
 SG_ Enable : 52|1@1+ (1,0) [0|1] "" Base
 SG_ DriveChecksum : 56|8@1+ (1,0) [0|255] "" Base

VAL_ 272 X -2147483648 "not available" ;
VAL_ 272 Y -2147483648 "not available" ;
VAL_ 273 Theta -2147483648 "not available" ;
"""

WIDE = """VERSION ""

NS_ :

BS_:

BU_: Base Runtime

BO_ 2566849552 Pose: 48 Base
 SG_ X : 0|64@1- (1,0) [0|0] "m" Runtime
 SG_ Y : 71|64@0- (1,0) [0|0] "m" Runtime
 SG_ Theta : 128|64@1- (1,0) [0|0] "rad" Runtime
 SG_ Stamp : 192|64@1+ (1,0) [0|0] "ns" Runtime
 SG_ PoseCounter : 256|16@1+ (1,0) [0|0] "" Runtime
 SG_ Stop : 272|1@1+ (1,0) [0|0] "" Runtime
 SG_ PoseChecksum : 376|8@1+ (1,0) [0|0] "" Runtime

BO_ 2566849808 Drive: 20 Runtime
 SG_ V : 0|64@1- (1,0) [0|0] "m/s" Base
 SG_ W : 71|64@0- (1,0) [0|0] "rad/s" Base
 SG_ DriveCounter : 128|8@1+ (1,0) [0|0] "" Base
 SG_ Enable : 136|1@1+ (1,0) [0|0] "" Base
 SG_ DriveChecksum : 152|8@1+ (1,0) [0|0] "" Base

SIG_VALTYPE_ 2566849552 X : 2;
SIG_VALTYPE_ 2566849552 Y : 2;
SIG_VALTYPE_ 2566849552 Theta : 2;
SIG_VALTYPE_ 2566849808 V : 2;
SIG_VALTYPE_ 2566849808 W : 2;
"""


class Robot:
    """A robot's end: publishes what it is told to, and keeps what it hears. dbc: CLASSIC, or WIDE for CAN FD."""

    def __init__(self, config: dict[str, Any], dbc: str) -> None:
        self._config = config
        self._db = cantools.database.load_string(dbc, database_format="dbc")
        self._wide = dbc is WIDE
        self._bus: can.BusABC | None = None
        self.stop = 0

    @property
    def bus(self) -> can.BusABC:
        """Opened when it is first used."""
        if self._bus is None:
            self._bus = can.Bus(ignore_config=True, **self._config)
        return self._bus

    def close(self) -> None:
        """Leaves the bus; comes back when it publishes again."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    def frame(self, name: str, values: dict[str, float]) -> can.Message:
        """A frame as cantools makes it, the checksum filled in."""
        message: Any = self._db.get_message_by_name(name)  # type: ignore[union-attr]
        data = message.encode(values, scaling=True, strict=False)
        if any(signal.name == f"{name}Checksum" for signal in message.signals):
            data = data[:-1] + bytes([crc8_j1850(Covered(data[:-1], data, 0, -1))])
        return can.Message(
            arbitration_id=message.frame_id, is_extended_id=message.is_extended_frame, is_fd=message.length > 8, data=data
        )  # fmt: skip

    def frames(self, seq: int, stamp_ns: int, x: tuple[float, ...]) -> list[can.Message]:
        """One observation's frames. A number that is not finite is sent as the bus can say it."""
        if self._wide:
            values = dict(zip(("X", "Y", "Theta"), x, strict=True))
            more = {"Stamp": stamp_ns, "PoseCounter": seq % 65536, "Stop": self.stop, "PoseChecksum": 0}
            return [self.frame("Pose", {**values, **more})]
        steps = (1e-6, 1e-6, 1e-7)
        xs, ys, heading = (value if math.isfinite(value) else NOT_AVAILABLE * step for value, step in zip(x, steps, strict=True))
        return [
            self.frame("Position", {"X": xs, "Y": ys}),
            self.frame("Heading", {"Theta": heading, "HeadingCounter": seq % 65536, "HeadingChecksum": 0}),
            self.frame("Clock", {"Stamp": stamp_ns // 1000, "ClockCounter": seq % 65536, "Stop": self.stop, "ClockChecksum": 0}),
        ]

    def publish(self, seq: int, stamp_ns: int, x: tuple[float, ...]) -> None:
        """One observation."""
        for message in self.frames(seq, stamp_ns, x):
            self.bus.send(message)

    def publish_raw(self, data: bytes) -> None:
        """These bytes in the frame that makes an observation, as many as it holds."""
        name, most = ("Pose", 64) if self._wide else ("Clock", 8)
        message = self._db.get_message_by_name(name)  # type: ignore[union-attr]
        length = next(n for n in (*range(9), 12, 16, 20, 24, 32, 48, 64) if n >= min(len(data), most))
        payload = data[:most].ljust(length, b"\0")
        self.bus.send(
            can.Message(arbitration_id=message.frame_id, is_extended_id=message.is_extended_frame, is_fd=self._wide, data=payload)
        )

    def received(self) -> list[Command]:
        """Commands since the last call, as cantools reads them."""
        found = []
        drive: Any = self._db.get_message_by_name("Drive")  # type: ignore[union-attr]
        while (message := self.bus.recv(0.0)) is not None:
            if message.arbitration_id == drive.frame_id and len(message.data) == drive.length:
                values = drive.decode(message.data)
                found.append(Command(values["DriveCounter"], 0, "recovery", (float(values["V"]), float(values["W"])), 0, 0))
        return found


def options_of(dbc: str, robot: dict[str, Any]) -> dict[str, Any]:
    """A transport's options for CLASSIC or WIDE. robot: python-can settings."""
    wide = dbc is WIDE
    head = "Pose" if wide else "Position"
    guarded = ("Pose", "Drive") if wide else ("Heading", "Clock", "Drive")
    return {
        "dbc": {"file": "rig.dbc", "text": dbc},
        "robot": robot,
        "states": {"x": f"{head}.X", "y": f"{head}.Y", "theta": "Pose.Theta" if wide else "Heading.Theta"},
        "inputs": {"v": "Drive.V", "w": "Drive.W"},
        "constants": {"Drive.Enable": 1},
        "counters": {name: f"{name}Counter" for name in guarded},
        "checksums": {name: f"{name}Checksum" for name in guarded},
        "overrides": {"emergency_stop": "Pose.Stop" if wide else "Clock.Stop"},
        "stamp": "Pose.Stamp" if wide else "Clock.Stamp",
        "message_timeout": 0.2,
        "observation_timeout": 0.3,
        "queue": 48,
    }


class Rig:
    """Transport and robot on one bus."""

    states, inputs = STATES, INPUTS
    dbc = CLASSIC

    def __init__(self, robot: dict[str, Any], **more: Any) -> None:
        self.options = {**options_of(self.dbc, robot), **more}
        self.transport = CanTransport(self.options, STATES, INPUTS)
        self.robot = Robot(robot, self.dbc)
        self._twins: list[Robot] = []

    def twin(self) -> Robot:
        """Another node that sends the same identifiers."""
        self._twins.append(Robot(self.options["robot"], self.dbc))
        return self._twins[-1]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.close()
        for robot in (self.robot, *self._twins):
            robot.close()


class VirtualRig(Rig):
    """In one process, CAN FD, 64-bit floats, an extended identifier."""

    dbc = WIDE

    def __init__(self, **more: Any) -> None:
        super().__init__({"interface": "virtual", "channel": f"rig-{next(_NUMBERS)}"}, **more)


class SocketRig(Rig):
    """Over TCP on loopback: python-can's socketcand against a hub, classic frames."""

    def __init__(self, **more: Any) -> None:
        self.hub = Hub().start()
        super().__init__(
            {"interface": "socketcand", "host": "127.0.0.1", "port": self.hub.port, "channel": "can0", "tcp_tune": True}, **more
        )

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self.hub.close()


class MulticastRig(Rig):
    """Over UDP multicast, CAN FD; for a network namespace of the test's own, as multicast leaves the host."""

    dbc = WIDE

    def __init__(self, **more: Any) -> None:
        super().__init__({"interface": "udp_multicast", "channel": "239.74.163.7", "port": 43200 + next(_NUMBERS) % 500}, **more)


def multicast_works() -> bool:
    """Whether frames come back over python-can's udp_multicast here."""
    config: dict[str, Any] = {"interface": "udp_multicast", "channel": "239.74.163.7", "port": 43199}
    with contextlib.suppress(can.CanError, OSError), can.Bus(ignore_config=True, **config) as bus:
        end = time.monotonic() + 1.0
        bus.send(can.Message(arbitration_id=1, data=b"?"))
        while time.monotonic() < end:
            if bus.recv(0.1) is not None:
                return True
    return False
