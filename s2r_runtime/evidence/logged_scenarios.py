"""Scenarios of logged runs, and the scores of their rollouts, as they go to a worker and come back."""

from __future__ import annotations

import msgspec


class LoggedScenario(msgspec.Struct, frozen=True):
    """What a run's scenario is drawn again from (`controllers.episodes`). start: (nx,), as observed."""

    seed: int
    index: int
    start: tuple[float, ...]


class SimulatedScores(msgspec.Struct, frozen=True):
    """Scores of n runs' rollouts, M each: in the run's own scenario, and in fresh ones from its start. None: no finite value."""

    own: list[list[float | None]]
    fresh: list[list[float | None]]
