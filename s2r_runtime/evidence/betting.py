"""Confidence sequences for means of bounded scores, by betting. Arrays (..., n): the last axis is the run, in the order of driving.

Capital. X_i >= a_i, where a_i and the bets are fixed before run i. For m > a_i and bets 0 <= t_j <= 1 with weights w_j that sum to 1

    K_n(m) = sum_j w_j prod_{i<=n} (1 + t_j (X_i - m) / (m - a_i))

No factor is negative. Null hypothesis H(m): E[X_i | past] <= m for every i. Under H(m) each product is a supermartingale that begins at 1,
and so is their mixture; so P(sup_n K_n(m) >= 1/beta) <= beta (Ville). Every factor falls with m: (X - m) / (m - a) has the derivative
-(X - a) / (m - a)^2. So the rejected m form an interval, and its upper end L satisfies: with probability at least 1-beta, H(L') is
rejected for no L' that is true, however often one looks. Where E[X_i | past] is one number, L is a lower limit of it at all times at once.
The upper limit is the same of 1 - X (I. Waudby-Smith & A. Ramdas, *Estimating means of bounded random variables by betting*, JRSS-B 2024;
mixture over constant bets: T. Cover, *Universal portfolios*, 1991).

Running mean. Without one number for all runs, the same X bound the mean of E[X_i | past] so far. Let h_i be any forecast that is fixed
before run i, X_i - h_i >= -s, and psi(u) = -log(1-u) - u. For 0 <= u < 1 (X. Fan, I. Grama & Q. Liu 2015; S. Howard, A. Ramdas,
J. McAuliffe & J. Sekhon, *Time-uniform, nonparametric, nonasymptotic confidence sequences*, Ann. Stat. 2021, theorem 4)

    exp(u sum_i (X_i - E[X_i | past]) / s - psi(u) sum_i ((X_i - h_i) / s)^2)

is a supermartingale, and so is a mixture over u. It bounds sum_i (X_i - E[X_i | past]) from above at all times at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import UsageError
from s2r_runtime.evidence.bounds import check_probability

Array = NDArray[np.float64]


class Bets(NamedTuple):
    """Constant bets t (k,), shares of the largest possible one, and their weights (k,), which sum to 1."""

    t: Array
    weights: Array


def _mean_bets() -> Bets:
    """Nobody knows the width that will be of interest: bets in equal ratios from 0.0005 to 0.95, and more of them near the largest one.

    Large bets are right for scores of small variance, as after a good correction. The largest possible one is lost with the first run that
    disagrees. It gives the best bound where none does, as for rare failures.
    """
    large = np.array([0.45, 0.6, 0.75, 0.85])
    t = np.concatenate([np.geomspace(0.0005, 0.95, 20), large, [1.0]])
    return Bets(t, np.concatenate([np.full(20, 0.75 / 20), np.full(4, 0.15 / 4), [0.1]]))


def _comparison_bets() -> Bets:
    """Differences between controllers that are worth a comparison: log-normal around 0.4, and a fifth in equal ratios from 0.001 on.

    Two success rates p and q on unrelated scenarios call for t = (q - p) / (p + q - 2 p q): 0.4 for .5 and .7, 0.38 for .8 and .9.
    """
    t = np.geomspace(0.001, 0.95, 35)
    peak = np.exp(-0.5 * (np.log(t / 0.4) / 0.4) ** 2)
    return Bets(t, 0.8 * peak / peak.sum() + 0.2 / len(t))


MEAN_BETS, COMPARISON_BETS = _mean_bets(), _comparison_bets()
RATES = Bets(np.geomspace(0.0005, 0.9, 25), np.full(25, 1.0 / 25))
"""The rates u of the running mean, and their weights."""
HALVINGS = 40
"""Of an interval of means: its end is then known to 1e-12 of the range."""


def log_capital(x: Array, least: Array | float, mean: Array | float, bets: Bets = MEAN_BETS) -> Array:
    """Logarithm of the capital against "E[X_i | past] <= mean for every i" after each run, (..., n), in nats.

    x: (..., n) with x >= least. mean: a number, or (..., 1); must be above `least`. Raises UsageError if it is not.
    """
    x, least, mean = np.asarray(x, np.float64), np.asarray(least, np.float64), np.asarray(mean, np.float64)
    if not np.all(mean > least):
        raise UsageError("the mean under the null hypothesis must be above the least possible score")
    gain = (x - mean) / (mean - least)
    total = np.full(np.broadcast_shapes(x.shape, gain.shape), -np.inf)
    with np.errstate(divide="ignore"):  # a bet of everything that is lost: the logarithm of no capital
        for t, weight in zip(bets.t, bets.weights, strict=True):
            total = np.logaddexp(total, np.cumsum(np.log1p(np.maximum(t * gain, -1.0)), axis=-1) + np.log(weight))
    return total


def lower_limit(x: Array, least: Array | float, beta: float, low: float, high: float, bets: Bets = MEAN_BETS) -> Array:
    """Lower limit of the mean of x (..., n) at confidence 1-beta and at all times: (...). low, high: range of the mean.

    The capital against each mean below the limit is at least 1/beta after these runs. What it was before does not count, although it might:
    where the mean changed, such limits from before and after would contradict each other. Constant `least`: never above the runs' mean.
    `low` where there are no runs. least: at most `low`. Raises UsageError out of range.
    """
    check_probability("beta", beta)
    x = np.asarray(x, np.float64)
    rejected, accepted = np.full((*x.shape[:-1], 1), float(low)), np.full((*x.shape[:-1], 1), float(high))
    if x.shape[-1] == 0:
        return rejected[..., 0]
    for _ in range(HALVINGS):
        middle = 0.5 * (rejected + accepted)
        refuted = log_capital(x, least, middle, bets)[..., -1:] >= -np.log(beta)
        rejected, accepted = np.where(refuted, middle, rejected), np.where(refuted, accepted, middle)
    return rejected[..., 0]


def running_log_capital(deviation: Array, variation: Array) -> Array:
    """Logarithm of the mixture over `RATES`, (...), in nats. deviation: sum of X_i - E[X_i | past], variation: sum of (X_i - h_i)^2, (...),
    in units of s and s^2.
    """
    total = np.full(np.broadcast_shapes(deviation.shape, variation.shape), -np.inf)
    for u, weight in zip(RATES.t, RATES.weights, strict=True):
        total = np.logaddexp(total, u * deviation - (-np.log1p(-u) - u) * variation + np.log(weight))
    return total


def variations(x: Array, least: Array, spread: float) -> Array:
    """Sums of ((X_i - h_i) / s)^2 after each run, (..., n). h: the mean of the earlier positions in the range, begun at its middle."""
    position = (x - least) / spread
    earlier = np.cumsum(position, axis=-1) - position
    forecast = (0.5 + earlier) / np.arange(1, x.shape[-1] + 1)
    return np.cumsum((position - forecast) ** 2, axis=-1)


def running_mean_lower_limit(x: Array, least: Array, spread: float, beta: float) -> Array:
    """Lower limit of the mean of E[X_i | past] over the runs so far, (...); no constancy is assumed. -inf where there are no runs.

    x: (..., n) within [least, least + spread], where `least` (..., n) is fixed before each run. Raises UsageError out of range.
    """
    check_probability("beta", beta)
    x, n = np.asarray(x, np.float64), x.shape[-1]
    if n == 0:
        return np.full(x.shape[:-1], -np.inf)
    variation = variations(x, least, spread)[..., -1]
    low, high = np.zeros(x.shape[:-1]), np.full(x.shape[:-1], n + (np.log(len(RATES.t) / beta) + n) / RATES.t[0])
    for _ in range(2 * HALVINGS):
        middle = 0.5 * (low + high)
        beyond = running_log_capital(middle, variation) >= -np.log(beta)
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return np.asarray(np.mean(x, axis=-1) - spread * high / n)
