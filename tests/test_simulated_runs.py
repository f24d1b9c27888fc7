"""Runs rolled out again: the same scenario from the same seed, fresh ones from the same start, and no model that has seen the runs."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from certificate_rig import KEY, PROFILE, PUBLIC, Evidence, evidence

from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.evidence.disturbance import GapSet
from s2r_runtime.evidence.logged_deployments import Run
from s2r_runtime.evidence.logged_scenarios import LoggedScenario, SimulatedScores
from s2r_runtime.evidence.real_means import mean_with_simulation, optimism
from s2r_runtime.evidence.scores import SAFE, Score
from s2r_runtime.evidence.seen_rows import sketch
from s2r_runtime.evidence.simulated_runs import fitted_on_runs, roll_out_logged, with_real
from s2r_runtime.evidence.statements import of_simulated
from s2r_runtime.evidence.trials import Found, trials
from s2r_runtime.hookspecs import Scenario
from s2r_runtime.messages import Trials
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import parse_profile
from s2r_runtime.tasks.stl_task import StlTask
from s2r_runtime.trust.certificate import load, sign

MODEL = compose(ModelSpec("unicycle", 0.1))
STARTS = {"theta": {"normal": [0.0, 1.0]}}
TASK = StlTask({"horizon": 0.3, "metric": "always (theta < 0.5)", "progress": "none", "start": STARTS}, MODEL.nominal, 0.1)
STILL = GapSet("ball", (1.0, 1.0, 1.0), 0.0, 0.0, 1)


def stand_still(x: np.ndarray, theta: Scenario) -> np.ndarray:
    return np.zeros((len(x), 2))


def simulated(starts: list[float], score: str = "safety", rollouts: int = 3, seed: int = 5) -> SimulatedScores:
    scenarios = [LoggedScenario(1, k, (0.0, 0.0, theta)) for k, theta in enumerate(starts)]
    return roll_out_logged(stand_still, TASK, MODEL, STILL, "uniform", scenarios, score=score, threshold=0.0, rollouts=rollouts, seed=seed)


def test_a_robot_that_stands_still_scores_what_its_start_gives() -> None:
    found = simulated([0.1, 0.7])
    assert found.own == [pytest.approx([0.4] * 3), pytest.approx([-0.2] * 3)]
    assert simulated([0.1, 0.7], "safe").own == [[1.0] * 3, [0.0] * 3]


def test_the_same_seed_gives_the_same_rollouts() -> None:
    assert simulated([0.1, 0.2]) == simulated([0.1, 0.2])


def test_without_rollouts_or_with_another_score_it_is_refused() -> None:
    with pytest.raises(UsageError, match="must be at least 1"):
        simulated([0.1], rollouts=0)
    with pytest.raises(UsageError, match="must be one of: safe, safety, progress"):
        simulated([0.1], "speed")


def test_mean_and_optimism_are_those_of_the_mean_scores_in_the_unit_of_the_score() -> None:
    rng = np.random.default_rng(1)
    real = rng.uniform(10.0, 20.0, 40)
    own = real[:, None] + rng.normal(0.0, 0.5, (40, 4)) - 1.0
    fresh = rng.uniform(9.0, 19.0, (40, 4))
    score = Score("time", 0.0, 30.0, better="low")
    found, lines = with_real(
        real.tolist(), SimulatedScores(own.tolist(), fresh.tolist()), score, law="uniform", radius=0.1, seed=3, beta=0.1
    )
    merit = 1.0 - real / 30.0
    bare = mean_with_simulation(merit, 1.0 - own.mean(axis=1) / 30.0, fresh=1.0 - fresh.mean(axis=1) / 30.0, beta=0.1)
    assert lines == ()
    assert found.mean.lower == pytest.approx(30.0 * (1.0 - bare.upper))
    assert found.mean.running_upper == pytest.approx(30.0 * (1.0 - bare.running_lower))
    assert found.mean.lower < 15.0 < found.mean.upper
    assert found.optimism.mean == pytest.approx(np.mean(real - own.mean(axis=1)))
    assert found.optimism.upper == pytest.approx(30.0 * optimism(merit, 1.0 - own.mean(axis=1) / 30.0, beta=0.1).upper)
    assert "scores better than the robot by at most" in of_simulated(found)[1]


def test_scores_outside_the_range_get_a_line_each_way() -> None:
    given = SimulatedScores([[1.0, None], [0.0, 0.0]], [[0.5, 0.5], [3.0, 0.5]])
    found, lines = with_real([1.0, 7.0], given, Score("progress"), law="uniform", radius=0.0, seed=3, beta=0.1)
    assert found.outside == 1
    assert [line.split(";")[1].strip() for line in lines] == [
        "each counts as the worst value, 0",
        "each counts as the best value, 1",
        "each counts as the best value, 1",
    ]
    with pytest.raises(NotEnoughEvidence):
        with_real([], SimulatedScores([], []), SAFE, law="uniform", radius=0.0, seed=3, beta=0.1)


def test_a_model_that_was_fitted_on_the_runs_is_noticed() -> None:
    rng = np.random.default_rng(2)
    run = np.cumsum(rng.normal(0.0, 0.1, (300, 3)), axis=0)
    other = np.cumsum(rng.normal(0.0, 0.1, (300, 3)), axis=0)
    fitted = sketch([run], (2,))
    rows = [[tuple(map(float, x)) for x in one] for one in (run[40:60], other)]
    assert fitted_on_runs(fitted, rows[:1])
    assert not fitted_on_runs(fitted, rows[1:])
    assert not fitted_on_runs(("sha256:a digest",), rows)


def with_runs(safe: list[bool], own: float, most: float = 1.0) -> tuple[Trials, Evidence]:
    """Trials of the certificate rig's controller whose rollouts are all `own` on average; and its evidence under `max_optimism`."""
    parts = evidence()
    text = PROFILE.replace("[verification]", f"[verification]\nmax_optimism = {most}")
    parts.profile = parse_profile(text, "test.toml", Path())
    found = Found([(Run(k, k, safety=1.0 if ok else -1.0, driven=True, over=True), ok) for k, ok in enumerate(safe)])
    digests = {
        "controller_digest": parts.controller.digest,
        "task_digest": parts.profile.task_digest(),
        "model_digest": parts.profile.model.digest(),
    }
    scores = SimulatedScores([[own]] * len(safe), [[own]] * len(safe))
    rolled, _ = with_real([float(ok) for ok in safe], scores, SAFE, law="uniform", radius=0.004, seed=1, beta=0.05)
    return msgspec.structs.replace(trials(found, **digests, beta=0.05), simulated=rolled), parts


