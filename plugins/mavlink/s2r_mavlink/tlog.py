"""Telemetry logs (`.tlog`, `.tlog.gz`): what a ground station or companion heard and sent, as states and inputs on the robot's clock.

A record is 8 bytes, the logging computer's clock in microseconds (big-endian), and one whole frame. States are stamped by the robot itself
(`time_boot_ms`). Commands are not: they have the stamp h of the computer that logged them, which is brought to the robot's clock b by

    h = rate b + delay(h),   delay: the least of (arrival - rate b) over telemetry of about the same second

so that a radio that is late now and then moves no command. A velocity acts until the next one, or for 3 s (ArduPilot's Rover stops then).
Only stretches in which the robot obeyed (mode and arming in its heartbeats) are driving; a clock that goes back is another start of it.
Where the inputs are sticks or what the actuators got (`logged_commands`), any mode will do in which it is armed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_mavlink.dialect import HEARTBEAT, MESSAGES
from s2r_mavlink.frames import length_at, payload, whole
from s2r_mavlink.logged_commands import NUMBERS, SIGNALS, VELOCITIES, Commands, Raw, Velocity
from s2r_mavlink.options import DEFAULTS, SIGNALS_ARE, LogInput, log_inputs
from s2r_mavlink.pose import POSE_ONLY, QUANTITIES, SOURCES, PoseSource
from s2r_mavlink.robot_state import ARMED, mode_number
from s2r_mavlink.tlog_records import STAMP, STAMP_MAX_US, Record, records
from s2r_runtime.errors import RecordingError
from s2r_runtime.hookspecs import ReadLog

Array = NDArray[np.float64]
Rows = tuple[Array, Array]

LAPSE_S = 3.0
"""After so long without a command ArduPilot's Rover stops."""
REORDERED_S = 1.0
"""A stamp that goes back by less came late; by more, the robot started anew."""
BIN_S = 1.0
ROVERS = (10, 11)
"""MAV_TYPE of a ground rover and a boat, whose modes have the numbers that are known here."""


class Start(NamedTuple):
    """What was logged between two starts of the robot: poses (host s, robot s, x, heading in rad), and times at which it was
    known to obey or not to.
    """

    host: list[float]
    boot: list[float]
    x: list[tuple[float, ...]]
    theta: list[float]
    obeyed: list[tuple[float, bool]]


def read(path: Path, states: tuple[str, ...], inputs: tuple[str, ...], options: dict[str, Any]) -> ReadLog:
    """Hook `s2r_recordings`: see `hookspecs`. Raises RecordingError, ConfigError."""
    mapped = log_inputs(options.get("log_inputs", {}), inputs)
    skipped: list[int] = []
    logged = list(records(path, skipped))
    if not logged:
        raise RecordingError(f"{path}: holds no MAVLink frame, must be a telemetry log (.tlog)")
    chosen = _options(path, logged, options, states, mapped)
    starts, commands = _sorted(logged, chosen, states, mapped)
    begins = [start.host[0] for start in starts[1:]]
    found: list[tuple[Rows, Rows]] = []
    for start, since, until in zip(starts, [-np.inf, *begins], [*begins, np.inf], strict=True):
        found += _stretches(start, _acting(start, commands, (since, until), mapped), len(states), len(inputs))
    if not found:
        armed = ", armed" if chosen["armed"] else ""
        raise RecordingError(f"{path}: system {chosen['system']} tells no pose while it obeys (mode {chosen['mode'] or 'any'}{armed})")
    unused, counted = commands.account(), len(commands.velocities) + len(commands.raw)
    if not counted and unused:
        raise RecordingError(f"{path}: no command in it counts: {unused}")
    notes = [f"commands that do not count: {unused}"] if unused else [] if counted else ["holds no command"]
    if counted and not any(len(u) for _, (_, u) in found):
        notes.append("no command was given while the robot obeyed")
    notes += [f"{sum(skipped)} bytes are no record of a telemetry log and left out"] if skipped else []
    return ReadLog(found, tuple(notes))


def is_tlog(head: bytes) -> bool:
    """Whether a file begins with two records: a stamp of this century or the last, and a frame (`Offer.recognises`)."""
    at = 0
    for _ in range(2):
        size = length_at(head, at + STAMP) if len(head) > at + STAMP else 0
        if (
            size <= 0
            or not whole(head[at + STAMP : at + STAMP + size], 0, size)
            or int.from_bytes(head[at : at + STAMP], "big") > STAMP_MAX_US
        ):
            return False
        at += STAMP + size
    return True


