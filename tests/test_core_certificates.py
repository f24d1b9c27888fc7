"""Attempts and certificates in the core: what is spent, checked again, issued, installed, outgrown, revoked."""

from __future__ import annotations

import math
import sys
from typing import Any

import msgspec
import pytest
from core_rig import GAP, Rig, answers, kinds, memory, of, one

from s2r_runtime.core import ledger
from s2r_runtime.core import reducer as core
from s2r_runtime.core.state import unix_now
from s2r_runtime.evidence import bounds
from s2r_runtime.messages import (
    FIXED_SEEDS,
    SEEDS,
    Answer,
    AttemptEnded,
    AttemptSpent,
    CampaignFinished,
    CertificateFailed,
    CertificateInstalled,
    CertificateStored,
    DrawSeed,
    IssueCertificate,
    JobFinished,
    LawResult,
    Persist,
    Revoked,
    SeedDrawn,
    Send,
    SourceStarted,
    SourceStopped,
    StartCampaign,
    StartController,
    StartJob,
    StopController,
    Tries,
    WallClockRead,
)

# ---------------------------------------------------------------- verification and certificates


def test_without_a_gap_nothing_is_verified() -> None:
    for verb in ("deploy", "verify"):
        rig = Rig()
        answer = one(rig.request(verb, digest="controller"), Answer)
        assert answer.exit_code == 1
        assert "no gap" in answer.text
        assert one(rig.request(verb), Answer).exit_code == 2
        assert rig.state.memory.attempts == 0


def test_a_certificate_whose_seed_was_fixed_drives_in_a_simulation_only() -> None:
    for simulated in (False, True):
        rig = Rig(simulated=simulated)
        rig.gap()
        rig.request("deploy", digest="controller")
        rig.verified()
        rig.stored(fixed_seed=True)
        assert bool(of(rig.outputs, StartController)) == simulated


@pytest.mark.parametrize(("changes", "drives"), [({}, False), ({"simulated": True}, True), ({"rules": FIXED_SEEDS - 1}, True)])
def test_a_memory_of_a_simulation_certifies_nothing_for_a_robot(changes: dict[str, Any], drives: bool) -> None:
    (facts,) = memory().certificates
    rig = Rig(memory(certificates=(msgspec.structs.replace(facts, fixed_seed=True),)), **changes)
    rig.observe()
    assert bool(of(rig.request("deploy", digest="controller"), StartController)) == drives


def test_an_attempt_is_on_disk_before_it_begins_and_runs_at_the_headroom() -> None:
    rig = Rig()
    rig.gap()
    rig.measure(0.012)
    outputs = rig.request("deploy", digest="controller")
    assert kinds(outputs) == ["Persist", "AttemptSpent", "DrawSeed", "GateChanged", "StartJob"]
    assert one(outputs, Persist).memory.attempts == 1
    assert one(outputs, AttemptSpent).beta == pytest.approx(bounds.attempt_beta(0.05, 1))
    job = one(outputs, StartJob)
    assert (job.kind, job.attempt, job.epoch, job.digest) == ("verify", 1, 1, "controller")
    assert job.radius == pytest.approx(1.5 * 0.012)
    assert job.hold_radius == pytest.approx(1.5 * 0.1 * 1.2)
    assert core.status(rig.state)["reason"] == "verification_running"


def test_a_gap_of_zero_grows_to_all_that_the_held_periods_can_add_up_to() -> None:
    rig = Rig()
    rig.gap(radius=0.0, hold_radius=0.0)
    rig.measure(0.002)
    job = one(rig.request("verify", digest="controller"), StartJob)
    assert job.radius == pytest.approx(1.5 * 0.002)
    assert job.hold_radius == pytest.approx(1.5 * 50 * 0.002)


def test_a_controller_that_passes_below_the_most_that_was_asked_for_is_certified_to_what_it_passed_at() -> None:
    rig = Rig()
    rig.gap()
    job = one(rig.request("deploy", digest="controller"), StartJob)
    assert (job.least_radius, job.radius) == (pytest.approx(0.01), pytest.approx(0.015))
    n = ledger.sample_size(0.03, ledger.share(0.05, 1) / 8)
    laws = tuple(LawResult(law, n, 0.1, 0, 0.01, 1.0, True, True, True) for law in ("uniform", "persistent"))
    rig.verified(radius=0.012, hold_radius=job.hold_radius * 0.8, split=8, laws=laws)
    assert one(rig.stored(), CertificateInstalled).facts.verified_radius == 0.012


