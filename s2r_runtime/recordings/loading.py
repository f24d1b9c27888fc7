"""A recording -> its transitions, ready for a gap (docs/log-format.md, 9; one transition a held input: G7).

MCAP: a campaign's samples are marked (`SampleTaken`). The last campaign that was completed counts, or the epoch asked for; one that was not
completed gives its samples without a statement, since N was not fixed beforehand. A log without samples is ordinary driving.

CSV with segments: the first row of each is x0. Its input must hold for at least dt; x1 is interpolated linearly at t0 + dt (angles
unwrapped). Where the input holds h whole steps in every segment used, and the states last as long, the state at t0 + h dt is
the hold's end. Segments are taken for independent draws that begin at rest: that is what the form says, it can't be checked here
beyond the order of the samples (`whiteness`). Left out, and counted by reason: `first_row_incomplete`, `no_input`, `input_changed`,
`too_short`; `not_received`, where rows reach t0 + dt and a state in them does not; `duplicate_stamp`, all rows on one stamp; `too_coarse`,
the rows around t0 + dt more than 1.5 dt apart, so that x1 would be made up.

CSV without segments, a log in a robot's own format (`robot_logs`), and a file with named signals (`formats`): ordinary driving
(`driving`). Several recordings at once are of one kind, and count together.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import RecordingError, UsageError
from s2r_runtime.files.canonical import digest_of, digest_of_all, digest_of_path
from s2r_runtime.files.table_text import GB, Limits, Progress, check_regular
from s2r_runtime.messages import CampaignFinished, LinkChanged, Observed, SampleTaken, Send, Started
from s2r_runtime.models.bound import wrap
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.recording.origin import other_writer
from s2r_runtime.recordings.driving import MAX_GAP, Streams, drive_transitions, resolution, state_at, streams_noise
from s2r_runtime.recordings.formats.mapping import Recorded
from s2r_runtime.recordings.formats.recognise import recognised
from s2r_runtime.recordings.formats.routes import read_recording
from s2r_runtime.recordings.robot_logs import content_digest, is_mcap, is_robot_log, merged_rows, refuse_special, sources_of
from s2r_runtime.recordings.sensor_noise import FEWEST, NORMAL_MAD
from s2r_runtime.recordings.table_rows import Subset, joined
from s2r_runtime.recordings.tables import ArrayTable, Source, header_of, read_csv
from s2r_runtime.recordings.transitions import Holds, Transitions

Array = NDArray[np.float64]

MAX_VALUES = 12_100_000
"""Numbers of a table that are used, 97 MB: two million rows of a planar robot. All that is computed from them takes four times as much."""

CHANNELS = ("event/started", "event/link_changed", "event/observed", "event/sample_taken", "event/campaign_finished", "out/send")


class _Read(NamedTuple):
    """A recording that is no log of this software. drawn: its streams are samples of a campaign. recording, content: digests."""

    streams: list[Streams]
    drawn: bool
    recording: str
    content: str
    source: str
    notes: tuple[str, ...] = ()
    subset: Subset | None = None


def load_transitions(
    path: Source | str | Sequence[Source | str],
    model: ComposedModel,
    columns: Mapping[str, str] | None = None,
    *,
    epoch: int | None = None,
    transport: Mapping[str, Any] | None = None,
    signals: Mapping[str, str] | None = None,
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> Transitions:
    """The transitions of a recording, or of several, whichever form they have. columns: model name, or `t` -> column name, where they
    differ. transport: the profile's, for a log in a robot's own format. signals: name in the model -> signal, of a file with such.
    limits, progress: of reading a table; of one with more than MAX_VALUES numbers a subset is used.

    Raises RecordingError (not readable, columns missing, of another robot), UsageError (recordings of different kinds, or one given twice).
    """
    paths = sources_of(path)
    for one in paths:
        refuse_special(one)
    own = [one for one in paths if isinstance(one, Path) and _is_own_log(one)]
    if len(own) > 1 or (own and len(paths) > 1):
        raise UsageError(f"{own[0]}: is a log of this software; the number of samples of each campaign was fixed for itself: give it alone")
    if own:
        return from_mcap(own[0], model, epoch=epoch)
    if epoch is not None:
        raise UsageError(f"{paths[0]}: a CSV has no epochs, nor has a log that is not of the daemon")
    tables = _Tables(columns or {}, MAX_VALUES // len(paths), limits, progress)
    return _together(model, [_read_one(one, model, tables, transport, signals) for one in paths])


def digest_of_source(path: Source) -> str:
    """Digest of a recording: of its bytes, or of the cells of a table in memory. Raises OSError."""
    return path.digest if isinstance(path, ArrayTable) else digest_of_path(path)


def look_at(path: Source, limits: Limits) -> None:
    """Raises RecordingError for what cannot be a recording, by its size and its beginning: before its bytes are digested.

    limits: of a table its text, of anything else all bytes, of a folder those of all its files.
    """
    from s2r_runtime.recording.writer import read

    if isinstance(path, ArrayTable):
        return
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    size = sum(check_regular(file) for file in files)
    if size > limits.text_bytes:
        raise RecordingError(f"{path}: has {size / GB:.4g} GB, at most {limits.text_bytes / GB:g} GB are read; to read more: --max-gb GB")
    if _is_own_log(path):
        if not read(path, ()).start:
            raise RecordingError(f"{path}: is no log of this software: it ends before its first record")
    elif recognised(path) is None and not is_robot_log(path):
        header_of(path, limits)


def _is_own_log(path: Path) -> bool:
    """A log of this software, or what has its suffix and cannot be told from a damaged one."""
    if path.is_dir():
        return False
    try:
        return (is_mcap(path) or path.suffix == ".mcap") and not other_writer(path) and not is_robot_log(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None


class _Tables(NamedTuple):
    """How tables are read. max_values: numbers of each that are used."""

    columns: Mapping[str, str]
    max_values: int
    limits: Limits | None = None
    progress: Progress | None = None


def _read_one(
    path: Source,
    model: ComposedModel,
    tables: _Tables,
    transport: Mapping[str, Any] | None,
    signals: Mapping[str, str] | None,
) -> _Read:
    recorded = read_recording(path, model, columns=tables.columns, transport=transport, signals=signals)
    if recorded is None:
        return _of_table(path, model, tables)
    content = content_digest(recorded.stretches, model)
    return _Read(_streams(recorded, len(model.states)), recorded.drawn, digest_of_source(path), content, str(path), recorded.notes)


def _streams(recorded: Recorded, nx: int) -> list[Streams]:
    return [Streams(t, values[:, :nx], values[:, nx:]) for t, values in map(merged_rows, recorded.stretches)]


def _together(model: ComposedModel, reads: Sequence[_Read]) -> Transitions:
    """Transitions of all recordings. Raises UsageError where one is there twice, or where samples and driving come together."""
    for k, read in enumerate(reads):
        if twin := next((one for one in reads[:k] if read.recording == one.recording or read.content == one.content), None):
            raise UsageError(f"{read.source}: is the recording {twin.source} once more (the same values); give each of them once")
        if read.drawn != reads[0].drawn:
            names = (read.source, reads[0].source) if read.drawn else (reads[0].source, read.source)
            raise UsageError(
                f"{names[0]} has segments, which count as samples, {names[1]} is ordinary driving; give recordings of one kind"
            )
    streams = [one for read in reads for one in read.streams]
    source = ", ".join(read.source for read in reads)
    recording = digest_of_all([read.recording for read in reads])
    if reads[0].drawn:
        found = _segment_transitions(model, streams, recording, source)
        found = replace(found, noise=streams_noise(model, streams))
    else:
        found = drive_transitions(model, streams, recording, source, under_way=any(read.subset for read in reads))
    found = replace(found, measured=_measured(model, streams))
    found = replace(found, subset=joined([read.subset for read in reads], [sum(len(s.t) for s in read.streams) for read in reads]))
    if len(reads) == 1:
        return replace(found, content_digest=reads[0].content, notes=reads[0].notes)
    notes = tuple(f"{Path(read.source).name}: {line}" for read in reads for line in read.notes)
    return replace(found, notes=notes, parts=tuple(one for read in reads for one in (read.recording, read.content)))


def _measured(model: ComposedModel, streams: Sequence[Streams]) -> tuple[Array, ...]:
    """States as measured, for a model that was fitted; else nobody looks at them, and they need not stay in memory."""
    return tuple(one.x for one in streams) if model.spec.fitted_on else ()


# ---------------------------------------------------------------- CSV


def from_csv(path: Path, model: ComposedModel, columns: Mapping[str, str], dt: float) -> Transitions:
    """Transitions of `dt` s (the model's step) from a CSV or CSV.gz. Raises RecordingError; UsageError if dt isn't the model's."""
    if dt != model.dt:
        raise UsageError(f"dt is {dt} s, the model's step is {model.dt} s")
    return _together(model, [_of_table(path, model, _Tables(columns, MAX_VALUES))])


def _of_table(path: Source, model: ComposedModel, how: _Tables) -> _Read:
    names = (*model.states, *model.inputs)
    table = read_csv(
        path,
        names,
        columns=how.columns,
        angles=model.nominal.angles,
        max_rows=how.max_values // (1 + len(names)),
        whole_segments=True,
        limits=how.limits,
        progress=how.progress,
    )
    nx, values = len(model.states), np.empty((len(table.t), len(names)))
    for place, name in enumerate(names):
        values[:, place] = table.columns.pop(name)
    whole = Streams(table.t, values[:, :nx], values[:, nx:])
    number = table.segment if table.segment is not None else table.piece
    parts = [whole] if number is None else _pieces(whole, number)
    return _Read(parts, table.segment is not None, table.file_digest, table.content, str(path), table.notes, table.subset)


def _pieces(whole: Streams, number: NDArray[np.int64]) -> list[Streams]:
    """Rows with the same number, in order."""
    edges = np.flatnonzero(np.diff(number, prepend=-1, append=-1))
    return [whole.rows(slice(a, b)) for a, b in pairwise(edges.tolist())]


@dataclass(frozen=True)
class _Start:
    """A segment whose first transition is there. whole_steps: of dt for which the input held and every state was received."""

    streams: Streams
    x0: Array
    u: Array
    x1: Array
    whole_steps: int


def _segment_transitions(model: ComposedModel, segments: list[Streams], recording: str, source: str) -> Transitions:
    rejected: dict[str, int] = {}
    used: list[_Start] = []
    for segment in segments:
        start = _first_transition(model, segment)
        if isinstance(start, str):
            rejected[start] = rejected.get(start, 0) + 1
        else:
            used.append(start)
    coarse = rejected.get("too_coarse", 0)
    if coarse > len(segments) / 2:
        apart = float(np.median(np.concatenate([np.diff(s.t) for s in segments])))
        raise RecordingError(
            f"{source}: rows are {apart:g} s apart, the model's step is {model.dt:g} s, so {coarse} of {len(segments)} segments show "
            "nothing of one step; is t in seconds?"
        )
    periods = min((start.whole_steps for start in used), default=1)
    held = None
    if periods > 1:
        ends = [_states_at(model, s.streams, periods) for s in used]
        if all(measured for _, measured in ends):
            held = _rows([x for x, _ in ends], len(model.states))
        else:
            periods = 1
    return Transitions(
        _rows([s.x0 for s in used], len(model.states)),
        _rows([s.u for s in used], len(model.inputs)),
        _rows([s.x1 for s in used], len(model.states)),
        held,
        max(1, periods),
        independent=True,
        rejected=rejected,
        digest=recording,
        t0_s=np.array([s.streams.t[0] for s in used]),
        source=source,
    )


def _first_transition(model: ComposedModel, s: Streams) -> _Start | str:
    """The segment's transition, or why it has none. Rows with the first row's stamp belong to it."""
    tolerance = resolution(s.t, model.dt)
    due = s.t[0] + model.dt
    first = np.searchsorted(s.t, s.t[0], side="right")
    x0, u = _first_received(s.x[:first]), _first_received(s.u[:first])
    if np.isnan(x0).any():
        return "first_row_incomplete"
    if np.isnan(u).any():
        return "no_input"
    changed = s.t[np.any(np.isfinite(s.u) & (s.u != u), axis=1)]
    until = float(changed[0]) if len(changed) else np.inf
    if until < due - tolerance:
        return "input_changed"
    last = min(float(s.t[np.isfinite(s.x[:, c])][-1]) for c in range(s.x.shape[1]))
    if last < due - tolerance:
        return _why_short(s, due - tolerance)
    x1, measured = _states_at(model, s, 1)
    if not measured:
        return "too_coarse"
    for column in model.angle_columns:
        x0[column] = wrap(x0[column])
    return _Start(s, x0, u, x1, int((min(until, last) - s.t[0] + tolerance) / model.dt))


def _why_short(s: Streams, due: float) -> str:
    """Why a state was not received until then."""
    if s.t[-1] >= due:
        return "not_received"
    return "duplicate_stamp" if len(s.t) > 1 and s.t[-1] == s.t[0] else "too_short"


def _first_received(rows: Array) -> Array:
    """(m, c) -> (c,): the last value received at the first stamp, NaN if there is none."""
    value = np.full(rows.shape[1], np.nan)
    for row in rows:
        value = np.where(np.isfinite(row), row, value)
    return value


def _states_at(model: ComposedModel, s: Streams, periods: int) -> tuple[Array, bool]:
    """(nx,) the states `periods` steps after the segment began; and whether rows near enough say so."""
    when, tolerance = s.t[:1] + periods * model.dt, resolution(s.t, model.dt)
    x, widest = np.empty(len(model.states)), 0.0
    for column in range(len(model.states)):
        angle = column in model.angle_columns
        value, width = state_at(s, column, when, angle, tolerance)
        widest = max(widest, float(width[0]))
        x[column] = wrap(value)[0] if angle else value[0]
    return x, widest <= MAX_GAP * model.dt + 2.0 * tolerance


def _rows(rows: Sequence[Array], width: int) -> Array:
    return np.array(rows) if rows else np.empty((0, width))


# ---------------------------------------------------------------- MCAP


def from_mcap(path: Path, model: ComposedModel, *, epoch: int | None = None) -> Transitions:
    """Samples of a log's campaign: the last complete one, or `epoch`. Raises RecordingError."""
    log = _read_log(path, model)
    recording = digest_of_path(path) if log.samples or any(log.rows) else ""
    if epoch is not None and epoch not in log.samples:
        there = ", ".join(str(e) for e in log.samples) or "none"
        raise RecordingError(f"{path}: has no samples of epoch {epoch}; it has samples of: {there}")
    if not log.samples:
        streams = log.stretches(model)
        found = drive_transitions(model, streams, recording, str(path))
        return replace(found, content_digest=log.identity, measured=_measured(model, streams))
    complete = [e for e in log.samples if e in log.finished and log.finished[e].complete and len(log.samples[e]) == log.finished[e].n]
    chosen = epoch if epoch is not None else (complete or list(log.samples))[-1]
    ending = log.finished.get(chosen)
    found = from_samples(list(log.samples[chosen].values()), rejected=ending.rejected if ending else {}, source=str(path))
    if found.noise is None:
        found = replace(found, noise=streams_noise(model, log.stretches(model)))
    doubt = "" if chosen in complete else _incomplete(chosen, len(log.samples[chosen]), ending)
    return replace(found, digest=recording, independent=not doubt, doubt=doubt)


def from_samples(samples: Sequence[SampleTaken], *, rejected: Mapping[str, int] | None = None, source: str = "campaign") -> Transitions:
    """Transitions of one complete campaign's samples; `digest` is that of the samples. Raises RecordingError if there are none."""
    if not samples:
        raise RecordingError(f"{source}: holds no samples")
    samples = sorted(samples, key=lambda s: s.index)
    if len({(len(s.x0), len(s.x1), len(s.u)) for s in samples}) > 1 or len(samples[0].x0) != len(samples[0].x1):
        raise RecordingError(f"{source}: its samples are not of one model: they differ in their numbers of states or inputs")
    kinds = {(len(s.held), s.periods) for s in samples}
    (width, periods), same_hold = next(iter(kinds)), len(kinds) == 1
    held = np.array([s.held for s in samples]) if same_hold and width == len(samples[0].x0) and periods > 1 else None
    data = digest_of([_recorded(s) for s in samples])
    return Transitions(
        np.array([s.x0 for s in samples], dtype=np.float64),
        np.array([s.u for s in samples], dtype=np.float64),
        np.array([s.x1 for s in samples], dtype=np.float64),
        held,
        periods if held is not None else 1,
        independent=True,
        rejected=dict(rejected or {}),
        digest=data,
        t0_s=np.array([s.t0_ns * 1e-9 for s in samples]),
        source=source,
        samples_digest=data,
        noise=_standing_noise(samples),
        holds=_holds(samples) if all(s.lasts_ns for s in samples) else None,
    )


def _recorded(s: SampleTaken) -> list[Any]:
    """What a sample's digest covers."""
    found = [s.u, s.x0, s.x1, s.held, s.periods]
    return [*found, s.lasts_ns, s.period, s.start, s.start_ns, s.hold_ns, s.past_u, s.past_ns] if s.lasts_ns else found


def _holds(samples: Sequence[SampleTaken]) -> Holds:
    """The holds that samples were taken from. Under which law: a hold's first period in all of them, or any."""
    nu = len(samples[0].u)
    seconds = np.array([(s.lasts_ns, s.t0_ns - s.start_ns, s.hold_ns) for s in samples], dtype=np.float64) * 1e-9
    past = tuple((np.array(s.past_ns, dtype=np.float64) * 1e-9, np.array(s.past_u, dtype=np.float64).reshape(-1, nu)) for s in samples)
    start = np.array([s.start for s in samples], dtype=np.float64)
    return Holds(seconds[:, 0], seconds[:, 1], start, seconds[:, 2], past, "random" if any(s.period for s in samples) else "first")


def _standing_noise(samples: Sequence[SampleTaken]) -> Array | None:
    """(nx,) from two observations of the robot at rest before each sample; the median doesn't mind angles that jump at the cut."""
    if len(samples) < FEWEST or not all(len(s.before) == len(s.x0) for s in samples):
        return None
    spread = np.median(np.abs(np.array([s.start or s.x0 for s in samples]) - np.array([s.before for s in samples])), axis=0)
    return np.asarray(spread / (NORMAL_MAD * np.sqrt(2.0))) if np.all(spread > 0.0) else None


@dataclass
class _Log:
    """What a log holds of states, inputs and samples (by epoch and index), in its order.

    rows: of each stretch (a new one wherever the robot's clock went back or its link changed: it may have been restarted) stamp in s, x and
    u, one number after the other, NaN where there is none: a long log is millions of them. identity: of the run, which a model remembers
    that was fitted on its driving (guarantee G6).
    """

    samples: dict[int, dict[int, SampleTaken]]
    finished: dict[int, CampaignFinished]
    rows: list[array[float]]
    identity: str = ""

    def stretches(self, model: ComposedModel) -> list[Streams]:
        """Measured states and inputs sent, by the robot's stamps."""
        nx, found = len(model.states), []
        for rows in self.rows:
            table = np.frombuffer(rows, dtype=np.float64).reshape(-1, 1 + nx + len(model.inputs))
            table = table[np.argsort(table[:, 0], kind="stable")]
            if len(table):
                found.append(Streams(table[:, 0], table[:, 1 : 1 + nx], table[:, 1 + nx :]))
        return found


def _read_log(path: Path, model: ComposedModel) -> _Log:
    from s2r_runtime.recording.stretches import log_identity
    from s2r_runtime.recording.writer import read

    log = _Log({}, {}, [array("d")])
    no_x, no_u = (np.nan,) * len(model.states), (np.nan,) * len(model.inputs)
    reading = read(path, CHANNELS)
    log.identity = log_identity(reading.run, reading.public_key)
    seen: dict[int, tuple[int, int]] = {}  # seq -> (daemon's clock, robot's clock), both ns: when the last observation came
    for entry in reading:
        match entry.message:
            case Started() as started:
                _check_robot(path, model, started)
            case LinkChanged():
                seen.clear()
                log.rows.append(array("d"))
            case Observed(t_ns, observation) if not observation.fault:
                if seen and observation.stamp_ns < next(iter(seen.values()))[1]:
                    log.rows.append(array("d"))
                seen = {observation.seq: (t_ns, observation.stamp_ns)}
                _check_width(path, "observations", observation.x, model.states)
                log.rows[-1].extend((observation.stamp_ns * 1e-9, *observation.x, *no_u))
            case Send() as send if send.obs_seq in seen:
                heard_ns, stamp_ns = seen[send.obs_seq]
                _check_width(path, "commands", send.u, model.inputs)
                log.rows[-1].extend(((stamp_ns + max(0, send.t_ns - heard_ns)) * 1e-9, *no_x, *send.u))
            case SampleTaken() as sample:
                log.samples.setdefault(sample.epoch, {}).setdefault(sample.index, sample)  # one logged once more is the same
            case CampaignFinished() as finished:
                log.finished[finished.epoch] = finished
    if reading.ending is not None and reading.ending.kind == "broken":
        raise RecordingError(f"{path}: is damaged {reading.ending.detail}")
    return log


def _check_width(path: Path, what: str, values: tuple[float, ...], names: tuple[str, ...]) -> None:
    if len(values) != len(names):
        raise RecordingError(f"{path}: has {what} of {len(values)} numbers, the model has {', '.join(names)}")


def _check_robot(path: Path, model: ComposedModel, started: Started) -> None:
    had = started.settings
    for what, recorded, wanted in (("states", had.states, model.states), ("inputs", had.inputs, model.inputs)):
        if recorded != wanted:
            raise RecordingError(f"{path}: was recorded with the {what} {', '.join(recorded)}; the model has {', '.join(wanted)}")
    if abs(had.dt_ns * 1e-9 - model.dt) > 1e-6 * model.dt:
        raise RecordingError(f"{path}: was recorded with a step of {had.dt_ns * 1e-9:g} s; the model's is {model.dt:g} s")


def _incomplete(epoch: int, n: int, ending: CampaignFinished | None) -> str:
    if ending is None:
        return f"campaign {epoch} did not end in this log ({n} samples), so N was not fixed beforehand"
    if not ending.complete:
        return f"campaign {epoch} was ended after {n} samples, before all that were fixed beforehand were there"
    return f"the log holds {n} of the {ending.n} samples of campaign {epoch}"
