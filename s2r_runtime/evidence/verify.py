"""Controller x task x uncertain model -> least safety value and what it shows (paper, corollary 2; guarantee G2, G8).

N scenarios drawn independently, one rollout each, s* the least of the N safety values: with confidence 1 - (1 - eps)^N a new rollout of
the uncertain model under the same disturbance law scores below s* with probability at most eps.

    passed  iff  for every required law:  s* >= threshold  and the task's progress requirement holds

Every required law must pass, so no share of beta is lost to their number. Beside s* stands the Clopper-Pearson upper bound on
P(s < threshold). The seed of an attempt that counts is drawn after it was paid for (`seeds`): nobody can shop for one.

A range of radii may be asked for: then the result is of the largest at which the controller passes, out of radii fixed beforehand that
share beta (`headroom`). At each of them the scenarios and draws are those of the same seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from s2r_runtime.controllers.observing import View, whole
from s2r_runtime.core.headroom import grid, search
from s2r_runtime.errors import ControllerError, NotEnoughEvidence, UsageError
from s2r_runtime.evidence import seeds
from s2r_runtime.evidence.bounds import clopper_pearson_upper, sample_size, scenario_confidence
from s2r_runtime.evidence.statements import confidence, worst
from s2r_runtime.evidence.uncertain import LAWS, Array, Control, GapSet, Rollouts, roll_out
from s2r_runtime.hookspecs import Task
from s2r_runtime.messages import LawResult, RadiusTried, Verification
from s2r_runtime.models.composed import ComposedModel

Progress = Callable[[float, float, str], None]


@dataclass(frozen=True)
class Detail:
    """One law's rollouts, for plots and for the log."""

    law: str
    rollouts: Rollouts


def seed_for(controller_digest: str, model_digest: str, task_digest: str, number: int) -> int:
    """The seed of rollouts that cost nothing and found no certificate (`s2r verify`): none of these is ever the seed of an attempt."""
    return seeds.known("verify", controller_digest, model_digest, task_digest, number)


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
    least_radius: float = 0.0,
    keep: int = 0,
    progress: Progress | None = None,
    view: View = whole,
) -> tuple[Verification, list[Detail]]:
    """n scenarios for each law (0: as many as epsilon and beta ask for). keep: so many paths a law are kept for plots. view: what the
    controller is shown.

    least_radius: the largest radius between this and gap_set's at which the controller passes is looked for (0: at gap_set's only).
    A controller that raises or answers with anything but finite (n, nu) inputs has failed, with the reason in the result. Raises
    UsageError for laws that make no sense, NotEnoughEvidence if n is too small for epsilon and beta.
    """
    _check(laws, required)
    radii = grid(least_radius, gap_set.radius)
    share = beta / len(radii)
    runs = _Runs(
        control,
        task,
        model,
        n=_enough(n, epsilon, share),
        threshold=threshold,
        share=share,
        seed=seed,
        required=required,
        keep=keep,
        progress=progress,
        most=1 + math.ceil(math.log2(len(radii))),
        laws=laws,
        view=view,
    )
    best, tried = _farthest(runs, gap_set, radii)
    runs.complete(best)
    return (
        Verification(
            passed=not best.reason,
            radius=best.gap_set.radius,
            hold_radius=best.gap_set.hold_radius,
            threshold=threshold,
            epsilon=epsilon,
            beta=beta,
            attempt=attempt,
            seed=seed,
            laws=tuple(sorted(best.results, key=lambda r: list(laws).index(r.law))),
            controller_digest=controller_digest,
            model_digest=model.spec.digest(),
            task_digest=task_digest,
            reason=best.reason,
            split=len(radii),
            tried=tuple(tried) if len(radii) > 1 else (),
        ),
        best.details,
    )


def _enough(n: int, epsilon: float, beta: float) -> int:
    """n scenarios, or as many as are needed where n is 0. Raises NotEnoughEvidence if they are too few."""
    needed = sample_size(epsilon, beta)
    n = n or needed
    if n < needed:
        raise NotEnoughEvidence(
            f"{n} scenarios, {needed} are needed for epsilon {epsilon:g} and beta {beta:.4g}: {needed - n} more", needed - n
        )
    return n


@dataclass
class _Run:
    """Rollouts at one radius. reason: why it does not pass, or empty."""

    gap_set: GapSet
    results: list[LawResult]
    details: list[Detail]
    reason: str = ""


