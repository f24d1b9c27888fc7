"""Promises of the verification (guarantee G2, G8): what passes, what cannot, what is claimed, and how often that is wrong."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2r_runtime.controllers.hosted import batch_control, load
from s2r_runtime.errors import ControllerError, NotEnoughEvidence, UsageError
from s2r_runtime.evidence.bounds import attempt_beta, clopper_pearson_lower, clopper_pearson_upper, sample_size
from s2r_runtime.evidence.seeds import drawn
from s2r_runtime.evidence.statements import worst
from s2r_runtime.evidence.uncertain import GapSet
from s2r_runtime.evidence.verify import not_shown, seed_for, statement, verification_json, verify, verify_in_detail
from s2r_runtime.files.canonical import canonical
from s2r_runtime.messages import Verification
from s2r_runtime.models.composed import compose
from s2r_runtime.profile import load_profile
from s2r_runtime.tasks.keep_out import KeepOut

ROOT = Path(__file__).parent.parent
MODEL = compose(load_profile(ROOT / "profiles" / "robotarium.toml").model)
TASK = KeepOut({"steps": 200, "min_progress": 0.3}, MODEL.nominal, MODEL.dt)
GOOD = batch_control(load(ROOT / "controllers" / "keep_out.py"), 2)
GAP = GapSet("ball", (1.0, 1.0, 0.0525), 0.0015, 0.0016, 50)
CHOICES: dict[str, Any] = {
    "gap_set": GAP,
    "laws": ("uniform", "persistent", "adversarial"),
    "required": ("uniform", "persistent"),
    "n": 0,
    "epsilon": 0.05,
    "beta": 0.05,
    "threshold": 0.0,
    "seed": 7,
    "controller_digest": "sha256:c",
    "task_digest": "sha256:t",
}


def run(control: Any = GOOD, task: Any = TASK, **choices: Any) -> Verification:
    return verify(control, task, MODEL, **{**CHOICES, **choices})


def still(x: np.ndarray, theta: dict[str, Any]) -> np.ndarray:
    return np.zeros((len(x), 2))


def straight(x: np.ndarray, theta: dict[str, Any]) -> np.ndarray:
    """Heads for the goal, whatever stands between."""
    to = theta["goal"] - x[:, :2]
    error = np.arctan2(to[:, 1], to[:, 0]) - x[:, 2]
    error = np.arctan2(np.sin(error), np.cos(error))
    return np.stack([0.15 * np.maximum(np.cos(error), 0.0), np.clip(3.0 * error, -2.0, 2.0)], axis=1)


# ---------------------------------------------------------------- what passes and what doesn't


def test_a_good_controller_passes_with_as_many_scenarios_as_beta_asks_for() -> None:
    result = run()
    assert result.passed
    assert result.reason == ""
    assert [law.law for law in result.laws] == ["uniform", "persistent", "adversarial"]
    for law in result.laws:
        assert law.n == sample_size(0.05, 0.05) == 59
        assert law.failures == 0
        assert law.s_star >= 0.0
        assert law.failure_upper == clopper_pearson_upper(0, 59, 0.05) == pytest.approx(0.05, abs=2e-3)
        assert law.progress_ok
        assert law.required == (law.law != "adversarial")
    assert result.model_digest == MODEL.spec.digest()
    assert (result.radius, result.hold_radius) == (0.0015, 0.0016)


def test_a_controller_that_crashes_does_not_pass_and_the_reason_counts_the_crashes() -> None:
    result = run(straight)
    assert not result.passed
    uniform = result.laws[0]
    assert uniform.s_star < 0.0
    assert 0 < uniform.failures < uniform.n
    assert uniform.failure_upper == clopper_pearson_upper(uniform.failures, uniform.n, 0.05)
    assert f"under uniform {uniform.failures} of 59 rollouts score below 0" in result.reason


def test_standing_still_is_safe_and_no_pass() -> None:
    result = run(still)
    assert all(law.failures == 0 for law in result.laws[:1])
    assert not result.laws[0].progress_ok
    assert not result.passed
    assert "progress requirement does not hold" in result.reason


def test_a_law_that_is_not_required_is_reported_and_does_not_decide() -> None:
    strong = GapSet("ball", (1.0, 1.0, 0.0525), 0.0015, 0.25, 50)
    choices = {"gap_set": strong, "laws": ("uniform", "persistent")}
    one, both = run(required=("uniform",), **choices), run(required=("uniform", "persistent"), **choices)
    assert one.laws[1].failures > 0
    assert one.passed
    assert not both.passed
    assert "under persistent" in both.reason
    assert "uniform" not in both.reason
    assert "Only uniform was required: nothing is shown about a disturbance that persists." in statement(one)
    assert f"Reported and not required: under persistent s* = {worst(one.laws[1].s_star)}" in statement(one)


def test_the_threshold_is_the_least_value_that_passes() -> None:
    least = min(law.s_star for law in run().laws if law.required)
    assert run(threshold=least).passed
    assert not run(threshold=np.nextafter(least, 1.0)).passed


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda x, theta: np.full((len(x), 2), math.nan), "must be finite"),
        (lambda x, theta: np.zeros((len(x), 1)), r"shape \(59, 1\), must be \(59, 2\)"),
    ],
)
def test_a_controller_that_answers_nonsense_has_failed_with_the_reason(answer: Any, words: str) -> None:
    result = run(answer)
    assert not result.passed
    assert result.laws == ()
    assert re.search(words, result.reason)


def test_a_controller_that_raises_now_and_then_has_failed() -> None:
    calls = [0]

    def sometimes(x: np.ndarray, theta: dict[str, Any]) -> np.ndarray:
        calls[0] += 1
        if calls[0] > 250:  # in the second law
            raise ControllerError("moody.py: ZeroDivisionError: division by zero (moody.py line 3)")
        return GOOD(x, theta)

    result = run(sometimes)
    assert not result.passed
    assert [law.law for law in result.laws] == ["uniform"]
    assert result.reason == "under persistent: moody.py: ZeroDivisionError: division by zero (moody.py line 3)"


def test_too_few_scenarios_are_refused_with_how_many_are_missing() -> None:
    with pytest.raises(NotEnoughEvidence, match=r"50 scenarios, 59 are needed for epsilon 0.05 and beta 0.05: 9 more") as caught:
        run(n=50)
    assert caught.value.missing == 9
    assert run(n=80).laws[0].n == 80


@pytest.mark.parametrize(
    ("laws", "required", "words"),
    [
        ((), (), "must be at least one"),
        (("uniform", "uniform"), ("uniform",), "each once"),
        (("uniform",), ("persistent",), "must be at least one of those that are run: uniform"),
        (("uniform", "worst"), ("uniform",), "'worst' is not known"),
    ],
)
def test_laws_that_make_no_sense_are_refused(laws: tuple[str, ...], required: tuple[str, ...], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        run(laws=laws, required=required)


# ---------------------------------------------------------------- seeds


def test_the_seed_of_rollouts_that_cost_nothing_belongs_to_what_is_verified_and_is_no_attempts() -> None:
    seeds = {seed_for("c", "m", "t", 1), seed_for("d", "m", "t", 1), seed_for("c", "n", "t", 1), seed_for("c", "m", "u", 1)}
    seeds |= {seed_for("c", "m", "t", j) for j in range(1, 50)} | {seed_for("cm", "", "t", 1)}
    assert len(seeds) == 4 + 48 + 1
    assert all(2**48 <= seed < 2**63 for seed in seeds)
    assert all(0 <= drawn() < 2**48 for _ in range(100))
    assert seed_for("c", "m", "t", 1) == seed_for("c", "m", "t", 1)


def test_a_verification_repeated_from_its_seed_is_the_same_in_every_bit() -> None:
    first, details = verify_in_detail(GOOD, TASK, MODEL, **CHOICES, keep=2)
    again, _ = verify_in_detail(GOOD, TASK, MODEL, **CHOICES, progress=lambda done, total, law: None)
    assert canonical(first) == canonical(again)
    assert canonical(run(seed=8)) != canonical(first)
    assert [d.law for d in details] == ["uniform", "persistent", "adversarial"]
    assert [len(d.rollouts.safety) for d in details] == [59, 59, 59]
    assert all(len(d.rollouts.paths) == 2 for d in details)
    assert min(details[0].rollouts.safety) == first.laws[0].s_star


def test_a_law_s_scenarios_do_not_depend_on_which_other_laws_are_run() -> None:
    alone = run(laws=("persistent",), required=("persistent",))
    assert alone.laws[0].s_star == run().laws[1].s_star


# ---------------------------------------------------------------- what is claimed


def test_the_statement_names_laws_numbers_and_no_more() -> None:
    result = run(beta=attempt_beta(0.05, 1))
    text = statement(result)
    n = sample_size(0.05, attempt_beta(0.05, 1))
    assert n == 82
    assert f"uniform (s* = {worst(result.laws[0].s_star)}, N = {n}), persistent (s* =" in text
    assert "with confidence 98.5094 % a new rollout of the uncertain model (radius 0.0015, hold gap 0.0016)" in text  # rounded down
    assert 1.0 - 0.95**n == pytest.approx(0.985095, abs=1e-6)
    assert "probability at most 0.05" in text
    assert "robot" not in text
    assert "read side by side" in text
    assert statement(run(straight)).startswith("Not passed: under uniform")
    assert any("do not compose" in line for line in not_shown())


def test_the_json_has_what_the_command_line_promises() -> None:
    answer = verification_json(run())
    assert {"passed", "radius", "threshold", "epsilon", "beta", "seed", "laws", "statement", "not_shown"} <= set(answer)
    for law in answer["laws"].values():
        assert {"n", "s_star", "failures", "failure_upper"} <= set(law)
    assert canonical(answer)


class Lottery:
    """A task whose safety is one uniform number a scenario: P(s < a) = a, whatever drives."""

    name = "lottery"
    horizon = 1
    PARAMETERS: dict[str, tuple[float, str]] = {}

    def draw(self, rng: np.random.Generator, n: int) -> dict[str, Any]:
        return {"start": np.zeros((n, 3)), "prize": rng.random(n)}

    def advance(self, scenario: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        return scenario

    def view(self, scenario: dict[str, Any]) -> dict[str, Any]:
        return scenario

    def clearance(self, x: np.ndarray, scenario: dict[str, Any]) -> None:
        return None

    def begin(self, scenario: dict[str, Any]) -> Any:
        return scenario["prize"]

    def observe(self, tally: Any, x: np.ndarray, scenario: dict[str, Any]) -> Any:
        return tally

    def safety(self, tally: Any) -> Any:
        return tally

    def progress(self, tally: Any) -> Any:
        return tally

    def done(self, tally: Any) -> Any:
        return np.zeros(len(tally), dtype=np.bool_)

    def progress_ok(self, progress: np.ndarray) -> bool:
        return True


def test_the_statement_is_wrong_no_more_often_than_it_says() -> None:
    """P(s < s*) is s* itself here. Whole verifications, each with the seed of its attempt."""
    repetitions, epsilon, beta = 1500, 0.1, 0.05
    choices = {"laws": ("uniform",), "required": ("uniform",), "epsilon": epsilon, "beta": beta}
    seeds = (seed_for("c", "m", "t", attempt) for attempt in range(1, repetitions + 1))
    stars = np.array([run(still, Lottery(), seed=seed, **choices).laws[0].s_star for seed in seeds])
    missed = int(np.sum(stars > epsilon))
    assert clopper_pearson_lower(missed, repetitions, 1e-3) <= beta
    assert missed > 0  # and the bound is no idle one: N is the least that keeps it
    # a planted fault, best of two seeds, is found
    shopped = int(np.sum(np.maximum(stars[::2], stars[1::2]) > epsilon))
    assert clopper_pearson_lower(shopped, repetitions // 2, 1e-3) > beta


def test_a_pass_is_wrong_no_more_often_than_it_says() -> None:
    """A controller that fails slightly more often than epsilon passes with probability at most beta."""
    repetitions, epsilon, beta = 1500, 0.1, 0.05
    choices = {"laws": ("uniform", "persistent"), "required": ("uniform", "persistent"), "epsilon": epsilon, "beta": beta}
    passed = sum(run(still, Lottery(), seed=seed, threshold=epsilon * 1.001, **choices).passed for seed in range(repetitions))
    assert clopper_pearson_lower(passed, repetitions, 1e-3) <= beta
