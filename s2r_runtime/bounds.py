"""The theorems as pure functions (guarantee G1, G2, G4, G9). No data, no state; every argument is a number.

Scenario bound with discards. N discrepancies drawn independently from one law, k of them discarded, N and k fixed
beforehand, r the (k+1)-th largest, V(r) = P[a new one > r]. Let q = inf {x : P[X > x] <= eps}. Then V(r) > eps iff r < q iff at
most k of the N are >= q, and each of them is so with probability at least eps:

    P[V(r) > eps] <= P(Bin(N, eps) <= k) = sum_{i<=k} C(N, i) eps^i (1-eps)^(N-i) = betainc(N-k, k+1, 1-eps)        (G1)

with equality where the law is continuous; for k = 0 it is (1-eps)^N (paper, theorem 2). The least of N safety values
is the same bound with the sign turned round (G2; paper, corollary 2).

Clopper-Pearson. f failures in n independent runs: the failure probability is at most u with confidence 1-beta, where u solves
P(Bin(n, u) <= f) = beta; so u = betaincinv(f+1, n-f, 1-beta), and 1 if every run failed. The lower limit mirrors it.

Spending (G4). The budget beta of a robot's life is halved, and the i-th of either kind spends 3 beta / (pi^2 i^2):

    sum_{i>=1} 3 beta / (pi^2 i^2) = (3 beta / pi^2) (pi^2 / 6) = beta / 2
"""

from __future__ import annotations

import math

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


def check_probability(name: str, value: float) -> None:
    """Raises UsageError unless 0 < value < 1 (NaN is refused too)."""
    if not 0.0 < value < 1.0:
        raise UsageError(f"{name} is {value}, must be between 0 and 1")


def _check_counts(failures: int, n: int, beta: float) -> None:
    check_probability("beta", beta)
    if not 0 <= failures <= n:
        raise UsageError(f"{failures} failures of {n} runs: must be between 0 and the number of runs")
