"""Telemetry logs (`.tlog`, `.tlog.gz`): what a ground station or companion heard and sent, as states and inputs on the robot's clock.

A record is 8 bytes, the logging computer's clock in microseconds (big-endian), and one whole frame. States are stamped by the robot itself
(`time_boot_ms`). Commands are not: they have the stamp h of the computer that logged them, which is brought to the robot's clock b by

    h = rate b + delay(h),   delay: the least of (arrival - rate b) over telemetry of about the same second

so that a radio that is late now and then moves no command. A command acts until the next one, or for 3 s (ArduPilot's Rover stops then).
Only stretches in which the robot obeyed (mode and arming in its heartbeats) are driving; a clock that goes back is another start of it.
"""

from __future__ import annotations

import gzip
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_mavlink.dialect import BODY_FRAMES, HEARTBEAT, MESSAGES, SET_POSITION_TARGET_LOCAL_NED
from s2r_mavlink.frames import header, length_at, payload, whole
from s2r_mavlink.options import DEFAULTS, INPUTS
from s2r_mavlink.pose import POSE_ONLY, QUANTITIES, SOURCES, PoseSource
from s2r_mavlink.robot_state import ARMED, mode_number
from s2r_runtime.errors import RecordingError

Array = NDArray[np.float64]
Rows = tuple[Array, Array]

STAMP = 8
LAPSE_S = 3.0
"""After so long without a command ArduPilot's Rover stops."""
REORDERED_S = 1.0
"""A stamp that goes back by less came late; by more, the robot started anew."""
BIN_S = 1.0
ROVERS = (10, 11)
"""MAV_TYPE of a ground rover and a boat, whose modes have the numbers that are known here."""
POSITION_OR_ANY_VELOCITY, IGNORES_YAW_RATE = 8 | 16 | 32, 2048


class Record(NamedTuple):
    """host_s: the logging computer's clock."""

    host_s: float
    system: int
    component: int
    number: int
    frame: bytes


class Start(NamedTuple):
    """What was logged between two starts of the robot: poses (host s, robot s, x), times at which it was known to obey or not to."""

    host: list[float]
    boot: list[float]
    x: list[tuple[float, ...]]
    obeyed: list[tuple[float, bool]]


def read(path: Path, states: tuple[str, ...], inputs: tuple[str, ...], options: dict[str, Any]) -> list[tuple[Rows, Rows]]:
    """Hook `s2r_recordings`: see `hookspecs`. Raises RecordingError."""
    data = _bytes(path)
    records = list(_records(data))
    if not records:
        raise RecordingError(f"{path}: holds no MAVLink frame, must be a telemetry log (.tlog)")
    chosen = _options(path, records, options, states, inputs)
    starts, commands = _sorted(records, chosen, states)
    begins = [start.host[0] for start in starts[1:]]
    found: list[tuple[Rows, Rows]] = []
    for start, since, until in zip(starts, [-np.inf, *begins], [*begins, np.inf], strict=True):
        given = [command for command in commands if since <= command[0] < until]
        found += _stretches(start, _acting(start, given, inputs), len(states), len(inputs))
    if not found:
        raise RecordingError(f"{path}: system {chosen['system']} tells no pose while it obeys (mode {chosen['mode'] or 'any'}, armed)")
    return found


