"""What a certificate shows and what it does not, in sentences made from its numbers (docs/guarantee.md). They say exactly this and no more.

Numbers are rounded away from what would flatter: bounds up, worst values and confidences down.
"""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal

from s2r_runtime.core.ledger import spent
from s2r_runtime.messages import (
    BEHAVIOURS,
    Composition,
    Enclosure,
    Gap,
    InsideRuns,
    LawResult,
    RunLimits,
    Simulated,
    Trials,
    Tries,
    Verification,
)
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import Driving

HELD = {
    "first": "each after a random waypoint and a full stop",
    "random": "each one period drawn uniformly from a hold that began after a random waypoint and a full stop",
}
"""What is said of the period of a hold that gives the sample."""
ASSUMED = "rests on an assumption that the user made"
STATED = "rests on an assumption that was tested and is not proved"


def shown(
    robot: str,
    model: ModelSpec,
    task: str,
    gap: Gap,
    verification: Verification,
    budget: float,
    assumption: str = "",
    trials: Trials | None = None,
    period: str = "first",
    tries: Tries | None = None,
    runs: RunLimits | None = None,
    composition: Composition | None = None,
) -> tuple[str, ...]:
    """The statements G1 to G4, G8, G10 and G13 of this evidence. budget: beta of the robot's life. assumption: one that the user made.
    period: of each hold that gave the sample (`sampling.period`). tries: what was tried before, if it was counted.
    runs: of this controller on this robot.

    Whether the numbers carry them is for `certificate.issue` to check.
    """
    return (
        *_gap(robot, model, gap, assumption, period),
        *_controller(task, gap, verification),
        (
            f"Together (G3). The gap's statement and a failure probability of at most {bound(verification.epsilon)} under every required "
            f"law hold at once with confidence {confidence(gap.beta + verification.beta)}: the confidences add."
        ),
        (
            f"Over the robot's life (G4). Gap epoch {gap.epoch} spent {bound(gap.beta)} and verification attempt {verification.attempt} "
            f"{bound(verification.beta)} of beta = {budget:g}; the epochs and attempts up to these spent "
            f"{bound(spent(budget, gap.epoch, verification.attempt))} of it, and all there will ever be spend no more than all of it."
        ),
        *(() if tries is None else (_tried(tries, verification),)),
        *(() if trials is None else (of_trials(trials),)),
        *(() if trials is None or trials.simulated is None else of_simulated(trials.simulated)),
        *(() if runs is None else (of_runs(runs),)),
        *(() if composition is None else of_composition(composition)),
    )


def _tried(tries: Tries, v: Verification) -> str:
    """How much was tried, and where the seed came from (G2, G4)."""
    # an attempt that was interrupted is counted, its controller's behaviour is not known
    least = "at least " if tries.controllers < tries.on_gap or tries.controllers >= BEHAVIOURS else ""
    seed = (
        "was fixed beforehand, in a simulation that is to be repeatable, so retries were free: this certifies nothing for a robot"
        if tries.fixed
        else "was drawn from the operating system's entropy after the attempt was paid for, so trying variants beforehand did not help"
    )
    return (
        f"Tries (G4). This is attempt {tries.attempts}, and number {tries.on_gap} of those counted on this gap; they were of {least}"
        f"{tries.controllers} controllers that differ in their behaviour. All attempts share one budget. The seed {v.seed} {seed}."
    )


def of_trials(t: Trials) -> str:
    """The statement G9."""
    number = "their number was fixed beforehand" if t.fixed else "their number counts as fixed without looking at what came of them"
    out = sum(t.left_out.values())
    return (
        f"Trials (G9). Of {t.n} closed-loop runs of this controller on the robot, each scenario drawn from where the one before had ended, "
        f"{t.unsafe or 'none'} were unsafe (the least safety value {worst(t.worst)}); {number}, and {out or 'no'} others were left out. If "
        f"they are independent draws of one law, then with confidence {confidence(t.beta)} a new run is unsafe with probability at most "
        f"{bound(t.unsafe_upper)} (Clopper-Pearson), and with confidence {confidence(t.beta)} its largest discrepancy "
        f"exceeds {bound(t.radius)} with probability at most {bound(t.epsilon)}. These confidences are no part of the budget above; with "
        "the others they add."
    )


