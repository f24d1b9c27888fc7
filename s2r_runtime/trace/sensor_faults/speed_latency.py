"""A speed that a controller made of positions comes late: a filter that looks back only is behind by its time constant, and the difference
of the last two positions by half a row.

Against the speed v that positions alone say (`speed_spline`: a spline looks both ways, and is not late), a recorded one is

    s_k = v_k - late a_k + noise,      a_k = (v_{k+1} - v_{k-1}) / (t_{k+1} - t_{k-1})

to first order, for a filter as for a delay. Least squares gives `late` with its error, from blocks of time. Rows that are off by
themselves are told by what a line through most of the acceleration leaves (least absolute errors): an arm that rests half of the
time is off, whenever it moves, by many times what it usually is. Rows are not asked at which an encoder that stood still goes on:
their acceleration is far beyond that by which half of all changes of speed came about. A speed that is late has the friction at
the wrong time, and looks like an actuator that answers late; the positions tell it better.

By less than a row, a position may as well come early: a simulator that steps by q+ = q + h v+ says so. Then the speed answers an input b
that is held from row to row at once; one that is late by a share c of a row answers with c of the one before,

    s_{k+1} - s_k - h b_{k-d} = c h (b_{k-d-1} - b_{k-d}) + noise

where the actuator is d whole rows late besides.

Of positions that were rounded, a speed that is their last difference is late without a doubt, though rounding hides by how much.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation.noise import quantum
from s2r_runtime.trace.estimation.speed_spline import Smoothed

Array = NDArray[np.float64]

SURELY, BLOCKS = 8.0, 10
"""Standard errors by which a speed must be late, from the scatter of so many blocks of time."""

ROWS, LEAST = 0.6, 0.1
"""Of the rows' distance: what it must be late by for inputs not to be asked, and at least. The spline's speed is late or early by up to a
fiftieth of a row where an actuator answers late.
"""

ANSWERS = 0.5
"""Of what a speed is late by, that with which it must answer inputs late, within twice the error of that."""

DELAYED = 10
"""Rows by which an actuator may answer late besides."""

MOSTLY = 0.5
"""Of what a recorded speed differs by from that of the positions, mean square, which must be its coming late; and of what it answers by
without such rows, what they must explain.
"""

FAR = 6.0
"""Times its usual size from which a value is off by itself, and is cut off there."""

SAME = 0.05
"""Of how differences change from row to row: so near to the last one is a speed that was made of it and printed with a few digits."""


def late(t: Array, recorded: Array, pushed: Array, found: Smoothed) -> float:
    """s by which a recorded speed (n,) at t (n,) is late, if that is beyond doubt and most of what is wrong with it; else 0.
    pushed: (n - 1,) acceleration by the inputs from row to row.
    """
    if len(t) < 8 * BLOCKS:
        return 0.0
    row = float(np.median(np.diff(t)))
    v = found.speed
    a = (v[2:] - v[:-2]) / (t[2:] - t[:-2])
    off = (v - recorded)[1:-1]
    usual = np.abs(a) <= FAR * _weighted_median(np.abs(a), np.abs(a))
    a = a[usual]
    off = _near_a_line(a, off[usual])
    seconds, error = _slope(a, off)
    explained = 1.0 - float(np.sum((off - seconds * a) ** 2) / max(float(np.sum(off * off)), 1e-300))
    sure = seconds > max(SURELY * error, LEAST * row) and explained > MOSTLY
    return seconds if sure and (seconds > ROWS * row or _answers_late(t, recorded, pushed, seconds)) else 0.0


def of_differences(t: Array, recorded: Array, position: Array, pushed: Array) -> float:
    """Half a row (s), if a speed is the difference of the last two of positions that were rounded; else 0."""
    if len(t) < 8 * BLOCKS or quantum(position[:-1], position[1:]) == 0.0:
        return 0.0
    made = np.diff(position) / np.diff(t)
    change = float(np.sqrt(np.mean(np.diff(made) ** 2)))
    same = float(np.sqrt(np.mean((recorded[1:] - made) ** 2))) < SAME * change
    half = 0.5 * float(np.median(np.diff(t)))
    return half if same and _answers_late(t, recorded, pushed, half) else 0.0


def _answers_late(t: Array, recorded: Array, pushed: Array, seconds: float) -> bool:
    """Whether a speed that is late by less than a row answers what was asked a part of a row before, or nothing tells. Whole rows are an
    actuator's: a simulator's speeds are in time, whatever it delays.
    """
    h = np.diff(t)
    first = min(DELAYED, len(h) // 2)
    at = np.arange(first + 1, len(h))
    found = []
    for rows in range(first + 1):
        asked = h[at] * pushed[at - rows]
        before = h[at] * pushed[at - rows - 1] - asked
        off = _without_outliers(np.diff(recorded)[at] - asked)
        share, error = _slope(before, off)
        share = float(np.clip(share, 0.0, 1.0))
        found.append((float(np.sum((off - share * before) ** 2)), share, error))
    best = min(found, key=lambda one: one[0])
    _, share, error = best if best[0] < (1.0 - MOSTLY) * found[0][0] else found[0]
    return min(share, 1.0 - share) + 2.0 * error > ANSWERS * seconds / float(np.median(h))


def _without_outliers(off: Array) -> Array:
    """Less its median, cut off at FAR times its usual size."""
    off = off - float(np.median(off))
    limit = FAR * float(np.median(np.abs(off))) + 1e-300
    return np.asarray(np.clip(off, -limit, limit))


def _near_a_line(x: Array, y: Array) -> Array:
    """y (n,) less its median, cut off at FAR times its usual distance from the line through 0 of least absolute errors on x (n,):
    usual where x is large, as only that says anything of the line.
    """
    y = y - float(np.median(y))
    some = x != 0.0
    if not np.any(some):
        return y
    line = _weighted_median(y[some] / x[some], np.abs(x[some])) * x
    limit = FAR * _weighted_median(np.abs(y - line)[some], x[some] ** 2) + 1e-300
    return np.asarray(line + np.clip(y - line, -limit, limit))


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(below, 0.5 * below[-1])]])


def _slope(x: Array, y: Array) -> tuple[float, float]:
    """Least squares of y on x, with the standard error by BLOCKS of time; (0, inf) where x is none."""
    power, product = (np.array([float(np.sum(part)) for part in np.array_split(e, BLOCKS)]) for e in (x * x, x * y))
    if not power.sum() > 0.0:
        return 0.0, float("inf")
    slope = float(product.sum() / power.sum())
    return slope, float(np.sqrt(np.sum((product - slope * power) ** 2))) / float(power.sum())
