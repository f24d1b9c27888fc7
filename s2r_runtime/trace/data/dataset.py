"""A recording on a model's grid: measured states dt apart, and the input over every step, finer where it changes within one.

    y_k = state at t_0 + k dt, (K+1, nx), angles unwrapped, NaN where nothing was measured
    u   = the commanded input, constant over parts of dt/S, (K S, nu); each is the mean of the held commands over its part

States and inputs may come on stamps of their own. Where states were recorded dt apart (or a whole fraction of it) the grid lies on the
recorded rows. Where they were not, each point of the grid takes the nearest row, and a step lasts as long as its two rows are apart.
Where inputs change on the grid only, S = 1. A run begins with the inputs that were there before its first state, if any were.

Steps are independent of each other if states are measured that often, and are not made of their neighbours by a filter. Where they
are not, `thinned` gives the steps, some times longer, that are. Nothing is interpolated between two rows of all states: a wheel that
changes its speed at once would look slow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import NotEnoughEvidence, RecordingError
from s2r_runtime.models.composed import SUBSTEPS, ComposedModel
from s2r_runtime.models.input_chains import Inputs
from s2r_runtime.recordings.table_rows import Subset
from s2r_runtime.recordings.tables import LARGEST
from s2r_runtime.recordings.transitions import Transitions
from s2r_runtime.trace.data.input_interpolation import Way
from s2r_runtime.trace.data.reconstruction import Reconstruction, at_step, independent_step, snapped
from s2r_runtime.trace.data.streams import (
    ALIGNED,
    Stream,
    at_grid,
    changes,
    complete,
    fresh,
    held,
    held_between,
    held_means,
    nearest,
    on_grid,
    turned,
    unwrapped,
)

__all__ = ["Dataset", "Pause", "Run", "Stream", "from_arrays", "from_streams", "thinned"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PARTS = (10, 12)
"""Least and most parts of a step where inputs change within steps. A change within a part counts as a mean over it, which spreads it as a
lag would: of a delay and a lag of a step each, parts of a quarter make the one longer and the other shorter by a hundredth of a step, far
outside their intervals where there is little noise. Even, so that a grid half as fine tells what is left of that (`discretisation_error`).
"""

MOST_ROWS, EVEN = 12, 0.02
"""Rows of inputs in a step up to which parts are whole shares of a row, where the rows go evenly into a step: a part that lies across two
rows has the mean of both, and its end is known no better.
"""

PAUSE_S = 20.0
"""A recording that is silent for longer than this (or 200 steps) is two runs: what the robot did meanwhile is not known."""

NEAREST = 1.1
"""Rows at most this many steps apart nearly all have a point of the grid; where they are farther apart, the step is as long as they are."""

SLOWEST, THINNED = 1.5, 3.2
"""Rows farther apart than this many steps do not give every step, and several are taken as one; farther apart than so many, the step was
meant for another recording."""

MOST_PARTS = 2
"""Parts of a step that is many of the model's at most: what an input does within it is then placed to a quarter of it, and more would cost
as much more and ask of a measured robot what no model of it holds.
"""

FINER_PARTS = 8
"""The same, where what is left may be of what an input does within such parts."""

LONG_S = 0.04
"""Steps longer than this are taken in parts where speeds were not measured: a position says when within a step a force acted."""

SILENT, OFTEN = 0.8, 3.0
"""Of a pause of the states that no input comes in, for nothing to have been received; and times as long as inputs usually are apart, if
some came in the rest of it.
"""

BEFORE = 600
"""Steps before the first state for which inputs are kept at most: hidden states have settled then."""


@dataclass(frozen=True)
class Pause:
    """No states between two stamps of a run, seconds; states before and after, (nx,). silent: nor anything else, or nearly."""

    from_s: float
    to_s: float
    run: int
    usual_s: float
    before: Array
    after: Array
    silent: bool = True


@dataclass(frozen=True)
class Run:
    """One contiguous stretch. start_s: of its first row; y: (K+1, nx); u: (K S, nu); lasts: (K,) s, of each step (None: dt).
    turned: (K, nu) steps in whose last part an input changes (`streams.turned`; None: in none). segment: which of the recording's it is of.
    """

    start_s: float
    y: Array
    u: Array
    lasts: Array | None = None
    turned: Mask | None = None
    segment: int = 0

    def durations(self, dt: float) -> Array:
        """(K,) s, of each step."""
        return np.full(len(self.y) - 1, dt) if self.lasts is None else self.lasts

    def begins(self, dt: float) -> Array:
        """(K,) s since the recording's first stamp, of each step."""
        lasts = self.durations(dt)
        return np.asarray(self.start_s + (dt * np.arange(len(lasts)) if self.lasts is None else np.cumsum(lasts) - lasts))


