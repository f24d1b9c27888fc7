"""The task that a profile writes down: its law, its values against slow reference code, what it refuses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from s2r_runtime.controllers.hosted import batch_control, load
from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.evidence.uncertain import GapSet, roll_out
from s2r_runtime.models.composed import compose
from s2r_runtime.models.unicycle import MODEL as UNICYCLE
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import Profile, load_profile, parse_profile
from s2r_runtime.tasks.stl_task import StlTask

ROOT = Path(__file__).parent.parent
DT = 0.1
REACH: dict[str, Any] = {
    "horizon": 4.0,
    "metric": "always (hypot(x - post_x, y) > 0.2) and eventually (x > goal_x)",
    "start": {"x": [-1.0, -0.5], "y": [-0.5, 0.5], "theta": [-3.2, 3.2]},
    "scenario": {"goal_x": [0.5, 1.0], "post_x": "(x + goal_x) / 2"},
}


def task(dt: float = DT, **changes: Any) -> StlTask:
    return StlTask({**REACH, **changes}, UNICYCLE, dt)


def ahead(x: np.ndarray, theta: dict[str, Any]) -> np.ndarray:
    """Straight on along x at 0.5 m/s, turning the heading to 0."""
    return np.column_stack([np.full(len(x), 0.5), -2.0 * x[:, 2]])


def rolled(one: StlTask, n: int, law: str = "uniform", radius: float = 0.01, hold: float = 0.1, **choices: Any) -> Any:
    gap = GapSet("ball", (1.0, 1.0, 1.0), radius, hold, 10)
    return roll_out(ahead, one, compose(ModelSpec("unicycle", DT)), gap, law, np.random.default_rng(3), n, **choices)


# ---------------------------------------------------------------- the law


def test_scenarios_follow_their_table() -> None:
    laws = {"a": [1.0, 2.0], "b": {"normal": [5.0, 0.5]}, "c": {"choice": [1, 2, 4]}, "d": "a + 2 * c - x", "e": 7, "f": "d * d"}
    n = 20_000
    s = task(scenario={**laws, "goal_x": 1.0, "post_x": 0.0}).draw(np.random.default_rng(1), n)
    assert s["start"].shape == (n, 3)
    assert np.all((s["a"] >= 1.0) & (s["a"] <= 2.0))
    assert abs(np.mean(s["a"]) - 1.5) < 6.0 / np.sqrt(12.0 * n)
    assert abs(np.mean(s["b"]) - 5.0) < 6.0 * 0.5 / np.sqrt(n)
    assert abs(np.std(s["b"]) - 0.5) < 6.0 * 0.5 / np.sqrt(2.0 * n)
    for value in (1, 2, 4):
        assert abs(np.mean(s["c"] == value) - 1.0 / 3.0) < 6.0 * np.sqrt(2.0 / 9.0 / n)
    np.testing.assert_allclose(s["d"], s["a"] + 2.0 * s["c"] - s["start"][:, 0], rtol=1e-12)
    np.testing.assert_allclose(s["f"], s["d"] ** 2, rtol=1e-12)
    assert np.all(s["e"] == 7.0)


def test_the_law_given_something_is_that_law_where_it_holds() -> None:
    one = task(given="x + goal_x > 0.2 and abs(y) < 0.1")
    s = one.draw(np.random.default_rng(1), 5000)
    assert np.all(s["start"][:, 0] + s["goal_x"] > 0.2)
    assert np.all(np.abs(s["start"][:, 1]) < 0.1)
    everything = task().draw(np.random.default_rng(2), 200_000)
    kept = everything["start"][:, 0] + everything["goal_x"] > 0.2
    assert abs(np.mean(s["goal_x"]) - np.mean(everything["goal_x"][kept])) < 6.0 * 0.15 / np.sqrt(5000)


def test_the_order_in_the_file_and_the_batch_size_of_one_seed_mean_nothing() -> None:
    names = ("goal_x", "post_x", "other")
    laws = {"goal_x": [0.5, 1.0], "post_x": [0.0, 0.1], "other": {"normal": [0.0, 1.0]}}
    draws = [task(scenario={name: laws[name] for name in order}).draw(np.random.default_rng(9), 7) for order in (names, names[::-1])]
    assert all(np.array_equal(draws[0][name], draws[1][name]) for name in (*names, "start"))


def test_a_robot_that_is_there_starts_there_and_one_that_is_not_is_told_where_scenarios_start() -> None:
    at = np.array([-0.75, 0.2, 1.0])
    s = task().draw_at(np.random.default_rng(1), at)
    assert s["start"].tolist() == [at.tolist()]
    assert s["post_x"][0] == pytest.approx((-0.75 + s["goal_x"][0]) / 2.0)
    with pytest.raises(NotEnoughEvidence, match=r"the robot is at x 0\.300.*scenarios start with x in \[-1, -0\.5\]"):
        task().draw_at(np.random.default_rng(1), np.array([0.3, 0.2, 1.0]))
    with pytest.raises(NotEnoughEvidence, match="no scenario starts there"):
        task(given="y > 0.3").draw_at(np.random.default_rng(1), at)


# ---------------------------------------------------------------- the metric


def test_safety_is_the_formulas_robustness_over_the_rollout() -> None:
    found = rolled(task(), 40, keep=40)
    for path, scenario, safety in zip(found.paths, found.scenarios, found.safety, strict=True):
        away = np.hypot(path[:, 0] - scenario["post_x"][0], path[:, 1]) - 0.2
        assert len(path) == 41
        assert safety == pytest.approx(min(away.min(), (path[:, 0] - scenario["goal_x"][0]).max()), abs=1e-12)
    assert np.any(found.safety < 0.0)
    assert np.any(found.safety > 0.0)


def test_a_barrier_is_its_least_value() -> None:
    found = rolled(task(metric="", barrier="hypot(x - post_x, y) - 0.1 * t", progress="x"), 20, keep=20)
    for path, scenario, safety, progress in zip(found.paths, found.scenarios, found.safety, found.progress, strict=True):
        values = np.hypot(path[:, 0] - scenario["post_x"][0], path[:, 1]) - 0.1 * DT * np.arange(41)
        assert safety == pytest.approx(values.min(), abs=1e-12)
        assert progress == pytest.approx(path[-1, 0], abs=1e-12)


def test_after_the_end_of_a_run_nothing_counts() -> None:
    metric = "always (x < goal_x + 0.1) and eventually (x > goal_x)"
    quick = {"horizon": 6.0, "start": {**REACH["start"], "theta": [-0.5, 0.5]}}
    assert np.all(rolled(task(metric=metric, **quick), 30, radius=0.0, hold=0.0).safety < 0.0)
    ending = task(metric=metric, ends="x > goal_x", **quick)
    found = rolled(ending, 30, radius=0.0, hold=0.0, keep=30)
    lengths = {len(path) for path in found.paths}
    assert np.all(found.safety > 0.0)
    assert max(lengths) < 61
    for path, scenario, safety in zip(found.paths, found.scenarios, found.safety, strict=True):
        goal = scenario["goal_x"][0]
        assert path[-1, 0] > goal >= path[-2, 0]
        assert safety == pytest.approx(min((goal + 0.1 - path[:, 0]).min(), (path[:, 0] - goal).max()), abs=1e-12)


def test_a_window_that_reaches_past_the_end_of_a_run_sees_the_state_held() -> None:
    metric = "always (x < goal_x + 0.1) and eventually always[0,2.5] (x > goal_x)"
    quick = {"horizon": 6.0, "start": {**REACH["start"], "theta": [-0.5, 0.5]}}
    found = rolled(task(metric=metric, ends="x > goal_x", **quick), 30, radius=0.0, hold=0.0)
    assert np.all(found.safety > 0.0)


def test_the_adversarial_law_pushes_against_what_the_metric_asks_for() -> None:
    one = task(metric="always (y < 0.9) and eventually (x > 0.2)")
    s = one.draw(np.random.default_rng(1), 5)
    x = s["start"]
    np.testing.assert_allclose(one.clearance(x, s), 0.9 - x[:, 1])
    only = task(metric="eventually[0,3] (x > goal_x)")
    np.testing.assert_allclose(only.clearance(x, only.draw(np.random.default_rng(1), 5)), x[:, 0] - s["goal_x"])
    own = task(clearance="2 * y")
    np.testing.assert_allclose(own.clearance(x, s | {"post_x": s["goal_x"]}), 2.0 * x[:, 1])
    drifted = [
        rolled(task(metric="always (y < 1)", progress="none"), 200, law, 0.02, 0.2).safety.mean() for law in ("persistent", "adversarial")
    ]
    assert drifted[1] < drifted[0] - 0.1


def test_standing_still_is_no_pass() -> None:
    one = task(metric="always (x < 5)", progress="eventually (x > goal_x)")
    assert not one.progress_ok(np.array([0.1, -0.2, -0.3]))
    assert one.progress_ok(np.array([0.1, 0.2, -0.3]))
    assert task(metric="always (x < 5)", progress="x", min_progress=0.5).progress_ok(np.array([0.6]))
    assert not task(metric="always (x < 5)", progress="x", min_progress=0.5).progress_ok(np.array([0.4]))
    assert task(metric="always (x < 5)", progress="none").progress_ok(np.array([0.0]))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"metric": ""}, "must have either metric"),
        ({"barrier": "x"}, "must have either metric"),
        ({"metric": "always (x < 5)"}, "progress is missing, and the metric asks for nothing to happen"),
        ({"metric": "not eventually (x > 5)"}, "progress is missing"),
        ({"metric": "always (z < 5)"}, "metric, column 9: 'z' is not known; there are: x, y, theta, goal_x, post_x, t"),
        ({"metric": "eventually[0,5] (x > 1)"}, "metric looks 5 s ahead, the horizon is 4 s"),
        ({"metric": "eventually (x > 0) and always (x != 3)"}, "column 34: that two numbers differ never has a robustness below 0"),
        ({"metric": "always not (x == 3) and eventually (x > 0)"}, "that two numbers differ never"),
        ({"metric": 3.0}, "metric is 3.0, must be a text"),
        ({"horizon": 0.01}, "horizon is 0.01 s, must be at least a step"),
        ({"horizon": "long"}, "horizon is 'long', must be a number"),
        ({"start": {"z": 0.0}}, "start.z: the model has no such state; it has: x, y, theta"),
        ({"start": {"x": [2.0, 1.0]}}, "start.x is [2.0, 1.0], must be [low, high] with low <= high"),
        ({"start": {"x": [1.0]}}, "start.x is [1.0], must be [low, high]"),
        ({"start": {"x": {"normal": [0.0, -1.0]}}}, "standard deviation >= 0"),
        ({"start": {"x": {"gamma": [0.0, 1.0]}}}, "must be a number, [low, high], { normal = [mean, sd] }"),
        ({"scenario": {"x": 1.0}}, "scenario.x: the name means something else already"),
        ({"scenario": {"t": 1.0}}, "scenario.t: the name means something else already"),
        ({"scenario": {"a b": 1.0}}, "a name has letters, digits and _"),
        ({"scenario": {"goal_x": "post_x", "post_x": "goal_x + 1"}}, "is computed from itself, through goal_x, post_x"),
        ({"scenario": {"goal_x": "post_x +", "post_x": 1.0}}, "scenario.goal_x, column 9: expected a name"),
        ({"given": "always (x < 1)"}, "it may only say something of the start"),
        ({"ends": "eventually (x < 1)"}, "it may only say something of one instant"),
        ({"goal": 1.0}, "has no parameter 'goal'"),
        ({"metrik": "x"}, "has no parameter 'metrik'; did you mean 'metric'?"),
    ],
)
def test_a_task_that_makes_no_sense_is_refused_on_one_line(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        task(**changes)
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_impossible_law_is_refused_where_it_is_drawn() -> None:
    with pytest.raises(ConfigError, match="no scenario was found"):
        task(given="x > 5").draw(np.random.default_rng(1), 3)
    with pytest.raises(ConfigError, match="goal_x of a scenario is not finite"):
        task(scenario={"goal_x": "1 / (x - x)", "post_x": 1.0}).draw(np.random.default_rng(1), 3)


@pytest.mark.parametrize("law", ["uniform", "persistent", "adversarial"])
@pytest.mark.parametrize("name", ["unicycle", "differential_drive", "bicycle", "double_integrator", "joint"])
def test_every_law_disturbs_every_model_within_the_gap(name: str, law: str) -> None:
    """Without an input the model's own motion is known, so what is left is the disturbance."""
    model = compose(ModelSpec(name, DT))
    first, nx = model.states[0], len(model.states)
    one = StlTask({"horizon": 2.0, "metric": f"always ({first} < 5)", "progress": "none"}, model.nominal, DT)
    gap = GapSet("box" if name == "joint" else "ball", tuple(1.0 + 0.5 * k for k in range(nx)), 0.02, 0.1, 10)
    found = roll_out(lambda x, theta: np.zeros((len(x), len(model.inputs))), one, model, gap, law, np.random.default_rng(4), 30, keep=30)
    for path in found.paths:
        foretold = np.array([model.step(x[None], np.zeros((1, len(model.inputs))), model.at_rest(1))[0][0] for x in path[:-1]])
        d = path[1:] - foretold
        for column in model.angle_columns:
            d[:, column] = (d[:, column] + np.pi) % (2.0 * np.pi) - np.pi
        assert np.max(gap.norm(d)) <= 0.02 * (1.0 + 1e-9)
    drift = np.abs([path[-1] - path[0] for path in found.paths]).max()
    assert drift > 0.02


