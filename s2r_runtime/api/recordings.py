"""Recordings as the command line and Python name them: files and folders, DataFrames, dicts of arrays; and which column is what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from s2r_runtime.api.frames import array_table, is_frame
from s2r_runtime.api.results import MEASURED, Result, axes_of
from s2r_runtime.api.spelling import front_door
from s2r_runtime.errors import RecordingError, UsageError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.profile import Profile
from s2r_runtime.recordings.robot_logs import has_columns
from s2r_runtime.recordings.tables import SEGMENT, TIME, ArrayTable, Source, read_csv

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from s2r_runtime.recordings.formats.series import Topic

RecordingLike = Any
"""A path, a DataFrame, a dict of arrays, what `s2r.recording(...)` gives, or a list of several."""
_LISTED = 8
"""Topics in a summary."""


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Result):
    """One recording, or several of one kind, and which of its columns or signals is what. Nothing is read before it is needed."""

    sources: tuple[Source, ...]
    column: Mapping[str, str] = field(default_factory=dict)
    state: Mapping[str, str] = field(default_factory=dict)
    input: Mapping[str, str] = field(default_factory=dict)
    dbc: Path | None = None
    max_gb: float | None = None

    def columns(self) -> dict[str, np.ndarray[Any, Any]]:
        """Columns of a table by name, (n,) each, and `t` in s; NaN where nothing was received. Raises RecordingError for anything else."""
        if len(self.sources) != 1 or not has_columns(self.sources[0]):
            raise RecordingError(f"{self._names()}: is no table of named columns; read_log reads a log of this software")
        stamps = {TIME: self.column[TIME]} if TIME in self.column else {}
        table = read_csv(self.sources[0], columns=stamps)
        return {TIME: table.t, **table.columns}

    def summary(self) -> str:
        """What it holds: topics or columns, rates and spans."""
        lines = []
        for one in self.to_dict()["recordings"]:
            topics = one["topics"]
            lines.append(f"{one['recording']}: {one['kind']}; {len(topics)} topic{'s' if len(topics) != 1 else ''}")
            lines += [
                f"  {topic['name'] or '(table)'}  n {topic['n']}  {topic['rate_hz']:.4g} Hz  {', '.join(topic['signals'])}"
                for topic in topics[:_LISTED]
            ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """`recordings`: for each what `s2r topics --json` prints."""
        return {"recordings": [topics_json(one, self.dbc) for one in self.sources]}

    def plot(self, ax: Axes | None = None, *, names: Sequence[str] | None = None) -> list[Axes]:
        """Columns of a table over time, one below the other; with `ax`, all in that one. names: of columns (default: the first eight)."""
        columns = self.columns()
        shown = list(names) if names is not None else [name for name in columns if name != TIME][:_LISTED]
        if unknown := [name for name in shown if name not in columns]:
            raise UsageError(f"plot: there is no column {unknown[0]!r}; there are: {', '.join(columns)}")
        axes = axes_of(max(1, len(shown)), ax, height_in=1.3)
        for k, name in enumerate(shown):
            here = axes[min(k, len(axes) - 1)]
            here.plot(columns[TIME], columns[name], color=MEASURED if ax is None else None, linewidth=0.9, label=name)
            here.set_ylabel(name)
        axes[-1].set_xlabel("t (s)")
        return axes

    def _names(self) -> str:
        return ", ".join(map(str, self.sources))


@front_door
def recording(
    source: RecordingLike,
    *,
    column: Mapping[str, str] | None = None,
    state: Mapping[str, str] | None = None,
    input: Mapping[str, str] | None = None,  # noqa: A002 - as the command line calls it
    dbc: str | Path | None = None,
    max_gb: float | None = None,
    name: str = "",
) -> Recording:
    """A recording, with which of its columns or signals is what. Wherever one is needed, `source` itself does as well.

    source: the path of a table (CSV), of a log of this software (MCAP), or of another format (docs/recordings.md: bags, tlogs, candumps,
    ULog, MF4, Parquet, ...); a pandas or polars DataFrame; a dict of column names to arrays (n,); or a list of several of one kind.
    A table has the stamps in `t` (s), a column for each state and each input, and maybe `segment` for runs that are not contiguous.
    NaN means *not received*; an input holds until its next value.

    column: name in the model (or `t`) -> column of a table. state, input: name in the model -> signal (`TOPIC.FIELD`), for formats with
    topics. dbc: of a CAN log, the file that describes its frames. max_gb: largest table that is read, as text. name: in messages.

    Raises TypeError for anything else, RecordingError for columns without names, of unequal lengths, or that are there twice.
    """
    if isinstance(source, Recording):
        found = source
    else:
        several = list(source) if isinstance(source, list | tuple) else [source]
        if not several:
            raise RecordingError("recording: the list is empty, must name at least one recording")
        frames = sum(1 for one in several if not isinstance(one, str | Path | Recording))
        found = Recording(tuple(_source(one, k + 1 if frames > 1 else 0, name) for k, one in enumerate(several)))
    options: dict[str, Any] = {"column": column, "state": state, "input": input, "max_gb": max_gb}
    options["dbc"] = None if dbc is None else Path(dbc)
    if max_gb is not None and not max_gb > 0.0:
        raise UsageError(f"--max-gb {max_gb}: must be > 0")
    for option in ("column", "state", "input"):
        _check_names(option, options[option])
    return replace(found, **{option: value for option, value in options.items() if value is not None})


def as_recording(given: RecordingLike, *options: Any) -> Recording:
    """As `recording`, where that name is taken. options: column, state, input, dbc, max_gb."""
    column, state, inputs, dbc, max_gb = options
    return recording(given, column=column, state=state, input=inputs, dbc=dbc, max_gb=max_gb)


def _source(value: Any, number: int, name: str) -> Source:
    if isinstance(value, str | Path):
        return Path(value)
    if isinstance(value, ArrayTable):
        return value
    if isinstance(value, Recording) and len(value.sources) == 1:
        return value.sources[0]
    shown = name or ("the DataFrame" if is_frame(value) else "the dict of arrays")
    if isinstance(value, Mapping) or is_frame(value):
        return array_table(value, f"{shown} {number}" if number else shown)
    raise TypeError(
        f"recording: is {type(value).__name__}, must be a path, a pandas or polars DataFrame, a dict of arrays, or a list of these"
    )


def _check_names(option: str, given: Mapping[str, str] | None) -> None:
    if given is None:
        return
    if not isinstance(given, Mapping) or not all(isinstance(one, str) and one for pair in given.items() for one in pair):
        raise TypeError(f"{option}: is {given!r}, must be a dict: name in the model -> its name in the recording")


def transport_of(dbc: Path | None, profile: Profile | None) -> dict[str, Any] | None:
    """The profile's transport; with a DBC file that alone, by which a CAN log has named signals."""
    if dbc is not None:
        return {"name": "can", "dbc": str(dbc)}
    return profile.transport if profile else None