def of_runs(r: RunLimits) -> str:
    """The statement G10, as on a certificate."""
    unsafe = "1 was" if r.unsafe == 1 else f"{r.unsafe or 'none'} were"
    censored = (
        f". {r.censored} had an unknown end, and count as unsafe in the upper limit and as safe in the lower one" if r.censored else ""
    )
    return (
        f"Runs (G10). Of {r.n} runs that this controller drove on this robot, {unsafe} unsafe{censored}. With confidence "
        f"{confidence(r.beta_upper)} their mean probability of being unsafe is at most {bound(r.upper)}. With confidence "
        f"{confidence(r.beta_lower)} it is at least {worst(r.lower)}. Each holds after every run at once, whatever the runs depend on. "
        "It is about the runs so far, in the scenarios that they met. These confidences are shares of a budget of their own "
        "(guarantee.beta_episodes)."
    )


def runs_line(r: RunLimits) -> str:
    """The same in one line, for an operator."""
    percent = Decimal(100) * (Decimal(1) - Decimal(r.beta_upper))
    sure = percent.quantize(Decimal(1) if percent < 99 else Decimal("0.1"), rounding=ROUND_FLOOR)
    cut = f", {r.censored} with an unknown end" if r.censored else ""
    where = "on this robot" if not r.certificate else "on this robot under this certificate"
    return (
        f"of the runs this controller drives {where}, at most {_percent(r.upper, ROUND_CEILING)} are unsafe "
        f"({sure} %, as of now, {r.n} {'run' if r.n == 1 else 'runs'}, {r.unsafe or 'none'} unsafe{cut})"
    )


def _percent(share: float, rounding: str) -> str:
    """Two digits."""
    return f"{Context(prec=2, rounding=rounding).create_decimal(Decimal(share) * 100).normalize():f} %"


def of_simulated(s: Simulated) -> tuple[str, str]:
    """The statements G11 and G12."""
    mean, optimism = s.mean, s.optimism
    saved = f"it saved about {mean.runs_saved:.0f} runs" if mean.runs_saved >= 1.0 else "it saved no runs"
    where = f"{s.rollouts} rollouts of the uncertain model in each run's scenario ({s.law}, radius {bound(s.radius)})"
    return (
        (
            f"Mean with simulation (G11). With confidence {confidence(mean.beta)} the mean score '{s.score}' of these {mean.n} runs, in "
            f"{s.low:g} to {s.high:g}, is between {worst(mean.lower)} and {bound(mean.upper)} if each run has the same mean given the "
            f"past, and with that confidence between {worst(mean.running_lower)} and {bound(mean.running_upper)} without that "
            f"assumption; at any number of runs. It is helped by {where}, whose scores have a correlation of {mean.correlation:.2g} with "
            f"the real ones: {saved}."
        ),
        (
            f"Optimism (G12). With confidence {confidence(optimism.beta)}, at any number of runs, the model scores better than the robot "
            f"by at most {bound(optimism.upper)} on average in '{s.score}' ({optimism.mean:.3g} in these runs), if each run has the same "
            "mean given the past."
        ),
    )


def of_enclosure(e: Enclosure) -> str:
    """The second term of G13."""
    how = (
        "The tube is exact, because the model and the controller's feedback are linear"
        if e.method == "linear"
        else (
            f"The tube {STATED}: from any state in the tube, the closed loop steps at most {e.rate:g} times as "
            f"far from the undisturbed run as it was, because {e.because}. States drawn in the tube came to {e.rate_seen:.3g}"
        )
    )
    return (
        f"Enclosure (G13). Of {e.n} scenarios drawn independently, {e.n - e.failed} are enclosed: no disturbance sequence in the gap set "
        f"of radius {e.radius:.6g} makes them unsafe. With confidence {confidence(e.beta)} a new scenario is not enclosed with "
        f"probability at most {bound(e.upper)}. {how}. The tube's reach is at most {bound(e.reach)} m."
    )


