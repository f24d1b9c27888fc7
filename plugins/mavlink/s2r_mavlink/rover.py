"""A stand-in for ArduPilot's Rover as a process of its own: `python -m s2r_mavlink.rover --help`.

It speaks through pymavlink, so that what this package reads and writes is held against somebody else's implementation. It does what the
transport relies on: heartbeat, modes, arming, message intervals in whole milliseconds that are denied above 0.8 of its loop rate, velocity
targets in GUIDED that lapse after 3 s, LOCAL_POSITION_NED and ATTITUDE, TIMESYNC, signing, reboot. It is no simulation of an autopilot.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from s2r_mavlink.robot_state import ROVER_MODES, mode_name
from s2r_mavlink.rover_body import RoverBody
from s2r_mavlink.rover_lines import Line, line_of
from s2r_runtime.child import die_with_parent
from s2r_runtime.errors import ConfigError

LAPSE_S = 3.0
LOOP_SHARE = 0.8
GROUND_ROVER, ARDUPILOT = 10, 3
DEFAULT_INTERVALS_MS = {0: 1000, 30: 250, 32: 250}
BOOT_S = 0.7
"""Silent for so long when it starts anew."""
EPILOG = """
stdin   mode NAME | arm | disarm | reboot | state critical|active | quit        what a person or a fail-safe does to it
stdout  one JSON line for everything that happens to it, with its own time: {"t": 12.3, "armed": true}
"""


class Rover:
    """The autopilot. say: told everything that happens to it."""

    def __init__(self, line: Line, options: argparse.Namespace, say: Callable[[dict[str, object]], None]) -> None:
        self._line, self._options, self._tell_person = line, options, say
        self._body = RoverBody(tuple(options.start), options.sigma, options.seed, options.turn_gain)
        self._period: float = 1.0 / options.loop_rate
        self._uptime: float = options.uptime
        self.running = True
        self.sent: dict[str, int] = {}
        self.mode, self.armed, self.state = ROVER_MODES[options.mode], options.armed, 4
        self._doers: dict[str, Callable[[Any], object]] = {
            "COMMAND_LONG": self._command,
            "SET_POSITION_TARGET_LOCAL_NED": self._target,
            "SET_MODE": lambda m: self._set_mode(m.custom_mode),
            "TIMESYNC": self._timesync,
            "REQUEST_DATA_STREAM": self._stream,
        }
        self._begin()
        self.due_s = time.monotonic()

    def _begin(self) -> None:
        """As it is after power came on."""
        self._mav = mavlink.MAVLink(None, self._options.system, 1)
        self._mav.robust_parsing = True
        if self._options.key_file:
            self._mav.signing.secret_key = bytes.fromhex(self._options.key_file.read_text().strip())
            self._mav.signing.sign_outgoing = True
            lag_s = self._options.signing_lag
            self._mav.signing.timestamp = int((time.time() - 1_420_070_400 - lag_s) * 1e5)
        self._k = 0
        self._aim = (0.0, 0.0)
        self._aimed_s = -math.inf
        self._intervals = dict(DEFAULT_INTERVALS_MS)
        self._due = dict.fromkeys(self._intervals, 0.0)

    @property
    def now_s(self) -> float:
        """Its clock."""
        return self._uptime + self._k * self._period

    def advance(self) -> None:
        """Takes what came, and steps as often as is due (`due_s`, host's clock). Not for long if it was held up for long."""
        step = self._period / self._options.speedup
        now_s = time.monotonic()
        while data := self._line.read():
            if now_s >= self.due_s - 20.0 * step:  # what comes while it starts is not heard
                self._hear(data)
        self.due_s = max(self.due_s, now_s - 20.0 * step)
        while self.due_s <= now_s:
            self._step()
            self.due_s += step

    @property
    def descriptors(self) -> list[int]:
        """Readable when something came."""
        return self._line.descriptors()

    def _step(self) -> None:
        aim = self._aim if self.mode == ROVER_MODES["GUIDED"] and self.armed and self.now_s - self._aimed_s <= LAPSE_S else (0.0, 0.0)
        self._body.move(aim, self._period)
        self._k += 1
        for number, interval_ms in self._intervals.items():
            if interval_ms and self.now_s >= self._due[number] - 1e-9:
                self._due[number] = max(self._due[number] + 1e-3 * interval_ms, self.now_s)
                self._tell(number)

    def _tell(self, number: int) -> None:
        ms = int(1000.0 * self.now_s + 1e-6)
        if number == 0:
            base = 1 | 128 * self.armed
            self._send(self._mav.heartbeat_encode(GROUND_ROVER, ARDUPILOT, base, self.mode, self.state))
            return
        north, east, yaw, speed, turn = self._body.estimate()
        if number == 30:
            self._send(self._mav.attitude_encode(ms, 0.0, 0.0, yaw, 0.0, 0.0, turn))
        elif number == 32:
            self._send(self._mav.local_position_ned_encode(ms, north, east, 0.0, speed * math.cos(yaw), speed * math.sin(yaw), 0.0))

    def _send(self, message: Any) -> None:
        data = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        self._line.write(data)
        self.sent[message.get_type()] = self.sent.get(message.get_type(), 0) + 1

    # ------------------------------------------------------------------ what comes

    def _hear(self, data: bytes) -> None:
        for message in (self._mav.parse_buffer(data) or []) if data else []:
            doer = self._doers.get(message.get_type())
            target = getattr(message, "target_system", self._options.system)
            if doer is not None and target in (0, self._options.system):
                doer(message)

    def _target(self, m: Any) -> None:
        """As ArduPilot's Rover reads it: all acceleration bits masked, no velocity bit, the speed with the sign of vx."""
        mask = m.type_mask
        if self.mode != ROVER_MODES["GUIDED"] or m.coordinate_frame not in (1, 7, 8, 9):
            return
        acceleration_ignored, velocity_ignored = mask & 448, mask & 56
        if mask & 7 and acceleration_ignored == 448 and not velocity_ignored and mask & 1024 and not mask & 2048:
            speed = min(math.hypot(m.vx, m.vy), self._options.top_speed)
            self._aim, self._aimed_s = (math.copysign(speed, m.vx) if speed else 0.0, m.yaw_rate), self.now_s

    def _timesync(self, m: Any) -> None:
        if m.tc1 == 0:
            self._send(self._mav.timesync_encode(int(self.now_s * 1e9), m.ts1))

    def _stream(self, m: Any) -> None:
        """The old way to ask for rates: what a ground station does at its start."""
        if m.start_stop and m.req_message_rate:
            self._intervals |= dict.fromkeys((30, 32), max(1000 // m.req_message_rate, self._least_ms()))

    def _least_ms(self) -> int:
        return math.ceil(1000.0 / (LOOP_SHARE * float(self._options.loop_rate)) - 1e-9)

    def _command(self, m: Any) -> None:
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if m.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._interval(int(m.param1), m.param2)
        elif m.command == mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
            result = mavlink.MAV_RESULT_ACCEPTED
            interval_us = 1000 * self._intervals.get(int(m.param1), 0) or -1
            self._send(self._mav.message_interval_encode(int(m.param1), interval_us))
        elif m.command == mavlink.MAV_CMD_DO_SET_MODE:
            result = self._set_mode(int(m.param2))
        elif m.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            result = self._arm(m.param1 > 0.5)
        elif m.command == mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
            result = mavlink.MAV_RESULT_ACCEPTED
        ack = (m.command, result, 0, 0, m.get_srcSystem(), m.get_srcComponent())
        self._send(self._mav.command_ack_encode(*ack))
        if m.command == mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
            self._reboot()

    def _interval(self, number: int, interval_us: float) -> int:
        if number not in DEFAULT_INTERVALS_MS:
            return int(mavlink.MAV_RESULT_FAILED)
        wanted_ms = DEFAULT_INTERVALS_MS[number] if interval_us == 0 else 0 if interval_us < 0 else max(1, int(interval_us / 1000.0))
        if wanted_ms and wanted_ms < self._least_ms():
            return int(mavlink.MAV_RESULT_DENIED)
        self._intervals[number], self._due[number] = wanted_ms, self.now_s + 1e-3 * wanted_ms
        self._say(interval=number, ms=wanted_ms)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _set_mode(self, mode: int) -> int:
        if mode not in ROVER_MODES.values():
            return int(mavlink.MAV_RESULT_FAILED)
        self.mode = mode
        self._say(mode=mode_name(mode))
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _arm(self, armed: bool) -> int:
        if armed and self._options.prearm_fails:
            self._send(self._mav.statustext_encode(2, b"Arm: GPS 1: Bad fix"))
            return int(mavlink.MAV_RESULT_FAILED)
        self.armed = armed
        self._say(armed=armed)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _reboot(self) -> None:
        self._say(reboot=True)
        self._body.stand()
        self.mode, self.armed, self.state = ROVER_MODES["HOLD"], False, 4
        self._uptime = 0.0
        self._begin()
        self.due_s = time.monotonic() + BOOT_S

    # ------------------------------------------------------------------ the person beside it

    def obey(self, line: str) -> None:
        """What a person does to it."""
        match line.split():
            case ["mode", name] if name in ROVER_MODES:
                self._set_mode(ROVER_MODES[name])
            case ["arm" | "disarm" as what]:
                self._arm(what == "arm")
            case ["reboot"]:
                self._reboot()
            case ["state", "critical" | "active" as state]:
                self.state = 5 if state == "critical" else 4
            case ["quit"]:
                self.running = False
                self._say(sent=dict(self.sent))
            case []:
                pass
            case _:
                self._say(error=f"{line!r} is none of: mode NAME, arm, disarm, reboot, state critical|active, quit")

    def _say(self, **facts: object) -> None:
        self._tell_person({"t": round(self.now_s, 3), **facts})


def parser() -> argparse.ArgumentParser:
    """The options."""
    p = argparse.ArgumentParser(
        prog="python -m s2r_mavlink.rover",
        description="A stand-in for ArduPilot's Rover that speaks MAVLink.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("line", metavar="LINE", help="udpout:HOST:PORT, tcpin:HOST:PORT or serial:PATH:BAUD")
    p.add_argument("--system", type=int, default=1, help="its system id (default %(default)s)")
    p.add_argument("--loop-rate", type=float, default=50.0, metavar="HZ", help="(default %(default)s)")
    p.add_argument("--speedup", type=float, default=1.0, help="its seconds in one of the host's (default %(default)s)")
    p.add_argument("--uptime", type=float, default=10.0, metavar="S", help="its clock at the start (default %(default)s)")
    p.add_argument("--mode", choices=sorted(ROVER_MODES), default="HOLD", help="at the start (default %(default)s)")
    p.add_argument("--armed", action="store_true", help="armed at the start")
    p.add_argument("--prearm-fails", action="store_true", help="it refuses to arm")
    p.add_argument("--start", type=float, nargs=3, metavar=("NORTH", "EAST", "YAW"), default=(0.0, 0.0, 0.0), help="m, m, rad clockwise")
    p.add_argument("--sigma", type=float, default=0.001, metavar="M", help="noise of its position estimate (default %(default)s)")
    p.add_argument("--top-speed", type=float, default=3.0, metavar="M/S", help="(default %(default)s)")
    p.add_argument("--turn-gain", type=float, default=1.0, help="what becomes of a turn rate that it is told (default %(default)s)")
    p.add_argument("--key-file", type=Path, help="holds 64 hexadecimal digits: signs, and wants to be signed to")
    p.add_argument("--signing-lag", type=float, default=0.0, metavar="S", help="how far its signing clock is behind (default %(default)s)")
    p.add_argument("--seed", type=int, default=1, help="of its noise (default %(default)s)")
    p.add_argument("--parent", type=int, default=0, metavar="PID", help="end when this process, which must be the parent, does")
    return p


def run(rover: Rover) -> None:
    """Until it is told to quit."""
    person = [0] if sys.stdin is not None and not sys.stdin.closed else []
    typed = b""
    while rover.running:
        rover.advance()
        left = max(0.0, rover.due_s - time.monotonic())
        if 0 in select.select([*person, *rover.descriptors], [], [], left)[0]:
            data = os.read(0, 65_536)
            person = person if data else []
            *lines, typed = (typed + data).split(b"\n")
            for line in lines:
                rover.obey(line.decode("utf-8", "replace"))


def main(argv: list[str] | None = None) -> int:
    """Runs until `quit` or a signal. Returns the exit code."""
    options = parser().parse_args(argv)
    if options.parent:
        die_with_parent(options.parent)
    try:
        line = line_of(options.line)
    except (ConfigError, OSError) as error:
        print(f"rover: {options.line}: {error}", file=sys.stderr)
        return 78
    with contextlib.closing(line), contextlib.suppress(KeyboardInterrupt):
        run(Rover(line, options, lambda facts: print(json.dumps(facts), flush=True)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
