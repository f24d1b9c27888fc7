"""A recording on a model's grid: measured states dt apart, and the input over every step, finer where it changes within one.

    y_k = state at t_0 + k dt, (K+1, nx), angles unwrapped, NaN where nothing was measured
    u   = the commanded input, constant over parts of dt/S, (K S, nu); each is the mean of the held commands over its part

States and inputs may come on stamps of their own. Where states were recorded dt apart (or a whole fraction of it) the grid lies on the
recorded rows and nothing is interpolated; else they are interpolated linearly between neighbours that are close enough. Where
inputs change on the grid only, S = 1. An input holds until the next one and is zero before the first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import SUBSTEPS, ComposedModel

Array = NDArray[np.float64]

ALIGNED = 0.02
"""A stamp this part of dt away from the grid counts as on it: stamps are printed with a few digits."""

PARTS = (4, 6)
"""Least and most parts of a step where inputs change within steps."""

PAUSE_S = 20.0
"""A recording that is silent for longer than this (or 200 steps) is two runs: what the robot did meanwhile is not known."""

SLOWEST = 1.5
"""Rows farther apart than this many steps cannot be turned into steps of dt."""


@dataclass(frozen=True)
class Stream:
    """t: (N,) s, ascending; values: (N, c). NaN where a column was not received."""

    t: Array
    values: Array


@dataclass(frozen=True)
class Pause:
    """No states between two stamps of a run, seconds; states before and after, (nx,). silent: nor any input."""

    from_s: float
    to_s: float
    run: int
    usual_s: float
    before: Array
    after: Array
    silent: bool = True


@dataclass(frozen=True)
class Run:
    """One contiguous stretch. start_s: its first stamp; y: (K+1, nx); u: (K S, nu)."""

    start_s: float
    y: Array
    u: Array


@dataclass(frozen=True)
class Dataset:
    """What the tracer works on. digests: of the recording's files (guarantee G6); rows: stamps at which states were measured; origin_s: the
    stamp from which times count.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dt: float
    substeps: int
    runs: tuple[Run, ...]
    interpolated: bool
    rows: int
    source: str
    digests: tuple[str, ...] = ()
    pauses: tuple[Pause, ...] = ()
    paths: tuple[Path, ...] = field(default=(), repr=False)
    origin_s: float = 0.0


def from_arrays(model: ComposedModel, runs: Sequence[tuple[Array, Array]], source: str = "arrays") -> Dataset:
    """Runs of (y (K+1, nx), u (K, nu)), exactly dt apart. Angles may be wrapped or not."""
    parts = least_parts(model)
    start, made = 0.0, []
    for y, u in runs:
        made.append(Run(start, _unwrapped(np.array(y, dtype=np.float64), model.angle_columns), np.repeat(u, parts, axis=0)))
        start += (len(y) + 1) * model.dt
    return Dataset(model.states, model.inputs, model.dt, parts, tuple(made), False, sum(len(r.y) for r in made), source)


def from_streams(
    model: ComposedModel,
    segments: Sequence[tuple[Stream, Stream]],
    source: str,
    digests: tuple[str, ...] = (),
    paths: tuple[Path, ...] = (),
) -> Dataset:
    """Segments of (states, inputs). Raises RecordingError if states come too seldom for the model's dt, or never."""
    stretches = [part for states, inputs in segments for part in _split(states, inputs, model.dt)]
    stretches = [part for part in stretches if len(part[0].t) >= 2]
    if not stretches:
        raise RecordingError(f"{source}: has no two rows on which a state was measured")
    dt = model.dt
    usual = [float(np.median(np.diff(states.t))) for states, _ in stretches]
    spacing = float(np.median(usual))
    if spacing > SLOWEST * dt:
        raise RecordingError(
            f"{source}: states are {spacing:.4g} s apart, the model's step is {dt:g} s; give a step of at least {spacing:.4g} s"
        )
    exact = all(_on_grid(states.t, dt) for states, _ in stretches)
    parts = _parts(model, stretches, exact)
    origin = min(float(states.t[0]) for states, _ in stretches)
    runs: list[Run] = []
    pauses: list[Pause] = []
    for states, inputs in stretches:
        t0 = float(states.t[0])
        pauses += _pauses(states, inputs.t, len(runs), spacing, origin, dt)
        y = _grid_exact(states, dt) if exact else _grid_interpolated(states, dt, model.angle_columns, spacing)
        u = _grid_inputs(inputs, t0, len(y) - 1, dt, parts)
        runs.append(Run(t0 - origin, _unwrapped(y, model.angle_columns), u))
    rows = sum(len(states.t) for states, _ in stretches)
    return Dataset(model.states, model.inputs, dt, parts, tuple(runs), not exact, rows, source, digests, tuple(pauses), paths, origin)


