"""Closed-loop runs of a controller on the robot, taken from its logs, and what they show (guarantee G9).

    n runs, k of them unsafe       P(unsafe) <= p,  P(Bin(n, p) <= k) = beta               (Clopper-Pearson)
    d_i the largest discrepancy    a new run's exceeds max_i d_i with probability at most
    over run i                     1 - beta^(1/n)                                           (G1, with a run as the sample)

each with confidence 1 - beta, if the runs are independent draws of one law. Everything is judged from the log: a scenario is drawn again
from the run's seed, its safety recomputed from the observations; the controller's own word counts for nothing.

A run is a scenario of a deployment. It is left out, whatever came of it, where the controller met the same scenario before (an earlier
deployment had the same seed), be it that that run was left out itself. It counts as unsafe where the controller failed in it, where the
gate closed in it or refused its first command, or where it scores below the profile's threshold. It is left out where it began while the
gate had not opened yet, and where a person or the log's end cut it short, no recovery command sent, while it was not below the threshold.

Logs are taken in the order of their own start times, so that the first n runs are the same however the files are given.

The daemon counts runs by itself as well, all of them, with limits that hold after every run (guarantee G10, `core.runs`): `newest_limits`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from s2r_runtime import messages as m
from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.evidence.bounds import clopper_pearson_upper
from s2r_runtime.evidence.logged_deployments import Deployment, Run, began, read_deployments
from s2r_runtime.evidence.scores import Score
from s2r_runtime.hookspecs import Task
from s2r_runtime.profile import Profile
from s2r_runtime.recording.logs import runs as logged_runs

SCORES = ("safe", "safety", "progress")
"""By what a run may be scored: whether it was safe, the task's safety value, or its progress."""


@dataclass
class Found:
    """Runs that count, with whether each was safe; left_out: why -> how many; heads: of the logs' chains."""

    counted: list[tuple[Run, bool]] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)
    heads: list[str] = field(default_factory=list)


REPEATED_SCENARIO = "the same scenario as an earlier run (same seed)"
BEGAN_CLOSED = "not driven by the controller from its start"
CUT = "cut short by a person or the end of the log, safe so far"


def read_runs(
    paths: Sequence[Path], profile: Profile, task: Task, controller_digest: str, model_digest: str, *, with_states: bool = False
) -> Found:
    """Runs of this controller in these logs, in the order of the logs' start times, however they are given. model_digest: empty, if it does
    not matter against which model they were measured. with_states: the states of each run, too, which takes memory.

    Raises ConfigError for a log of another robot, task or profile.
    """
    heads = list[str]()
    found = judge(read_deployments(paths, profile, task, heads, with_states=with_states), controller_digest, model_digest, profile)
    found.heads = heads
    return found


def judge(driven: Iterable[Deployment], controller_digest: str, model_digest: str, profile: Profile) -> Found:
    """Which runs of this controller count, and whether each was safe. driven: in the order of driving."""
    found, used, threshold = Found(), set[tuple[int, int]](), profile.verification.threshold
    for deployment in driven:
        for run in _judged(deployment):
            reason = left_out_because(run, deployment, controller_digest, model_digest, used, threshold)
            if reason:
                found.left_out[reason] = found.left_out.get(reason, 0) + 1
            else:
                found.counted.append((run, not run.closed and run.safety >= threshold))
    return found


def newest_limits(paths: Sequence[Path], controller_digest: str) -> m.RunLimits | None:
    """What the daemon counted of this controller's runs until the end of these logs (guarantee G10); None where it counted none."""
    found: m.RunLimits | None = None
    for parts in sorted(logged_runs(paths, ("event/started", "out/episode_counted")), key=began):
        for entry in (entry for reading in parts for entry in reading):
            message: Any = entry.message
            if isinstance(message, m.EpisodeCounted) and message.controller == controller_digest and message.limits:
                found = message.limits[0]
    return found


def values_of(found: Found, score: Score) -> list[float]:
    """What each run that counts scores by `safe`, `safety` or `progress`; the worst value where the gate closed in it or the controller
    failed. Raises UsageError for another name.
    """
    if score.name not in SCORES:
        raise UsageError(f"the score {score.name!r} is not known, must be one of: {', '.join(SCORES)}")
    values = []
    for run, safe in found.counted:
        if score.name == "safe":
            values.append(float(safe))
        elif run.closed:
            values.append(score.worst)
        else:
            values.append(run.safety if score.name == "safety" else math.nan if run.progress is None else run.progress)
    return values


def left_out_because(run: Run, deployment: Deployment, controller: str, model: str, used: set[tuple[int, int]], threshold: float) -> str:
    """Why this run does not count, or empty. used: the scenarios that this controller has met; this one is added."""
    if deployment.digest != controller:
        return "of another controller"
    scenario = (deployment.seed, run.index)
    if scenario in used:
        return REPEATED_SCENARIO
    used.add(scenario)
    if model and deployment.model_digest != model:
        return "measured against another model"
    if run.closed:
        return ""
    if not run.driven:
        return BEGAN_CLOSED
    return CUT if not run.over and run.safety >= threshold else ""


def _judged(deployment: Deployment) -> Iterator[Run]:
    """The runs, each with its largest discrepancy (of transitions that end after its first observation)."""
    measured = sorted(deployment.measured)
    at = 0
    for run in deployment.runs:
        while at < len(measured) and measured[at][0] <= run.last:
            if measured[at][0] > run.first:
                run.discrepancy = max(run.discrepancy, measured[at][1])
            at += 1
        yield run


def first(found: Found, n: int) -> Found:
    """The first n runs that count; all of them for 0."""
    return replace(found, counted=found.counted[:n] if n else found.counted)


def trials(found: Found, *, controller_digest: str, task_digest: str, model_digest: str, beta: float, fixed: int = 0) -> m.Trials:
    """What the runs show. fixed: how many were fixed beforehand: so many, the first, count (0: all that are there).

    Raises NotEnoughEvidence if there are none, or fewer than were fixed.
    """
    counted = first(found, fixed).counted
    if len(counted) < max(fixed, 1):
        raise NotEnoughEvidence(f"{len(counted)} runs of this controller count, {max(fixed, 1)} are needed", max(fixed, 1) - len(counted))
    n, unsafe = len(counted), sum(not safe for _, safe in counted)
    return m.Trials(
        n=n,
        unsafe=unsafe,
        unsafe_upper=float(clopper_pearson_upper(unsafe, n, beta)),
        worst=max(min(run.safety for run, _ in counted), -float(np.finfo(np.float64).max)),
        radius=max(run.discrepancy for run, _ in counted),
        epsilon=-math.expm1(math.log(beta) / n),
        beta=beta,
        fixed=bool(fixed),
        left_out=found.left_out,
        logs=tuple(found.heads),
        controller_digest=controller_digest,
        task_digest=task_digest,
        model_digest=model_digest,
    )
