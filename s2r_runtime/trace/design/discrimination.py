"""How well a sequence of inputs would tell rival models apart: expected log likelihood difference, in nats.

Where model i is true, the rival j leaves the residual

    d_k = f_i(y_k, a_i,k) (-) f_j(y_k, a_j,k)            on the trajectory of i, with the fitted noise

and j's parameters move to make the best of it: to first order what remains is d less its projection on J = d f_j / d p_j,

    nats(i, j) = 1/2 |L^-1 (d - J delta)|^2,     delta = argmin           L L^T: covariance of the noise (residual_noise)

`refitted` is the same with j really fitted to what i would do: where parameters enter with a kink the first order promises too much.
What an earlier recording says about j's parameters is not counted, so the promise holds for the sequence alone.
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
    """(count, T + 1, nx) measured states under the inputs u (count, T, nu); without noise the states themselves."""
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
    """(R,) nats by which the true model's likelihood is expected to beat each; 0 for itself. data: what the truth does."""
    given, white = _seen(fits[truth], data)
    act = [acting(fit.model, data) for fit in fits]
    steps = given.steps
    foretold = [predicted(fit.model, steps, a) for fit, a in zip(fits, act, strict=True)]
    nats = np.zeros(len(fits))
    for j, fit in enumerate(fits):
        if j != truth:
            d = white.whiten(fit.model.difference(foretold[truth].copy(), foretold[j])).ravel()
            nats[j] = 0.5 * _left(d, sensitivities(given, white, fit.model, fit.free))
    return nats


def between(fits: Sequence[Fit], base: Fit, data: Dataset) -> Array:
    """(R, R) nats of each against each, all on one trajectory of the base; 0 for one that runs away to infinity on it."""
    given, white = _seen(base, data)
    nats = np.zeros((len(fits), len(fits)))
    with np.errstate(all="ignore"):
        foretold = [predicted(fit.model, given.steps, acting(fit.model, data)) for fit in fits]
        moved = [sensitivities(given, white, fit.model, fit.free) for fit in fits]
    sound = [i for i in range(len(fits)) if np.isfinite(foretold[i]).all() and np.isfinite(moved[i]).all()]
    spaces = {i: _basis(moved[i]) for i in sound}
    for i in sound:
        for j in sound:
            if i != j:
                d = white.whiten(base.model.difference(foretold[i].copy(), foretold[j])).ravel()
                nats[i, j] = 0.5 * max(float(d @ d - np.sum((spaces[j].T @ d) ** 2)), 0.0)
    return nats


def refitted(fits: Sequence[Fit], truth: int, rival: int, like: Dataset, start: Array, u: Array) -> float:
    """Nats after the rival is really fitted to what the truth does without noise, (T, nu) inputs."""
    y = trajectories(fits[truth].model, None, start, u[None], np.random.default_rng(0))[0]
    given, white = _seen(fits[truth], as_data(like, y, u))
    z = objective(given, white, refine(given, white, fits[rival].model))
    return float(np.sum(noises.log_density(np.zeros_like(z)) - noises.log_density(z)))


def _seen(fit: Fit, data: Dataset) -> tuple[Problem, Fit]:
    """Transitions, and the fit as it would whiten them."""
    steps = steps_of(data)
    f = state_jacobian(fit.model, steps, acting(fit.model, data))
    white = replace(fit, whiten=Whitener(fit.noise, f, steps.joined), colour=noises.no_colour(f.shape[1]), z=np.zeros(f.shape[:2]))
    return problem(data, steps), white


def _left(d: Array, j: Array) -> float:
    """Sum of squares of d that columns of j do not take up."""
    return max(float(d @ d - np.sum((_basis(j).T @ d) ** 2)), 0.0)


def _basis(j: Array) -> Array:
    """Orthonormal columns that span those of j, without the parameters that change nothing here."""
    return np.asarray(np.linalg.qr(j[:, np.any(j != 0.0, axis=0)])[0])
