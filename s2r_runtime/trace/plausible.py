"""Are the columns what they say? Other units or axes, or exchanged columns, are no effect that a model lacks.

    E(c) = mean over states that go somewhere of  |y_{k+H} (-) f^H(y_k)| / |y_{k+H} (-) y_k|     (trimmed rms, H steps of half a second)

for the recording as it is and with each usual mistake c taken back. As it is, the model foretells little (E > NOTHING); with one
mistake taken back it foretells well (E < WELL, and by far better): then that is what is wrong, and no effect is looked for.

Inputs that come after the motion that they cause are on another clock: the model foretells a tenth of a second far better with the inputs
earlier by some steps than with any delay. Where that lead grows over the recording, the clocks run at different rates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import axes
from s2r_runtime.trace.dataset import Dataset, Run, regridded
from s2r_runtime.trace.never_measured import check_measured
from s2r_runtime.trace.residual import Index, acting, first_steps, rollout, rollout_starts
from s2r_runtime.trace.streams import Stream

Array = NDArray[np.float64]
Change = Callable[[Array], Array]

NOTHING, WELL, BETTER = 0.35, 0.35, 0.4
"""E from which a model foretells little (two columns of four may be exchanged), E below which it foretells well, and the ratio of both at
most.
"""

SURELY = 0.1
"""As WELL, for factors that an actuator's limits could have, too."""

DEAD = 0.7
"""Of E with an input that does nothing, which E must be below: a motor that hardly turns is in no other unit."""

HORIZON_S = 0.5
"""Of the rollouts, s (1 to 50 steps)."""

STARTS = 300
"""Rollouts: their mean error is then known to a few per cent."""

ROWS = 6000
"""Rows of each segment that are looked at."""

GOES = 5.0
"""Standard deviations of its noise that a state must go in the horizon to count."""

LEAD_S, APART_S = 4.0, 0.05
LEADS = (-60, -40, -28, -20, -14, -10, -7, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 7, 10, 14, 20, 28, 40, 56, 80)
"""Leads (below zero: delays) that are tried, in steps and in steps of APART_S, up to LEAD_S and to a quarter of the longest run."""

GLANCE_S, GLANCES = 0.1, 2400
"""What is foretold to see which input it was (1 to 50 steps: in one step of a fast recording nothing moves), and from how many rows."""

WILD = 6.0
"""Robust standard deviations beyond which a residual counts no more."""

AHEAD = 0.4
"""Squared error with the inputs earlier, over the best with them as they are or later, below which they are on another clock."""

SEGMENTS = 40
"""Segments that are looked at, evenly spread."""

DRIFTS, PARTS, DRIFTING = 3, 8, 0.7
"""Steps by which the lead must grow from the first to the last of so many parts of the recording; and the squared error with it, over
the one with the best lead for all, below which it does.
"""


@dataclass(frozen=True)
class _Mistake:
    """What it is, and how it is taken back: of states (N, nx) and inputs (N, nu). well: E below which it is believed."""

    said: str
    states: Change | None
    inputs: Change | None
    well: float


