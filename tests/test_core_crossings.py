"""What crosses on its way in the core, and what happens exactly at a bound."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from core_rig import DT, GAP, Rig, S, kinds, of, one

from s2r_runtime.core import drive, ledger
from s2r_runtime.core.state import Turn
from s2r_runtime.messages import (
    Answer,
    CertificateFailed,
    GateChanged,
    IssueCertificate,
    JobFinished,
    Observed,
    OverrideChanged,
    Persist,
    Send,
    SourceStarted,
    StartController,
    StartJob,
    Ticked,
)


def two_that_wait() -> tuple[Rig, IssueCertificate]:
    """A controller's certificate is being signed; meanwhile a person changed his mind, and another one, which has its own, starts."""
    rig = Rig()
    rig.gap()
    rig.request("verify", digest="second")
    rig.verified()
    rig.stored()
    rig.request("deploy", digest="first")
    order = one(rig.verified(), IssueCertificate)
    rig.request("undeploy")
    assert one(rig.request("deploy", digest="second"), StartController).digest == "second"
    return rig, order


def test_a_certificate_that_comes_too_late_starts_nobody_elses_deployment() -> None:
    rig, order = two_that_wait()
    waiting = rig.state.deployment
    outputs = rig.stored()
    assert of(outputs, StartController) == []
    assert rig.state.deployment == waiting
    assert order.verification.controller_digest in {facts.controller_digest for facts in rig.state.memory.certificates}
    assert not rig.state.gate_open


def test_a_certificate_that_could_not_be_made_ends_nobody_elses_deployment() -> None:
    rig, order = two_that_wait()
    waiting = rig.state.deployment
    assert waiting is not None
    rig.feed(CertificateFailed(rig.t, "the disk is full", order.request_id))
    assert rig.state.deployment == waiting
    assert rig.state.issuing is None


def test_a_certificate_for_a_deployment_that_was_taken_back_starts_nothing() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="first")
    rig.verified()
    rig.request("undeploy")
    outputs = rig.stored()
    assert of(outputs, StartController) == []
    assert rig.state.deployment is None


def test_a_verification_that_ends_after_another_began_ends_no_deployment() -> None:
    rig = Rig()
    rig.gap()
    rig.request("verify", digest="second")
    rig.verified()
    rig.stored()
    first = one(rig.request("deploy", digest="first"), StartJob)
    rig.request("undeploy")
    rig.request("deploy", digest="second")
    waiting = rig.state.deployment
    assert waiting is not None
    rig.feed(JobFinished(rig.t, first.job_id, "verify", error="it failed"))
    assert rig.state.deployment == waiting


def test_a_certificate_that_is_loaded_beside_a_driving_controller_does_not_change_hands() -> None:
    """Verified on request: the deployment goes on under the certificate that it began with, and the new one counts for the next."""
    rig = Rig()
    rig.driving()
    before = rig.state.deployment
    rig.request("verify", digest="another")
    rig.verified()
    rig.stored()
    assert rig.state.gate_open
    assert rig.state.deployment == before
    assert [facts.controller_digest for facts in rig.state.memory.certificates] == ["controller", "another"]


@pytest.mark.parametrize("kind", ["emergency_stop", "manual_override"])
def test_a_stop_latches_whatever_the_profile_says_and_a_deployment_says_what_to_do(kind: str) -> None:
    rig = Rig(latching=())
    rig.deployed()
    rig.request("undeploy")
    rig.feed(OverrideChanged(rig.t, kind, "somebody"))  # type: ignore[arg-type]
    assert rig.state.memory.latched == (kind,)
    answer = one(rig.request("deploy", digest="controller"), Answer)
    assert answer.exit_code == 1
    assert answer.text.startswith(f"refused: {kind}: ")
    assert "clear" in answer.text


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, -1e-9])
def test_a_discrepancy_that_is_no_size_is_a_fault_of_the_measurement_and_not_a_gap(value: float) -> None:
    rig = Rig()
    rig.driving()
    memory = rig.state.memory
    rig.measure(value)
    assert rig.state.memory == memory
    assert rig.state.faults == 1
    rig.measure(value)
    rig.measure(value)
    assert not rig.state.gate_open
    assert rig.state.gate_reason.endswith("measurement_faults")


@pytest.mark.parametrize(("e_value", "written"), [(1.999, 0), (2.0, 1)])
def test_evidence_that_has_doubled_is_written_down_at_once(e_value: float, written: int) -> None:
    rig = Rig()
    rig.driving()
    assert len(of(rig.measure(0.001, e_value=e_value), Persist)) == written