def of_inside_runs(r: InsideRuns) -> str:
    """The first term of G13."""
    several = r.controllers > 1 or r.own < r.n
    tested = (
        f"A test of it, at any time at level {r.level:g}, did not refute it (evidence {math.exp(min(r.capital, 30.0)):.3g} of "
        f"{1.0 / r.level:g}); it is not proved."
        if r.own
        else "For this controller nothing here could test it, because it has no run of its own."
    )
    assumed = (
        f" Runs of {r.controllers} controllers count, {r.own or 'none'} of them of this one. That rests on an assumption: the largest "
        f"residual of a run has one distribution, whichever certified controller drives. {tested}"
        if several
        else ""
    )
    refuted = f" Runs of other controllers do not count: their residuals differ, at level {r.level:g}." if r.refuted else ""
    return (
        f"Residuals of runs (G13). Of {r.n} runs, {r.outside or 'none'} left the gap set of radius {r.radius:.6g}, which was fixed "
        f"before them, or had an unknown end. With confidence {confidence(r.beta)}, after every run at once, the mean probability of that "
        f"is at most {bound(r.upper)} for these runs.{assumed}{refuted}"
    )


def of_composition(c: Composition) -> tuple[str, ...]:
    """The statement G13: both terms, and what they come to."""
    if c.runs is None:
        return of_enclosure(c.enclosure), "Composition (G13). No runs are part of it, so nothing is claimed of the robot."
    return (
        of_inside_runs(c.runs),
        of_enclosure(c.enclosure),
        (
            "Composition (G13). A run whose residuals are all in the gap set is a run of the uncertain model. So this controller's runs on "
            f"the robot are unsafe with probability at most {bound(c.upper)} on average, the sum of both limits, with confidence "
            f"{confidence(c.runs.beta + c.enclosure.beta)}. It is about runs whose residuals are distributed as in these runs, in "
            "scenarios drawn from the task's distribution, their starts too. The confidences are shares of a budget of their own "
            "(guarantee.beta_composition)."
        ),
    )


def assumption(driving: Driving) -> str:
    """The words of the profile's mixing assumption, as they stand on the certificate."""
    mixing = "independent" if driving.mixing == 0.0 else f"beta-mixing with a coefficient of at most {driving.mixing:g} a block"
    return (
        f"this drive is stationary, and transitions from different blocks of {driving.block:g} s, one from each, are {mixing}, because "
        f"{driving.because}"
    )


def not_shown(gap: Gap, verification: Verification, horizon: int = 0, *, trials: bool = False, composed: bool = False) -> tuple[str, ...]:
    """What nobody may read into it. horizon: steps of the task (0: not said). trials: whether there were any.
    composed: whether G13 says something of the robot.
    """
    run = ""
    if horizon > 1:
        once = 1.0 - (1.0 - gap.epsilon) ** horizon
        run = f" In a run of {horizon} steps even independent discrepancies may exceed r at least once with probability {bound(once)}."
    required = {law.law for law in verification.laws if law.required}
    alone = (
        ("The law uniform alone stands behind this certificate: no persistent disturbance of this size was required to be survived.",)
        if required == {"uniform"}
        else ()
    )
    apart = " The composed statement (G13) uses neither." if composed else ""
    return (
        *alone,
        (
            "The gap's statement and the controller's do not compose into a statement about the robot with this controller: the first is "
            f"about the robot under the sampling law, the second about the uncertain model.{run}{apart}"
        ),
        (
            "The inputs change when a controller drives: where it applies inputs rho times as often as they were sampled, epsilon becomes "
            "rho epsilon."
        ),
        (
            "The disturbance laws are models. Uniform, zero-mean, independent noise averages out where a real, persistent disturbance does "
            "not: in one and the same ball (r = 0.006) it crashed 0.035 % of runs, a constant lateral push 3.4 %, a push toward the "
            "nearest wall 22 %."
        ),
        (
            "Measured discrepancies are bounded, not true ones: measurement noise is inside r, and an error that the measurements share "
            "with the model is not."
        ),
        (
            "Nothing is said about states outside the region of the profile, other tasks and scenario laws, or a robot that has changed "
            "since the campaign; the watch looks for that while it drives (G5)."
        ),
        (
            "The controller is taken to be a function of the state, the scenario and its parameters: what depends on time, memory, data "
            "files or how many rollouts it is shown at once is not covered."
        ),
        (
            "The trials (G9) are of the robot as it was then, in the scenarios that it met: nothing is said of other starts, or of later."
            if trials
            else "No closed-loop trials of this controller on the robot (G9) are part of it."
        ),
    )