@dataclass
class _Runs:
    """What is the same at every radius. share: of beta, that one radius has; most: how many radii are looked at, at most."""

    control: Control
    task: Task
    model: ComposedModel
    n: int
    threshold: float
    share: float
    seed: int
    required: Sequence[str]
    keep: int
    progress: Progress | None
    most: int
    laws: Sequence[str]
    view: View
    done: int = 0

    def run(self, gap_set: GapSet, *, only_required: bool) -> _Run:
        """All laws, or the required ones as far as they pass: where the answer is no, only that is of interest."""
        run = _Run(gap_set, [], [])
        for law in self.laws:
            if only_required and law not in self.required:
                continue
            self._roll_out(run, law, self.threshold if only_required else -np.inf)
            if run.reason or (only_required and _why_not(run.results, self.threshold)):
                break
        run.reason = run.reason or _why_not(run.results, self.threshold)
        self.done += 1
        return run

    def complete(self, run: _Run) -> None:
        """The laws that were left out because nothing depended on them."""
        for law in self.laws:
            if not run.reason and law not in {detail.law for detail in run.details}:
                self._roll_out(run, law)

    def _roll_out(self, run: _Run, law: str, give_up_below: float = -np.inf) -> None:
        rng = np.random.default_rng([self.seed, list(LAWS).index(law)])
        told = None if self.progress is None else self._tell(self.progress, run.gap_set.radius, law)
        try:
            rollouts = roll_out(
                self.control,
                self.task,
                self.model,
                run.gap_set,
                law,
                rng,
                self.n,
                keep=self.keep,
                progress=told,
                give_up_below=give_up_below,
                view=self.view,
            )
        except ControllerError as error:
            # a controller's own failure is a verdict on the controller, under whichever law it shows; nothing was shown under this one
            run.reason = f"under {law}: {error}"
            return
        run.details.append(Detail(law, rollouts))
        run.results.append(_judge(law, rollouts, self.task, self.threshold, self.share, law in self.required))

    def _tell(self, progress: Progress, radius: float, law: str) -> Callable[[float, float], None]:
        before, whole = (self.done * len(self.laws) + list(self.laws).index(law)) * self.n, self.most * len(self.laws) * self.n
        detail = law if self.most == 1 else f"{law}, radius {radius:.3g}"
        return lambda done, _total: progress(before + done, whole, detail)


def _farthest(runs: _Runs, gap_set: GapSet, radii: Sequence[float]) -> tuple[_Run, list[RadiusTried]]:
    """The run at the largest of the radii (ascending, the last is gap_set's) at which the controller passes, else at the least; and those
    that were looked at, in that order.
    """
    tried: list[RadiusTried] = []
    at: dict[int, _Run] = {}

    def passes(index: int) -> bool:
        share = radii[index] / gap_set.radius if gap_set.radius > 0.0 else 1.0
        scaled = replace(gap_set, radius=radii[index], hold_radius=gap_set.hold_radius * share)
        at[index] = run = runs.run(scaled, only_required=index > 0)
        least = min((r.s_star for r in run.results if r.required), default=-np.finfo(np.float64).max)
        tried.append(RadiusTried(index, scaled.radius, not run.reason, float(least)))
        return not run.reason

    return at[search(len(radii), passes) or 0], tried


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


def statement(v: Verification) -> str:
    """What the rollouts show (G2, G8), and no more."""
    if not v.passed:
        return f"Not passed: {v.reason}. Nothing is claimed for this controller at radius {v.radius:.6g}."
    required = [r for r in v.laws if r.required]
    named = ", ".join(f"{r.law} (s* = {worst(r.s_star)}, N = {r.n})" for r in required)
    attained = min(v.split * max(scenario_confidence(r.n, 0, v.epsilon) for r in required), 1.0)
    told = [
        (
            f"Under each of the disturbance laws {named}: with confidence {confidence(attained)} a new rollout of the uncertain model "
            f"(radius {v.radius:.6g}, hold gap {v.hold_radius:.6g}) scores below s* with probability at most {v.epsilon:g}; "
            f"s* is at least the threshold {v.threshold:g}."
        )
    ]
    if v.split > 1:
        told.append(
            f"The radius is the largest of {v.split}, fixed beforehand, at which it was seen to pass; the confidence holds for all at once."
        )
    if len(required) > 1:
        told.append("The laws were read side by side: each statement holds by itself at this confidence.")
    if [r.law for r in required] == ["uniform"]:
        told.append("Only uniform was required: nothing is shown about a disturbance that persists.")
    told += [
        f"Reported and not required: under {r.law} s* = {worst(r.s_star)}, {r.failures} of {r.n} rollouts below the threshold "
        "(worst found, not proved)."
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
        "What rollouts show against disturbances is the worst found, not proved; only an enclosure covers all of them (G13).",
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
        "split": v.split,
        "tried": [{"radius": one.radius, "passed": one.passed, "s_star": one.s_star} for one in v.tried],
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
