"""A stand-in base on CAN as a process of its own: `python -m s2r_can.standin --help`. Its DBC: data/amr-can.dbc.

It speaks through python-can and cantools only, so that what it says is not what this package's own bit extraction says of it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import math
import os
import random
import select
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import can
import cantools

from s2r_can.base import Base, Measured, Sheet, Wheels
from s2r_can.checksums import Covered, crc8_j1850
from s2r_runtime.child import die_with_parent
from s2r_runtime.errors import ConfigError, S2RError

DBC = Path(__file__).parent / "data" / "amr-can.dbc"
COMMAND_TIMEOUT_S = 0.1
STATUS_EVERY = 5
COLLECT_S = 0.002
COMMAND_JUMP = 3
"""Steps of the command's counter that count as lost commands; others are not obeyed until they go on properly."""
EPILOG = """
stdin      effect EFFECT          begin an undeclared effect: any that is installed for the runtime's models, 'input_gain:cmd_left gain=0.8'
           clear                  end all effects
           emergency_stop         press the red button; `release` lets it go
           manual                 somebody takes the stick; `release` gives it back
           silent SECONDS         send nothing for so long
           reboot [SECONDS]       stop, be silent for so long (default 0.5), and count from zero again
           quit                   also SIGTERM
           The end of stdin changes nothing. stdout has one JSON line for each thing done, and one with the counts at the end.
"""


