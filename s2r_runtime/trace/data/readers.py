"""Datasets from files: a table (CSV, CSV.gz), a log in a robot's own format, a file with named signals, or a log of the daemon (MCAP, one
part or several). Several recordings that are no parts of a log are runs of their own.

In a log the states are the observations that carry no fault, on the robot's clock. A command acts from the stamp of the observation
that it answers, plus what the daemon took to answer (`obs_seq` ties the two clocks together); in lockstep that is nothing.
"""

from __future__ import annotations

import difflib
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from s2r_runtime.errors import RecordingError, UsageError
from s2r_runtime.evidence.seen_rows import sketch
from s2r_runtime.files.canonical import digest_of_path
from s2r_runtime.files.table_text import Limits, Progress
from s2r_runtime.messages import CampaignFinished, Observed, Send, StartCampaign, Started
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.modelspec import COMPACT
from s2r_runtime.recording.origin import other_writer
from s2r_runtime.recordings.formats.mapping import Recorded
from s2r_runtime.recordings.formats.routes import read_recording
from s2r_runtime.recordings.robot_logs import content_digest, is_mcap, is_robot_log, refuse_special, sources_of
from s2r_runtime.recordings.table_rows import Subset, joined
from s2r_runtime.recordings.tables import ArrayTable, Source
from s2r_runtime.trace.data.dataset import Array, Dataset, Stream, from_streams
from s2r_runtime.trace.data.reconstruction import late_speeds, reconstruct
from s2r_runtime.trace.data.unmeasured_states import unneeded, without
from s2r_runtime.trace.estimation.hidden_state import told_through
from s2r_runtime.trace.estimation.prediction import check_steps
from s2r_runtime.trace.sensor_faults.pose_latency import earlier, late_pose

Row = tuple[float, ...]
RECENT = 4096
"""Observations to which a command may still answer."""

MAX_ROWS = 262_144
"""Rows of a table that are traced: a search takes as much longer as there are more, and a fit uses 4000 of them."""

MISSPELT = 0.75
"""Likeness of names from which on one is the other, misspelt; upper and lower are 0.6 alike."""


