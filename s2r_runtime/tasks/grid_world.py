"""The paper's grid task (section V): reach one of several goals through static and moving obstacles.

s = -1 if the robot's disc touched an obstacle cell, a moving obstacle or the arena's wall within the horizon; otherwise the Manhattan
distance travelled along the shortest feasible path to the nearest goal, m: that path's length from the start cell less
that from the robot's cell at the end, not below 0. So s >= 0 iff it was safe. A scenario ends when the robot's centre is in a goal cell.

The law. Static, goal and start cells are distinct and uniform, the robot's place uniform in the start cell, its heading uniform;
all of that given that a goal can be reached from the start over the four neighbours and that the robot's clearance from walls and
obstacles is at least `start_clearance`. It starts at rest; states other than x, y, theta are 0. Moving obstacles start at the
centres of distinct cells, uniform over those that are left and at least `clear_cells` (Chebyshev) from the start cell, and move as
`movers` says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.hookspecs import NominalModel, Scenario
from s2r_runtime.tasks.grid_layout import Grid, LayoutLaw, Layouts
from s2r_runtime.tasks.movers import MoverLaw
from s2r_runtime.tasks.parameters import columns_of, filled_in, require, whole

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Tally:
    """What has happened so far, (n,) each. `cell`: the robot's, as it was when the outcome was settled."""

    cell: Ints
    start_distance: Array
    distance: Array
    crashed: Bools
    arrived: Bools


