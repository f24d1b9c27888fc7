"""Means of real scores with the help of a simulator, and how optimistic it is (guarantee G11, G12). Merits in [0, 1], 1 the best.

Y_i: merit of real run i. f_i: the simulator's merit in the same scenario. lambda_i: a slope that is fixed from the earlier pairs alone.
c_i: what the simulator scores on average in such a scenario. With

    X_i = Y_i - lambda_i (f_i - c_i),      E[f_i - c_i | past] = 0      gives      E[X_i | past] = E[Y_i | past]

X is bounded, so it is a score for `betting`. The variance of X is (1 - rho^2) times that of Y at the best slope cov(Y, f) / var(f). A wrong
simulator costs width, never validity. Two ways to know c:

    rollouts    N independent rollouts of new scenarios give limits [a, b] of the mean, with a tenth of beta; the lower limit of Y
                takes min(lambda_i a, lambda_i b) for lambda_i c_i, the upper one the max. All scenarios have one distribution.
    fresh       before run i, M new scenarios that begin where the robot is are rolled out, too; c_i is their mean. Nothing is
                paid for it, and the distribution of scenarios may change from run to run.

What simulation cannot buy. Let U be any upper limit of P(real run unsafe) that is valid at confidence 1-beta for every joint distribution
of real and simulated outcomes. After n pairs that all agree on safe, U >= 1 - beta^(1/n). Proof: let the simulated run be safe always and
the real one unsafe with probability q < 1 - beta^(1/n), independently. All n pairs agree with probability (1-q)^n > beta. If U were below
q then, it would be wrong with a probability above beta. How U is computed does not matter: control variates, conformal prediction and
prediction-powered inference are all subject to it (without a simulator: J. Hanley & A. Lippman-Hand, *If nothing goes wrong, is
everything all right?*, JAMA 1983).

Optimism. D_i = f_i - Y_i in [-1, 1]. delta is a one-sided upper limit of E[D_i | past] by the same bets: "the simulator scores better than
the robot by at most delta". Both null hypotheses state one side for every run: E[. | past] beyond the limit, all i.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.evidence.betting import lower_limit, running_mean_lower_limit
from s2r_runtime.evidence.bounds import check_probability
from s2r_runtime.evidence.scores import Score
from s2r_runtime.messages import Optimism, RealMean

Array = NDArray[np.float64]

ROLLOUT_SHARE = 0.1
"""Of beta, for the limits of the simulator's own mean. Rollouts are cheap, so their interval is narrow all the same."""
PRIOR_SLOPE, PRIOR_PAIRS = 0.5, 4.0
"""The slope before there are pairs, between no simulator and a calibrated forecast, and the number of pairs that it counts for."""
STEEPEST = 1.0
"""Largest slope either way: beyond it the range of X, and with it the loss from one bad pair, grows without a gain."""


class Expected(NamedTuple):
    """What the simulator scores on average in the scenario of each run: limits low, high (..., n) or (..., 1).

    known: the limits hold with certainty (of their own confidence) for E[f | past]. Otherwise low = high is an estimate without bias.
    """

    low: Array
    high: Array
    known: bool


def from_rollouts(rollouts: Array, beta: float) -> Expected:
    """Limits of the simulator's mean from N independent rollouts (..., N), at confidence 1-beta in all."""
    low = lower_limit(rollouts, 0.0, beta / 2.0, 0.0, 1.0)
    high = 1.0 - lower_limit(1.0 - rollouts, 0.0, beta / 2.0, 0.0, 1.0)
    return Expected(low[..., None], high[..., None], known=True)


def from_fresh(means: Array) -> Expected:
    """Mean (..., n) of new rollouts that begin where run i began, drawn as the run's own scenario was."""
    return Expected(means, means, known=False)


def slopes(real: Array, control: Array) -> Array:
    """Predictable slopes (..., n + 1): the i-th is computed from the pairs before i. real, control = f - c: (..., n).

    Least squares with a constant, shrunk to `PRIOR_SLOPE` as if that were worth `PRIOR_PAIRS` pairs, within +-`STEEPEST`.
    """
    n = np.arange(1, real.shape[-1] + 1)
    sum_y, sum_g = np.cumsum(real, axis=-1), np.cumsum(control, axis=-1)
    cov = np.cumsum(real * control, axis=-1) - sum_y * sum_g / n
    var = np.cumsum(control**2, axis=-1) - sum_g**2 / n
    fitted = np.divide(cov, var, out=np.full_like(cov, PRIOR_SLOPE), where=var > 1e-12)
    shrunk = (n * fitted + PRIOR_PAIRS * PRIOR_SLOPE) / (n + PRIOR_PAIRS)
    begin = np.full((*real.shape[:-1], 1), PRIOR_SLOPE)
    return np.asarray(np.clip(np.concatenate([begin, shrunk], axis=-1), -STEEPEST, STEEPEST))


def corrected(real: Array, simulated: Array, expected: Expected, slope: Array) -> tuple[Array, Array]:
    """Scores X (..., n) whose conditional means are at most those of `real`, and the least value that each can have. slope: (..., n).

    Of the merits 1 - real, 1 - simulated and mirrored limits, this is the one for the upper limit.
    """
    centre = np.minimum(slope * expected.low, slope * expected.high)
    low, high = (expected.low, expected.high) if expected.known else (0.0, 1.0)
    least = -np.maximum(slope, 0.0) * (1.0 - low) + np.minimum(slope, 0.0) * high
    return real - slope * simulated + centre, np.broadcast_to(least, real.shape)


def spread(expected: Expected) -> float:
    """Largest length of the range of X_i: that of Y, and the steepest slope times that of f - c."""
    return 1.0 + STEEPEST * (1.0 if expected.known else 2.0)


