"""Minima and maxima over windows ahead, O(T) whatever the window's length. Batched: (T, n), time first.

    result[k] = op(x[k + first], ..., x[k + last]),   clipped to the trace; over nothing: +inf (minimum), -inf (maximum)

van Herk 1992, Gil and Werman 1993: cut the trace into blocks as long as the window, w; a window of w samples is the end of one block and
the beginning of the next, so with cumulative extrema from both ends of every block it costs one more comparison.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Extremum = Literal["min", "max"]

WIDE = 48
"""Rows of at least so many runs are compared row by row; narrower ones by `accumulate`, which costs more a number and less a call."""

_OPERATIONS = {"min": np.minimum, "max": np.maximum}
_NOTHING = {"min": np.inf, "max": -np.inf}


def ahead(kind: Extremum, x: Array, first: int, last: int | None, count: int) -> Array:
    """The extremum over [k + first, k + last] for k = 0 .. count - 1, (count, n). last None: to the end of the trace."""
    steps, n = x.shape
    out = np.full((count, n), _NOTHING[kind])
    known = min(count, steps - first)  # windows from here on begin behind the trace
    if known <= 0:
        return out
    y = x[first:]
    if last is None or last - first + 1 >= len(y):
        out[:known] = _cumulated(kind, y[::-1])[::-1][:known]
    else:
        out[:known] = _sliding(kind, y, last - first + 1)[:known]
    return out


def _sliding(kind: Extremum, x: Array, w: int) -> Array:
    """op(x[k .. k+w-1]), clipped at the end, (T, n); w < T."""
    if w == 1:
        return x
    steps, n = x.shape
    blocks = -(-steps // w) + 1  # one more of nothing, for the windows that begin in the last
    padded = np.full((blocks * w, n), _NOTHING[kind])
    padded[:steps] = x
    cut = padded.reshape(blocks, w, n)
    ends = _cumulated(kind, cut[:, ::-1].swapaxes(0, 1)).swapaxes(0, 1)[:, ::-1]
    begins = _cumulated(kind, cut.swapaxes(0, 1)).swapaxes(0, 1)
    ends, begins = ends.reshape(-1, n), begins.reshape(-1, n)
    return np.asarray(_OPERATIONS[kind](ends[:steps], begins[w - 1 : w - 1 + steps]))


def _cumulated(kind: Extremum, x: Array) -> Array:
    """Extremum of x[0 .. k] along the first axis."""
    operation = _OPERATIONS[kind]
    if x[0].size < WIDE:
        return np.asarray(operation.accumulate(x, axis=0))
    out = np.array(x, order="C")
    for k in range(1, len(out)):
        operation(out[k], out[k - 1], out=out[k])
    return out


def until(left: Array, right: Array, first: int, last: int | None, count: int) -> Array:
    """max over t in [k + first, k + last] of min(right[t], min of left over [k, t)), (count, n); all of the trace must be given.

    With `a until b` unbounded, u[k] = max(right[k], min(left[k], u[k+1])), a bounded one is (Donze, Ferrere, Maler 2013; it holds at
    every threshold, so it holds for the values)

        min( max of right over [k + first, k + last],  min of left over [k, k + first - 1],  u[k + first] )
    """
    steps, n = left.shape
    unbounded = np.array(right)
    for k in range(steps - 2, -1, -1):
        np.maximum(unbounded[k], np.minimum(left[k], unbounded[k + 1]), out=unbounded[k])
    if first == 0:
        out = np.full((count, n), -np.inf)
        out[: min(count, steps)] = unbounded[:count]
    else:
        out = np.full((count, n), -np.inf)
        known = max(0, min(count, steps - first))
        out[:known] = unbounded[first : first + known]
        np.minimum(out, ahead("min", left, 0, first - 1, count), out=out)
    return out if last is None else np.minimum(out, ahead("max", right, first, last, count))
