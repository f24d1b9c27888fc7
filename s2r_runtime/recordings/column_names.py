"""Columns of a table that go by the field's usual names: which column a state, an input or the stamps are in, and in which unit.

A column with the model's own name counts first, then one that the person stated (`--column`), then the only one whose usual meaning is
that state or input. Two such columns are refused: the person decides. A unit that ends a name (`yaw_deg`, `time_ms`, `v [km/h]`) is
converted to SI, whoever named the column; one that is unknown, or of another quantity, is refused.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from s2r_runtime.errors import RecordingError

USUAL: dict[str, tuple[str, ...]] = {
    "t": ("time", "timestamp", "time_stamp", "stamp", "header_stamp", "sim_time", "elapsed", "elapsed_time", "secs"),
    "x": ("pose_x", "x_pose", "pos_x", "x_pos", "position_x", "x_position", "px", "odom_x", "pose_position_x", "pose_pose_position_x"),
    "y": ("pose_y", "y_pose", "pos_y", "y_pos", "position_y", "y_position", "py", "odom_y", "pose_position_y", "pose_pose_position_y"),
    "theta": (
        "yaw",
        "heading",
        "th",
        "psi",
        "yaw_angle",
        "heading_angle",
        "pose_theta",
        "pose_yaw",
        "orientation_yaw",
        "odom_yaw",
        "odom_theta",
    ),
    "v": (
        *("cmd_v", "v_cmd", "cmd_vel_linear_x", "cmd_vel_x", "cmd_linear_x", "cmd_linear", "cmd_speed", "speed_cmd", "u_v"),
        *("linear_velocity", "linear_velocity_x", "linear_vel", "lin_vel", "linear_x", "twist_linear_x", "velocity", "vel", "speed"),
    ),
    "w": (
        *("cmd_w", "w_cmd", "cmd_omega", "omega_cmd", "cmd_vel_angular_z", "cmd_vel_z", "cmd_angular_z", "cmd_angular", "u_w", "omega"),
        *("angular_velocity", "angular_velocity_z", "angular_vel", "ang_vel", "angular_z", "twist_angular_z"),
        *("yaw_rate", "yawrate", "turn_rate", "cmd_yaw_rate", "yaw_rate_cmd"),
    ),
    "speed": ("velocity", "vel", "v", "linear_velocity", "linear_x"),
    "speed_cmd": ("cmd_speed", "cmd_v", "v_cmd", "target_speed", "desired_speed"),
    "steer_cmd": ("cmd_steer", "cmd_steering", "steering_cmd", "steering_angle_cmd", "steering", "steering_angle", "steer", "delta"),
    "vx": ("v_x", "vel_x", "velocity_x", "linear_velocity_x", "x_vel", "xdot", "x_dot"),
    "vy": ("v_y", "vel_y", "velocity_y", "linear_velocity_y", "y_vel", "ydot", "y_dot"),
    "ax": ("a_x", "acc_x", "accel_x", "acceleration_x", "cmd_ax", "ax_cmd"),
    "ay": ("a_y", "acc_y", "accel_y", "acceleration_y", "cmd_ay", "ay_cmd"),
    "wheel_left": ("left_wheel", "wheel_l", "left_wheel_speed", "left_wheel_velocity", "wheel_left_velocity", "omega_left", "omega_l"),
    "wheel_right": (
        "right_wheel",
        "wheel_r",
        "right_wheel_speed",
        "right_wheel_velocity",
        "wheel_right_velocity",
        "omega_right",
        "omega_r",
    ),
    "cmd_left": ("left_cmd", "cmd_l", "left_command", "cmd_wheel_left", "wheel_left_cmd", "left_wheel_cmd"),
    "cmd_right": ("right_cmd", "cmd_r", "right_command", "cmd_wheel_right", "wheel_right_cmd", "right_wheel_cmd"),
    "q": ("position", "pos", "joint_position", "joint_pos", "joint_angle"),
    "qd": ("velocity", "vel", "joint_velocity", "joint_vel", "dq", "q_dot", "qdot"),
    "force": (
        "effort",
        "torque",
        "tau",
        "joint_torque",
        "joint_effort",
        "cmd_torque",
        "torque_cmd",
        "cmd_effort",
        "cmd_force",
        "force_cmd",
    ),
}
"""Name in the built-in models -> other names that the field uses for it, all in small letters with `_` between words."""

_TURN = math.pi / 180.0
_UNITS: dict[str, dict[str, float]] = {
    "time": {
        "s": 1.0,
        "sec": 1.0,
        "secs": 1.0,
        "seconds": 1.0,
        "ms": 1e-3,
        "msec": 1e-3,
        "us": 1e-6,
        "usec": 1e-6,
        "ns": 1e-9,
        "nsec": 1e-9,
    },
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3},
    "angle": {"rad": 1.0, "radians": 1.0, "deg": _TURN, "degrees": _TURN, "mrad": 1e-3},
    "speed": {
        "m/s": 1.0,
        "mps": 1.0,
        "m_s": 1.0,
        "cm/s": 1e-2,
        "mm/s": 1e-3,
        "km/h": 1 / 3.6,
        "kmh": 1 / 3.6,
        "kph": 1 / 3.6,
        "mph": 0.44704,
    },
    "rate": {
        **dict.fromkeys(("rad/s", "rad_s", "radps", "rps"), 1.0),
        **dict.fromkeys(("deg/s", "deg_s", "degps", "dps"), _TURN),
        "rpm": math.pi / 30.0,
    },
    "acceleration": {"m/s2": 1.0, "m/s^2": 1.0, "m_s2": 1.0, "mps2": 1.0, "g": 9.80665},
    "force": {"n": 1.0, "nm": 1.0, "n_m": 1.0, "mnm": 1e-3, "kn": 1e3},
}
"""Quantity -> unit -> how many SI units one of it is."""
_QUANTITY = {
    **dict.fromkeys(("x", "y"), ("length",)),
    **dict.fromkeys(("theta", "steer_cmd"), ("angle",)),
    **dict.fromkeys(("v", "vx", "vy", "speed", "speed_cmd"), ("speed",)),
    **dict.fromkeys(("w", "wheel_left", "wheel_right", "cmd_left", "cmd_right"), ("rate",)),
    **dict.fromkeys(("ax", "ay"), ("acceleration",)),
    "t": ("time",),
    "q": ("length", "angle"),
    "qd": ("speed", "rate"),
    "force": ("force",),
}
_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
_SUFFIXES = sorted({unit.replace("/", "_") for units in _UNITS.values() for unit in units}, key=len, reverse=True)


@dataclass(frozen=True)
class Place:
    """Where a state, an input or the stamps are: the table's column, and how many SI units one of its unit is (`unit`: empty if its name
    has none). guessed: by its usual name.
    """

    column: str
    unit: str = ""
    scale: float = 1.0
    guessed: bool = False


def places(
    header: Sequence[str], wanted: Sequence[str], stated: Mapping[str, str], source: str, angles: Sequence[str] = ()
) -> dict[str, Place]:
    """Name in the model (or `t`) -> its place, of those that are there. stated: by the person. angles: names that are angles, in rad.

    Raises RecordingError for two columns that may be the same, one that may be two things, or a unit that is not the quantity's.
    """
    found: dict[str, Place] = {}
    for name in wanted:
        column = stated.get(name, name)
        if column in header:
            unit, scale = _unit(column, _quantities(name, angles)) if column != name else ("", 1.0)
            found[name] = Place(column, unit, scale)
    taken = {place.column for place in found.values()} | set(stated.values())
    rest = [column for column in dict.fromkeys(header) if column and column not in taken]
    by_column: dict[str, str] = {}
    for name in wanted:
        if name in found or name in stated:
            continue
        quantities = _quantities(name, angles)
        usual = [column for column in rest if _means(column, name, quantities)]
        if len(usual) > 1:
            both = " and ".join(map(repr, usual)) if len(usual) == 2 else ", ".join(map(repr, usual))
            raise RecordingError(f"{source}: the columns {both} may each be {name!r}; state which one is: --column {name}={usual[0]}")
        if not usual:
            continue
        column = usual[0]
        if (other := by_column.setdefault(column, name)) != name:
            raise RecordingError(
                f"{source}: the column {column!r} may be {other!r} or {name!r}; state which one it is: --column {other}={column}"
            )
        unit, scale = _unit(column, quantities, source, name)
        found[name] = Place(column, unit, scale, guessed=True)
    return found


def told(found: Mapping[str, Place]) -> str:
    """What was guessed or converted, in one sentence; empty if nothing was."""
    parts = []
    for name, place in found.items():
        unit = f" in {place.unit}" if place.unit and place.scale != 1.0 else ""
        if place.guessed:
            parts.append(f"{place.column!r} is read as {name}{unit}")
        elif unit:
            parts.append(f"{place.column!r} is read{unit}")
    guessed = any(place.guessed for place in found.values())
    return ", ".join(parts) + (" (if it is another column: --column NAME=COLUMN)" if guessed else "") if parts else ""


def missing(names: Sequence[str], header: Sequence[str]) -> str:
    """What to say of columns that are not there."""
    near = {name: difflib.get_close_matches(name, header, 1, 0.5) for name in names}
    listed = ", ".join(f"{name!r}" + (f" (nearest: {near[name][0]!r})" if near[name] else "") for name in names)
    return f"lacks the column{'s' if len(names) > 1 else ''} {listed}; it has: {', '.join(header)}; others: --column NAME=COLUMN"


def _words(column: str) -> str:
    """`cmdVel.linear.x` -> `cmd_vel_linear_x`."""
    column = column.replace("°", "_deg").replace("²", "2")
    apart = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", column) if not column.isupper() else column
    return re.sub(r"[^a-z0-9^/]+", "_", apart.lower()).strip("_/")


def _split(column: str) -> tuple[str, str, bool]:
    """Name and unit of a column (empty if it has none), and whether the unit stands in brackets."""
    if (match := _BRACKETS.match(column)) is not None:
        return _words(match[1]), match[2].strip().lower().replace(" ", "").replace("°", "deg").replace("²", "2"), True
    words = _words(column).replace("/", "_")
    for unit in _SUFFIXES:
        if words.endswith(f"_{unit}"):
            return words.removesuffix(f"_{unit}"), unit, False
    return words, "", False


def _quantities(name: str, angles: Sequence[str]) -> tuple[str, ...]:
    return ("angle",) if name in angles else _QUANTITY.get(name, ())


def _means(column: str, name: str, quantities: Sequence[str]) -> bool:
    """Whether a column usually means what the model calls `name`."""
    names = {name.lower(), *USUAL.get(name, ())}
    if _words(column).replace("/", "_") in names:
        return True
    words, unit, brackets = _split(column)
    return words in names and (brackets or any(_scale(unit, quantity) is not None for quantity in quantities))


def _scale(unit: str, quantity: str) -> float | None:
    units = _UNITS[quantity]
    return units.get(unit, next((scale for name, scale in units.items() if name.replace("/", "_") == unit), None))


def _unit(column: str, quantities: Sequence[str], source: str = "", name: str = "") -> tuple[str, float]:
    """The unit that a column's name ends in, and its size in SI units. source, name: of a guess, which is refused if the unit in brackets
    is not one of the quantity's.
    """
    if name and _words(column).replace("/", "_") in {name.lower(), *USUAL.get(name, ())}:
        return "", 1.0
    _, unit, brackets = _split(column)
    if not unit:
        return "", 1.0
    for quantity in quantities:
        if (scale := _scale(unit, quantity)) is not None:
            return unit, scale
    if name and brackets:
        known = ", ".join(unit for quantity in quantities for unit in _UNITS[quantity])
        raise RecordingError(
            f"{source}: the column {column!r} seems to be {name!r}, in a unit that is not known for it; known are: {known}"
        )
    return "", 1.0
