"""The profile's `[transport]` table, checked. Names of the DBC are looked up later (`layout`), python-can's settings by python-can."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from s2r_runtime.errors import ConfigError

OPTIONS: dict[str, str] = {
    "dbc": "the bus's DBC file (or KCD, SYM, ARXML), relative to the profile; its content is bound into certificates",
    "robot": "python-can settings of the interface toward the robot: interface, channel, bitrate, fd, ...",
    "controller": "the same toward everybody else: another interface; left out: nobody has a way in",
    "states": "model state -> signal, as Message.Signal, or { signal, scale, offset } with SI = physical * scale + offset",
    "inputs": "model input -> signal of the command, likewise",
    "constants": "signal of a command -> its physical value, for what else the robot wants to be told (enable bits, modes)",
    "counters": "message -> its rolling counter: the signal, or { signal, modulus, jump }",
    "checksums": "message -> its checksum: the signal, or { signal, scheme, data_id }",
    "overrides": "emergency_stop, manual_override -> signal that is not zero while the robot's button is pressed",
    "stamp": "signal that holds the robot's own clock; without one the frames' arrival counts",
    "trigger": "message that makes an observation when it comes (default: of the stamp, else of the first state)",
    "timeouts": "message -> s for which what it said is good (default: 1.5 of its cycle in the DBC, else message_timeout)",
    "cycles": "message -> s between two of its frames, where the DBC says another cycle than is true, or none; inf: it has none",
    "message_timeout": "s for which a message is good whose cycle the DBC doesn't say (default 0.1)",
    "observation_timeout": "s without an observation after which the link counts as lost (default 0.5)",
    "dead_reckoning": "pose from wheel speeds: { left, right, track, wheel_radius } or { speed, yaw_rate } or { speed, heading }; start",
    "command_cycle": "s between repetitions of a command while its time to live lasts (default 0: each is sent once)",
    "source_addresses": "J1939 message -> source address whose frames count, whatever their priority, or any (default: as in the DBC)",
    "forward": "what of the robot's bus the controllers' side hears: all, named (what this profile reads), none (default all)",
    "queue": "frames kept for a runtime that is late; older ones are dropped and counted (default 1024)",
}
TABLES = (
    "robot",
    "controller",
    "states",
    "inputs",
    "constants",
    "counters",
    "checksums",
    "overrides",
    "timeouts",
    "cycles",
    "dead_reckoning",
    "source_addresses",
)
Kind = Literal["emergency_stop", "manual_override"]
KINDS: tuple[Kind, ...] = ("emergency_stop", "manual_override")
FORWARD = ("all", "named", "none")
RECKONING = ("left", "right", "track", "wheel_radius", "speed", "yaw_rate", "heading", "start")


class Source(NamedTuple):
    """A number on the bus. scale: SI per physical unit, None: by the DBC's unit."""

    signal: Any
    scale: float | None = None
    offset: float = 0.0


class CounterOption(NamedTuple):
    """modulus, jump: 0 for the default."""

    signal: Any
    modulus: int = 0
    jump: int = 0


class ChecksumOption(NamedTuple):
    """data_id: -1 for none."""

    signal: Any
    scheme: str = "crc8_j1850"
    data_id: int = -1


@dataclass(frozen=True)
class Options:
    """As in OPTIONS."""

    dbc: Any
    robot: dict[str, Any]
    controller: dict[str, Any]
    states: dict[str, Source]
    inputs: dict[str, Source]
    constants: dict[str, float] = field(default_factory=dict)
    counters: dict[str, CounterOption] = field(default_factory=dict)
    checksums: dict[str, ChecksumOption] = field(default_factory=dict)
    overrides: dict[Kind, str] = field(default_factory=dict)
    timeouts: dict[str, float] = field(default_factory=dict)
    cycles: dict[str, float] = field(default_factory=dict)
    dead_reckoning: dict[str, Any] = field(default_factory=dict)
    stamp: str = ""
    trigger: str = ""
    message_timeout: float = 0.1
    observation_timeout: float = 0.5
    command_cycle: float = 0.0
    forward: str = "all"
    queue: int = 1024
    source_addresses: dict[str, int] = field(default_factory=dict)


