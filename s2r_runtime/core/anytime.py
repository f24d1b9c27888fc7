"""Confidence sequences for the mean probability of a failure: limits that hold after every run at once (guarantee G10).

Outcomes X_i in {0, 1}, 1 for a failure. p_i = P(X_i = 1 | runs before i) may depend on everything before run i and may drift. Nothing is
assumed constant or independent. S = X_1 + ... + X_n; the limits are for the mean m_n = (p_1 + ... + p_n) / n of the runs so far.

For a fixed bet l the product of exp(l X_i) / (1 + p_i (e^l - 1)) is a martingale with mean 1: the denominator is E[exp(l X_i) | past].
log(1 + p (e^l - 1)) is concave in p, so by Jensen's inequality the denominators' logarithms sum to at most n log(1 + m_n (e^l - 1)). Hence

    M_n(m_n) = sum_j w_j exp(l_j S - n log(1 + m_n (e^l_j - 1))),     sum_j w_j = 1

is never larger than a mixture of these martingales, for every n. Ville's inequality: P(some n has M_n(m_n) >= 1/alpha) <= alpha. So

    upper(n, S) = the largest m with M_n(m) < 1/alpha, all l_j < 0        M_n grows with m
    lower(n, S) = the least m with M_n(m) < 1/alpha, all l_j > 0          M_n falls as m grows

each hold for all n together with probability 1 - alpha. They need n and S alone, and may be evaluated after every run.

The bet l = -inf stakes everything on no failure: it pays (1 - m)^-n until the first failure, nothing afterwards. With weight 1/2 it gives
upper(n, 0) <= 1 - (alpha/2)^(1/n). Whatever the method, an upper limit that is right for every robot is at least 1 - alpha^(1/n) there:
a failure probability just below that shows n safe runs with probability alpha. At alpha = 5 % the ratio is at most 1.24.

A run whose outcome is unknown (censored) counts as a failure in the upper limit and as none in the lower limit. Both stay valid.

References: J. Ville, *Etude critique de la notion de collectif*, 1939; S. R. Howard, A. Ramdas, J. McAuliffe, J. Sekhon, *Time-uniform,
nonparametric, nonasymptotic confidence sequences*, Annals of Statistics 49, 2021; I. Waudby-Smith, A. Ramdas, *Estimating means of bounded
random variables by betting*, JRSS B 86, 2024. Standard library only, because the core uses it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

BETS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.4, 2.2, 3.2)
"""|l_j| in nats, equal weights. A bet of l is best where the observed odds are e^-l (upper) or e^l (lower) times those of the limit. From
0.05 to 3.2 that covers limits from 5 % to 25 times away; a finer grid gains less than its weights cost."""
ALL_IN = 0.5
"""Weight of the bet l = -inf in the upper limit. More favours robots without a failure, less those with some."""
HALVINGS, MOST_HALVINGS, STEPS = 6, 50, 12
"""Of the interval in which an upper limit is searched, and at most so many steps of Newton's method from its end on the safe side. log M_n
is convex in m, so the method stays on that side, however early it ends. At m = 1 the bet -inf has no finite value: then it is halved on."""
RELATIVE = 1e-10
"""A smaller step is the last one."""


class Counts(NamedTuple):
    """Runs: n in all, of which `unsafe` failed and `censored` have an unknown outcome."""

    n: int = 0
    unsafe: int = 0
    censored: int = 0


class Limits(NamedTuple):
    """Of the mean failure probability of the runs so far: each holds after every run at once, with the confidence it was computed for."""

    lower: float
    upper: float


def limits(counts: Counts, alpha_lower: float, alpha_upper: float) -> Limits:
    """Lower and upper limit at confidence 1 - alpha_lower and 1 - alpha_upper.

    >>> found = limits(Counts(412), 0.05, 0.05)
    >>> found.lower, round(found.upper, 4)
    (0.0, 0.0083)
    """
    return Limits(lower(counts.n, counts.unsafe, alpha_lower), upper(counts.n, counts.unsafe + counts.censored, alpha_upper))


def upper(n: int, failures: int, alpha: float) -> float:
    """Upper limit of the mean failure probability. n = 0: 1, nothing is known. Raises ValueError unless
    0 <= failures <= n and 0 < alpha < 1.
    """
    bar = _bar(n, failures, alpha)
    terms = [(math.log((1.0 - ALL_IN) / len(BETS)) - bet * failures, math.expm1(-bet)) for bet in BETS]
    if failures == 0 < n:
        terms.append((math.log(ALL_IN), -1.0))
    elif _evidence(n, 1.0, terms)[0] < bar:
        return 1.0
    low, high, halvings = failures / n, 1.0, 0
    while halvings < HALVINGS or (failures == 0 and high == 1.0 and halvings < MOST_HALVINGS):
        middle, halvings = 0.5 * (low + high), halvings + 1
        low, high = (low, middle) if _evidence(n, middle, terms)[0] >= bar else (middle, high)
    return high if failures == 0 and high == 1.0 else min(high, _newton(n, high, terms, bar))


def lower(n: int, failures: int, alpha: float) -> float:
    """Lower limit of the mean failure probability. Without a failure: 0. Raises ValueError as `upper`."""
    bar = _bar(n, failures, alpha)
    terms = [(-math.log(len(BETS)) + bet * failures, math.expm1(bet)) for bet in BETS]
    if _evidence(n, 0.0, terms)[0] < bar:
        return 0.0
    return _newton(n, 0.0, terms, bar)


def _newton(n: int, start: float, terms: list[tuple[float, float]], bar: float) -> float:
    """Where log M_n = bar, from a start on the side where it is larger: the result is on that side, too."""
    mean = start
    for _ in range(STEPS):
        value, slope = _evidence(n, mean, terms)
        if value <= bar or slope == 0.0:
            break
        step = (value - bar) / slope
        mean -= step
        if abs(step) <= RELATIVE * abs(mean):
            break
    return mean


def _evidence(n: int, mean: float, terms: list[tuple[float, float]]) -> tuple[float, float]:
    """log M_n(mean), and its derivative. terms: of each bet l, log w + l S and e^l - 1. The mean is below 1 where a bet is -inf."""
    exponents = [constant - n * math.log1p(mean * slope) for constant, slope in terms]
    largest = max(exponents)
    shares = [math.exp(one - largest) for one in exponents]
    total = sum(shares)
    weighted = sum([share * slope / (1.0 + mean * slope) for share, (_, slope) in zip(shares, terms, strict=True)])
    return largest + math.log(total), -n * weighted / total


def _bar(n: int, failures: int, alpha: float) -> float:
    """log(1/alpha)."""
    if not 0 <= failures <= n:
        raise ValueError(f"{failures} failures of {n} runs: must be between 0 and the number of runs")
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"alpha is {alpha}, must be between 0 and 1")
    return -math.log(alpha)
