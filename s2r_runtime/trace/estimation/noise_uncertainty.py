"""How much wider intervals are because process noise is not known, only estimated.

A small one, far below what is measured, is often most likely none at all, although it isn't (N. Shephard, A. Harvey, On the probability of
estimating a deterministic component in the local level model, J. Time Series Analysis 11, 1990). Under none, whatever is constant is known
as well as if the whole recording were one measurement. With weights from the estimate q, the variance of numbers is linear in q', what it
truly is:

    var = A^-1 (A + sum_i (q_i' - q_i) G_i^T G_i) A^-1      A = J^T S^-1 J,   G = S^-1 dr/dp, G_i its rows of state i

so on average over what the likelihood leaves open it is that of the mean q': flat in its root (A. Gelman, Prior distributions for variance
parameters, Bayesian Analysis 1, 2006), with measurement noise where it is.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.problem import WIDEST, Fit, Problem, slopes
from s2r_runtime.trace.estimation.state_noise import State

Array = NDArray[np.float64]

KNOWN = 200.0
"""Information on log q, nats per unit squared, from which on nothing is added: its standard deviation is 7 % then."""

POINTS, FAR = 24, 8.0
"""Of the mean over the root of q: from none to where the likelihood has fallen by so many nats."""

DOUBLINGS = 24

WILD = 100.0
"""Times the variance of outlying steps, with which they say nothing."""


def doubted(given: Problem, fit: Fit) -> Array:
    """(k,) by which standard deviations are larger than the likelihood at its best noise says, within [1, WIDEST]."""
    r, f = given.residual(fit.model), given.jacobian(fit.model)
    more = _more(r, f, given, fit)
    if not np.any(more):
        return np.ones(len(fit.free))
    n, nx = r.shape
    z = fit.whiten(slopes(given, fit.model, fit.free))
    w = noises.weight(fit.whiten(r))[:, :, None]
    g = fit.whiten.back(w * z)
    j = z.reshape(n * nx, -1)
    inverse = np.linalg.pinv(j.T @ (w * z).reshape(n * nx, -1), rcond=1e-12, hermitian=True)
    added = np.einsum("kip,i,kiq->pq", g, more, g, optimize=True)
    own = np.maximum(np.diag(inverse), 1e-300)
    return np.asarray(np.minimum(np.sqrt(1.0 + np.maximum(np.diag(inverse @ added @ inverse), 0.0) / own), WIDEST))


def _more(r: Array, f: Array, given: Problem, fit: Fit) -> Array:
    """(nx,) mean of q over its likelihood, less its estimate; zero for states of axes whose speed was not measured."""
    noise, joined = fit.noise, given.steps.joined
    skip = {i for pair in given.floor.axes for i in pair}
    z = fit.whiten(r)
    wild = np.abs(z) > noises.OUTLIER
    more = np.zeros(r.shape[1])
    for i in range(r.shape[1]):
        if i in skip:
            continue
        others = f[:, i] ** 2 @ noise.r - f[:, i, i] ** 2 * noise.r[i]
        own = noise.q[i] + noise.r[i] * (1.0 + f[:, i, i] ** 2) + others
        extra = np.where(wild[:, i], WILD * z[:, i] ** 2 * own, 0.0)
        more[i] = _mean(State(r[:, i], f[:, i, i], joined, others + extra), float(noise.q[i]), float(noise.r[i])) - noise.q[i]
    return np.maximum(more, 0.0)


def _mean(state: State, q: float, r: float) -> float:
    """Of q over its likelihood."""
    at = state.at((math.log(q), math.log(r)))
    if state.slopes(at)[2] > KNOWN:
        return q

    def behind(root: float) -> float:
        return state.at((2.0 * math.log(root), math.log(r))).cost - at.cost

    top = math.sqrt(q)
    for _ in range(DOUBLINGS):
        top *= 2.0
        if behind(top) > FAR:
            break
    roots = top * (np.arange(POINTS) + 0.5) / POINTS
    nats = np.array([behind(root) for root in roots])
    w = np.exp(float(nats.min()) - nats)
    return float(w @ roots**2 / w.sum())
