"""Expected log likelihood difference of competing models under a sequence of inputs, in nats.

If model i is true, the alternative j has the residual

    d_k = f_i(y_k, a_i,k) (-) f_j(y_k, a_j,k)            on the trajectory of i, with the fitted noise

and j's parameters are re-fitted: to first order d loses its projection on J = d f_j / d p_j,

    nats(i, j) = 1/2 |L^-1 (d - J delta)|^2,     delta = argmin           L L^T: covariance of the noise (residual_noise)

This is the criterion of a T-optimal design (A. Atkinson, V. Fedorov, Biometrika 62, 1975). `refitted` fits j to the motion of i without the
approximation: if parameters have kinks, the first order is too large. Earlier recordings are not counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset, Run
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.noise import Noise, Whitener
from s2r_runtime.trace.estimation.prediction import acting, predicted, state_jacobian, steps_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, objective, problem, refine, sensitivities

Array = NDArray[np.float64]


def trajectories(model: ComposedModel, noise: Noise | None, start: Array, u: Array, rng: np.random.Generator) -> Array:
    """Simulate measured states (count, T + 1, nx) under inputs u (count, T, nu); without noise the states themselves."""
    count, steps = u.shape[:2]
    q, r = (np.zeros(len(start)), np.zeros(len(start))) if noise is None else (np.sqrt(noise.q), np.sqrt(noise.r))
    x, hidden = np.tile(start, (count, 1)), model.at_rest(count)
    y = np.empty((count, steps + 1, len(start)))
    y[:, 0] = x
    for k in range(steps):
        x, hidden = model.step(x, u[:, k], hidden)
        x = x + rng.normal(size=x.shape) * q
        y[:, k + 1] = x
    return y + rng.normal(size=y.shape) * r


def as_data(like: Dataset, y: Array, u: Array) -> Dataset:
    """One run on the same grid as a recording."""
    run = Run(0.0, y, np.repeat(u, like.substeps, axis=0))
    return Dataset(like.states, like.inputs, like.dt, like.substeps, (run,), len(y), "suggested")


def expected(fits: Sequence[Fit], truth: int, data: Dataset) -> Array:
    """(R,) expected log likelihood of the true model minus that of each, nats; 0 for itself. data: simulated by the true model."""
    given, white = _seen(fits[truth], data)
    act = [acting(fit.model, data) for fit in fits]
    steps = given.steps
    predictions = [predicted(fit.model, steps, a) for fit, a in zip(fits, act, strict=True)]
    nats = np.zeros(len(fits))
    for j, fit in enumerate(fits):
        if j != truth:
            d = white.whiten(fit.model.difference(predictions[truth].copy(), predictions[j])).ravel()
            nats[j] = 0.5 * _left(d, sensitivities(given, white, fit.model, fit.free))
    return nats


def between(fits: Sequence[Fit], base: Fit, data: Dataset) -> Array:
    """(R, R) expected nats of each pair, on one trajectory of the base; 0 for a model that diverges on it."""
    given, white = _seen(base, data)
    nats = np.zeros((len(fits), len(fits)))
    with np.errstate(all="ignore"):
        predictions = [predicted(fit.model, given.steps, acting(fit.model, data)) for fit in fits]
        moved = [sensitivities(given, white, fit.model, fit.free) for fit in fits]
    sound = [i for i in range(len(fits)) if np.isfinite(predictions[i]).all() and np.isfinite(moved[i]).all()]
    spaces = {i: _basis(moved[i]) for i in sound}
    for i in sound:
        for j in sound:
            if i != j:
                d = white.whiten(base.model.difference(predictions[i].copy(), predictions[j])).ravel()
                nats[i, j] = 0.5 * max(float(d @ d - np.sum((spaces[j].T @ d) ** 2)), 0.0)
    return nats


def refitted(fits: Sequence[Fit], truth: int, alternative: int, like: Dataset, start: Array, u: Array) -> float:
    """Nats after the alternative is fitted to the noise-free motion of the truth under inputs (T, nu)."""
    y = trajectories(fits[truth].model, None, start, u[None], np.random.default_rng(0))[0]
    given, white = _seen(fits[truth], as_data(like, y, u))
    z = objective(given, white, refine(given, white, fits[alternative].model))
    return float(np.sum(noises.log_density(np.zeros_like(z)) - noises.log_density(z)))


def _seen(fit: Fit, data: Dataset) -> tuple[Problem, Fit]:
    """Transitions, and the fit with their whitening."""
    steps = steps_of(data)
    f = state_jacobian(fit.model, steps, acting(fit.model, data))
    white = replace(fit, whiten=Whitener(fit.noise, f, steps.joined), colour=noises.no_colour(f.shape[1]), z=np.zeros(f.shape[:2]))
    return problem(data, steps), white


def _left(d: Array, j: Array) -> float:
    """Sum of squares of d minus its projection on the columns of j."""
    return max(float(d @ d - np.sum((_basis(j).T @ d) ** 2)), 0.0)


def _basis(j: Array) -> Array:
    """Orthonormal basis of the non-zero columns of j."""
    return np.asarray(np.linalg.qr(j[:, np.any(j != 0.0, axis=0)])[0])
