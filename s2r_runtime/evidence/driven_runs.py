"""Runs of all certified controllers in logs, each with its largest residual (guarantee G13, `composition`).

A run counts from the controller's first command in it, as for G10. What cuts it counts against the gap set: its residual is then
not known (inf). Left out is only what was decided before its outcome: a run that the controller did not drive from its start while nothing
went wrong in it, and a scenario that this controller met before (same seed).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from s2r_runtime.errors import ConfigError
from s2r_runtime.evidence.composition import DrivenRun, largest_residual
from s2r_runtime.evidence.logged_deployments import Run, deployments, in_order
from s2r_runtime.evidence.uncertain import GapSet
from s2r_runtime.hookspecs import Task
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.profile import Profile
from s2r_runtime.recording.reading import Reading


@dataclass
class DrivenRuns:
    """Runs that count, in the order of driving; their states (J + 1, nx) each; left_out: why -> how many; heads: of the logs' chains."""

    runs: list[DrivenRun] = field(default_factory=list)
    states: list[list[tuple[float, ...]]] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)
    heads: list[str] = field(default_factory=list)


def read_driven_runs(paths: Sequence[Path], profile: Profile, task: Task, model: ComposedModel, gap: GapSet) -> DrivenRuns:
    """Runs in these logs, in the order in which the logs began. gap: the norm of the residuals, and their radius.

    Raises ConfigError for a log of another robot, task or profile, or one of before the radius was fixed.
    """
    found, used = DrivenRuns(), set[tuple[str, int, int]]()
    for parts in in_order(paths):
        _check_fixed(parts, gap.radius)
        for deployment in deployments(parts, profile, task, with_states=True):
            for run in deployment.runs:
                reason = left_out_because(run, (deployment.digest, deployment.seed, run.index), used)
                if reason:
                    found.left_out[reason] = found.left_out.get(reason, 0) + 1
                    continue
                known = run.over and not run.closed and run.driven is True
                residual = largest_residual(model, gap, run.states, run.inputs) if known else math.inf
                found.runs.append(DrivenRun(deployment.digest, residual))
                found.states.append(run.states)
        found.heads.append(parts[-1].head.hex())
    return found


def left_out_because(run: Run, scenario: tuple[str, int, int], used: set[tuple[str, int, int]]) -> str:
    """Why this run does not count, or empty. used: the scenarios that were met; this one is added."""
    if scenario in used:
        return "the same scenario as an earlier run (same seed)"
    used.add(scenario)
    return "not driven by the controller from its start" if not run.driven and not run.closed else ""


def _check_fixed(parts: Sequence[Reading], radius: float) -> None:
    for entry in Reading(parts[0].path, ("event/started",)):
        fixed = getattr(getattr(entry.message, "settings", None), "run_radius", 0.0)
        if fixed != radius:
            was = f"verification.run_radius was {fixed:g} then" if fixed else "verification.run_radius was not set then"
            raise ConfigError(f"{parts[0].path}: {was}, and {radius:g} is meant; the radius is fixed before the runs that count")
