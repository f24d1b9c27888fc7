"""Residual of a composed model on a dataset, one step and over rollouts.

    e_k     = y_{k+1} (-) f(y_k, a_k)                    one step, (n, nx); a_k: the input as it acts over step k
    e_{k,H} = y_{k+H} (-) f^H(y_k, a_k .. a_{k+H-1})     at the end of a rollout of H steps, open loop
    F_k     = df/dx at (y_k, a_k), (n, nx, nx)

Effects of stage `input` filter the command, which is known without noise: their hidden states are exact, over all of a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.models.file_model import NoNumbers
from s2r_runtime.trace.data.dataset import Dataset

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


TOGETHER = 30_000
"""Numbers in a table of states that is stepped at once: fewer calls of what takes as long for one row as for a hundred, and a small
machine's cache holds them.
"""

SKIPPED = 3
"""Steps without a measured end over which what is said of the last step before is taken to hold."""


@dataclass(frozen=True)
class Steps:
    """n transitions in order of time. place: (n,) step in the runs laid end to end; joined: (n,) starts where the one before ended.

    y0, y1: (n, nx) measured at start and end; t: (n,) s since the recording's first stamp; run: (n,).
    """

    place: Index
    run: Index
    t: Array
    y0: Array
    y1: Array
    joined: Mask

    def __len__(self) -> int:
        return len(self.place)

    @cached_property
    def farthest(self) -> Array:
        """(nx,) sizes that nothing foretold exceeds. Every prediction is held against them."""
        return farthest(self.y1)

    def take(self, rows: Index | Mask) -> Steps:
        """Some of them, in the same order."""
        place = self.place[rows]
        joined: Mask = (
            np.append(False, (np.diff(place) == 1) & (np.diff(self.run[rows]) == 0)) if len(place) else np.zeros(0, dtype=np.bool_)
        )
        return Steps(place, self.run[rows], self.t[rows], self.y0[rows], self.y1[rows], joined & self.joined[rows])


@dataclass(frozen=True)
class Acting:
    """The input as it acts over every step of all runs laid end to end: mean over the step, and at its end, (M, nu). lasts: (M,) s, of each
    step, None where all last dt. parts: (M, S, nu) over parts of it, where the model takes each part by itself.
    """

    mean: Array
    end: Array
    lasts: Array | None = None
    parts: Array | None = None

    def at(self, place: Index) -> Acting:
        """Over some of the steps, each as one."""
        return Acting(self.mean[place], self.end[place], None if self.lasts is None else self.lasts[place])

    def over(self, place: Index) -> Acting:
        """Over some of the steps, as it is."""
        mean = self.mean[place]
        end = mean if self.end is self.mean else self.end[place]
        parts = None if self.parts is None else self.parts[place]
        return Acting(mean, end, None if self.lasts is None else self.lasts[place], parts)

    def moved(self, shift: Array) -> Acting:
        """The same with (M, nu), or (nu,), more."""
        parts = None if self.parts is None else self.parts + shift[..., None, :]
        return Acting(self.mean + shift, self.end + shift, self.lasts, parts)


def side_by_side(acts: Sequence[Acting]) -> Acting:
    """What acts over the same steps in several ways, one after the other."""
    mean = np.concatenate([act.mean for act in acts])
    end = mean if all(act.end is act.mean for act in acts) else np.concatenate([act.end for act in acts])
    lasts = [act.lasts for act in acts if act.lasts is not None]
    parts = [act.parts for act in acts if act.parts is not None]
    return Acting(mean, end, np.concatenate(lasts) if lasts else None, np.concatenate(parts) if parts else None)


def first_steps(data: Dataset) -> Index:
    """(runs + 1,) where each run's steps begin in the runs laid end to end."""
    return np.cumsum([0] + [len(run.y) - 1 for run in data.runs])


def steps_of(data: Dataset, left_out: Sequence[tuple[int, int]] = ()) -> Steps:
    """All transitions with both ends measured. left_out: (run, step) that do not count."""
    begin = first_steps(data)
    ends = [(run.y[:-1], run.y[1:]) for run in data.runs]
    y0, y1 = np.concatenate([a for a, _ in ends]), np.concatenate([b for _, b in ends])
    where = np.repeat(np.arange(len(data.runs)), np.diff(begin))
    t = np.concatenate([run.begins(data.dt) for run in data.runs])
    good = ~(np.isnan(y0).any(axis=1) | np.isnan(y1).any(axis=1))
    good[[begin[run] + k for run, k in left_out]] = False
    place = np.arange(len(t))
    everything = Steps(place, where, t, y0, y1, np.append(False, where[1:] == where[:-1]) if len(t) else good)
    return everything.take(np.flatnonzero(good))


def times(data: Dataset) -> Array:
    """When each row of the inputs of all runs, laid end to end, begins: (sum T_i,), s since the recording's first stamp."""
    parts = np.arange(data.substeps) / data.substeps
    return np.concatenate([(run.begins(data.dt)[:, None] + run.durations(data.dt)[:, None] * parts).ravel() for run in data.runs])