def checked(given: dict[str, Any]) -> Options:
    """Options with their defaults. Raises ConfigError, saying what would be right."""
    for name in given:
        _known(name, OPTIONS, "transport", "is not an option of the can transport")
    for name in TABLES:
        if not isinstance(given.get(name, {}), dict):
            raise ConfigError(f"transport.{name} is {given[name]!r}, must be a table: {OPTIONS[name]}")
    if not given.get("dbc"):
        raise ConfigError("transport.dbc is missing: the DBC file of the robot's bus")
    sides = {side: _bus(side, given.get(side, {})) for side in ("robot", "controller")}
    if not sides["robot"]:
        raise ConfigError('transport.robot is missing: python-can settings, such as { interface = "socketcan", channel = "can0" }')
    _apart(sides["robot"], sides["controller"])
    return Options(
        dbc=given["dbc"],
        robot=sides["robot"],
        controller=sides["controller"],
        states={name: _source(value, f"transport.states.{name}") for name, value in given.get("states", {}).items()},
        inputs={name: _source(value, f"transport.inputs.{name}") for name, value in given.get("inputs", {}).items()},
        constants={name: _number(value, f"transport.constants.{name}") for name, value in given.get("constants", {}).items()},
        counters={name: _counter(value, f"transport.counters.{name}") for name, value in given.get("counters", {}).items()},
        checksums={name: _checksum(value, f"transport.checksums.{name}") for name, value in given.get("checksums", {}).items()},
        overrides=_overrides(given.get("overrides", {})),
        timeouts={name: _seconds(value, f"transport.timeouts.{name}", endless=True) for name, value in given.get("timeouts", {}).items()},
        cycles={name: _seconds(value, f"transport.cycles.{name}", endless=True) for name, value in given.get("cycles", {}).items()},
        dead_reckoning=_reckoning(given.get("dead_reckoning", {})),
        stamp=_text(given.get("stamp", ""), "transport.stamp"),
        trigger=_text(given.get("trigger", ""), "transport.trigger"),
        message_timeout=_seconds(given.get("message_timeout", 0.1), "transport.message_timeout"),
        observation_timeout=_seconds(given.get("observation_timeout", 0.5), "transport.observation_timeout"),
        command_cycle=_cycle(given.get("command_cycle", 0.0)),
        forward=_choice(given.get("forward", "all"), FORWARD, "transport.forward"),
        source_addresses={
            name: _address(value, f"transport.source_addresses.{name}") for name, value in given.get("source_addresses", {}).items()
        },
        queue=_whole(given.get("queue", 1024), "transport.queue", 2),
    )


def named(options: Options) -> tuple[set[str], set[str]]:
    """(names of messages, names of signals without one) that the options mention, as they are written there."""
    references = [source.signal for source in (*options.states.values(), *options.inputs.values())]
    references += [one.signal for one in options.dead_reckoning.values() if isinstance(one, Source)]
    references += [*options.constants, *options.overrides.values(), options.stamp]
    messages = {
        *options.counters,
        *options.checksums,
        *options.timeouts,
        *options.cycles,
        *options.source_addresses,
        options.trigger.partition(".")[0],
    }
    messages |= {one.partition(".")[0] for one in references if isinstance(one, str) and "." in one}
    return messages - {""}, {one for one in references if isinstance(one, str) and "." not in one} - {""}


