"""Where a sine stands out in noisy, gappy data: weighted least squares over frequency (Lomb-Scargle, with weights).

Data d_k at t_k mean  d_k = w_k (a sin + b cos)(2 pi f t_k) + noise of variance ~ w_k,  that is, w_k = |p_k|² and d_k = p_k . r_k for a
residual r_k that a disturbance s pushes by p_k s. The drop of the sum of squares by a sine of frequency f is

    P(f) = S' M^-1 S,   S = sum d (cos, sin),   M = sum w (cos, sin)(cos, sin)'

On a grid of dt (t rounded to it) S is one Fourier transform, and M, from cos² = (1 + cos 2x)/2, another one taken at 2 f. Peaks are ranked
by their height over the usual level around them, since measured states make a residual's noise grow with frequency; then the best are
refined with the exact stamps. The level is that without the highest peak, if that is lower: through gaps (stretches that are held out,
between runs) a strong sine leaks into all frequencies around, and stands out of its own leakage less than chance does elsewhere. Each peak
is taken out before the next one is looked for (CLEAN: D. Roberts, J. Lehár, J. Dreher, Astronomical Journal 93 (1987) 968). Sines slower
than SLOWEST periods over all of the data cannot be told from a drift and are left out.

N. R. Lomb, Astrophysics and Space Science 39 (1976) 447; J. D. Scargle, Astrophysical Journal 263 (1982) 835; for weights and the mean
M. Zechmeister, M. Kürster, Astronomy and Astrophysics 496 (2009) 577.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OVERSAMPLED = 4
"""Frequencies a resolution (one over the data's length): a peak between two of them keeps 95 % of its height."""

MOST = 1 << 20
"""Points of the transform at most; a longer recording is cut into so many, and looked at for slower sines only."""

SLOWEST = 1.5
BANDS = 40
"""Of frequency, in each of which the median is the usual level."""

ZOOM = (11, 3)
"""Frequencies looked at around a peak, and how often the range is narrowed to their spacing."""


class Peak(NamedTuple):
    """sine, cosine: a, b of a sin(2 pi f t) + b cos(2 pi f t)."""

    frequency: float
    sine: float
    cosine: float


def peaks(t: Array, d: Array, w: Array, dt: float, count: int) -> list[Peak]:
    """The `count` frequencies that stand out most. t, d, w: (n,), t ascending; dt: the usual spacing."""
    span = float(t[-1] - t[0]) if len(t) else 0.0
    if len(t) < 8 or span <= 0.0 or not np.any(w > 0.0):
        return []
    d = d - w * (d.sum() / w.sum())
    grid = max(dt, OVERSAMPLED * span / MOST)
    found: list[Peak] = []
    while len(found) < count:
        frequency, power = _spectrum(t - t[0], d, w, grid)
        usable = (frequency > SLOWEST / span) & (frequency < 0.5 / dt)
        power = np.where(usable, power, 0.0)
        if not np.any(power > 0.0):
            break
        highest, width = int(np.argmax(power)), float(frequency[1] - frequency[0])
        peak = _refined(float(frequency[highest]), width, t, d, w)
        rest = _without(peak, t, d, w)
        level = np.minimum(_usual(power, usable), _usual(_spectrum(t - t[0], rest, w, grid)[1], usable))
        k = int(np.argmax(power / level))
        if k != highest:
            peak = _refined(float(frequency[k]), width, t, d, w)
            rest = _without(peak, t, d, w)
        found.append(peak)
        d = rest
    return found


def _without(peak: Peak, t: Array, d: Array, w: Array) -> Array:
    """d (n,) less what the sine does to it."""
    angle = 2.0 * np.pi * peak.frequency * t
    return np.asarray(d - w * (peak.sine * np.sin(angle) + peak.cosine * np.cos(angle)))


def _spectrum(t: Array, d: Array, w: Array, dt: float) -> tuple[Array, Array]:
    """(frequencies, P)."""
    from scipy.fft import next_fast_len, rfft

    place = np.rint(t / dt).astype(np.int64)
    length = next_fast_len(OVERSAMPLED * (int(place[-1]) + 1), real=True)
    sums = rfft(np.bincount(place, d, minlength=length), length)
    double = rfft(np.bincount(place, w, minlength=length), length)
    index = np.arange(length // 4 + 1)  # beyond this one twice the frequency is past Nyquist's, where the transform is mirrored
    rest = np.arange(length // 4 + 1, len(sums))
    twice = np.concatenate([double[2 * index], np.conj(double[np.maximum(length - 2 * rest, 0)])])
    total = w.sum()
    cc, ss, cs = 0.5 * (total + twice.real), 0.5 * (total - twice.real), -0.5 * twice.imag
    c, s = sums.real, -sums.imag
    det = cc * ss - cs * cs
    power = (ss * c * c - 2.0 * cs * c * s + cc * s * s) / np.maximum(det, 1e-9 * total * total)
    return np.arange(len(sums)) / (length * dt), power


def _usual(power: Array, usable: NDArray[np.bool_]) -> Array:
    """Median of the power around each frequency."""
    inside = np.flatnonzero(usable)
    if not len(inside):
        return np.ones_like(power)
    bands = min(BANDS, max(1, len(inside) // (8 * OVERSAMPLED)))
    each, more = divmod(len(inside), bands)  # as many in each, and one more in the first ones
    first = more * (each + 1)
    parts = [part.reshape(-1, size) for part, size in ((inside[:first], each + 1), (inside[first:], each)) if len(part)]
    middle, level = (np.concatenate([np.median(of[part], axis=1) for part in parts]) for of in (np.arange(len(power)), power))
    return np.asarray(np.maximum(np.interp(np.arange(len(power)), middle, level), 1e-300))


def _refined(frequency: float, width: float, t: Array, d: Array, w: Array) -> Peak:
    """The best frequency within ± width, with the stamps as they are."""
    points, rounds = ZOOM
    best = frequency
    a = b = 0.0
    for _ in range(rounds):
        tried = np.maximum(best + width * np.linspace(-1.0, 1.0, points), 1e-3 * width)
        angle = 2.0 * np.pi * np.outer(t, tried)
        c, s = np.cos(angle), np.sin(angle)
        cc, ss, cs = w @ (c * c), w @ (s * s), w @ (c * s)
        dc, ds = d @ c, d @ s
        det = np.maximum(cc * ss - cs * cs, 1e-14 * cc * ss + 1e-300)  # below that it is rounding
        beta, alpha = (ss * dc - cs * ds) / det, (cc * ds - cs * dc) / det
        k = int(np.argmax(beta * dc + alpha * ds))
        best, a, b = float(tried[k]), float(alpha[k]), float(beta[k])
        width *= 2.0 / (points - 1)
    return Peak(best, a, b)