@pytest.mark.parametrize(("safe", "issued"), [([True] * 60, True), ([True] * 40 + [False] * 20, False), ([True] * 10, False)])
def test_beyond_the_demanded_optimism_there_is_no_certificate(safe: list[bool], *, issued: bool) -> None:
    runs, parts = with_runs(safe, own=1.0, most=0.1)
    if issued:
        signed = parts.issue(trials=runs)
        assert signed.trials == runs
        assert any(line.startswith("Optimism (G12).") for line in signed.shown)
    else:
        with pytest.raises(NotEnoughEvidence, match=r"by at most .* only .*, and verification.max_optimism is 0.1"):
            parts.issue(trials=runs)
    with pytest.raises(NotEnoughEvidence, match="nothing is known of the model's optimism"):
        parts.issue()


def test_a_certificate_keeps_its_bytes_with_and_without_simulated_runs() -> None:
    runs, parts = with_runs([True] * 60, own=1.0)
    for given in (runs, msgspec.structs.replace(runs, simulated=None)):
        data = sign(parts.issue(trials=given), KEY)
        assert load(data, [PUBLIC]).trials == given
        assert (b'"simulated"' in data) == (given.simulated is not None)
    wrong = msgspec.structs.replace(runs, simulated=msgspec.structs.replace(runs.simulated, rollouts=0))
    with pytest.raises(NotEnoughEvidence, match="the trials do not carry their statement"):
        parts.issue(trials=wrong)
