"""What the runtime relies on in a task (hookspecs.Task): a law that depends on the generator only, and a safety metric that judges each
rollout by itself, and no rollout that stands still as a success.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import NominalModel, Scenario, Task
from s2r_runtime.plugins import registry

Array = NDArray[np.float64]

DT = 0.05
STEPS_MOST = 200
"""Of a horizon that are tried."""


class TaskKit:
    """Subclass with `task`, a class. parameters: where the defaults are not enough. models: names of models on which to try it; default:
    all registered ones that it takes. reach: how far a state goes from its start in a rollout of the kit's, SI.
    """

    task: ClassVar[Any]
    parameters: ClassVar[dict[str, Any]] = {}
    models: ClassVar[tuple[str, ...]] = ()
    reach: ClassVar[float] = 0.5

    @pytest.fixture
    def cases(self) -> list[tuple[NominalModel, Task]]:
        """The task on each model that it takes."""
        found, why = [], ""
        for name in self.models or registry().names("models"):
            model = registry().get("models", name)
            try:
                found.append((model, self.task(dict(self.parameters), model, DT)))
            except ConfigError as error:
                why = str(error)
                assert not self.models, f"the task does not take {name}: {why}"
        assert found, f"the task takes none of these models: {why}"
        return found

    # ------------------------------------------------------------ parameters

    def test_parameters_have_defaults_and_are_explained(self) -> None:
        for name, (_, meaning) in self.task.PARAMETERS.items():
            assert meaning, f"{name}: what does it mean?"

    def test_parameters_that_make_no_sense_are_refused(self, cases: list[tuple[NominalModel, Task]]) -> None:
        model, _ = cases[0]
        with pytest.raises(ConfigError, match="no_such_parameter"):
            self.task({**self.parameters, "no_such_parameter": 1.0}, model, DT)
        for name in self.task.PARAMETERS:
            with pytest.raises(ConfigError, match=name):
                self.task({**self.parameters, name: float("nan")}, model, DT)

    def test_horizon_is_a_number_of_steps(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for _, task in cases:
            assert isinstance(task.horizon, int)
            assert task.horizon >= 1

    # ------------------------------------------------------------ the law

    def test_scenarios_are_rows_and_hold_a_start(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for model, task in cases:
            for n in (1, 2, 17):
                scenario = task.draw(np.random.default_rng(1), n)
                self._rows(scenario, n)
                assert scenario["start"].shape == (n, len(model.states))
                assert np.isfinite(scenario["start"]).all()
                self._rows(task.view(scenario), n)

    def test_a_seed_gives_one_set_of_scenarios_and_another_seed_another(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for _, task in cases:
            one, same, other = (task.draw(np.random.default_rng(seed), 8) for seed in (1, 1, 2))
            assert all((one[name] == same[name]).all() for name in one), "randomness must come from rng alone"
            assert any((one[name] != other[name]).any() for name in one), "the law has one scenario only"

    def test_a_scenario_can_begin_where_the_robot_is(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for _, task in cases:
            start = task.draw(np.random.default_rng(3), 1)["start"][0]
            scenario = task.draw_at(np.random.default_rng(4), start)
            self._rows(scenario, 1)
            np.testing.assert_allclose(scenario["start"][0], start)

    def test_a_step_does_not_change_what_it_is_given(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for _, task in cases:
            scenario = task.draw(np.random.default_rng(1), 5)
            before = {name: value.copy() for name, value in scenario.items()}
            after = task.advance(scenario, np.random.default_rng(2))
            assert set(after) == set(before)
            self._rows(after, 5)
            task.view(scenario)
            for name, value in before.items():
                assert (scenario[name] == value).all(), f"{name} was changed in place"

    # ------------------------------------------------------------ the metric

    def test_verdicts_are_one_value_a_rollout(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for _, task, scenarios, states in self._runs(cases, 6):
            tally = task.begin(scenarios[0])
            for scenario, x in zip(scenarios, states, strict=True):
                tally = task.observe(tally, x, scenario)
                clearance = task.clearance(x, scenario)
                assert clearance is None or clearance.shape == (6,)
                assert task.done(tally).shape == (6,)
                assert task.done(tally).dtype == np.bool_
            for values in (task.safety(tally), task.progress(tally)):
                assert values.shape == (6,)
                assert np.isfinite(values).all()

    def test_rollouts_are_judged_each_by_itself(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for _, task, scenarios, states in self._runs(cases, 5):
            together = self._judged(task, scenarios, states)
            for i in range(5):
                alone = self._judged(task, [_row(s, i) for s in scenarios], [x[i : i + 1] for x in states])
                for a, b in zip(alone, together, strict=True):
                    np.testing.assert_allclose(a[0], b[i], rtol=1e-12, atol=1e-12)

    def test_what_is_done_does_not_change_any_more(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for _, task, scenarios, states in self._runs(cases, 30):
            tally = task.begin(scenarios[0])
            done = np.zeros(30, dtype=np.bool_)
            safety = progress = np.zeros(30)
            for scenario, x in zip(scenarios, states, strict=True):
                tally = task.observe(tally, x, scenario)
                assert (task.done(tally) >= done).all(), "a rollout that was done is not any more"
                np.testing.assert_array_equal(task.safety(tally)[done], safety[done])
                np.testing.assert_array_equal(task.progress(tally)[done], progress[done])
                done, safety, progress = task.done(tally), task.safety(tally), task.progress(tally)

    def test_standing_still_is_no_success(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for _, task, scenarios, _ in self._runs(cases, 40, whole=True):
            start = scenarios[0]["start"]
            _, progress = self._judged(task, scenarios, [start] * len(scenarios))
            verdict = task.progress_ok(progress)
            assert isinstance(verdict, bool)
            assert not verdict, "a robot that never moves passes"

    def test_what_is_called_safe_within_a_distance_is_safe_in_all_of_it(self, cases: list[tuple[NominalModel, Task]]) -> None:
        for model, task, scenarios, states in self._runs(cases, 40):
            named: Any = task
            if not hasattr(task, "enclosed"):
                continue
            rng, columns = np.random.default_rng(6), [model.states.index(name) for name in named.position]
            for scenario, x in list(zip(scenarios, states, strict=True))[::10]:
                for within in (0.0, 0.1 * self.reach):
                    found = named.enclosed(x, within, scenario, 0.0)
                    assert found is not None, "it says nothing at the threshold 0"
                    safe, over = found
                    assert (safe.shape, safe.dtype, over.shape, over.dtype) == ((40,), np.bool_, (40,), np.bool_)
                    moved = x + rng.normal(size=x.shape)  # all but the place may be anything
                    way = rng.normal(size=(40, len(columns)))
                    moved[:, columns] = x[:, columns] + 0.999 * within * way / np.linalg.norm(way, axis=1, keepdims=True)
                    tally = task.observe(task.begin(scenario), moved, scenario)
                    assert (task.safety(tally)[safe] >= 0.0).all(), "a state within the distance is not safe"
                    assert task.done(tally)[safe & over].all(), "a run in a state within the distance is not over"

    # ------------------------------------------------------------ how

    def _rows(self, scenario: Scenario, n: int) -> None:
        for name, value in scenario.items():
            assert isinstance(value, np.ndarray), f"{name} is {type(value).__name__}, must be an array"
            assert value.shape[:1] == (n,), f"{name} has shape {value.shape}, must begin with {n}"

    def _runs(
        self, cases: list[tuple[NominalModel, Task]], n: int, *, whole: bool = False
    ) -> Iterator[tuple[NominalModel, Task, list[Scenario], list[Array]]]:
        """Scenarios as they go on, and states that wander from the start."""
        for model, task in cases:
            rng = np.random.default_rng(5)
            steps = task.horizon if whole else min(task.horizon, STEPS_MOST)
            scenarios, states = [task.draw(rng, n)], []
            pace = rng.uniform(-self.reach, self.reach, (n, len(model.states))) / steps
            for k in range(steps):
                states.append(scenarios[0]["start"] + k * pace)
                if k + 1 < steps:
                    scenarios.append(task.advance(scenarios[-1], rng))
            yield model, task, scenarios, states

    def _judged(self, task: Task, scenarios: list[Scenario], states: list[Array]) -> tuple[Array, Array]:
        tally = task.begin(scenarios[0])
        for scenario, x in zip(scenarios, states, strict=True):
            tally = task.observe(tally, x, scenario)
        return task.safety(tally), task.progress(tally)


def _row(scenario: Scenario, i: int) -> Scenario:
    return {name: value[i : i + 1] for name, value in scenario.items()}
