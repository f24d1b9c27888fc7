"""Runs for a comparison of controllers (guarantee G14), by the rules by which the daemon counts them (docs/episodes.md)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

from s2r_runtime.evidence.logged_deployments import Deployment, Run
from s2r_runtime.evidence.scores import Score
from s2r_runtime.evidence.trials import BEGAN_CLOSED, CUT, REPEATED_SCENARIO, Found, left_out_because, values_of

Outcome = Literal["safe", "unsafe", "censored", "left_out"]


class Compared(NamedTuple):
    """Runs for a comparison, in the order of driving, by the daemon's rules (docs/episodes.md).

    censored: nobody knows how it would have ended. left_out: why -> how many.
    """

    runs: list[tuple[Run, Outcome]]
    left_out: dict[str, int]


def judge_compared(driven: Iterable[Deployment], controller_digest: str, threshold: float, seed: int | None = None) -> Compared:
    """Runs of this controller. seed: of these scenarios alone (None: of all)."""
    found, used = Compared([], {}), set[tuple[int, int]]()
    for deployment in driven:
        if deployment.digest != controller_digest or (seed is not None and deployment.seed != seed):
            continue
        for run in deployment.runs:
            reason = left_out_because(run, deployment, controller_digest, "", used, threshold)
            outcome = _outcome(run, deployment, reason, threshold)
            if outcome == "left_out":
                found.left_out[reason or BEGAN_CLOSED] = found.left_out.get(reason or BEGAN_CLOSED, 0) + 1
            else:
                found.runs.append((run, outcome))
        found.runs.extend((run, "censored") for run in _lost(deployment))
    return found


def _lost(deployment: Deployment) -> list[Run]:
    """Scenarios of a comparison of which the log has nothing, because it was cut. The controller may have driven in them."""
    if deployment.scenarios is None or deployment.ended:
        return []
    of, known = deployment.scenarios, {run.index for run in deployment.runs}
    return [Run(index, -1, seed=of.seed) for index in range(of.first, of.first + of.count) if index not in known]


def _outcome(run: Run, deployment: Deployment, reason: str, threshold: float) -> Outcome:
    """reason: of `left_out_because`. A daemon that ended before it counted a run was cut, and so was the run."""
    if reason == REPEATED_SCENARIO:
        return "left_out"
    if deployment.counted and run.outcome:
        return run.outcome  # type: ignore[return-value] # as the log's schema has it
    cut = deployment.counted and not run.over and (run.driven or not deployment.ended)
    if reason == CUT or (cut and run.safety >= threshold):
        return "censored"
    return "left_out" if reason else "safe" if not run.closed and run.safety >= threshold else "unsafe"


def compared_values(found: Compared, score: Score) -> list[float | None]:
    """What each run scores, as `values_of`; None for a censored run."""
    scored = values_of(Found([(run, outcome == "safe") for run, outcome in found.runs]), score)
    return [None if outcome == "censored" else value for value, (_, outcome) in zip(scored, found.runs, strict=True)]
