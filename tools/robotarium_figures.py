"""The figures of the Robotarium experiment, drawn again: histograms of the gap, verification against 20 000 scenarios, the true system
within the uncertain model's predictions, the first four runs. One self-contained page.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Scenario
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.report import plots
from s2r_runtime.report.page import Page
from s2r_runtime.tasks.grid_world import GridWorld
from s2r_runtime.uncertain import Control, GapSet, roll_out

Array = NDArray[np.float64]

PREDICTED = 60
"""Rollouts of the uncertain model that the true run is drawn among."""


class Again(GridWorld):
    """The grid without moving obstacles, always in the same scenario."""

    def __init__(self, model: ComposedModel, seed: int) -> None:
        super().__init__({"movers": 0}, model.nominal, model.dt)
        self._one = super().draw(np.random.default_rng([seed, 5]), 1)

    def draw(self, rng: np.random.Generator, n: int) -> Scenario:
        """The same n times."""
        return {name: np.repeat(value, n, axis=0) for name, value in self._one.items()}


def reach(setting: Any, law: str, control: Control, seed: int) -> dict[str, Any]:
    """Paths in one and the same scenario: predicted ones, and the true system's."""
    from robotarium_experiment import LITERAL, TRUTH

    rng = np.random.default_rng([seed, 6])
    predicted = roll_out(control, Again(setting.model, seed), setting.model, setting.gap, law, rng, PREDICTED, keep=PREDICTED)
    true = roll_out(control, Again(TRUTH, seed), TRUTH, GapSet("ball", LITERAL, 0.0), "uniform", rng, 1, keep=1)
    return {"predicted": predicted.paths, "true": true.paths[0], "scenario": true.scenarios[0]}


def page(found: dict[str, Any], numbers: dict[str, Any], lines: list[str]) -> str:
    """The page. numbers: `found` without arrays."""
    result = Page(
        "The Robotarium experiment, again",
        "P. Akella, W. Ubellacker, A. D. Ames: Safety-Critical Controller Verification via Sim2Real Gap Quantification",
    )
    _gaps(result, found, numbers)
    for one in found["models"]:
        _model(result, one)
    result.heading("In lines")
    result.items(lines)
    return result.html()


def _gaps(result: Page, found: dict[str, Any], numbers: dict[str, Any]) -> None:
    result.heading("The gap, reading by reading")
    result.text(
        "The paper has r = .198 from 600 of 2400 samples. In the norm that mixes metres and radians that is a period of command latency "
        "with the previous sample's random input still acting; after a full stop the same robot has half of it."
    )
    head = ("reading", "r of 600", "99.5 % of 2400", "r >= it", "r repeated: median", "5 %", "95 %", "r >= it")
    rows = [
        (
            g["reading"],
            f"{g['r']:.4f}",
            f"{g['cutoff']:.4f}",
            "yes" if g["holds"] else "no",
            *(f"{v:.4f}" for v in g["r_repeated"]),
            f"{g['reached']:.0%}",
        )
        for g in numbers["gaps"]
    ]
    result.table(head, rows)
    for at in (1, 4):
        g = found["gaps"][at]
        marks = {
            "r of the first 600": (g["r"], plots.RED),
            "99.5 % of all": (g["cutoff"], plots.ORANGE),
            "the paper's .198": (0.198, plots.INK),
        }
        result.figure(
            plots.histogram(g["discrepancies"], "discrepancy", marks, "histogram of the gap"), f"Sampled discrepancies: {g['reading']}."
        )
    literal = found["literal"]
    result.text(
        f"With r = .198 in the literal norm {literal['crashed']:.2%} of {literal['n']} rollouts of the shipped controller crash.", "warn"
    )


def _model(result: Page, one: dict[str, Any]) -> None:
    result.heading(f"{one['name']}, disturbance law {one['law']}: r = {one['r']:.4g}, r_h = {one['r_h']:.4g}")
    counts = list(one["controllers"][0]["s_star"])
    rows = [
        (c["controller"], *(f"{c['s_star'][n]:.2f}" for n in counts), c["crashes"], f"{c['progress']:.2f}", "passes" if c["passed"] else "")
        for c in one["controllers"]
    ]
    result.table(("controller", *(f"s* of {n}" for n in counts), "crashes", "median progress, m", ""), rows)
    if "final" not in one:
        result.text("No controller passes.", "warn")
        return
    final = one["final"]
    marks = {f"s* of {c['n']}": (c["s_star"], plots.RED) for c in final["claims"]}
    marks |= {f"{c['epsilon']:.1%} of {final['n']}": (c["cutoff"], plots.ORANGE) for c in final["claims"]}
    told = f"Safety of {final['n']} rollouts of {one['winner']}, {final['crashes']} crashed."
    result.figure(plots.histogram(final["safety"], "safety value, m", marks, "histogram of safety values"), told)
    runs = one["true_runs"]
    result.text(
        f"On the true system {runs['crashes']} of {runs['n']} runs crashed: at most {runs['crash_upper']:.1%} with confidence 95 %.",
        "good" if not runs["crashes"] else "bad",
    )
    result.panels([(_reach(one["reach"]), "One scenario: predictions of the uncertain model, and the true system.")])
    rollouts = runs["rollouts"]
    tiles = [
        (_tile(s, [(p, plots.ORANGE, 1.6)]), f"run {k + 1}")
        for k, (s, p) in enumerate(zip(rollouts.scenarios, rollouts.paths, strict=True))
    ]
    result.panels(tiles)


def _reach(data: dict[str, Any]) -> str:
    lines = [(path, plots.QUIET, 0.7) for path in data["predicted"]] + [(data["true"], plots.BLUE, 1.6)]
    return _tile(data["scenario"], lines)


def _tile(scenario: Scenario, lines: list[tuple[Array, str, float]]) -> str:
    from robotarium_experiment import TRUTH

    grid = GridWorld({}, TRUTH.nominal, TRUTH.dt).grid
    fig, (ax,) = plots.figure(width=3.6, height=2.5)
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
    return plots.svg(fig, "a run through the grid")
