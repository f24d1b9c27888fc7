"""The quadruped's profile, controllers and experiment, in little and on a robot without physics (`swaying_walker`): the pieces do what they
say of themselves, and everything that the tool draws and tells is there.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import bench_quadruped_coverage as coverage
import numpy as np
import pytest
import quadruped_experiment as experiment
from paper_experiment import control_of
from quadruped_gaps import BODY, READINGS, Reading, of_more, row
from quadruped_truth import Holds, placed, run, stops, walked
from swaying_walker import SwayingWalker

from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.evidence.bounds import sample_size
from s2r_runtime.evidence.disturbance import GapSet
from s2r_runtime.evidence.uncertain import roll_out
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.profile import Profile, check_names, load_profile
from s2r_runtime.tasks.grid_world import GridWorld

ROOT = Path(__file__).parent.parent
PROFILE, SECOND = experiment.PROFILE, load_profile(ROOT / "profiles" / "quadruped-second.toml")
SIGMA = np.array([0.0005, 0.0005, 0.002])


class Unicycle(SwayingWalker):
    """It does what it is told, and doesn't sway."""

    lag, gain_v, gain_w, sway, roll = 0.01, 1.0, 1.0, 0.0, 0.0


class Standing(Unicycle):
    """It doesn't move."""

    gain_v = gain_w = 0.0


def holds_of(robot: SwayingWalker, n: int = 60, seed: int = 3) -> Holds:
    return placed(robot, stops(robot, 5, seed, PROFILE), n, seed, PROFILE, 1.0)


# ---------------------------------------------------------------- profile and controllers


def test_the_profile_has_the_papers_numbers() -> None:
    check_names(PROFILE, "profiles/quadruped.toml")
    assert PROFILE.region == {"x": (-2.5, 2.5), "y": (-2.5, 2.5)}
    assert PROFILE.inputs == {"v": (-0.15, 0.15), "w": (-0.3, 0.3)}
    assert (PROFILE.model.name, PROFILE.model.dt) == ("unicycle", 0.1)
    assert PROFILE.sampling.hold_periods * PROFILE.model.dt == pytest.approx(1.0)  # 1000 steps of the robot
    assert (PROFILE.guarantee.epsilon, PROFILE.guarantee.beta) == (0.03, 0.05)
    assert sample_size(0.03, 0.05) <= experiment.Size().samples == 100
    grid = {name: PROFILE.task.parameters[name] for name in ("columns", "rows", "static", "goals", "movers")}
    assert grid == {"columns": 5, "rows": 5, "static": 5, "goals": 1, "movers": 0}


def test_what_ships_with_the_robot_is_the_profile_and_the_controllers() -> None:
    data = ROOT / "plugins" / "standins" / "s2r_standins" / "data"
    for name in ("quadruped.toml", "quadruped-second.toml"):
        assert (data / name).read_bytes() == (ROOT / "profiles" / name).read_bytes()
    for name in ("quadruped_grid.py", "quadruped_grid_reckless.py"):
        assert (data / name).read_bytes() == (ROOT / "controllers" / name).read_bytes()


def test_the_profile_with_a_step_a_second_is_of_the_same_robot_and_task() -> None:
    check_names(SECOND, "profiles/quadruped-second.toml")
    assert (SECOND.model.dt, SECOND.robot.name, SECOND.norm) == (1.0, PROFILE.robot.name, PROFILE.norm)
    assert (SECOND.region, SECOND.inputs) == (PROFILE.region, PROFILE.inputs)
    seconds = [p.task.parameters["steps"] * p.model.dt for p in (PROFILE, SECOND)]  # type: ignore[operator]
    assert seconds[0] == seconds[1]
    others = [{k: v for k, v in p.task.parameters.items() if k != "steps"} for p in (PROFILE, SECOND)]
    assert others[0] == others[1]


@pytest.mark.parametrize("profile", [PROFILE, SECOND], ids=["tenth", "second"])
def test_a_scenario_can_begin_wherever_a_campaign_may_have_left_the_robot(profile: Profile) -> None:
    """At its last waypoint's edge, a hold further out; in all of 40 directions. (At .1 s: half a hold; one in 50 goes farther.)"""
    task = GridWorld(dict(profile.task.parameters), compose(profile.model).nominal, profile.model.dt)
    rng, s = np.random.default_rng(1), profile.sampling
    hold = s.hold_periods * profile.model.dt * profile.inputs["v"][1] * (0.5 if profile is PROFILE else 1.0)
    out = profile.region["x"][1] - s.waypoint_margin + s.waypoint_radius + hold
    for angle in np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False):
        square = out / max(abs(math.cos(angle)), abs(math.sin(angle)))
        task.draw_at(rng, np.array([square * math.cos(angle), square * math.sin(angle), angle]))