def test_radii_that_share_beta_need_the_scenarios_for_their_shares() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    n = ledger.sample_size(0.03, ledger.share(0.05, 1))  # enough for one radius
    laws = tuple(LawResult(law, n, 0.1, 0, 0.01, 1.0, True, True, True) for law in ("uniform", "persistent"))
    assert "too few" in one(rig.verified(laws=laws), AttemptEnded).reason


def test_a_result_that_leaves_out_that_its_beta_was_split_is_no_pass() -> None:
    for split in (1, 0, -1, 7, 9):
        rig = Rig()
        rig.gap()
        rig.request("deploy", digest="controller")
        outputs = rig.verified(split=split)
        assert "8 were fixed beforehand" in one(outputs, AttemptEnded).reason
        assert of(outputs, IssueCertificate) == []
    rig = Rig(headroom=1.0)
    rig.gap()
    rig.request("deploy", digest="controller")
    assert of(rig.verified(split=1), IssueCertificate)  # nothing was searched for


def test_a_gap_that_grew_beyond_all_numbers_is_not_paid_for() -> None:
    largest = sys.float_info.max
    for verb in ("deploy", "verify"):
        rig = Rig(memory(radius=largest, certificates=()))
        outputs = rig.request(verb, digest="controller")
        assert kinds(outputs) == ["Answer"]
        assert "no finite number" in one(outputs, Answer).text
        assert rig.state.memory.attempts == 1
    rig = Rig(memory(gap=msgspec.structs.replace(GAP, hold_radius=1.0), radius=largest / 10, certificates=()))  # its hold gap would be
    assert "no finite number" in one(rig.request("verify", digest="controller"), Answer).text


def test_a_discrepancy_beyond_all_numbers_ends_the_certificate_that_drives() -> None:
    rig = Rig()
    rig.driving()
    outputs = rig.measure(sys.float_info.max)
    assert of(outputs, StartJob) == of(outputs, AttemptSpent) == []
    assert one(outputs, Revoked).reason == "verification_failed_at_grown_radius"
    assert of(outputs, StopController)
    assert not rig.state.gate_open
    assert core.status(rig.state)["headroom_used"] is None


def test_a_discrepancy_beyond_all_numbers_during_a_verification_refuses_it() -> None:
    for verb in ("deploy", "verify"):
        rig = Rig()
        rig.gap()
        rig.request(verb, digest="controller")
        rig.measure(sys.float_info.max)
        outputs = rig.verified()
        assert of(outputs, StartJob) == of(outputs, IssueCertificate) == []
        answer = one(outputs, Answer)
        assert (answer.exit_code, answer.final) == (1, True)
        assert "no finite number" in answer.text


def test_a_radius_that_was_outgrown_while_it_was_verified_is_verified_once_more() -> None:
    rig = Rig()
    rig.gap()
    rig.request("verify", digest="controller")
    rig.measure(0.0125)
    again = one(rig.verified(radius=0.012), StartJob)
    assert again.least_radius == pytest.approx(0.0125)


def test_an_attempt_begins_with_the_first_seed_that_is_drawn_for_it_after_it_was_paid_for() -> None:
    rig = Rig(memory(certificates=()))
    rig.draws = False
    outputs = rig.request("verify", digest="a")
    order = one(outputs, DrawSeed)
    assert kinds(outputs).index("Persist") < kinds(outputs).index("AttemptSpent") < kinds(outputs).index("DrawSeed")
    assert of(rig.feed(SeedDrawn(rig.t, order.job_id, order.attempt - 1, 4)), StartJob) == []  # of an attempt of before
    assert one(rig.feed(SeedDrawn(rig.t, order.job_id, order.attempt, 5)), StartJob).seed == 5
    assert rig.feed(SeedDrawn(rig.t, order.job_id, order.attempt, 6)) == []


