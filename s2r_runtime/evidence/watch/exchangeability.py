"""Are the discrepancies of one law, in no particular order? A conformal test martingale in constant memory (guarantee G5).

Discrepancies fall into bins that were fixed beforehand (`core.stream`), so their scores are exchangeable if they are. c_b counts those so
far, the newest included, b its bin, U_n uniform and independent of all else:

    p_n = (sum_{c > b} c_c + U_n c_b) / n

is then uniform on (0, 1) and independent of p_1 ... p_{n-1}, exactly, ties and all (Vovk, Gammerman & Shafer 2005): half or more
of the discrepancies are the same number where a saturated input hides the error. Against it bet the *simple jumper* (Vovk et al. 2021):

    f_e(p) = 1 + e (p - 1/2), e in {-1, 0, 1};      before each bet a share JUMP of the capital is spread evenly over the three

on capital that is staked bit by bit, by the weights T of `exceedance`, so that a long quiet time does not eat up what bets later. The total
is a martingale, so it ever reaches 1/alpha with probability at most alpha. Having done so it stands still: the epoch's driving is not of
one law. That refutes no gap: a controller in another place, or on its way, is reason enough. So its notice revokes nothing.

U_n is the n-th output of SplitMix64 (Steele, Lea & Flood 2014) from a seed that follows from the gap's digest, which is in the log.
"""

from __future__ import annotations

from collections.abc import Sequence

from s2r_runtime.core.stream import BINS
from s2r_runtime.evidence.watch.exceedance import stake, unstaked

JUMP = 0.01
"""Vovk et al.'s; a change is worth betting on for a hundred discrepancies or so."""
_64 = (1 << 64) - 1


def tie_break(seed: int, n: int) -> float:
    """U_n in [0, 1)."""
    z = (seed + n * 0x9E3779B97F4A7C15) & _64
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _64
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _64
    return ((z ^ (z >> 31)) >> 11) * 2.0**-53


class ConformalTest:
    """seed: of the ties. alpha: it stands still once it reaches 1/alpha.

    counts, value: where an earlier one stood (a restart goes on there: what had been won is spread evenly, which keeps the promise).
    Counts of another number of bins are none: it begins anew, and what had been won is given up.
    """

    def __init__(self, seed: int, alpha: float, *, counts: Sequence[int] = (), value: float = 1.0) -> None:
        if not 0.0 < alpha < 1.0:
            raise ValueError(f"alpha is {alpha}, must be between 0 and 1")
        known = len(counts) == BINS
        self.counts = list(counts) if known else [0] * BINS
        self.n = sum(self.counts)
        self._seed, self._bar = seed, 1.0 / alpha
        self.value = value if known else 1.0
        won = max(0.0, self.value - unstaked(self.n)) / 3.0
        self._low = self._even = self._high = won

    def update(self, index: int) -> float:
        """The bin of one more discrepancy; gives the martingale's value."""
        counts = self.counts
        counts[index] += 1
        self.n += 1
        if self.value >= self._bar:
            return self.value
        tie = tie_break(self._seed, self.n)
        bet = (sum(counts[index + 1 :]) + tie * counts[index]) / self.n - 0.5
        new = stake(self.n)
        kept = 1.0 - JUMP
        spread = (JUMP * (self._low + self._even + self._high) + new) / 3.0
        self._low = (kept * self._low + spread) * (1.0 - bet)
        self._even = kept * self._even + spread
        self._high = (kept * self._high + spread) * (1.0 + bet)
        self.value = unstaked(self.n) + self._low + self._even + self._high
        return self.value