def load_dataset(
    path: Source | str | Sequence[Source | str],
    model: ComposedModel,
    columns: Mapping[str, str] | None = None,
    *,
    epoch: int | None = None,
    bandwidth: float | None = None,
    transport: Mapping[str, Any] | None = None,
    behind: Mapping[str, float] | None = None,
    signals: Mapping[str, str] | None = None,
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Reads a recording on the model's grid: a file, a folder, or a table in memory.

    columns: name in the model, or `t` -> column of the table. Several paths: parts of one log, or
    recordings of one kind, each of them a run of its own. signals: name in the model -> signal, for a file with named signals.
    epoch: of a log, only what was recorded while that campaign was under way. bandwidth: Hz within which states that the table does not
    have are reconstructed from those that it has (None: what the data bear, and only those that the motion
    needs: unseen.py). transport: the profile's, for a log in a robot's own format. behind: s by which states of the pose come late, if that
    is known from another recording (None: as this one says, `pose_latency`). limits, progress: of reading a table; of one with more than
    MAX_ROWS rows stretches that are evenly spread are used (`Dataset.subset`).

    Raises RecordingError (unreadable, lacks a column that does not follow from others, too slow for the model's dt), ConfigError if
    somebody's own model fails at the states of a table, NotEnoughEvidence if states were measured at one moment only, or too seldom for
    what was not measured, UsageError if a recording is there twice.
    """
    paths = sources_of(path)
    for one in paths:
        refuse_special(one)
    source = ", ".join(str(p) for p in paths)
    own = [one for one in paths if isinstance(one, Path) and _is_own_log(one)]
    files = tuple(one for one in paths if isinstance(one, Path))
    if own and len(own) < len(paths):
        raise UsageError(f"{own[0]}: is a log of this software, other recordings are none; trace one kind at a time")
    segments = _log_segments(files, model, epoch) if own else []  # first: what is no log is refused before all of it is digested
    if own:
        digests = tuple(_digest(p) for p in paths) if any(len(states.t) for states, _ in segments) else ()
        _once(paths, digests)
        return replace(from_streams(model, segments, source, (*digests, *row_sketch(model, segments)), files), commanded=True)
    tables = _Tables(columns or {}, not bandwidth, MAX_ROWS // len(paths), limits, progress)
    parts = [_read_one(one, model, tables, transport, signals) for one in paths]
    digests = tuple(_digest(p) for p in paths)
    _once(paths, digests)
    _once(paths, [part.content for part in parts])
    segments, missing, called = _joined(paths, parts)
    rows: tuple[str, ...] = ()
    if not missing:
        _check_steps(model, segments)
        rows = row_sketch(model, segments)
    if behind is None:
        behind = {} if bandwidth else late_pose(model, segments, missing)
    names = [s for s in model.states if s not in missing]
    segments = earlier(segments, names, behind) if behind else segments
    slow = {} if bandwidth else late_speeds(model, segments, missing)
    if slow:
        kept = [j for j, s in enumerate(names) if s not in slow]
        segments = [(Stream(states.t, states.values[:, kept]), inputs) for states, inputs in segments]
        missing = tuple(s for s in model.states if s in {*missing, *slow})
    spare = () if bandwidth else unneeded(model, missing)  # who gives a bandwidth wants to see them
    model, missing = without(model, spare), tuple(s for s in missing if s not in spare)
    done = None
    if missing:
        segments, done = reconstruct(model, segments, missing, source, bandwidth, slow)
    named = called if len(called) > 1 and done is None else ()  # what was reconstructed may be in more parts
    data = from_streams(model, segments, source, (*digests, *(part.content for part in parts), *rows), files, done)
    subset = joined([part.subset for part in parts], [sum(len(states.t) for states, _ in part.segments) for part in parts])
    names = [f"{one.name}: " if len(paths) > 1 else "" for one in paths]
    notes = tuple(f"{name}{line}" for name, part in zip(names, parts, strict=True) for line in part.notes)
    return replace(data, behind=dict(behind), called=named, subset=subset, notes=notes)


def _check_steps(model: ComposedModel, segments: Sequence[tuple[Stream, Stream]]) -> None:
    """Raises ConfigError, as the model does, if its step fails from the first, middle and last states that were measured. One that always
    does would say so only after it was asked of every row by itself.
    """
    x, u = (np.concatenate([pair[kind].values for pair in segments]) for kind in (0, 1))
    x, u = x[np.isfinite(x).all(axis=1)], u[np.isfinite(u).all(axis=1)]
    if len(x) and len(u):
        check_steps(model, *(e[[0, len(e) // 2, -1]] for e in (x, u)))


def row_sketch(model: ComposedModel, segments: Sequence[tuple[Stream, Stream]], form: str = COMPACT) -> tuple[str, ...]:
    """What stands for the rows of states that were measured (guarantee G6), as text."""
    return sketch([states.values for states, _ in segments], model.angle_columns, form)


def _digest(path: Source) -> str:
    """As guarantee G6 wants it: of the file's bytes."""
    if isinstance(path, ArrayTable):
        return path.digest
    try:
        return digest_of_path(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None


class _Tables(NamedTuple):
    """How tables are read. hidden: whether states may be left out that others tell by the model alone. max_rows: of each that are used."""

    columns: Mapping[str, str]
    hidden: bool
    max_rows: int
    limits: Limits | None
    progress: Progress | None


def _table_segments(path: Source, model: ComposedModel, how: _Tables) -> _Part:
    """A table's. A column that the caller stated must be there."""
    from s2r_runtime.recordings.tables import read_csv

    columns, names = how.columns, (*model.states, *model.inputs)
    free = {name for name in getattr(model.nominal, "follows", {}) if name not in columns}
    free |= _hidden(path, model, free, columns) if how.hidden else set()
    needed, spare = ([name for name in names if (name in free) == may] for may in (False, True))
    table = read_csv(
        path,
        needed,
        spare,
        columns,
        order=names,
        angles=model.nominal.angles,
        max_rows=how.max_rows,
        limits=how.limits,
        progress=how.progress,
    )
    unsaid = {s for s in model.states if s not in columns and np.isnan(table.columns.get(s, np.array(np.nan))).all()}
    if not unsaid <= free and not (how.hidden and told_through(model.nominal, [s for s in model.states if s in unsaid])):
        unsaid &= free
    missing = tuple(s for s in model.states if s in unsaid)
    states = np.column_stack([table.columns[s] for s in model.states if s not in missing])
    inputs = np.column_stack([table.columns[i] for i in model.inputs])
    where = table.piece if table.piece is not None else table.segment
    where = np.zeros(len(table.t), dtype=np.int64) if where is None else where
    edges = np.flatnonzero(np.diff(where, prepend=-1, append=-1))
    given = []
    for a, b in pairwise(edges.tolist()):
        t, y, u = table.t[a:b], states[a:b], inputs[a:b]
        measured, commanded = ~np.isnan(y).all(axis=1), ~np.isnan(u).all(axis=1)
        given.append((Stream(t[measured], y[measured]), Stream(t[commanded], u[commanded])))
    called = table.segments if table.subset is None else ()  # stretches of one segment are runs of their own
    return _Part(given, missing, table.content, called, table.notes, table.subset)


def _hidden(path: Source, model: ComposedModel, free: set[str], columns: Mapping[str, str]) -> set[str]:
    """States that the table does not have, and that other ones tell by the model (`hidden_state`). Not where it has a column that nobody
    asked for, of nearly the same name: that is it, misspelt.
    """
    from s2r_runtime.recordings.tables import header_of, places_of

    header = header_of(path)
    there = places_of(path, (*model.states, *model.inputs), columns, model.nominal.angles)
    lacks = [s for s in model.states if s not in {*there, *free, *columns}]
    spare = [name for name in header if name not in {place.column for place in there.values()}]
    if not lacks or any(difflib.get_close_matches(name.lower(), [other.lower() for other in spare], 1, MISSPELT) for name in lacks):
        return set()
    missing = [s for s in model.states if s not in there]
    return {*lacks} if told_through(model.nominal, missing) else set()


class _Part(NamedTuple):
    """A recording that is no log of this software: its segments, the states that it lacks, the digest of what it says, the names of its
    segments, and notes on how it was read.
    """

    segments: list[tuple[Stream, Stream]]
    missing: tuple[str, ...]
    content: str
    called: tuple[str, ...]
    notes: tuple[str, ...] = ()
    subset: Subset | None = None


def _is_own_log(path: Path) -> bool:
    try:
        return not path.is_dir() and is_mcap(path) and not other_writer(path) and not is_robot_log(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None


def _once(paths: Sequence[Source], digests: Sequence[str]) -> None:
    """Raises UsageError if a recording is there twice: it would count twice."""
    for k, digest in enumerate(digests):
        if digest in digests[:k]:
            twin = paths[list(digests).index(digest)]
            raise UsageError(f"{paths[k]}: is the recording {twin} once more (the same values); give each of them once")


def _read_one(
    path: Source,
    model: ComposedModel,
    tables: _Tables,
    transport: Mapping[str, Any] | None,
    signals: Mapping[str, str] | None,
) -> _Part:
    recorded = read_recording(path, model, columns=tables.columns, transport=transport, signals=signals)
    return _table_segments(path, model, tables) if recorded is None else _recorded_segments(recorded, model)


def _joined(paths: Sequence[Source], parts: Sequence[_Part]) -> tuple[list[tuple[Stream, Stream]], tuple[str, ...], tuple[str, ...]]:
    """Segments, states that are missing, and names of segments, of all recordings. Raises RecordingError if they lack different states."""
    for path, part in zip(paths, parts, strict=True):
        if part.missing != parts[0].missing:
            differ = ", ".join(sorted({*part.missing} ^ {*parts[0].missing}))
            raise RecordingError(f"{path}: does not have the states that {paths[0]} has: one of them lacks {differ}; trace them one by one")
    if len(parts) == 1:
        return parts[0].segments, parts[0].missing, parts[0].called
    called = tuple(
        f"{path.name}: {part.called[k]}" if len(part.called) > 1 else path.name
        for path, part in zip(paths, parts, strict=True)
        for k in range(len(part.segments))
    )
    return [segment for part in parts for segment in part.segments], parts[0].missing, called


def _recorded_segments(recorded: Recorded, model: ComposedModel) -> _Part:
    """Of a robot's own log or a file with named signals. States that follow from others may lack."""
    stretches = recorded.stretches
    seen = ~np.isnan(np.concatenate([stretch.states.values for stretch in stretches])).all(axis=0)
    free = getattr(model.nominal, "follows", {})
    missing = tuple(name for name, there in zip(model.states, seen, strict=True) if not there and name in free)
    kept = [i for i, name in enumerate(model.states) if name not in missing]
    given = [(Stream(s.states.t, s.states.values[:, kept]), Stream(*s.inputs)) for s in stretches]
    return _Part(given, missing, content_digest(stretches, model), recorded.called, recorded.notes)


def _log_segments(paths: tuple[Path, ...], model: ComposedModel, epoch: int | None) -> list[tuple[Stream, Stream]]:
    from s2r_runtime.recording.reading import read

    log = _Log(model, epoch)
    for path in paths:
        reading = read(path, ("event/started", "event/observed", "out/send", "out/start_campaign", "event/campaign_finished"))
        for entry in reading:
            log.take(entry.message, path)
        if reading.ending is not None and reading.ending.kind == "broken":
            raise RecordingError(f"{path}: is damaged {reading.ending.detail}")
    return [(_stream(y, len(model.states)), _stream(u, len(model.inputs))) for y, u in log.segments]


class _Log:
    """Collects segments of (stamp, state) and (stamp, input) rows from a log's messages, in their order. epoch: as in `load_dataset`."""

    def __init__(self, model: ComposedModel, epoch: int | None) -> None:
        self.segments: list[tuple[array[float], array[float]]] = [_rows()]
        self._model, self._epoch = model, epoch
        self._inside = epoch is None
        self._stamps: dict[int, tuple[float, int]] = {}
        self._last: tuple[int, float] = (-1, -float("inf"))
        self._row: Row = ()

    def take(self, message: object, path: Path) -> None:
        """The next message."""
        if isinstance(message, Started):
            had, has = message.settings, self._model
            _expect(had.states == has.states, path, f"the states {', '.join(had.states)}; the model has {', '.join(has.states)}")
            _expect(had.inputs == has.inputs, path, f"the inputs {', '.join(had.inputs)}; the model has {', '.join(has.inputs)}")
        elif isinstance(message, Observed) and not message.observation.fault:
            self._observed(message, path)
        elif isinstance(message, Send) and self._inside and message.obs_seq in self._stamps:
            stamp, asked_ns = self._stamps[message.obs_seq]
            nu = len(self._model.inputs)
            _expect(len(message.u) == nu, path, f"commands of {len(message.u)} inputs, the model has {nu}")
            self.segments[-1][1].extend((stamp + max(message.t_ns - asked_ns, 0) * 1e-9, *message.u))
        elif isinstance(message, StartCampaign) and message.epoch == self._epoch:
            self._inside = True
            self.segments.append((array("d", self._row), array("d")))  # what the campaign is asked first is about this observation
        elif isinstance(message, CampaignFinished) and message.epoch == self._epoch:
            self._inside = False

    def _observed(self, message: Observed, path: Path) -> None:
        o, (last_seq, last) = message.observation, self._last
        stamp, nx = o.stamp_ns * 1e-9, len(self._model.states)
        if o.seq < last_seq and stamp < last:  # both go back: the robot was started anew
            self.segments.append(_rows())
            self._stamps.clear()
        elif stamp <= last:
            return
        self._last = o.seq, stamp
        self._stamps[o.seq] = stamp, message.t_ns
        if len(self._stamps) > RECENT:
            del self._stamps[next(iter(self._stamps))]
        _expect(len(o.x) == nx, path, f"observations of {len(o.x)} states, the model has {nx}")
        self._row = (stamp, *o.x)
        if self._inside:
            self.segments[-1][0].extend(self._row)


def _rows() -> tuple[array[float], array[float]]:
    """Rows of states, and of inputs, one number after the other: a long log is millions of them."""
    return array("d"), array("d")


def _expect(ok: bool, path: Path, what: str) -> None:
    if not ok:
        raise RecordingError(f"{path}: has {what}")


def _stream(rows: array[float], width: int) -> Stream:
    """Sorted by stamp; equal stamps keep their order."""
    table: Array = np.frombuffer(rows, dtype=np.float64).reshape(-1, 1 + width)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return Stream(table[:, 0], table[:, 1:])
