"""The profile's `[transport]` table: what each option means, its default, and what is wrong with a value."""

from __future__ import annotations

import difflib
import math
from typing import Any, NamedTuple

from s2r_mavlink.endpoints import Address, parse
from s2r_mavlink.logged_commands import SIGNALS
from s2r_mavlink.pose import POSE_ONLY, QUANTITIES, SOURCES
from s2r_mavlink.robot_state import mode_number
from s2r_runtime.errors import ConfigError

INPUTS = ("v", "w")
SIGNALS_ARE = "v, w, manual_x, _y, _z, _r, rc1 to rc18, servo1 to servo16, actuator1 to actuator32, control1 to control16"
TAKE_OVER = ("never", "mode", "arm")
STOP_WHEN = ("emergency", "closed")

DEFAULTS: dict[str, Any] = {
    "robot": "",
    "ground": "",
    "companion": "",
    "system": 1,
    "component": 1,
    "own_component": 191,
    "pose": "local",
    "pose_component": 0,
    "origin": [],
    "rate": 50.0,
    "mode": "GUIDED",
    "take_over": "never",
    "stop_mode": "",
    "stop_when": "emergency",
    "observation_timeout": 0.5,
    "max_age": 0.3,
    "queue": 64,
    "signing_key_file": "",
    "signing_state": "",
    "log_inputs": {},
}

MEANINGS: dict[str, str] = {
    "robot": "where the autopilot is: udp:HOST:PORT (wait there), udpout:HOST:PORT, tcp:HOST:PORT or serial:PATH:BAUD",
    "ground": "where a ground station reaches the robot through the runtime: the same kinds, and tcpin:HOST:PORT; none: it has its own way",
    "companion": "where other people's controllers find the robot: they hear everything, and what they command is logged and refused",
    "system": "the robot's system id (default 1)",
    "component": "its autopilot's component id (default 1)",
    "own_component": "component id of the runtime, under the robot's system id (default 191, an onboard computer)",
    "pose": "what says where the robot is: local (LOCAL_POSITION_NED + ATTITUDE, the default), odometry, vision or gps",
    "pose_component": "component id of who sends ODOMETRY or VISION_POSITION_ESTIMATE (default: the autopilot's)",
    "origin": "[latitude, longitude] of x = y = 0 in degrees; with pose = gps",
    "rate": "observations a second that the robot is asked for (default 50)",
    "mode": "the mode in which it takes velocity commands: one of ArduPilot Rover's, a number, or empty if it has none (default GUIDED)",
    "take_over": "what the runtime does when it finds the robot: never (a person does it), mode (switches to that mode), arm (and arms it)",
    "stop_mode": "mode to switch to after an emergency stop and when the runtime ends, such as HOLD (default: zero velocity is all)",
    "stop_when": "emergency (the default), or closed: also while the gate is closed on a controller's, certificate's or the log's account",
    "observation_timeout": "s without an observation after which the link counts as lost (default 0.5)",
    "max_age": "s; an observation that was longer on its way is faulty (default 0.3)",
    "queue": "messages about the pose kept for a runtime that is late; older ones are dropped and counted (default 64)",
    "signing_key_file": "file with the key (64 hexadecimal digits, readable by its owner only): everything is signed and must be",
    "log_inputs": "input -> what a telemetry log has for it: rc3, servo1, manual_x, ..., or { signal, scale, offset } (default: v and w)",
    "signing_state": "file that keeps the newest stamp over a restart (default: in the user's state folder, one a key)",
}


