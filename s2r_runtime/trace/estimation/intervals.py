"""95 % intervals of fitted parameters.

Smooth parameters: value ± 1.96 s, s from Gauss-Newton, widened by the ratio in which the scores of blocks of time scatter more than
the likelihood says (a sandwich; never narrowed), or for noise that is not known, if that is more (`noise_uncertainty`). Parameters that
enter with a kink (delays, limits): profile likelihood, where the log likelihood, the other parameters refitted, has fallen by 1.92 (3.68
for the time of a change) times the square of that ratio.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.change_times import is_time
from s2r_runtime.trace.estimation.change_times import spread as times_of
from s2r_runtime.trace.estimation.noise_uncertainty import doubted
from s2r_runtime.trace.estimation.parameters import Free, Slot, bounds_of, values_of, with_values
from s2r_runtime.trace.estimation.problem import Fit, Problem, objective, sensitivities, widening

Array = NDArray[np.float64]

NORMAL_95 = 1.96
CHANGE_95 = 3.68
"""Nats, for the time of a change: the likelihood is then the higher one of two random walks, P(less than x) = (1 - exp(-x))^2, no parabola
(D. Siegmund, Confidence sets in change-point problems, International Statistical Review 56, 1988).
"""

BLOCKS = 20


@dataclass(frozen=True)
class Spread:
    """Of the k numbers of a fit. normal, covariance: (k, k) by Gauss-Newton; wider: (k,) times their standard deviations are larger."""

    normal: Array
    covariance: Array
    wider: Array

    @property
    def widened(self) -> Array:
        """(k, k) covariance that is as wide as the intervals are."""
        return np.asarray(self.covariance * np.outer(self.wider, self.wider))


def spread_of(given: Problem, fit: Fit) -> Spread:
    """Of all numbers of the fit."""
    if given.floor.axes:  # as `plainly` fits
        fit = replace(fit, colour=noises.no_colour(fit.z.shape[1]))
    z = objective(given, fit, fit.model)
    j = sensitivities(given, fit, fit.model, fit.free)
    w = noises.weight(z).ravel()
    normal = j.T @ (j * w[:, None])
    covariance = np.asarray(np.linalg.pinv(normal, rcond=1e-12, hermitian=True))
    wider = widening(j * (w * z.ravel())[:, None], covariance, z.shape[1], BLOCKS)
    return Spread(normal, covariance, np.maximum(wider, doubted(given, fit)))


def intervals(given: Problem, fit: Fit) -> dict[Slot, tuple[float, float]]:
    """(low, high) of every number that was fitted. Where the data say nothing of a parameter: its bounds."""
    if not fit.free:
        return {}
    if given.floor.axes:  # as `plainly` fits
        fit = replace(fit, colour=noises.no_colour(fit.z.shape[1]))
    spread = spread_of(given, fit)
    normal, covariance, wider = spread.normal, spread.covariance, spread.wider
    found = {}
    values = values_of(fit.model, fit.free)
    for index, slot in enumerate(fit.free):
        bounds, value = bounds_of(fit.model, slot), float(values[index])
        s = float(np.sqrt(max(covariance[index, index], 0.0)) * wider[index])
        known = normal[index, index] > 1e-12 * max(float(np.max(np.diag(normal))), 1e-300)
        if bounds.kink or not known:
            drop = (CHANGE_95 if is_time(fit.model, slot) else 0.5 * NORMAL_95**2) * float(wider[index]) ** 2
            found[slot] = _profile(given, fit, index, value, s, drop, bounds.low, bounds.high)
            if is_time(fit.model, slot):
                first, last = times_of(given, fit, slot, drop)
                found[slot] = min(found[slot][0], first), max(found[slot][1], last)
        else:
            found[slot] = float(max(value - NORMAL_95 * s, bounds.low)), float(min(value + NORMAL_95 * s, bounds.high))
    return found


def _profile(given: Problem, fit: Fit, index: int, value: float, s: float, drop: float, low: float, high: float) -> tuple[float, float]:
    """Where the profile falls by so many nats, by doubling and bisection."""
    best = _reached(given, fit, index, value)
    ends = []
    for sign, bound in ((-1.0, low), (1.0, high)):
        near, step = value, max(s, 1e-3 * abs(value), 1e-9)
        far = None
        for _ in range(24):
            there = min(max(value + sign * step, low), high)
            if best - _reached(given, fit, index, there) > drop:
                far = there
                break
            near = there
            if there == bound:
                break
            step *= 2.0
        if far is None:
            ends.append(bound)
            continue
        for _ in range(6):
            middle = 0.5 * (near + far)
            near, far = (near, middle) if best - _reached(given, fit, index, middle) > drop else (middle, far)
        ends.append(0.5 * (near + far))
    return ends[0], ends[1]


def _reached(given: Problem, fit: Fit, index: int, value: float) -> float:
    """Log density with one parameter held, the others moved by two Gauss-Newton steps."""
    values = values_of(fit.model, fit.free)
    values[index] = value
    model = with_values(fit.model, fit.free, values)
    if model is None:
        return -np.inf
    others: Free = tuple(f for i, f in enumerate(fit.free) if i != index)
    z = objective(given, fit, model)
    reached = float(np.sum(noises.log_density(z)))
    for _ in range(2 if others else 0):
        model, z, better = _step(given, fit, model, others, z, reached)
        if better - reached < 0.01:
            break
        reached = better
    return reached


def _step(given: Problem, fit: Fit, model: ComposedModel, free: Free, z: Array, reached: float) -> tuple[ComposedModel, Array, float]:
    j = sensitivities(given, fit, model, free)
    w = noises.weight(z).ravel()
    step = np.linalg.lstsq(j.T @ (j * w[:, None]), j.T @ (w * z.ravel()), rcond=1e-10)[0]
    other = with_values(model, free, values_of(model, free) - step)
    if other is None:
        return model, z, reached
    moved = objective(given, fit, other)
    better = float(np.sum(noises.log_density(moved)))
    return (other, moved, better) if better > reached else (model, z, reached)