def _bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if not data.startswith(b"\x1f\x8b"):
        return data
    try:
        return gzip.decompress(data)
    except (OSError, EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: is not a whole gzip file: {error}") from None


def _records(data: bytes) -> Iterator[Record]:
    """In the file's order; what is no record is skipped byte by byte, and a last one that was cut is left out."""
    at, end = 0, len(data) - STAMP
    while at < end:
        size = length_at(data, at + STAMP)
        start = at + STAMP
        # `whole` can't check a message that it doesn't know by what follows: here that is the next record's stamp
        if size > 0 and start + size <= len(data) and (whole(data[start : start + size], 0, size)):
            frame = data[start : start + size]
            facts = header(frame)
            yield Record(int.from_bytes(data[at:start], "big") * 1e-6, facts.system, facts.component, facts.number, frame)
            at = start + size
        else:
            at += 1


# ---------------------------------------------------------------- which robot, which source


def _options(path: Path, records: list[Record], given: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> dict[str, Any]:
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
    told = POSE_ONLY if options["pose"] == "vision" else QUANTITIES
    for what, names, known in (("states", states, told), ("inputs", inputs, INPUTS)):
        if unknown := [name for name in names if name not in known]:
            raise RecordingError(f"{path}: a telemetry log has the {what} {', '.join(known)}; the model also has {', '.join(unknown)}")
    return options


def _sorted(
    records: list[Record], options: dict[str, Any], states: tuple[str, ...]
) -> tuple[list[Start], list[tuple[float, float, float]]]:
    """By start of the robot; and the commands (host s, v, w)."""
    numbers = frozenset(SOURCES[options["pose"]])
    teller = options["pose_component"] or options["component"]
    source = PoseSource(options["pose"], states, tuple(options["origin"] or (0.0, 0.0)))
    wanted = mode_number(options["mode"]) if options["mode"] else None
    starts = [Start([], [], [], [])]
    commands: list[tuple[float, float, float]] = []
    for record in records:
        if record.system == options["system"] and record.number in numbers and record.component in (teller, options["component"]):
            pose = source.take(record.number, MESSAGES[record.number].unpack(payload(record.frame)))
            if pose is not None and not pose.fault:
                _take_pose(starts, source, record.host_s, pose.stamp_ns * 1e-9, pose.x)
        elif record.number == HEARTBEAT and (record.system, record.component) == (options["system"], options["component"]):
            f = MESSAGES[HEARTBEAT].unpack(payload(record.frame))
            starts[-1].obeyed.append((record.host_s, wanted is None or (f[0] == wanted and bool(f[3] & ARMED))))
        elif record.number == SET_POSITION_TARGET_LOCAL_NED:
            f = MESSAGES[record.number].unpack(payload(record.frame))
            known = f[15] in BODY_FRAMES and not f[12] & (POSITION_OR_ANY_VELOCITY | IGNORES_YAW_RATE)
            if known and f[13] in (options["system"], 0) and np.isfinite((f[4], f[11])).all():
                commands.append((record.host_s, f[4], 0.0 - f[11]))
    return starts, commands


def _take_pose(starts: list[Start], source: PoseSource, host_s: float, boot_s: float, x: tuple[float, ...]) -> None:
    start = starts[-1]
    if start.boot and boot_s <= start.boot[-1]:
        if start.boot[-1] - boot_s <= REORDERED_S:
            return
        source.restarted()
        start = Start([], [], [], [])
        starts.append(start)
    start.host.append(host_s)
    start.boot.append(boot_s)
    start.x.append(x)


# ---------------------------------------------------------------- one clock


def _acting(start: Start, commands: list[tuple[float, float, float]], inputs: tuple[str, ...]) -> Rows:
    """The commands on the robot's clock, with the zero that follows a lapse."""
    columns = [INPUTS.index(name) for name in inputs]
    if len(start.boot) < 2 or not commands:
        return np.empty(0), np.empty((0, len(inputs)))
    given = np.array(commands)
    t = _robot_time(np.array(start.host), np.array(start.boot), given[:, 0])
    order = np.argsort(t, kind="stable")
    t, u = t[order], given[order, 1:][:, columns]
    lapsed = np.append(np.diff(t) > LAPSE_S, True)
    t = np.concatenate([t, t[lapsed] + LAPSE_S])
    u = np.concatenate([u, np.zeros((int(lapsed.sum()), len(inputs)))])
    order = np.argsort(t, kind="stable")
    return t[order], u[order]


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