class GridWorld:
    """Interface: `hookspecs.Task`. Models with the states x, y, theta."""

    name = "grid_world"
    position = ("x", "y")
    PARAMETERS: ClassVar[dict[str, tuple[float, str]]] = {
        "columns": (8, "cells along x"),
        "rows": (5, "cells along y"),
        "cell": (0.4, "side of a cell, m"),
        "center_x": (0.0, "the arena's centre, m"),
        "center_y": (0.0, "the arena's centre, m"),
        "static": (10, "static obstacles, a cell each"),
        "goals": (3, "goal cells"),
        "movers": (3, "moving obstacles"),
        "steps": (200, "horizon, steps of the model"),
        "robot_radius": (0.055, "the robot's disc, m"),
        "mover_radius": (0.055, "a moving obstacle's disc, m"),
        "mover_speed": (0.1, "m/s; rounded so that a cell takes whole steps"),
        "turn": (0.5, "probability that a moving obstacle turns at a cell's centre"),
        "clear_cells": (2, "moving obstacles start at least so many cells from the start cell"),
        "start_clearance": (0.045, "the robot starts with at least this clearance, m"),
        "min_progress": (0.4, "median distance travelled along the shortest path that counts as doing the task, m"),
    }

    def __init__(self, parameters: dict[str, Any], model: NominalModel, dt: float) -> None:
        p = filled_in(self.name, parameters, self.PARAMETERS)
        self._check(p)
        self._x, self._y, self._theta = columns_of(self.name, model, ("x", "y", "theta"))
        self._nx = len(model.states)
        self._dt = dt
        self.horizon = int(p["steps"])
        columns, rows, cell = int(p["columns"]), int(p["rows"]), p["cell"]
        self.grid = Grid(columns, rows, cell, p["center_x"] - columns * cell / 2.0, p["center_y"] - rows * cell / 2.0)
        self._layouts = LayoutLaw(self.grid, int(p["static"]), int(p["goals"]), int(p["movers"]), int(p["clear_cells"]))
        self._movers = MoverLaw(self.grid, int(p["movers"]), p["mover_speed"], p["turn"], dt)
        self._radius, self._touch = p["robot_radius"], p["robot_radius"] + p["mover_radius"]
        self._start_clearance, self._min_progress = p["start_clearance"], p["min_progress"]

    def _check(self, p: dict[str, float]) -> None:
        whole(self.name, p, 1, ("columns", "rows", "goals", "steps"))
        whole(self.name, p, 0, ("static", "movers", "clear_cells"))
        for name, ok, must in (
            ("cell", p["cell"] > 0.0, "> 0 m"),
            ("robot_radius", 0.0 < p["robot_radius"] < p["cell"] / 2.0, "> 0 m and below half a cell"),
            ("mover_radius", 0.0 <= p["mover_radius"] < p["cell"] / 2.0, ">= 0 m and below half a cell"),
            ("mover_speed", p["mover_speed"] >= 0.0, ">= 0 m/s"),
            ("turn", 0.0 <= p["turn"] <= 1.0, "a probability"),
            ("start_clearance", 0.0 <= p["start_clearance"] < p["cell"] / 2.0 - p["robot_radius"], ">= 0 m and leave room in a cell"),
            ("min_progress", p["min_progress"] >= 0.0, ">= 0 m"),
        ):
            require(self.name, p, name, ok, must)
        taken, there = p["static"] + p["goals"] + p["movers"] + 1, p["columns"] * p["rows"]
        if taken > there:
            raise ConfigError(f"task {self.name}: static, goals, movers and the start take {taken:g} cells, there are {there:g}")

    # ---------------------------------------------------------------- the law

    def draw(self, rng: np.random.Generator, n: int) -> Scenario:
        """n scenarios from the law, independent. Raises ConfigError if there are no such layouts."""
        half = self.grid.cell / 2.0
        starts: list[Array] = []

        def accept(proposed: Layouts) -> Bools:
            k = len(proposed.start)
            x = np.zeros((k, self._nx))
            x[:, self._x] = self.grid.centre_x[proposed.start] + rng.uniform(-half, half, k)
            x[:, self._y] = self.grid.centre_y[proposed.start] + rng.uniform(-half, half, k)
            x[:, self._theta] = rng.uniform(-math.pi, math.pi, k)
            accepted = self._wall_distance(x, proposed.blocked) - self._radius >= self._start_clearance
            starts.append(x[accepted])
            return accepted

        layouts = self._layouts.draw(rng, n, None, accept)
        if layouts is None:
            raise ConfigError(f"task {self.name}: no layout with a way to a goal was found; fewer obstacles would leave one")
        # of what the last round accepted, `draw` took the first ones
        return self._scenario(rng, layouts, np.asfortranarray(np.concatenate(starts)[:n]))

    def draw_at(self, rng: np.random.Generator, x: Array) -> Scenario:
        """One scenario from the law given that the robot starts at x (nx,): the same layouts, given this start.

        Raises NotEnoughEvidence where the law has none: outside the arena or too near to its wall.
        """
        at = np.asarray(x, dtype=np.float64)[None, :]
        here = f"the robot is at x {at[0, self._x]:.3f}, y {at[0, self._y]:.3f} m"
        empty = np.ones((1, self.grid.size), dtype=np.bool_)
        empty[:, self.grid.inner] = False
        if not np.all(np.isfinite(at)) or self._wall_distance(at, empty)[0] - self._radius < self._start_clearance:
            must = f"inside the arena with its disc at least {self._start_clearance:g} m from the wall"
            raise NotEnoughEvidence(f"task {self.name}: {here}; scenarios start {must}")
        start, _, _ = self.grid.place(at[:, self._x], at[:, self._y])

        def accept(proposed: Layouts) -> Bools:
            states = np.repeat(at, len(proposed.start), axis=0)
            return self._wall_distance(states, proposed.blocked) - self._radius >= self._start_clearance

        layouts = self._layouts.draw(rng, 1, int(start[0]), accept)
        if layouts is None:
            raise NotEnoughEvidence(f"task {self.name}: {here}, and no layout with a way to a goal starts there")
        return self._scenario(rng, layouts, at)

    def _scenario(self, rng: np.random.Generator, layouts: Layouts, start: Array) -> Scenario:
        goals = np.stack([self.grid.centre_x[layouts.goals], self.grid.centre_y[layouts.goals]], axis=2)
        return {
            "start": start,
            "blocked": layouts.blocked,
            "distance": layouts.distance,
            "goals": goals,
            "step": np.zeros(len(start), dtype=np.int64),
            **self._movers.begin(rng, layouts.movers, layouts.blocked),
        }

    def advance(self, scenario: Scenario, rng: np.random.Generator) -> Scenario:
        """The moving obstacles one step later."""
        step = scenario["step"] + 1
        moved = self._movers.advance(scenario, step, rng) if self._movers.count and self._movers.period else {}
        return {**scenario, **moved, "step": step}

    def view(self, scenario: Scenario) -> Scenario:
        """What a controller sees. Grids are (n, rows + 2, columns + 2), with a border of wall; row 0 is the border below.

        goals (n, goals, 2) m; blocked; distance: along the shortest path to the nearest goal, m, inf where there is none;
        mover_x, mover_y (n, movers) m and mover_vx, mover_vy m/s, now; cell, left, bottom (n,): side of a cell and the
        arena's corner, m; time_left (n,) s.
        """
        n, grid = len(scenario["step"]), self.grid
        shape = (n, grid.rows + 2, grid.width)
        return {
            "goals": scenario["goals"],
            "blocked": scenario["blocked"].reshape(shape),
            "distance": scenario["distance"].reshape(shape),
            "mover_x": scenario["mover_x"],
            "mover_y": scenario["mover_y"],
            "mover_vx": scenario["mover_vx"],
            "mover_vy": scenario["mover_vy"],
            "cell": np.broadcast_to(grid.cell, (n,)),
            "left": np.broadcast_to(grid.left, (n,)),
            "bottom": np.broadcast_to(grid.bottom, (n,)),
            "time_left": (self.horizon - scenario["step"]) * self._dt,
        }

    # ---------------------------------------------------------------- safety

    def clearance(self, x: Array, scenario: Scenario) -> Array:
        """Distance of the robot's disc from the nearest obstacle, mover or wall, m, (n,); negative in one. Obstacles beyond the
        neighbouring cells count as if they began right behind those.
        """
        clear = self._wall_distance(x, scenario["blocked"]) - self._radius
        if self._movers.count:
            clear = np.minimum(clear, np.sqrt(self._mover_distance2(x, scenario)) - self._touch)
        return clear

    def _mover_distance2(self, x: Array, scenario: Scenario) -> Array:
        """Squared distance of centres to the nearest moving obstacle, (n,)."""
        dx = scenario["mover_x"] - x[:, self._x, None]
        dy = scenario["mover_y"] - x[:, self._y, None]
        dx *= dx
        dy *= dy
        dx += dy
        nearest: Array = dx.min(axis=1)
        return nearest

    def _wall_distance(self, x: Array, blocked: Bools) -> Array:
        """Distance of the robot's centre from the nearest blocked cell among its own and the eight around it, m, (n,)."""
        cell, fx, fy = self.grid.place(x[:, self._x], x[:, self._y])
        half, width = self.grid.cell / 2.0, self.grid.width
        at = np.arange(len(x)) * self.grid.size + cell
        flat = blocked.ravel()
        inside = flat.take(at)
        # the border's cells have neighbours that are not there; whoever is in one is inside an obstacle anyway
        at = np.where(inside, width + 1, at)
        across = {1: half - fx, 0: np.zeros_like(fx), -1: half + fx}
        up = {1: half - fy, 0: np.zeros_like(fy), -1: half + fy}
        edge = np.minimum(half - np.abs(fx), half - np.abs(fy))
        nearest = np.where(inside, -np.abs(edge), edge + self.grid.cell)
        for i, dx in across.items():
            for j, dy in up.items():
                if i or j:
                    there = flat.take(at + (i + j * width)) & ~inside
                    np.minimum(nearest, np.sqrt(dx * dx + dy * dy), out=nearest, where=there)
        return nearest

    def enclosed(self, x: Array, reach: float, scenario: Scenario, threshold: float) -> tuple[Bools, Bools] | None:
        """Nothing is touched from any place within `reach`, m; and it is within a goal's cell. `clearance` is never above the distance
        from what is touched, which is 1-Lipschitz in the place. A threshold above 0 requires progress: None.
        """
        if threshold > 0.0:
            return None
        cell, fx, fy = self.grid.place(x[:, self._x], x[:, self._y])
        goal = scenario["distance"].ravel().take(np.arange(len(x)) * self.grid.size + cell) == 0.0
        within = self.grid.cell / 2.0 - np.maximum(np.abs(fx), np.abs(fy)) >= reach
        return self.clearance(x, scenario) - reach > 0.0, goal & within

    def begin(self, scenario: Scenario) -> Tally:
        """Nothing has happened."""
        start = scenario["start"]
        cell, _, _ = self.grid.place(start[:, self._x], start[:, self._y])
        distance = scenario["distance"].ravel()
        nothing = np.zeros(len(start), dtype=np.bool_)
        return Tally(cell, distance.take(np.arange(len(start)) * self.grid.size + cell), distance, nothing, nothing)

    def observe(self, tally: Tally, x: Array, scenario: Scenario) -> Tally:
        """Whether the robot, at x (n, nx), touches something or has arrived."""
        cell, fx, fy = self.grid.place(x[:, self._x], x[:, self._y])
        at = np.arange(len(x)) * self.grid.size + cell
        hit = scenario["blocked"].ravel().take(at)
        # far from its cell's edge the disc is in that cell alone
        edge = self.grid.cell / 2.0 - np.maximum(np.abs(fx), np.abs(fy))
        near = np.flatnonzero(edge < self._radius)
        if len(near):
            hit[near] = self._wall_distance(x[near], scenario["blocked"][near]) < self._radius
        if self._movers.count:
            hit |= self._mover_distance2(x, scenario) < self._touch * self._touch
        live = ~(tally.crashed | tally.arrived)
        crashed = tally.crashed | (live & hit)
        arrived = tally.arrived | (live & ~hit & (tally.distance.take(at) == 0.0))
        return Tally(np.where(live, cell, tally.cell), tally.start_distance, tally.distance, crashed, arrived)

    def safety(self, tally: Tally) -> Array:
        """-1 for a crash, else the progress, m."""
        return np.where(tally.crashed, -1.0, self.progress(tally))

    def progress(self, tally: Tally) -> Array:
        """Distance travelled along the shortest path, m, >= 0. Cells from which no goal can be reached count as none."""
        left = tally.distance.take(np.arange(len(tally.cell)) * self.grid.size + tally.cell)
        cells = np.rint((tally.start_distance - left) / self.grid.cell)  # whole cells: no dust of subtracting multiples of one
        return np.maximum(cells * self.grid.cell, 0.0)

    def done(self, tally: Tally) -> Bools:
        """Crashed or arrived."""
        return tally.crashed | tally.arrived

    def progress_ok(self, progress: Array) -> bool:
        """Whether the median distance travelled is at least `min_progress`."""
        return bool(np.median(progress) >= self._min_progress)