# ---------------------------------------------------------------- which robot, which source


def _options(
    path: Path, records: list[Record], given: dict[str, Any], states: tuple[str, ...], inputs: dict[str, LogInput]
) -> dict[str, Any]:
    """The profile's options, or what the log itself suggests."""
    counts = Counter((r.system, r.number) for r in records)
    options = {**DEFAULTS, **given}
    if "pose" not in given:
        there = [name for name, numbers in SOURCES.items() if any(count for (_, number), count in counts.items() if number == numbers[0])]
        options["pose"] = next((name for name in there if name != "gps"), options["pose"])
    lead = SOURCES[options["pose"]][0]
    if "system" not in given:
        systems = {system: count for (system, number), count in counts.items() if number == lead}
        options["system"] = max(systems, key=lambda system: systems[system], default=options["system"])
    if not counts[options["system"], lead]:
        raise RecordingError(f"{path}: holds no {MESSAGES[lead].name} of system {options['system']}")
    if "mode" not in given and not any(
        MESSAGES[HEARTBEAT].unpack(payload(r.frame))[1] in ROVERS
        for r in records
        if r.number == HEARTBEAT and r.system == options["system"]
    ):
        options["mode"] = ""
    options["armed"] = bool(options["mode"])
    if not {one.signal for one in inputs.values()} & set(VELOCITIES):
        options["mode"], options["armed"] = "", True  # sticks and actuators: in whatever mode
    told = POSE_ONLY if options["pose"] == "vision" else QUANTITIES
    if unknown := [name for name in states if name not in told]:
        raise RecordingError(f"{path}: a telemetry log has the states {', '.join(told)}; the model also has {', '.join(unknown)}")
    if unknown := [name for name, one in inputs.items() if one.signal not in VELOCITIES and not SIGNALS.fullmatch(one.signal)]:
        raise RecordingError(
            f"{path}: a telemetry log has the inputs {SIGNALS_ARE}; the model also has {', '.join(unknown)}, "
            "which transport.log_inputs can map"
        )
    return options


def _sorted(
    records: list[Record], options: dict[str, Any], states: tuple[str, ...], inputs: dict[str, LogInput]
) -> tuple[list[Start], Commands]:
    """By start of the robot; and the commands."""
    numbers = frozenset(SOURCES[options["pose"]])
    teller = options["pose_component"] or options["component"]
    source = PoseSource(options["pose"], (*states, "theta"), tuple(options["origin"] or (0.0, 0.0)))
    wanted = mode_number(options["mode"]) if options["mode"] else None
    starts = [Start([], [], [], [], [])]
    commands = Commands(options["system"], tuple(one.signal for one in inputs.values()))
    for record in records:
        if record.system == options["system"] and record.number in numbers and record.component in (teller, options["component"]):
            pose = source.take(record.number, MESSAGES[record.number].unpack(payload(record.frame)))
            if pose is not None and not pose.fault:
                _take_pose(starts, source, record.host_s, pose.stamp_ns * 1e-9, pose.x)
        elif record.number == HEARTBEAT and (record.system, record.component) == (options["system"], options["component"]):
            f = MESSAGES[HEARTBEAT].unpack(payload(record.frame))
            obeys = (wanted is None or f[0] == wanted) and (not options["armed"] or bool(f[3] & ARMED))
            starts[-1].obeyed.append((record.host_s, obeys))
        elif record.number in NUMBERS:
            commands.take(record.host_s, record.system, record.number, payload(record.frame))
    return starts, commands


def _take_pose(starts: list[Start], source: PoseSource, host_s: float, boot_s: float, x: tuple[float, ...]) -> None:
    start = starts[-1]
    if start.boot and boot_s <= start.boot[-1]:
        if start.boot[-1] - boot_s <= REORDERED_S:
            return
        source.restarted()
        start = Start([], [], [], [], [])
        starts.append(start)
    start.host.append(host_s)
    start.boot.append(boot_s)
    start.x.append(x[:-1])
    start.theta.append(x[-1])


# ---------------------------------------------------------------- one clock


