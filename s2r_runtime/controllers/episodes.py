"""Scenario after scenario of a task for a robot that drives: the k-th step of a scenario is the k-th observation in it.

A scenario is drawn around the robot (`Task.draw_at`), moves one step an observation, and ends at its horizon or when its
outcome is settled; the next is drawn from where the robot then is. The same order as in verification: look at the state,
let the controller see the scenario, step. Scenario i draws from the seed (seed, i), so each can be repeated on its own.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Self

import msgspec

from s2r_runtime.hookspecs import Scenario, Task
from s2r_runtime.messages import EpisodeEnded, EpisodeScored, Scenarios

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class Episode(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a scenario stands after `k` steps. safety, progress, clearance: the task's; None where it has no finite value."""

    index: int
    k: int
    safety: float | None = None
    progress: float | None = None
    clearance: float | None = None
    done: bool = False


class Episodes:
    """`look` at one state after the other. count: how many scenarios (0: no end). first: number of the first one."""

    def __init__(self, task: Task, seed: int, count: int = 0, first: int = 0) -> None:
        self._task, self._seed, self._end = task, seed, first + count if count else 0
        self._index, self._k, self._begun = first - 1, 0, False
        self._scenario: Scenario = {}
        self._tally: Any = None

    @classmethod
    def of(cls, task: Task, scenarios: Scenarios) -> Self:
        """These scenarios of the task."""
        return cls(task, scenarios.seed, scenarios.count, scenarios.first)

    def look(self, x: Array) -> tuple[Scenario | None, Episode, Episode | None]:
        """Takes the next state (nx,). Returns what the controller may see of the scenario (None: all scenarios are over),
        where the scenario stands, and how the one before ended, if it did with this state.
        """
        ended = None
        if not self._begun:
            self._begin(x)
        else:
            self._k += 1
            self._scenario = self._task.advance(self._scenario, self._rng)
            self._tally = self._task.observe(self._tally, x[None, :], self._scenario)
            if self._k >= self._task.horizon or bool(self._task.done(self._tally)[0]):
                ended = self._status(x, done=True)
                if self._index + 1 == self._end:
                    return None, ended, ended
                self._begin(x)
        return self._task.view(self._scenario), self._status(x, done=False), ended

    def _begin(self, x: Array) -> None:
        import numpy as np  # here, because the daemon's process reads this module for `Episode` and does without numpy

        self._index += 1
        self._k, self._begun = 0, True
        self._rng = np.random.default_rng([self._seed, self._index])
        self._scenario = self._task.draw_at(self._rng, x)
        self._tally = self._task.observe(self._task.begin(self._scenario), x[None, :], self._scenario)

    def _status(self, x: Array, *, done: bool) -> Episode:
        clearance = self._task.clearance(x[None, :], self._scenario)
        return Episode(
            self._index,
            self._k,
            _finite(self._task.safety(self._tally)),
            _finite(self._task.progress(self._tally)),
            None if clearance is None else _finite(clearance),
            done,
        )


def _finite(values: Array) -> float | None:
    value = float(values[0])
    return value if math.isfinite(value) else None


# ---------------------------------------------------------------- what is reported of them


def end_report(t_ns: int, ended: Episode) -> EpisodeEnded:
    """Report of a scenario that came to its end."""
    missing = ", ".join(f"no {name}" for name, value in (("safety", ended.safety), ("progress", ended.progress)) if value is None)
    return EpisodeEnded(t_ns, ended.index, ended.k, ended.safety or 0.0, ended.progress or 0.0, missing)


def score_report(t_ns: int, now: Episode, before: tuple[int, bool], threshold: float) -> tuple[tuple[int, bool], EpisodeScored | None]:
    """Report of a scenario whose safety value crosses the threshold; None where it does not.

    before: index of the scenario that was scored last, and whether it was below. Also returns the same for this one.
    """
    below = now.safety is None or now.safety < threshold
    after = (now.index, below)
    if below == (before[0] == now.index and before[1]):
        return after, None
    return after, EpisodeScored(t_ns, now.index, now.k, now.safety or 0.0, below, "no safety" if now.safety is None else "")
