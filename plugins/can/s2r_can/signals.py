"""CAN logs as named time series (hook `s2r_formats`): which identifiers there are, and with a DBC the signals of its messages.

Without a DBC each identifier of each channel is a topic without numbers (`can0:123`). With one, a message is a topic: `State`, or
`State[can0]`, `EEC1[00]` where it came on several channels or from several J1939 source addresses. A signal is in the DBC's unit. It is
missing (NaN) where its multiplexer does not select it, where it is outside the DBC's range, and where the DBC names its value as none.

Identifiers are matched as they stand in the DBC; a J1939 message whatever its source address and priority. A stamp that goes back by more
than `AGAIN_S` begins another run. Two passes: what there is, then the numbers that are wanted.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from s2r_can.addresses import PRIORITY, SOURCE
from s2r_can.bits import Scaled, Selector, selected, selectors_of
from s2r_can.database import Database, looked_up
from s2r_can.kinds import kind_of
from s2r_can.layout import scaled
from s2r_can.logs import read_frames
from s2r_can.options import Source
from s2r_can.recordings import AGAIN_S, BACKWARD_SHARE
from s2r_can.records import ERROR, EXTENDED, REMOTE, LogFrame, spelled
from s2r_can.tally import Tally
from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.recordings.formats.series import Run, Samples, Topic
from s2r_runtime.recordings.formats.sizes import check_values
from s2r_runtime.recordings.robot_logs import head_of, suffix_of

if TYPE_CHECKING:
    from cantools.database.can import Message

NULL_ADDRESS = 0xFE
"""Source address of J1939 messages in DBC files: any."""
Key = tuple[str, int]
"""(channel, identifier with its flags)."""


@dataclass
class _Seen:
    """Frames of an identifier. first_s, last_s: of all runs; lasts_s: of all runs together; since_s: where the present run began."""

    n: int = 0
    first_s: float = math.inf
    last_s: float = -math.inf
    lasts_s: float = 0.0
    run: int = -1
    since_s: float = 0.0
    now_s: float = 0.0

    def take(self, t: float, run: int) -> None:
        if run != self.run:
            self.lasts_s, self.run, self.since_s = self.lasts_s + self.now_s - self.since_s, run, t
        self.n += 1
        self.now_s, self.first_s, self.last_s = t, min(self.first_s, t), max(self.last_s, t)


class Field(NamedTuple):
    """A signal, physical in the DBC's unit, and what must be selected for it to be there."""

    scaled: Scaled
    selectors: tuple[Selector, ...]

    def value(self, payload: bytes) -> float:
        """NaN where it is not there, or no measurement."""
        if self.selectors and not selected(self.selectors, payload):
            return math.nan
        one = self.scaled
        raw = one.bits.raw(payload)
        physical = raw * one.scale + one.offset
        return physical if one.low <= physical <= one.high and raw not in one.invalid else math.nan


class Described(NamedTuple):
    """A message of the DBC. note: what of it cannot be used."""

    name: str
    length: int
    fields: dict[str, Field]
    units: dict[str, str]
    note: str


class CanLog:
    """`Opened` for a log of a CAN bus. dbc: path of the file that describes its messages, or as a profile holds it."""

    drawn = False

    def __init__(self, path: Path, dbc: Any = None) -> None:
        self._path, self._dbc = path, dbc
        self.kind = f"{kind_of(head_of(path), suffix_of(path))} log of a CAN bus"
        tally = Tally()
        self._seen: dict[Key, _Seen] = {}
        self.runs = 1
        for run, frame in _runs(path, tally):
            self._seen.setdefault((frame.channel, frame.key), _Seen()).take(frame.t, run)
            self.runs = run + 1
        self.notes = tally.notes()
        if not self._seen:
            raise RecordingError(f"{path}: holds no data frame ({'; '.join(self.notes) or 'no frame'})")
        self._described = _described(dbc, self._seen) if dbc else {}
        self._names = _names(self._seen, self._described)
        if dbc and not self._described:
            self.notes.append("the DBC has none of these identifiers; it is another bus's")

    def topics(self) -> list[Topic]:
        """Messages of the DBC, and the identifiers that it does not have."""
        found = []
        for key, seen in self._seen.items():
            about = self._described.get(key)
            if about:
                kind, units, note = f"CAN frame {key[0]}:{spelled(key[1])}", about.units, about.note
            else:
                kind, units, note = "CAN frame", {}, "not in the DBC" if self._dbc else "--dbc FILE says what is in it"
            lasts = seen.lasts_s + seen.now_s - seen.since_s if self.runs > 1 else 0.0
            found.append(Topic(self._names[key], kind, seen.n, seen.first_s, seen.last_s, units, note, lasts))
        return found

    def read(self, wanted: Mapping[str, Sequence[str]]) -> list[Run]:
        """Samples of these messages."""
        sought = {key: name for key, name in self._names.items() if name in wanted}
        check_values(self._path, sum(self._seen[key].n * (len(wanted[name]) + 1) for key, name in sought.items()))
        runs: list[dict[str, list[array[float]]]] = [
            {name: [array("d") for _ in range(len(wanted[name]) + 1)] for name in sought.values()} for _ in range(self.runs)
        ]
        missing: Counter[str] = Counter()
        short: Counter[str] = Counter()
        tally = Tally()
        for run, frame in _runs(self._path, tally):
            name = sought.get((frame.channel, frame.key))
            if name is None:
                continue
            about = self._described[frame.channel, frame.key]
            if len(frame.payload) < about.length:
                short[name] += 1
                continue
            columns, payload = runs[run][name], frame.payload[: about.length]
            columns[0].append(frame.t)
            for column, field in zip(columns[1:], wanted[name], strict=True):
                column.append(about.fields[field].value(payload))
                if math.isnan(column[-1]) and not about.fields[field].selectors:
                    missing[f"{name}.{field}"] += 1
        self.notes = [*tally.notes()]
        self.notes += [f"{n} frames of {name} are shorter than the DBC says and left out" for name, n in short.items()]
        self.notes += [f"{n} values of {name} are outside the DBC's range or no measurement, and missing" for name, n in missing.items()]
        return [Run({name: _samples(columns, wanted[name]) for name, columns in run.items() if len(columns[0])}) for run in runs]