# ---------------------------------------------------------------- in a profile


def test_a_profile_binds_every_word_of_the_task() -> None:
    profile = load_profile(ROOT / "profiles" / "ground-avoidance.toml")
    text = (ROOT / "profiles" / "ground-avoidance.toml").read_text()
    other = parse_profile(text.replace("altitude > 0", "altitude > 1"), "other", ROOT / "profiles")
    assert profile.task_digest() != other.task_digest()
    assert msgspec.json.decode(msgspec.json.encode(profile), type=Profile) == profile


def test_a_robot_that_nobody_can_reach_is_not_driven(tmp_path: Path) -> None:
    for verb in (("run",), ("sample",)):
        done = subprocess.run(
            [sys.executable, "-m", "s2r_runtime.cli.main", *verb, str(ROOT / "profiles" / "ground-avoidance.toml")],
            capture_output=True,
            text=True,
            check=False,
            cwd=tmp_path,
        )
        assert done.returncode == 78
        assert "transport is missing; to drive a robot" in done.stderr


def test_a_state_that_is_called_t_is_meant_by_t() -> None:
    class Clock:
        states, angles = ("t", "x"), ()

    one = StlTask({"metric": "always (t < 5)", "progress": "none"}, Clock(), DT)  # type: ignore[arg-type]
    s = one.draw(np.random.default_rng(1), 1) | {"step": np.array([30])}
    assert one.safety(one.observe(one.begin(s), np.array([[4.0, 0.0]]), s)).tolist() == [1.0]


def test_a_benchmark_ported_from_the_docs_is_told_from_one_that_crashes() -> None:
    profile = load_profile(ROOT / "profiles" / "ground-avoidance.toml")
    model = compose(profile.model)
    one = StlTask(profile.task.parameters, model.nominal, model.dt)
    gap = GapSet("ball", (1.0, 1.0, 100.0, 100.0, 10.0), 0.2, 1.4, 50)
    for pull, crashes in ((5.0, False), (2.0, True)):
        control = batch_control(load(ROOT / "controllers" / "ground_avoidance.py", {"pull": pull}))
        safety = roll_out(control, one, model, gap, "uniform", np.random.default_rng(1), 300).safety
        assert bool(np.any(safety < 0.0)) == crashes
