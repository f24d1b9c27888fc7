"""Seeds of verifications (guarantee G2). Two domains that never meet:

    drawn()          0 .. 2^48 - 1       of an attempt that was paid for: the operating system's entropy, drawn afterwards
    known(...)       2^48 .. 2^63 - 1    of what costs nothing (`s2r verify`): a function of what is verified, so that it can be repeated

Who knows the seed beforehand can try variants of a controller until one passes in just these scenarios, offline and for nothing. With a
drawn seed each attempt j errs with probability at most beta_j given everything before it, however the controller was chosen. The
union bound over the attempts needs no more.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Iterator

DRAWN_BITS = 48
"""Exact in every JSON reader; two attempts in a life of a thousand share a seed with probability 2e-9."""


def drawn() -> int:
    """The seed of an attempt that is paid for, durably."""
    return secrets.randbits(DRAWN_BITS)


def known(*parts: str | int) -> int:
    """The seed of rollouts that found no certificate."""
    number = int.from_bytes(hashlib.sha256("\n".join(map(str, parts)).encode()).digest()[:8], "big") >> 1
    return number | 1 << DRAWN_BITS


def simulated(seed: int) -> Iterator[int]:
    """Seeds for a simulation that is to be repeatable, one an attempt. Never for a robot: certificates say that they were fixed."""
    for attempt in range(1, 1 << 30):
        yield known("simulated", seed, attempt) % (1 << DRAWN_BITS)
