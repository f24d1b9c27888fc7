"""Is the gap exceeded more often than it may be? (guarantee G5; docs/decisions/0006). No independence is assumed.

X_i = 1 iff the i-th counted discrepancy exceeds the epoch's own r (never a grown one). Null hypothesis: P(X_i = 1 | past) <= eps.
For any p in (eps, 1) and any start k the product

    L_k(p) = prod_{i >= k} (p / eps)^X_i ((1-p) / (1-eps))^(1-X_i)

is a supermartingale under it: each factor's mean grows with P(X_i = 1 | past), and is 1 at eps. The e-value mixes such products, over a
grid of p and over the start k, so that a robot that changes after a long good time is caught about as soon as one bad at once:

    E_n = T(n) + sum_{k <= n} (T(k-1) - T(k)) mean_p L_k(p),      T(n) = 1 / (1 + ln(1 + n))

T(n) is the part not staked yet. E_0 = 1 and the mean of E_n is at most 1, so by Ville's inequality P(sup E_n >= 1/alpha) <= alpha: an
alarm at 1/alpha is false with probability at most alpha, over the whole epoch. A start after n good steps costs ln n + 2 ln ln n nats.
A discrepancy that a measurement-fault rule rejects is no X_i; a rule that rejects only exceedances keeps the null hypothesis true.

One number a p: memory and work an update are constant. Everything in logarithms: no overflow, no NaN.
"""

from __future__ import annotations

import math

GRID = 8
"""Values of p, geometrically between eps and 1; the best of them loses a few per cent of the growth of the best p."""

LARGEST = 1e300
"""What an e-value above it is reported as."""


def grid(epsilon: float) -> list[float]:
    """The values of p, ascending. Raises ValueError if epsilon is no probability."""
    if not 0.0 < epsilon < 1.0:
        raise ValueError(f"epsilon is {epsilon}, must be between 0 and 1")
    return [epsilon ** (1.0 - j / (GRID + 1)) for j in range(1, GRID + 1)]


def unstaked(n: int) -> float:
    """T(n)."""
    return 1.0 / (1.0 + math.log1p(n))


def stake(n: int) -> float:
    """T(n-1) - T(n), without cancellation; n >= 1."""
    return math.log1p(1.0 / n) / ((1.0 + math.log(n)) * (1.0 + math.log1p(n)))


class EProcess:
    """The e-value of the null hypothesis, exceedance by exceedance.

    n, exceedances, e_value: where an earlier one stood (a restart goes on there: what had been won is staked anew, evenly over the
    grid, which keeps every promise above; without the e_value it is given up). Raises ValueError if they can't be.
    """

    def __init__(self, epsilon: float, *, n: int = 0, exceedances: int = 0, e_value: float | None = None) -> None:
        p = grid(epsilon)
        if not 0 <= exceedances <= n:
            raise ValueError(f"{exceedances} exceedances of {n}: must be between 0 and their number")
        self._if_exceeds = [math.log(q / epsilon) for q in p]
        self._if_not = [math.log1p(-q) - math.log1p(-epsilon) for q in p]
        won = max(0.0, e_value - unstaked(n)) if e_value is not None else 0.0
        self._log_won = [math.log(won / GRID) if won > 0.0 else -math.inf] * GRID
        self.n, self.exceedances = n, exceedances

    @property
    def e_value(self) -> float:
        """E_n, at most LARGEST."""
        most = max(self._log_won)
        if most > math.log(LARGEST / GRID):
            return LARGEST
        return unstaked(self.n) + sum(math.exp(log_won) for log_won in self._log_won)

    def update(self, exceeds: bool) -> float:
        """One more counted discrepancy; gives the e-value after it."""
        self.n += 1
        self.exceedances += exceeds
        staked = math.log(stake(self.n) / GRID)
        growth = self._if_exceeds if exceeds else self._if_not
        self._log_won = [_log_add(won, staked) + g for won, g in zip(self._log_won, growth, strict=True)]
        return self.e_value


def _log_add(a: float, b: float) -> float:
    """log(exp(a) + exp(b)); b is finite."""
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high))