def least_parts(model: ComposedModel) -> int:
    """S for inputs that change between steps only: 1, unless effects may meet something for which the order within a step matters."""
    straight = all(a.effect.stage != "input" or getattr(a.effect, "linear", False) for a in model.effects)
    return 1 if straight and not getattr(model.nominal, "reached", None) else SUBSTEPS


def columns_of(model: ComposedModel, columns: Mapping[str, str]) -> dict[str, str]:
    """Name in the model -> column of the recording."""
    return {name: columns.get(name, name) for name in (*model.states, *model.inputs)}


def _split(states: Stream, inputs: Stream, dt: float) -> list[tuple[Stream, Stream]]:
    """At long silences. States: rows where all are there if that is most of them, else each interpolated on the union."""
    states = _complete(states)
    cut = np.flatnonzero(np.diff(states.t) > max(PAUSE_S, 200.0 * dt)) + 1
    parts = np.split(np.arange(len(states.t)), cut)
    given = []
    for rows in parts:
        t = states.t[rows]
        if len(t):
            inside = (inputs.t >= t[0] - PAUSE_S) & (inputs.t <= t[-1])
            given.append((Stream(t, states.values[rows]), Stream(inputs.t[inside], inputs.values[inside])))
    return given


def _complete(states: Stream) -> Stream:
    """Rows on which every state is known, one a stamp (the last)."""
    there = ~np.isnan(states.values)
    whole = there.all(axis=1)
    fewest = int(there.sum(axis=0).min(initial=len(states.t)))
    if fewest and np.count_nonzero(whole) < 0.8 * fewest:  # states on different stamps: bring all to those of the slowest
        slow = int(np.argmin(there.sum(axis=0)))
        t = states.t[there[:, slow]]
        values = np.column_stack([np.interp(t, states.t[m], states.values[m, j]) for j, m in enumerate(there.T)])
        return _last_of_each(Stream(t, values))
    return _last_of_each(Stream(states.t[whole], states.values[whole]))


def _last_of_each(stream: Stream) -> Stream:
    keep = np.append(np.diff(stream.t) > 0.0, True) if len(stream.t) else np.zeros(0, dtype=bool)
    return Stream(stream.t[keep], stream.values[keep])


def _on_grid(t: Array, dt: float) -> bool:
    """Whether nearly every grid point that has a row in reach has one on it."""
    place = (t - t[0]) / dt
    nearest = np.rint(place)
    on = np.abs(place - nearest) <= ALIGNED
    return len(np.unique(nearest[on])) >= 0.97 * len(np.unique(nearest))


def _parts(model: ComposedModel, stretches: Sequence[tuple[Stream, Stream]], exact: bool) -> int:
    """S: into how many parts a step is cut."""
    least = least_parts(model)
    spacing = []
    aligned: bool = exact
    for states, inputs in stretches:
        changes = _changes(inputs)
        place = (changes - states.t[0]) / model.dt
        off = np.abs(place - np.rint(place)) > ALIGNED
        aligned = aligned and bool(np.count_nonzero(off) <= 0.01 * len(place))
        spacing += np.diff(inputs.t)[np.diff(inputs.t) > 0.0].tolist()
    if aligned:
        return least
    usual = float(np.median(spacing)) if spacing else model.dt
    return max(least, min(max(math.ceil(model.dt / usual), PARTS[0]), PARTS[1]))


def _changes(inputs: Stream) -> Array:
    """Stamps at which the held input changes, (M,)."""
    held = _held(inputs.values)
    moved = np.any(held[1:] != held[:-1], axis=1) if len(held) else np.zeros(0, dtype=bool)
    return inputs.t[1:][moved]


