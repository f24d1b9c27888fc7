"""Bounded scores of runs: a declared range, which end of it is the better one, and what counts where a value lies outside.

A real score outside its range, or no number, counts as the worst value: nothing may gain by an error of measurement. A simulated one
counts as the best value: a model gains nothing in the comparison of `real_means.optimism` by an error of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from s2r_runtime.errors import UsageError

Array = NDArray[np.float64]


class Score(msgspec.Struct, frozen=True):
    """What a run is scored by. low, high: its declared range, fixed before the runs. better: the end of it that is the good one."""

    name: str
    low: float = 0.0
    high: float = 1.0
    better: Literal["high", "low"] = "high"

    def __post_init__(self) -> None:
        """Raises UsageError for a range that is empty or not finite."""
        if not (np.isfinite(self.low) and np.isfinite(self.high) and self.low < self.high):
            raise UsageError(f"the range of the score {self.name!r} is {self.low:g} to {self.high:g}, must be finite and ascending")

    @property
    def worst(self) -> float:
        """The worst value."""
        return self.low if self.better == "high" else self.high

    @property
    def best(self) -> float:
        """The best value."""
        return self.high if self.better == "high" else self.low

    @property
    def spread(self) -> float:
        """Length of the range, in the score's unit."""
        return self.high - self.low


SAFE = Score("safe")
"""1 for a safe run, 0 for an unsafe one."""


def known_merits(values: Sequence[float | None], score: Score, *, what: str = "run") -> tuple[Array, tuple[str, ...]]:
    """As `merits`; NaN where the value is None, which nobody knows."""
    unknown = np.array([value is None for value in values], dtype=np.bool_)
    merit, lines = merits([score.worst if value is None else value for value in values], score, what=what)
    return np.where(unknown, np.nan, merit), lines


def merits(values: ArrayLike, score: Score, *, simulated: bool = False, what: str = "run") -> tuple[Array, tuple[str, ...]]:
    """Values (...) -> merits in [0, 1], of which 1 is the best; and at most one line about values outside the declared range.

    what: the word for a place along the last axis, which is counted from 1.
    """
    given = np.asarray(values, np.float64)
    outside = ~((given >= score.low) & (given <= score.high))  # no number is outside, too
    counted = np.where(outside, score.best if simulated else score.worst, given)
    merit = (counted - score.low) / score.spread
    merit = merit if score.better == "high" else 1.0 - merit
    if not np.any(outside):
        return merit, ()
    place = tuple(np.argwhere(outside)[0])
    each = f"each counts as the {'best' if simulated else 'worst'} value, {score.best if simulated else score.worst:g}"
    line = (
        f"{int(np.sum(outside))} of {given.size} values of {'the simulated ' if simulated else ''}{score.name!r} are outside the declared "
        f"range {score.low:g} to {score.high:g} (the first: {given[place]:g} in {what} {int(place[-1]) + 1}); {each}"
    )
    return merit, (line,)
