"""How large an effect must be for the model's error to be a given multiple of the oracle's: a search over its size, all else the same.

ratio² = 1 + (c size)²  nearly, for small effects;   size' = size sqrt((aim² - 1) / (ratio² - 1))
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trace_sets.making import Draft, realise
from trace_sets.recording import Recording
from trace_sets.scale import log_uniform
from trace_sets.world import Rollouts

Rng = np.random.Generator

STRONG = 1.5
WEAK = 1.1
"""Ratios of nominal over oracle error from which an effect matters, and from which it is there at all."""

LARGEST_AIM = 60.0
"""Of strong effects; they are spread evenly over the decades up to it."""

STEPS, ROBOTS = 5, 4
NEAR = 0.35
"""Of the aim's logarithm: near enough."""

SIZES = (1e-4, 5.0)


@dataclass(frozen=True)
class Band:
    """Ratios in [low, high) will do; aims are drawn from [first, last]."""

    low: float
    high: float
    first: float
    last: float


MATTERS = Band(STRONG, 1e9, 1.6, LARGEST_AIM)
HARDLY = Band(WEAK, STRONG, 1.13, 1.45)

Found = tuple[Draft, Recording, Rollouts | None]


def sized(rng: Rng, draw: Callable[[int, Rng, float], Draft], band: Band, *, steps: int = STEPS, robots: int = ROBOTS) -> Found:
    """draw(robot's number, rng, size). The first robot on which the band is reached, at the size nearest to an aim; else the last one."""
    aim = log_uniform(rng, band.first, band.last)
    found: Found | None = None
    for number in range(robots):
        sub, size, best = int(rng.integers(2**62)), 1.0, math.inf
        for _ in range(steps):
            again = np.random.default_rng(sub)
            draft = draw(number, again, size)
            recording, errors = realise(again, draft)
            ratio = errors.ratio if errors else 1.0
            off = abs(math.log(ratio / aim))
            if found is None or best == math.inf or (band.low <= ratio < band.high and off < best):
                found = draft, recording, errors
                best = off if band.low <= ratio < band.high else math.inf
            if best < NEAR:
                break
            wanted = math.sqrt((aim**2 - 1.0) / max(ratio**2 - 1.0, 1e-4))
            smaller = min(max(size * min(max(wanted, 0.02), 20.0), SIZES[0]), SIZES[1])
            if smaller == size:
                break
            size = smaller
        if best < math.inf:
            break
    assert found is not None
    return found
