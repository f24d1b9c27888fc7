"""The figures of the rover experiment on one self-contained page: sampled discrepancies, the drive, the watch, the fault."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rover_story import Told

from s2r_runtime.messages import Gap
from s2r_runtime.recording.reading import read
from s2r_runtime.report import plots
from s2r_runtime.report.page import Page
from s2r_runtime.report.story import Story
from s2r_runtime.report.story import tell as fold

Array = NDArray[np.float64]
AROUND_S = 30.0
"""Before and after the fault, in its figure."""
SHOWN_M = 0.1
"""Larger discrepancies are drawn there: a rover drives no farther in one step."""


def page(stories: list[Told], bare: dict[str, Any], lines: list[str]) -> str:
    """The page."""
    result = Page("A real autopilot, all the way", "ArduPilot Rover in its own simulator, driven through MAVLink under a certificate")
    complete = sum(told.is_complete for told in stories)
    result.text(f"{complete} of {len(stories)} stories were complete.", "good" if complete == len(stories) else "bad")
    result.items(lines)
    for told in stories:
        _story(result, told)
    if "radius" in bare:
        result.heading("The bare unicycle on the same samples")
        result.text(
            f"Without ramps and delays the model is off by up to {bare['radius']:.3g} m in one step. The controller "
            + ("passes at this gap." if bare.get("passed") else "is refused at this gap."),
            "" if bare.get("passed") else "warn",
        )
    return result.html()


def _story(result: Page, told: Told) -> None:
    result.heading(told.name)
    rows = [
        (
            f"{step['at_s']:.0f}",
            f"s2r {_without_folders(step['verb'])}",
            f"{step['seconds']:.0f}",
            step["exit_code"],
            _first_line(step["text"]),
        )
        for step in told.steps
    ]
    result.table(("at, s", "verb", "took, s", "exit code", "answer"), rows)
    seen = fold(entry for log in told.logs for entry in read(log))
    for gap in seen.gaps:
        _gap(result, gap, seen)
    _drive(result, seen)
    _watched(result, told)


def _without_folders(text: str) -> str:
    return " ".join(word.rsplit("/", 1)[-1] for word in text.split())


def _first_line(text: str) -> str:
    """The answer's first line; of a digest its first digits, which tell it from others."""
    return re.sub(r"(sha256:[0-9a-f]{8})[0-9a-f]+", r"\1...", next(iter(text.strip().splitlines()), ""))[:140]


def _gap(result: Page, gap: Gap, seen: Story) -> None:
    taken = len(seen.samples.get(gap.epoch, []))
    result.text(
        f"Epoch {gap.epoch}: {taken} samples, gap {1e3 * gap.radius:.3g} mm in one step, "
        f"{1e3 * gap.hold_radius:.3g} mm over {gap.hold_periods} held steps, at epsilon {gap.epsilon:g}."
    )


def _drive(result: Page, seen: Story) -> None:
    """Path, and discrepancies against radius and verified radius."""
    poses, measured = seen.poses.rows, seen.discrepancies.rows
    if poses:
        x = np.array([row[1][:2] for row in poses])
        result.figure(
            plots.path(x[:, 0], x[:, 1], np.array([row[2] for row in poses]), "x, m (north)", "y, m (west)", "where the rover drove"),
            "Where the rover drove: sampling, and under a certificate.",
        )
    if measured:
        t, d, _, radius, verified = (np.array(column) for column in zip(*measured, strict=True))
        d = np.minimum(d, SHOWN_M)
        curves = {
            "discrepancy": (t, 1e3 * d, plots.BLUE),
            "radius in force": (t, 1e3 * radius, plots.ORANGE),
            "verified radius": (t, 1e3 * verified, plots.RED),
        }
        result.figure(
            plots.series(curves, "time in the log, s", "mm in one step", "discrepancies while driving"),
            "Each step while driving against the model, the gap's radius in force, and the radius to which the controller is verified. The "
            "last jump is the fault.",
        )
        marks = {"radius at first": (1e3 * radius[0], plots.ORANGE)}
        result.figure(plots.histogram(1e3 * d, "discrepancy, mm", marks, "histogram of discrepancies"), "The same, as a histogram.")


def _watched(result: Page, told: Told) -> None:
    """The gate, and what happened around the fault."""
    if not told.watched:
        return
    at = np.array([row["at_s"] for row in told.watched])
    spans = [
        (begin, end, "open" if row["gate"] == "open" else "closed")
        for begin, end, row in zip(at[:-1], at[1:], told.watched[:-1], strict=True)
    ]
    colours = {"open": (plots.GREEN, "gate open"), "closed": (plots.QUIET, "gate closed")}
    marks = [(told.fault_at_s, 1, plots.RED)] if told.fault_at_s is not None else []
    result.figure(
        plots.timeline(spans, marks, colours, "time in the story, s", "the gate"), "The gate while it drove. 1: the fault is set."
    )
    if told.fault_at_s is not None:
        near = [row for row in told.watched if abs(row["at_s"] - told.fault_at_s) < AROUND_S and row["radius"]]
        t = np.array([row["at_s"] - told.fault_at_s for row in near])
        grown = np.array([1e3 * row["radius"] for row in near])
        verified = np.array([1e3 * (row["verified_radius"] or np.nan) for row in near])
        curves = {"radius in force": (t, grown, plots.ORANGE), "verified radius": (t, verified, plots.RED)}
        result.figure(
            plots.series(curves, "time after the fault, s", "mm in one step", "the fault"),
            f"The fault. Certificates revoked after {told.noticed_after_s:.1f} s: {told.reason_noticed}."
            if told.noticed_after_s is not None
            else "The fault. It was not noticed.",
        )
