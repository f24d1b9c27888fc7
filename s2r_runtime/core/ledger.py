"""What a robot's life may still spend, and how many samples a share of it asks for (guarantee G1, G4). Standard library only.

    gap epoch i and verification attempt j each spend  3 beta / (pi^2 i^2)       (either kind sums to beta / 2)
    of an epoch's share r and r_h get half each;  N = the least n with  P(Bin(n, eps) <= k) <= that half

The bounds are those of `bounds`, which uses scipy; the core must not, so they stand here once more as plain sums.
"""

from __future__ import annotations

import hashlib
import math

MAX_SAMPLES = 10**9
"""As in `bounds`: beyond this a campaign is no plan."""


def share(beta: float, number: int) -> float:
    """What the number-th (1, 2, ...) epoch or attempt spends of a life's budget beta."""
    return 3.0 * beta / (math.pi * number) ** 2


def spent(beta: float, epochs: int, attempts: int) -> float:
    """What so many epochs and attempts have spent together."""
    return math.fsum(share(beta, number) for count in (epochs, attempts) for number in range(1, count + 1))


def binomial_tail(n: int, k: int, eps: float) -> float:
    """P(Bin(n, eps) <= k), 0 < eps < 1; each term through its logarithm, so that none overflows."""
    if k >= n:
        return 1.0
    log_p, log_q = math.log(eps), math.log1p(-eps)
    if k == 0:
        return math.exp(n * log_q)
    log_n = math.lgamma(n + 1)
    return math.fsum(math.exp(log_n - math.lgamma(i + 1) - math.lgamma(n - i + 1) + i * log_p + (n - i) * log_q) for i in range(k + 1))


def sample_size(eps: float, beta: float, k: int = 0) -> int:
    """The least n with `binomial_tail(n, k, eps)` <= beta. ValueError beyond 1e9 samples.

    >>> sample_size(0.005, 0.05), sample_size(0.01, 0.05), sample_size(0.03, 0.05)
    (598, 299, 99)
    """
    low, high = k, k + 1  # at low the bound is 1; it falls as n grows
    while binomial_tail(high, k, eps) > beta:
        low, high = high, 2 * high
        if high > MAX_SAMPLES:
            raise ValueError(f"epsilon {eps:g} with beta {beta:g} and {k} discarded asks for more than {MAX_SAMPLES:g} samples")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if binomial_tail(middle, k, eps) <= beta else (middle, high)
    return high


def campaign_size(eps: float, epoch_share: float, k: int) -> int:
    """How many samples a campaign must have at least: its share is halved between r and r_h. ValueError as `sample_size`."""
    return sample_size(eps, 0.5 * epoch_share, k)


def seed(*parts: str | int) -> int:
    """A seed that nobody chose: the first 48 bits of the SHA-256 of what it is for (exact in every JSON reader)."""
    return int.from_bytes(hashlib.sha256("\n".join(map(str, parts)).encode()).digest()[:6], "big")
