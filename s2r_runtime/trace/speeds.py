"""The speed of an axis whose position alone was measured: a smoothing spline that is bent by what the inputs do.

    x_{k+1} = A_k x_k + b_k + w_k      x = (position, speed), A = (1 h; 0 1), b = a (h^2/2, h); a: the model's acceleration, h: s to the
                                       next row
    y_k     = position_k + e_k         e ~ (0, R)
    w       ~ (0, s G_k),              G = (h^3/3 h^2/2; h^2/2 h): white acceleration, for all that the model lacks

With M the matrix of the normal equations (banded, two rows a stamp) and S their least sum of squares over R, the likelihood of
r = s/R is

    log p = -(n - 1) log r - 1/2 log|M| - (n - 2)/2 log S,             R = S / (n - 2)

so how much is smoothed follows from the data, and no bandwidth has to be chosen: G. Wahba, *Improper priors, spline smoothing and
the problem of guarding against model errors in regression*, J. R. Statist. Soc. B 40, 1978. Whether b helps is told by the same likelihood.
Rows far off (outliers) are given less weight. Time is counted in usual rows, so that numbers stay near 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STIFFEST, SOFTEST, FIRST, LAST = -32.0, 6.0, 3.0, 0.2
"""log r that are looked at, rows as the unit of time; the first and the last step of the search."""

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
        off = np.abs(y - x[0]) / max(math.sqrt(scale), 1e-300)
        if not np.any(off > WILD):
            break
        weight = np.where(off > WILD, (WILD / np.maximum(off, WILD)) ** 2 / 4.0, 1.0)
    return Smoothed(x[1] / unit, spread / unit, math.exp(0.25 * ratio) / (2.0 * math.pi * unit))


def less_noise(t: Array, y: Array, ratio: float | None = None) -> tuple[Array, float, float]:
    """(n,) y without its noise, the standard deviation of that, and log r. t, y: (n,), n >= FEWEST; ratio: log r, if it is known."""
    h, weight, still = np.diff(t) / float(np.median(np.diff(t))), np.ones(len(t)), np.zeros(len(t) - 1)
    if ratio is None:
        ratio, _ = _likeliest(h, y, weight, (still,))
    (found, _), scale, _ = _Spline(h, y, weight, still).solve(ratio)
    return found, math.sqrt(scale), ratio


def _likeliest(h: Array, y: Array, weight: Array, ways: tuple[Array, ...]) -> tuple[float, Array]:
    """(log r, a) of the a that explains most, on ENOUGH rows of the middle."""
    first = max(0, (len(y) - ENOUGH) // 2)
    last = first + min(len(y), ENOUGH)
    rows, steps = slice(first, last), slice(first, last - 1)
    found = [(*_Spline(h[steps], y[rows], weight[rows], a[steps]).best(), a) for a in ways]
    best = max(found, key=lambda one: one[0])
    return best[1], best[2]


class _Spline:
    """h, a: (n - 1,); y, weight: (n,); all in rows."""

    def __init__(self, h: Array, y: Array, weight: Array, a: Array) -> None:
        n = len(y)
        self._n, self._y, self._weight = n, y, weight
        i11, i12, i22 = 12.0 / h**3, -6.0 / h**2, 4.0 / h  # of G^-1
        b1, b2 = 0.5 * a * h * h, a * h
        self._inverse, self._b = (i11, i12, i22), (b1, b2)
        prior = np.zeros((4, 2 * n))
        prior[0, 2::2] += i11
        prior[0, 3::2] += i22
        prior[1, 2::2] += i12  # (speed, position) of row k + 1
        c12, c22 = h * i11 + i12, h * i12 + i22  # G^-1 A: (i11 c12; i12 c22)
        prior[0, 0:-2:2] += i11
        prior[0, 1:-2:2] += h * c12 + c22
        prior[1, 0:-2:2] += c12
        prior[2, 0:-2:2] -= i11
        prior[2, 1:-2:2] -= c22
        prior[1, 1:-2:2] -= c12
        prior[3, 0:-2:2] -= i12
        self._prior = prior
        self._rhs = np.zeros(2 * n)
        g1, g2 = i11 * b1 + i12 * b2, i12 * b1 + i22 * b2
        self._rhs[2::2] += g1
        self._rhs[3::2] += g2
        self._rhs[0:-2:2] -= g1
        self._rhs[1:-2:2] -= h * g1 + g2
        self._origin = float(np.mean(y))

    def _solved(self, ratio: float) -> tuple[Array, Array, float]:
        """(factor, x, S) at log r."""
        from scipy.linalg import lapack

        r = math.exp(ratio)
        m = self._prior / r
        m[0, 0::2] += self._weight
        rhs = self._rhs / r
        rhs[0::2] += self._weight * (self._y - self._origin)
        factor, info = lapack.dpbtrf(m, lower=1)
        if info != 0:
            return factor, rhs, math.inf
        x, _ = lapack.dpbtrs(factor, rhs, lower=1)
        return factor, x, self._squares(x, r)

    def _squares(self, x: Array, r: float) -> float:
        """S, from what is left: the short form cancels where there is hardly any noise."""
        p, v = x[0::2], x[1::2]
        h_b1, h_b2 = self._b
        w1, w2 = p[1:] - p[:-1] - self._h * v[:-1] - h_b1, v[1:] - v[:-1] - h_b2
        i11, i12, i22 = self._inverse
        off = self._y - self._origin - p
        return float(np.sum(self._weight * off * off) + np.sum(i11 * w1 * w1 + 2.0 * i12 * w1 * w2 + i22 * w2 * w2) / r)

    @property
    def _h(self) -> Array:
        return 4.0 / self._inverse[2]

    def likelihood(self, ratio: float) -> float:
        """log p but for a constant."""
        factor, _, squares = self._solved(ratio)
        if not math.isfinite(squares):
            return -math.inf
        n = self._n
        return -(n - 1) * ratio - float(np.sum(np.log(factor[0]))) - 0.5 * (n - 2) * math.log(max(squares, 1e-300))

    def best(self) -> tuple[float, float]:
        """(log p, log r) at its maximum."""
        tried = {at: self.likelihood(at) for at in np.arange(STIFFEST, SOFTEST + FIRST, FIRST).tolist()}
        at, step = max(tried, key=lambda k: tried[k]), FIRST / 2.0
        while step > LAST:
            for other in (at - step, at + step):
                tried.setdefault(other, self.likelihood(other))
            at, step = max(tried, key=lambda k: tried[k]), step / 2.0
        return tried[at], at

    def solve(self, ratio: float) -> tuple[tuple[Array, Array], float, float]:
        """((position, speed), R, standard deviation of the speed in the middle)."""
        from scipy.linalg import lapack

        factor, x, squares = self._solved(ratio)
        scale = squares / max(self._n - 2, 1)
        unit = np.zeros(2 * self._n)
        place = 2 * (self._n // 2) + 1
        unit[place] = 1.0
        spread, _ = lapack.dpbtrs(factor, unit, lower=1)
        return (x[0::2] + self._origin, x[1::2]), scale, math.sqrt(max(scale * float(spread[place]), 0.0))
