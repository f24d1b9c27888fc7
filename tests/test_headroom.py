"""How far above the gap a controller still passes: found by halving, stated with the confidence that the search leaves."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from s2r_runtime.audit.evidence import _radii_problem
from s2r_runtime.core.headroom import STEPS, follows, grid, search
from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.evidence.bounds import clopper_pearson_lower, clopper_pearson_upper, sample_size
from s2r_runtime.evidence.statements import confidence
from s2r_runtime.evidence.uncertain import GapSet, roll_out
from s2r_runtime.evidence.verify import statement, verify
from s2r_runtime.messages import RadiusTried, StartJob, Verification
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.tasks.stl_task import StlTask

MODEL = compose(ModelSpec("double_integrator", 0.1))
TASK = StlTask(
    {"metric": "always (abs(x) < 1)", "progress": "none", "horizon": 3.0, "start": {"x": [-0.2, 0.2], "vx": [-0.1, 0.1]}},
    MODEL.nominal,
    MODEL.dt,
)
EPSILON, BETA = 0.05, 0.05


def steady(x: np.ndarray, theta: dict[str, Any]) -> np.ndarray:
    return -np.column_stack([x[:, 0] + 1.5 * x[:, 2], x[:, 1] + 1.5 * x[:, 3]])


def run(most: float, least: float = 0.0, control: Any = steady, **choices: Any) -> Verification:
    settings: dict[str, Any] = {
        "gap_set": GapSet("ball", (1.0, 1.0, 0.3, 0.3), most, 3.0 * most, 10),
        "laws": ("uniform", "persistent", "adversarial"),
        "required": ("uniform", "persistent"),
        "n": 0,
        "epsilon": EPSILON,
        "beta": BETA,
        "threshold": 0.0,
        "seed": 7,
        "controller_digest": "controller",
        "task_digest": "task",
        "least_radius": least,
    }
    return verify(control, TASK, MODEL, **{**settings, **choices})


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8])
def test_the_search_finds_the_edge_wherever_it_is_and_asks_little(count: int) -> None:
    for edge in range(-1, count):
        asked: list[int] = []

        def passes(at: int, edge: int = edge, asked: list[int] = asked) -> bool:
            asked.append(at)
            return at <= edge

        assert search(count, passes) == (edge if edge >= 0 else None)
        assert len(set(asked)) == len(asked) <= 1 + math.ceil(math.log2(count))
        tried = [RadiusTried(at, 0.0, at <= edge, 0.0) for at in asked]
        assert follows(tried, count)
        assert not follows(tried[:-1], count)
        assert not follows([*tried, RadiusTried(0, 0.0, True, 0.0)], count)
        if edge < count - 1 and count > 1:
            assert not follows([msgspec.structs.replace(tried[0], passed=True), *tried[1:]], count)


def test_the_grid_goes_from_what_will_do_to_what_is_asked_for() -> None:
    radii = grid(0.02, 0.08)
    assert (radii[0], radii[-1], len(radii)) == (0.02, 0.08, STEPS)
    assert np.allclose(np.diff(np.log(radii)), np.log(4.0) / (STEPS - 1))
    assert grid(0.0, 0.08) == grid(0.08, 0.08) == (0.08,)
    assert grid(0.0, 0.0) == (0.0,)


def test_the_radius_reported_is_one_at_which_it_passes_by_itself_and_the_next_is_not() -> None:
    found = run(0.3, 0.01)
    radii = grid(0.01, 0.3)
    assert found.passed
    assert found.radius in radii[1:-1]
    assert found.hold_radius == pytest.approx(3.0 * found.radius)
    n = sample_size(EPSILON, BETA / STEPS)
    assert {law.n for law in found.laws} == {n}
    alone = run(found.radius, n=n, beta=BETA / STEPS)
    assert alone.passed
    assert [law.s_star for law in alone.laws] == pytest.approx([law.s_star for law in found.laws], rel=1e-9)
    assert not run(radii[radii.index(found.radius) + 1], n=n, beta=BETA / STEPS).passed
    assert [law.law for law in found.laws] == ["uniform", "persistent", "adversarial"]
    for law in found.laws:
        assert law.failure_upper == clopper_pearson_upper(law.failures, n, BETA / STEPS)


def test_a_controller_that_passes_at_the_most_needs_one_run_and_one_that_fails_at_the_least_is_refused_there() -> None:
    easy = run(0.02, 0.01)
    assert (easy.passed, easy.radius, [one.index for one in easy.tried]) == (True, 0.02, [STEPS - 1])
    hard = run(5.0, 1.0)
    assert not hard.passed
    assert hard.radius == 1.0
    assert not any(one.passed for one in hard.tried)
    assert len(hard.laws) == 3
    assert "Nothing is claimed for this controller at radius 1" in statement(hard)


def test_the_statement_says_what_the_search_cost() -> None:
    found = run(0.3, 0.01)
    assert f"The radius is the largest of {STEPS}, fixed beforehand" in statement(found)
    n = sample_size(EPSILON, BETA / STEPS)
    assert f"with confidence {confidence(STEPS * (1.0 - EPSILON) ** n)}" in statement(found)


def test_too_few_scenarios_for_the_shares_are_refused() -> None:
    with pytest.raises(NotEnoughEvidence, match="more"):
        run(0.3, 0.01, n=sample_size(EPSILON, BETA))


def test_a_controller_that_raises_has_failed_wherever_it_was_looked_at() -> None:
    def broken(x: np.ndarray, theta: dict[str, Any]) -> np.ndarray:
        return np.full((len(x), 2), np.nan)

    found = run(0.3, 0.01, broken)
    assert not found.passed
    assert "must be finite" in found.reason
    assert found.radius == 0.01


def searched(fails: list[float], n: int, rng: np.random.Generator) -> int | None:
    """The index that a search ends with where a rollout fails with these probabilities."""
    return search(len(fails), lambda at: bool(rng.random() < (1.0 - fails[at]) ** n))


def test_the_search_keeps_its_confidence_and_would_not_without_paying_for_it() -> None:
    repetitions, sure = 20_000, 1e-3
    just_too_bad = [EPSILON * 1.0001] * STEPS
    rising = [0.0, 0.0, 0.0, 0.0, *just_too_bad[4:]]
    for fails in (just_too_bad, rising):
        for share, holds in ((BETA / STEPS, True), (BETA, False)):
            rng, n = np.random.default_rng(4), sample_size(EPSILON, share)
            found = [searched(fails, n, rng) for _ in range(repetitions)]
            missed = sum(at is not None and fails[at] > EPSILON for at in found)
            assert (clopper_pearson_lower(missed, repetitions, sure) <= BETA) == holds, (fails, share, missed)


def test_an_audit_finds_radii_that_are_not_those_of_the_search() -> None:
    job = StartJob(1, 1, "verify", 1, "controller", 0.3, 0.9, 1, 7, BETA, least_radius=0.01)
    found = run(0.3, 0.01)
    assert _radii_problem(found, job) == ""
    radii = grid(0.01, 0.3)
    better = radii.index(found.radius) + 1
    higher = msgspec.structs.replace(found, radius=radii[better], hold_radius=3.0 * radii[better])
    assert "not the largest that passed" in _radii_problem(higher, job)
    assert "radii that were ordered" in _radii_problem(msgspec.structs.replace(found, split=1), job)
    assert "radii that were ordered" in _radii_problem(msgspec.structs.replace(found, radius=found.radius * 1.001), job)
    assert "not those of the search" in _radii_problem(msgspec.structs.replace(found, tried=found.tried[1:]), job)
    assert _radii_problem(run(0.3), msgspec.structs.replace(job, least_radius=0.0)) == ""


def test_rollouts_are_given_up_once_one_has_failed_for_good_and_never_otherwise() -> None:
    def crossing(x: np.ndarray, theta: dict[str, Any]) -> np.ndarray:
        return np.full((len(x), 2), 1.0)

    settled = StlTask({"metric": "always (x < 0.5)", "progress": "none", "horizon": 3.0, "ends": "x > 0.5"}, MODEL.nominal, MODEL.dt)
    gap = GapSet("ball", (1.0,) * 4, 0.001)
    seen = []
    for below in (-np.inf, 0.0, -9.0):
        steps: list[int] = []

        def counted(x: np.ndarray, theta: dict[str, Any], steps: list[int] = steps) -> np.ndarray:
            steps.append(len(x))
            return crossing(x, theta) * np.linspace(0.2, 1.0, len(x))[:, None]

        found = roll_out(counted, settled, MODEL, gap, "uniform", np.random.default_rng(1), 20, give_up_below=below)
        seen.append((len(steps), bool(np.any(found.safety < 0.0))))
    assert seen[0][1]
    assert seen[1][1]
    assert seen[2] == seen[0]
    assert seen[1][0] < seen[0][0] - 5
    waiting = StlTask({"metric": "always (x < 0.5)", "progress": "none", "horizon": 3.0}, MODEL.nominal, MODEL.dt)
    whole = [
        roll_out(crossing, waiting, MODEL, gap, "uniform", np.random.default_rng(1), 20, give_up_below=below).safety
        for below in (-np.inf, 0.0)
    ]
    assert np.array_equal(*whole)