def signals_of(state: Mapping[str, str], inputs: Mapping[str, str], model: ComposedModel) -> dict[str, str]:
    """Name in the model -> signal. Raises UsageError for a name that the model does not have."""
    found: dict[str, str] = {}
    for option, given, names in (("--state", state, model.states), ("--input", inputs, model.inputs)):
        what = option[2:]
        for name, signal in given.items():
            if name not in names:
                other = model.inputs if option == "--state" else model.states
                item = f"{name}={signal}"
                hint = f"; it is an{' input: --input' if option == '--state' else ' state: --state'} {item}" if name in other else ""
                raise UsageError(f"{option} {item}: the model has no {what} {name!r}{hint}; it has: {', '.join(names)}")
            found[name] = signal
    return found


def columns_of(given: Recording, model: ComposedModel, profile: Profile | None, test: Recording | None = None) -> dict[str, str]:
    """Name in the model, or `t` -> column of the table, where they differ: the profile's, and those given instead.

    test: another recording that is read alike. Raises UsageError for a name that the model does not have, for two names on one column,
    and where there is no table.
    """
    columns = dict(profile.columns) if profile else {}
    columns |= signals_of(given.state, given.input, model)
    if not given.column:
        return columns
    for source in (*given.sources, *(test.sources if test else ())):
        if not has_columns(source):
            raise UsageError(f"--column: belongs to a table; {source} is a log, whose states and inputs have their names")
    names = (*model.states, *model.inputs, TIME)
    for name, column in given.column.items():
        if name not in names:
            has = ", ".join(names[:-1])
            raise UsageError(f"--column {name}={column}: the model has no state or input {name!r}; it has: {has} (and t for the stamps)")
    columns |= given.column
    for name in given.column:
        other = next((n for n in names if n != name and columns.get(n, n) == columns[name]), None)
        if other is not None:
            raise UsageError(
                f"--column {name}={columns[name]}: is the column of {other}, too; say where that is (--column {other}=COLUMN), or rename it"
            )
    return columns


