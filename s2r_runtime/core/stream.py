"""What is kept of the stream of discrepancies while controllers drive (guarantee G5). Standard library only; constant memory.

Counts by bin, on a grid that was fixed before the first one came: with q = d / r, r the epoch's own radius,

    bin 0: q = 0        bins 1..16: q in ((i-1)/16, i/16]        then q in (1.25^(j-1), 1.25^j], j = 1..15        last: beyond

A quantile at all times. While driving nothing is independent, so the statement is about what is said of each step given its past. For one
edge x let S of n be above it. If P(d_i > x | past) >= eps at every step, the beta-binomial e-process of `bounds` (here once more without
scipy) reaches 1/alpha with probability at most alpha, ever. The edges for which that holds are all those below some point, and the largest
of them has the fewest above it: so reporting the smallest edge that is refuted errs with probability at most alpha, over all edges and
all times together. It founds nothing; it is what driving shows of itself.
"""

from __future__ import annotations

import math
from bisect import bisect_left

from s2r_runtime.core.ledger import binomial_tail
from s2r_runtime.messages import Measured, Memory, WatchStood

EDGES = (0.0, *(i / 16.0 for i in range(1, 17)), *(1.25**j for j in range(1, 16)))
"""Upper edges in multiples of r. Fine where a good robot's discrepancies lie, coarse up to 28 r, beyond which only `beyond` matters."""
BINS = len(EDGES) + 1
EXACT_TERMS = 30
"""Up to so many exceedances the binomial sum is exact; beyond, one half bounds it from below (its median), at most 0.7 nats of many."""


def bin_of(discrepancy: float, radius: float) -> int:
    """0 to BINS - 1."""
    if discrepancy <= 0.0:
        return 0
    return bisect_left(EDGES, discrepancy / radius) if radius > 0.0 else BINS - 1


def stood(memory: Memory) -> WatchStood:
    """Where the watch of the epoch in force stood when the memory was last changed."""
    return WatchStood(
        memory.watch_n, memory.watch_exceedances, memory.watch_e_value, memory.watch_change, memory.watch_exchange, memory.watch_counts
    )


def after(before: WatchStood, event: Measured, radius: float) -> WatchStood:
    """Where it stands after one more, unless a measurement-fault rule rejected that. radius: the epoch's own."""
    if event.fault:
        return before
    counts = list(before.counts) if len(before.counts) == BINS else [0] * BINS
    counts[bin_of(event.discrepancy, radius)] += 1
    return WatchStood(event.n, event.exceedances, event.e_value, event.change, event.exchange, tuple(counts))


def quantile(counts: tuple[int, ...], radius: float, epsilon: float, alpha: float) -> float | None:
    """The smallest edge that the (1-epsilon)-quantile was not above at every step, with confidence 1-alpha at all times; None: none yet."""
    n, above, found = sum(counts), 0, None
    for index in range(len(EDGES) - 1, -1, -1):
        above += counts[index + 1] if len(counts) == BINS else 0
        if not refuted(above, n, epsilon, alpha):
            break
        found = EDGES[index] * radius
    return found


def quantile_lower(counts: tuple[int, ...], radius: float, epsilon: float, alpha: float) -> float | None:
    """The largest edge that the (1-epsilon)-quantile was above at some step, with confidence 1-alpha at all times; None: none yet.

    The mirror of `quantile`: P(d > x | past) <= epsilon at every step is P(d <= x | past) >= 1-epsilon, which few d <= x refute.
    """
    n, below, found = sum(counts), 0, None
    for edge, count in zip(EDGES, counts, strict=False):
        below += count
        if not refuted(below, n, 1.0 - epsilon, alpha):
            break
        found = edge * radius
    return found


def refuted(exceedances: int, n: int, p: float, alpha: float) -> bool:
    """Whether so few of n refute, at 1/alpha, that an exceedance is always at least as probable as p: `bounds.anytime_evidence`."""
    if n == 0 or exceedances + 1 > (n + 1) * p:
        return False  # as many as p would give, or more
    below = 1.0 - binomial_tail(n + 1, exceedances, p) if exceedances < EXACT_TERMS else 0.5
    log_choose = math.lgamma(n + 1) - math.lgamma(exceedances + 1) - math.lgamma(n - exceedances + 1)
    log_e = math.log(below) - math.log(n + 1) - log_choose - (exceedances + 1) * math.log(p) - (n - exceedances) * math.log1p(-p)
    return log_e >= -math.log(alpha)


def share_above(exceedances: int, n: int, alpha: float) -> float:
    """Upper limit of the probability of an exceedance, at all times at once with confidence 1-alpha: `bounds.anytime_upper`."""
    low, high = (exceedances / n if n else 1.0), 1.0
    for _ in range(40):  # to 1e-12
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        low, high = (low, middle) if refuted(exceedances, n, middle, alpha) else (middle, high)
    return high
