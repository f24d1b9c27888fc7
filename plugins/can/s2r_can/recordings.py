"""The hook `s2r_recordings`: CAN logs (`logs`) -> states and inputs, through the profile's DBC and mapping.

Frames are judged as on the bus (`hearing`). A message's values make a row at its stamp; messages that come together (within MERGE of the
shortest usual interval between two of one kind) make one, stamped with the trigger if it is among them. Where a state is dead
reckoned, it comes with the wheels' speeds. A command frame makes a row of inputs.

Which of several interfaces: the one that the profile calls its robot's side; where the log has none of that name, the one that has most
frames of messages with states.
"""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_can.addresses import Addresses
from s2r_can.database import Database
from s2r_can.hearing import Heard, Hearing
from s2r_can.layout import Group, Layout
from s2r_can.listening import layout_of
from s2r_can.logs import read_frames
from s2r_can.odometry import Odometry
from s2r_can.options import checked, named
from s2r_can.proposals import CommandReader
from s2r_can.reckoning import Reckoning, odometry_of
from s2r_can.records import ERROR, REMOTE, LogFrame
from s2r_can.tally import Tally
from s2r_runtime.errors import RecordingError
from s2r_runtime.hookspecs import ReadLog

Array = NDArray[np.float64]
Stretch = tuple[tuple[Array, Array], tuple[Array, Array]]

MERGE = 0.3
BACKWARD_SHARE = 0.1
"""Of the frames that may come before the one before them (two interfaces in one log); in more, the stamps are no time."""
AGAIN_S = 1.0
"""A stamp that is farther back begins another drive: logs that were put together."""


def read(path: Path, states: tuple[str, ...], inputs: tuple[str, ...], options: dict[str, Any]) -> ReadLog:
    """A log's stretches, and what of it could not be used; see `hookspecs.s2r_recordings`. Raises ConfigError, RecordingError."""
    known = checked(options)
    database = Database(known.dbc, named(known))
    layout = layout_of(known, database, states, inputs)
    tally = Tally()
    drives = _chosen(path, layout, str(known.robot.get("channel", "")), tally)
    window = _window(drives, layout)
    stretches: list[Stretch] = []
    refused: Counter[str] = Counter()
    for drive in drives:
        rows = _Rows(layout, states, inputs, odometry_of(known), round(known.observation_timeout * 1e9), window)
        for frame in drive:
            rows.take(frame)
        stretches += [stretch for stretch in rows.stretches() if len(stretch[0][0])]
        refused.update(rows.hearing.counts)
        refused["wrong command"] += rows.wrong_commands
        refused["of a second source address"] += rows.twins
    counts = ", ".join(f"{name} {count}" for name, count in sorted(refused.items()) if count and name != "lost")
    frames = sum(map(len, drives))
    if not stretches:
        raise RecordingError(f"{path}: none of {frames} frames with states can be believed ({counts or 'no value in them'})")
    believed = [f"of {frames} frames of the profile's messages these were not believed, as on the bus: {counts}"] if counts else []
    lost = [f"{refused['lost']} frames are missing, by the counters in the others"] if refused["lost"] else []
    return ReadLog(stretches, (*tally.notes(), *believed, *lost))


def _chosen(path: Path, layout: Layout, robot: str, tally: Tally) -> list[list[LogFrame]]:
    """Drives: frames that matter, of one interface, in time."""
    listened, sent = set(layout.inbound), set(layout.commands)
    seen: Counter[str] = Counter()
    others = 0
    frames: list[LogFrame] = []
    addresses = Addresses(layout.inbound, layout.sources)
    for frame in read_frames(path, tally):
        if frame.key not in sent and addresses.message(frame.key) in listened:
            listened.add(frame.key)  # whatever its source address
        if frame.key in listened or frame.key in sent:
            frames.append(frame)
            seen[frame.channel] += frame.key in listened
        else:
            others += 1
            if frame.key & (ERROR | REMOTE):
                tally.left_out["error frames" if frame.key & ERROR else "remote frames"] += 1
    if not sum(seen.values()):
        wanted = ", ".join(sorted({m.name for m in layout.inbound.values()}))
        raise RecordingError(f"{path}: holds none of the messages that the profile reads ({wanted}) among {others + len(frames)} frames")
    channel = robot if seen[robot] else seen.most_common(1)[0][0]
    commanded = {f.channel for f in frames if f.key in sent}
    source = channel if channel in commanded else next(iter(sorted(commanded)), channel)
    kept = [f for f in frames if f.channel == (channel if f.key in listened else source)]
    if len(kept) < len(frames):
        tally.said.append(
            f"{len(frames) - len(kept)} frames of the profile's messages are of another interface than {channel!r} and left out"
        )
    backward = sum(b.t < a.t for a, b in pairwise(kept))
    if backward > max(1.0, BACKWARD_SHARE * len(kept)):
        raise RecordingError(f"{path}: time runs backwards {backward} times: stamps must be times, not the differences of candump -td")
    cuts = [0, *(k for k, (a, b) in enumerate(pairwise(kept), start=1) if b.t < a.t - AGAIN_S), len(kept)]
    return [sorted(kept[a:b], key=lambda frame: frame.t) for a, b in pairwise(cuts)]