def check_plausible(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if the columns are clearly not what they say, with what they seem to be."""
    check_measured(model, data)
    as_it_is = _foretold(model, data)
    if as_it_is is not None and as_it_is > NOTHING and data.segments:
        few = _few(data)
        tried = [(_foretold(model, _taken_back(model, few, m)), m) for m in _mistakes(model)]
        best, said = min([(e, m.said) for e, m in tried if e is not None and e < m.well], default=(math.inf, ""))
        dead = [_foretold(model, _taken_back(model, few, m)) for m in _dead(model)]
        if best < min(BETTER * as_it_is, *(DEAD * e for e in dead if e is not None)):
            raise RecordingError(f"{data.source}: {said}: so read, the model errs by {best:.0%} of the motion; as it is, by {as_it_is:.0%}")
    _check_clocks(model, data)


def _few(data: Dataset) -> Dataset:
    """The beginning of each segment, of many every so many."""
    some = [pair for pair in data.segments if len(pair[0].t) > 1]
    every = max(1, len(some) // SEGMENTS)
    cut = tuple((Stream(s.t[:ROWS], s.values[:ROWS]), _until(i, s.t[:ROWS])) for s, i in some[::every])
    return replace(data, segments=cut)


def _until(inputs: Stream, t: Array) -> Stream:
    inside = inputs.t <= t[-1] if len(t) else np.zeros(len(inputs.t), dtype=bool)
    return Stream(inputs.t[inside], inputs.values[inside])


def _taken_back(model: ComposedModel, data: Dataset, mistake: _Mistake) -> Dataset:
    changed = []
    for states, inputs in data.segments:
        y = states.values if mistake.states is None else mistake.states(states.values)
        u = inputs.values if mistake.inputs is None else mistake.inputs(inputs.values)
        changed.append((Stream(states.t, y), Stream(inputs.t, u)))
    return regridded(replace(data, segments=tuple(changed)), model)


def _foretold(model: ComposedModel, data: Dataset) -> float | None:
    """E; None where nothing goes anywhere."""
    ahead = int(np.clip(round(HORIZON_S / data.dt), 1, 50))
    starts = rollout_starts(data, ahead)
    starts = starts[:: max(1, len(starts) // STARTS)]
    if len(starts) < 20:
        return None
    begin = np.cumsum([0] + [len(run.y) - 1 for run in data.runs])
    rows = starts + np.searchsorted(begin, starts, side="right") - 1
    y = np.concatenate([run.y for run in data.runs])
    with np.errstate(all="ignore"):
        error = _trimmed(rollout(model, data, acting(model, data), starts, ahead).error)
    gone = _trimmed(model.difference(y[rows + ahead].copy(), y[rows]))
    bent = np.concatenate([np.diff(run.y, 2, axis=0) for run in data.runs])
    noise = np.nanmedian(np.abs(bent), axis=0) / 0.6745 / math.sqrt(6.0)
    goes = gone > GOES * noise + 1e-12
    return float(np.mean(np.minimum(error[goes] / gone[goes], 2.0))) if goes.any() else None


def _trimmed(e: Array) -> Array:
    """(nx,) rms of the four fifths that are smallest."""
    sizes = np.sort(np.abs(np.nan_to_num(e, nan=1e300)), axis=0)[: max(1, int(0.8 * len(e)))]
    return np.asarray(np.sqrt(np.mean(np.minimum(sizes, 1e100) ** 2, axis=0)))


def _mistakes(model: ComposedModel) -> Iterator[_Mistake]:
    """The usual ones, each as what would be right."""
    units: dict[str, str] = getattr(model.nominal, "units", {})
    for kind, names in (("states", model.states), ("inputs", model.inputs)):
        for a, b in combinations(names, 2):
            order = [names.index({a: b, b: a}.get(name, name)) for name in names]
            yield _mistake(kind, f"the columns {a} and {b} seem to be exchanged", partial(_ordered, order))
        for j, name in enumerate(names):
            for unit, right, factor, well in _UNITS.get(units.get(name, ""), ()):
                yield _mistake(kind, f"{name} seems to be in {unit}, must be in {right}", partial(_scaled, [j], factor), well)
            if kind == "inputs":
                yield _mistake(kind, f"{name} seems to have the other sign", partial(_scaled, [j], -1.0))
    if {"x", "y"} <= set(model.states):
        both = [model.states.index("x"), model.states.index("y")]
        yield _mistake("states", "x and y seem to be in mm, must be in m", partial(_scaled, both, 1e-3))
        yield _mistake("states", "y seems to point right, must point left", partial(_scaled, both[1:], -1.0))
    for name in model.nominal.angles:
        j = model.states.index(name)
        yield _mistake("states", f"{name} seems to be clockwise, must be counter-clockwise", partial(_scaled, [j], -1.0))
        yield _mistake("states", f"{name} seems to be clockwise from y, must be counter-clockwise from x", partial(_turned, j))


def _dead(model: ComposedModel) -> list[_Mistake]:
    """What is none: each input by itself does nothing."""
    return [_mistake("inputs", "", partial(_scaled, [j], 0.0)) for j in range(len(model.inputs))]


_UNITS = {
    "rad": (("degrees", "rad", math.pi / 180.0, WELL),),
    "rad/s": (("degrees a second", "rad/s", math.pi / 180.0, WELL), ("revolutions a minute", "rad/s", math.pi / 30.0, SURELY)),
    "m/s": (("mm/s", "m/s", 1e-3, WELL),),
}
"""Unit of a column -> units in which it may be by mistake: name, right one, factor, E below which it is believed. Not km/h, which could as
well be a gain."""


def _mistake(kind: str, said: str, change: Change, well: float = WELL) -> _Mistake:
    return _Mistake(said, change if kind == "states" else None, change if kind == "inputs" else None, well)


def _ordered(order: list[int], values: Array) -> Array:
    return values[:, order]


def _scaled(columns: list[int], factor: float, values: Array) -> Array:
    values = values.copy()
    values[:, columns] *= factor
    return values


def _turned(column: int, values: Array) -> Array:
    values = values.copy()
    values[:, column] = 0.5 * math.pi - values[:, column]
    return values


def _check_clocks(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if the motion comes before the inputs."""
    apart = max(1, round(APART_S / data.dt))
    longest = max((len(run.y) for run in data.runs), default=0)
    tried = sorted({lead * unit for lead in LEADS for unit in (1, apart)})
    leads = [lead for lead in tried if (abs(lead) * data.dt <= LEAD_S or abs(lead) <= 2) and 4 * abs(lead) < longest]
    long = [run for run in data.runs if leads and len(run.y) > 4 * max(leads)]
    if not long or not any(np.any(run.u[1:] != run.u[:-1]) for run in long):
        return
    few = replace(data, runs=tuple(long))
    ahead = int(np.clip(round(GLANCE_S / data.dt), 1, 50))
    starts = rollout_starts(few, ahead)
    starts = starts[:: max(1, len(starts) // GLANCES)]
    if len(starts) < 20:
        return
    size = np.median(np.abs(_errors(model, few, 0, starts, ahead)), axis=0) / 0.6745 + 1e-12

    def costs(lead: int) -> list[float]:
        return [float(np.sum(part)) for part in _parts(_errors(model, few, lead, starts, ahead) / size)]

    cost = np.array([costs(lead) for lead in leads])
    total = cost.sum(axis=1)
    best = leads[int(np.argmin(total))]
    by_part = [leads[int(k)] for k in np.argmin(cost, axis=0)]
    steadily = by_part in (sorted(by_part), sorted(by_part, reverse=True))
    followed, single = float(np.sum(np.min(cost, axis=0))), float(np.min(total))
    drifts = abs(by_part[-1] - by_part[0]) >= DRIFTS and steadily and max(by_part) > 0 and followed < DRIFTING * single
    causal = float(np.min(total[np.array(leads) <= 0]))
    if min(followed if drifts else math.inf, single if best > 0 else math.inf) < AHEAD * causal:
        causal = min(causal, _least_causal(lambda delay: sum(costs(-delay)), min(round(LEAD_S / data.dt), longest // 4), apart))
    if drifts and followed < AHEAD * causal:
        raise RecordingError(
            f"{data.source}: the motion comes {by_part[0] * data.dt:.2g} s before the inputs that cause it at first and "
            f"{by_part[-1] * data.dt:.2g} s in the end: their clocks run at different rates, their stamps must be of one clock"
        )
    if best > 0 and single < AHEAD * causal and axes(model.nominal):
        beside = {lead: _with_friction(model, few, _errors(model, few, lead, starts, ahead) / size, starts) for lead in leads if lead >= 0}
        single, causal = min(cost for lead, cost in beside.items() if lead > 0), beside[0]
    if best > 0 and single < AHEAD * causal:
        best = min(range(round(0.7 * best), round(1.4 * best) + 1, max(1, best // 20)), key=lambda lead: sum(costs(lead)))
        raise RecordingError(
            f"{data.source}: the motion comes about {best * data.dt:.2g} s before the inputs that cause it: their stamps must be of "
            "one clock, and an input must stand at the time from which it acts"
        )


def _least_causal(cost: Callable[[int], float], longest: int, apart: int) -> float:
    """Of all delays up to the longest, steps, at the bottom between them: inputs that repeat themselves come before and after it."""
    near = min(range(0, longest + 1, apart), key=cost)
    around = {delay: cost(delay) for delay in range(max(0, near - apart), near + apart + 1)}
    best = min(around, key=lambda delay: around[delay])
    if best - 1 not in around or best + 1 not in around:
        return around[best]
    before, here, after = (around[best + k] for k in (-1, 0, 1))
    bend = before - 2.0 * here + after
    return max(0.0, here - (before - after) ** 2 / (8.0 * bend)) if bend > 0.0 else here


def _with_friction(model: ComposedModel, data: Dataset, z: Array, starts: Index) -> float:
    """What errors z (n, nx) cost less what friction, a bias and a gain would make of them: a controller that has to push against friction
    asks for a force that comes after the acceleration.
    """
    moving = [axis.velocity for axis in axes(model.nominal)]
    run = np.searchsorted(first_steps(data), starts, side="right") - 1
    v = np.concatenate([r.y for r in data.runs])[starts + run][:, moving]
    told = np.concatenate([np.ones((len(v), 1)), v, np.sign(v), acting(model, data).mean[starts]], axis=1)
    cut = np.clip(z, -WILD, WILD)
    return float(sum(np.sum(part) for part in _parts(z - told @ np.linalg.lstsq(told, cut, rcond=1e-9)[0])))


def _errors(model: ComposedModel, data: Dataset, lead: int, starts: Index, ahead: int) -> Array:
    """(n, nx) after `ahead` steps with the inputs earlier by `lead`."""
    shifted = replace(data, runs=tuple(_earlier(run, lead * data.substeps) for run in data.runs))
    with np.errstate(all="ignore"):
        error = rollout(model, data, acting(model, shifted), starts, ahead).error
    return np.nan_to_num(error, nan=1e300, posinf=1e300, neginf=-1e300)


def _parts(z: Array) -> list[Array]:
    """Squares, cut off where they are wild, of each part of the recording."""
    return np.array_split(np.minimum(np.abs(z), WILD) ** 2, PARTS)


def _earlier(run: Run, rows: int) -> Run:
    u = np.roll(run.u, -rows, axis=0)
    if rows > 0:
        u[-rows:] = run.u[-1]
    elif rows < 0:
        u[:-rows] = run.u[0]
    return replace(run, u=u)