@pytest.mark.parametrize("drawn", [False, True])
def test_a_result_of_another_seed_than_the_one_that_was_drawn_certifies_nothing(drawn: bool) -> None:
    rig = Rig(memory(certificates=()))
    rig.draws = drawn
    rig.request("verify", digest="a")
    job = rig.state.jobs[0]
    order = StartJob(rig.t, job.id, "verify", 1, "a", job.radius, job.hold_radius, job.attempt, 7, 0.01, least_radius=job.least_radius)
    outputs = rig.feed(JobFinished(rig.t, job.id, "verify", verification=rig.result(order)))
    assert of(outputs, IssueCertificate) == []
    assert "of another seed" in one(outputs, AttemptEnded).reason


def test_by_the_rules_of_before_the_seed_followed_from_digests_and_attempt() -> None:
    def seed(digest: str, attempts: int, **changes: Any) -> int:
        rig = Rig(memory(attempts=attempts, certificates=()), rules=SEEDS - 1, **changes)
        return one(rig.request("verify", digest=digest), StartJob).seed

    assert seed("a", 0) == seed("a", 0) == seed("a", 0, seed=77)
    assert len({seed("a", 0), seed("b", 0), seed("a", 1), seed("a", 0, task_digest="other"), seed("a", 0, profile_digest="other")}) == 5


def test_a_certificate_is_told_how_many_attempts_and_controllers_its_gap_has_seen() -> None:
    rig = Rig()
    rig.gap()
    for digest, behaviour in (("a", "left"), ("b", "left"), ("c", "right"), ("d", "")):
        rig.request("verify", digest=digest)
        job = one(rig.outputs, StartJob, last=True)
        rig.feed(JobFinished(rig.t, job.job_id, "verify", verification=rig.result(job, passed=False), behaviour=behaviour))
    rig.request("verify", digest="e")
    assert one(rig.verified(), IssueCertificate).tries == Tries(5, 5, 4)
    rig.stored()
    rig.gap()
    rig.request("verify", digest="a")
    assert one(rig.verified(), IssueCertificate).tries == Tries(6, 1, 1)


def test_a_controller_that_answers_otherwise_when_asked_again_loses_its_certificates_for_good() -> None:
    rig = Rig()
    rig.driving()
    outputs = rig.feed(SourceStopped(rig.t, "controller", "inconsistent", "it answers [1] and not [2]"))
    assert kinds(outputs)[:2] == ["GateChanged", "Send"]
    assert one(outputs, Revoked).reason == "controller_inconsistent"
    assert rig.state.memory.certificates == ()
    assert rig.state.memory.latched == ("controller_fault",)
    rig.request("clear", text="controller_fault")
    assert one(rig.request("deploy", digest="controller"), StartJob).attempt == 2, "it is verified anew, and that is paid for"


def test_a_failed_verification_is_a_refusal_that_was_paid_for() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    outputs = rig.verified(passed=False, reason="uniform: s* is -1")
    assert (one(outputs, AttemptEnded).passed, one(outputs, AttemptEnded).reason) == (False, "uniform: s* is -1")
    assert one(outputs, Answer).exit_code == 1
    assert one(outputs, Answer).text.startswith("refused: ")
    assert of(rig.outputs, StartController) == []
    assert rig.state.memory.attempts == 1
    assert core.status(rig.state)["reason"] == "no_certificate"
    assert one(rig.request("deploy", digest="controller"), StartJob).attempt == 2


_LAW = LawResult("uniform", 160, 0.1, 0, 0.01, 1.0, progress_ok=True, required=True, passed=True)


