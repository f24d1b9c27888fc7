"""Driving that exceeded what sampling can see refuses the next deployment, until a person says that the robot was mended."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from core_rig import Rig, answers, of
from daemon_rig import Rig as DaemonRig

from s2r_runtime.core import driven, stream
from s2r_runtime.core import reducer as core
from s2r_runtime.core.stream import BINS, bin_of
from s2r_runtime.evidence.bounds import anytime_evidence, clopper_pearson_lower
from s2r_runtime.messages import REFUSED_FIRST, AttemptSpent, Measured, Persist, StartController, StartJob


def drive(rig: Rig, discrepancies: list[float]) -> None:
    for n, d in enumerate(discrepancies, 1):
        rig.feed(Measured(rig.t, rig.seq, d, "", 1.0, n, 1))


def driven_twice(discrepancies: list[float], **second: Any) -> Rig:
    """An epoch that drove with these discrepancies, and the gap of the next one."""
    rig = Rig()
    rig.driving()
    drive(rig, discrepancies)
    rig.request("undeploy")
    rig.gap(**second)
    return rig


def test_a_gap_below_what_driving_showed_carries_no_deployment_and_costs_nothing() -> None:
    rig = driven_twice([0.014] * 8 + [0.004] * 40)
    attempts = rig.state.memory.attempts
    outputs = rig.request("deploy", digest="controller")
    (answer,) = answers(rig)[max(answers(rig))]
    assert (answer.exit_code, of(outputs, StartJob), of(outputs, StartController)) == (1, [], [])
    assert answer.text.startswith("refused: driving_exceeds_sampling: in epoch 1 the discrepancy's 0.97-quantile while driving was above")
    assert rig.state.memory.attempts == attempts
    shown = core.status(rig.state)["driven"]
    assert isinstance(shown, dict)
    assert (shown["epoch"], shown["n"]) == (1, 48)
    assert 1.0 <= shown["ratio_lower"] <= 1.4
    assert shown["ratio_upper"] is None or shown["ratio_upper"] >= shown["ratio_lower"]


def test_no_attempt_is_spent_on_a_certificate_that_may_not_be_deployed() -> None:
    rig = driven_twice([0.014] * 8)
    spent = rig.state.memory.attempts
    outputs = rig.request("verify", digest="controller")
    (answer,) = answers(rig)[max(answers(rig))]
    assert (answer.exit_code, of(outputs, AttemptSpent), rig.state.memory.attempts) == (1, [], spent)
    assert answer.text.startswith("refused: driving_exceeds_sampling: ")
    rig.request("clear", text=driven.REASON)
    assert of(rig.request("verify", digest="controller"), AttemptSpent)


def test_an_audit_of_before_verifies_it_as_it_was() -> None:
    rig = Rig(rules=REFUSED_FIRST - 1)
    rig.driving()
    drive(rig, [0.014] * 8)
    rig.request("undeploy")
    rig.gap()
    assert of(rig.request("verify", digest="controller"), AttemptSpent)


def test_it_is_remembered_over_a_restart_and_forgotten_when_a_person_clears_it() -> None:
    memory = of(driven_twice([0.014] * 8).outputs, Persist)[-1].memory
    rig = Rig(memory, campaign_digest=memory.campaign_digest)
    rig.observe()
    rig.request("deploy", digest="controller")
    rig.request("clear", text=driven.REASON)
    assert [given[0].exit_code for given in answers(rig).values()] == [1, 0]
    assert not verifies(rig)
    rig.request("deploy", digest="controller")
    assert verifies(rig)
    assert of(rig.outputs, Persist)[-1].memory.driven == ()


def verifies(rig: Rig) -> bool:
    return any(job.purpose == "deploy" for job in rig.state.jobs)


@pytest.mark.parametrize(
    ("discrepancies", "second"),
    [
        ([0.004] * 400, {}),
        ([0.014] + [0.004] * 400, {}),  # an outlier is no quantile
        ([0.014] * 8, {"radius": 0.02}),  # sampling has seen as much now
    ],
)
def test_what_sampling_covers_is_not_refused(discrepancies: list[float], second: dict[str, Any]) -> None:
    rig = driven_twice(discrepancies, **second)
    rig.request("deploy", digest="controller")
    assert verifies(rig)


@pytest.mark.parametrize("change", [{"weights": (2.0, 2.0, 2.0)}, {"set": "box"}, {"model_digest": "another"}, {"epsilon": 0.05}])
def test_what_does_not_compare_refuses_nothing(change: dict[str, Any]) -> None:
    rig = driven_twice([0.014] * 8)
    memory, settings = rig.state.memory, rig.settings
    assert driven.refusal(memory, settings)
    assert memory.gap is not None
    other = msgspec.structs.replace(memory, gap=msgspec.structs.replace(memory.gap, **change))
    assert not driven.refusal(other, settings)
    assert driven.status(other, settings) is None


def test_of_several_epochs_the_worst_is_kept() -> None:
    rig = driven_twice([0.014] * 8)
    rig.request("clear", text=driven.REASON)
    rig.deploying()
    drive(rig, [0.004] * 300)
    rig.request("undeploy")
    rig.gap()
    assert [one.epoch for one in rig.state.memory.driven] == [2]
    rig.deploying()
    drive(rig, [0.014] * 8)
    rig.request("undeploy")
    rig.gap()
    rig.gap(radius=0.012)
    assert [one.epoch for one in rig.state.memory.driven] == [3]


def test_an_epoch_of_another_model_between_them_forgets_nothing() -> None:
    rig = driven_twice([0.014] * 8)
    memory, settings = rig.state.memory, rig.settings
    assert memory.gap is not None
    for number in range(3):  # each drove a step, which establishes no limit
        other = msgspec.structs.replace(memory.gap, model_digest=f"other {number % 2}")
        drove = msgspec.structs.replace(memory, gap=other, watch_counts=(1,) + (0,) * (BINS - 1))
        memory = msgspec.structs.replace(memory, driven=driven.kept(drove, settings.alpha))
    assert len(memory.driven) == 3
    assert driven.refusal(memory, settings)


def test_an_audit_of_before_remembers_nothing() -> None:
    rig = Rig(rules=2)
    rig.driving()
    drive(rig, [0.014] * 8)
    rig.request("undeploy")
    rig.gap()
    assert rig.state.memory.driven == ()


@pytest.mark.parametrize("epsilon", [0.03, 0.3])
def test_the_lower_limit_is_the_mirror_of_the_bound_from_above(epsilon: float) -> None:
    """Against `bounds`, which computes the same mixture with scipy: few of n at or below the edge refute that 1 - epsilon always are."""
    alpha, n = 0.01, 60
    for above in range(n + 1):
        counts = [0] * BINS
        counts[bin_of(0.5, 1.0)], counts[bin_of(1.5, 1.0)] = n - above, above
        found = stream.quantile_lower(tuple(counts), 1.0, epsilon, alpha)
        assert (found is not None and found >= 1.0) == (anytime_evidence(n - above, n, 1.0 - epsilon) >= -math.log(alpha)), above


@pytest.mark.slow
def test_it_lies_above_the_quantile_at_any_time_no_more_often_than_alpha() -> None:
    """500 drives of 300 steps, looked at after each: the true quantile is below the lower limit in at most alpha of them."""
    rng, epsilon, alpha, runs = np.random.default_rng(5), 0.1, 0.05, 500
    true, wrong = 1.0 - epsilon, 0
    for d in rng.uniform(size=(runs, 300)):
        counts, missed = [0] * BINS, False
        for value in d:
            counts[bin_of(value, 0.6)] += 1
            lower = stream.quantile_lower(tuple(counts), 0.6, epsilon, alpha)
            missed = missed or (lower is not None and lower >= true)
        wrong += missed
    assert clopper_pearson_lower(wrong, runs, 0.001) <= alpha


def test_a_daemon_refuses_before_it_drives_says_so_and_the_audit_holds(tmp_path: Path) -> None:
    rig = DaemonRig(tmp_path)
    try:
        rig.start_robot()
        rig.start()
        path = rig.controller("    return np.tile([0.05, 0.5], (len(x), 1))\n")
        rig.until(lambda: rig.status()["observation"])
        first = rig.ask("deploy", path=str(path), certificate=rig.certificate(path, radius=1e-7, verified=0.02, epoch=1))
        assert first["exit_code"] == 0, first
        rig.until(lambda: rig.status()["alarm"])
        rig.ask("clear", text="watch_alarm")
        again = rig.certificate(path, radius=1e-7, verified=0.02, epoch=2)
        refused = rig.ask("deploy", path=str(path), certificate=again)
        assert refused["exit_code"] == 1
        assert "driving_exceeds_sampling" in refused["text"], refused
        assert rig.status()["driven"]["ratio_lower"] > 1.0
        said = rig.s2r("status", "--socket", str(rig.socket)).stdout
        assert "driving/gap" in said
        assert rig.ask("clear", text="driving_exceeds_sampling")["exit_code"] == 0
        assert rig.ask("deploy", path=str(path))["exit_code"] == 0
        rig.stop()
        found = json.loads(rig.s2r("audit", *map(str, rig.log_files()), "--key", str(rig.state / "key.pub"), "--json").stdout)
        assert (found["ok"], found["first_difference"]) == (True, None), found
    finally:
        rig.close()