class Standin:
    """The base on its bus."""

    def __init__(self, body: Base, bus: can.BusABC, options: argparse.Namespace) -> None:
        self._body, self._bus, self._options = body, bus, options
        self._db: Any = cantools.database.load_file(DBC)
        self._draw = random.Random(f"{options.seed}/bus")
        self._counts = dict.fromkeys(("WheelSpeeds", "Position", "Heading", "BaseStatus"), 0)
        self._stop = self._manual = 0
        self._period = 0
        self._command: Wheels = (0.0, 0.0)
        self._commanded_at = -math.inf
        self._command_counter = -1
        self._silent_until = 0.0
        self._input = b""
        self._stdin = sys.stdin is not None and not sys.stdin.closed
        self.running = True
        self.tally = dict.fromkeys(
            ("periods", "sent", "withheld", "corrupted", "duplicated", "failed", "commands", "commands_refused", "stopped_periods"), 0
        )  # fmt: skip

    def run(self) -> None:
        """Periods of the host's clock; one that was stopped for long takes its clock up where it stands."""
        dt = self._body.sheet.dt
        due = time.monotonic() + dt
        while self.running:
            self._publish(self._body.observe())
            if self._options.eager:
                self._await()
            else:
                self._listen(due)
            fresh = time.monotonic() - self._commanded_at <= COMMAND_TIMEOUT_S
            allowed = fresh and not self._stop and not self._manual
            self.tally["stopped_periods"] += not allowed
            self.tally["periods"] += 1
            self._body.move(self._command if allowed else (0.0, 0.0))
            self._period += 1
            due = max(due + dt, time.monotonic() - 10.0 * dt)

    # ------------------------------------------------------------------ out

    def _publish(self, m: Measured) -> None:
        if time.monotonic() < self._silent_until:
            return
        for name, values in self._frames(m):
            count = self._counts[name]
            prefix = {"WheelSpeeds": "Wheel", "BaseStatus": "Status"}.get(name, name)
            self._counts[name] = (count + 1) % (16 if name == "BaseStatus" else 256)
            message = self._db.get_message_by_name(name)
            data = message.encode({**values, f"{prefix}Counter": count, f"{prefix}Checksum": 0}, padding=True, strict=False)
            self._send(message.frame_id, data[:-1] + bytes([crc8_j1850(Covered(data[:-1], data, 0, -1))]))

    def _frames(self, m: Measured) -> Iterator[tuple[str, dict[str, float]]]:
        yield "WheelSpeeds", {"Left": m.left, "Right": m.right}
        yield "Position", {"X": m.x, "Y": m.y}
        if self._period % STATUS_EVERY == 0:
            page = self._period // STATUS_EVERY % 2
            more = {"MotorTemperature": 35} if page else {"BatteryVoltage": 25.6}
            yield "BaseStatus", {"EmergencyStop": self._stop, "ManualMode": self._manual, "Page": page, **more}
        stamp = round(self._period * self._body.sheet.dt * 1e6) % 167_772_160
        yield "Heading", {"Angle": math.degrees(m.theta), "Stamp": stamp}

    def _send(self, identifier: int, data: bytes) -> None:
        """One frame; sometimes not, or wrong, or twice, as the options say. Drawn whether or not it matters."""
        o, draws = self._options, [self._draw.random() for _ in range(3)]
        if draws[0] < o.lose:
            self.tally["withheld"] += 1
            return
        if draws[1] < o.corrupt:
            self.tally["corrupted"] += 1
            where = self._draw.randrange(64)
            data = (int.from_bytes(data, "little") ^ 1 << where).to_bytes(8, "little")
        for _ in range(2 if draws[2] < o.duplicate else 1):
            try:
                self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
                self.tally["sent"] += 1
            except can.CanError:
                self.tally["failed"] += 1
        self.tally["duplicated"] += draws[2] < o.duplicate

    # ------------------------------------------------------------------ in

    def _listen(self, due: float) -> None:
        """Commands and stdin until then."""
        while self.running and (left := due - time.monotonic()) > 0.0:
            if self._stdin and select.select([0], [], [], 0.0)[0]:
                self._read()
            try:
                message = self._bus.recv(left)
            except (can.CanError, ValueError):  # bytes that are no CAN frame
                continue
            if message is not None and message.arbitration_id == 513 and not message.is_error_frame and len(message.data) == 8:
                self._obey_frame(bytes(message.data))

    def _await(self) -> None:
        """Until a command came, and a little longer, so that the newest counts; or for so long that there is nobody."""
        before, end = self.tally["commands"], time.monotonic() + 2.0 * COMMAND_TIMEOUT_S
        while self.running and self.tally["commands"] == before and time.monotonic() < end:
            self._listen(min(end, time.monotonic() + COLLECT_S))
        self._listen(time.monotonic() + COLLECT_S)

    def _obey_frame(self, data: bytes) -> None:
        told = self._db.decode_message(513, data)
        step = (int(told["CommandCounter"]) - self._command_counter) % 16
        known = time.monotonic() - self._commanded_at <= COMMAND_TIMEOUT_S
        if told["CommandChecksum"] != crc8_j1850(Covered(data[:-1], data, 0, -1)) or (known and not 1 <= step <= COMMAND_JUMP):
            self.tally["commands_refused"] += 1
            return
        self._command_counter, self._commanded_at = int(told["CommandCounter"]), time.monotonic()
        self._command = (float(told["LeftTarget"]), float(told["RightTarget"])) if told["Enable"] else (0.0, 0.0)
        self.tally["commands"] += 1

    # ------------------------------------------------------------------ what happens to it

    def _read(self) -> None:
        data = os.read(0, 65_536)
        if not data:
            self._stdin = False
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            try:
                self.obey(line.decode("utf-8", "replace").strip())
            except S2RError as error:
                self.say(error=str(error))

    def obey(self, line: str) -> None:
        """One line of stdin. Raises ConfigError."""
        verb, _, rest = line.partition(" ")
        match verb:
            case "":
                return
            case "quit":
                self.running = False
            case "effect":
                self._body.switch_on(rest)
            case "clear":
                self._body.clear()
            case "emergency_stop":
                self._stop = 1
            case "manual":
                self._manual = 1
            case "release":
                self._stop = self._manual = 0
            case "silent":
                self._silent_until = time.monotonic() + _seconds(rest, line)
            case "reboot":
                self._silent_until = time.monotonic() + _seconds(rest or "0.5", line)
                self._counts, self._commanded_at, self._period = dict.fromkeys(self._counts, 0), -math.inf, 0
            case _:
                raise ConfigError(
                    f"{line!r}: must be effect, clear, emergency_stop, manual, release, silent SECONDS, reboot [SECONDS] or quit"
                )
        self.say(done=line)

    def say(self, **facts: Any) -> None:
        """One line of JSON."""
        with contextlib.suppress(OSError):  # nobody reads
            print(json.dumps({"t": round(self._period * self._body.sheet.dt, 6), **facts}), flush=True)