def _gap(robot: str, model: ModelSpec, gap: Gap, assumption: str, period: str) -> tuple[str, ...]:
    effects = "".join(f" + {effect.name}({effect.channel})" for effect in model.effects)
    norm = f"{gap.set}, weights {', '.join(f'{w:g}' for w in gap.weights)}"
    hold = ""
    if gap.hold_periods > 1:
        hold = (
            f", and one after {gap.hold_periods} held periods exceeds r_h = {bound(gap.hold_radius)} with probability at most "
            f"{bound(gap.epsilon)} (r and r_h each took half of beta = {bound(gap.beta)})"
        )
    noise = f"; noise alone would make about {min(gap.radius_noise, gap.radius):.2g} of r" if gap.radius_noise is not None else ""
    basis = f"{ASSUMED}: {assumption}" if assumption else f"were drawn independently, one from each held input (G7), {HELD[period]}"
    whether = "they" if not assumption else "their independence"
    law = "the campaign's law" if not assumption else "the law of that driving"
    return (
        (
            f"Gap (G1). With confidence {confidence(gap.beta)}, a new discrepancy between robot {robot!r} and one step of {model.dt:g} s "
            f"of the model {model.name}{effects}, drawn from {law}, exceeds r = {bound(gap.radius)} ({norm}) with probability "
            f"at most {bound(gap.epsilon)}{hold}."
        ),
        (
            f"It stands on {gap.n} transitions, {gap.discarded or 'none'} of the largest discarded, both numbers fixed beforehand; "
            f"{whether} {basis}. In the unweighted norm r is {bound(gap.radius_literal)}{noise}."
        ),
    )


def _controller(task: str, gap: Gap, v: Verification) -> tuple[str, ...]:
    required = [law for law in v.laws if law.required]
    beside = [law for law in v.laws if not law.required]
    grown = v.radius / gap.radius if gap.radius > 0.0 else math.inf
    times = f", {grown:.3g} times r" if math.isfinite(grown) else ""
    lines = [_law(task, law, v, times) for law in required]
    if v.split > 1:
        lines.append(
            f"Headroom (G5). {worst(v.radius)} is the largest of {v.split} radii, fixed beforehand, at which it was seen to pass; each of "
            f"them had 1/{v.split} of the attempt's beta, so the confidence holds whichever it is. Growth up to it costs nothing."
        )
    if len(required) > 1:
        lines.append(
            f"Each of these {len(required)} values of s* has this confidence on its own; that the failure probability is at most "
            f"{bound(v.epsilon)} under every required law has it as a whole, because all of them had to pass."
        )
    lines += [
        f"Reported, not required: under the law {law.law} the least of {law.n} safety values was {worst(law.s_star)}, with {law.failures} "
        f"below the threshold."
        for law in beside
    ]
    return tuple(lines)


def _law(task: str, law: LawResult, v: Verification, times: str) -> str:
    disturbed = f"disturbed within {bound(v.radius)}{times}"
    if law.law != "uniform":
        disturbed += f", with at most {bound(v.hold_radius)} over a hold"
    return (
        f"Controller (G2, law {law.law}). With confidence {confidence(v.beta)}, a new rollout of the uncertain model ({disturbed}) in a "
        f"new scenario of the task {task} scores below s* = {worst(law.s_star)} with probability at most {bound(v.epsilon)}; {law.n} "
        f"scenarios were drawn independently, {law.failures} scored below the threshold {v.threshold:g}, and the probability of that is at "
        f"most {bound(law.failure_upper)} (Clopper-Pearson, the same confidence)."
    )


_DIGITS = 6


def bound(value: float) -> str:
    """An upper bound, six digits, rounded up."""
    return _digits(value, ROUND_CEILING)


def worst(value: float) -> str:
    """A least value, six digits, rounded down."""
    return _digits(value, ROUND_FLOOR)


def confidence(beta: float) -> str:
    """1 - beta in percent, rounded down."""
    exact = (Decimal(1) - Decimal(beta)) * 100
    return f"{exact.quantize(Decimal('0.0001'), rounding=ROUND_FLOOR)} %"


def _digits(value: float, rounding: str) -> str:
    return f"{Context(prec=_DIGITS, rounding=rounding).create_decimal(Decimal(repr(value))).normalize():g}"
