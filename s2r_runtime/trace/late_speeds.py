"""A speed that a controller made of positions comes late: a filter that looks back only is behind by its time constant.

Against the speed v that positions alone say (`speeds`: a spline looks both ways, and is not late), a recorded one is

    s_k = v_k - late a_k + noise,      a_k = (v_{k+1} - v_{k-1}) / (t_{k+1} - t_{k-1})

to first order, for a filter as for a delay. Least squares gives `late` with its error, from blocks of time. A speed that is late
has the friction at the wrong time, and looks like an actuator that answers late; the positions tell it better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.speeds import Smoothed

Array = NDArray[np.float64]

SURELY, BLOCKS = 8.0, 10
"""Standard errors by which a speed must be late, from the scatter of so many blocks of time."""

ROWS = 0.6
"""Of the rows' distance: what it must be late at least. A difference of the last two positions is late by half of it."""

MOSTLY = 0.5
"""Of what a recorded speed differs by from that of the positions, mean square, which must be its coming late."""


def late(t: Array, recorded: Array, found: Smoothed) -> float:
    """s by which a recorded speed (n,) at t (n,) is late, if that is beyond doubt and most of what is wrong with it; else 0."""
    if len(t) < 8 * BLOCKS:
        return 0.0
    v = found.speed
    a = (v[2:] - v[:-2]) / (t[2:] - t[:-2])
    off = (v - recorded)[1:-1]
    off = off - float(np.median(off))
    limit = 6.0 * float(np.median(np.abs(off))) + 1e-300
    off = np.clip(off, -limit, limit)
    power, product = (np.array([float(np.sum(part)) for part in np.array_split(e, BLOCKS)]) for e in (a * a, a * off))
    if not power.sum() > 0.0:
        return 0.0
    seconds = float(product.sum() / power.sum())
    error = float(np.sqrt(np.sum((product - seconds * power) ** 2))) / float(power.sum())
    explained = 1.0 - float(np.sum((off - seconds * a) ** 2) / max(float(np.sum(off * off)), 1e-300))
    sure = seconds > max(SURELY * error, ROWS * float(np.median(np.diff(t)))) and explained > MOSTLY
    return seconds if sure else 0.0