def checked(given: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> dict[str, Any]:
    """Options with their defaults. Raises ConfigError."""
    for name, value in given.items():
        _known(name, value)
    options = {**DEFAULTS, **given}
    if not options["robot"]:
        raise ConfigError("transport: the mavlink transport needs robot, such as udp:127.0.0.1:14551 or serial:/dev/ttyACM0:115200")
    for name in ("robot", "ground", "companion"):
        _endpoint(name, options[name])
    taken = [options[name] for name in ("robot", "ground", "companion") if options[name]]
    if len(taken) > len(set(taken)):
        raise ConfigError("transport: robot, ground and companion share an endpoint; each needs one of its own")
    for name, low, high in (("system", 1, 255), ("component", 1, 255), ("own_component", 1, 255), ("pose_component", 0, 255)):
        if not low <= options[name] <= high:
            raise ConfigError(f"transport.{name} is {options[name]}, must be in {low} to {high}")
    if options["own_component"] in (options["component"], options["pose_component"]):
        raise ConfigError(f"transport.own_component is {options['own_component']}, must not be one of the robot's")
    for name, unit in (("observation_timeout", "s"), ("max_age", "s"), ("rate", "Hz")):
        if not 0.0 < options[name] < math.inf:
            raise ConfigError(f"transport.{name} is {options[name]}, must be > 0 {unit}")
    if options["queue"] < 2:
        raise ConfigError(f"transport.queue is {options['queue']}, must be >= 2")
    _choice("take_over", options["take_over"], TAKE_OVER)
    _choice("stop_when", options["stop_when"], STOP_WHEN)
    _choice("pose", options["pose"], tuple(SOURCES))
    _modes(options)
    _origin(options)
    log_inputs(options["log_inputs"], inputs)
    _quantities(options["pose"], states, inputs)
    return options


class LogInput(NamedTuple):
    """An input in a telemetry log: value = signal * scale + offset."""

    signal: str
    scale: float = 1.0
    offset: float = 0.0


def log_inputs(given: dict[str, Any], inputs: tuple[str, ...]) -> dict[str, LogInput]:
    """The signal of each input of the model: as `log_inputs` maps it, else the one of its own name. Raises ConfigError."""
    found = {name: LogInput(name) for name in inputs}
    for name, value in given.items():
        where = f"transport.log_inputs.{name}"
        if name not in inputs:
            raise ConfigError(f"{where}: the model has no such input; it has: {', '.join(inputs)}")
        table = {"signal": value} if isinstance(value, str) else value
        if not isinstance(table, dict) or not isinstance(table.get("signal"), str) or not set(table) <= set(LogInput._fields):
            raise ConfigError(f"{where} is {value!r}, must be a signal, or {{ signal = ..., scale = ..., offset = ... }}")
        numbers = [table.get("scale", 1.0), table.get("offset", 0.0)]
        if not all(isinstance(n, int | float) and not isinstance(n, bool) and math.isfinite(n) for n in numbers) or numbers[0] == 0:
            raise ConfigError(f"{where} is {value!r}; scale and offset must be finite numbers, and scale not 0")
        if table["signal"] not in INPUTS and not SIGNALS.fullmatch(table["signal"]):
            raise ConfigError(f"{where}: {table['signal']!r} is no signal of a telemetry log; there are: {SIGNALS_ARE}")
        found[name] = LogInput(table["signal"], float(numbers[0]), float(numbers[1]))
    return found


def _known(name: str, value: Any) -> None:
    if name not in DEFAULTS:
        near = difflib.get_close_matches(name, DEFAULTS, 1, 0.6)
        hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(DEFAULTS)}"
        raise ConfigError(f"transport.{name} is not an option of the mavlink transport; {hint}")
    wanted = (int, float) if isinstance(DEFAULTS[name], float) else type(DEFAULTS[name])
    if isinstance(value, bool) or not isinstance(value, wanted):
        kind = {str: "text", int: "a whole number", float: "a number", list: "[latitude, longitude]", dict: "a table"}[type(DEFAULTS[name])]
        raise ConfigError(f"transport.{name} is {value!r}, must be {kind}")


def _endpoint(name: str, text: str) -> None:
    if not text:
        return
    address = parse(text)
    if not isinstance(address, Address):
        raise ConfigError(f"transport.{name} is {text!r}, must be {address}")
    if name == "robot" and address.kind == "tcpin":
        raise ConfigError(f"transport.{name} is {text!r}: a robot is connected to (tcp:HOST:PORT) or waited for by udp:HOST:PORT")


def _choice(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        near = difflib.get_close_matches(value, known, 1, 0.6)
        raise ConfigError(
            f"transport.{name} is {value!r}, must be one of {', '.join(known)}" + (f"; did you mean {near[0]!r}?" if near else "")
        )


def _modes(options: dict[str, Any]) -> None:
    for name in ("mode", "stop_mode"):
        if options[name] and mode_number(options[name]) is None:
            raise ConfigError(
                f"transport.{name} is {options[name]!r}, must be a mode of ArduPilot Rover, such as GUIDED or HOLD, or a number"
            )
    if not options["mode"] and (options["take_over"] != "never" or options["stop_mode"]):
        raise ConfigError("transport.mode is empty, must be a mode where take_over or stop_mode change it")
    if options["stop_mode"] and mode_number(options["stop_mode"]) == mode_number(options["mode"]):
        raise ConfigError(f"transport.stop_mode is {options['stop_mode']!r}, must be another mode than transport.mode")
    if options["stop_when"] == "closed" and not options["stop_mode"]:
        raise ConfigError("transport.stop_when is 'closed', must come with transport.stop_mode, such as HOLD")


def _origin(options: dict[str, Any]) -> None:
    origin = options["origin"]
    if options["pose"] != "gps":
        if origin:
            raise ConfigError(
                f"transport.origin is {origin}, must be there only with pose = gps; other sources have an origin of their own"
            )
        options["origin"] = [0.0, 0.0]
        return
    numbers = len(origin) == 2 and all(isinstance(value, int | float) and not isinstance(value, bool) for value in origin)
    if not numbers or not (-85.0 <= origin[0] <= 85.0 and -180.0 <= origin[1] <= 180.0):
        raise ConfigError(f"transport.origin is {origin}, must be [latitude, longitude] in degrees, latitude in -85 to 85")


def _quantities(pose: str, states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    """What the model's names mean must be in what the robot sends and takes."""
    there = POSE_ONLY if pose == "vision" else QUANTITIES
    if unknown := [name for name in states if name not in there]:
        raise ConfigError(f"transport: MAVLink with pose = {pose} tells {', '.join(there)}; the model also has {', '.join(unknown)}")
    if unknown := [name for name in inputs if name not in INPUTS]:
        raise ConfigError(f"transport: MAVLink takes the inputs {', '.join(INPUTS)}; the model also has {', '.join(unknown)}")
