"""Two numbers a row, of which the first was measured: smoothed under a linear law, how much by the data themselves.

    x_{k+1} = F_k x_k + c_k + w_k      w ~ (0, s G_k)
    y_k     = (x_k)_1 + e_k            e ~ (0, R / weight_k)

With M the matrix of the normal equations (banded, two numbers a row) and S their least sum of squares over R, the likelihood of r = s/R is

    log p = -(n - 1) log r - 1/2 log|M| - (n - 2)/2 log S,             R = S / (n - 2)

with nothing known of the first row: G. Wahba, *Improper priors, spline smoothing and the problem of guarding against model errors in
regression*, J. R. Statist. Soc. B 40, 1978.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STIFFEST, SOFTEST, FIRST, LAST = -32.0, 6.0, 3.0, 0.2
"""log r that are looked at, where the second number moves the first by about itself in a row; first and last step of the search."""


class Smoother:
    """f: (n - 1, 2, 2); c: (n - 1, 2); inverse: of G, its 11, 12 and 22, each (n - 1,); y, weight: (n,)."""

    def __init__(self, f: Array, c: Array, inverse: tuple[Array, Array, Array], y: Array, weight: Array) -> None:
        n = len(y)
        self._n, self._y, self._weight = n, y, weight
        self._f, self._c, self._inverse = f, c, inverse
        i11, i12, i22 = inverse
        (f11, f12), (f21, f22) = f.transpose(1, 2, 0)
        gf11, gf12 = i11 * f11 + i12 * f21, i11 * f12 + i12 * f22  # G^-1 F
        gf21, gf22 = i12 * f11 + i22 * f21, i12 * f12 + i22 * f22
        prior = np.zeros((4, 2 * n))
        prior[0, 2::2] += i11
        prior[0, 3::2] += i22
        prior[1, 2::2] += i12  # both numbers of row k + 1
        prior[0, 0:-2:2] += f11 * gf11 + f21 * gf21
        prior[0, 1:-2:2] += f12 * gf12 + f22 * gf22
        prior[1, 0:-2:2] += f12 * gf11 + f22 * gf21
        prior[2, 0:-2:2] -= gf11
        prior[2, 1:-2:2] -= gf22
        prior[1, 1:-2:2] -= gf12
        prior[3, 0:-2:2] -= gf21
        self._prior = prior
        self._rhs = np.zeros(2 * n)
        g1, g2 = i11 * c[:, 0] + i12 * c[:, 1], i12 * c[:, 0] + i22 * c[:, 1]
        self._rhs[2::2] += g1
        self._rhs[3::2] += g2
        self._rhs[0:-2:2] -= f11 * g1 + f21 * g2
        self._rhs[1:-2:2] -= f12 * g1 + f22 * g2

    def _solved(self, ratio: float) -> tuple[Array, Array, float]:
        """(factor, x, S) at log r."""
        from scipy.linalg import lapack

        r = math.exp(ratio)
        m = self._prior / r
        m[0, 0::2] += self._weight
        rhs = self._rhs / r
        rhs[0::2] += self._weight * self._y
        factor, info = lapack.dpbtrf(m, lower=1)
        if info != 0:
            return factor, rhs, math.inf
        x, _ = lapack.dpbtrs(factor, rhs, lower=1)
        return factor, x, self._squares(x.reshape(-1, 2), r)

    def _squares(self, x: Array, r: float) -> float:
        """S, from what is left: the short form cancels where there is hardly any noise."""
        w1, w2 = (x[1:] - np.einsum("kij,kj->ki", self._f, x[:-1]) - self._c).T
        i11, i12, i22 = self._inverse
        off = self._y - x[:, 0]
        return float(np.sum(self._weight * off * off) + np.sum(i11 * w1 * w1 + 2.0 * i12 * w1 * w2 + i22 * w2 * w2) / r)

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

    def solve(self, ratio: float) -> tuple[Array, float, float]:
        """((n, 2) x, R, standard deviation of the second number in the middle)."""
        from scipy.linalg import lapack

        factor, x, squares = self._solved(ratio)
        scale = squares / max(self._n - 2, 1)
        unit = np.zeros(2 * self._n)
        place = 2 * (self._n // 2) + 1
        unit[place] = 1.0
        spread, _ = lapack.dpbtrs(factor, unit, lower=1)
        return x.reshape(-1, 2), scale, math.sqrt(max(scale * float(spread[place]), 0.0))
