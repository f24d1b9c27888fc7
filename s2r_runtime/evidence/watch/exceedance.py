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

One number a p: memory and work an update are constant. Each is about what was staked last or more, so none vanishes, and at most LARGEST,
by which nothing is lost that an alarm would need.
"""

from __future__ import annotations

import math

GRID = 8
"""Values of p, geometrically between eps and 1; the best of them loses a few per cent of the growth of the best p."""

LARGEST = 1e300
"""What an e-value above it, or beyond all floats, is taken for."""


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
        self._if_exceeds = [q / epsilon for q in p]
        self._if_not = [(1.0 - q) / (1.0 - epsilon) for q in p]
        self._won = [max(0.0, e_value - unstaked(n)) / GRID if e_value is not None else 0.0] * GRID
        self.n, self.exceedances = n, exceedances
        self.e_value = min(LARGEST, unstaked(n) + sum(self._won))
        """E_n, at most LARGEST."""

    def update(self, exceeds: bool) -> float:
        """One more counted discrepancy; gives the e-value after it."""
        self.n += 1
        self.exceedances += exceeds
        staked = stake(self.n) / GRID
        factors = self._if_exceeds if exceeds else self._if_not
        self._won = [(won + staked) * factor for won, factor in zip(self._won, factors, strict=True)]
        won = sum(self._won)
        if won > LARGEST:
            self._won, won = [min(one, LARGEST) for one in self._won], LARGEST
        self.e_value = min(LARGEST, unstaked(self.n) + won)
        return self.e_value