@pytest.mark.parametrize(("name", "crash"), [("quadruped_grid.py", 0.0), ("quadruped_grid_reckless.py", 0.2)])
def test_the_good_controller_walks_the_grid_and_the_reckless_one_crashes(name: str, crash: float) -> None:
    model = compose(PROFILE.model)
    task = GridWorld(dict(PROFILE.task.parameters), model.nominal, model.dt)
    done = roll_out(control_of(name, {}), task, model, GapSet("ball", BODY, 0.01), "uniform", np.random.default_rng(5), 300)
    assert np.mean(done.safety < 0.0) == 0.0 if not crash else np.mean(done.safety < 0.0) > crash
    if not crash:
        assert np.median(done.progress) >= 2.0


def test_the_controller_turns_its_nearer_end_and_stays_in_bounds() -> None:
    model = compose(PROFILE.model)
    task = GridWorld(dict(PROFILE.task.parameters), model.nominal, model.dt)
    scenario = task.draw(np.random.default_rng(6), 400)
    control, x = control_of("quadruped_grid.py", {}), scenario["start"].copy()
    low, high = np.array([PROFILE.inputs[name] for name in ("v", "w")]).T
    u = control(x, task.view(scenario))
    assert np.all((u >= low) & (u <= high))
    assert np.any(u[:, 0] < 0.0)
    assert np.any(u[:, 0] > 0.0)
    turned = x.copy()
    turned[:, 2] += np.pi
    np.testing.assert_allclose(control(turned, task.view(scenario)) * [-1.0, 1.0], u, atol=1e-9)


# ---------------------------------------------------------------- sampling


def test_a_walked_campaign_is_the_daemons_and_its_holds_are_its_samples() -> None:
    holds = walked(SwayingWalker(), PROFILE, 5, 1)
    x0, x1, held = (np.array([getattr(s, name) for s in holds.samples]) for name in ("x0", "x1", "held"))
    np.testing.assert_array_equal(holds.path[:, 0], x0)
    np.testing.assert_array_equal(holds.path[:, 10], x1)
    np.testing.assert_array_equal(holds.path[:, -1], held)
    t, x, u = holds.drive or (np.empty(0),) * 3
    assert len(t) == len(x) == len(u)
    first = int(np.argmax(np.all(x == x0[0], axis=1)))
    np.testing.assert_array_equal(u[first : first + 10], np.repeat(holds.u[:1], 10, axis=0))


def test_a_robot_that_is_its_model_leaves_noise() -> None:
    """5 sigma of a difference of two measurements, and what the first hundredth of a second costs in which it doesn't move yet."""
    holds = holds_of(Unicycle())
    allowed = 5.0 * math.sqrt(2.0) * SIGMA + 0.01 * np.array([0.15, 0.15, 0.3]) + 0.0005
    for dt in (0.2, 0.47, 1.0):
        assert np.all(np.abs(Reading(dt).errors(holds)) < allowed)
    assert Reading(1.0).discrepancies(holds).max() < 0.05 * Reading(1.0).still


def test_a_robot_that_stands_still_scores_what_standing_still_scores() -> None:
    holds = holds_of(Standing(), 300)
    assert Reading(0.1, norm="literal").still == pytest.approx(0.0335, abs=5e-5)
    for reading in (Reading(0.1, norm="literal"), Reading(0.5), Reading(1.0, kind="box")):
        told = row(reading, holds, 0.03)
        noise = 5.0 * math.sqrt(2.0) * float(np.linalg.norm(SIGMA * reading.weights))
        assert 0.8 * reading.still < told["r"] < reading.still + noise
        assert told["position"] <= 0.15 * reading.dt + 0.005
        assert told["confidence"] == pytest.approx(1.0 - 0.97**300)


def test_a_lag_that_the_model_knows_is_carried_into_the_stride() -> None:
    class Lagging(Unicycle):
        lag = 0.3

    holds = holds_of(Lagging())
    known = tuple(EffectSpec("input_lag", name, {"time_constant": 0.3}) for name in ("v", "w"))
    for begins in ("standing", "in stride"):
        without, with_it = (Reading(0.2, begins, effects=effects).discrepancies(holds).max() for effects in ((), known))
        assert with_it < 0.006  # 5 sigma of measurement
        assert without > 2.0 * with_it


