"""The figures of the quadruped experiment on one self-contained page: histogram of the gap and its parts, what it could say at most and how
that changes with the model's step, one-step reachable sets against what happened, safety values, paths.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from paper_figures import among, tile, verification

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import Profile
from s2r_runtime.report import plots
from s2r_runtime.report.page import Page
from s2r_runtime.report.trace_section import add_trace
from s2r_runtime.tasks.grid_layout import Grid
from s2r_runtime.tasks.grid_world import GridWorld

Array = NDArray[np.float64]

SHOWN_S = 8.0
"""Of a run whose reachable sets are drawn: from when it has begun to walk."""


def page(found: dict[str, Any], lines: list[str]) -> str:
    """The page."""
    result = Page(
        "The quadruped experiment, again",
        "P. Akella, W. Ubellacker, A. D. Ames: Safety-Critical Controller Verification via Sim2Real Gap Quantification",
    )
    _outcome(result, found)
    _gaps(result, found)
    _traced(result, found)
    shown: set[int] = set()
    for one in found["models"]:
        _model(result, one, shown)
    result.heading("In lines")
    result.items(lines)
    return result.html()


def _outcome(result: Page, found: dict[str, Any]) -> None:
    """What a reader wants to know first: was what was verified safe on the robot, and what does that say."""
    judged = [one for one in found["models"] if "final" in one]
    drives = {id(one["true_runs"]["rollouts"]): one["true_runs"] for one in judged}  # models with one winner and one step share their runs
    runs, crashed = sum(r["n"] for r in drives.values()), sum(r["crashes"] for r in drives.values())
    text = (
        f"Of {len(found['models'])} pairs of an uncertain model and a disturbance law, {len(judged)} have a controller that passes. These "
        f"controllers walked {runs} scenarios on the robot: {crashed} crashed, {sum(r['falls'] for r in drives.values())} fell."
    )
    result.text(text, "good" if judged and not crashed else "bad")
    left = [one for one in judged if one["true_runs"]["steps"]["inside"] < 0.97]
    if crashed or left:
        names = "; ".join(f"{one['name']}, {one['law']}: {1.0 - one['true_runs']['steps']['inside']:.1%}" for one in left) or "none"
        result.text(
            "The gap bounds one step of the campaign's law, and verification bounds rollouts of the uncertain model; the two are no "
            "statement about the robot under a controller (guarantee, what is not shown), whose inputs follow another law. Where more than "
            f"3 % of the steps driven left their reachable set: {names}.",
            "warn",
        )


def _gaps(result: Page, found: dict[str, Any]) -> None:
    result.heading("The gap, and what it could say at most")
    literal, weighted = found["gaps"][0], found["gaps"][1]
    verdict = (
        f"In the paper's reading r = {literal['r']:.4f}; a robot that never moved would score {literal['still']:.4f} at most. "
        f"The body of a walking robot swings within its stride by about as much as it advances in a tenth of a second: the position "
        f"was off by up to {1e3 * literal['position']:.1f} mm, the heading by up to {literal['heading']:.3f} rad, where one step is "
        f"{1e3 * literal['furthest'][0]:.0f} mm and {literal['furthest'][1]:.2f} rad at most."
    )
    result.text(verdict, "warn" if literal["share"] >= 0.7 else "")
    head = ("model step, start, norm", "N", "r", "median", "position, m", "heading, rad", "standing still", "r / standing still")
    result.table(head, [_gap_cells(g) for g in [*found["gaps"], *found.get("repaired", [])]])
    for g in (literal, weighted):
        marks = {f"r of {g['n']}": (g["r"], plots.RED), "standing still, at most": (g["still"], plots.ORANGE)}
        result.figure(
            plots.histogram(g["discrepancies"], "discrepancy", marks, "histogram of the gap"), f"Sampled discrepancies: {g['reading']}."
        )
    result.figure(_parts(literal), "The position and the heading part of these discrepancies, against the largest input's way in one step.")
    result.heading("What says more", 3)
    colours = (plots.BLUE, plots.GREEN, plots.ORANGE)
    curves = {name: (c[:, 0], c[:, 1], colour) for (name, c), colour in zip(found["drawn"].items(), colours, strict=False) if len(c)}
    result.figure(
        plots.series(curves, "model step, s", "r / standing still", "share of the gap in the largest step against the model's step"),
        "r as a share of what a robot that stands still would score, weighted ball, against the length of the model's step. A robot "
        "swings as much in a second as in a tenth of one, and goes ten times as far.",
    )
    rows = [
        (
            name,
            m["n"],
            m["discarded"],
            f"{m['epsilon']:.1%}",
            f"{m['r']:.4f}",
            f"{m['share']:.0%}",
            "" if m["beyond"] is None else f"{m['beyond']:.1%}",
        )
        for name, more in found["more"].items()
        for m in more
    ]
    result.table(("reading", "N", "discarded", "epsilon", "r", "r / standing still", "of the others beyond r"), rows)


def _parts(gap: dict[str, Any]) -> str:
    """Histograms of both parts."""
    fig, axes = plots.figure(columns=2)
    parts = (
        ("position, mm", 1e3, gap["drawn"]["position"], gap["furthest"][0]),
        ("heading, rad", 1.0, gap["drawn"]["heading"], gap["furthest"][1]),
    )
    for ax, (label, scale, values, step) in zip(axes, parts, strict=True):
        ax.hist(scale * values, bins=20, color=plots.BLUE, alpha=0.75)
        ax.axvline(scale * step, color=plots.ORANGE, linewidth=1.6, label="a step")
        ax.set_xlabel(label)
        ax.legend(frameon=False, fontsize=8)
    axes[0].set_ylabel("count")
    return plots.svg(fig, "position and heading parts of the gap")


def _gap_cells(g: dict[str, Any]) -> tuple[object, ...]:
    numbers = (f"{g[key]:.4f}" for key in ("r", "median", "position", "heading", "still"))
    return (g["reading"], g["n"], *numbers, f"{g['share']:.0%}")


def _traced(result: Page, found: dict[str, Any]) -> None:
    traced = found["traced"]
    result.heading("What the model lacks")
    if traced["told"]:
        add_trace(result, traced["told"])
    else:
        result.text(traced["text"], "soft")
    if traced["effects"]:
        result.text(
            f"In the repaired model: {'; '.join(traced['effects'])}. Whatever a model has in it, its gap comes from samples that the fit "
            "never saw (guarantee G6)."
        )


def _model(result: Page, one: dict[str, Any], shown: set[int]) -> None:
    result.heading(f"{one['name']}, disturbance law {one['law']}: r = {one['r']:.4g}, after {one['h']} held steps {one['r_h']:.4g}")
    verification(result, one)
    if "final" not in one:
        return
    runs = one["true_runs"]
    result.text(
        f"On the robot {runs['crashes']} of {runs['n']} runs crashed: at most {runs['crash_upper']:.1%} with confidence 95 %. "
        f"{runs['arrived']} arrived at the goal.",
        "good" if not runs["crashes"] else "bad",
    )
    steps = runs["steps"]
    result.text(
        f"{steps['inside']:.1%} of {steps['steps']} steps stayed in their one-step reachable set, in {steps['runs_inside']} of {runs['n']} "
        "runs all of them. The gap's statement is about samples of the campaign's law; a controller that drives has another one."
    )
    reached = one["reach"]
    grid = _grid()
    drawn = among(reached["run"].scenario, reached["predicted"], reached["run"].path, grid)
    result.panels(
        [(drawn, "One scenario: predictions of the uncertain model, and the robot."), (_sets(reached), _SETS), (_headings(reached), "")]
    )
    if id(runs["rollouts"]) not in shown:
        shown.add(id(runs["rollouts"]))
        result.panels([(tile(r.scenario, [(r.path, plots.ORANGE, 1.6)], grid), f"run {k + 1}") for k, r in enumerate(runs["rollouts"])])


_SETS = "One-step reachable sets f(x, u) + D in the plane (discs), and where the robot then was (points)."


def _window(reached: dict[str, Any]) -> slice:
    first = min(round(2.0 / reached["dt"]), len(reached["foretold"]) - 1)
    return slice(first, first + max(1, round(SHOWN_S / reached["dt"])))


def _sets(reached: dict[str, Any]) -> str:
    """Discs around the foretold positions, and what was measured."""
    fig, (ax,) = plots.figure(width=3.6, height=3.4)
    part, gap = _window(reached), reached["gap"]
    foretold, there = reached["foretold"][part], reached["run"].path[1:][part]
    turn = np.linspace(0.0, 2.0 * np.pi, 40)
    for x, y, _ in foretold:
        ax.fill(
            x + gap.radius / gap.weights[0] * np.cos(turn), y + gap.radius / gap.weights[1] * np.sin(turn), color=plots.ORANGE, alpha=0.12
        )
    ax.plot(there[:, 0], there[:, 1], ".-", color=plots.BLUE, markersize=3, linewidth=0.7)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x, m")
    ax.set_ylabel("y, m")
    return plots.svg(fig, "one-step reachable sets against what happened")


def _headings(reached: dict[str, Any]) -> str:
    """Errors of the heading against what D allows."""
    fig, (ax,) = plots.figure(width=3.6, height=3.4)
    part, gap = _window(reached), reached["gap"]
    errors = reached["errors"][part, 2]
    t = reached["dt"] * (part.start + 1 + np.arange(len(errors)))
    ax.fill_between(t, -gap.radius / gap.weights[2], gap.radius / gap.weights[2], color=plots.ORANGE, alpha=0.15)
    ax.plot(t, errors, ".-", color=plots.BLUE, markersize=3, linewidth=0.7)
    ax.set_xlabel("s")
    ax.set_ylabel("heading, measured less foretold, rad")
    return plots.svg(fig, "errors of the heading against the gap set")


def _grid() -> Grid:
    from quadruped_experiment import PROFILE

    profile: Profile = PROFILE
    model = compose(ModelSpec("unicycle", profile.model.dt))
    return GridWorld(dict(profile.task.parameters), model.nominal, model.dt).grid
