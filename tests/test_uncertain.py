"""Promises of the disturbance laws (guarantee G8) and of the rollouts that they disturb."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2r_runtime.controllers.hosted import batch_control, load
from s2r_runtime.errors import ControllerError, UsageError
from s2r_runtime.evidence.bounds import clopper_pearson_lower, clopper_pearson_upper
from s2r_runtime.evidence.disturbance import LAWS, Ahead
from s2r_runtime.evidence.uncertain import BATCH, GapSet, roll_out
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.models.double_integrator import MODEL as DOUBLE_INTEGRATOR
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import load_profile
from s2r_runtime.tasks.grid_world import GridWorld
from s2r_runtime.tasks.keep_out import KeepOut

ROOT = Path(__file__).parent.parent
MODEL = compose(load_profile(ROOT / "profiles" / "robotarium.toml").model)
GRID = GridWorld({}, MODEL.nominal, MODEL.dt)
KEEP_OUT = KeepOut({"steps": 40}, MODEL.nominal, MODEL.dt)
CONTROL = batch_control(load(ROOT / "controllers" / "grid.py"), 2)
WEIGHTS = (1.0, 2.0, 0.0525)
SURE = 1e-4


def assert_share(hits: Any, n: int, share: float) -> None:
    """hits of n is compatible with this probability."""
    assert clopper_pearson_lower(int(hits), n, SURE) <= share <= clopper_pearson_upper(int(hits), n, SURE)


def still(x: np.ndarray, theta: dict[str, Any]) -> np.ndarray:
    return np.zeros((len(x), 2))


def steps(paths: list[np.ndarray]) -> np.ndarray:
    """Differences between neighbouring states, (rollout, step, nx), angles wrapped."""
    d = np.diff(np.array(paths), axis=1)
    d[..., 2] = np.arctan2(np.sin(d[..., 2]), np.cos(d[..., 2]))
    return d


# ---------------------------------------------------------------- the set


@pytest.mark.parametrize("kind", ["ball", "box"])
@pytest.mark.parametrize("nx", [1, 2, 3, 5])
def test_points_are_uniform_in_the_set(kind: Any, nx: int) -> None:
    gap = GapSet(kind, tuple(0.1 + np.arange(nx) * 1.3), 0.25)
    n = 20_000
    d = gap.inside(np.random.default_rng([1, nx]), n, 0.25)
    norm = gap.norm(d)
    assert d.shape == (n, nx)
    assert norm.max() <= 0.25 * (1.0 + 1e-12)
    for share in (0.1, 0.5, 0.9):  # a uniform point is within q r with probability q^nx
        assert_share(np.sum(norm <= 0.25 * share ** (1.0 / nx)), n, share)
    outer = norm > 0.125
    for part in (outer, ~outer):  # and its direction doesn't depend on how far out it is: every orthant is alike
        assert_share(np.sum(np.all(d[part] > 0.0, axis=1)), int(np.sum(part)), 0.5**nx)
    v = d * np.asarray(gap.weights) / 0.25
    if kind == "box":
        for column in range(nx):
            assert_share(np.sum(v[:, column] < -0.4), n, 0.3)
    elif nx == 3:  # the height of a uniform point in a ball: P(z > 1/2) = 5/32 (a cap's share)
        for column in range(nx):
            assert_share(np.sum(v[:, column] > 0.5), n, 5.0 / 32.0)


def test_directions_are_uniform_on_the_boundary() -> None:
    n, rng = 20_000, np.random.default_rng(2)
    ball = GapSet("ball", WEIGHTS, 1.0)
    g = ball.boundary(rng, n)
    assert np.allclose(ball.norm(g), 1.0)
    for column, weight in enumerate(WEIGHTS):  # Archimedes: a coordinate of a uniform point on the sphere in space is uniform
        for level in (-0.6, 0.0, 0.7):
            assert_share(np.sum(weight * g[:, column] > level), n, (1.0 - level) / 2.0)
    box = GapSet("box", WEIGHTS, 1.0)
    v = box.boundary(rng, n) * np.asarray(WEIGHTS)
    assert np.allclose(np.abs(v).max(axis=1), 1.0)
    for column in range(3):
        for face in (1.0, -1.0):
            on = v[:, column] == face
            assert_share(np.sum(on), n, 1.0 / 6.0)
            other = v[on][:, (column + 1) % 3]
            assert_share(np.sum(other > 0.2), len(other), 0.4)


@pytest.mark.parametrize(
    ("kind", "weights", "numbers", "words"),
    [
        ("cube", (1.0,), (1.0, 0.0, 1), "kind is 'cube', must be ball or box"),
        ("ball", (1.0, 0.0), (1.0, 0.0, 1), "must be numbers > 0"),
        ("ball", (1.0,), (math.nan, 0.0, 1), "radius is nan, must be >= 0"),
        ("box", (1.0,), (1.0, -1.0, 1), "hold radius is -1.0, must be >= 0"),
        ("box", (1.0,), (1.0, 1.0, 0), "hold periods are 0, must be >= 1"),
    ],
)
def test_an_impossible_set_is_refused(kind: Any, weights: tuple[float, ...], numbers: tuple[float, float, int], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        GapSet(kind, weights, *numbers)


# ---------------------------------------------------------------- the laws


@pytest.mark.parametrize("kind", ["ball", "box"])
def test_uniform_disturbances_are_independent_and_fill_the_set(kind: Any) -> None:
    gap = GapSet(kind, WEIGHTS, 0.001, 0.02, 50)
    d = steps(roll_out(still, KEEP_OUT, MODEL, gap, "uniform", np.random.default_rng(3), 300, keep=300).paths)
    norm = gap.norm(d.reshape(-1, 3))
    assert norm.max() <= 0.001 * (1.0 + 1e-6)
    assert_share(np.sum(norm <= 0.0005), len(norm), 0.125)
    for column in range(3):  # a sign says nothing about the next one
        same = np.sign(d[:, 1::2, column]) == np.sign(d[:, 0::2, column])
        assert_share(np.sum(same), same.size, 0.5)


@pytest.mark.parametrize("kind", ["ball", "box"])
def test_a_persistent_disturbance_is_one_push_a_rollout_and_noise_in_what_the_set_leaves(kind: Any) -> None:
    gap = GapSet(kind, WEIGHTS, 0.001, 0.02, 50)
    d = steps(roll_out(still, KEEP_OUT, MODEL, gap, "persistent", np.random.default_rng(4), 400, keep=400).paths)
    assert gap.push == pytest.approx(0.0004)
    assert gap.norm(d.reshape(-1, 3)).max() <= 0.001 * (1.0 + 1e-6)
    middle = (d.max(axis=1) + d.min(axis=1)) / 2.0  # of 40 uniform draws around the push: near it
    assert np.all(gap.norm(middle) < 0.0004 + 0.0004)
    assert np.all(gap.norm(middle) > 0.0004 - 0.00035)
    alone = GapSet(kind, WEIGHTS, 0.0004, 0.02, 50)  # nothing is left: the push, the same at every step
    d = steps(roll_out(still, KEEP_OUT, MODEL, alone, "persistent", np.random.default_rng(4), 400, keep=400).paths)
    assert np.allclose(gap.norm(d.reshape(-1, 3)), 0.0004)
    assert np.allclose(d, d[:, :1], atol=1e-12)


def test_a_push_larger_than_the_set_is_not_cut() -> None:
    gap = GapSet("ball", WEIGHTS, 0.001, 0.2, 50)
    d = steps(roll_out(still, KEEP_OUT, MODEL, gap, "persistent", np.random.default_rng(5), 50, keep=50).paths)
    assert np.allclose(gap.norm(d.reshape(-1, 3)), 0.004)


@pytest.mark.parametrize("kind", ["ball", "box"])
def test_no_push_lowers_the_clearance_more_than_the_adversary_s(kind: Any) -> None:
    gap = GapSet(kind, WEIGHTS, 0.0, 0.05, 50)
    rng = np.random.default_rng(6)
    scenario = GRID.draw(rng, 2000)
    x = scenario["start"]
    ahead = Ahead(x, scenario, GRID, GRID.begin(scenario))
    law = LAWS["adversarial"]
    d = law.draw(gap, rng, law.begin(gap, rng, 2000), ahead)
    assert np.allclose(gap.norm(d), 0.001)
    lowered = GRID.clearance(x + d, scenario)
    for _ in range(40):
        other = GRID.clearance(x + gap.push * gap.boundary(rng, 2000), scenario)
        # where two obstacles are equally near, a gradient knows one of them; distances are not quite linear
        assert np.mean(lowered <= other + 2e-6) > 0.995


class NoClearance(KeepOut):
    """The same task, for which nobody wrote down a clearance."""

    def clearance(self, x: np.ndarray, scenario: dict[str, Any]) -> None:  # type: ignore[override]
        return None

    def observe(self, tally: Any, x: np.ndarray, scenario: dict[str, Any]) -> Any:
        least = np.minimum(tally.least, super().clearance(x, scenario))
        return type(tally)(least, tally.first, self._from_goal(x, scenario), tally.arrived)


def test_without_a_clearance_the_adversary_takes_the_worst_axis() -> None:
    task = NoClearance({}, MODEL.nominal, MODEL.dt)
    gap = GapSet("ball", WEIGHTS, 0.0, 0.05, 50)
    rng = np.random.default_rng(7)
    scenario = task.draw(rng, 500)
    x = scenario["start"]
    tally = task.observe(task.begin(scenario), x, scenario)
    law = LAWS["adversarial"]
    d = law.draw(gap, rng, law.begin(gap, rng, 500), Ahead(x, scenario, task, tally))
    assert np.all(np.sum(d != 0.0, axis=1) == 1)
    axes = [gap.push * sign * np.eye(3)[c] / WEIGHTS[c] for c in range(3) for sign in (1.0, -1.0)]
    after = np.array([task.safety(task.observe(tally, x + axis, scenario)) for axis in axes])
    assert np.allclose(task.safety(task.observe(tally, x + d, scenario)), after.min(axis=0))
    assert task.safety(tally) is tally.least  # what was asked did not change the tally


def test_the_worse_law_crashes_more() -> None:
    gap = GapSet("ball", (1.0, 1.0, 0.0525), 0.0015, 0.06, 50)  # a push of 1.2 mm a step
    crashes = [np.sum(roll_out(CONTROL, GRID, MODEL, gap, law, np.random.default_rng(8), 600).safety < 0.0) for law in LAWS]
    assert crashes[0] < crashes[1] < crashes[2]


# ---------------------------------------------------------------- rollouts


def test_every_step_is_the_model_s_own_plus_a_disturbance_in_the_set() -> None:
    """By hand, one rollout at a time: one period of delay, clipped wheels, an arc."""
    gap = GapSet("ball", (1.0, 1.0, 0.0525), 0.002)
    done = roll_out(CONTROL, GRID, MODEL, gap, "uniform", np.random.default_rng(9), 40, keep=12)
    rng = np.random.default_rng(0)
    for path, scenario in zip(done.paths, done.scenarios, strict=True):
        moved = scenario
        commanded = (0.0, 0.0)
        for k in range(len(path) - 1):
            if k < 100:  # before the moving obstacles' first turn, which nobody can foresee
                asked = CONTROL(path[k : k + 1], GRID.view(moved))[0]
            v, w = commanded
            left, right = (min(max(v + side * w * 0.105 / 2.0, -0.2), 0.2) for side in (-1.0, 1.0))
            v, w = (left + right) / 2.0, (right - left) / 0.105
            x, y, theta = path[k]
            if abs(w) > 1e-9:
                x += v / w * (math.sin(theta + w * 0.033) - math.sin(theta))
                y -= v / w * (math.cos(theta + w * 0.033) - math.cos(theta))
            else:
                x, y = x + v * 0.033 * math.cos(theta), y + v * 0.033 * math.sin(theta)
            d = path[k + 1] - (x, y, theta + w * 0.033)
            d[2] = math.atan2(math.sin(d[2]), math.cos(d[2]))
            if k <= 100:
                assert math.hypot(d[0], d[1], 0.0525 * d[2]) <= 0.002 + 1e-9
            assert -math.pi <= path[k + 1][2] <= math.pi
            commanded = tuple(asked)
            moved = GRID.advance(moved, rng)


def test_a_rollout_s_safety_is_that_of_its_path() -> None:
    task = GridWorld({"turn": 0.0}, MODEL.nominal, MODEL.dt)  # what moves is then foreseeable
    gap = GapSet("ball", (1.0, 1.0, 0.0525), 0.004, 0.1, 50)
    done = roll_out(CONTROL, task, MODEL, gap, "persistent", np.random.default_rng(10), 100, keep=100)
    assert np.any(done.safety < 0.0)
    for path, scenario, safety in zip(done.paths, done.scenarios, done.safety, strict=True):
        tally, moved = task.observe(task.begin(scenario), path[:1], scenario), scenario
        for x in path[1:]:
            moved = task.advance(moved, np.random.default_rng(0))
            tally = task.observe(tally, x[None], moved)
        assert task.safety(tally)[0] == safety


def test_a_seed_gives_the_same_rollouts_again() -> None:
    gap = GapSet("box", (1.0, 1.0, 0.0525), 0.002, 0.01, 50)

    def run(seed: int, n: int, **choices: Any) -> Any:
        return roll_out(still, KEEP_OUT, MODEL, gap, "persistent", np.random.default_rng(seed), n, **choices)

    n = BATCH + 7
    first, again, other = run(1, n), run(1, n, keep=3, progress=lambda done, total: None), run(2, n)
    assert np.array_equal(first.safety, again.safety)
    assert not np.array_equal(first.safety, other.safety)
    assert len(first.safety) == len(first.progress) == n
    assert len(again.paths) == 3
    assert len(np.unique(first.safety)) > n - 10  # no batch repeats another


def test_progress_reaches_the_end() -> None:
    told: list[tuple[float, float]] = []
    gap = GapSet("ball", (1.0, 1.0, 0.0525), 0.002)
    roll_out(still, KEEP_OUT, MODEL, gap, "uniform", np.random.default_rng(1), 20, progress=lambda done, total: told.append((done, total)))
    assert told[-1] == (20.0, 20)
    assert [done for done, _ in told] == sorted(done for done, _ in told)


def test_any_model_with_a_place_can_be_rolled_out() -> None:
    model: ComposedModel = compose(ModelSpec("double_integrator", 0.02))
    task = KeepOut({"steps": 60}, DOUBLE_INTEGRATOR, 0.02)
    gap = GapSet("box", (1.0, 1.0, 0.1, 0.1), 0.001, 0.01, 20)
    for law in LAWS:
        done = roll_out(still, task, model, gap, law, np.random.default_rng(11), 50)
        assert np.all(np.isfinite(done.safety))


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda x, theta: np.zeros((len(x), 3)), r"returned shape \(5, 3\), must be \(5, 2\)"),
        (lambda x, theta: np.full((len(x), 2), math.nan), r"returned \[nan, nan\] in row 0, must be finite"),
        (lambda x, theta: np.full((len(x), 2), math.inf), "must be finite"),
        (lambda x, theta: np.full((len(x), 2), "fast"), "must be numbers"),
        (lambda x, theta: np.full((len(x), 2), 1e308) * np.array([0.0, 1.0]), "state is not finite after step"),
    ],
)
def test_a_controller_that_answers_nonsense_is_stopped(answer: Any, words: str) -> None:
    model = compose(ModelSpec("unicycle", 1e3))
    task = KeepOut({"steps": 5}, model.nominal, 1e3)
    with pytest.raises(ControllerError, match=words), np.errstate(over="ignore", invalid="ignore"):
        roll_out(answer, task, model, GapSet("ball", (1.0, 1.0, 1.0), 0.0), "uniform", np.random.default_rng(1), 5)


def test_a_law_or_weights_that_do_not_exist_are_refused() -> None:
    gap = GapSet("ball", (1.0, 1.0), 0.1)
    with pytest.raises(UsageError, match="'gaussian' is not known, must be one of: uniform, persistent, adversarial"):
        roll_out(still, KEEP_OUT, MODEL, gap, "gaussian", np.random.default_rng(1), 5)
    with pytest.raises(UsageError, match="2 weights, must be one for each of x, y, theta"):
        roll_out(still, KEEP_OUT, MODEL, gap, "uniform", np.random.default_rng(1), 5)
