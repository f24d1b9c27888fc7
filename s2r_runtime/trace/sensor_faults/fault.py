"""A fault of measurement, and from where on something is one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from s2r_runtime.trace.data.dataset import Dataset

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SIGMAS = 8.0
"""Robust standard deviations from which a single residual is suspected."""

FROZEN_ROWS = 5
"""Rows that repeat a state exactly before it counts as frozen."""

RESTLESS, RESTS, REPEATS = 12, 60, 0.01
"""Rows of exact repeats that are no rest of what jitters; rows elsewhere from which it is told that it does; share of these that repeats at
most.
"""

LEAPS, USUALLY = 3.0, 0.99
"""Times what all but a few changes from row to row stay within: what repeats, and then leaps by more, went on while nobody told it."""

QUANTA = 6.0
"""Least changes by which a state must have moved on while it repeated: below that it may be resolution."""


@dataclass(frozen=True)
class Fault:
    """An interval of the recording, s since its first stamp. channel: a state, or `*`. kind: as docs/json.md. segment: what the recording
    calls the run that it is in, if it has several.
    """

    from_s: float
    to_s: float
    channel: str
    kind: str
    segment: str = ""


def fault_of(data: Dataset, run: int, rows: tuple[int, int], channel: str, kind: str) -> Fault:
    """One of a run, from its first row to its last."""
    begin, (first, last) = data.runs[run].start_s, rows
    return Fault(begin + data.dt * first, begin + data.dt * last, channel, kind, data.segment_of(run))


def stretches(yes: Mask) -> list[tuple[int, int]]:
    """[a, b) of each run of True in (K,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], yes.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def leaps(change: Array, within: tuple[int, int]) -> bool:
    """Whether a state that hardly ever repeats stops on its way, repeats for long, and leaps then: a robot comes to rest, and sets out from
    there. One that stands when the recording begins may be kicked. change: (K,) from row to row, NaN across a pause; within: [a, b) that
    repeats.
    """
    a, b = within
    usual = _usual(change, within)
    return usual is not None and bool(np.nanmax(change[a - FROZEN_ROWS : a], initial=0.0) >= usual[0] and change[b] > LEAPS * usual[1])


def springs(change: Array, within: tuple[int, int]) -> bool:
    """The same of a position that need not have been on its way, if it goes on by far less than it leaps: kicked, it would be under way."""
    _, b = within
    usual = _usual(change, within)
    after = change[b + 1 : b + 1 + FROZEN_ROWS]
    return usual is not None and bool(np.any(np.isfinite(after)) and change[b] > LEAPS * max(usual[1], float(np.nanmax(after))))


def _usual(change: Array, within: tuple[int, int]) -> tuple[float, float] | None:
    """By how much a state changes in the middle, and at most but for a few rows; None where it repeats for too short, or elsewhere, too."""
    a, b = within
    if b - a < RESTLESS or a < FROZEN_ROWS or b >= len(change) or not np.isfinite(change[b]):
        return None
    others = np.isfinite(change)
    others[a : b + 1] = False
    if np.count_nonzero(others) < RESTS or float(np.mean(change[others] == 0.0)) >= REPEATS:
        return None
    return float(np.median(change[others])), float(np.quantile(change[others], USUALLY))
