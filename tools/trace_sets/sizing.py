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

SIZES, LOUD = (1e-4, 5.0), (1e-3, 100.0)
FIRST = 3
"""Steps in which the effect's size is tried, before the noise is turned."""


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
Draw = Callable[[int, Rng, float, float], Draft]
"""(robot's number, rng, size of the effect, loudness of the noise) -> draft."""


def sized(rng: Rng, draw: Draw, band: Band, *, steps: int = STEPS, robots: int = ROBOTS) -> Found:
    """The first robot on which the band is reached, as near to an aim as it gets; else the last one."""
    aim = log_uniform(rng, band.first, band.last)
    by_noise = rng.random() < 0.5
    found: Found | None = None
    for number in range(robots):
        sub, size, loud, best = int(rng.integers(2**62)), 1.0, 1.0, math.inf
        for step in range(steps):
            again = np.random.default_rng(sub)
            draft = draw(number, again, size, loud)
            recording, errors = realise(again, draft)
            ratio = errors.ratio if errors else 1.0
            off = abs(math.log(ratio / aim))
            if found is None or best == math.inf or (band.low <= ratio < band.high and off < best):
                found = draft, recording, errors
                best = off if band.low <= ratio < band.high else math.inf
            if best < NEAR:
                break
            wanted = min(max(math.sqrt((aim**2 - 1.0) / max(ratio**2 - 1.0, 1e-4)), 0.02), 20.0)
            if by_noise or step >= FIRST:
                loud = min(max(loud / wanted, LOUD[0]), LOUD[1])
            else:
                size = min(max(size * wanted, SIZES[0]), SIZES[1])
        if best < math.inf:
            break
    assert found is not None
    return found
