"""A statement about the real closed loop, composed of two that can be shown (guarantee G13).

A run visits x_0, ..., x_J, one state a step of the task, and the controller answers u_k to x_k. Its residuals are

    d_k = x_{k+1} - f(x_k, u_k),      f the model's step of dt, from rest; angles by the shorter way

whatever caused them: delay, jitter of the clock, a command that was not sent. So a run with |d_k|_W <= R for every k *is* a trajectory of
the uncertain model, for one disturbance sequence in D^J, D = {d : |d|_W <= R}. If it is unsafe, some sequence in D^J makes its
scenario unsafe, so the scenario is not enclosed (`enclosure`). Hence, given everything before run i,

    P(run i unsafe) <= P(some residual of run i is outside D) + P(scenario i is not enclosed)

First term. X_i = 1 if the largest residual of run i is above R, or is not known: the gate closed, the controller failed, the run was
cut, an answer is missing. R was fixed before the runs. `anytime.upper` gives a limit of the mean of P(X_i = 1 | past) over the runs so
far, after every run at once. Second term: N scenarios drawn from the task's distribution, once (Clopper-Pearson). Both confidences add.

Several controllers. The first term may be taken from runs of others under the assumption that *the largest residual of a run has one
distribution, whichever certified controller drives*. Then the runs of all controllers together are exchangeable, if nobody chose who
drives by the residuals seen before. Null hypothesis: that. Statistic: the rank of each run's largest residual among the runs before it,
ties broken at random, is uniform and independent of earlier ranks (V. Vovk, A. Gammerman, G. Shafer, *Algorithmic learning in a random
world*, 2005). Bets on the rank's bin are learned for each controller from its own earlier ranks (the estimator of R. Krichevsky &
V. Trofimov, 1981, is predictable). So the capital is a martingale: it ever reaches 1/level with probability at most `level` (Ville).
Then the assumption is refuted, and a controller's limit takes its own runs alone. Not refuted is not proved. Which of the two sequences
is read depends on the data, so each has half of beta.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.core import anytime
from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.evidence.bounds import clopper_pearson_upper
from s2r_runtime.evidence.uncertain import GapSet
from s2r_runtime.messages import Composition, Enclosure, InsideRuns
from s2r_runtime.models.bound import wrap
from s2r_runtime.models.composed import ComposedModel

Array = NDArray[np.float64]

BINS = 4
"""Of a rank. A distribution that is shifted shows in quarters after some twenty runs of each controller."""
PRIOR = 0.5
"""Ranks that each bin counts for before any is seen."""
RATE_SLACK = 1.0 + 1e-6
"""Of a stated rate, for rounding in drawn states that are near the nominal run."""
LEVEL = 0.05
"""Probability at which the assumption is ever refuted although it holds, at most."""


class DrivenRun(NamedTuple):
    """A run of a certified controller: its digest, and the run's largest residual in the gap set's norm (inf: not known)."""

    controller: str
    residual: float


def largest_residual(
    model: ComposedModel, gap: GapSet, states: Sequence[Sequence[float]], inputs: Sequence[Sequence[float] | None]
) -> float:
    """max_k |x_{k+1} - f(x_k, u_k)|_W of a run. states: (J + 1, nx); inputs: J answers (nu,), None where one is missing: then inf.

    0 for a run without a step. The effects of a model with memory begin at rest, as in a rollout.
    """
    if len(states) != len(inputs) + 1 or any(u is None for u in inputs):
        return math.inf
    if not inputs:
        return 0.0
    x, u = np.array(states, dtype=np.float64), np.array(inputs, dtype=np.float64)
    hidden = model.at_rest(1)
    if any(z.size for z in hidden):
        ahead = np.empty_like(x[1:])
        for k in range(len(u)):
            after, hidden = model.step(x[k : k + 1], u[k : k + 1], hidden)
            ahead[k] = after[0]
    else:
        ahead, _ = model.step(x[:-1], u, model.at_rest(len(u)))
    residual = x[1:] - ahead
    for column in model.angle_columns:
        residual[:, column] = wrap(residual[:, column])
    largest = float(np.max(gap.norm(residual)))
    return largest if math.isfinite(largest) else math.inf


def dependence(runs: Sequence[DrivenRun], seed: int) -> float:
    """Logarithm of the largest capital so far against "the controller does not matter", nats. seed: of the breaking of ties."""
    rng = np.random.default_rng(seed)
    before: list[float] = []
    counts: dict[str, Array] = {}
    capital = most = 0.0
    for run in runs:
        earlier = np.array(before)
        above, equal = int(np.sum(earlier > run.residual)), int(np.sum(earlier == run.residual))
        rank = (above + rng.random() * (equal + 1)) / (len(before) + 1)
        chosen = min(int(BINS * rank), BINS - 1)
        own = counts.setdefault(run.controller, np.full(BINS, PRIOR))
        if before:  # the first rank is the tie's alone
            capital += math.log(BINS * own[chosen] / own.sum())
            most = max(most, capital)
            own[chosen] += 1.0
        before.append(run.residual)
    return most


def inside_runs(
    runs: Sequence[DrivenRun], radius: float, *, beta: float, controller: str = "", seed: int = 0, logs: Sequence[str] = ()
) -> InsideRuns:
    """What these runs, in the order of driving, show of the probability that a run's residuals leave the gap set.

    radius: R, fixed before the runs. beta: one minus the confidence, at all times. controller: the one that the statement is to be about;
    where the assumption is refuted its own runs alone count. Empty: of all controllers' runs, and nothing is assumed.
    Raises NotEnoughEvidence without runs that count.
    """
    if not runs:
        raise NotEnoughEvidence("no run of a certified controller is in these logs, at least one is needed", 1)
    own = sum(run.controller == controller for run in runs)
    capital = dependence(runs, seed)
    refuted = capital >= -math.log(LEVEL)
    counted = [run for run in runs if run.controller == controller or not (refuted and controller)]
    if not counted:
        raise NotEnoughEvidence(
            "the residuals differ between controllers (the assumption that it does not matter who drives is refuted at level "
            f"{LEVEL:g}), and there is no run of this one; drive it",
            1,
        )
    outside = sum(not run.residual <= radius for run in counted)
    known = [run.residual for run in counted if math.isfinite(run.residual)]
    return InsideRuns(
        radius=radius,
        n=len(counted),
        outside=outside,
        upper=inside_limit(len(counted), outside, beta, chosen=bool(controller)),
        beta=beta,
        largest=max(known, default=0.0),
        own=own,
        controllers=len({run.controller for run in counted}),
        capital=capital,
        level=LEVEL,
        refuted=refuted,
        logs=tuple(logs),
    )


def inside_limit(n: int, outside: int, beta: float, *, chosen: bool) -> float:
    """Upper limit of the mean probability that a run has a residual outside. chosen: out of two sequences, which share beta."""
    return anytime.upper(n, outside, beta / 2.0 if chosen else beta)


def enclosure_limit(failed: int, n: int, beta: float) -> float:
    """Upper limit of P(a new scenario is not enclosed), from n drawn independently and once, n fixed beforehand."""
    return float(clopper_pearson_upper(failed, n, beta))


def composed(enclosure: Enclosure, runs: InsideRuns | None) -> Composition:
    """Both terms together. Without runs nothing is claimed of the robot: the limit is 1."""
    upper = 1.0 if runs is None else min(enclosure.upper + runs.upper, 1.0)
    return Composition(enclosure, runs, upper)


def problem(found: Composition) -> str:
    """Why these numbers do not carry their statement, or empty."""
    e, r = found.enclosure, found.runs
    if not (0 <= e.failed <= e.n and e.n >= 1 and 0.0 < e.beta < 1.0 and e.radius > 0.0):
        return "the enclosure's numbers are out of range"
    if not math.isclose(e.upper, enclosure_limit(e.failed, e.n, e.beta), abs_tol=1e-9):
        return "the enclosure's limit does not follow from its counts"
    if e.method == "rate" and not (e.rate > 0.0 and e.because.strip() and e.rate_seen <= e.rate * RATE_SLACK):
        return "the stated rate has no reason, or drawn states refute it"
    if r is None:
        return "" if found.upper == 1.0 else "without runs nothing is claimed of the robot"
    if not (0 <= r.outside <= r.n and r.n >= 1 and r.own >= 0 and 0.0 < r.beta < 1.0 and r.radius == e.radius):
        return "the runs' numbers are out of range, or of another radius"
    if r.refuted != (r.capital >= -math.log(r.level)) or (r.refuted and (r.controllers != 1 or r.n != r.own)):
        return "the assumption on who drives is refuted, and runs of others count"
    if not math.isclose(r.upper, inside_limit(r.n, r.outside, r.beta, chosen=True), abs_tol=1e-9):
        return "the runs' limit does not follow from their counts"
    return "" if math.isclose(found.upper, min(e.upper + r.upper, 1.0), abs_tol=1e-9) else "the limit is not the sum of both"
