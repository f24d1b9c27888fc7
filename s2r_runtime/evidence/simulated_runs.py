"""Real runs rolled out again on the uncertain model, for means with simulation and the model's optimism (guarantee G11, G12).

Run i began at x_i in the scenario that (seed, index) draws there. It is rolled out M times in that scenario: f_i is the mean score. M more
scenarios are drawn at x_i as that one was, by another seed, and rolled out once each: c_i is their mean. Given the past, the run's
scenario and the fresh ones have one distribution, so E[f_i - c_i | past] = 0, wherever the robot had got to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.controllers.observing import View, whole
from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.evidence.logged_scenarios import LoggedScenario, SimulatedScores
from s2r_runtime.evidence.real_means import mean_in_unit, mean_with_simulation, optimism, optimism_in_unit
from s2r_runtime.evidence.scores import Score, merits
from s2r_runtime.evidence.seen_rows import seen
from s2r_runtime.evidence.uncertain import Control, GapSet, roll_out
from s2r_runtime.hookspecs import Scenario, Task
from s2r_runtime.messages import Simulated
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.modelspec import is_sketch

Array = NDArray[np.float64]


class _Given:
    """A task whose scenarios are drawn already: `draw` gives the next n of them."""

    def __init__(self, task: Task, scenarios: Scenario) -> None:
        self._task, self._scenarios, self._next = task, scenarios, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._task, name)

    def draw(self, rng: np.random.Generator, n: int) -> Scenario:
        """The next n, in order."""
        first, self._next = self._next, self._next + n
        return {name: values[first : self._next] for name, values in self._scenarios.items()}


def roll_out_logged(
    control: Control,
    task: Task,
    model: ComposedModel,
    gap: GapSet,
    law: str,
    scenarios: Sequence[LoggedScenario],
    *,
    score: str,
    threshold: float,
    rollouts: int,
    seed: int,
    progress: Callable[[float, float], None] | None = None,
    view: View = whole,
) -> SimulatedScores:
    """Scores by `score` (`trials.SCORES`) of `rollouts` rollouts of either kind for each run. seed: of fresh scenarios and disturbances.
    view: what the controller is shown.

    Raises UsageError without rollouts or for an unknown score, else as `uncertain.roll_out`.
    """
    if rollouts < 1:
        raise UsageError(f"{rollouts} rollouts for each run, must be at least 1")
    drawn: list[Scenario] = []
    for number, one in enumerate(scenarios):
        x = np.array(one.start)
        drawn += [task.draw_at(np.random.default_rng([one.seed, one.index]), x)] * rollouts
        rng = np.random.default_rng([seed, number])
        drawn += [task.draw_at(rng, x) for _ in range(rollouts)]
    together = {name: np.concatenate([scenario[name] for scenario in drawn]) for name in drawn[0]}
    given: Any = _Given(task, together)
    rng = np.random.default_rng([seed, len(scenarios)])
    found = roll_out(control, given, model, gap, law, rng, len(drawn), progress=progress, view=view)
    values = _scores(score, found.safety, found.progress, threshold).reshape(len(scenarios), 2, rollouts)
    plain = [[[v if np.isfinite(v) else None for v in kind] for kind in run] for run in values.tolist()]
    return SimulatedScores([run[0] for run in plain], [run[1] for run in plain])


def with_real(
    real: Sequence[float], simulated: SimulatedScores, score: Score, *, law: str, radius: float, seed: int, beta: float
) -> tuple[Simulated, tuple[str, ...]]:
    """Mean and optimism of the runs with these real scores, in the score's unit; and lines about scores outside its range.

    Raises NotEnoughEvidence without runs.
    """
    if len(real) == 0:
        raise NotEnoughEvidence("no runs to simulate, at least one is needed", 1)
    y, lines = merits(real, score)
    own, fresh = (np.array(kind, dtype=np.float64).reshape(len(y), -1) for kind in (simulated.own, simulated.fresh))
    f, more = merits(own, score, simulated=True, what="rollout")
    c, most = merits(fresh, score, simulated=True, what="rollout")
    f, c = f.mean(axis=1), c.mean(axis=1)
    return Simulated(
        score=score.name,
        low=score.low,
        high=score.high,
        better=score.better,
        law=law,
        radius=radius,
        rollouts=own.shape[1],
        seed=seed,
        outside=int(np.sum(~((np.asarray(real) >= score.low) & (np.asarray(real) <= score.high)))),
        mean=mean_in_unit(mean_with_simulation(y, f, fresh=c, beta=beta), score),
        optimism=optimism_in_unit(optimism(y, f, beta=beta), score),
    ), (*lines, *more, *most)


def fitted_on_runs(fitted_on: Sequence[str], runs: Sequence[Sequence[tuple[float, ...]]]) -> bool:
    """Whether a model's sketches of fitted rows (`seen_rows`) hold rows of these runs, each (m, nx). ConfigError for a damaged one."""
    states = [np.array(run, dtype=np.float64) for run in runs if run]
    return any(seen(text, states).refused for text in fitted_on if is_sketch(text))


def _scores(name: str, safety: Array, progress: Array, threshold: float) -> Array:
    if name == "safe":
        return np.asarray(safety >= threshold, dtype=np.float64)
    if name in {"safety", "progress"}:
        return np.asarray(safety if name == "safety" else progress, dtype=np.float64)
    raise UsageError(f"the score {name!r} is not known, must be one of: safe, safety, progress")