def limits(real: Array, simulated: Array, expected: Expected, slope: Array, beta: float) -> tuple[Array, Array]:
    """Lower and upper limit of the mean of real merits, (...) each, together at confidence 1-beta and at all times. slope: (..., n)."""
    low = lower_limit(*corrected(real, simulated, expected, slope), beta / 2.0, 0.0, 1.0)
    high = 1.0 - lower_limit(*corrected(1.0 - real, 1.0 - simulated, _mirrored(expected), slope), beta / 2.0, 0.0, 1.0)
    return low, high


def mean_with_simulation(
    real: Array, simulated: Array, *, fresh: Array | None = None, rollouts: Array | None = None, beta: float
) -> RealMean:
    """The mean of real merits (n,) in [0, 1], helped by simulated ones (n,). fresh: (n,); or rollouts: (N,) (`Expected`).

    Raises NotEnoughEvidence without pairs, UsageError for arrays that do not fit.
    """
    check_probability("beta", beta)
    _check(real, simulated)
    n, share = len(real), beta
    if fresh is not None:
        if fresh.shape != real.shape:
            raise UsageError(f"{len(fresh)} means of fresh rollouts for {n} pairs, must be one for each")
        expected = from_fresh(fresh)
    elif rollouts is not None and rollouts.size:
        share = (1.0 - ROLLOUT_SHARE) * beta
        expected = from_rollouts(rollouts, ROLLOUT_SHARE * beta)
    else:
        raise NotEnoughEvidence("no rollouts to know the simulator's mean from, at least one is needed", 1)
    slope = slopes(real, simulated - 0.5 * (expected.low + expected.high))
    low, high = (float(limit) for limit in limits(real, simulated, expected, slope[:-1], share))
    alone = Expected(np.zeros(1), np.zeros(1), known=True)
    alone_low, alone_high = (float(limit) for limit in limits(real, simulated, alone, np.zeros(n), beta))
    running = [
        float(running_mean_lower_limit(*corrected(y, f, e, slope[:-1]), spread(e), share / 2.0))
        for y, f, e in ((real, simulated, expected), (1.0 - real, 1.0 - simulated, _mirrored(expected)))
    ]
    ratio = (alone_high - alone_low) / max(high - low, 1e-12)
    return RealMean(
        n=n,
        mean=float(np.mean(real - slope[:-1] * (simulated - 0.5 * (expected.low + expected.high)))),
        lower=low,
        upper=high,
        running_lower=max(running[0], 0.0),
        running_upper=min(1.0 - running[1], 1.0),
        alone_lower=alone_low,
        alone_upper=alone_high,
        correlation=_correlation(real, simulated),
        slope=float(slope[-1]),
        runs_alone=n * ratio**2,
        runs_saved=n * (ratio**2 - 1.0),
        beta=beta,
    )


def optimism(real: Array, simulated: Array, *, beta: float) -> Optimism:
    """By how much simulated merits (n,) exceed the real ones (n,) on average. Raises as `mean_with_simulation`."""
    check_probability("beta", beta)
    _check(real, simulated)
    d = simulated - real
    return Optimism(
        n=len(d),
        mean=float(np.mean(d)),
        lower=float(lower_limit(d, -1.0, beta, -1.0, 1.0)),
        upper=-float(lower_limit(-d, -1.0, beta, -1.0, 1.0)),
        beta=beta,
    )


def mean_in_unit(mean: RealMean, score: Score) -> RealMean:
    """Limits of merits as limits of the score itself, in its unit."""
    names = ("mean", "lower", "upper", "running_lower", "running_upper", "alone_lower", "alone_upper")
    if score.better == "high":
        return msgspec.structs.replace(mean, **{name: score.low + getattr(mean, name) * score.spread for name in names})
    other = {name: name.replace("lower", "UPPER").replace("upper", "lower").replace("UPPER", "upper") for name in names}
    return msgspec.structs.replace(mean, **{name: score.high - getattr(mean, other[name]) * score.spread for name in names})


def optimism_in_unit(found: Optimism, score: Score) -> Optimism:
    """The same in the score's unit: positive where the simulator is better, whichever end of the range is the good one."""
    return msgspec.structs.replace(found, **{name: getattr(found, name) * score.spread for name in ("mean", "lower", "upper")})


def least_upper_limit(n: int, beta: float) -> float:
    """1 - beta^(1/n): no valid upper limit of P(real run unsafe) is below it after n pairs that agree on safe. 1 for n = 0."""
    check_probability("beta", beta)
    return 1.0 if n == 0 else float(-np.expm1(np.log(beta) / n))


def _mirrored(expected: Expected) -> Expected:
    return Expected(1.0 - expected.high, 1.0 - expected.low, expected.known)


def _check(real: Array, simulated: Array) -> None:
    if real.ndim != 1 or real.shape != simulated.shape:
        raise UsageError(f"{real.shape} real scores and {simulated.shape} simulated ones, must be one of each for each run")
    if len(real) == 0:
        raise NotEnoughEvidence("no pairs of a real and a simulated run, at least one is needed", 1)
    for what, merit in (("real", real), ("simulated", simulated)):
        if not np.all((merit >= 0.0) & (merit <= 1.0)):
            raise UsageError(f"a {what} merit is outside 0 to 1 (scores.merits counts such scores as the worst value)")


def _correlation(real: Array, simulated: Array) -> float:
    if len(real) < 2 or np.ptp(real) == 0.0 or np.ptp(simulated) == 0.0:
        return 0.0
    return float(np.corrcoef(real, simulated)[0, 1])
