"""Noise of an axis whose speed was not measured: of its position's measurement (R), and of what pushes it (Q, on the speed).

The speed that stands in the recording (`speed_spline`) is where the model is stepped from, not a measurement: it is given a measurement
noise beyond all bounds, K R. The residual of position and speed,

    r_k = (p, v)_{k+1} - f(p, v)_k = w_k + e_{k+1} - F_k e_k,      e ~ (0, R diag(1, K)),  w ~ (0, Q (h^2/3 h/2; h/2 1)),

then says of the model what the positions alone say of it, whatever the speeds are (to first order in their errors): its likelihood is
that of the innovations of a Kalman filter that begins without any speed. With Q/R = l, the covariance is R S(l), and R = r' S^-1 r / n.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BEYOND = 10.0
"""Times the speed's usual size, standard deviation: as good as none, and no rounding errors."""

SMALLEST, LARGEST, COARSE = -28.0, 7.0, 2.5
"""log of l dt^2 that are looked at first, and how far apart."""

STEP, LAST, NARROWER = 0.6, 0.5, 0.3
"""First and last step of the search from where it was before; by parabolas, right to a few hundredths after one such step."""


def of_axis(
    r: Array, f: Array, joined: Mask, extra: Array, floor: tuple[float, float, float], near: tuple[float, float] | None
) -> tuple[float, float]:
    """(Q, R) by maximum likelihood. r: (n, 2) of position and speed; f: (n, 2, 2); extra: (n,) variance of the position's residual besides.

    floor: least Q, least R, variance of the speed. near: (Q, R) where to look first.
    """
    dt2 = max(float(np.mean(f[:, 0, 1] ** 2)), 1e-300)
    guess = max(near[1] if near else 0.5 * float(np.median(np.abs(np.diff(r[:, 0], prepend=0.0)))) ** 2, floor[1], 1e-300)
    given = _Band(r, f, joined, extra / guess, floor[2] / guess, floor)
    known: dict[float, tuple[float, float]] = {}

    def cost(at: float) -> float:
        if at not in known:
            known[at] = given.cost(math.exp(at) / dt2)
        return known[at][0]

    if near is None:
        best = min(np.arange(SMALLEST, LARGEST, COARSE).tolist(), key=cost)
    else:
        best = min(max(math.log(max(near[0], 1e-300) / guess * dt2), SMALLEST), LARGEST)
    step = STEP if near else 0.5 * COARSE
    while step > LAST:
        below, above = best - step, best + step
        other = min((below, above), key=cost)
        if cost(other) < cost(best) and SMALLEST <= other <= LARGEST:
            best = other
            continue
        bend = cost(below) - 2.0 * cost(best) + cost(above)
        vertex = best + 0.5 * step * (cost(below) - cost(above)) / bend if bend > 0.0 and math.isfinite(bend) else best
        best = min((best, min(max(vertex, SMALLEST), LARGEST)), key=cost)
        step *= NARROWER
    scale = known[best][1]
    return max(math.exp(best) / dt2 * scale, floor[0]), max(scale, floor[1])


class _Band:
    """S, of one axis, as LAPACK has bands: four rows for two numbers a step."""

    def __init__(self, r: Array, f: Array, joined: Mask, extra: Array, beyond: float, floor: tuple[float, float, float]) -> None:
        n = len(r)
        self._r, self._n, self._floor = r.reshape(-1, 1), n, floor
        noise = np.array([1.0, beyond])
        rf = f * noise
        own = np.einsum("kij,klj->kil", rf, f)
        own[:, 0, 0] += 1.0 + extra
        own[:, 1, 1] += beyond
        band = np.zeros((4, n, 2))
        band[0, :, 0], band[0, :, 1], band[1, :, 0] = own[:, 0, 0], own[:, 1, 1], own[:, 1, 0]
        link = np.where(joined[1:, None, None], -rf[1:], 0.0)  # (row of step k + 1, column of step k)
        h = f[:, 0, 1]
        self._pushed = h * h / 3.0, h / 2.0
        band[2, :-1, 0], band[2, :-1, 1], band[3, :-1, 0], band[1, :-1, 1] = link[:, 0, 0], link[:, 1, 1], link[:, 1, 0], link[:, 0, 1]
        self._band = band

    def cost(self, ratio: float) -> tuple[float, float]:
        """(- log likelihood, R) at l."""
        from scipy.linalg import lapack

        band = self._band.copy()
        band[0, :, 1] += ratio
        band[0, :, 0] += ratio * self._pushed[0]
        band[1, :, 0] += ratio * self._pushed[1]
        lower, info = lapack.dpbtrf(band.reshape(4, -1), lower=1, overwrite_ab=1)
        if info != 0:
            return math.inf, self._floor[1]
        z, _ = lapack.dtbtrs(lower, self._r, uplo="L")
        squares = float(z.ravel() @ z.ravel())
        scale = max(squares / self._n, self._floor[1], 1e-300)
        return float(np.log(lower[0]).sum()) + 0.5 * self._n * math.log(scale) + 0.5 * squares / scale, scale