def acting(model: ComposedModel, data: Dataset, effects: Sequence[AppliedEffect] | None = None) -> Acting:
    """The input as it acts after the effects of stage `input` (None: the model's)."""
    chain = [a for a in (model.effects if effects is None else effects) if a.effect.stage == "input"]
    lasts = np.concatenate([run.durations(data.dt) for run in data.runs]) if data.uneven else None
    if data.turned is None and not data.in_parts:
        return Acting(*data.chains.over_steps(model, chain), lasts)
    u, ends = data.chains.with_ends(model, chain)
    if data.substeps == 1:
        return Acting(u, ends, lasts)
    table = u.reshape(-1, data.substeps * u.shape[1])
    mean = table @ np.tile(np.eye(u.shape[1]) / data.substeps, (data.substeps, 1))
    parts = u.reshape(-1, data.substeps, u.shape[1]) if data.in_parts else None
    end = ends[data.substeps - 1 :: data.substeps].copy()
    if data.turned is not None:  # what changes within the last part is over by its end, unless an effect says what acts there
        plain = data.turned & (end == u[data.substeps - 1 :: data.substeps])
        end[plain] = np.roll(table[:, : u.shape[1]], -1, axis=0)[plain]
    return Acting(mean, end, lasts, parts)


def advanced(model: ComposedModel, x: Array, act: Acting, place: Index | slice) -> Array:
    """x (n, nx) one step later, angles not wrapped; place: which of the steps. A step of a thinned recording is many of the model's.

    Steps of their own length each are one step of a model that takes them (`uneven`). Others are interpolated between the model's at
    dt (1 - s), dt and dt (1 + s), a quadratic in their length: exact for poses by Euler and for constant accelerations.
    """
    lasts = None if act.lasts is None else act.lasts[place]
    if act.parts is None:
        mean = act.mean[place]
        return _once(model, x, mean, mean if act.end is act.mean else act.end[place], lasts)
    parts = act.parts[place]
    count = parts.shape[1]
    short = replace(model, spec=structs.replace(model.spec, dt=model.dt / count))
    for i in range(count):
        end = parts[:, i] if i < count - 1 else act.end[place]
        x = _once(short, x, parts[:, i], end, None if lasts is None else lasts / count)
    return x


def _once(model: ComposedModel, x: Array, mean: Array, end: Array, lasts: Array | None) -> Array:
    if lasts is None:
        return model.advance(x, mean, end)
    if model.uneven:
        try:
            return model.advance(x, mean, end, lasts)
        except NoNumbers:
            raise
        except ConfigError:  # somebody's own step that takes them where it was asked, and not here
            pass
    h = (lasts / model.dt - 1.0)[:, None]
    s = float(np.clip(np.max(np.abs(h), initial=0.0), 0.05, 0.9))
    short, long = (replace(model, spec=structs.replace(model.spec, dt=model.dt * (1.0 + r))).advance(x, mean, end) for r in (-s, s))
    usual = model.advance(x, mean, end)
    return np.asarray(usual + h / (2.0 * s) * (long - short) + (h / s) ** 2 / 2.0 * (long - 2.0 * usual + short))


FEWEST = 400
"""Rollouts whose errors tell a root mean square to 4 %, and one that is held against another of the same noise better than that."""

FARTHEST = 1e6
"""Times the largest value of a state: what is foretold beyond it explains nothing, its squares leave no digits for the rest, and an
integration that is not stable there leaves all numbers within a few steps.
"""


def farthest(y: Array) -> Array:
    """(nx,) sizes that nothing foretold exceeds, from measured states (n, nx)."""
    largest = np.nanmax(np.abs(y), axis=0, initial=0.0)
    return np.asarray(np.where(largest > 0.0, FARTHEST * largest, np.inf))


def near(x: Array, ends_at: Array) -> bool:
    """Whether all of x (..., nx) is nearer than the nearest of these (nx,), as it mostly is by far: that is seen at once, and column by
    column it takes as long as a step.
    """
    return bool(max(x.max(initial=0.0), -x.min(initial=0.0)) <= ends_at.min())


def no_farther(x: Array, ends_at: Array) -> Array:
    """x (..., nx), cut off there."""
    return x if near(x, ends_at) else np.clip(x, -ends_at, ends_at)


def wherever(model: ComposedModel, x: Array, act: Acting, place: Index | slice) -> Array:
    """As `advanced`; a row stays from which somebody's own model gives no numbers: a rollout has left all that its equations are for, or a
    candidate's values have, just beside what was recorded.
    """
    try:
        return advanced(model, x, act, place)
    except ConfigError as error:
        if len(x) <= 1:
            return x
        place, half = np.arange(len(act.end))[place], len(x) // 2
        if isinstance(error, NoNumbers) and len(error.rows) == len(x):
            going, there = ~error.rows, x.copy()
            if np.any(going):
                there[going] = wherever(model, x[going], act, place[going])
            return there
        return np.concatenate([wherever(model, x[part], act, place[part]) for part in (slice(half), slice(half, None))])


