"""Figures that the paper's two experiments share: a scenario of the grid with paths in it, and the histogram of safety values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import NominalModel, Scenario
from s2r_runtime.report import plots
from s2r_runtime.report.page import Page
from s2r_runtime.tasks.grid_layout import Grid
from s2r_runtime.tasks.grid_world import GridWorld

Array = NDArray[np.float64]
Line = tuple[Array, str, float]
"""Path (steps, >= 2), colour, width."""

PREDICTED = 60
"""Rollouts of the uncertain model that the true run is drawn among."""


class Again(GridWorld):
    """The grid, always in the same scenario: the one given, or one drawn from the seed."""

    def __init__(
        self, parameters: dict[str, Any], model: NominalModel, dt: float, *, seed: int = 0, scenario: Scenario | None = None
    ) -> None:
        super().__init__(parameters, model, dt)
        self._one = scenario if scenario is not None else super().draw(np.random.default_rng([seed, 5]), 1)

    def draw(self, rng: np.random.Generator, n: int) -> Scenario:
        """The same n times."""
        return {name: np.repeat(value, n, axis=0) for name, value in self._one.items()}


def tile(scenario: Scenario, lines: Sequence[Line], grid: Grid, description: str = "a run through the grid") -> str:
    """One scenario: obstacles, goals, what moves (where it began), and paths."""
    fig, (ax,) = plots.figure(width=3.6, height=2.5 if grid.columns > grid.rows else 3.4)
    ax.grid(visible=False)
    half = grid.cell / 2.0
    for cell in grid.inner:
        if scenario["blocked"][0][cell]:
            x, y = grid.centre_x[cell], grid.centre_y[cell]
            ax.fill([x - half, x + half, x + half, x - half], [y - half, y - half, y + half, y + half], color=plots.SOFT)
    for x, y in scenario["goals"][0]:
        ax.fill([x - half, x + half, x + half, x - half], [y - half, y - half, y + half, y + half], color=plots.GREEN, alpha=0.5)
    for path, colour, width in lines:
        ax.plot(path[:, 0], path[:, 1], color=colour, linewidth=width)
    if "mover_x" in scenario and scenario["mover_x"].size:
        ax.plot(scenario["mover_x"][0], scenario["mover_y"][0], "o", color=plots.RED, markersize=4)
    ax.set_xlim(grid.left, grid.left + grid.columns * grid.cell)
    ax.set_ylim(grid.bottom, grid.bottom + grid.rows * grid.cell)
    ax.set_aspect("equal")
    return plots.svg(fig, description)


def among(scenario: Scenario, predicted: Sequence[Array], true: Array, grid: Grid) -> str:
    """One scenario: what the uncertain model foretells, and what the true system did."""
    return tile(scenario, [*((path, plots.QUIET, 0.7) for path in predicted), (true, plots.BLUE, 1.6)], grid)


def verification(page: Page, one: dict[str, Any]) -> None:
    """Table of the controllers against one uncertain model, and the winner's safety values, if there is one."""
    counts = list(one["controllers"][0]["s_star"])
    rows = [
        (c["controller"], *(f"{c['s_star'][n]:.2f}" for n in counts), c["crashes"], f"{c['progress']:.2f}", "passes" if c["passed"] else "")
        for c in one["controllers"]
    ]
    page.table(("controller", *(f"s* of {n}" for n in counts), "crashes", "median progress, m", ""), rows)
    if "final" not in one:
        page.text("No controller passes.", "warn")
        return
    final = one["final"]
    marks = {f"s* of {c['n']}": (c["s_star"], plots.RED) for c in final["claims"]}
    marks |= {f"{c['epsilon']:.1%} of {final['n']}": (c["cutoff"], plots.ORANGE) for c in final["claims"]}
    told = f"Safety of {final['n']} rollouts of {one['winner']}, {final['crashes']} crashed."
    page.figure(plots.histogram(final["safety"], "safety value, m", marks, "histogram of safety values"), told)
