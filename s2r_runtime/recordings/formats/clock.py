"""One clock for states that their sender stamped and commands that only the recorder stamped.

    s = l              if the fastest state was recorded 0 to 0.5 s after its stamp: it is the same clock
    s = l - delay(l)   otherwise (simulated time, another computer's clock); delay: the least of l - s over states of the same second

l: when a message was recorded, s: the clock of the stamps. Where l - s jumps by more than a second the clock was set, or began
again: another stretch. Below half a second an offset of clocks cannot be told from a delay, and is taken for one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JUMP_S = 1.0
SAME_CLOCK_S = (-0.01, 0.5)
BIN_S = 1.0


class Stretch(NamedTuple):
    """rows: from and to, of the states. since, until: of the recorder's clock, s: messages without a stamp between them belong to it."""

    rows: slice
    since: float
    until: float


def stretches(recorded: Array, stamps: Array) -> list[Stretch]:
    """Where the stamps' clock is one. recorded, stamps: (N,) s, in the order of recording."""
    cuts = [0, *(np.flatnonzero(np.abs(np.diff(recorded - stamps)) > JUMP_S) + 1).tolist(), len(stamps)]
    # a command between two stretches is of the nearer one
    edges = [-np.inf, *((recorded[cut - 1] + recorded[cut]) / 2 for cut in cuts[1:-1]), np.inf]
    return [Stretch(slice(cuts[k], cuts[k + 1]), float(edges[k]), float(edges[k + 1])) for k in range(len(cuts) - 1)]


def on_stamps(recorded: Array, stamps: Array, at: Array) -> Array:
    """Recorded times `at` (m,) on the clock of the stamps, of one stretch with rows (recorded, stamps), both (N,)."""
    delay = recorded - stamps
    least = float(delay.min())
    if SAME_CLOCK_S[0] <= least <= SAME_CLOCK_S[1]:
        return at
    bins = np.floor((recorded - recorded[0]) / BIN_S)
    order = np.lexsort((delay, bins))
    best = np.sort(order[np.unique(bins[order], return_index=True)[1]])
    return np.asarray(at - np.interp(at, recorded[best], delay[best]))


def newer(stamps: Array) -> NDArray[np.bool_]:
    """(N,) which rows are newer than all before them."""
    return np.concatenate([[True], stamps[1:] > np.maximum.accumulate(stamps)[:-1]]) if len(stamps) else np.empty(0, dtype=np.bool_)