# ---------------------------------------------------------------- what a recording holds


def topics_json(source: Source, dbc: Path | None) -> dict[str, Any]:
    """What `s2r topics --json` prints of a recording, without a model."""
    kind, topics, notes = listed(source, transport_of(dbc, None))
    rows = [topic_json(topic) for topic in ordered(topics)]
    return {"recording": str(source), "kind": kind, "topics": rows, "guess": {}, "notes": list(notes)}


def ordered(topics: Sequence[Topic]) -> list[Topic]:
    """Usable ones first, of these what gives a robot's motion or its commands."""
    from s2r_runtime.recordings.formats.guess import INPUTS, STATES

    usual = {source.match for source in (*STATES, *INPUTS)}
    return sorted(topics, key=lambda one: (not one.fields or one.n == 0, not {one.kind, f"#{one.name}"} & usual, one.name))


def topic_json(topic: Topic) -> dict[str, Any]:
    """Plain data."""
    from s2r_runtime.recordings.formats.signals import paths_of

    def finite(value: float) -> float | None:
        return value if np.isfinite(value) else None

    return {
        "name": topic.name,
        "type": topic.kind,
        "n": topic.n,
        "rate_hz": round(topic.rate, 6),
        "first_s": finite(topic.first_s),
        "last_s": finite(topic.last_s),
        "signals": {path: topic.fields.get(path, "rad") for path in paths_of(topic)},
        "note": topic.note,
    }


def listed(path: Source, described: dict[str, Any] | None) -> tuple[str, Sequence[Topic], Sequence[str]]:
    """What a recording is, its topics, and notes on how it was read. described: the file that describes its messages.

    Raises UsageError, RecordingError.
    """
    from s2r_runtime.files.table_text import refuse_special
    from s2r_runtime.recordings.formats.recognise import open_recording
    from s2r_runtime.recordings.formats.routes import Named, form_of, signals_of_log
    from s2r_runtime.recordings.robot_logs import is_mcap, is_robot_log

    if isinstance(path, ArrayTable):
        return "table", [_table(path)], []
    refuse_special(path)
    form = form_of(path)
    named = Named(form, {}) if form else None if is_mcap(path) else signals_of_log(path, described)
    if described and not (named and named.options):
        raise UsageError(f"{path}: --dbc: is no log of a CAN bus")
    if named is not None:
        opened = open_recording(path, *named)
        return opened.kind, opened.topics(), opened.notes
    if is_mcap(path):
        raise UsageError(
            f"{path}: is a log of this software, whose states and inputs have their names; s2r log info {path} says what it holds"
        )
    if is_robot_log(path):
        raise UsageError(f"{path}: is a robot's own log; its profile says what is in it: s2r trace {path} --profile P")
    return "table", [_table(path)], []


def _table(path: Source) -> Topic:
    """A table as one topic, whose name is empty."""
    import math

    from s2r_runtime.recordings.formats.series import Topic
    from s2r_runtime.recordings.tables import header_of, missing_columns, places_of

    header = [name for name in header_of(path) if name and name != SEGMENT]
    if len(header) <= 1:
        raise RecordingError(f"{path}: is no table, and nothing else that is known here: {missing_columns([TIME], header)}")
    stamps = places_of(path, [TIME], {}).get(TIME)
    if stamps is None:
        return Topic("", "table", 0, math.nan, math.nan, dict.fromkeys(header, ""), f"no column t (the stamps): --column {TIME}=NAME")
    table = read_csv(path, [])
    fields = {name: "" for name in header if name != stamps.column}
    if table.segment is None:
        return Topic("", "table", len(table.t), float(table.t.min()), float(table.t.max()), fields)
    lasts = sum(float(np.ptp(table.t[table.segment == k])) for k in range(len(table.segments)))
    note = f"{len(table.segments)} runs, by {SEGMENT}"
    return Topic("", "table", len(table.t), float(table.t.min()), float(table.t.max()), fields, note, lasts)
