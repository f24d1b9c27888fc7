"""Evidence for a dictionary of terms in a whitened residual, and what chance makes of it.

    z = X beta + noise, beta ~ N(0, tau^2):   log evidence = 1/2 s' (K + I/tau^2)^-1 s - 1/2 log |I + tau^2 K|,   K = X'X, s = X'z

A Bayes factor against `no structure`: a large dictionary costs only what it uses. It supposes white noise. What noise of any colour, with
any tails, would make of it is seen by sliding the residual along the recording: that keeps its own correlation and that of the
terms, and breaks every tie between the two (but that with slow time and with constants, which slide along).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RIDGES = 10.0 ** np.arange(-5.0, 2.0)
"""1/tau^2 that are tried, as shares of the columns' own size."""

SLIDES = 80
"""Slides of the residual along the recording."""

NEAREST = 0.08
"""Of the recording: slides by less than this leave slow things in place."""


TWICE = 2.0
"""Times the evidence of the best slide: where slides have much, so has whatever wanders, and the next slide may have more."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """log: largest log evidence; ridge: the 1/tau^2 that has it. values (m,), vectors (m, m): of K, none below 0."""

    log: float
    ridge: float
    values: Array = field(repr=False)
    vectors: Array = field(repr=False)

    def beta(self, slope: Array) -> Array:
        """(m,) (K + ridge)^-1 s."""
        return np.asarray(self.vectors @ ((self.vectors.T @ slope) / (self.values + self.ridge)))

    def price(self, times: float) -> float:
        """1/2 log |I + times K / ridge|: what it costs that slopes of that spread may be anything."""
        return 0.5 * float(np.sum(np.log1p(self.values * (times / self.ridge))))


def evidence(product: Array, slope: Array) -> Evidence:
    """From K (m, m) and s (m,)."""
    values, vectors = np.linalg.eigh(product)
    told, best = _evidences(values, (vectors.T @ slope)[:, None], product)
    return Evidence(float(told[0]), float(best[0]), np.maximum(values, 0.0), vectors)


def margin(white: Array, z: Array, weight: Array, least: float) -> float:
    """Nats by which the evidence exceeds that of every slide of the residual; 0 if it is below `least`, or not clearly above.

    white: (n, nx, m) whitened terms; z, weight: (n, nx).
    """
    n, m = len(z), white.shape[2]
    x, push = white.reshape(-1, m), z * weight
    product = x.T @ (x * weight.reshape(-1, 1))
    rng = np.random.default_rng(0)
    shifts = rng.integers(round(NEAREST * n), max(round((1.0 - NEAREST) * n), round(NEAREST * n) + 1), SLIDES)
    slid = np.stack([push.ravel(), *(np.roll(push, int(k), axis=0).ravel() for k in shifts)], axis=1)
    values, vectors = np.linalg.eigh(product)
    told, _ = _evidences(values, vectors.T @ (x.T @ slid), product)
    chance = max(float(np.max(told[1:])), 0.0)
    return float(told[0] - chance) if told[0] > max(least, TWICE * chance) else 0.0


def _evidences(values: Array, along: Array, product: Array) -> tuple[Array, Array]:
    """(largest log evidence, its ridge) of each column of along (m, c): slopes in the eigenvectors' axes."""
    values = np.maximum(values, 0.0)
    size = max(float(np.mean(np.diag(product))), 1e-300)
    ridges = RIDGES * size
    told = np.stack([0.5 * (np.sum(along**2 / (values + r)[:, None], axis=0) - np.sum(np.log1p(values / r))) for r in ridges])
    best = np.argmax(told, axis=0)
    return told[best, np.arange(told.shape[1])], ridges[best]
