"""Moving obstacles of the grid world: from cell centre to cell centre at a constant speed, turning at random. Batched.

At a centre a mover turns left or right with probability `turn`, half each, and goes straight on otherwise; where the next cell
is blocked it goes back, and stands for one period where that is blocked too. They take no notice of the robot or of each other.
All start at centres, so that all reach the next centre at the same step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from s2r_runtime.hookspecs import Scenario
from s2r_runtime.tasks.grid_layout import Bools, Grid, Ints

EAST_WEST = np.array([1.0, 0.0, -1.0, 0.0])
NORTH_SOUTH = np.array([0.0, 1.0, 0.0, -1.0])


@dataclass(frozen=True)
class MoverLaw:
    """count movers a scenario; dt: the task's step, s. speed: m/s, rounded so that a cell takes whole steps (`period`; 0: they stand)."""

    grid: Grid
    count: int
    speed: float
    turn: float
    dt: float

    @property
    def period(self) -> int:
        """Steps from one centre to the next."""
        return max(1, round(self.grid.cell / (self.speed * self.dt))) if self.speed > 0.0 else 0

    def begin(self, rng: np.random.Generator, cells: Ints, blocked: Bools) -> Scenario:
        """Movers at the centres of `cells` (n, count), each with a direction drawn uniformly from the four."""
        # memory order (count, n): operations between these and the robots' columns run along the rollouts
        cells = np.asfortranarray(cells)
        return self._set_out(cells, np.asfortranarray(rng.integers(0, 4, cells.shape)), blocked)

    def advance(self, s: Scenario, step: int | Ints, rng: np.random.Generator) -> Scenario:
        """What changes in the scenario within one step, which is the `step`-th (n,)."""
        moved: Scenario = {"mover_x": s["mover_x"] + self.dt * s["mover_vx"], "mover_y": s["mover_y"] + self.dt * s["mover_vy"]}
        at = np.flatnonzero(step % self.period == 0)
        if len(at) == 0:
            return moved
        direction = s["mover_direction"][at]
        cells = s["mover_cell"][at] + s["mover_moves"][at] * self.grid.offsets[direction]
        u = rng.random(cells.shape)
        turned = np.where(u < self.turn / 2.0, 1, np.where(u < self.turn, 3, 0))
        arrived = self._set_out(cells, (direction + turned) % 4, s["blocked"][at])
        if len(at) == len(s["blocked"]):
            return arrived
        for name, value in arrived.items():
            moved[name] = (moved[name] if name in moved else s[name]).copy("K")
            moved[name][at] = value
        return moved

    def _set_out(self, cells: Ints, wanted: Ints, blocked: Bools) -> Scenario:
        """Movers that stand at centres and want to go there: (k, count) each."""
        grid, row = self.grid, np.arange(len(cells))[:, None]
        back = (wanted + 2) % 4
        stopped = blocked[row, cells + grid.offsets[wanted]]
        direction = np.where(stopped, back, wanted)
        moves = ~(stopped & blocked[row, cells + grid.offsets[back]])
        speed = np.where(moves, grid.cell / (self.period * self.dt), 0.0) if self.period else np.zeros_like(cells, dtype=np.float64)
        return {
            "mover_cell": cells,
            "mover_direction": direction,
            "mover_moves": moves,
            "mover_x": grid.centre_x[cells],
            "mover_y": grid.centre_y[cells],
            "mover_vx": speed * EAST_WEST[direction],
            "mover_vy": speed * NORTH_SOUTH[direction],
        }