def open_log(path: Path, dbc: Any = None) -> CanLog:
    """`Opened` for a log of a CAN bus. Raises RecordingError."""
    try:
        return CanLog(path, dbc)
    except ConfigError as error:
        raise RecordingError(f"{path}: {str(error).replace('transport.dbc', '--dbc')}") from None


def _samples(columns: list[array[float]], fields: Sequence[str]) -> Samples:
    return Samples(np.array(columns[0]), {field: np.array(one) for field, one in zip(fields, columns[1:], strict=True)})


def _runs(path: Path, tally: Tally) -> Iterator[tuple[int, LogFrame]]:
    """(run, data frame). Raises RecordingError where stamps are no times."""
    run, n, backward, last = 0, 0, 0, -math.inf
    latest: dict[str, float] = {}
    for frame in read_frames(path, tally):
        if frame.t < last - AGAIN_S:
            run += 1
            latest.clear()
        backward += frame.t < latest.get(frame.channel, -math.inf)
        latest[frame.channel] = last = frame.t
        n += 1
        if frame.key & (ERROR | REMOTE):
            tally.left_out["error frames" if frame.key & ERROR else "remote frames"] += 1
        else:
            yield run, frame
    if backward + run > max(1.0, BACKWARD_SHARE * n):
        raise RecordingError(
            f"{path}: time runs backwards {backward + run} times: stamps must be times, not the differences of candump -td"
        )


def _described(dbc: Any, seen: Mapping[Key, _Seen]) -> dict[Key, Described]:
    """Identifiers of the log that the DBC has."""
    messages, refused = looked_up(dbc)
    any_source = {_group(key): key for key, (_, message) in messages.items() if _is_j1939(message)}
    made: dict[int, Described] = {}
    found = {}
    for channel, key in seen:
        known = key if key in messages or key in refused else any_source.get(_group(key), key) if key & EXTENDED else key
        if known in messages and known not in made:
            made[known] = _describe(*messages[known])
        elif known in refused:
            made[known] = Described("", 0, {}, {}, refused[known])
        if known in made:
            found[channel, key] = made[known]
    return found


def _group(key: int) -> int:
    """A J1939 identifier without priority and source address."""
    return key & ~PRIORITY & ~SOURCE


def _is_j1939(message: Message) -> bool:
    return bool(message.is_extended_frame and (message.protocol == "j1939" or message.frame_id & SOURCE == NULL_ADDRESS))


def _describe(database: Database, message: Message) -> Described:
    fields, units, wrong = {}, {}, []
    for signal in message.signals:
        try:
            one = scaled(database.signal_in(message, signal.name, message.name), Source(signal.name, 1.0), message.name)
            fields[signal.name] = Field(one, selectors_of(message, signal, message.name))
            units[signal.name] = signal.unit or ""
        except ConfigError as error:
            wrong.append(str(error))
    return Described(message.name, int(message.length), fields, units, "; ".join(wrong[:1]))


def _names(seen: Mapping[Key, _Seen], described: Mapping[Key, Described]) -> dict[Key, str]:
    """Topics: a message, with channel and source address where there are several; else channel and identifier."""
    keys: dict[str, list[Key]] = {}
    for key, about in described.items():  # one that cannot be used has no name
        keys.setdefault(about.name, []).append(key)
    found = {}
    for key in seen:
        if key not in described or not described[key].name:
            found[key] = f"{key[0]}:{spelled(key[1])}"
            continue
        name = described[key].name
        parts = [key[0]] if len({channel for channel, _ in keys[name]}) > 1 else []
        parts += [f"{key[1] & SOURCE:02X}"] if len({number for _, number in keys[name]}) > 1 else []
        found[key] = name + (f"[{':'.join(parts)}]" if parts else "")
    return found
