"""A heading that leaves the motion while the position does not: the compass is wrong there, not the robot.

    d_k = (f + i l)_k      displacement of step k in the body's frame by the measured heading, forward and sideways
    D_k = arg(sum d^2) / 2 over a window: course less heading, whichever way the robot drives, in (-pi/2, pi/2]
    C_k   running sum of the yaw residual, less what of it is constant or in proportion to the yaw that the model foresees

Of a heading that is off from some time on, or up to it, the part is wrong in which it is not the course.

A robot that slips sideways, drifts or is measured beside its axle has a course of its own, but turns as its heading says. A heading that is
wrong by b has D lower by b, and got there by a yaw residual that sums to b: only both together are a fault. At high rates steps are taken
over several rows, until they are long beside the noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST = 0.2
"""Rad by which a heading must be off: slip and wind take a course that far from it, and more is left to the yaw residual to say."""

SPREADS = 5.0
"""Robust standard deviations of the course less the heading, over the whole run, that it must be off by."""

SURE = 0.08
"""Rad, standard deviation of D by the noise of positions from which on a window is long enough."""

AGREE = 0.4
"""Share by which what D says and what the yaw residual says may differ."""

CLEAR = 6.0
"""Standard deviations of a position that a step must be long, at its upper quartile, for its course to be told."""

RIGHT, LEAST_RIGHT, FEWEST_RIGHT = 0.35, 0.1, 150
"""Of a jump: how near the course must be to the heading on one side of it, and to the jump beside it on the other, to say which side is
right; and the share of a run, and rows, that must be left then.
"""

KEPT = 0.3
"""Of a run that the smaller part must be to be the right one, where a heading went off in more than a step."""

SHORTEST = 5
"""Rows that must be off."""

WIDEST = 16
"""Steps before and after in a window at most."""

MOST = 0.6
"""Of a run that may be off: of what is off for longer, nobody knows which half is right."""


@dataclass(frozen=True)
class Off:
    """Rows [first, last] whose heading is wrong, by about `angle` rad."""

    first: int
    last: int
    angle: float


def departures(y: Array, turned: Array, foreseen: Array, noise: float) -> list[Off]:
    """y: (K+1, 3) x, y, theta (unwrapped; NaN where not measured); turned: (K,) yaw residual; foreseen: (K,) yaw of the model; noise: of a
    position's residual along one axis, standard deviation in m.
    """
    every = _every(y, noise)
    usual = _usual(y[::every], noise)
    if usual is None:
        return []
    off, half = usual
    known = ~np.isnan(off)
    spread = 1.4826 * _half_of(off[known])
    limit = max(LEAST, SPREADS * spread)
    if limit > 1.0:
        return []
    found: list[Off] = []
    for a, b in _stretches(off, limit):
        angle = float(np.nanmedian(off[a:b]))
        begin, end = _edge(off, a, -1, angle, half), _edge(off, b - 1, 1, angle, half)
        if (b - a) * every < SHORTEST or end - begin > MOST * len(off):
            continue
        outside = np.ones(len(turned), dtype=bool)
        outside[begin * every : end * every + 1] = False
        left = _less_effects(turned, foreseen, outside)
        total = np.concatenate([[0.0], np.cumsum(left)])[::every]
        there = np.flatnonzero(np.abs(off[begin : end + 1]) > 0.85 * abs(angle)) + begin
        edges = [(begin, int(there[0]))] * (begin > 0) + [(int(there[-1]), end)] * (end < len(off) - 1)
        if _agree(off, total, begin, end, half) or (edges and all(_agree(off, total, *edge, half) for edge in edges)):
            found.append(_bounds(off, left, begin, end, angle, half, every))
    joined = _joined(found)
    return [_wrong_side(joined[0], y)] if len(joined) == 1 else joined


def wrong_before(y: Array, step: int, jump: float) -> bool | None:
    """Whether a heading that jumps in a step was wrong before (True), or is after it (False), by the course; None where that does not say,
    or would leave too little. y: (K+1, 3) x, y, theta.
    """
    before, after = course_of(y[: step + 1]), course_of(y[step + 1 :])
    there = np.asarray(np.isfinite(y).all(axis=1))
    near, least = RIGHT * abs(jump), max(LEAST_RIGHT * np.count_nonzero(there), FEWEST_RIGHT)
    if abs(after) < near and abs(before - jump) < near and np.count_nonzero(there[step + 1 :]) > least:
        return True
    return False if abs(before) < near and abs(after + jump) < near and np.count_nonzero(there[: step + 1]) > least else None


def carried(runs: Sequence[Array], jumps: Mapping[int, float]) -> list[int]:
    """Runs in which a heading is off, each as a whole: a compass that jumped in one run is off in all that follow, or was in all before.
    runs: (K+1, 3) each, x, y, theta, in their order; jumps: rad, by run, of those in which a heading jumped for good.

    The course less the heading changes there by as much, on all that follow, the other way. That side is right on which the heading is the
    course; if both or neither are, the longer one. Where no run has the jump in it, nothing is said: other floors, winds and ways to drive
    change courses, too.
    """
    there = [k for k, y in enumerate(runs) if np.count_nonzero(np.isfinite(y).all(axis=1)) >= SHORTEST and np.isfinite(course_of(y))]
    course = np.array([course_of(runs[k]) for k in there])
    rows = np.array([np.count_nonzero(np.isfinite(runs[k]).all(axis=1)) for k in there])
    for run, jump in jumps.items():
        first, at = (int(np.searchsorted(there, k)) for k in (run, run + 1))
        if not first or at == len(there):
            continue
        middles = _middle(course[:first]), _middle(course[at:])
        if abs(_turned(middles[1] - middles[0], -jump)) >= RIGHT * abs(jump):
            continue
        near = [abs(m) < RIGHT * abs(jump) for m in middles]
        fewer = bool(np.sum(rows[:first]) < np.sum(rows[at:]))
        before = near[1] if near[0] != near[1] else fewer  # whether the first ones are the wrong ones
        right = rows[at:] if before else rows[:first]
        if np.sum(right) >= max(LEAST_RIGHT * np.sum(rows), FEWEST_RIGHT):
            return there[:first] if before else there[at:]
    return []


def _middle(angles: Array) -> float:
    """Of courses, half turns apart or not: their median about their mean direction."""
    mean = 0.5 * float(np.angle(np.sum(np.exp(2j * angles))))
    return mean + float(np.median(_turned(angles, mean)))


def _turned(angles: Any, by: float) -> Any:
    """angles less `by`, in (-pi/2, pi/2]; one or (n,)."""
    return 0.5 * np.angle(np.exp(2j * (angles - by)))


def course_of(y: Array) -> float:
    """Course less heading, all in all, in (-pi/2, pi/2]; NaN if it never moved. Squares of noise go anywhere."""
    step, turned = np.diff(y[:, :2], axis=0), np.exp(-0.5j * (y[1:, 2] + y[:-1, 2]))
    squared = ((step[:, 0] + 1j * step[:, 1]) * turned) ** 2
    total = complex(np.nansum(squared))
    return float(0.5 * np.angle(total)) if total else float("nan")


def _wrong_side(off: Off, y: Array) -> Off:
    """The other part of a run in two, if that is the wrong one, and leaves enough: some rows beside it are left out, too."""
    first, last = int(np.argmax(np.isfinite(y[:, 2]))), len(y) - 1
    from_first = off.first <= first
    if from_first == (off.last >= last):
        return off
    step, jump = (off.last, -off.angle) if from_first else (off.first, off.angle)
    before = wrong_before(y, step, jump)
    kept = np.isfinite(y[:, 2])[: step + 1] if from_first else np.isfinite(y[:, 2])[step + 1 :]
    if before is None or before == from_first or np.count_nonzero(kept) < KEPT * np.count_nonzero(np.isfinite(y[:, 2])):
        return off
    return Off(first, step, -jump) if before else Off(step, last, jump)


def _joined(found: list[Off]) -> list[Off]:
    """Those that overlap as one: where a heading is off by about the limit, a stretch falls into parts."""
    whole: list[Off] = []
    for off in sorted(found, key=lambda off: off.first):
        if whole and off.first <= whole[-1].last:
            wider = max(whole[-1], off, key=lambda one: abs(one.angle))
            whole[-1] = Off(whole[-1].first, max(whole[-1].last, off.last), wider.angle)
        else:
            whole.append(off)
    return whole


def _half_of(off: Array) -> float:
    """Half the length of the shortest interval that holds half of them (P. Rousseeuw, A. Leroy, Statistica Neerlandica
    42, 1988): as the median distance, but a heading that stays off for two fifths of a run does not widen it.
    """
    ordered, half = np.sort(off), len(off) // 2
    return 0.5 * float(np.min(ordered[half:] - ordered[: len(off) - half]))


def _every(y: Array, noise: float) -> int:
    """Rows in a step long enough to have a course."""
    for every in (1, 2, 4, 8, 16, 32):
        gone = np.hypot(*np.diff(y[::every, :2], axis=0).T)
        gone = gone[np.isfinite(gone)]
        if len(gone) < 8 * SHORTEST:
            return max(1, every // 2)
        if np.quantile(gone, 0.75) > CLEAR * noise:
            return every
    return 32


def _usual(y: Array, noise: float) -> tuple[Array, int] | None:
    """((K,) heading less course, less what that usually is, NaN where nobody can tell; steps before and after in a window)."""
    step = np.diff(y[:, :2], axis=0)
    theta = 0.5 * (y[1:, 2] + y[:-1, 2])
    body = (step[:, 0] + 1j * step[:, 1]) * np.exp(-1j * theta)
    there = np.isfinite(body)
    squared = np.where(there, body, 0.0) ** 2
    size = np.abs(squared)
    needed = (noise / SURE) ** 2
    for half in (1, 2, 4, 8, WIDEST):
        z, d = _windowed(squared, half), _windowed(size, half).real
        sure = (d > needed) & there
        if np.count_nonzero(sure) > 0.6 * np.count_nonzero(size > 0.05 * np.quantile(size, 0.9)):
            break
    if np.count_nonzero(sure) < 4 * SHORTEST:
        return None
    centre = complex(np.sum(z[sure] / np.maximum(np.abs(z[sure]), 1e-300)))
    for _ in range(3):
        off = -0.5 * np.angle(z * np.conj(centre))
        near = sure & (np.abs(off) < 0.5)
        if near.any():
            centre = centre * complex(np.exp(-2j * float(np.median(off[near]))))
    return np.where(sure, -0.5 * np.angle(z * np.conj(centre)), np.nan), half


def _windowed(values: NDArray[np.complex128] | Array, half: int) -> NDArray[np.complex128]:
    """Sums over half steps before to half steps after."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    k = np.arange(len(values))
    return np.asarray(total[np.minimum(k + half + 1, len(values))] - total[np.maximum(k - half, 0)], dtype=np.complex128)