def test_where_the_watch_stands_is_remembered_whole() -> None:
    rig = Rig()
    rig.driving()
    rig.measure(0.02, e_value=1.5, change=7.0, exchange=3.0)
    memory = rig.state.memory
    assert (memory.watch_e_value, memory.watch_change, memory.watch_exchange) == (1.5, 7.0, 3.0)
    assert (memory.watch_n, memory.watch_exceedances) == (10, 1)


def test_in_lockstep_a_blind_robot_that_was_answered_is_told_nothing_more() -> None:
    """Its clock stands still and it waits for nothing: a command more would be one for which there is no instant."""
    rig = Rig(lockstep=True)
    rig.observe()
    rig.observe((math.nan, 0.0, 0.0))
    assert rig.state.answered
    rig.t += 20 * DT
    assert of(rig.feed(Ticked(rig.t)), Send) == []
    realtime = Rig()
    realtime.observe()
    realtime.observe((math.nan, 0.0, 0.0))
    realtime.t += 20 * DT
    assert [send.source for send in of(realtime.feed(Ticked(realtime.t)), Send)] == ["recovery"]


@pytest.mark.parametrize(("late_ns", "drives"), [(0, True), (1, False)])
def test_the_way_home_is_known_for_as_long_as_the_last_observation_counts(late_ns: int, drives: bool) -> None:
    rig = Rig(recovery="return")
    rig.observe((0.5, 0.2, 0.0))
    rig.t += rig.settings.observation_timeout_ns + late_ns
    turn = Turn(rig.state, rig.settings, rig.t)
    assert any(drive.recovery_input(turn)) == drives


def test_sizes_that_meet_their_confidence_exactly_are_enough() -> None:
    for n in (1, 2, 7, 100, 1000):
        beta = ledger.binomial_tail(n, 0, 0.03)
        assert ledger.sample_size(0.03, beta) == n
        assert ledger.sample_size(0.03, math.nextafter(beta, 0.0)) == n + 1


def test_a_gap_that_has_just_the_confidence_that_was_its_due_comes_into_force() -> None:
    rig = Rig()
    rig.gap()
    assert rig.state.memory.gap is not None
    assert rig.state.memory.campaign_digest == rig.settings.campaign_digest
    assert rig.state.memory.gap.radius == GAP.radius


def test_a_controller_is_stopped_before_it_is_ended_and_what_ended_the_last_is_forgotten_with_the_next() -> None:
    rig = Rig(latching=())
    rig.driving()
    rig.propose((math.nan, 0.0))
    rig.request("undeploy")
    rig.observe()
    rig.request("deploy", digest="controller")
    assert rig.state.ended == ""
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    assert rig.state.ended == ""


def test_a_permit_of_no_time_at_all_and_one_of_the_longest_are_permits() -> None:
    rig = Rig()
    rig.observe()
    assert one(rig.request("permit", duration_s=0.0), Answer).exit_code == 0
    assert rig.state.permit_until_ns is None
    for wrong in (math.nan, math.inf, -math.inf, -1e-9):
        assert one(rig.request("permit", duration_s=wrong), Answer).exit_code == 2
        assert rig.state.permit_until_ns is None
    assert one(rig.request("permit", duration_s=1.0), Answer).exit_code == 0
    assert rig.state.permit_until_ns == rig.t + S


@pytest.mark.parametrize(
    "spoiled", [{"x": (), "fault": "malformed"}, {"x": (math.nan, 0.0, 0.0)}, {"x": (0.5, 0.2)}], ids=["fault", "NaN", "short"]
)
def test_what_a_robot_says_of_no_use_closes_the_gate_at_once_also_under_the_number_of_what_was_good(spoiled: dict[str, Any]) -> None:
    """A transport that can't read the number of what came, or whose robot says that it knows its position no more, gives it that number."""
    rig = Rig()
    rig.driving()
    good = rig.state.observation
    assert good is not None
    assert kinds(rig.feed(Observed(rig.t, good))) == []  # an echo changes nothing
    rig.t += DT // 2
    outputs = rig.feed(Observed(rig.t, msgspec.structs.replace(good, **spoiled)))
    assert kinds(outputs)[:2] == ["GateChanged", "Send"]
    assert (one(outputs, GateChanged).reason, one(outputs, Send).source) == ("observation_invalid", "recovery")
    assert rig.state.observation == good
    assert kinds(rig.feed(Observed(rig.t, msgspec.structs.replace(good, **spoiled)))) == []
    rig.feed(Observed(rig.t, good))  # an echo of before says nothing of now
    assert rig.state.gate_reason == "observation_invalid"
    for _ in range(8):
        rig.observe()
        rig.propose()
    assert rig.state.gate_open