def _window(drives: list[list[LogFrame]], layout: Layout) -> float:
    """s within which messages belong together."""
    intervals, addresses = [], Addresses(layout.inbound, layout.sources)
    for key in layout.inbound:
        apart = [np.diff([frame.t for frame in drive if addresses.message(frame.key) == key]) for drive in drives]
        if sum(map(len, apart)) > 1:
            intervals.append(float(np.median(np.concatenate(apart))))
    return MERGE * min(intervals, default=0.0)


class _Rows:
    """Collects rows. window: s within which what comes together makes one."""

    def __init__(
        self, layout: Layout, states: tuple[str, ...], inputs: tuple[str, ...], odometry: Odometry | None, silence_ns: int, window: float
    ) -> None:
        self._layout, self._names, self._nu, self._window = layout, states, len(inputs), window
        self.hearing = Hearing(layout, silence_ns)
        self._reckoning = Reckoning(layout, odometry, self.hearing.values)
        self._columns = {index: column for column, index in enumerate(layout.states) if index is not None}
        self._commands = CommandReader(layout, inputs)
        self._origin: float | None = None
        self.wrong_commands = self.twins = 0
        self._addresses = Addresses(layout.inbound, layout.sources, silence_ns)
        self._parts: list[tuple[list[float], list[list[float]], list[float], list[list[float]]]] = [([], [], [], [])]
        self._row: list[float] = []
        self._row_t = 0.0
        self._in_row: set[int] = set()

    def take(self, frame: LogFrame) -> None:
        """The next frame, in time."""
        if self._origin is None:
            self._origin = frame.t
        if self._addresses.used and self._addresses.twin(frame.key, round((frame.t - self._origin) * 1e9)):
            self.twins += 1
            return
        message = self._layout.inbound.get(self._addresses.message(frame.key))
        if message is None:
            self._command(frame)
            return
        heard = self.hearing.frame(message, frame.payload, round((frame.t - self._origin) * 1e9))
        self._reckoning.forget(heard.bad)
        if heard.kind == "restarted":
            self._begin()
        if heard.groups:
            self._states(frame.t, heard)

    def stretches(self) -> list[Stretch]:
        """What there is."""
        self._end_row()
        nx = len(self._names)
        return [
            ((np.array(tx), np.array(x).reshape(len(tx), nx)), (np.array(tu), np.array(u).reshape(len(tu), self._nu)))
            for tx, x, tu, u in self._parts
        ]

    def _begin(self) -> None:
        """The robot started anew: what comes is another stretch."""
        self._end_row()
        self._reckoning.rest()
        self._parts.append(([], [], [], []))

    def _states(self, t: float, heard: Heard) -> None:
        assert self._origin is not None  # noqa: S101 - `take` set it
        for group in heard.groups:
            moved = self._reckoning.came(group, round((t - self._origin) * 1e9))
            columns = [(self._columns[index], self.hearing.values[index]) for index in group.into if index in self._columns]
            if moved is not None:
                columns += [(c, moved[("x", "y", "theta").index(n)]) for c, n in enumerate(self._names) if self._layout.states[c] is None]
            if columns:
                self._put(t, group, columns)

    def _put(self, t: float, group: Group, columns: list[tuple[int, float]]) -> None:
        if not self._row or t - self._row_t > self._window or group.index in self._in_row:
            self._end_row()
            self._row, self._row_t = [np.nan] * len(self._names), t
        for column, value in columns:
            self._row[column] = value
        self._in_row.add(group.index)
        if group is self._layout.trigger:
            self._row_t = t

    def _end_row(self) -> None:
        if self._row:
            times, rows, _, _ = self._parts[-1]
            if not times or self._row_t >= times[-1]:
                times.append(self._row_t)
                rows.append(self._row)
        self._row, self._in_row = [], set()

    def _command(self, frame: LogFrame) -> None:
        values, wrong = self._commands.read(frame.key, frame.payload)
        self.wrong_commands += bool(wrong)
        if not wrong:
            self._parts[-1][2].append(frame.t)
            self._parts[-1][3].append(values)
