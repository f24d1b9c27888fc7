"""Derivatives of measured positions without delay: a low-pass of stated bandwidth, and the bandwidth that the data bear.

    x_B = h * x,   d^m x_B / dt^m = F^-1[(i 2 pi f)^m H(f) X(f)]          x: (n, c), one row every dt s

h is a sinc of cutoff B cut off by a Kaiser window (flat to 0.75 B, half at B, 60 dB down from 1.25 B on), symmetric, so nothing is
delayed; its derivatives are exact. What is behind a recording's ends is taken to be its point reflection there.

Bandwidth: with P(f) the spectral density of x and N its floor in the highest octave (white measurement noise), the signal is seen up to
f_N, where P falls below SEEN N; B is where all but CUT of the power of the m-th derivative below f_N lies: what it says of the motion is
within. Smooth motion says it in so narrow a band that few rows are independent; B is then wider, up to ROWS of them, as long as
the derivative's noise within, the integral of N (2 pi f)^2m, stays below NOISY of its power.

Inputs are filtered alike (parallel filtering: M. Gautier, P. Poignet, Extended Kalman filtering and weighted least squares dynamic
identification of robot, Control Engineering Practice 9, 2001): a linear model then holds between them as it did before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TRANSITION = 0.5
"""Width of the transition over the bandwidth; a narrower one rings longer."""

ATTENUATION_DB = 60.0
"""Of what is beyond it: a thousandth of the measurement's noise."""

SEEN = 4.0
"""Spectral density over the noise's floor down to which a signal is seen; an average over a dozen bins is rarely wrong by half of that."""

CUT = 1e-3
"""Share of a derivative's power that is given up."""

ROWS = 1500
"""Independent rows that are enough: a parameter that matters is known to a per cent or two."""

NOISY = 0.1
"""Noise power over signal power in a derivative that is still of use, since the tracer weighs it."""

BINS = 2048
"""Longest stretch of a spectral density, rows."""

HIGHEST = 0.4
"""Bandwidth over the sampling rate at most: above half of it nothing can be told."""

FEWEST = 16
"""Rows from which a spectral density says something."""


def low_pass(x: Array, dt: float, bandwidth: float, derivative: int = 0) -> Array:
    """x (n, c), or its derivative, within the bandwidth (Hz); rows near both ends lean on a reflection."""
    half = reach(dt, bandwidth)
    n = np.arange(-half, half + 1)
    h = np.sinc(2.0 * bandwidth * dt * n) * np.kaiser(2 * half + 1, _BETA)
    h /= h.sum()
    pad = min(2 * half, len(x) - 1)
    size = 1 << (len(x) + 2 * pad + 2 * half - 1).bit_length()
    circle = np.zeros(size)
    circle[: half + 1], circle[-half:] = h[half:], h[:half]
    response = np.fft.rfft(circle) * (2j * math.pi * np.fft.rfftfreq(size, dt)) ** derivative
    spectrum = np.fft.rfft(_closed(x, pad, size), axis=0) * response[:, None]
    return np.asarray(np.fft.irfft(spectrum, size, axis=0)[pad : pad + len(x)])


def reach(dt: float, bandwidth: float) -> int:
    """Rows before and after from which a filtered row is made."""
    return max(1, math.ceil((ATTENUATION_DB - 8.0) / (2.285 * 2.0 * math.pi * TRANSITION * bandwidth * dt) / 2.0))


_BETA = 0.1102 * (ATTENUATION_DB - 8.7)
"""Of the Kaiser window (J. F. Kaiser, Nonrecursive digital filter design using the I0-sinh window function, 1974)."""


def _closed(x: Array, pad: int, size: int) -> Array:
    """x with its reflections before and after, and a straight line from the end back to the beginning; (size, c)."""
    longer = np.concatenate([2.0 * x[:1] - x[pad:0:-1], x, 2.0 * x[-1:] - x[-2 : -pad - 2 : -1]]) if pad else x
    share = (np.arange(1, size - len(longer) + 1) / (size - len(longer) + 1))[:, None]
    return np.concatenate([longer, longer[-1:] + share * (longer[:1] - longer[-1:])])


def bandwidth(stretches: Sequence[Array], dt: float, derivative: int = 2, *, rows: int = ROWS) -> float:
    """Hz, of what the columns of x (n, c), in stretches without gaps, say about their derivative of that order. The column that says most
    decides: one in which nothing moves says nothing. To two digits, to be said and given again. rows: independent ones that are enough.
    """
    longest = max(len(x) for x in stretches)
    size = min(BINS, longest - 2)
    lowest, highest = 3.0 / (longest * dt), HIGHEST / dt
    if size < FEWEST:
        return highest
    f, density = _density(stretches, dt, size)
    enough = 0.5 * rows / (dt * sum(len(x) for x in stretches))
    found = [_seen(f, p, derivative, enough) for p in density.T]
    return float(f"{np.clip(max(found), min(lowest, highest), highest):.2g}")


def _density(stretches: Sequence[Array], dt: float, size: int) -> tuple[Array, Array]:
    """(f (m,), density of x (m, c)) by Welch's method on second differences, whose spectrum leaks little; f > 0."""
    window = np.hanning(size + 1)[:size, None]
    total, count = np.zeros((size // 2 + 1, stretches[0].shape[1])), 0
    for x in stretches:
        bent = np.diff(x, 2, axis=0)
        for first in range(0, len(bent) - size + 1, max(1, size // 2)):
            total += np.abs(np.fft.rfft(window * bent[first : first + size], axis=0)) ** 2
            count += 1
    f: Array = np.fft.rfftfreq(size, dt)[1:].astype(np.float64)
    per = total[1:] * (2.0 * dt / float(np.sum(window**2)) / max(count, 1))
    return f, np.asarray(per / ((2.0 * np.sin(math.pi * f * dt)) ** 4)[:, None])


def _seen(f: Array, density: Array, derivative: int, enough: float) -> float:
    """The bandwidth by one column. enough: Hz that give enough independent rows."""
    floor = float(np.median(density[f > 0.6 * f[-1]]))
    around = np.array([np.mean(density[(f >= at / 1.15) & (f <= at * 1.15)]) for at in f])
    lost = np.flatnonzero(around < SEEN * floor)
    seen = int(lost[0]) if len(lost) else len(f)
    power = np.cumsum(np.maximum(density[:seen] - floor, 0.0) * f[:seen] ** (2 * derivative))
    if seen == 0 or power[-1] <= 0.0:
        return float(f[0])
    needed = float(f[int(np.searchsorted(power, (1.0 - CUT) * power[-1]))])
    noise = np.cumsum(floor * f ** (2 * derivative))
    borne = float(f[min(int(np.searchsorted(noise, NOISY * power[-1])), len(f) - 1)])
    return max(needed, min(borne, enough))
