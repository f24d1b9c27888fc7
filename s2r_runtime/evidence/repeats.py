"""Do transitions repeat each other? Copies say nothing new, so they count once (guarantee G1), and a campaign made of them founds no gap.

A transition is the row (x0, u, x1), each column divided by its spread; the distance of two rows is their largest difference in a column.

*Copies*: rows that share a cell, MERGED / n^2 wide, of one of two grids that are half a cell apart. Even a law of one continuous dimension
joins two of n rows so with probability below 2 MERGED.

*Repeats* (null hypothesis: rows are independent draws). Among the M pairs of rows within WINDOW, where a density is nearly constant, the
share within r is at most DENSITY r / WINDOW; more dimensions make it less. With r_(i) the i-th smallest distance, no finer than half of the
finest column's smallest step (a quantised sensor makes two draws equal):

    p = M min_i P(Bin(M, DENSITY r_(i) / WINDOW) >= i)                    (Bonferroni)

A law of few values in all columns has no density. Where states and inputs both vary, it is acquitted if inputs that are shuffled among the
rows, as independent draws would be, give as many such pairs (permutation test; exact if input and state are independent).

*Mixtures* (convex combinations of two rows): three rows stand on a line along which every column of x0 and u changes. Independent rows with
d >= 3 such columns do so within an angle STRAIGHT with probability STRAIGHT^(d-1) a triple. Rows within WINDOW of each other do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.messages import REPEATED

Array = NDArray[np.float64]

ALPHA = 1e-3
"""Of campaigns whose rows are independent, this share is refused at most by each of the two tests."""
MERGED = 1e-3
ROUNDING = 1e-12
"""Of a column's spread: differences below are the arithmetic's."""
WINDOW, DENSITY = 1e-2, 2.0
"""Of a column's spread; and how much denser than its mean a density may be at the middle of such a window."""
ROWS, LINE_ROWS = 2000, 300
"""Rows that are tested, drawn from all: 2000 make two million pairs, and 300 four million triples."""
STRAIGHT = 1e-5
SHUFFLES = 1999


class Repeats(NamedTuple):
    """distinct: how many rows are no copies of others. doubt: why chance does not make these rows, or empty; begins with REPEATED."""

    distinct: int
    doubt: str


def repeats(x0: Array, u: Array, x1: Array, angles: Sequence[int] = ()) -> Repeats:
    """x0, x1: (n, nx); u: (n, nu); angles: columns of a state that are angles, rad."""
    n, (z, varies) = len(x0), _scaled(x0, u, x1, angles)
    if n < 2 or not np.any(varies):
        return Repeats(min(n, 1), "")
    width = x0.shape[1] + len(angles)
    column = np.arange(len(varies))
    state, inputs = column < width, (column >= width) & (column < width + u.shape[1])
    number = _copies(z)
    distinct = int(number.max()) + 1
    rng = np.random.default_rng(0)  # which rows are looked at, and the shuffles: alike in an audit
    some = z if n <= ROWS else z[rng.choice(n, ROWS, replace=False)]
    p = _nearness(some, state[varies], inputs[varies], rng)
    if p < ALPHA:
        how = f"{n - distinct} of {n} are copies of others" if distinct < n else "some are nearly equal"
        return Repeats(distinct, f"{REPEATED} more often than independent ones do (p = {p:.1g}): {how}")
    first = np.unique(number, return_index=True)[1]
    on_lines = _on_lines(np.column_stack([x0, u, x1])[first], x0.shape[1] + u.shape[1], rng)
    return Repeats(distinct, f"{REPEATED}: {on_lines} stand on lines through two others, as mixtures do" if on_lines else "")


def distinct(x0: Array, u: Array, x1: Array, angles: Sequence[int] = ()) -> int:
    """`Repeats.distinct` alone."""
    z, varies = _scaled(x0, u, x1, angles)
    return int(_copies(z).max()) + 1 if len(x0) > 1 and np.any(varies) else min(len(x0), 1)


def _scaled(x0: Array, u: Array, x1: Array, angles: Sequence[int]) -> tuple[Array, NDArray[np.bool_]]:
    """(n, c) columns that vary, divided by their spread; (c',) which columns of state, input and next state those are."""
    z = np.column_stack([_on_circles(x0, angles), u, _on_circles(x1, angles)])
    spread = _spread(z) if len(z) else np.zeros(z.shape[1])
    return z[:, spread > 0.0] / spread[spread > 0.0], spread > 0.0


def _on_circles(x: Array, angles: Sequence[int]) -> Array:
    """Angles as points of a circle."""
    return np.column_stack([np.delete(x, angles, axis=1), *(f(x[:, a]) for a in angles for f in (np.cos, np.sin))])


def _spread(z: Array) -> Array:
    """(c,) the middle nine tenths of each column; its range, where those are one value; 0 where all are, but for rounding."""
    low, high = np.quantile(z, (0.05, 0.95), axis=0)
    whole = np.ptp(z, axis=0)
    whole[whole <= ROUNDING * np.max(np.abs(z), axis=0)] = 0.0
    return np.asarray(np.where(high - low > 1e-3 * whole, high - low, whole))


