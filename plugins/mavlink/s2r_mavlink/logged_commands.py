"""What a telemetry log holds of commands: velocities, sticks, and what the actuators got; and why one of them does not count.

    v, w            SET_POSITION_TARGET_LOCAL_NED and _GLOBAL_INT with velocity and yaw rate. Body frames: v = vx. Frames along
                    north and east: v is the component along the robot's heading, at every pose while the command acts
    manual_x ... r  MANUAL_CONTROL, in thousandths: x, y, z, r
    rc1 ... rc18    RC_CHANNELS_OVERRIDE, (microseconds - 1500) / 500
    servo1 ... 16   SERVO_OUTPUT_RAW, likewise
    actuator1 ... 32  ACTUATOR_OUTPUT_STATUS, as it is;  control1 ... 16  HIL_ACTUATOR_CONTROLS, as it is

A velocity acts for `LAPSE_S`, the others until the next one.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from typing import Any, NamedTuple

from s2r_mavlink.dialect import (
    ACTUATOR_OUTPUT_STATUS,
    BODY_FRAMES,
    HIL_ACTUATOR_CONTROLS,
    LOGGED,
    MANUAL_CONTROL,
    MESSAGES,
    RC_CHANNELS_OVERRIDE,
    SERVO_OUTPUT_RAW,
    SET_POSITION_TARGET_GLOBAL_INT,
    SET_POSITION_TARGET_LOCAL_NED,
)

NORTH_EAST_FRAMES = (0, 1, 3, 5, 6, 7, 10, 11)
"""MAV_FRAME: global, local NED, local offset NED and their kind: velocities are north, east, down."""
VELOCITY_BITS, POSITION_BITS, IGNORES_YAW_RATE = 8 | 16 | 32, 1 | 2, 2048
"""Of a setpoint's type mask: what it leaves out. ArduPilot's Rover takes a velocity only if none of its three parts is left out."""
CENTRE_US, HALF_RANGE_US = 1500.0, 500.0
RC_IGNORED = (0, 65534, 65535)
STICK_MAX = 1000
NUMBER_MAX = 1e7
VELOCITIES = ("v", "w")
SIGNALS = re.compile(r"manual_[xyzr]|rc([1-9]|1[0-8])|servo([1-9]|1[0-6])|actuator([1-9]|[12]\d|3[0-2])|control([1-9]|1[0-6])")
_SETPOINTS = (SET_POSITION_TARGET_LOCAL_NED, SET_POSITION_TARGET_GLOBAL_INT)
_STICKS = (MANUAL_CONTROL, RC_CHANNELS_OVERRIDE)
NUMBERS = frozenset({SET_POSITION_TARGET_LOCAL_NED, *LOGGED})


class Velocity(NamedTuple):
    """host_s: the logging computer's clock. along, across: m/s forward and right if `body`, else north and east. w: counter-clockwise."""

    host_s: float
    body: bool
    along: float
    across: float
    w: float


class Raw(NamedTuple):
    """Signals of one message; NaN where it leaves one as it was."""

    host_s: float
    values: dict[str, float]


class Commands:
    """Collects what is commanded to `system`. inputs: the signals that are wanted. unused: (message, why not) -> number of them."""

    def __init__(self, system: int, inputs: tuple[str, ...]) -> None:
        self._system = system
        self._velocities = bool(set(inputs) & set(VELOCITIES))
        self._turns = "w" in inputs
        self._raw = set(inputs) - set(VELOCITIES)
        self.velocities: list[Velocity] = []
        self.raw: list[Raw] = []
        self.unused: Counter[tuple[str, str]] = Counter()

    def take(self, host_s: float, sender: int, number: int, payload: bytes) -> None:
        """One message with a number of `NUMBERS`."""
        message = MESSAGES.get(number) or LOGGED[number]
        fields = message.unpack(payload)
        if number in _SETPOINTS:
            why = self._velocity(host_s, fields)
        else:
            why = self._signals(host_s, sender, number, dict(zip(message.fields, fields, strict=False)), fields)
        if why:
            self.unused[message.name, why] += 1

    def _velocity(self, host_s: float, f: tuple[Any, ...]) -> str:
        mask, target, frame = f[12], f[13], f[15]
        if target not in (self._system, 0):
            return "for another system"
        if not self._velocities:
            return "the model has neither v nor w"
        if mask & VELOCITY_BITS or not mask & POSITION_BITS:
            return "a position, or without all of the velocity"
        if mask & IGNORES_YAW_RATE and self._turns:
            return "their type mask ignores the yaw rate, which w is"
        if not all(math.isfinite(value) and abs(value) < NUMBER_MAX for value in (f[4], f[5], f[11])):
            return "not finite"
        if frame not in BODY_FRAMES and frame not in NORTH_EAST_FRAMES:
            return f"in frame {frame}, which is neither the body's nor along north and east"
        self.velocities.append(Velocity(host_s, frame in BODY_FRAMES, f[4], f[5], 0.0 - f[11]))
        return ""

    def _signals(self, host_s: float, sender: int, number: int, named: dict[str, Any], f: tuple[Any, ...]) -> str:
        target = named.get("target", named.get("target_system", self._system))
        if number in _STICKS and target not in (self._system, 0):
            return "for another system"
        if number not in _STICKS and sender != self._system:
            return "of another system"
        found = {name: value for name, value in _values(number, named, f).items() if name in self._raw}
        if not found:
            return f"no input of the model has the name of its signals ({_example(number)})"
        if not all(math.isnan(value) or abs(value) < NUMBER_MAX for value in found.values()):
            return "not finite"
        self.raw.append(Raw(host_s, found))
        return ""

    def account(self) -> str:
        """What there is that does not count, and why."""
        return ", ".join(f"{count} {name} ({why})" for (name, why), count in sorted(self.unused.items()))


def _example(number: int) -> str:
    names = {
        MANUAL_CONTROL: "manual_x, manual_r",
        RC_CHANNELS_OVERRIDE: "rc1, rc3",
        SERVO_OUTPUT_RAW: "servo1, servo3",
        ACTUATOR_OUTPUT_STATUS: "actuator1",
        HIL_ACTUATOR_CONTROLS: "control1",
    }
    return f"{names[number]}, ...; transport.log_inputs maps them"


def _values(number: int, named: dict[str, Any], f: tuple[Any, ...]) -> dict[str, float]:
    """Signal -> value."""
    if number == MANUAL_CONTROL:
        return {f"manual_{axis}": named[axis] / STICK_MAX if abs(named[axis]) <= STICK_MAX else math.nan for axis in "xyzr"}
    if number == RC_CHANNELS_OVERRIDE:
        return {f"rc{k}": _scaled(named[f"chan{k}_raw"], RC_IGNORED) for k in range(1, 19)}
    if number == SERVO_OUTPUT_RAW:
        ports = 8 * min(named["port"], 1)
        return {f"servo{k + ports}": _scaled(named[f"servo{k}_raw"], (0, 65535)) for k in range(1, 17 - ports)}
    if number == ACTUATOR_OUTPUT_STATUS:
        return {f"actuator{k}": float(f[1 + k]) for k in range(1, 33)}
    return {f"control{k}": float(f[1 + k]) for k in range(1, 17)}


def _scaled(microseconds: int, ignored: tuple[int, ...]) -> float:
    return math.nan if microseconds in ignored else (microseconds - CENTRE_US) / HALF_RANGE_US