def _seconds(text: str, line: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0.0 <= seconds < math.inf:
        raise ConfigError(f"{line!r}: must be a number of seconds")
    return seconds


def parser() -> argparse.ArgumentParser:
    """The options; the defaults are the data sheet that the profile `amr-can` declares."""
    sheet = Sheet()
    p = argparse.ArgumentParser(
        prog="python -m s2r_can.standin",
        description="A mobile base with two driven wheels on a CAN bus: wheel-speed commands, pose from a localisation. Real time.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "--bus", default='{"interface": "udp_multicast", "channel": "239.74.163.10", "port": 43310}', help="python-can settings, JSON"
    )
    p.add_argument("--seed", type=int, default=1, help="of noise and losses (default %(default)s)")
    p.add_argument("--start", type=float, nargs=3, metavar=("X", "Y", "THETA"), default=(0.0, 0.0, 0.0), help="pose in m and rad")
    p.add_argument("--period", type=float, default=sheet.dt, help="s (default %(default)s)")
    p.add_argument("--time-constant", type=float, default=sheet.time_constant, help="of the wheels, s (default %(default)s)")
    p.add_argument("--latency", type=int, default=sheet.latency, help="periods until a command acts (default %(default)s)")
    p.add_argument("--effect", action="append", default=[], metavar="EFFECT", help="undeclared, from the start; repeatable")
    p.add_argument(
        "--eager", action="store_true", help="a period is over when a command came: time goes as fast as it is answered, for tests"
    )
    p.add_argument("--lose", type=float, default=0.0, metavar="P", help="probability that a frame is not sent")
    p.add_argument("--corrupt", type=float, default=0.0, metavar="P", help="probability that a bit of a frame is wrong")
    p.add_argument("--duplicate", type=float, default=0.0, metavar="P", help="probability that a frame is sent twice")
    p.add_argument("--parent", type=int, default=0, metavar="PID", help="end when this process, which must be the parent, does")
    return p


def main(argv: list[str] | None = None) -> int:
    """Runs until `quit`, SIGTERM or SIGINT. Returns the exit code."""
    o = parser().parse_args(argv)
    logging.getLogger("can").setLevel(logging.CRITICAL)
    if o.parent:
        die_with_parent(o.parent)
    try:
        for name, ok, must in (
            ("--period", 0.001 <= o.period <= 1.0, "0.001 to 1 s"),
            ("--time-constant", 0.0 <= o.time_constant < math.inf, ">= 0 s"),
            ("--latency", 0 <= o.latency <= 100, "0 to 100 periods"),
            *((f"--{name}", 0.0 <= getattr(o, name) < 1.0, "in [0, 1)") for name in ("lose", "corrupt", "duplicate")),
        ):
            if not ok:
                raise ConfigError(f"{name}: must be {must}")
        sheet = Sheet(dt=o.period, time_constant=o.time_constant, latency=o.latency)
        body = Base(sheet, tuple(o.start), o.seed)
        for effect in o.effect:
            body.switch_on(effect)
        try:
            bus = can.Bus(ignore_config=True, **json.loads(o.bus))
        except (can.CanError, ValueError, TypeError, OSError, NotImplementedError) as error:
            raise ConfigError(f"--bus {o.bus}: {error}") from None
        with bus:
            base = Standin(body, bus, o)

            def end(_signal: int, _frame: FrameType | None) -> None:
                base.running = False

            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, end)
            base.run()
            base.say(**base.tally)
    except S2RError as error:
        print(f"standin: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
