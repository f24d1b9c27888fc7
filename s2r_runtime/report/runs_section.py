"""The report's section on the runs that controllers drove on this robot, with the limits after each (guarantee G10)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from s2r_runtime.evidence.statements import of_runs, runs_line
from s2r_runtime.messages import EpisodeCounted, RunLimits, Settings
from s2r_runtime.report import plots
from s2r_runtime.report.page import Page


def add_runs(page: Page, counted: Sequence[EpisodeCounted], settings: Settings | None) -> None:
    """For each controller: the statement as it stands at the log's end, the limits over its runs, and the runs that were not safe."""
    if not counted:
        return
    page.heading("Runs on this robot")
    left_out = sum(one.outcome == "left_out" for one in counted)
    if left_out:
        page.text(f"Left out: {left_out} runs that the controller did not drive from their start.", "soft")
    for controller in dict.fromkeys(one.controller for one in counted):
        _of_controller(page, [one for one in counted if one.controller == controller and one.outcome != "left_out"], settings)


def _of_controller(page: Page, runs: list[EpisodeCounted], settings: Settings | None) -> None:
    if not runs:
        return
    last = runs[-1].limits
    page.text(f"Controller {runs[-1].controller[7:19]}: {runs_line(last[0])}.", "statement")
    page.text(of_runs(last[0]), "soft")
    if len(last) > 1 and last[1].number != last[0].number:
        page.text(f"Certificate {last[1].certificate[7:19]}: {runs_line(last[1])}.")
    page.figure(_plot([one.limits[0] for one in runs], settings), _caption(settings))
    bad = [one for one in runs if one.outcome != "safe"]
    if bad:
        page.table(
            ("run", "scenario", "steps", "safety value", "counts as", "because"),
            [
                (one.limits[0].n, one.index, one.steps, "-" if one.safety is None else f"{one.safety:+.3f}", one.outcome, one.reason)
                for one in bad
            ],
        )


def _plot(limits: Sequence[RunLimits], settings: Settings | None) -> str:
    n = np.array([float(one.n) for one in limits])
    values = {
        "at most": ([one.upper for one in limits], plots.BLUE),
        "unsafe so far": ([one.unsafe / one.n for one in limits], plots.SOFT),
        "at least": ([one.lower for one in limits], plots.ORANGE),
    }
    curves = {name: (n, _percent(shares), colour) for name, (shares, colour) in values.items() if any(shares)}
    if settings is not None and settings.max_unsafe > 0.0:
        curves["guarantee.max_unsafe"] = (n, np.full(len(n), 100.0 * settings.max_unsafe), plots.RED)
    return plots.series(
        curves, "runs of this controller on this robot", "unsafe runs, %", "limits of the share of unsafe runs over runs", log=True
    )


def _percent(shares: Sequence[float]) -> plots.Array:
    """For a logarithmic axis: a share of 0 has no place there."""
    return np.array([100.0 * share if share > 0.0 else np.nan for share in shares])


def _caption(settings: Settings | None) -> str:
    said = "The true mean probability of an unsafe run lies between the two limits, after every run at once."
    if settings is not None and settings.max_unsafe > 0.0:
        said += " Where the lower limit crosses the red line, the controller is revoked."
    return said
