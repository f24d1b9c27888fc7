"""The theorems as pure functions (guarantee G1, G2, G4, G5, G9). No data, no state; every argument is a number.

Scenario bound with discards. N discrepancies drawn independently from one law, k of them discarded, N and k fixed
beforehand, r the (k+1)-th largest, V(r) = P[a new one > r]. Let q = inf {x : P[X > x] <= eps}. Then V(r) > eps iff r < q iff at
most k of the N are >= q, and each of them is so with probability at least eps:

    P[V(r) > eps] <= P(Bin(N, eps) <= k) = sum_{i<=k} C(N, i) eps^i (1-eps)^(N-i) = betainc(N-k, k+1, 1-eps)        (G1)

with equality where the law is continuous; for k = 0 it is (1-eps)^N (paper, theorem 2). For other k these are Wilks' tolerance limits
(1941), and the scenario approach with k discarded constraints for one decision variable, where its factor C(k+d-1, k) is 1 (Campi & Garatti
2011). The least of N safety values is the same bound with the sign turned round (G2; paper, corollary 2).

Clopper-Pearson (1934). f failures in n independent runs: the failure probability is at most u with confidence 1-beta, where u solves
P(Bin(n, u) <= f) = beta; so u = betaincinv(f+1, n-f, 1-beta), and 1 if every run failed. The lower limit mirrors it.

Spending (G4). The budget beta of a robot's life is halved, and the i-th of either kind spends 3 beta / (pi^2 i^2):

    sum_{i>=1} 3 beta / (pi^2 i^2) = (3 beta / pi^2) (pi^2 / 6) = beta / 2

Splitting. Statements that are all to hold share their beta (union bound): r and r_h half each. Disturbance laws of one attempt need no
split: a false pass needs every required law to pass wrongly, so it is no more likely than with one law (intersection-union; Berger 1982).
Controllers and radii need none beyond the attempts that they are.

At all times. S_n of n indicators are 1 and P(X_i = 1 | past) >= p for every i. For any t < p the likelihood ratio of t against p is then a
supermartingale; mixed over t, uniform on (0, p), it is the beta-binomial e-process (Robbins 1970; Howard & Ramdas 2022, one-sided)

    E_n(p) = (1/p) int_0^p (t/p)^S ((1-t)/(1-p))^(n-S) dt = betainc(S+1, n-S+1, p) / ((n+1) C(n, S) p^(S+1) (1-p)^(n-S))

and P(sup_n E_n >= 1/beta) <= beta (Ville). It grows with p and falls with S. So the largest p with E_n(p) < 1/beta bounds an exceedance
probability from above at all times at once, and the (k+1)-th largest of n draws, k the largest S with E_n(eps) >= 1/beta, is not below the
(1-eps)-quantile of their law: at any n, however often one looks. Not so with `scenario_confidence`, which holds for an n fixed beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from s2r_runtime.errors import UsageError

MAX_SAMPLES = 10**9
"""Beyond this a campaign is no plan, and the bisection would go on for nothing."""


def scenario_confidence(n: int, k: int, eps: float) -> float:
    """P(Bin(n, eps) <= k): how likely at most k of n samples exceed what they should. 1 if k >= n. UsageError out of range."""
    check_probability("epsilon", eps)
    if n < 0 or k < 0:
        raise UsageError(f"n is {n} and k is {k}, must both be >= 0")
    if k >= n:
        return 1.0
    if k == 0:
        return math.exp(n * math.log1p(-eps))
    from scipy.special import betainc

    return float(betainc(n - k, k + 1, 1.0 - eps))


def sample_size(eps: float, beta: float, k: int = 0) -> int:
    """The smallest n with `scenario_confidence(n, k, eps)` <= beta. UsageError out of range or beyond 1e9 samples.

    >>> sample_size(0.005, 0.05), sample_size(0.01, 0.05), sample_size(0.03, 0.05)
    (598, 299, 99)
    """
    check_probability("epsilon", eps)
    check_probability("beta", beta)
    if k < 0:
        raise UsageError(f"discard is {k}, must be >= 0")
    low, high = k, k + 1  # at low the bound is 1; it falls as n grows
    while scenario_confidence(high, k, eps) > beta:
        low, high = high, 2 * high
        if high > MAX_SAMPLES:
            raise UsageError(f"epsilon {eps:g} with beta {beta:g} and {k} discarded asks for more than {MAX_SAMPLES:g} samples")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if scenario_confidence(middle, k, eps) <= beta else (middle, high)
    return high


def epoch_beta(beta: float, i: int) -> float:
    """What gap epoch i (1, 2, ...) spends of a life's budget beta; r and r_h share it. All epochs together: beta / 2."""
    check_probability("beta", beta)
    if i < 1:
        raise UsageError(f"the count starts at 1, not at {i}")
    return 3.0 * beta / (math.pi * i) ** 2


