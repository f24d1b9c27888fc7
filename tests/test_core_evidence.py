"""What the core believes of a gap, of a verification and of a certificate: each condition alone, at its bound and beside it."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from core_rig import GAP, Rig, memory, one

from s2r_runtime.core import certificates, gaps, ledger
from s2r_runtime.core.certificates import ROUNDING
from s2r_runtime.core.state import Job, Turn
from s2r_runtime.messages import SERIAL, CertificateFacts, CertificateStored, StartController, StartJob, Verification

replace = msgspec.structs.replace
ENOUGH = replace(GAP, n=161)
BESIDE, WITHIN = 1.5 * ROUNDING, 0.5 * ROUNDING


def turn_of(rig: Rig) -> Turn:
    return Turn(rig.state, rig.settings, rig.t)


def epsilon_for(probability: float, n: int) -> float:
    """The violation of which n scenarios leave exactly this probability."""
    return -math.expm1(math.log(probability) / n)


# ---------------------------------------------------------------- verifications


class Asked:
    """A verification that is under way, and what the core would say to a result of it."""

    def __init__(self, **changes: Any) -> None:
        self.rig = Rig(**changes)
        self.rig.gap()
        outputs = self.rig.request("deploy", digest="controller")
        self.job: Job = self.rig.state.jobs[0]
        self.good = self.rig.result(one(outputs, StartJob))

    def problem(self, v: Verification | None = None, job: Job | None = None) -> str:
        return certificates._result_problem(turn_of(self.rig), job or self.job, v or self.good)

    def with_law(self, **changes: Any) -> Verification:
        """The second law is otherwise."""
        return replace(self.good, laws=(self.good.laws[0], replace(self.good.laws[1], **changes)))


@pytest.fixture(scope="module")
def asked() -> Asked:
    return Asked()


def test_a_good_result_has_no_problem(asked: Asked) -> None:
    assert asked.problem() == ""
    assert asked.problem(asked.with_law(s_star=0.0)) == ""  # exactly at the threshold


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"passed": False}, "the law persistent did not pass"),
        ({"progress_ok": False}, "the law persistent did not pass"),
        ({"s_star": -1e-12}, "the law persistent did not pass"),
        ({"s_star": math.nan}, "the law persistent did not pass"),
        ({"required": False}, "a required law was not run"),
        ({"law": "another"}, "a required law was not run"),
        ({"n": 0}, "0 scenarios are too few for the share of attempt 1"),
        ({"n": 100}, "100 scenarios are too few for the share of attempt 1"),
    ],
    ids=str,
)
def test_one_law_that_fell_short_is_enough(asked: Asked, changes: dict[str, Any], problem: str) -> None:
    assert asked.problem(asked.with_law(**changes)) == problem


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"passed": False}, "it did not pass"),
        ({"passed": False, "reason": "too slow"}, "too slow"),
        ({"controller_digest": "another"}, "the result is of another controller, model or task"),
        ({"model_digest": "another"}, "the result is of another controller, model or task"),
        ({"task_digest": "another"}, "the result is of another controller, model or task"),
        ({"attempt": 2}, "the result is of attempt 2"),
        ({"epsilon": 0.0}, "its numbers make no sense"),
        ({"epsilon": 1.0}, "its numbers make no sense"),
        ({"epsilon": 1.5}, "its numbers make no sense"),
        ({"epsilon": math.nan}, "its numbers make no sense"),
        ({"radius": math.inf}, "it was verified at inf, less than 0.01"),
        ({"radius": math.nan}, "it was verified at nan, less than 0.01"),
        ({"hold_radius": math.inf}, "it was verified at inf, less than 0.1"),
    ],
    ids=str,
)
def test_a_result_that_is_another_or_makes_no_sense_is_none(asked: Asked, changes: dict[str, Any], problem: str) -> None:
    found = asked.problem(replace(asked.good, **changes))
    assert found == problem or (problem.startswith("it was verified") and found.startswith(problem))


def test_without_a_required_law_nothing_passed() -> None:
    asked = Asked(required_laws=())
    none = replace(asked.good, laws=tuple(replace(law, required=False) for law in asked.good.laws))
    assert asked.problem(none) == "it did not pass"


def test_the_least_radius_and_its_share_of_the_hold_gap_will_do_and_nothing_below(asked: Asked) -> None:
    job, good = asked.job, asked.good
    assert job.least_radius < job.radius
    least, hold = job.least_radius, job.hold_radius * job.least_radius / job.radius
    assert asked.problem(replace(good, radius=least, hold_radius=hold)) == ""
    assert asked.problem(replace(good, radius=least * (1 - ROUNDING), hold_radius=hold * (1 - ROUNDING))) == ""
    assert "less than" in asked.problem(replace(good, radius=least * (1 - BESIDE), hold_radius=hold))
    assert "less than" in asked.problem(replace(good, radius=least, hold_radius=hold * (1 - BESIDE)))
    without = replace(job, least_radius=0.0)
    assert "less than" in asked.problem(replace(good, radius=least, split=1), without)


def test_a_gap_of_nothing_asks_for_its_whole_hold_gap(asked: Asked) -> None:
    job = replace(asked.job, radius=0.0, least_radius=0.0, hold_radius=0.1)
    nothing = replace(asked.good, radius=0.0, split=1)
    assert asked.problem(replace(nothing, hold_radius=0.1), job) == ""
    assert asked.problem(replace(nothing, hold_radius=0.09), job) == "it was verified at 0.09, less than 0.1"


def test_scenarios_are_enough_down_to_the_last_digits_of_the_share(asked: Asked) -> None:
    n, split = asked.good.laws[0].n, asked.good.split
    share = ledger.share(asked.rig.settings.beta, 1) / split
    for slack, fits in ((WITHIN, True), (BESIDE, False)):
        v = replace(asked.good, epsilon=epsilon_for(share * (1 + slack), n))
        assert asked.problem(v) == ("" if fits else f"{n} scenarios are too few for the share of attempt 1")


def test_a_split_that_was_not_fixed_beforehand_is_refused(asked: Asked) -> None:
    radii = asked.good.split
    assert asked.problem(replace(asked.good, split=1)) == f"its beta is split among 1 radii, {radii} were fixed beforehand"


def test_no_attempt_is_begun_without_a_gap() -> None:
    rig = Rig()
    with pytest.raises(AssertionError, match="a verification without a gap"):
        certificates.begin_verification(turn_of(rig), "verify", "controller", 1)


def test_what_an_attempt_is_made_at_is_finite_or_it_is_said() -> None:
    rig = Rig(memory())
    assert certificates._boundless(turn_of(rig), GAP) == ""
    rig.state = replace(rig.state, memory=replace(rig.state.memory, radius=1.5e308))
    assert "no finite number" in certificates._boundless(turn_of(rig), GAP)


# ---------------------------------------------------------------- certificates

FACTS = CertificateFacts("new", "controller", "model", "task", "profile", 1, 0.01, 0.015, 1500, 2500, 1)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({}, ""),
        ({"controller_digest": "x"}, "its controller is x, here it is controller"),
        ({"model_digest": "x"}, "its model is x, here it is model"),
        ({"task_digest": "x"}, "its task is x, here it is task"),
        ({"profile_digest": "x"}, "its profile is x, here it is profile"),
        ({"epoch": 2}, "its epoch is 2, here it is 1"),
        ({"verified_radius": 0.01 * (1 - ROUNDING)}, ""),
        ({"verified_radius": math.inf}, "it is verified to inf, less than 0.01"),
        ({"verified_radius": math.nan}, "it is verified to nan, less than 0.01"),
        ({"id": "gone"}, "it was revoked: by_operator"),
        ({"id": "c1"}, ""),
        ({"id": "c1", "attempt": 2}, "another certificate in force has its id"),
    ],
    ids=str,
)
def test_facts_certify_this_controller_here_or_it_is_said_why_not(changes: dict[str, Any], problem: str) -> None:
    rig = Rig(memory(revoked={"gone": "by_operator"}))
    assert certificates.facts_problem(turn_of(rig), replace(FACTS, **changes), "controller", 1, 0.01) == problem


def test_facts_may_fall_short_of_the_radius_by_its_last_digits_only() -> None:
    rig = Rig(memory())
    for slack, fits in ((WITHIN, True), (BESIDE, False)):
        found = certificates.facts_problem(turn_of(rig), replace(FACTS, verified_radius=0.01 * (1 - slack)), "controller", 1, 0.01)
        assert (found == "") == fits


def test_only_a_certificate_that_could_drive_now_is_used_again() -> None:
    assert certificates.valid_certificate(turn_of(Rig(memory())), "controller") is not None
    assert certificates.valid_certificate(turn_of(Rig(memory())), "another") is None
    assert certificates.valid_certificate(turn_of(Rig(memory(revoked={"c1": "by_operator"}))), "controller") is None
    assert certificates.valid_certificate(turn_of(Rig(memory(alarm_epoch=1))), "controller") is None
    assert certificates.valid_certificate(turn_of(Rig(memory(radius=0.02))), "controller") is None


# ---------------------------------------------------------------- gaps


def problem_of(**changes: Any) -> str:
    settings = changes.pop("settings", {})
    rig = Rig(memory(), **settings)
    return gaps._gap_problem(turn_of(rig), replace(ENOUGH, **changes), 1)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({}, ""),
        ({"epoch": 2}, "it is of another epoch or model"),
        ({"model_digest": "x"}, "it is of another epoch or model"),
        ({"radius": math.inf}, "its radius is not a finite number >= 0"),
        ({"radius": -1e-9}, "its radius is not a finite number >= 0"),
        ({"hold_radius": math.nan}, "its radius is not a finite number >= 0"),
        ({"radius": 0.0, "hold_radius": 0.0}, ""),
        ({"epsilon": 0.02}, "its epsilon or discards are not the profile's"),
        ({"discarded": 1, "n": 500}, "its epsilon or discards are not the profile's"),
        ({"settings": {"norm_weights": ()}, "weights": (2.0,), "set": "box"}, ""),
        ({"white_reason": f"{SERIAL}: 0.9"}, f"its samples were not drawn independently: {SERIAL}: 0.9"),
        ({"white_reason": "it drifts"}, ""),
        ({"n": 0}, "0 samples are too few for the share of epoch 1"),
        ({"n": 150}, "150 samples are too few for the share of epoch 1"),
    ],
    ids=str,
)
def test_a_gap_carries_its_statement_or_it_is_said_why_not(changes: dict[str, Any], problem: str) -> None:
    assert problem_of(**changes) == problem


def test_another_norm_is_named_with_the_profiles() -> None:
    found = problem_of(set="box")
    assert found.startswith("its norm is a box with weights (1.0, 1.0, 0.05), the profile's a ball")
    assert "its norm is a ball with weights (1.0, 1.0, 0.06)" in problem_of(weights=(1.0, 1.0, 0.06))


def test_samples_are_enough_down_to_the_last_digits_of_half_the_share() -> None:
    half = 0.5 * ledger.share(0.05, 1)
    for slack, fits in ((WITHIN, True), (BESIDE, False)):
        epsilon = epsilon_for(half * (1 + slack), ENOUGH.n)
        found = problem_of(epsilon=epsilon, settings={"epsilon": epsilon})
        assert (found == "") == fits, found


def test_samples_of_a_gap_that_was_refuted_found_no_later_epoch() -> None:
    def problem(transitions: str, **changes: Any) -> str:
        return gaps._samples_problem(turn_of(Rig(memory(**changes))), replace(GAP, transitions_digest=transitions))

    assert problem("others") == ""
    assert "a later epoch needs samples of its own" in problem("transitions")
    assert problem("transitions", gap=None) == ""
    assert "refuted or outgrown here" in problem("transitions", gap=None, refuted=("transitions",))


# ---------------------------------------------------------------- at their bounds


def test_uniform_alone_will_do_where_the_residual_is_white_and_nothing_was_traced() -> None:
    turn = turn_of(Rig(memory()))
    assert certificates._needs_more_laws(turn, GAP, ("uniform",)) == ""
    assert certificates._needs_more_laws(turn, replace(GAP, white=False), ("uniform", "persistent")) == ""
    assert "is not white" in certificates._needs_more_laws(turn, replace(GAP, white=False), ("uniform",))
    traced = turn_of(Rig(memory(traced=True)))
    assert "an effect was traced" in certificates._needs_more_laws(traced, GAP, ("uniform",))


def test_a_certificate_that_nobody_asked_for_changes_nothing() -> None:
    rig = Rig(memory())
    before = rig.state.memory
    assert rig.feed(CertificateStored(rig.t, FACTS)) == []
    assert rig.state.memory == before


def test_a_certificate_that_reaches_exactly_as_far_as_the_gap_has_grown_will_do() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    rig.verified()
    rig.measure(0.015)
    assert rig.state.memory.radius == 0.015
    assert len([one for one in rig.stored() if isinstance(one, StartController)]) == 1