@pytest.mark.parametrize(
    "changes",
    [
        {"passed": False},
        {"radius": 0.0099},
        {"radius": math.nan},
        {"hold_radius": 0.0},
        {"controller_digest": "another"},
        {"model_digest": "another"},
        {"task_digest": "another"},
        {"attempt": 2},
        {"epsilon": 0.0},
        {"epsilon": 1e-3},
        {"laws": ()},
        {"laws": (_LAW,)},
        {"laws": (msgspec.structs.replace(_LAW, law="adversarial", n=500),)},
        {"laws": tuple(msgspec.structs.replace(_LAW, law=law, n=500) for law in ("uniform", "adversarial"))},
        {"threshold": 0.2},
        {"laws": tuple(msgspec.structs.replace(_LAW, law=law, n=100) for law in ("uniform", "persistent"))},
        {"laws": tuple(msgspec.structs.replace(_LAW, law=law, n=0) for law in ("uniform", "persistent"))},
        {"laws": tuple(msgspec.structs.replace(_LAW, law=law, required=False) for law in ("uniform", "persistent"))},
        {"laws": (_LAW, msgspec.structs.replace(_LAW, law="persistent", passed=False))},
        {"laws": (_LAW, msgspec.structs.replace(_LAW, law="persistent", progress_ok=False))},
        {"laws": (_LAW, msgspec.structs.replace(_LAW, law="persistent", s_star=-0.1))},
    ],
    ids=lambda changes: str(changes)[:60],
)
def test_a_result_that_does_not_show_what_was_asked_is_no_pass(changes: dict[str, Any]) -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    outputs = rig.verified(**changes)
    assert not one(outputs, AttemptEnded).passed
    assert one(outputs, Answer).exit_code == 1
    assert of(outputs, IssueCertificate) == []


def test_a_worker_that_fails_shows_nothing() -> None:
    for error in ("timeout after 600 s", ""):
        rig = Rig()
        rig.gap()
        job = one(rig.request("deploy", digest="controller"), StartJob)
        outputs = rig.feed(JobFinished(rig.t, job.job_id, "verify", error=error))
        assert not one(outputs, AttemptEnded).passed
        assert one(outputs, Answer).exit_code == 1


def test_uniform_alone_carries_no_certificate_where_the_residual_is_not_white_or_an_effect_is_known() -> None:
    rig = Rig(required_laws=("uniform",))
    rig.gap(white=False)
    assert "not white" in one(rig.request("deploy", digest="controller"), Answer).text
    assert rig.state.memory.attempts == 0  # refused before it was paid for
    rig = Rig(memory(traced=True, certificates=()), required_laws=("uniform",))
    assert "traced" in one(rig.request("deploy", digest="controller"), Answer).text
    rig = Rig(required_laws=())
    rig.gap(white=False)
    rig.request("deploy", digest="controller")
    outputs = rig.verified(names=("uniform",))
    assert one(outputs, AttemptEnded).passed
    assert "not white" in one(outputs, Answer).text
    rig = Rig(required_laws=("uniform",))
    rig.gap()
    rig.request("deploy", digest="controller")
    assert of(rig.verified(names=("uniform",)), IssueCertificate)


def test_a_certificate_is_durable_and_installed_before_its_controller_starts() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    order = one(rig.verified(), IssueCertificate)
    assert (order.gap, order.lifetime_s) == (rig.state.memory.gap, 1000)
    assert of(rig.outputs, StartController) == []
    outputs = rig.stored()
    assert kinds(outputs)[:3] == ["CertificateInstalled", "Persist", "Answer"]
    assert one(outputs, Persist).memory.certificates[0].id == "c1"
    assert one(outputs, StartController) == StartController(rig.t, "controller", "c1")
    assert kinds(outputs).index("Persist") < kinds(outputs).index("StartController")
    assert answers(rig)[3] == []
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    assert [a.exit_code for a in answers(rig)[3]] == [0]


def test_a_certificate_in_force_is_used_again_without_paying() -> None:
    rig = Rig()
    rig.driving()
    assert one(rig.request("deploy", digest="controller"), Answer).exit_code == 0  # drives already
    assert one(rig.request("deploy", digest="another"), Answer).exit_code == 2
    assert one(rig.request("undeploy"), StopController).reason == "undeployed"
    assert one(rig.request("deploy", digest="controller"), StartController).certificate_id == "c1"
    assert rig.state.memory.attempts == 1
    rig.request("undeploy")
    rig.feed(WallClockRead(rig.t, 2501))
    assert one(rig.request("deploy", digest="controller"), StartJob).attempt == 2  # expired


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"verified_radius": 0.0149}, "verified"),
        ({"controller_digest": "x"}, "controller"),
        ({"epoch": 2}, "epoch"),
        ({"task_digest": "x"}, "task"),
    ],
)
def test_a_certificate_other_than_the_one_asked_for_is_not_installed(changes: dict[str, Any], word: str) -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    rig.verified()
    assert rig.feed(CertificateStored(rig.t, memory().certificates[0], request_id=77)) == []
    outputs = rig.stored(**changes)
    assert of(outputs, CertificateInstalled) == []
    assert word in one(outputs, Answer).text
    assert rig.state.memory.certificates == ()


