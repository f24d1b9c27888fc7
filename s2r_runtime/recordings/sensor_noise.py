"""How noisy are measurements of a moving robot? Standard deviation of each state, from its stream alone.

Four neighbouring stamps: the second value against the parabola through the other three. Over so short a time the motion is a
parabola but for a rest of third order in the step, while white noise of deviation sigma leaves sigma sqrt(1 + w1^2 + w3^2 + w4^2),
the w being Lagrange's weights at those stamps. The median of the absolute values gives sigma, whatever a few jumps do.

What it can't see: noise slower than four stamps (drift, a filter's ripple), and where a sensor repeats its value most of the time, any:
then there is no answer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FEWEST = 30
"""Sets of four below which a median says little (its standard error is then 20 %)."""
NORMAL_MAD = 0.6744897501960817
"""Median of |z| of a standard normal z."""
AT_ONCE = 100_000
"""Sets of four in memory at a time."""
GAP = 2.5
"""Steps of this many median steps are not neighbours any more."""


def stream_noise(t: Array, x: Array, segment: NDArray[np.int64] | None = None) -> Array | None:
    """t: (N,) s; x: (N, nx), NaN where nothing was received, angles unwrapped. (nx,), or None if any state doesn't show its noise."""
    found = [_deviation(t, x[:, column], segment) for column in range(x.shape[1])]
    return np.array(found) if all(sigma is not None for sigma in found) else None


def _deviation(t: Array, values: Array, segment: NDArray[np.int64] | None) -> float | None:
    received = np.flatnonzero(np.isfinite(values))
    if len(received) < FEWEST + 3:
        return None
    usual = float(np.median(np.diff(t[received])))
    if usual <= 0.0:
        return None
    parts = [_misfits(t, values, segment, received[a : a + AT_ONCE + 3], usual) for a in range(0, len(received) - 3, AT_ONCE)]
    misfits = np.concatenate(parts)
    if len(misfits) < FEWEST:
        return None
    sigma = float(np.median(misfits)) / NORMAL_MAD
    return sigma if sigma > 0.0 else None


def _misfits(t: Array, values: Array, segment: NDArray[np.int64] | None, received: NDArray[np.int64], usual: float) -> Array:
    """(m,) how far the second of four neighbours is off the parabola, in units of what unit noise makes; usual: s between stamps."""
    rows = np.lib.stride_tricks.sliding_window_view(received, 4)
    stamps, x = t[rows], values[rows]
    steps = np.diff(stamps, axis=1)
    near = np.all((steps > 0.1 * usual) & (steps < GAP * usual), axis=1)
    if segment is not None:
        near &= segment[rows[:, 0]] == segment[rows[:, 3]]
    stamps, x = stamps[near], x[near]
    others = (0, 2, 3)
    rest, power = x[:, 1].copy(), np.ones(len(x))
    for i in others:
        weight = np.ones(len(x))
        for j in others:
            if j != i:
                weight *= (stamps[:, 1] - stamps[:, j]) / (stamps[:, i] - stamps[:, j])
        rest -= weight * x[:, i]
        power += weight**2
    return np.asarray(np.abs(rest) / np.sqrt(power))
