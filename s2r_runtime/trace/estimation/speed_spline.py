"""The speed of an axis whose position alone was measured: a smoothing spline that is bent by what the inputs do.

    x_{k+1} = A_k x_k + b_k + w_k      x = (position, speed), A = (1 h; 0 1), b = a (h^2/2, h); a: the model's acceleration, h: s to the
                                       next row
    y_k     = position_k + e_k         e ~ (0, R)
    w       ~ (0, s G_k),              G = (h^3/3 h^2/2; h^2/2 h): white acceleration, for all that the model lacks

How much is smoothed follows from the data (`smoother`), and no bandwidth has to be chosen. Whether b helps is told by the same likelihood.
Rows far off (outliers) are given less weight. Time is counted in usual rows, so that numbers stay near 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation.smoother import Smoother

Array = NDArray[np.float64]

WILD, ROUNDS = 4.0, 3
"""Standard deviations from which a row counts less, and how often that is told anew."""

ENOUGH = 6000
"""Rows from which r is estimated at most; it is then known to a few per cent."""

FEWEST = 8
"""Rows through which a spline is laid."""


@dataclass(frozen=True)
class Smoothed:
    """speed: (n,); error: standard deviation of the speed; bandwidth: Hz, where half of the speed passes."""

    speed: Array
    error: float
    bandwidth: float


def smoothed(t: Array, y: Array, pushed: Array) -> Smoothed:
    """t, y: (n,), n >= 4; pushed: (n - 1,) acceleration by the inputs from row to row."""
    unit = float(np.median(np.diff(t)))
    h, weight = np.diff(t) / unit, np.ones(len(t))
    for _ in range(ROUNDS):
        ratio, a = _likeliest(h, y, weight, (pushed * unit * unit, np.zeros_like(pushed)))
        x, scale, spread = _Spline(h, y, weight, a).solve(ratio)
        off = np.abs(y - x[:, 0]) / max(math.sqrt(scale), 1e-300)
        if not np.any(off > WILD):
            break
        weight = np.where(off > WILD, (WILD / np.maximum(off, WILD)) ** 2 / 4.0, 1.0)
    return Smoothed(x[:, 1] / unit, spread / unit, math.exp(0.25 * ratio) / (2.0 * math.pi * unit))


def less_noise(t: Array, y: Array, ratio: float | None = None) -> tuple[Array, float, float]:
    """(n,) y without its noise, the standard deviation of that, and log r. t, y: (n,), of which FEWEST stamps differ; ratio: log r, if it
    is known. Of rows with one stamp, the first one counts.
    """
    new = np.append(True, np.diff(t) > 0.0)
    if not new.all():
        found, scale, ratio = less_noise(t[new], y[new], ratio)
        return found[np.cumsum(new) - 1], scale, ratio
    h, weight, still = np.diff(t) / float(np.median(np.diff(t))), np.ones(len(t)), np.zeros(len(t) - 1)
    if ratio is None:
        ratio, _ = _likeliest(h, y, weight, (still,))
    found, scale, _ = _Spline(h, y, weight, still).solve(ratio)
    return found[:, 0], math.sqrt(scale), ratio


def _likeliest(h: Array, y: Array, weight: Array, ways: tuple[Array, ...]) -> tuple[float, Array]:
    """(log r, a) of the a that explains most, on ENOUGH rows of the middle."""
    first = max(0, (len(y) - ENOUGH) // 2)
    last = first + min(len(y), ENOUGH)
    rows, steps = slice(first, last), slice(first, last - 1)
    found = [(*_Spline(h[steps], y[rows], weight[rows], a[steps]).best(), a) for a in ways]
    best = max(found, key=lambda one: one[0])
    return best[1], best[2]


class _Spline(Smoother):
    """h, a: (n - 1,); y, weight: (n,); all in rows."""

    def __init__(self, h: Array, y: Array, weight: Array, a: Array) -> None:
        one = np.ones_like(h)
        f = np.stack([np.stack([one, h], axis=1), np.stack([0.0 * h, one], axis=1)], axis=1)
        self._origin = float(np.mean(y))
        super().__init__(f, np.column_stack([0.5 * a * h * h, a * h]), (12.0 / h**3, -6.0 / h**2, 4.0 / h), y - self._origin, weight)

    def solve(self, ratio: float) -> tuple[Array, float, float]:
        """((n, 2) position and speed, R, standard deviation of the speed in the middle)."""
        x, scale, spread = super().solve(ratio)
        return x + np.array([self._origin, 0.0]), scale, spread
