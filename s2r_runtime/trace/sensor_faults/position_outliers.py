"""Faults of a position whose speed was not measured, told from its own rows: behind a low-pass, and a spline, nothing of them is left.

A body's position goes on at its pace. With d_k = p_{k+1} - p_k over h_k, and m_k the median pace of the rows around,

    off_k = d_k - m_k h_k                       of noise, rounding, and what accelerates the body
    jump:    |off_k| beyond noise, and beyond what the inputs do, with nothing like it beside
    spike:   one that is taken back within a few rows
    frozen:  p repeats exactly, and then makes up for the way that the pace before and after says; or it stops on its way, as it
             hardly ever repeats elsewhere, and leaps beyond what the inputs do; or leaps so from rest, and is not under way then

A blow, or an end stop, changes the pace from v to w, and m is between them at that row: off is half of (v - w) h before it, and the other
way after it, as if one row were wrong. So a jump and a spike must be beyond |w - v| h, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.sensor_faults.fault import FROZEN_ROWS, QUANTA, SIGMAS, Fault, leaps, springs, stretches

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

AROUND = 5
"""Rows on either side that tell the pace."""

APART = 2.5
"""Usual intervals from which on rows are too far apart."""

ALIKE = 0.3
"""Of a jump, that no row beside it may be off by."""

BEYOND = 3.0
"""Times what the largest force does in a row to the way that is made in it."""

MADE_UP = 0.5
"""Of the way that a frozen position missed, by which the first row after it may miss that."""

BRIEF = 3
"""Rows that a spike lasts at most."""

TAIL_SIGMAS = 4.0
"""Robust standard deviations from which rows of a sensor with many wild ones are left out, if they are away and back."""

MOST_WILD, BLOCK, BURSTS = 0.25, 40, 5.0
"""Share of steps that are wild at most, of a sensor with outliers; steps in which they are counted, and variance of these counts over their
mean from which on they come in bursts.
"""

FEWEST = 60
"""Rows from which noise is told."""

RARE = 0.01
"""Share of rows from which on what is wild is a property of the sensor."""


@dataclass(frozen=True)
class Mended:
    """parts: the rows that are right, cut where a position jumped; faults: s since `begin`; outliers: rows that are away, and back, of more
    than RARE, and no faults.
    """

    parts: tuple[Stream, ...]
    faults: tuple[Fault, ...]
    outliers: int


def mended(states: Stream, columns: Sequence[tuple[int, str]], pushed: Array, begin: float) -> Mended:
    """states: rows without gaps in any column; columns: (place, name) of positions of axes; pushed: (n - 1, k) acceleration that the inputs
    cause, of each of them; begin: s, of the recording.
    """
    lost, cuts, faults = np.zeros(len(states.t), dtype=bool), set[int](), []
    astray: list[tuple[int, Mask]] = []
    for (j, name), push in zip(columns, pushed.T, strict=True):
        wrong, jumps, told, away = _of_one(states.t, states.values[:, j], push)
        lost |= wrong
        astray.append((j, away))
        cuts |= set(jumps)
        faults += [Fault(float(states.t[a]) - begin, float(states.t[b]) - begin, name, kind) for a, b, kind in told]
    values = states.values.copy()
    gone = np.any([away for _, away in astray], axis=0)
    rests = ~(lost | gone)
    for j, away in astray:
        lost |= away & ~_bridged(states.t, values[:, j], away, rests, cuts)
    edges = [0, *(k + 1 for k in sorted(cuts)), len(states.t)]
    kept = [np.arange(a, b)[~lost[a:b]] for a, b in pairwise(edges)]
    parts = tuple(Stream(states.t[rows], values[rows]) for rows in kept if len(rows))
    return Mended(parts, tuple(faults), int(np.count_nonzero(gone)))


def _bridged(t: Array, column: Array, away: Mask, rests: Mask, cuts: set[int]) -> Mask:
    """(n,) rows that are astray next to one another, a few at most, through which a line is put here, in `column`, between rows that are
    right (`rests`) and belong together: a recording is not cut for them.
    """
    done = np.zeros(len(t), dtype=bool)
    for a, b in stretches(away):
        whole = 1 < b - a <= AROUND and a > 0 and b < len(t) and rests[a - 1] and rests[b]
        if whole and not any(k in cuts for k in range(a - 1, b)):
            column[a:b] = np.interp(t[a:b], t[[a - 1, b]], column[[a - 1, b]])
            done[a:b] = True
    return done


def _of_one(t: Array, p: Array, pushed: Array) -> tuple[Mask, list[int], list[tuple[int, int, str]], Mask]:
    """Rows that are wrong (n,), steps that jump, (from, to, kind) in rows, and rows (n,) that a sensor of many wild ones took away."""
    lost = np.zeros(len(p), dtype=bool)
    if len(p) < FEWEST:
        return lost, [], [], lost
    h, d = np.diff(t), np.diff(p)
    pace, blow = _pace(d / h)
    pauses = np.convolve(h > APART * np.median(h), np.ones(2 * AROUND + 1), mode="same") > 0.5
    off = np.where(pauses, 0.0, d - pace * h)  # across one, a pace says nothing
    changed = np.abs(d[d != 0.0])
    quantum = float(changed.min()) if len(changed) else 0.0
    noise = max(1.4826 * float(np.median(np.abs(off - np.median(off)))), quantum / 2.0)
    by_force = BEYOND * float(np.max(np.abs(pushed), initial=0.0)) * float(np.median(h)) ** 2
    least = SIGMAS * noise + by_force
    told: list[tuple[int, int, str]] = []
    changed_by = np.where(h > APART * np.median(h), np.nan, np.abs(d))
    for a, b in (one for one in stretches(d == 0.0) if one[1] - one[0] >= FROZEN_ROWS):
        around = np.concatenate(
            [d[max(a - AROUND, 0) : a] / h[max(a - AROUND, 0) : a], d[b + 1 : b + 1 + AROUND] / h[b + 1 : b + 1 + AROUND]]
        )
        if b >= len(d) or len(around) < AROUND:
            continue
        missed = float(np.median(around)) * float(t[b + 1] - t[a])
        made_up = abs(missed) > least + QUANTA * quantum and abs(float(d[b]) - missed) < MADE_UP * abs(missed)
        far = abs(float(d[b])) > least + QUANTA * quantum
        if made_up or (far and (leaps(changed_by, (a, b)) or springs(changed_by, (a, b)))):
            lost[a + 1 : b + 1] = True
            off[max(a - AROUND, 0) : b + 1 + AROUND] = 0.0  # the pace there is told from rows that stand still
            told.append((a, b, "frozen"))
    wild = np.flatnonzero(np.abs(off) > least + blow * h).tolist()
    many = len(wild) > max(RARE * len(p), 3.0)
    if many:  # the tail of what is found goes on below
        wild = np.flatnonzero(np.abs(off) > TAIL_SIGMAS * noise + by_force + blow * h).tolist()
    away = np.zeros(len(p), dtype=bool)
    if many:  # two of them in a row look like a jump
        for k in wild if _scattered(wild, len(off)) else ():
            path = np.cumsum(off[k : k + BRIEF + 2])
            back = np.flatnonzero(np.abs(path[1:]) < ALIKE * np.max(np.abs(path)))
            if len(back) and not np.any(away[k : k + 2]):
                away[k + 1 : k + 2 + int(back[0])] = True
        return lost, [], told, away
    spikes = _there_and_back(off, wild)
    for first, last in spikes:
        lost[first : last + 1] = True
    told += [(first, last, "spike") for first, last in spikes]
    jumps = [k for k in wild if _alone(off, k)]
    told += [(k + 1, _until(off, k, jumps, len(p)), "offset_jump") for k in _first_of_pairs(off, jumps)]
    return lost, jumps, told, away


def _scattered(wild: list[int], steps: int) -> bool:
    """Whether they come as by chance, and not in bursts: what rings is away and back, too. Of pairs that come by chance, counts in blocks
    have twice their mean for variance.
    """
    counts = np.bincount(np.array(wild, dtype=np.int64) // BLOCK, minlength=-(-steps // BLOCK))
    return len(wild) < MOST_WILD * steps and bool(np.var(counts) < BURSTS * np.mean(counts))


def _there_and_back(off: Array, wild: list[int]) -> list[tuple[int, int]]:
    """First and last rows that are away for a few rows at most; both steps of each are taken out of `wild`."""
    found, left = [], [*wild]
    while left:
        k = left.pop(0)
        back = next((m for m in left if m <= k + BRIEF and abs(off[m] + off[k]) < ALIKE * abs(off[k])), None)
        if back is not None:
            left.remove(back)
            wild.remove(k)
            wild.remove(back)
            found.append((k + 1, back))
    return found


def _pace(v: Array) -> tuple[Array, Array]:
    """(n,) median of the rows around each, itself left out, and by how much that of the rows after differs from that of those before; 0
    where there are none on one side.
    """
    padded = np.concatenate([np.full(AROUND, np.nan), v, np.full(AROUND, np.nan)])
    near = np.delete(np.lib.stride_tricks.sliding_window_view(padded, 2 * AROUND + 1), AROUND, axis=1)
    blow = np.zeros(len(v))
    blow[1:-1] = np.abs(np.nanmedian(near[1:-1, AROUND:], axis=1) - np.nanmedian(near[1:-1, :AROUND], axis=1))
    return np.asarray(np.nanmedian(near, axis=1)), blow


def _alone(off: Array, k: int) -> bool:
    around = np.abs(np.concatenate([off[max(k - 2, 0) : k], off[k + 1 : k + 3]]))
    return bool(np.all(around < ALIKE * abs(off[k])))


def _first_of_pairs(off: Array, jumps: list[int]) -> list[int]:
    """Jumps but for those that take an earlier one back."""
    left = list(jumps)
    firsts = []
    while left:
        k = left.pop(0)
        firsts.append(k)
        back = next((m for m in left if abs(off[m] + off[k]) < ALIKE * abs(off[k])), None)
        if back is not None:
            left.remove(back)
    return firsts


def _until(off: Array, k: int, jumps: list[int], rows: int) -> int:
    """The row until which a jump lasts."""
    return next((m for m in jumps if m > k and abs(off[m] + off[k]) < ALIKE * abs(off[k])), rows - 1)