@dataclass(frozen=True)
class Dataset:
    """What the tracer works on. digests: of the recording's files (guarantee G6); rows: stamps at which states were measured; origin_s: the
    stamp from which times count. apart: steps that make one which is independent of the next. interval: s between rows, as recorded.
    segments: as received. campaign: its samples, if they are known besides (else they are looked for in `paths`).
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dt: float
    substeps: int
    runs: tuple[Run, ...]
    rows: int
    source: str
    digests: tuple[str, ...] = ()
    pauses: tuple[Pause, ...] = ()
    paths: tuple[Path, ...] = field(default=(), repr=False)
    origin_s: float = 0.0
    reconstruction: Reconstruction | None = None
    apart: float = 1
    interval: float = 0.0
    segments: tuple[tuple[Stream, Stream], ...] = field(default=(), repr=False)
    in_parts: bool = False
    """The model takes each of the S parts of a step by itself: its own steps are that much shorter."""
    campaign: Transitions | None = field(default=None, repr=False)
    way: Way = field(default_factory=Way)
    """How inputs went that the recording has samples of (`input_hold`)."""
    noisy: dict[str, float] = field(default_factory=dict)
    """Standard deviations of the noise that was taken out of inputs for that."""
    commanded: bool = False
    """The inputs are known to be what was commanded: a log of ours says what was sent."""
    measured_forces: bool = False
    """The inputs are forces that were measured, with noise of their own, and not commanded (`measured_forces`)."""
    behind: dict[str, float] = field(default_factory=dict)
    """s by which states came late against others, and were taken earlier (`pose_latency`)."""
    from_first: bool = False
    """The first rows of runs count, whatever the model makes of them: the tracer found nothing that remembers what was before."""
    unplaced: bool = False
    """Commands changed between rows, nobody knows when: transitions in which one does are left out (`command_timing`)."""
    called: tuple[str, ...] = ()
    """Names of its segments; empty if it has one, or none has a name."""
    subset: Subset | None = None
    """Which rows of a long recording are here; None: all."""
    notes: tuple[str, ...] = ()
    """What a person should know of how the recording was read, one line each."""
    forgetting: tuple[tuple[float, float], ...] = ()
    """From and to, s: first rows of runs that are left out, in which something may act on that nobody recorded (`initial_conditions`)."""

    @cached_property
    def chains(self) -> Inputs:
        """The inputs of its runs, for chains of effects."""
        lasts = [np.repeat(run.durations(self.dt) / self.substeps, self.substeps) for run in self.runs] if self.uneven else None
        starts, turned = [run.start_s for run in self.runs], [run.turned for run in self.runs]
        return Inputs([run.u for run in self.runs], self.dt / self.substeps, starts, lasts, self.substeps, turned)

    def segment_of(self, run: int) -> str:
        """What the recording calls the segment that a run is of, or nothing."""
        return self.called[self.runs[run].segment] if self.called else ""

    @property
    def uneven(self) -> bool:
        """Whether steps do not all last dt."""
        return any(run.lasts is not None for run in self.runs)

    @cached_property
    def turned(self) -> Mask | None:
        """(M, nu) of all runs' steps; None where no input changes within the last part of a step."""
        if all(run.turned is None for run in self.runs):
            return None
        return np.concatenate(
            [np.zeros((len(run.y) - 1, len(self.inputs)), bool) if run.turned is None else run.turned for run in self.runs]
        )

    @cached_property
    def axes_without_speed(self) -> tuple[tuple[int, int], ...]:
        """Columns (position, speed) of axes whose speed is no measurement (`reconstruction`)."""
        pairs = self.reconstruction.axes if self.reconstruction else ()
        return tuple((self.states.index(p), self.states.index(v)) for p, v in pairs)

    @cached_property
    def in_order(self) -> bool:
        """Whether runs have times of their own: where each begins at zero, nobody knows when what happened."""
        spans = []
        for run in self.runs:
            there = np.flatnonzero(~np.isnan(run.y).any(axis=1))
            if len(there):
                spans.append((run.start_s + self.dt * int(there[0]), run.start_s + self.dt * int(there[-1])))
        return all(later[0] > earlier[1] - 1.5 * self.dt for earlier, later in pairwise(sorted(spans)))


