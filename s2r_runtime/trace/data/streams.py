"""Streams of measured states and of inputs, as received: on stamps of their own, with blanks, repeats and gaps.

An input holds until the next one and is zero before the first. A value that is said again because no new one came is not a measurement
(`fresh`). States on different stamps are brought to those of the slowest one (`complete`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rates = Callable[[Array, Array], Array]
"""States (N, nx) and inputs (N, nu) -> what a model says of their change, per s."""

ALIGNED = 0.02
"""A stamp this part of dt away from the grid counts as on it: stamps are printed with a few digits."""

ROUNDING = 1e-3
"""Of a part's length: a change this near to an edge, or nearer than stamps can tell, is on it: stamps are printed with some digits."""

PAUSE, LONG, APART, FARTHEST = 1.5, 8, 0.1, 0.7
"""Steps between two rows from which on it is a pause; rows behind one that tell where they lie between the points of the grid, if they come
a step apart to within so many steps; and steps from its point to where any of them may be.
"""

TOGETHER = 0.8
"""If this part of the rows with the rarest state has all states, they come on the same stamps, and the rest is left."""

REACH = 2.6
"""Usual intervals between two values of a state from which on nothing is interpolated between them."""

REPEATED = 0.15
"""Share of the rows in motion that must repeat the row before for repeats to be the recorder's, not the robot's."""

BRIEF = 6
"""Rows that a recorder repeats at most while the robot moves; longer ones are a matter for the search for faults."""

COARSE = 50
"""A change of this many quanta or more, at the median, means that a sensor's resolution cannot make it repeat."""


@dataclass(frozen=True)
class Stream:
    """t: (N,) s, ascending; values: (N, c). NaN where a column was not received."""

    t: Array
    values: Array


def complete(states: Stream, inputs: Stream | None = None, rates: Rates | None = None) -> Stream:
    """Rows on which every state is known, one a stamp (the last). rates: how fast states are to change under the inputs that are held; a
    state on stamps of its own is then interpolated along that. A straight line would smooth what the inputs do, which looks like a delay.
    """
    there = ~np.isnan(states.values)
    whole = there.all(axis=1)
    counts = there.sum(axis=0)
    if not counts.min(initial=len(states.t)) or np.count_nonzero(whole) >= TOGETHER * counts.min():
        return last_of_each(Stream(states.t[whole], states.values[whole]))
    rare = np.flatnonzero(counts <= 1.1 * counts.min())
    together = [np.count_nonzero((there & there[:, [j]]).sum(axis=0) > TOGETHER * counts[j]) for j in rare]
    slow = there[:, int(rare[int(np.argmax(together))])]  # the stamps of most states, if several groups are about as rare
    t = states.t[slow]
    values = np.column_stack([_between(t, states.t[m], states.values[m, j]) for j, m in enumerate(there.T)])
    if inputs is not None and rates is not None and len(inputs.t):
        values = np.column_stack([_along(t, states.t[m], values, j, inputs, rates) for j, m in enumerate(there.T)])
    whole = ~np.isnan(values).any(axis=1)
    return last_of_each(Stream(t[whole], values[whole]))


def _between(at: Array, t: Array, values: Array) -> Array:
    """Linear between neighbours that are not far apart; NaN elsewhere."""
    if len(t) == len(at) and np.array_equal(t, at):
        return values
    right = np.clip(np.searchsorted(t, at), 1, max(len(t) - 1, 1))
    if len(t) < 2:
        return np.where(np.isin(at, t), values[0] if len(values) else np.nan, np.nan)
    apart = t[right] - t[right - 1]
    usual = float(np.median(np.diff(t)))
    far = (apart > REACH * usual) & ~np.isin(at, t)
    return np.where(far | (at < t[0]) | (at > t[-1]), np.nan, np.interp(at, t, values))


