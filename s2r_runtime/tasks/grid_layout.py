"""Cells of the grid world: geometry, shortest feasible paths, and the law of the layouts. Batched over n scenarios.

Cells are numbered on a grid with a border of one cell of wall all around, (rows + 2) x (columns + 2), flattened row by row: so a
neighbour is always an offset away, and the arena's wall is a blocked cell like any other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

MAX_ROUNDS = 1000
"""Rounds of rejection before a law is given up: each proposes at least 8, so an acceptance of 0.1 % is missed once in 3000 times."""


@dataclass(frozen=True)
class Grid:
    """Square cells of side `cell` m; row 0 is the lowest y; (left, bottom) is the arena's corner, m."""

    columns: int
    rows: int
    cell: float
    left: float
    bottom: float

    @property
    def width(self) -> int:
        """Cells in a row, with the border."""
        return self.columns + 2

    @property
    def size(self) -> int:
        """Cells, with the border."""
        return (self.rows + 2) * self.width

    @cached_property
    def offsets(self) -> Ints:
        """Index offset to the neighbour east, north, west and south, (4,)."""
        return np.array([1, self.width, -1, -self.width])

    @cached_property
    def inner(self) -> Ints:
        """Indices of the cells inside the border, (rows * columns,)."""
        return np.asarray(np.arange(1, self.rows + 1)[:, None] * self.width + np.arange(1, self.columns + 1)).ravel()

    @cached_property
    def centre_x(self) -> Array:
        """x of each cell's centre, m, (size,)."""
        return np.asarray(self.left + self.cell * (np.arange(self.size) % self.width - 0.5), dtype=np.float64)

    @cached_property
    def centre_y(self) -> Array:
        """y of each cell's centre, m, (size,)."""
        return np.asarray(self.bottom + self.cell * (np.arange(self.size) // self.width - 0.5), dtype=np.float64)

    def place(self, x: Array, y: Array) -> tuple[Ints, Array, Array]:
        """Cell that a point is in (all outside is the border) and the point from its centre, m; any shape, finite."""
        across = np.minimum(np.maximum((x - self.left) * (1.0 / self.cell) + 1.0, 0.5), self.columns + 1.5)
        up = np.minimum(np.maximum((y - self.bottom) * (1.0 / self.cell) + 1.0, 0.5), self.rows + 1.5)
        column, row = np.floor(across), np.floor(up)
        offset_x = x - (column * self.cell + (self.left - 0.5 * self.cell))
        offset_y = y - (row * self.cell + (self.bottom - 0.5 * self.cell))
        return (row * self.width + column).astype(np.int64), offset_x, offset_y


def distances(grid: Grid, blocked: Bools, sources: Bools) -> Array:
    """Length of the shortest feasible path from each cell to the nearest source, m, (n, size); inf where there is none.

    Breadth-first over the four neighbours, all scenarios at once: a layer a round, and each round adds one to what is unreached.
    """
    shape = (len(blocked), grid.rows + 2, grid.width)
    free = ~blocked.reshape(shape)
    reached = sources.reshape(shape) & free
    steps = np.zeros(shape, dtype=np.int16)
    while True:
        steps += ~reached
        grown = reached.copy()
        grown[:, 1:] |= reached[:, :-1]
        grown[:, :-1] |= reached[:, 1:]
        grown[:, :, 1:] |= reached[:, :, :-1]
        grown[:, :, :-1] |= reached[:, :, 1:]
        grown &= free
        if np.array_equal(grown, reached):
            return np.where(reached, steps * grid.cell, np.inf).reshape(len(blocked), grid.size)
        reached = grown


@dataclass(frozen=True)
class Layouts:
    """n layouts, cells as indices. blocked: (n, size), the border too; distance: (n, size), m, to the nearest goal."""

    start: Ints
    goals: Ints
    blocked: Bools
    distance: Array
    movers: Ints

    def __getitem__(self, rows: Ints | slice) -> Layouts:
        """Some of them."""
        return Layouts(self.start[rows], self.goals[rows], self.blocked[rows], self.distance[rows], self.movers[rows])


@dataclass(frozen=True)
class LayoutLaw:
    """Static, goal and start cells distinct and uniform, given that a goal can be reached from the start; then the movers' cells,
    distinct and uniform over what is left at least `clear_cells` (Chebyshev) from the start.
    """

    grid: Grid
    static: int
    goals: int
    movers: int
    clear_cells: int

    def draw(self, rng: np.random.Generator, n: int, start: int | None, accept: Callable[[Layouts], Bools]) -> Layouts | None:
        """n layouts, given that `accept(layouts) -> (k,)` and, with `start`, that this is the start cell. None: none was found."""
        parts: list[Layouts] = []
        missing = n
        for _ in range(MAX_ROUNDS):
            proposed, possible = self._propose(rng, missing + missing // 2 + 8, start)
            proposed = proposed[np.flatnonzero(possible)]
            parts.append(proposed[np.flatnonzero(accept(proposed))[:missing]])
            missing -= len(parts[-1].start)
            if missing == 0:
                return parts[0] if len(parts) == 1 else _joined(parts)
        return None

    def _propose(self, rng: np.random.Generator, n: int, start: int | None) -> tuple[Layouts, Bools]:
        """n layouts before rejection, and which of them are of the law."""
        grid = self.grid
        keys = rng.random((n, grid.rows * grid.columns))
        if start is not None:
            keys[:, np.flatnonzero(grid.inner == start)[0]] = -1.0  # sorts first
        order = grid.inner[np.argsort(keys, axis=1)]
        origin, goals, static, rest = np.split(order, np.cumsum([1, self.goals, self.static]), axis=1)
        row = np.arange(n)[:, None]
        blocked = np.ones((n, grid.size), dtype=np.bool_)
        blocked[:, grid.inner] = False
        blocked[row, static] = True
        sources = np.zeros((n, grid.size), dtype=np.bool_)
        sources[row, goals] = True
        distance = distances(grid, blocked, sources)
        columns_off = np.abs(rest % grid.width - origin % grid.width)
        rows_off = np.abs(rest // grid.width - origin // grid.width)
        away = np.maximum(columns_off, rows_off) >= self.clear_cells
        chosen = np.argsort(~away, axis=1, kind="stable")[:, : self.movers]
        possible = np.isfinite(distance[row[:, 0], origin[:, 0]]) & (np.sum(away, axis=1) >= self.movers)
        return Layouts(origin[:, 0], goals, blocked, distance, np.take_along_axis(rest, chosen, axis=1)), possible


def _joined(parts: list[Layouts]) -> Layouts:
    return Layouts(
        np.concatenate([p.start for p in parts]),
        np.concatenate([p.goals for p in parts]),
        np.concatenate([p.blocked for p in parts]),
        np.concatenate([p.distance for p in parts]),
        np.concatenate([p.movers for p in parts]),
    )
