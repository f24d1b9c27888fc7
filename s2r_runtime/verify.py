"""Controller x task x uncertain model -> least safety value and what it shows (paper, corollary 2; guarantee G2, G8).

N scenarios drawn independently, one rollout each, s* the least of the N safety values: with confidence 1 - (1 - eps)^N a new rollout of
the uncertain model under the same disturbance law scores below s* with probability at most eps.

    passed  iff  for every required law:  s* >= threshold  and the task's progress requirement holds

Every required law must pass, so no share of beta is lost to their number. Beside s* stands the Clopper-Pearson upper bound on
P(s < threshold). The seed is a function of the digests and the attempt number: nobody can shop for one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from s2r_runtime.bounds import clopper_pearson_upper, sample_size, scenario_confidence
from s2r_runtime.errors import ControllerError, NotEnoughEvidence, UsageError
from s2r_runtime.hookspecs import Task
from s2r_runtime.messages import LawResult, Verification
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.statements import confidence, worst
from s2r_runtime.uncertain import LAWS, Array, Control, GapSet, Rollouts, roll_out

Progress = Callable[[float, float, str], None]


@dataclass(frozen=True)
class Detail:
    """One law's rollouts, for plots and for the log."""

    law: str
    rollouts: Rollouts


def seed_for(controller_digest: str, model_digest: str, task_digest: str, attempt: int) -> int:
    """The seed of an attempt, 0 .. 2^63 - 1: a function of what is verified and how often that was tried (guarantee G2)."""
    text = f"{controller_digest}\n{model_digest}\n{task_digest}\n{attempt}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def verify(control: Control, task: Task, model: ComposedModel, **choices: Any) -> Verification:
    """As `verify_in_detail`, the result alone."""
    return verify_in_detail(control, task, model, **choices)[0]


def verify_in_detail(
    control: Control,
    task: Task,
    model: ComposedModel,
    *,
    gap_set: GapSet,
    laws: Sequence[str],
    required: Sequence[str],
    n: int,
    epsilon: float,
    beta: float,
    threshold: float,
    seed: int,
    controller_digest: str,
    task_digest: str,
    attempt: int = 1,
    keep: int = 0,
    progress: Progress | None = None,
) -> tuple[Verification, list[Detail]]:
    """n scenarios for each law (0: as many as epsilon and beta ask for). keep: so many paths a law are kept for plots.

    A controller that raises or answers with anything but finite (n, nu) inputs has failed, with the reason in the result. Raises
    UsageError for laws that make no sense, NotEnoughEvidence if n is too small for epsilon and beta.
    """
    _check(laws, required)
    needed = sample_size(epsilon, beta)
    n = n or needed
    if n < needed:
        raise NotEnoughEvidence(
            f"{n} scenarios, {needed} are needed for epsilon {epsilon:g} and beta {beta:.4g}: {needed - n} more", needed - n
        )
    results: list[LawResult] = []
    details: list[Detail] = []
    reason = ""
    for index, law in enumerate(laws):
        rng = np.random.default_rng([seed, list(LAWS).index(law)])
        told = None if progress is None else _tell(progress, law, index * n, len(laws) * n)
        try:
            rollouts = roll_out(control, task, model, gap_set, law, rng, n, keep=keep, progress=told)
        except ControllerError as error:
            # a controller's own failure is a verdict on the controller, under whichever law it shows; nothing was shown under this one
            reason = f"under {law}: {error}"
            break
        details.append(Detail(law, rollouts))
        results.append(_judge(law, rollouts, task, threshold, beta, law in required))
    reason = reason or _why_not(results, threshold)
    return (
        Verification(
            passed=not reason,
            radius=gap_set.radius,
            hold_radius=gap_set.hold_radius,
            threshold=threshold,
            epsilon=epsilon,
            beta=beta,
            attempt=attempt,
            seed=seed,
            laws=tuple(results),
            controller_digest=controller_digest,
            model_digest=model.spec.digest(),
            task_digest=task_digest,
            reason=reason,
        ),
        details,
    )


def _check(laws: Sequence[str], required: Sequence[str]) -> None:
    if not laws or len(set(laws)) != len(laws):
        raise UsageError(f"disturbance laws are {list(laws)}, must be at least one, each once")
    if unknown := [law for law in laws if law not in LAWS]:
        raise UsageError(f"disturbance law {unknown[0]!r} is not known, must be one of: {', '.join(LAWS)}")
    if not required or not set(required) <= set(laws):
        raise UsageError(f"required laws are {list(required)}, must be at least one of those that are run: {', '.join(laws)}")


