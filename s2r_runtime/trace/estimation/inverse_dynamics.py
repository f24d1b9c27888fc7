"""Where a force, a torque or an acceleration is the input: the input that the measured motion takes, against the one that acted.

    u*_k: f(y_k, u*_k) = y_{k+1} in the least-squares sense, of all such inputs the one nearest to what acted, a_k
    input_relative = |h * (a - u*)| / |h * u|         over what is held out, every input over its own norm, root mean square of the inputs

(y, a) at the recording's own rate, since friction is not the same over a long step; u: what was commanded; h: the low-pass of
differentiation.py, zero-phase, by which noise that differences of measurements blow up is left out of both. This is the relative
error of inverse dynamic identification (A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, 2019).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data import differentiation
from s2r_runtime.trace.data.dataset import Dataset, regridded
from s2r_runtime.trace.data.reconstruction import at_step
from s2r_runtime.trace.estimation.prediction import Acting, Steps, acting, rms, steps_of, wherever

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FORCES = {"N", "N m", "Nm", "m/s²", "rad/s²"}
"""Units of inputs for which the inverse model is a usual thing to ask for."""

ROUNDS = 40
"""Of the iteration; it ends at once where the model is linear, and where friction holds it creeps out of the range that does nothing."""

CLOSE = 1e-7
"""Change, over the input's size, at which the iteration ends."""

FARTHEST = 100.0
"""Times the input's size that the one that the motion takes may be away: a model that asks for more explains nothing."""

DRAWS = 20
"""Of noise: the largest of so many is exceeded by chance once in so many and one times."""

WILD, FEW = 4.0, 0.05
"""Robust standard deviations at which an error counts no more, and share of the rows below which such are outliers."""

ROWS = 200_000
"""At most; of a longer recording a part of that length at the beginning."""


@dataclass(frozen=True)
class Inverse:
    """What is judged. data: at the recording's rate; steps of it; stretches: [a, b) of steps that follow one another; bandwidth: Hz."""

    data: Dataset
    steps: Steps
    stretches: tuple[tuple[int, int], ...]
    bandwidth: float


def inverse(model: ComposedModel, data: Dataset, held_out: Steps) -> Inverse | None:
    """None where the inputs are no forces, or where what is held out has no stretch long enough to filter."""
    units: dict[str, str] = getattr(model.nominal, "units", {})
    if not all(units.get(name) in FORCES for name in model.inputs) or not len(held_out):
        return None
    fine = data
    if data.segments and data.interval < 0.75 * data.dt:
        fine = regridded(data, at_step(model, data.interval))
    steps = steps_of(fine)
    steps = steps.take(_within(steps, fine.dt, held_out, data.dt))
    steps = steps.take(np.arange(min(len(steps), ROWS)))
    if not len(steps):
        return None
    edges = [0, *(np.flatnonzero(~steps.joined[1:]) + 1).tolist(), len(steps)]
    band = data.reconstruction.needed if data.reconstruction else _bandwidth(model, steps, edges, fine.dt)
    longest = max(b - a for a, b in pairwise(edges))
    while 4 * differentiation.reach(fine.dt, band) > longest and band < differentiation.HIGHEST / fine.dt:
        band *= 1.5
    least = 2 * differentiation.reach(fine.dt, band)
    stretches = tuple((a, b) for a, b in pairwise(edges) if b - a > least)
    return Inverse(fine, steps, stretches, band) if stretches else None


def input_relative(model: ComposedModel, given: Inverse) -> float | None:
    """See above. None where nothing was commanded: the share of nothing is no number."""
    lost, whole = (np.sum(e**2, axis=0) for e in (_off(model, given), _commanded(model, given)))
    used = whole > 0.0
    return float(np.sqrt(np.mean(lost[used] / whole[used]))) if used.any() else None


@dataclass(frozen=True)
class Recorded:
    """Of the forces that were recorded, (nu,) each: their rms, that of them less their mean, and that of what is left of them where they
    act (what acts by itself is none of it).
    """

    asked: Array
    varies: Array
    left: Array


def recorded(model: ComposedModel, given: Inverse) -> Recorded:
    """Through a model."""
    model, here = _here(model, given)
    silent = replace(given.data, runs=tuple(replace(run, u=0.0 * run.u, turned=None) for run in given.data.runs))
    by_itself = acting(model, silent).mean[given.steps.place]
    asked = _commanded(model, given)
    return Recorded(rms(asked), np.std(asked, axis=0), rms(_filtered(here.mean - by_itself, given)))


def off(model: ComposedModel, given: Inverse) -> Array:
    """(nu,) rms of a - u*, wild values cut off."""
    return _tame(_off(model, given))