def attempt_beta(beta: float, j: int) -> float:
    """What verification attempt j (1, 2, ...) spends, passed or not. All attempts together: beta / 2."""
    return epoch_beta(beta, j)


def clopper_pearson_upper(failures: int, n: int, beta: float) -> float:
    """Upper limit of a failure probability, at confidence 1-beta (one-sided, exact). n = 0: 1, nothing is known."""
    _check_counts(failures, n, beta)
    if failures == n:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(failures + 1, n - failures, 1.0 - beta))


def clopper_pearson_lower(failures: int, n: int, beta: float) -> float:
    """Lower limit of a failure probability, at confidence 1-beta (one-sided, exact). n = 0: 0."""
    _check_counts(failures, n, beta)
    if failures == 0:
        return 0.0
    from scipy.special import betaincinv

    return float(betaincinv(failures, n - failures + 1, beta))


def split(beta: float, weights: Sequence[float]) -> tuple[float, ...]:
    """Shares of beta for statements that are all to hold, in proportion to `weights`; together they are no more than beta.

    >>> split(0.05, (1, 1))
    (0.025, 0.025)
    """
    check_probability("beta", beta)
    total = math.fsum(weights)
    if not weights or not all(0.0 < weight < math.inf for weight in weights):
        raise UsageError(f"weights are {list(weights)}, must be at least one number > 0")
    return tuple(beta * (weight / total) for weight in weights)


def anytime_evidence(exceedances: int, n: int, p: float) -> float:
    """log E_n(p): evidence that an exceedance is not always at least as probable as p, after so many of n; -inf where it underflows."""
    check_probability("p", p)
    _check_counts(exceedances, n, p)
    from scipy.special import betainc, betaln

    below = float(betainc(exceedances + 1, n - exceedances + 1, p))
    if below == 0.0:
        return -math.inf
    log_beta = float(betaln(exceedances + 1, n - exceedances + 1))  # 1 / ((n+1) C(n, S))
    return math.log(below) + log_beta - (exceedances + 1) * math.log(p) - (n - exceedances) * math.log1p(-p)


def anytime_upper(exceedances: int, n: int, beta: float) -> float:
    """Upper limit of an exceedance probability that holds at every n at once, with confidence 1-beta. n = 0: 1, nothing is known."""
    _check_counts(exceedances, n, beta)
    if exceedances == n:
        return 1.0
    low, high, bar = exceedances / n, 1.0, -math.log(beta)  # E is at most 1 at the observed share, and grows from there
    for _ in range(60):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        low, high = (low, middle) if anytime_evidence(exceedances, n, middle) >= bar else (middle, high)
    return high


def anytime_discards(n: int, eps: float, beta: float) -> int:
    """k: the (k+1)-th largest of n draws bounds the (1-eps)-quantile at every n at once, with confidence 1-beta; -1: none does yet."""
    check_probability("epsilon", eps)
    _check_counts(0, n, beta)
    bar = -math.log(beta)
    low, high = -1, n  # at n there is no evidence
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if anytime_evidence(middle, n, eps) >= bar else (low, middle)
    return low


def anytime_sample_size(eps: float, beta: float) -> int:
    """The smallest n at which `anytime_discards` gives a bound. UsageError out of range or beyond 1e9 samples.

    >>> anytime_sample_size(0.01, 0.05)
    449
    """
    low, high = 0, 1
    while anytime_discards(high, eps, beta) < 0:
        low, high = high, 2 * high
        if high > MAX_SAMPLES:
            raise UsageError(f"epsilon {eps:g} with beta {beta:g} asks for more than {MAX_SAMPLES:g} samples")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if anytime_discards(middle, eps, beta) >= 0 else (middle, high)
    return high


def check_probability(name: str, value: float) -> None:
    """Raises UsageError unless 0 < value < 1 (NaN is refused too)."""
    if not 0.0 < value < 1.0:
        raise UsageError(f"{name} is {value}, must be between 0 and 1")


def _check_counts(failures: int, n: int, beta: float) -> None:
    check_probability("beta", beta)
    if not 0 <= failures <= n:
        raise UsageError(f"{failures} failures of {n} runs: must be between 0 and the number of runs")