def check_steps(model: ComposedModel, x: Array, u: Array) -> None:
    """Raises ConfigError, as the model does, if its step fails from all of these states (n, nx) under these inputs (n, nu), each alone. One
    that gives no numbers there may give some elsewhere.
    """
    failed: list[ConfigError] = []
    for state, given in zip(x, u, strict=True):
        try:
            model.advance(state[None], given[None], given[None])
        except NoNumbers:
            return
        except ConfigError as error:
            failed.append(error)
    if failed and len(failed) == len(x):
        raise failed[0]


def predicted(model: ComposedModel, steps: Steps, act: Acting) -> Array:
    """f(y0, a), (n, nx), angles not wrapped; y0 where somebody's own model gives no numbers (`wherever`), and none that are absurd."""
    return no_farther(wherever(model, steps.y0, act, steps.place), steps.farthest)


def residual(model: ComposedModel, steps: Steps, act: Acting) -> Array:
    """y1 (-) f(y0, a), (n, nx)."""
    return model.difference(steps.y1, predicted(model, steps, act))


def state_jacobian(model: ComposedModel, steps: Steps, act: Acting) -> Array:
    """F, (n, nx, nx), by central differences of a millionth of the state's size."""
    n, nx = steps.y0.shape
    h = 1e-6 * np.maximum(1.0, np.max(np.abs(steps.y0), axis=0, initial=0.0))
    moved = np.concatenate([np.diag(h), -np.diag(h)])  # (2 nx, nx)
    there = np.empty((2 * nx, n, nx))
    together = max(1, TOGETHER // max(steps.y0.size, 1))
    for k in range(0, 2 * nx, together):
        x = steps.y0 + moved[k : k + together, None]
        place = np.tile(steps.place, len(x))
        there[k : k + together] = wherever(model, x.reshape(-1, nx), act, place).reshape(x.shape)
    return np.ascontiguousarray(((there[:nx] - there[nx:]) / (2.0 * h)[:, None, None]).transpose(1, 2, 0))


@dataclass(frozen=True)
class Rollouts:
    """Errors at the end of rollouts of `horizon` steps: error (m, nx); place: (m,) the step each starts at."""

    horizon: int
    place: Index
    error: Array


def rollout_starts(data: Dataset, horizon: int, left_out: Sequence[tuple[int, int]] = (), within: Mask | None = None) -> Index:
    """Steps (in the runs laid end to end) with a measured start, a measured end `horizon` steps on in the same run, and nothing left out
    between. within: (M,) steps that a rollout may touch.
    """
    begin = first_steps(data)
    blocked = np.zeros(begin[-1] + 1)
    blocked[[begin[run] + k for run, k in left_out]] = 1
    if within is not None:
        blocked[: len(within)] += ~within
    count = np.concatenate([[0.0], np.cumsum(blocked)])
    found = []
    for i, run in enumerate(data.runs):
        good: Mask = ~np.asarray(np.isnan(run.y).any(axis=1))
        last = len(run.y) - horizon
        if last > 0:
            k = np.flatnonzero(good[:last] & good[horizon:]) + begin[i]
            found.append(k[count[k + horizon] == count[k]])
    return np.concatenate(found).astype(np.int64) if found else np.zeros(0, dtype=np.int64)


def some_of(starts: Index, horizon: int, most: int) -> Index:
    """Every so many starts of rollouts, `most` or so: those that begin within a sixteenth of the horizon go mostly the same way, and one of
    them tells what they all do, as long as FEWEST are left.
    """
    apart = max(len(starts) // most, min(horizon // 16, len(starts) // FEWEST))
    return starts[:: max(1, apart)]


def covered(steps: Steps, n: int) -> tuple[Index, Mask]:
    """(n,) of the steps in the runs laid end to end: the transition that each is, or the last one before; and whether that one is near
    enough to speak for it. What was left out is spoken for by none.
    """
    here = np.arange(n)
    last = np.maximum(np.searchsorted(steps.place, here, side="right") - 1, 0)
    return last, here - steps.place[last] <= SKIPPED


def rollout(
    model: ComposedModel,
    data: Dataset,
    act: Acting,
    starts: Index,
    horizon: int,
    extra: Array | None = None,
    begun: Array | None = None,
    ends: Array | None = None,
) -> Rollouts:
    """Rolls out from every start at once. extra: (M, nx), added to the state after each step (what a lack-of-fit model says). begun, ends:
    states (rows of the runs laid end to end, nx) from which to begin, and where it should lead; None: as measured.
    """
    begin = first_steps(data)
    run = np.searchsorted(begin, starts, side="right") - 1
    y = np.concatenate([r.y for r in data.runs])
    rows = starts + run  # a run has one row more than it has steps
    x = y[rows] if begun is None else begun[rows]
    ends_at = farthest(y)
    for h in range(horizon):
        place = starts + h
        x = wherever(model, x, act, place)
        if extra is not None:
            x = x + extra[place]
        x = no_farther(x, ends_at)
    return Rollouts(horizon, starts, model.difference((y if ends is None else ends)[rows + horizon], x))


def rms(e: Array) -> Array:
    """(nx,) root mean square over rows; NaN if there are none."""
    return np.sqrt(np.mean(e**2, axis=0)) if len(e) else np.full(e.shape[1], np.nan)