def from_arrays(model: ComposedModel, runs: Sequence[tuple[Array, Array]], source: str = "arrays") -> Dataset:
    """Runs of (y (K+1, nx), u (K, nu)), exactly dt apart. Angles may be wrapped or not; NaN is a state that was not measured.

    Raises RecordingError for other shapes, and for what is no number.
    """
    parts = least_parts(model)
    start, made = 0.0, []
    for place, (y, u) in enumerate(runs):
        _fits(model, np.asarray(y), np.asarray(u), f"{source}: run {place}")
        made.append(Run(start, unwrapped(np.array(y, dtype=np.float64), model.angle_columns), np.repeat(u, parts, axis=0)))
        start += (len(y) + 1) * model.dt
    return Dataset(model.states, model.inputs, model.dt, parts, tuple(made), sum(len(r.y) for r in made), source)


def _fits(model: ComposedModel, y: Array, u: Array, where: str) -> None:
    """Raises RecordingError if a run is none of this model."""
    nx, nu = len(model.states), len(model.inputs)
    if y.ndim != 2 or u.shape != (len(y) - 1, nu) or y.shape[1] != nx:
        raise RecordingError(f"{where}: states {y.shape} and inputs {u.shape}, must be (K + 1, {nx}) and (K, {nu})")
    for values, names, what in ((y, model.states, "finite or NaN (not measured)"), (u, model.inputs, "finite")):
        wrong = ~(np.abs(values) <= LARGEST) if names is model.inputs else np.abs(values) > LARGEST
        for row, column in np.argwhere(wrong)[:1].tolist():
            raise RecordingError(f"{where}: row {row}: {names[column]} is {values[row, column]:g}, must be {what}, within {LARGEST:g}")


def from_streams(
    model: ComposedModel,
    segments: Sequence[tuple[Stream, Stream]],
    source: str,
    digests: tuple[str, ...] = (),
    paths: tuple[Path, ...] = (),
    reconstruction: Reconstruction | None = None,
    in_parts: int = 0,
    substeps: int = 0,
) -> Dataset:
    """Segments of (states, inputs), both as received. reconstruction: what was done to them before. in_parts: S, if the model
    is to take each part of a step by itself; substeps: S, if it is known, and the model takes steps whole.

    Raises RecordingError if states come too seldom for the model's dt, or never, or inputs at another time, NotEnoughEvidence if states
    were measured at one moment only.
    """
    dt = model.dt
    pieces = _stretches(model, segments, source)
    stretches = [part for _, part in pieces]
    spacing = _spacing(stretches, dt, source)
    apart = _apart(spacing / dt)
    if reconstruction is not None:
        each = apart if apart <= SLOWEST else 1  # a grid between the rows would take some twice as far apart as others
        apart = max(apart, each * math.ceil(independent_step(reconstruction, dt) / each))
    exact = all(on_grid(states.t, dt) for states, _ in stretches)
    parts = in_parts or substeps or _parts(model, stretches, exact)
    origin = min(_first(states) for states, _ in segments)
    laid = _on_the_grid if exact else _as_recorded
    runs = [laid(model, states, inputs, parts, origin) for states, inputs in stretches]
    return Dataset(
        states=model.states,
        inputs=model.inputs,
        dt=dt,
        substeps=parts,
        runs=tuple(replace(run, segment=k) for run, (k, _) in zip(runs, pieces, strict=True)),
        rows=sum(len(states.t) for states, _ in stretches),
        source=source,
        digests=digests,
        pauses=tuple(p for i, (states, inputs) in enumerate(stretches) for p in _pauses(states, inputs.t, i, spacing, origin, dt)),
        paths=paths,
        origin_s=origin,
        reconstruction=reconstruction,
        apart=apart,
        interval=reconstruction.interval if reconstruction else snapped(spacing, dt),
        segments=tuple(segments),
        in_parts=in_parts > 0,
    )


def _apart(steps: float) -> float:
    """Steps of the model that are taken as one, where rows are so many of them apart."""
    if steps > SLOWEST:
        return math.ceil(steps - ALIGNED)
    return steps if steps > NEAREST + ALIGNED else 1