def test_a_certificate_that_cannot_be_made_is_a_refusal() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    rig.verified()
    assert one(rig.feed(CertificateFailed(rig.t, "no key", 77)), Answer).final is False
    assert "no key" in one(rig.feed(CertificateFailed(rig.t, "no key", 3)), Answer).text
    assert rig.state.deployment is None


@pytest.mark.parametrize("reason", ["digest", "start_failed"])
def test_what_starts_must_be_what_was_certified(reason: str) -> None:
    rig = Rig()
    rig.gap()
    rig.deploying()
    if reason == "digest":
        outputs = rig.feed(SourceStarted(rig.t, "controller", "another"))
        assert one(outputs, StopController).reason == "digest_mismatch"
    else:
        outputs = rig.feed(SourceStopped(rig.t, "controller", "start_failed", "no such file"))
    assert one(outputs, Answer).exit_code == 1
    for _ in range(8):
        assert [send.source for send in of(rig.observe(), Send)] == ["recovery"]


def test_a_controller_that_nobody_deployed_is_stopped_and_a_second_one_is_a_fault() -> None:
    rig = Rig()
    rig.gap()
    assert one(rig.feed(SourceStarted(rig.t, "controller", "x")), StopController).reason == "not_requested"
    rig.request("deploy", digest="controller")
    assert one(rig.feed(SourceStarted(rig.t, "controller", "x")), StopController).reason == "not_requested"
    rig.verified()
    rig.stored()
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    assert of(rig.feed(SourceStarted(rig.t, "controller", "controller")), StopController)
    assert rig.state.memory.latched == ("controller_fault",)


def test_undeploying_answers_whoever_waits_and_what_was_paid_for_stays() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    assert one(rig.request("deploy", digest="controller"), Answer).exit_code == 2
    rig.feed(SourceStopped(rig.t, "controller", "died"))  # an earlier one's
    outputs = rig.request("undeploy")
    assert kinds(outputs) == ["GateChanged", "Answer", "Answer"]
    assert [a.exit_code for a in of(outputs, Answer)] == [1, 0]
    assert one(rig.request("undeploy"), Answer).exit_code == 2
    assert one(rig.request("verify", digest="controller"), Answer).exit_code == 1  # one is still running
    rig.verified()
    assert kinds(rig.stored()) == ["CertificateInstalled", "Persist"]
    assert of(rig.request("deploy", digest="controller"), StartController)


def test_an_undeployed_controllers_failure_or_outgrown_pass_is_told_to_nobody_twice() -> None:
    for grown, passed in ((False, False), (True, True)):
        rig = Rig()
        rig.gap()
        rig.request("deploy", digest="controller")
        rig.request("undeploy")
        if grown:
            rig.measure(0.5)
        assert kinds(rig.verified(passed=passed)) == ["AttemptEnded", "Persist"]
        assert all(len(found) == 1 for found in answers(rig).values())


def test_verify_issues_a_certificate_without_starting_anything() -> None:
    rig = Rig()
    rig.gap()
    rig.request("verify", digest="controller")
    rig.verified()
    outputs = rig.stored()
    assert kinds(outputs) == ["CertificateInstalled", "Persist", "Answer"]
    assert one(outputs, Answer).exit_code == 0
    rig.request("verify", digest="other")
    assert one(rig.verified(passed=False), Answer).exit_code == 1


def test_a_pass_that_the_radius_outgrew_is_verified_once_more_and_then_refused() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    rig.measure(0.1)
    outputs = rig.verified()
    assert one(outputs, Answer).final is False
    assert one(outputs, StartJob).radius == pytest.approx(0.15)
    rig.measure(0.2)
    outputs = rig.verified()
    assert one(outputs, Answer).exit_code == 1
    assert of(outputs, StartJob) == []
    assert rig.state.memory.attempts == 2


def test_a_radius_that_grows_while_the_certificate_is_signed_counts_too() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    rig.verified()
    rig.measure(0.1)
    outputs = rig.stored()
    assert of(outputs, StartController) == []
    assert one(outputs, StartJob).radius == pytest.approx(0.15)
    rig.verified()
    assert one(rig.stored(), StartController).certificate_id == "c2"


