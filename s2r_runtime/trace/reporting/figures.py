"""Arrays for figures of a trace: residuals over time, their autocorrelation, rollouts and measurement.

All are of the held-out data, before and after, except `over_time` (the whole recording). Long recordings are thinned; extremes remain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.diagnostics.residual_plots import Component, components, variables
from s2r_runtime.trace.diagnostics.rollout_error import MANY
from s2r_runtime.trace.estimation.prediction import Steps, acting, advanced, first_steps, residual, rollout_starts, steps_of
from s2r_runtime.trace.estimation.problem import evaluate, problem

if TYPE_CHECKING:
    from s2r_runtime.trace.reporting.result import TraceResult

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LAGS = 40
"""Steps of the autocorrelation."""

POINTS = 1500
"""Points of a scatter."""

BUCKETS = 400
"""Buckets of a curve over time; each keeps its least and its largest value."""

AROUND = 2
"""Rollouts shown before and after the one that a stretch is about."""

LONGEST = 1200
"""Steps of a stretch."""


@dataclass(frozen=True)
class Correlated:
    """Autocorrelation at lags 1, 2 ... steps. expected: what measurement noise alone makes; band: half the 95 % width around it."""

    lag: Index
    before: Array
    after: Array
    expected: Array
    band: Array


@dataclass(frozen=True)
class Stretch:
    """Rollouts one after the other, each begun at the measured state. t: (m,) s; measured, before, after: (m, nx); starts: (r,) indices
    at which a rollout begins: there the curves jump back to the measurement. about: number of the rollout that it shows.
    """

    said: str
    t: Array
    measured: Array
    before: Array
    after: Array
    starts: Index
    about: int


@dataclass(frozen=True)
class OverTime:
    """All of the recording's residuals, and the spans of time that were held out."""

    t: Array
    parts: list[Component]
    held_out: list[tuple[float, float]]


def views(r: TraceResult) -> dict[str, Any]:
    """All arrays as lists by state, for other plotting tools."""
    steps, over = r.held.steps, variables(r.nominal, r.held)
    parts = {p.name: p for p in components(r.nominal, r.held, r.before.one_step, r.after.one_step, r.floor[0])}
    states = {name: (r.before.one_step[:, i], r.after.one_step[:, i]) for i, name in enumerate(r.nominal.states)}
    residuals: dict[str, Any] = {}
    for name, (before, after) in {**states, **{n: (p.before, p.after) for n, p in parts.items()}}.items():
        keep = spread(POINTS, before, after)
        residuals[name] = {
            "t": steps.t[keep].tolist(),
            "before": before[keep].tolist(),
            "after": after[keep].tolist(),
            "against": {v.name: v.values[keep].tolist() for v in over},
        }
    correlated = dict(correlations(r, list(parts.values())))
    shown = stretches(r)
    return {
        "residual": residuals,
        "autocorrelation": {
            name: {"lag": c.lag.tolist(), "before": c.before.tolist(), "after": c.after.tolist()} for name, c in correlated.items()
        },
        "rollout": {
            state: {key: value for s in shown[:1] for key, value in _listed(s, i).items()} for i, state in enumerate(r.nominal.states)
        },
    }


def _listed(s: Stretch, i: int) -> dict[str, list[float]]:
    return {
        "t": s.t.tolist(),
        "measured": s.measured[:, i].tolist(),
        "before": s.before[:, i].tolist(),
        "after": s.after[:, i].tolist(),
    }