def _stretches(off: Array, limit: float) -> list[tuple[int, int]]:
    """[a, b) in which it is off to one side, unknown rows within stepped over."""
    rows = np.flatnonzero(~np.isnan(off))
    side = np.where(np.abs(off[rows]) > limit, np.sign(off[rows]), 0.0)
    edges = np.flatnonzero(np.diff(side)) + 1
    parts = np.split(np.arange(len(rows)), edges)
    return [(int(rows[p[0]]), int(rows[p[-1]]) + 1) for p in parts if len(p) and side[p[0]] != 0.0]


def _edge(off: Array, row: int, way: int, angle: float, half: int) -> int:
    """The last row that way that is not yet as usual."""
    rows = np.arange(row, len(off) if way > 0 else -1, way)
    back = np.flatnonzero(np.abs(off[rows]) < 0.15 * abs(angle))
    if not len(back):
        return len(off) - 1 if way > 0 else 0
    return int(np.clip(rows[back[0]] + way * half, 0, len(off) - 1))


def _less_effects(turned: Array, foreseen: Array, outside: Mask) -> Array:
    """(K,) yaw residual less its mean and its share of what is foreseen, both by the rows outside."""
    good = outside & np.isfinite(turned) & np.isfinite(foreseen)
    e, p = np.nan_to_num(turned), np.nan_to_num(foreseen)
    if np.count_nonzero(good) < 10:
        return e
    table = np.column_stack([np.ones(np.count_nonzero(good)), p[good]])
    c, *_ = np.linalg.lstsq(table, e[good], rcond=None)
    return np.where(np.isfinite(turned), e - c[0] - c[1] * p, 0.0)