def _known(name: str, known: Any, where: str, what: str) -> None:
    if name in known:
        return
    near = difflib.get_close_matches(name, list(known), 1, 0.6)
    raise ConfigError(f"{where}.{name} {what}; " + (f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(known)}"))


def _bus(side: str, given: dict[str, Any]) -> dict[str, Any]:
    if not given:
        return {}
    _text(given.get("interface", ""), f"transport.{side}.interface", "the name of a python-can interface, such as socketcan")
    if not given.get("interface"):
        raise ConfigError(f"transport.{side}.interface is missing: the name of a python-can interface, such as socketcan")
    if given.get("receive_own_messages"):
        raise ConfigError(f"transport.{side}.receive_own_messages must not be set: a command of our own would look like a stranger's")
    return given


def _apart(robot: dict[str, Any], controller: dict[str, Any]) -> None:
    """Two interfaces that are one bus would carry the controllers' frames past the gate."""
    if not controller or robot["interface"] != controller["interface"]:
        return
    if robot.get("channel") == controller.get("channel") and robot.get("host") == controller.get("host"):
        raise ConfigError(
            f"transport: robot and controller share {robot['interface']} {robot.get('channel')!r}; whoever is on the robot's bus can "
            "command the robot, so each side needs an interface of its own"
        )
    if robot["interface"] == "udp_multicast" and robot.get("port", 43113) == controller.get("port", 43113):
        # a socket bound to a port hears every group that anybody on this host has joined (IP_MULTICAST_ALL)
        raise ConfigError("transport: robot and controller share a port of udp_multicast, so each hears the other's group; give them two")


def _source(value: Any, where: str) -> Source:
    if isinstance(value, str):
        return Source(value)
    if not isinstance(value, dict) or "signal" not in value:
        raise ConfigError(f"{where} is {value!r}, must be a signal, as Message.Signal, or {{ signal = ..., scale = ..., offset = ... }}")
    for name in value:
        _known(name, Source._fields, where, "is not known")
    scale = _number(value["scale"], f"{where}.scale") if "scale" in value else None
    if scale == 0.0:
        raise ConfigError(f"{where}.scale is 0, must be SI units per unit of the signal")
    return Source(value["signal"], scale, _number(value.get("offset", 0.0), f"{where}.offset"))


def _counter(value: Any, where: str) -> CounterOption:
    if isinstance(value, str):
        return CounterOption(value)
    table = _parts(value, CounterOption._fields, where)
    modulus = _whole(table["modulus"], f"{where}.modulus", 2) if "modulus" in table else 0
    return CounterOption(table["signal"], modulus, _whole(table["jump"], f"{where}.jump", 1) if "jump" in table else 0)


def _checksum(value: Any, where: str) -> ChecksumOption:
    if isinstance(value, str):
        return ChecksumOption(value)
    table = _parts(value, ChecksumOption._fields, where)
    data_id = _whole(table["data_id"], f"{where}.data_id", 0) if "data_id" in table else -1
    if data_id > 0xFFFF:
        raise ConfigError(f"{where}.data_id is {data_id}, must be at most {0xFFFF}")
    return ChecksumOption(table["signal"], _text(table.get("scheme", "crc8_j1850"), f"{where}.scheme"), data_id)


def _parts(value: Any, known: tuple[str, ...], where: str) -> dict[str, Any]:
    if not isinstance(value, dict) or "signal" not in value:
        raise ConfigError(f"{where} is {value!r}, must be a signal of that message, or a table with {', '.join(known)}")
    for name in value:
        _known(name, known, where, "is not known")
    return value


def _overrides(given: dict[str, Any]) -> dict[Kind, str]:
    for name in given:
        _known(name, KINDS, "transport.overrides", "is not a kind of override")
    return {kind: _text(given[kind], f"transport.overrides.{kind}", "a signal, as Message.Signal") for kind in KINDS if kind in given}


def _reckoning(given: dict[str, Any]) -> dict[str, Any]:
    where = "transport.dead_reckoning"
    if not given:
        return {}
    for name in given:
        _known(name, RECKONING, where, "is not known")
    read: dict[str, Any] = {}
    for name, value in given.items():
        if name == "start":
            if not isinstance(value, list) or len(value) != 3:
                raise ConfigError(f"{where}.start is {value!r}, must be [x, y, theta] in m and rad")
            read[name] = tuple(_number(number, f"{where}.start") for number in value)
        elif name in ("track", "wheel_radius"):
            read[name] = _number(value, f"{where}.{name}")
            if read[name] <= 0.0:
                raise ConfigError(f"{where}.{name} is {value}, must be > 0 m")
        else:
            read[name] = _source(value, f"{where}.{name}")
    wheels, speed = {"left", "right"} & set(read), "speed" in read
    if wheels == {"left", "right"} and not speed:
        if "track" not in read and not {"yaw_rate", "heading"} & set(read):
            raise ConfigError(f"{where}.track is missing: the distance between the wheels, m")
    elif wheels or not speed:
        raise ConfigError(f"{where} needs left and right (and track), or speed with yaw_rate or heading")
    elif not {"yaw_rate", "heading"} & set(read):
        raise ConfigError(f"{where} needs yaw_rate or heading beside speed")
    if {"yaw_rate", "heading"} <= set(read):
        raise ConfigError(f"{where}: yaw_rate and heading cannot both be given")
    return read


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{where} is {value!r}, must be a finite number")
    return float(value)


def _seconds(value: Any, where: str, *, endless: bool = False) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not (0.0 < value < math.inf or (endless and value == math.inf)):
        raise ConfigError(f"{where} is {value!r}, must be > 0 s" + (" (inf: it is sent only when it changes)" if endless else ""))
    return float(value)


def _cycle(value: Any) -> float:
    cycle = _number(value, "transport.command_cycle")
    if cycle != 0.0 and not 0.001 <= cycle <= 1.0:
        raise ConfigError(f"transport.command_cycle is {value}, must be 0 or in 0.001 to 1 s")
    return cycle


def _address(value: Any, where: str) -> int:
    if value == "any":
        return -1
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 253:
        raise ConfigError(f'{where} is {value!r}, must be a source address in 0 to 253, or "any"')
    return value


def _whole(value: Any, where: str, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ConfigError(f"{where} is {value!r}, must be a whole number >= {least}")
    return value


def _text(value: Any, where: str, what: str = "text") -> str:
    if not isinstance(value, str):
        raise ConfigError(f"{where} is {value!r}, must be {what}")
    return value


def _choice(value: Any, known: tuple[str, ...], where: str) -> str:
    if value not in known:
        raise ConfigError(f"{where} is {value!r}, must be one of: {', '.join(known)}")
    return str(value)