def spread(most: int, *values: Array) -> Index:
    """Indices to plot: evenly spaced, and those with the largest values."""
    n = len(values[0])
    if n <= most:
        return np.arange(n)
    even = np.linspace(0, n - 1, most * 4 // 5).astype(np.int64)
    far = [np.argsort(-np.abs(v))[: most // (5 * len(values))] for v in values]
    return np.unique(np.concatenate([even, *far]))


def envelope(t: Array, e: Array, buckets: int = BUCKETS) -> Index:
    """Indices of a curve to plot: minimum and maximum of each interval."""
    if len(t) <= 2 * buckets:
        return np.arange(len(t))
    edges = np.linspace(0, len(t), buckets + 1).astype(np.int64)
    rows = [a + np.sort([int(np.argmin(e[a:b])), int(np.argmax(e[a:b]))]) for a, b in pairwise(edges.tolist()) if b > a]
    return np.unique(np.concatenate(rows))


def over_time(r: TraceResult) -> OverTime:
    """Over all of the recording that is judged on."""
    held = r.held
    steps = steps_of(held.data, held.left_out)
    everything = type(held)(held.data, steps, held.left_out, held.within, held.horizon)
    before, after = (residual(m, steps, acting(m, held.data)) for m in (r.nominal, r.model))
    parts = components(r.nominal, everything, before, after, r.floor[0])
    return OverTime(steps.t, parts, [] if held.within.all() else _spans(steps, held.within[steps.place]))


def _spans(steps: Steps, inside: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """(from, to) in s of stretches of steps that are inside."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int8), [0]])))
    return [(float(steps.t[a]), float(steps.t[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def correlations(r: TraceResult, parts: Sequence[Component]) -> list[tuple[str, Correlated]]:
    """Autocorrelation of each component, with its 95 % band (Bartlett, moving average of order 1)."""
    steps = r.held.steps
    noise = evaluate(problem(r.held.data, steps), r.model).noise
    own = dict(zip(r.nominal.states, zip(noise.r, noise.q, strict=True), strict=True))
    lags = min(LAGS, max(1, len(steps) // 4))
    found = []
    for part in parts:
        measured, process = own.get(part.name) or (0.5 * (own["x"][0] + own["y"][0]), 0.5 * (own["x"][1] + own["y"][1]))
        first = -measured / max(2.0 * measured + process, 1e-300)
        expected = np.append(first, np.zeros(lags - 1))
        pairs, before = _autocorrelation(steps, part.before, lags)
        _, after = _autocorrelation(steps, part.after, lags)
        # Bartlett, for a moving average of order 1: the first lag's own variance, and that of all beyond it
        spread_ = np.append(1.0 - 3.0 * first**2 + 4.0 * first**4, np.full(lags - 1, 1.0 + 2.0 * first**2))
        band = 1.96 * np.sqrt(spread_ / np.maximum(pairs, 1))
        found.append((part.name, Correlated(np.arange(1, lags + 1), before, after, expected, band)))
    return found


def _autocorrelation(steps: Steps, e: Array, lags: int) -> tuple[Index, Array]:
    """(pairs, correlation) at each lag: only of steps that lie that far apart in one run."""
    e = e - float(np.mean(e))
    total = float(np.mean(e * e)) or 1.0
    pairs, found = [], []
    for lag in range(1, lags + 1):
        there = (steps.place[lag:] - steps.place[:-lag] == lag) & (steps.run[lag:] == steps.run[:-lag])
        count = int(np.count_nonzero(there))
        pairs.append(count)
        found.append(float(e[lag:][there] @ e[:-lag][there]) / (max(count, 1) * total))
    return np.array(pairs), np.array(found)


def stretches(r: TraceResult) -> list[Stretch]:
    """The rollouts that end farthest off under the given model and under the repaired one, and a usual one (median)."""
    held = r.held
    starts = rollout_starts(held.data, held.horizon, held.left_out, held.within)
    starts = starts[:: max(1, len(starts) * held.horizon // MANY)]
    if not len(starts) or len(starts) != len(r.before.ends):
        return []
    floor = np.maximum(r.floor[1], 1e-300)
    off = [np.sum((judged.ends / floor) ** 2, axis=1) for judged in (r.before, r.after)]
    changed = r.model.effects != r.nominal.effects
    usual = int(np.argsort(off[1])[len(starts) // 2])
    picked = {"worst of all rollouts before": int(np.argmax(off[0]))} if changed else {}
    picked |= {"worst of all rollouts after" if changed else "worst of all rollouts": int(np.argmax(off[1])), "a usual one": usual}
    found, taken = [], set()
    for said, at in picked.items():
        if at not in taken:
            found.append(_stretch(r, said, int(starts[at])))
        taken.add(at)
    return found


def _stretch(r: TraceResult, said: str, start: int) -> Stretch:
    """Around the rollout that starts at a step (of the runs laid end to end), as far as what is held out goes."""
    held = r.held
    begin = first_steps(held.data)
    run = int(np.searchsorted(begin, start, side="right")) - 1
    horizon = min(held.horizon, LONGEST)
    around = min(AROUND, (LONGEST // horizon - 1) // 2)
    there = np.isfinite(held.data.runs[run].y).all(axis=1)
    good = held.within[begin[run] : begin[run + 1]] & np.asarray(there)[:-1]
    good[[k for i, k in held.left_out if i == run]] = False
    first = last = start - int(begin[run])
    last += horizon
    for _ in range(around):
        first -= horizon if first >= horizon and good[first - horizon : first].all() else 0
        last += horizon if last + horizon <= len(good) and good[last : last + horizon].all() else 0
    y = held.data.runs[run].y[first : last + 1]
    begins = np.arange(0, last - first, horizon)
    curves = [_rolled(model, r, int(begin[run]) + first, y, begins) for model in (r.nominal, r.model)]
    t: Array = held.data.runs[run].start_s + held.data.dt * np.arange(first, last + 1, dtype=np.float64)
    return Stretch(said, t, y, curves[0], curves[1], begins, int((start - begin[run] - first) // horizon))


def _rolled(model: ComposedModel, r: TraceResult, place: int, y: Array, begins: Index) -> Array:
    """(m, nx) predicted states from each start to the next; at a start, the end of the previous rollout."""
    act = acting(model, r.held.data)
    x = np.empty_like(y)
    x[0] = y[0]
    for k in range(len(y) - 1):
        here = y[k] if k in begins else x[k]
        x[k + 1] = advanced(model, here[None, :], act, slice(place + k, place + k + 1))[0]
    return x