def _acting(start: Start, commands: Commands, span: tuple[float, float], inputs: dict[str, LogInput]) -> Rows:
    """(t, u): the commands of a span of the host's clock on the robot's clock, as the model's inputs."""
    parts: list[tuple[Array, Array, tuple[str, ...]]] = []
    if len(start.boot) >= 2:
        host, boot = np.array(start.host), np.array(start.boot)
        velocities = [one for one in commands.velocities if span[0] <= one.host_s < span[1]]
        if velocities:
            t = _robot_time(host, boot, np.array([one.host_s for one in velocities]))
            parts.append((*_velocities(boot, np.array(start.theta), t, velocities), VELOCITIES))
        raw = [one for one in commands.raw if span[0] <= one.host_s < span[1]]
        if raw:
            parts.append(_signals(_robot_time(host, boot, np.array([one.host_s for one in raw])), raw))
    rows = [np.empty((0, len(inputs)))]
    for t, values, names in parts:
        u = np.full((len(t), len(inputs)), np.nan)
        for column, one in enumerate(inputs.values()):
            if one.signal in names:
                u[:, column] = one.scale * values[:, names.index(one.signal)] + one.offset
        rows.append(u)
    stamps, table = np.concatenate([np.empty(0), *(t for t, _, _ in parts)]), np.concatenate(rows)
    order = np.argsort(stamps, kind="stable")
    return stamps[order], table[order]


def _signals(t: Array, raw: list[Raw]) -> tuple[Array, Array, tuple[str, ...]]:
    names = tuple(sorted({name for one in raw for name in one.values}))
    return t, np.array([[one.values.get(name, np.nan) for name in names] for one in raw]), names


def _velocities(boot: Array, theta: Array, t: Array, given: list[Velocity]) -> tuple[Array, Array]:
    """(t, (v, w)) of the body, with the zero that follows a lapse. What is commanded along north and east turns against the body as that
    turns: a row at each pose while it acts.
    """
    order = np.argsort(t, kind="stable")
    t, given = t[order], [given[k] for k in order]
    heading = np.unwrap(theta)
    times: list[Array] = []
    values: list[Array] = []
    for k, one in enumerate(given):
        until = min(t[k] + LAPSE_S, t[k + 1] if k + 1 < len(t) else np.inf)
        at = t[k : k + 1]
        if not one.body:
            at = np.concatenate([at, boot[(boot > t[k]) & (boot < until)]])
        turned = np.zeros(len(at)) if one.body else np.interp(at, boot, heading)  # counter-clockwise from north; east is to the right of it
        v = one.along * np.cos(turned) - (0.0 if one.body else one.across) * np.sin(turned)
        lapsed = until == t[k] + LAPSE_S
        times += [at, np.array([until])] if lapsed else [at]
        values.append(np.column_stack([v, np.full(len(at), one.w)]))
        values += [np.zeros((1, 2))] if lapsed else []
    return np.concatenate(times), np.concatenate(values)


def _robot_time(host: Array, boot: Array, when: Array) -> Array:
    """Times of the logging computer's clock on the robot's, s."""
    rate = (host[-1] - host[0]) / (boot[-1] - boot[0])
    delay = host - rate * boot
    bins = np.floor((host - host[0]) / BIN_S).astype(np.int64)
    numbers, first = np.unique(bins, return_index=True)
    least = np.minimum.reduceat(delay, first) if np.all(np.diff(bins) >= 0) else np.array([delay[bins == n].min() for n in numbers])
    middle = host[0] + (numbers + 0.5) * BIN_S
    return np.asarray((when - np.interp(when, middle, least)) / rate)


def _stretches(start: Start, acting: Rows, nx: int, nu: int) -> Iterator[tuple[Rows, Rows]]:
    """Those in which the robot obeyed; without a heartbeat all of it is believed."""
    if len(start.boot) < 2:
        return
    t, x = np.array(start.boot), np.array(start.x).reshape(-1, nx)
    for low, high in _obedient(start):
        rows, given = (t >= low) & (t <= high), (acting[0] >= low) & (acting[0] <= high)
        if np.count_nonzero(rows) >= 2:
            yield (t[rows], x[rows]), (acting[0][given], acting[1][given].reshape(-1, nu))


def _obedient(start: Start) -> list[tuple[float, float]]:
    """Intervals of the robot's clock, s: from one heartbeat that said so to the last in a row."""
    if not start.obeyed:
        return [(-np.inf, np.inf)]
    if all(yes for _, yes in start.obeyed):
        return [(-np.inf, np.inf)]
    host = np.array([at for at, _ in start.obeyed])
    times = _robot_time(np.array(start.host), np.array(start.boot), host)
    found: list[tuple[float, float]] = []
    since: float | None = None
    for at, (_, yes) in zip(times.tolist(), start.obeyed, strict=True):
        if yes:
            since = at if since is None else since
            last = at
        elif since is not None:
            found.append((since, last))
            since = None
    return [*found, (since, np.inf)] if since is not None else found