def _copies(z: Array) -> NDArray[np.int64]:
    """(n,) number of each row's group: rows that share a cell of either grid are of one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    cell = max(ROUNDING, MERGED / len(z) ** 2)
    rows, cells, found = np.arange(len(z)), [], 0
    for shift in (0.0, 0.5):
        number = _cells(np.floor(z / cell + shift))
        cells.append(number + found)
        found += int(number.max()) + 1
    edges = coo_array((np.ones(2 * len(z), dtype=np.int8), (np.tile(rows, 2), len(z) + np.concatenate(cells))), shape=(len(z) + found,) * 2)
    _, group = connected_components(edges, directed=False)
    return np.unique(group[: len(z)], return_inverse=True)[1].astype(np.int64)


def _cells(rows: Array) -> NDArray[np.int64]:
    """(n,) number of each different row (n, c)."""
    packed = np.ascontiguousarray(rows + 0.0).view(np.dtype((np.void, rows.shape[1] * rows.itemsize))).ravel()
    return np.unique(packed, return_inverse=True)[1].astype(np.int64)


def _steps(z: Array) -> Array:
    """(c,) smallest difference of two values of a column that is more than rounding."""
    apart = np.diff(np.sort(z, axis=0), axis=0)
    return np.asarray(np.min(np.where(apart > ROUNDING, apart, np.inf), axis=0))


def _nearness(z: Array, state: NDArray[np.bool_], inputs: NDArray[np.bool_], rng: np.random.Generator) -> float:
    """p-value of the null hypothesis that rows are independent. z: (n, c), scaled; state, inputs: (c,) which columns are x0 and u."""
    from scipy.spatial import cKDTree
    from scipy.stats import binom

    pairs = cKDTree(z).query_pairs(WINDOW, p=np.inf, output_type="ndarray")
    if not len(pairs):
        return 1.0
    r = np.sort(np.max(np.abs(z[pairs[:, 0]] - z[pairs[:, 1]]), axis=1))
    floored = np.maximum(r, 0.5 * np.min(_steps(z)))
    m, last = len(r), np.flatnonzero(np.append(np.diff(floored) > 0.0, True))
    by_chance = binom.sf(last, m, np.minimum(1.0, DENSITY * floored[last] / WINDOW))  # last + 1 or more
    p, nearest = min(1.0, m * float(np.min(by_chance))), float(r[last[int(np.argmin(by_chance))]])
    if p >= ALPHA or not np.any(state) or not np.any(inputs):
        return p
    return max(p, _shuffled(z[:LINE_ROWS], max(nearest, ROUNDING), state, inputs, rng))


def _shuffled(z: Array, r: float, state: NDArray[np.bool_], inputs: NDArray[np.bool_], rng: np.random.Generator) -> float:
    """p-value of as many pairs within r, among inputs shuffled against states; 0 where these rows hold no such pair."""
    near = {name: _within(z[:, columns], r) for name, columns in (("x0", state), ("u", inputs), ("all", np.ones_like(state)))}
    found = np.count_nonzero(np.triu(near["all"], 1))
    if not found:
        return 0.0
    i, j = np.nonzero(np.triu(near["x0"], 1))
    as_many = 0
    for _ in range(SHUFFLES):
        order = rng.permutation(len(z))
        as_many += bool(np.count_nonzero(near["u"][order[i], order[j]]) >= found)
    return (1.0 + as_many) / (1.0 + SHUFFLES)


def _within(z: Array, r: float) -> NDArray[np.bool_]:
    """(n, n) whether two rows are within r of each other."""
    near = np.ones((len(z), len(z)), dtype=np.bool_)
    for column in z.T:
        near &= np.abs(column[:, None] - column) <= r
    return near


def _on_lines(z: Array, width: int, rng: np.random.Generator) -> int:
    """How many rows of z (n, c), each once, stand on a line with two others; the first `width` columns are x0 and u. 0 where chance may."""
    spread = _spread(z)
    varies = spread > 0.0
    given = np.flatnonzero(varies[:width])
    z = z[:, varies] / spread[varies]
    if len(z) > LINE_ROWS:
        z = z[rng.choice(len(z), LINE_ROWS, replace=False)]
    n, d = len(z), len(given)
    free = _dimensions(z[:, :d])
    if free < 3 or n**3 / 6.0 * float(np.prod(np.sort(_width(z[:, :d]))[::-1][: free - 1])) > ALPHA:
        return 0
    way = z - z[:, None]
    way /= np.maximum(np.sqrt(np.sum(way**2, axis=2)), ROUNDING)[:, :, None]
    across = way @ rng.normal(size=(z.shape[1], 2))
    way *= np.where(across[:, :, 0] < 0.0, -1.0, 1.0)[:, :, None]  # a line has two ends
    place = np.abs(across[:, :, 0])
    order = np.argsort(place, axis=1)
    i, k = np.nonzero(np.diff(np.take_along_axis(place, order, axis=1), axis=1) < 10.0 * STRAIGHT)
    a, b = order[i, k], order[i, k + 1]
    straight = np.all(np.abs(way[i, a] - way[i, b]) < STRAIGHT, axis=1) & np.all(np.abs(way[i, a][:, :d]) > 100.0 * STRAIGHT, axis=1)
    straight &= np.max(np.abs(z[a] - z[b]), axis=1) > WINDOW  # two draws of a law's atom are in one direction from anywhere
    return len(np.unique(np.concatenate([a[straight], b[straight]])))


def _dimensions(z: Array) -> int:
    """Of the smallest flat that nearly all rows (n, d) are on."""
    size = np.linalg.svd(z - np.mean(z, axis=0), compute_uv=False)
    return int(np.count_nonzero(size > 1e-3 * np.max(size, initial=0.0)))


def _width(z: Array) -> Array:
    """(c,) chance that a column's value is the one that a line foretells, of a column that is quantised its step."""
    steps = _steps(z)
    return np.asarray(np.where(steps > 10.0 * STRAIGHT, np.minimum(steps, 1.0), STRAIGHT))