def test_more_samples_are_counted_as_the_theorem_counts_them() -> None:
    holds = holds_of(SwayingWalker(), 120)
    one, two = of_more(Reading(0.1), holds, ((100, 0, 0.03), (120, 1, 0.03)))
    ordered = np.sort(Reading(0.1).discrepancies(holds))
    assert one["r"] == Reading(0.1).discrepancies(holds)[:100].max()
    assert one["beyond"] == np.mean(Reading(0.1).discrepancies(holds)[100:] > one["r"])
    assert (two["r"], two["beyond"]) == (ordered[-2], None)
    assert one["confidence"] > 0.95


def test_placed_starts_are_seeded_and_in_the_region() -> None:
    one, two, other = (holds_of(SwayingWalker(), 30, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.path, two.path)
    assert not np.array_equal(one.path, other.path)
    assert np.all(np.abs(one.path[:, 0, :2]) < 2.51)


# ---------------------------------------------------------------- runs on the robot


def test_a_fall_is_a_crash_wherever_it_was() -> None:
    class Clumsy(SwayingWalker):
        def step(self, v: float, w: float, seconds: float) -> tuple[float, float, float]:
            if self.now_s > 2.0:
                self.fallen = "tripped"
            return super().step(v, w, seconds)

    task = experiment.task_for(compose(PROFILE.model), experiment.QUICK)
    scenario = task.draw(np.random.default_rng(1), 1)
    control = control_of("quadruped_grid.py", {})
    fell, stood = (run(robot, control, task, scenario, PROFILE, 0.1, 1) for robot in (Clumsy(), SwayingWalker()))
    assert (fell.safety, fell.fallen) == (-1.0, "tripped")
    assert len(fell.path) < len(stood.path)
    assert stood.safety >= 0.0
    with pytest.raises(NotEnoughEvidence, match="tripped"):
        walked(Clumsy(), PROFILE, 3, 1)


def test_steps_of_a_run_are_judged_with_the_models_memory() -> None:
    class Lagging(Unicycle):
        lag = 0.3

    spec = ModelSpec("unicycle", 0.1, effects=tuple(EffectSpec("input_lag", name, {"time_constant": 0.3}) for name in ("v", "w")))
    task = experiment.task_for(compose(spec), experiment.QUICK)
    one = run(Lagging(), control_of("quadruped_grid.py", {}), task, task.draw(np.random.default_rng(2), 1), PROFILE, 0.1, 2)
    knowing, plain = (experiment.step_errors(one, compose(s))[0] for s in (spec, ModelSpec("unicycle", 0.1)))
    assert np.sqrt(np.mean(knowing[:, 2] ** 2)) < 1.2 * math.sqrt(2.0) * 0.002
    assert np.sqrt(np.mean(plain[:, 2] ** 2)) > np.sqrt(np.mean(knowing[:, 2] ** 2))


# ---------------------------------------------------------------- the whole


@pytest.mark.slow
def test_the_whole_experiment_runs_and_tells_what_came_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page, numbers = tmp_path / "page.html", tmp_path / "numbers.json"
    assert experiment.main(["--quick", "-o", str(page), "--json", str(numbers)], lambda _: SwayingWalker()) == 0
    said = capsys.readouterr().out
    assert "what standing still would score" in said
    found = json.loads(numbers.read_text())
    assert [g["reading"] for g in found["gaps"]] == [r.words for r in READINGS]
    assert found["gaps"][0]["still"] == pytest.approx(0.0335, abs=5e-5)
    passing = [m for m in found["models"] if "final" in m]
    assert passing
    for one in passing:
        assert one["true_runs"]["n"] == experiment.QUICK.runs
        assert [c["n"] for c in one["final"]["claims"]] == [300, 500]
    html = page.read_text()
    assert html.count("<svg") >= 10
    assert "src=" not in html
    assert "http" not in html.replace("http://www.w3.org", "")


def test_readings_alone_need_no_campaign(capsys: pytest.CaptureFixture[str]) -> None:
    assert experiment.main(["--readings", "20"], lambda _: SwayingWalker()) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("gap: r")
    assert [line.split("%   ")[1] for line in told[1:]] == [r.words for r in READINGS]


@pytest.mark.slow
def test_coverage_holds_on_a_robot_and_is_broken_where_radii_are_too_small(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--campaigns", "60", "--law", "4000", "--starts", "40", "--json"]
    coverage.main(arguments, lambda _: SwayingWalker())
    rows = json.loads(capsys.readouterr().out)["rows"]
    plain = [r for r in rows if not r["what"].startswith("fault")]
    assert len(plain) == 3
    assert all(r["ok"] and r["campaigns"] == 60 for r in plain)
    ordered = np.linspace(0.0, 1.0, 1001)
    short = coverage.row("short", np.full(60, 0.9), ordered, planted=False)
    assert (short["missed"], short["ok"]) == (60, False)
    assert coverage.row("enough", np.full(60, 0.98), ordered, planted=False)["missed"] == 0