def _along(at: Array, t: Array, values: Array, j: int, inputs: Stream, rates: Rates) -> Array:
    """Column j of values (N, c), interpolated linearly at `at` (N,) between its own stamps t (M,), bent as the inputs bend it.

    Of neighbours a <= s <= b with w = (b - s)/(b - a): + w (what the inputs do from a to s) - (1 - w) (what they do from s to b).
    """
    if len(t) < 2 or (len(t) == len(at) and np.array_equal(t, at)):
        return values[:, j]
    right = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    before, after = at - t[right - 1], t[right] - at
    own = (before <= 0.0) | (after <= 0.0)
    edges = np.stack([at - np.maximum(before, 1e-9), at, at + np.maximum(after, 1e-9)], axis=1)
    area = _area(inputs, edges.ravel()).reshape(*edges.shape, -1)
    first, second = (area[:, k + 1] - area[:, k] for k in (0, 1))
    known = np.nan_to_num(values)
    moved_before = rates(known, first / np.maximum(before, 1e-9)[:, None])[:, j] * before
    moved_after = rates(known, second / np.maximum(after, 1e-9)[:, None])[:, j] * after
    share = after / np.maximum(before + after, 1e-300)
    return np.where(own, values[:, j], values[:, j] + share * moved_before - (1.0 - share) * moved_after)


def _area(inputs: Stream, at: Array) -> Array:
    """Integral of what is held, up to each stamp, (N, nu)."""
    values = held(inputs.values)
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values[:-1] * np.diff(inputs.t)[:, None], axis=0)])
    last = np.searchsorted(inputs.t, at, side="right") - 1
    i = np.maximum(last, 0)
    return np.asarray(np.where(last[:, None] >= 0, total[i] + values[i] * (at - inputs.t[i])[:, None], 0.0))


def last_of_each(stream: Stream) -> Stream:
    """One row a stamp: of equal stamps the last."""
    keep = np.append(np.diff(stream.t) > 0.0, True) if len(stream.t) else np.zeros(0, dtype=bool)
    return Stream(stream.t[keep], stream.values[keep])


def fresh(states: Stream) -> Stream:
    """The same with NaN where columns, in the groups in which they come (a pose, the wheels), repeat the row before because nothing
    new had come: on a good part of the rows, briefly, in motion, and not for want of resolution.
    """
    values = states.values.copy()
    for group in _groups(states.values):
        column = states.values[:, group]
        rows = np.flatnonzero(~np.isnan(column).any(axis=1))
        if len(rows) < 20:
            continue
        change = np.diff(column[rows], axis=0)
        same = np.append(False, ~np.any(change, axis=1))
        stale = same & (_length(same) <= BRIEF)
        moving = ~(same & ~stale)
        if np.count_nonzero(stale) > REPEATED * np.count_nonzero(moving) and not _coarse(change):
            values[rows[stale][:, None], group] = np.nan
    return Stream(states.t, values)


def _groups(values: Array) -> list[list[int]]:
    """Columns that are received and repeated on the same rows."""
    same = np.diff(values, axis=0) == 0.0
    groups: list[list[int]] = []
    for j in range(values.shape[1]):
        for group in groups:
            first = same[:, group[0]]
            either = np.count_nonzero(first | same[:, j])
            if either and np.count_nonzero(first & same[:, j]) > 0.9 * either:
                group.append(j)
                break
        else:
            groups.append([j])
    return groups