def _agree(off: Array, total: Array, begin: int, end: int, half: int) -> bool:
    """Whether the running sum of the yaw residual goes as the heading less the course does, in and around an interval."""
    around = slice(max(0, begin - 4 * half - 4), min(len(off), end + 4 * half + 4))
    a, b = off[around], (0.5 * (total[:-1] + total[1:]) if len(total) > len(off) else total)[: len(off)][around]
    good = ~np.isnan(a)
    a, b = a[good] - np.mean(a[good]), b[good] - np.mean(b[good])
    size = float(a @ a)
    if size <= 0.0:
        return False
    slope = float(a @ b) / size
    return abs(slope - 1.0) < AGREE and float(np.sum((b - a) ** 2)) < AGREE**2 * size


def _bounds(off: Array, left: Array, begin: int, end: int, angle: float, half: int, every: int) -> Off:
    """Where the yaw residual takes the heading off, and where it brings it back."""
    half_way = np.flatnonzero(np.abs(off[begin : end + 1]) > 0.5 * abs(angle)) + begin
    first, last = 0, len(left)
    if begin > 0:
        first = begin * every + _leaves(left[begin * every : (int(half_way[0]) + half + 1) * every], angle)
    if end < len(off) - 1:
        back = left[(int(half_way[-1]) - half) * every : (end + 1) * every][::-1]
        last = (end + 1) * every - _leaves(back, -angle)
    return Off(first, min(last, len(left)), angle)


def _leaves(left: Array, angle: float) -> int:
    """Steps before the sum of the yaw residual begins to go to the angle."""
    total = np.cumsum(left) / angle
    middle = int(np.argmax(total > 0.4)) if np.any(total > 0.4) else len(total)
    low = np.flatnonzero(total[:middle] < 0.04)
    return int(low[-1]) + 1 if len(low) else 0