def test_a_gap_that_changes_while_a_verification_runs_gives_no_certificate() -> None:
    for late in (False, True):
        rig = Rig()
        rig.gap()
        rig.request("verify", digest="controller")
        if late:
            rig.verified()
        job = one(rig.outputs, StartJob, last=True)
        n = one(rig.sampling(), StartCampaign).n
        rig.feed(CampaignFinished(rig.t, 2, n, complete=True, rejected={}))
        rig.finish_gap(msgspec.structs.replace(GAP, epoch=2, n=n))
        if late:
            outputs = rig.stored()
            assert one(outputs, Revoked).reason == "gap_void"
        else:
            rig.outputs.append(job)
            outputs = rig.verified()
        assert "does not hold any more" in one(outputs, Answer).text
        assert rig.state.memory.certificates == ()


def test_revoking_stops_the_controller_after_the_robot_was_told() -> None:
    rig = Rig()
    rig.driving()
    outputs = rig.request("revoke", text="c1")
    assert kinds(outputs)[:4] == ["GateChanged", "Send", "Revoked", "Persist"]
    assert one(outputs, Send).source == "recovery"
    assert one(outputs, StopController).reason == "certificate_revoked"
    assert core.status(rig.state)["reason"] == "certificate_revoked"
    assert one(rig.request("revoke", text="c1"), Answer).exit_code == 0
    assert one(rig.request("revoke", text="c9"), Answer).exit_code == 2
    assert one(rig.request("revoke"), Answer).exit_code == 0
    assert one(rig.request("deploy", digest="controller"), StartJob).attempt == 2
    rig.verified()
    rig.stored()
    assert "1 certificates" in one(rig.request("revoke"), Answer, last=True).text


def test_revoking_another_controllers_certificate_stops_nobody() -> None:
    rig = Rig()
    rig.driving()
    rig.request("verify", digest="next")
    rig.verified()
    rig.stored()
    assert kinds(rig.request("revoke", text="c2")) == ["Revoked", "Persist", "Answer"]
    assert rig.state.gate_open


def driving_rig() -> Rig:
    rig = Rig()
    rig.driving()
    return rig


@pytest.mark.parametrize("back_to", [0, 1500, 2499])
def test_a_certificate_that_expired_drives_no_more_when_the_clock_steps_back_not_even_after_a_restart(back_to: int) -> None:
    rig = driving_rig()
    rig.feed(WallClockRead(rig.t, 2500))
    assert rig.state.gate_reason == "certificate_expired"
    rig.feed(WallClockRead(rig.t, back_to))
    assert (rig.state.gate_open, rig.state.gate_reason) == (False, "certificate_expired")
    assert rig.state.clock_behind_s == (2500 - back_to if back_to < 2499 else 0), "one second is rounding"
    again = Rig(rig.state.memory)
    assert unix_now(again.state) == 2500
    again.feed(WallClockRead(again.t, back_to))
    again.request("deploy", digest="controller")
    assert again.state.deployment is None or not again.state.deployment.certificate_id


def test_the_monotonic_clock_bounds_a_certificates_life_while_the_wall_clock_stands() -> None:
    rig = driving_rig()
    for _ in range(11):
        rig.t += 100_000_000_000
        rig.feed(WallClockRead(rig.t, 1500))
    assert rig.state.gate_reason == "certificate_expired"


def test_a_clock_that_was_ahead_by_mistake_is_believed_again_by_a_person_and_what_had_expired_is_revoked() -> None:
    rig = driving_rig()
    identity = rig.state.memory.certificates[0].id
    assert "not behind" in one(rig.request("clear", text="wall_clock"), Answer).text
    rig.feed(WallClockRead(rig.t, 10**9))
    rig.feed(WallClockRead(rig.t, 1501))
    assert "1 certificates had expired" in one(rig.request("clear", text="wall_clock"), Answer).text
    assert (unix_now(rig.state), rig.state.memory.latest_unix_s) == (1501, 1501)
    assert rig.state.memory.clock_cleared == 1
    assert rig.state.memory.revoked == {identity: "expired"}
