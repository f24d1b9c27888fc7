"""The kits for models and tasks pass the built-in ones, and fail what breaks the contract in the test that is about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.unicycle import Unicycle
from s2r_runtime.plugins import registry
from s2r_runtime.tasks.keep_out import KeepOut, Tally
from s2r_runtime.testing import ModelKit, TaskKit
from s2r_runtime.testing.builtin_kits import StlKit


class TestUnicycle(ModelKit):
    model = registry().get("models", "unicycle")


class TestDifferentialDrive(ModelKit):
    model = registry().get("models", "differential_drive")


class TestBicycle(ModelKit):
    model = registry().get("models", "bicycle")


class TestJoint(ModelKit):
    model = registry().get("models", "joint")


class TestDoubleIntegrator(ModelKit):
    model = registry().get("models", "double_integrator")


class TestGridWorld(TaskKit):
    task = registry().get("tasks", "grid_world")


class TestKeepOut(TaskKit):
    task = KeepOut


class TestStl(StlKit):
    pass


# ---------------------------------------------------------------- models that break it


class Mixes(Unicycle):
    def step(self, x: Any, u: Any, dt: float, parameters: dict[str, float]) -> Any:
        return super().step(x - 0.01 * x.mean(axis=0), u, dt, parameters)


class InPlace(Unicycle):
    def step(self, x: Any, u: Any, dt: float, parameters: dict[str, float]) -> Any:
        x += super().step(x, u, dt, parameters) - x
        return x.copy()


class Remembers(Unicycle):
    last = 0.0

    def step(self, x: Any, u: Any, dt: float, parameters: dict[str, float]) -> Any:
        after = super().step(x, u, dt, parameters) + 1e-3 * self.last
        self.last = float(u.sum())
        return after


class CountsTurns(Unicycle):
    def step(self, x: Any, u: Any, dt: float, parameters: dict[str, float]) -> Any:
        after = super().step(x, u, dt, parameters)
        after[:, 0] += 1e-3 * x[:, 2]
        return after


class Jumps(Unicycle):
    def step(self, x: Any, u: Any, dt: float, parameters: dict[str, float]) -> Any:
        return super().step(x, u, dt, parameters) + 0.1


class Single(Unicycle):
    def step(self, x: Any, u: Any, dt: float, parameters: dict[str, float]) -> Any:
        return super().step(x, u, dt, parameters).astype(np.float32)


class TwoNames(Unicycle):
    inputs = ("v", "x")


class NoState(Unicycle):
    angles = ("psi",)


class WholeNumber(Unicycle):
    parameters = {"mass": 2}  # type: ignore[dict-item]


class StrangeUnits(Unicycle):
    units = {"z": "m"}


MODELS = {
    Mixes: "test_rows_do_not_mix",
    InPlace: "test_arguments_are_not_changed",
    Remembers: "test_same_arguments_give_the_same_step",
    CountsTurns: "test_a_full_turn_more_of_an_angle_is_the_same_robot",
    Jumps: "test_a_shorter_step_goes_less_far",
    Single: "test_step_gives_one_finite_row_for_each",
    TwoNames: "test_names_are_text_and_differ",
    NoState: "test_angles_are_states",
    WholeNumber: "test_parameters_have_finite_defaults",
    StrangeUnits: "test_what_it_may_also_say_is_about_its_own_columns",
}


@pytest.mark.parametrize(("broken", "test"), MODELS.items(), ids=[b.__name__ for b in MODELS])
def test_model_kit_fails_a_model_that_breaks_the_contract(broken: type[Unicycle], test: str, tmp_path: Path) -> None:
    kit = type("Kit", (ModelKit,), {"model": broken()})()
    with pytest.raises(AssertionError):
        getattr(kit, test)()


# ---------------------------------------------------------------- tasks that break it


class OwnDice(KeepOut):
    def draw(self, rng: np.random.Generator, n: int) -> Any:
        return super().draw(np.random.default_rng(), n)


class OneScenario(KeepOut):
    def draw(self, rng: np.random.Generator, n: int) -> Any:
        return super().draw(np.random.default_rng(1), n)


class Elsewhere(KeepOut):
    def draw_at(self, rng: np.random.Generator, x: Any) -> Any:
        return super().draw(rng, 1)


class Moves(KeepOut):
    def advance(self, scenario: Any, rng: np.random.Generator) -> Any:
        scenario["step"] += 1
        return scenario


class WorstOfAll(KeepOut):
    def safety(self, tally: Tally) -> Any:
        return np.full_like(tally.least, tally.least.min())


class GoesOn(KeepOut):
    def observe(self, tally: Tally, x: Any, scenario: Any) -> Tally:
        seen = super().observe(tally, x, scenario)
        return Tally(seen.least - 0.01, seen.first, seen.last, seen.arrived | (np.arange(len(x)) % 2 == 0))


class AnythingGoes(KeepOut):
    def progress_ok(self, progress: Any) -> bool:
        return True


class TakesAnything(KeepOut):
    def __init__(self, parameters: dict[str, Any], model: Any, dt: float) -> None:
        super().__init__({name: value for name, value in parameters.items() if value == value and name in self.PARAMETERS}, model, dt)  # noqa: PLR0124


class HalfHorizon(KeepOut):
    def __init__(self, parameters: dict[str, Any], model: Any, dt: float) -> None:
        super().__init__(parameters, model, dt)
        self.horizon = 12.5  # type: ignore[assignment]


class Unexplained(KeepOut):
    PARAMETERS = {**KeepOut.PARAMETERS, "shift": (0.2, "")}


TASKS = {
    OwnDice: "test_a_seed_gives_one_set_of_scenarios_and_another_seed_another",
    OneScenario: "test_a_seed_gives_one_set_of_scenarios_and_another_seed_another",
    Elsewhere: "test_a_scenario_can_begin_where_the_robot_is",
    Moves: "test_a_step_does_not_change_what_it_is_given",
    WorstOfAll: "test_rollouts_are_judged_each_by_itself",
    GoesOn: "test_what_is_done_does_not_change_any_more",
    AnythingGoes: "test_standing_still_is_no_success",
    TakesAnything: "test_parameters_that_make_no_sense_are_refused",
    HalfHorizon: "test_horizon_is_a_number_of_steps",
}


@pytest.mark.parametrize(("broken", "test"), TASKS.items(), ids=[b.__name__ for b in TASKS])
def test_task_kit_fails_a_task_that_breaks_the_contract(broken: type[KeepOut], test: str) -> None:
    kit = type("Kit", (TaskKit,), {"task": broken, "models": ("unicycle",)})()
    model = registry().get("models", "unicycle")
    with pytest.raises((AssertionError, pytest.fail.Exception)):
        getattr(kit, test)([(model, broken({}, model, 0.05))])


def test_task_kit_wants_parameters_explained_and_says_why_no_model_will_do() -> None:
    with pytest.raises(AssertionError, match="shift: what does it mean"):
        type("Kit", (TaskKit,), {"task": Unexplained})().test_parameters_have_defaults_and_are_explained()

    class Nowhere(KeepOut):
        def __init__(self, parameters: dict[str, Any], model: Any, dt: float) -> None:
            raise ConfigError("task nowhere: needs a formula")

    class Kit(TaskKit):
        task = Nowhere

    with pytest.raises(AssertionError, match="takes none of these models: task nowhere: needs a formula"):
        TaskKit.cases.__wrapped__(Kit())  # type: ignore[attr-defined]