def _stretches(model: ComposedModel, segments: Sequence[tuple[Stream, Stream]], source: str) -> list[tuple[int, tuple[Stream, Stream]]]:
    """What is in one piece, and long enough for a step, each with the segment that it is of. Raises NotEnoughEvidence if there is one
    moment only, RecordingError if nothing is long enough, or clocks or units of time differ.
    """
    for states, inputs in segments:
        _check_same_clock(states, inputs, source)
    _check_seconds(segments, model.dt, source)
    pieces = [(k, part) for k, (states, inputs) in enumerate(segments) for part in _split(states, inputs, model)]
    pieces = [(k, part) for k, part in pieces if len(part[0].t) >= 2 and part[0].t[-1] - part[0].t[0] > 0.5 * model.dt]
    if not pieces:
        longest = max((float(states.t[-1] - states.t[0]) for states, _ in segments if len(states.t)), default=-1.0)
        if longest < 0.0:
            raise RecordingError(f"{source}: has no row on which a state was measured")
        if longest == 0.0:
            rows, each = sum(len(states.t) for states, _ in segments), "" if len(segments) == 1 else " of each run"
            raise NotEnoughEvidence(
                f"{source}: a state was measured at one moment{each} only, on {rows} row{'s' if rows != 1 else ''}; how it changes is told "
                f"by rows that are a step of the model, {model.dt:g} s, apart"
            )
        raise RecordingError(
            f"{source}: no two rows on which a state was measured are a step of the model, {model.dt:g} s, apart: the longest run lasts "
            f"{longest:g} s"
        )
    return pieces


def _spacing(stretches: Sequence[tuple[Stream, Stream]], dt: float, source: str) -> float:
    """Usual interval of the states, s: that of half of the time, or longer, so that all rows count; a run's own where they differ. Runs in
    which rows are too rare for the model's step decide nothing, unless most rows are in these: then RecordingError.
    """
    each = np.array([np.median(np.diff(states.t)) for states, _ in stretches])
    lasts = np.array([states.t[-1] - states.t[0] for states, _ in stretches])
    rows = np.array([len(states.t) for states, _ in stretches])
    often = each <= THINNED * dt
    asked = often if 2 * rows[often].sum() >= rows.sum() else ~often
    slower = np.flatnonzero(asked)[np.argsort(-each[asked])]
    sofar = np.cumsum(lasts[slower])
    spacing = float(each[slower[np.searchsorted(sofar, 0.5 * sofar[-1] * (1.0 - 1e-9))]])
    if spacing > THINNED * dt:
        raise RecordingError(
            f"{source}: states are {spacing:.4g} s apart, the model's step is {dt:g} s; give a step of at least {spacing:.4g} s"
        )
    return spacing


def _early(states: Stream, inputs: Stream, dt: float) -> int:
    """Steps before the first state of which the inputs are known."""
    early = math.ceil((float(states.t[0]) - inputs.t[0]) / dt - ALIGNED) if len(inputs.t) else 0
    return min(max(early, 0), BEFORE)


def _as_recorded(model: ComposedModel, states: Stream, inputs: Stream, parts: int, origin: float) -> Run:
    """A run on the rows nearest to the model's steps, each step as long as its rows are apart."""
    t0, early = float(states.t[0]), _early(states, inputs, model.dt)
    y, at = nearest(states, model.dt, model.angle_columns)
    at = np.concatenate([t0 - model.dt * np.arange(early, 0, -1), at])
    u, lasts, late = held_between(inputs, at, parts), np.diff(at), turned(inputs, at, parts)
    return Run(t0 - early * model.dt - origin, _after(early, y), u, lasts, late)


def _on_the_grid(model: ComposedModel, states: Stream, inputs: Stream, parts: int, origin: float) -> Run:
    """A run on rows that lie on the model's steps."""
    dt, t0, early = model.dt, float(states.t[0]), _early(states, inputs, model.dt)
    y = at_grid(states, dt, model.angle_columns)
    u = held_means(inputs, t0 - early * dt, len(y) - 1 + early, dt, parts)
    at = np.asarray(t0 + dt * np.arange(-early, len(y)), dtype=np.float64)
    late = turned(inputs, at, parts, ALIGNED * dt) if parts > 1 else None
    return Run(t0 - early * dt - origin, _after(early, y), u, None, late)


def _after(early: int, y: Array) -> Array:
    """States behind steps in which nobody measured any."""
    return np.concatenate([np.full((early, y.shape[1]), np.nan), y])