def _length(yes: Mask) -> NDArray[np.int64]:
    """Of the run of True that each row is in, (N,); 0 elsewhere."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], yes.astype(np.int8), [0]])))
    length = np.zeros(len(yes), dtype=np.int64)
    for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        length[a:b] = b - a
    return length


def _coarse(change: Array) -> bool:
    """Whether every column moves by a few quanta at a time: then they repeat by themselves."""
    for column in change.T:
        moved = np.sort(np.abs(column[column != 0.0]))
        if len(moved) < 10:
            continue
        least = float(moved[len(moved) // 100])
        if np.median(moved) >= COARSE * least or not any(_whole(column, least / k) for k in (1, 2, 3)):
            return False
    return True


def _whole(change: Array, quantum: float) -> bool:
    """Whether changes, and sums of some of them, are whole numbers of a quantum, as nearly as rounded digits say."""
    number = np.rint(np.abs(change) / quantum)
    quantum = float(np.median(np.abs(change[number > 0]) / number[number > 0]))
    for rows in (1, 4, 12):
        ratio = np.convolve(change, np.ones(rows), "valid") / quantum
        if not len(ratio) or np.mean(np.abs(ratio - np.rint(ratio)) < 0.08) < 0.85:
            return False
    return True


def held(values: Array) -> Array:
    """Each column's last received value, zero before the first; (N, c)."""
    out = values.copy()
    for column in out.T:
        there = ~np.isnan(column)
        last = np.maximum.accumulate(np.where(there, np.arange(len(column)), -1))
        column[:] = np.where(last >= 0, column[np.maximum(last, 0)], 0.0)
    return out


def changes(inputs: Stream) -> Array:
    """Stamps at which the held input changes, (M,)."""
    values = held(inputs.values)
    moved = np.any(values[1:] != values[:-1], axis=1) if len(values) else np.zeros(0, dtype=bool)
    return inputs.t[1:][moved]


def held_means(inputs: Stream, t0: float, steps: int, dt: float, parts: int) -> Array:
    """(steps * parts, nu) from t0 on: what is held at the start of a part where inputs change on the grid of steps only; else the mean over
    each part, from the running integral.
    """
    values = held(inputs.values)
    width = values.shape[1]
    if not len(values):
        return np.zeros((steps * parts, width))
    nearest = t0 + dt * np.rint((inputs.t - t0) / dt)
    on = np.abs(inputs.t - nearest) <= ALIGNED * dt
    t = np.where(on, nearest, inputs.t)
    edges = np.asarray(t0 + dt / parts * np.arange(steps * parts + 1), dtype=np.float64)
    if bool(on.all()):
        last = np.searchsorted(t, edges[:-1] + ALIGNED * dt / parts, side="right") - 1
        return np.asarray(np.where(last[:, None] >= 0, values[np.maximum(last, 0)], 0.0))
    total = np.concatenate([np.zeros((1, width)), np.cumsum(values[:-1] * np.diff(t)[:, None], axis=0)])
    last = np.searchsorted(t, edges, side="right") - 1
    i = np.maximum(last, 0)
    area = np.where(last[:, None] >= 0, total[i] + values[i] * (edges - t[i])[:, None], 0.0)
    return _held_or_mean(np.diff(area, axis=0) * (parts / dt), values, t, edges)


def _held_or_mean(mean: Array, values: Array, t: Array, edges: Array) -> Array:
    """Means over the parts between the edges (K + 1,), (K, nu); exactly what is held, values (N, nu) from t (N,) on, where nothing changes
    within a part, which an integral gives but for rounding: what looks for changes would find one in every part.
    """
    near = ROUNDING * float(np.min(np.diff(edges), initial=np.inf)) + 4.0 * float(np.spacing(np.max(np.abs(edges))))
    first, last = (np.searchsorted(t, at, side="right") for at in (edges[:-1] + near, edges[1:] - near))
    given = np.concatenate([np.zeros((1, values.shape[1])), values])
    changed = np.cumsum(np.append(np.zeros((1, values.shape[1]), dtype=bool), given[1:] != given[:-1], axis=0), axis=0)
    return np.asarray(np.where(changed[last] == changed[first], given[first], mean))


