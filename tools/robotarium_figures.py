"""The figures of the Robotarium experiment, drawn again: histograms of the gap, verification against 20 000 scenarios, the true system
within the uncertain model's predictions, the first four runs. One self-contained page.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from paper_figures import PREDICTED, Again, among, tile, verification

from s2r_runtime.evidence.uncertain import Control, GapSet, roll_out
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.report import plots
from s2r_runtime.report.page import Page
from s2r_runtime.tasks.grid_world import GridWorld

STILL: dict[str, Any] = {"movers": 0}
"""The grid without moving obstacles: one picture can show its predictions."""


def reach(setting: Any, law: str, control: Control, seed: int) -> dict[str, Any]:
    """Paths in one and the same scenario: predicted ones, and the true system's."""
    from robotarium_experiment import LITERAL, TRUTH

    rng = np.random.default_rng([seed, 6])
    predicted = roll_out(
        control,
        Again(STILL, setting.model.nominal, setting.model.dt, seed=seed),
        setting.model,
        setting.gap,
        law,
        rng,
        PREDICTED,
        keep=PREDICTED,
    )
    true = roll_out(
        control, Again(STILL, TRUTH.nominal, TRUTH.dt, seed=seed), TRUTH, GapSet("ball", LITERAL, 0.0), "uniform", rng, 1, keep=1
    )
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
    verification(result, one)
    if "final" not in one:
        return
    runs = one["true_runs"]
    result.text(
        f"On the true system {runs['crashes']} of {runs['n']} runs crashed: at most {runs['crash_upper']:.1%} with confidence 95 %.",
        "good" if not runs["crashes"] else "bad",
    )
    grid = GridWorld({}, _truth().nominal, _truth().dt).grid
    reached = one["reach"]
    drawn = among(reached["scenario"], reached["predicted"], reached["true"], grid)
    result.panels([(drawn, "One scenario: predictions of the uncertain model, and the true system.")])
    rollouts = runs["rollouts"]
    tiles = [
        (tile(s, [(p, plots.ORANGE, 1.6)], grid), f"run {k + 1}")
        for k, (s, p) in enumerate(zip(rollouts.scenarios, rollouts.paths, strict=True))
    ]
    result.panels(tiles)


def _truth() -> ComposedModel:
    from robotarium_experiment import TRUTH

    return TRUTH