def off_by_noise(model: ComposedModel, given: Inverse, r: Array) -> Array:
    """(DRAWS, nu) what noise of the measurements, of variances r (nx,), makes of `off`, drawn so often."""
    model, here = _here(model, given)
    needed, rng = _needed(model, given.steps, here), np.random.default_rng(0)
    drawn = [_filtered(_needed(model, _shaken(given, r, rng), here) - needed, given) for _ in range(DRAWS)]
    return np.array([_tame(e) for e in drawn])


def _here(model: ComposedModel, given: Inverse) -> tuple[ComposedModel, Acting]:
    """The model at the recording's rate, and what acts over the steps."""
    model = model if model.dt == given.data.dt else at_step(model, given.data.dt)
    return model, acting(model, given.data).at(given.steps.place)


def _commanded(model: ComposedModel, given: Inverse) -> Array:
    """(m, nu) h * u."""
    return _filtered(acting(model, given.data, ()).mean[given.steps.place], given)


def _off(model: ComposedModel, given: Inverse) -> Array:
    """(m, nu) h * (a - u*)."""
    model, here = _here(model, given)
    return _filtered(here.mean - _needed(model, given.steps, here), given)


def _shaken(given: Inverse, r: Array, rng: np.random.Generator) -> Steps:
    """The steps with noise of these variances on every measurement."""
    steps = given.steps
    rows = steps.place + steps.run  # a run has one row more than it has steps
    e = rng.normal(size=(int(rows[-1]) + 2, len(r))) * np.sqrt(r)
    return replace(steps, y0=steps.y0 + e[rows], y1=steps.y1 + e[rows + 1])


def _filtered(e: Array, given: Inverse) -> Array:
    """(m, nu) h * e of all stretches."""
    return np.concatenate([differentiation.low_pass(e[a:b], given.data.dt, given.bandwidth) for a, b in given.stretches])


def _tame(e: Array) -> Array:
    """(nu,) rms, wild values cut off if they are few: a robot that mostly rests has more of them when it moves."""
    most = WILD * np.median(np.abs(e), axis=0) / 0.6745
    few = np.mean(np.abs(e) > most, axis=0) < FEW
    return rms(np.clip(e, np.where(few, -most, -np.inf), np.where(few, most, np.inf)))


def _needed(model: ComposedModel, steps: Steps, act: Acting) -> Array:
    """u*, (n, nu)."""
    size = np.maximum(np.sqrt(np.mean(act.mean**2, axis=0)), 1e-12)
    answer = np.stack([_slope(model, steps, act, j, float(size[j])) for j in range(len(size))], axis=1)
    back = np.linalg.pinv(answer)  # (nu, nx)
    shift = np.zeros_like(act.mean)
    for _ in range(ROUNDS):
        e = model.difference(steps.y1, wherever(model, steps.y0, act.moved(shift), slice(None)))
        step = e @ back.T
        shift = np.clip(shift + step, -FARTHEST * size, FARTHEST * size)
        if np.all(np.abs(step) < CLOSE * size):
            break
    return np.asarray(act.mean + shift)


def _slope(model: ComposedModel, steps: Steps, act: Acting, j: int, h: float) -> Array:
    """(nx,) what a unit more of input j does to the state, where it does much: where friction holds, it does nothing."""
    up = np.zeros(act.mean.shape[1])
    up[j] = h
    change = np.subtract(*(wherever(model, steps.y0, act.moved(way), slice(None)) for way in (up, -up)))
    return np.asarray(np.quantile(np.abs(change), 0.9, axis=0) * np.sign(np.sum(change, axis=0)) / (2.0 * h))


def _within(steps: Steps, dt: float, held_out: Steps, longer: float) -> Mask:
    """Which of the steps lie in one that is held out."""
    middle = steps.t + 0.5 * dt
    last = np.searchsorted(held_out.t, middle, side="right") - 1
    inside: Mask = (last >= 0) & (middle < held_out.t[np.maximum(last, 0)] + longer)
    return inside


def _bandwidth(model: ComposedModel, steps: Steps, edges: list[int], dt: float) -> float:
    """What the measured rates (the states that an input moves most) bear, Hz."""
    at = np.zeros((1, len(model.inputs)))
    pushed = [model.nominal.step(steps.y0[:1], at + one, model.dt, model.parameters) for one in np.eye(len(model.inputs))]
    resting = model.nominal.step(steps.y0[:1], at, model.dt, model.parameters)
    moved = np.max([np.abs(p - resting)[0] for p in pushed], axis=0)
    fast = np.flatnonzero(moved > 0.5 * moved.max())
    return differentiation.bandwidth([steps.y0[a:b][:, fast] for a, b in pairwise(edges)], dt, 1, rows=0)