def _held(values: Array) -> Array:
    """Each column's last received value, zero before the first; (N, c)."""
    held = values.copy()
    for column in held.T:
        there = ~np.isnan(column)
        last = np.maximum.accumulate(np.where(there, np.arange(len(column)), -1))
        column[:] = np.where(last >= 0, column[np.maximum(last, 0)], 0.0)
    return held


def _grid_exact(states: Stream, dt: float) -> Array:
    place = (states.t - states.t[0]) / dt
    nearest = np.rint(place)
    on = np.abs(place - nearest) <= ALIGNED
    y = np.full((int(nearest[on].max()) + 1, states.values.shape[1]), np.nan)
    y[nearest[on].astype(int)] = states.values[on]
    return y


def _grid_interpolated(states: Stream, dt: float, angles: list[int], spacing: float) -> Array:
    """Linear between neighbours at most a few usual spacings apart."""
    values = _unwrapped(states.values, angles)
    reach = max(1.6 * spacing, min(3.0 * spacing, dt))
    grid = states.t[0] + dt * np.arange(math.floor((states.t[-1] - states.t[0]) / dt + ALIGNED) + 1)
    right = np.clip(np.searchsorted(states.t, grid), 1, len(states.t) - 1)
    share = ((grid - states.t[right - 1]) / (states.t[right] - states.t[right - 1]))[:, None]
    y = (1.0 - share) * values[right - 1] + share * values[right]
    far = states.t[right] - states.t[right - 1] > reach
    on_left, on_right = np.abs(grid - states.t[right - 1]) < ALIGNED * dt, np.abs(states.t[right] - grid) < ALIGNED * dt
    y[far] = np.nan
    y[far & on_left] = values[right - 1][far & on_left]
    y[far & on_right] = values[right][far & on_right]
    return np.asarray(y)


def _grid_inputs(inputs: Stream, t0: float, steps: int, dt: float, parts: int) -> Array:
    """(steps * parts, nu): what is held at the start of a step where S = 1; else the mean over each part, from the running integral."""
    held = _held(inputs.values)
    width = held.shape[1]
    if not len(held):
        return np.zeros((steps * parts, width))
    on = np.abs((inputs.t - t0) / dt - np.rint((inputs.t - t0) / dt)) <= ALIGNED
    t = np.where(on, t0 + dt * np.rint((inputs.t - t0) / dt), inputs.t)
    edges = t0 + dt / parts * np.arange(steps * parts + 1)
    if bool(on.all()):
        last = np.searchsorted(t, edges[:-1] + ALIGNED * dt / parts, side="right") - 1
        return np.asarray(np.where(last[:, None] >= 0, held[np.maximum(last, 0)], 0.0))
    total = np.concatenate([np.zeros((1, width)), np.cumsum(held[:-1] * np.diff(t)[:, None], axis=0)])
    last = np.searchsorted(t, edges, side="right") - 1
    i = np.maximum(last, 0)
    reach = np.where(last[:, None] >= 0, total[i] + held[i] * (edges - t[i])[:, None], 0.0)
    mean: Array = np.diff(reach, axis=0) * (parts / dt)
    return mean


def _pauses(states: Stream, stamps: Array, run: int, usual: float, origin: float, dt: float) -> list[Pause]:
    """Intervals between states clearly longer than usual, and than a step. stamps: of the inputs."""
    t, v, found = states.t, states.values, []
    for i in np.flatnonzero(np.diff(t) > max(1.7 * usual, 1.5 * dt)).tolist():
        between = np.count_nonzero((stamps > t[i] + 0.5 * usual) & (stamps < t[i + 1] - 0.5 * usual))
        found.append(Pause(float(t[i] - origin), float(t[i + 1] - origin), run, usual, v[i], v[i + 1], between == 0))
    return found


def _unwrapped(y: Array, angles: list[int]) -> Array:
    """Angle columns without jumps of a turn; NaN rows are stepped over."""
    y = y.copy()
    for column in angles:
        there = ~np.isnan(y[:, column])
        y[there, column] = np.unwrap(y[there, column])
    return y