def _judge(law: str, rollouts: Rollouts, task: Task, threshold: float, beta: float, required: bool) -> LawResult:
    safety: Array = rollouts.safety
    failures = int(np.sum(~(safety >= threshold)))  # a value that is no number is a failure
    finite = np.where(np.isfinite(safety), safety, -np.finfo(np.float64).max)
    s_star, ok = float(np.min(finite)), bool(task.progress_ok(rollouts.progress))
    return LawResult(
        law=law,
        n=len(safety),
        s_star=s_star,
        failures=failures,
        failure_upper=clopper_pearson_upper(failures, len(safety), beta),
        progress=float(np.median(rollouts.progress)),
        progress_ok=ok,
        required=required,
        passed=s_star >= threshold and failures == 0 and ok,
    )


def _why_not(results: Sequence[LawResult], threshold: float) -> str:
    reasons = []
    for r in results:
        if not r.required or r.passed:
            continue
        if r.failures:
            reasons.append(f"under {r.law} {r.failures} of {r.n} rollouts score below {threshold:g}, the worst {r.s_star:.4g}")
        else:
            reasons.append(
                f"under {r.law} the task's progress requirement does not hold (median {r.progress:.4g}): standing still is no pass"
            )
    return "; ".join(reasons)


def _tell(progress: Progress, law: str, before: int, total: int) -> Callable[[float, float], None]:
    return lambda done, _total: progress(before + done, total, law)


def statement(v: Verification) -> str:
    """What the rollouts show (G2, G8), and no more."""
    if not v.passed:
        return f"Not passed: {v.reason}. Nothing is claimed for this controller at radius {v.radius:.6g}."
    required = [r for r in v.laws if r.required]
    named = ", ".join(f"{r.law} (s* = {worst(r.s_star)}, N = {r.n})" for r in required)
    attained = max(scenario_confidence(r.n, 0, v.epsilon) for r in required)
    told = [
        (
            f"Under each of the disturbance laws {named}: with confidence {confidence(attained)} a new rollout of the uncertain model "
            f"(radius {v.radius:.6g}, hold gap {v.hold_radius:.6g}) scores below s* with probability at most {v.epsilon:g}; "
            f"s* is at least the threshold {v.threshold:g}."
        )
    ]
    if len(required) > 1:
        told.append("The laws were read side by side: each statement holds by itself at this confidence.")
    if [r.law for r in required] == ["uniform"]:
        told.append("Only uniform was required: nothing is shown about a disturbance that persists.")
    told += [
        f"Reported and not required: under {r.law} s* = {worst(r.s_star)}, {r.failures} of {r.n} rollouts below the threshold."
        for r in v.laws
        if not r.required
    ]
    return " ".join(told)


def not_shown() -> list[str]:
    """What nobody may read into the statements, in general (a certificate's own list has the numbers)."""
    return [
        "The gap's statement and the controller's do not compose into a statement about the true closed loop.",
        "A controller that drives chooses other inputs than a campaign: where it does so rho times as often, epsilon becomes rho epsilon.",
        "Epsilon is a probability a step: over a run of hundreds of steps the gap may be exceeded at least once.",
        "The disturbance laws are models: independent, zero-mean noise averages out where a real, persistent disturbance does not.",
        "Nothing is said about scenarios outside the task's law, states outside the region, or a robot that changed since the campaign.",
    ]


def verification_json(v: Verification) -> dict[str, Any]:
    """What `s2r verify --json` prints."""
    return {
        "passed": v.passed,
        "reason": v.reason,
        "radius": v.radius,
        "hold_radius": v.hold_radius,
        "threshold": v.threshold,
        "epsilon": v.epsilon,
        "beta": v.beta,
        "attempt": v.attempt,
        "seed": v.seed,
        "laws": {
            r.law: {
                "n": r.n,
                "s_star": r.s_star,
                "failures": r.failures,
                "failure_upper": r.failure_upper,
                "progress": r.progress,
                "progress_ok": r.progress_ok,
                "required": r.required,
                "passed": r.passed,
            }
            for r in v.laws
        },
        "controller_digest": v.controller_digest,
        "model_digest": v.model_digest,
        "task_digest": v.task_digest,
        "statement": statement(v),
        "not_shown": not_shown(),
    }