def regridded(data: Dataset, model: ComposedModel, in_parts: int = 0, substeps: int = 0) -> Dataset:
    """The same recording on the grid of a model with another step. in_parts, substeps: as `from_streams`."""
    again = from_streams(model, data.segments, data.source, data.digests, data.paths, data.reconstruction, in_parts, substeps)
    again = replace(again, commanded=data.commanded, measured_forces=data.measured_forces, called=data.called)
    return replace(again, way=data.way, noisy=data.noisy, behind=data.behind, from_first=data.from_first, unplaced=data.unplaced)


def thinned(
    model: ComposedModel, data: Dataset, test: Dataset | None = None, parts: int | None = None
) -> tuple[ComposedModel, Dataset, Dataset | None]:
    """The same on the shortest steps that are independent of each other in both: unchanged, if they are, unless `parts` of them are asked
    for. parts: S, or None for as many as are usual where steps were made longer.
    """
    apart = max(data.apart, test.apart if test else 1)
    whole = data.reconstruction is None or data.interval * MOST_PARTS > data.dt
    made = data.reconstruction  # a hidden state's model may be one of whole steps: what is too coarse is asked of the model itself
    if parts is None and apart == 1 and whole and not (made and made.axes and not made.hidden and data.dt > LONG_S):
        return model, data, test
    longer = at_step(model, apart * model.dt)

    def again(one: Dataset) -> Dataset:
        if apart > 1:
            return regridded(one, longer, parts or (MOST_PARTS if apart > SLOWEST else 0))
        if not one.segments:  # arrays: inputs change with their rows
            return one
        return replace(regridded(one, longer, parts or MOST_PARTS), campaign=one.campaign)  # the step is the same, and so are its samples

    return longer, again(data), again(test) if test else None


def in_finer_parts(data: Dataset, model: ComposedModel) -> Dataset | None:
    """The same with each step taken in the parts that its inputs have, or in more of them if it is so already and inputs change within
    those; None if they do not, or where a hidden state was told by whole steps.
    """
    told_by_whole = data.reconstruction is not None and data.reconstruction.hidden
    if not data.segments or (told_by_whole and not data.in_parts):
        return None
    if not data.in_parts:
        finer = max(data.substeps, 2 * MOST_PARTS)  # more than there are of a step that was made longer
        return regridded(data, model, finer) if data.substeps > 1 and _changes(data, data.substeps) else None
    spacing = float(np.median(np.concatenate([np.diff(inputs.t) for _, inputs in data.segments])))
    times = math.floor(min(FINER_PARTS, data.dt / spacing + ALIGNED) / data.substeps) if spacing > 0.0 else 0
    if times < 2:
        return None
    finer_still = regridded(data, model, times * data.substeps)
    return finer_still if _changes(finer_still, times) else None


def _changes(data: Dataset, parts: int) -> bool:
    """Whether inputs change within so many parts of a step that lie together."""
    return any(bool(np.any(np.ptp(run.u.reshape(-1, parts, run.u.shape[1]), axis=1))) for run in data.runs)


def least_parts(model: ComposedModel) -> int:
    """S for inputs that change between steps only: 1, unless effects may meet something for which the order within a step matters."""
    straight = all(a.effect.stage != "input" or getattr(a.effect, "linear", False) for a in model.effects)
    return 1 if straight and not getattr(model.nominal, "reached", None) else SUBSTEPS


def _first(states: Stream) -> float:
    """Stamp of the first measured state, s; infinity if there is none. Another state may come on rows of its own, a little later."""
    there = ~np.isnan(states.values).all(axis=1)
    return float(states.t[np.argmax(there)]) if there.any() else math.inf


def _check_same_clock(states: Stream, inputs: Stream, source: str) -> None:
    """Raises RecordingError if no input can have acted while states were measured."""
    if not len(states.t) or not len(inputs.t):
        return
    (a, b), (c, d) = (states.t[0], states.t[-1]), (inputs.t[0], inputs.t[-1])
    if c > b or d < a - max(PAUSE_S, b - a):
        raise RecordingError(
            f"{source}: states were measured from {a:.6g} s to {b:.6g} s, inputs given from {c:.6g} s to {d:.6g} s: "
            "their stamps must be of one clock"
        )