def turned(inputs: Stream, at: Array, parts: int, on_edge: float = 0.0) -> Mask | None:
    """(K, nu) of steps between the stamps at (K + 1,): whether an input changes within the last part of a step and holds over the next.
    What acts at the end of that step is what acts over the next part: its own last part has a mean of before and after. None: nowhere.
    on_edge: s from a stamp within which a change is on it.
    """
    values = held(inputs.values)
    found: Mask = np.zeros((len(at) - 1, values.shape[1]), dtype=np.bool_)
    last, after = np.diff(at)[:-1] / parts, np.diff(at)[1:] / parts
    least = ROUNDING * np.minimum(last, after) + 4.0 * np.spacing(np.abs(at[1:-1]))
    near = np.maximum(least, on_edge)
    for j, column in enumerate(values.T):
        t = inputs.t[np.append(True, column[1:] != column[:-1])] if len(column) else inputs.t
        a, b, c = (np.searchsorted(t, e) for e in (at[1:-1] - last + least, at[1:-1] - near, at[1:-1] + after - least))
        found[:-1, j] = (b > a) & (c == b)
    return found if found.any() else None


def on_grid(t: Array, dt: float) -> bool:
    """Whether nearly every grid point that has a row in reach has one on it."""
    place = (t - t[0]) / dt
    nearest = np.rint(place)
    on = np.abs(place - nearest) <= ALIGNED
    return len(np.unique(nearest[on])) >= 0.97 * len(np.unique(nearest))


def at_grid(states: Stream, dt: float, angles: list[int]) -> Array:
    """(K + 1, nx): the rows that are on the grid from the first stamp on, NaN where there is none."""
    place = (states.t - states.t[0]) / dt
    nearest = np.rint(place)
    on = np.abs(place - nearest) <= ALIGNED
    y = np.full((int(nearest[on].max()) + 1, states.values.shape[1]), np.nan)
    y[nearest[on].astype(int)] = states.values[on]
    return unwrapped(y, angles)


def nearest(states: Stream, dt: float, angles: list[int]) -> tuple[Array, Array]:
    """(K + 1, nx) the row nearest to each point of the grid, and (K + 1,) its stamp (of a point without a row: where the grid has it)."""
    place = (states.t - states.t[0]) / dt
    point = _points(place)
    order = np.argsort(-np.abs(place - point), kind="stable")  # the nearest one is written last
    y = np.full((int(point.max()) + 1, states.values.shape[1]), np.nan)
    at = states.t[0] + dt * np.arange(len(y))
    y[point[order]] = states.values[order]
    at[point[order]] = states.t[order]
    return unwrapped(y, angles), at


def _points(place: Array) -> NDArray[np.int64]:
    """(N,) the point of each row, whose place is in steps: the nearest one. Behind a pause that ends midway between two, the nearest one
    is a matter of rounding, and every second row would be lost: those rows all go to the one before or behind, whichever is nearer to most.
    """
    point = np.rint(place).astype(np.int64)
    edges = [0, *(np.flatnonzero(np.diff(place) > PAUSE) + 1).tolist(), len(place)]
    for a, b in pairwise(edges[1:]):
        if b - a < LONG or abs(float(np.median(np.diff(place[a:b]))) - 1.0) > APART or np.all(np.diff(point[a:b])):
            continue
        aside = float(np.angle(np.mean(np.exp(2j * np.pi * place[a:b]))) / (2.0 * np.pi))
        own = np.rint(place[a:b] - aside).astype(np.int64)
        if np.max(np.abs(own - place[a:b])) <= FARTHEST and len(np.unique(own)) > len(np.unique(point[a:b])):
            point[a:b] = own
    return point


def held_between(inputs: Stream, at: Array, parts: int) -> Array:
    """(K * parts, nu) means of what is held, over equal parts of the intervals between the stamps at (K + 1,)."""
    values = held(inputs.values)
    if not len(values):
        return np.zeros(((len(at) - 1) * parts, values.shape[1]))
    edges = np.interp(np.arange((len(at) - 1) * parts + 1) / parts, np.arange(len(at)), at)
    return _held_or_mean(np.diff(_area(inputs, edges), axis=0) / np.diff(edges)[:, None], values, inputs.t, edges)


def unwrapped(y: Array, angles: list[int]) -> Array:
    """Angle columns without jumps of a turn; NaN rows are stepped over."""
    y = y.copy()
    for column in angles:
        there = ~np.isnan(y[:, column])
        y[there, column] = np.unwrap(y[there, column])
    return y