def _check_seconds(segments: Sequence[tuple[Stream, Stream]], dt: float, source: str) -> None:
    """Raises RecordingError if stamps are a usual factor too large to be seconds of this model's steps."""
    apart = np.concatenate([np.diff(states.t) for states, _ in segments])
    if not np.any(apart > 0.0):
        return
    spacing = float(np.median(apart[apart > 0.0]))
    for unit, factor in (("ms", 1e3), ("µs", 1e6), ("ns", 1e9)):
        if 1.0 / THINNED < spacing / factor / dt < THINNED:
            raise RecordingError(
                f"{source}: t seems to be in {unit}, must be in s: states are {spacing:.4g} apart, the model's step is {dt:g} s"
            )


def _split(states: Stream, inputs: Stream, model: ComposedModel) -> list[tuple[Stream, Stream]]:
    """At long silences."""
    states = fresh(states)
    states = Stream(states.t, unwrapped(states.values, model.angle_columns))  # what lies between two headings is no turn back
    states = complete(states, inputs, lambda x, u: _rates(model, x, u))
    cut = np.flatnonzero(np.diff(states.t) > max(PAUSE_S, 200.0 * model.dt)) + 1
    given = []
    for rows in np.split(np.arange(len(states.t)), cut):
        t = states.t[rows]
        if len(t):
            given.append((Stream(t, states.values[rows]), _received(inputs, t)))
    return given


def _rates(model: ComposedModel, x: Array, u: Array) -> Array:
    """What the nominal model makes of states (N, nx) and inputs, per s; zero for states that are set at once."""
    nominal, h = model.nominal, 1e-3 * model.dt
    rates = (nominal.step(x, u, h, nominal.parameters) - x) / h
    rates[:, [model.states.index(name) for name in getattr(nominal, "reached", {})]] = 0.0
    return rates


def _received(inputs: Stream, t: Array) -> Stream:
    """The inputs of a stretch of states, from a while before it on; or with the last one before, which holds."""
    inside = (inputs.t >= t[0] - PAUSE_S) & (inputs.t <= t[-1])
    before = int(np.searchsorted(inputs.t, t[0], side="right"))
    if not before or (inside.any() and inputs.t[inside][0] <= t[0]):
        return Stream(inputs.t[inside], inputs.values[inside])
    return Stream(np.append(t[0], inputs.t[inside]), np.concatenate([held(inputs.values[:before])[-1:], inputs.values[inside]]))


def _parts(model: ComposedModel, stretches: Sequence[tuple[Stream, Stream]], exact: bool) -> int:
    """S: into how many parts a step is cut."""
    least = least_parts(model)
    spacing = []
    aligned = True
    for states, inputs in stretches:
        at = changes(inputs)
        place = (at - states.t[0]) / model.dt
        if not exact:  # a step ends where its row is
            _, ends = nearest(states, model.dt, model.angle_columns)
            place = np.interp(at, ends, np.arange(len(ends)))
        off = np.abs(place - np.rint(place)) > ALIGNED
        aligned = aligned and bool(np.count_nonzero(off) <= 0.01 * len(place))
        spacing += np.diff(inputs.t)[np.diff(inputs.t) > 0.0].tolist()
    if aligned:
        return least
    rows = model.dt / float(np.median(spacing)) if spacing else 1.0
    whole = round(rows)
    if 1 < whole <= MOST_ROWS and abs(rows - whole) < EVEN * whole:
        return whole * math.ceil(max(least, PARTS[0]) / whole)
    return max(least, PARTS[rows - ALIGNED > PARTS[0]])


def _pauses(states: Stream, stamps: Array, run: int, usual: float, origin: float, dt: float) -> list[Pause]:
    """Intervals between states clearly longer than usual, and than a step. stamps: of the inputs."""
    t, v, found = states.t, states.values, []
    rate = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    for i in np.flatnonzero(np.diff(t) > max(1.7 * usual, 1.5 * dt)).tolist():
        near = 0.1 * usual
        between = stamps[(stamps > t[i] + near) & (stamps < t[i + 1] - near)]  # a few may come before all is silent, or after
        longest = float(np.max(np.diff(np.concatenate([t[i : i + 1], between, t[i + 1 : i + 2]]))))
        silent = longest >= SILENT * float(t[i + 1] - t[i]) and (not len(between) or longest > OFTEN * rate)
        found.append(Pause(float(t[i] - origin), float(t[i + 1] - origin), run, usual, v[i], v[i + 1], silent))
    return found
