"""The core and the gap while a controller drives: growth, verification beside the closed gate, alarms, measurement faults."""

from __future__ import annotations

import math
from typing import Any

import pytest
from core_rig import Rig, answers, kinds, of, one, reason, reopen, sources

from s2r_runtime.core import reducer as core
from s2r_runtime.messages import (
    AlarmRaised,
    Answer,
    CertificateFailed,
    GateChanged,
    Persist,
    RadiusGrew,
    Revoked,
    SourceStarted,
    StartJob,
    StopController,
)

# ---------------------------------------------------------------- the gap while driving


def test_growth_within_the_headroom_costs_nothing_and_beyond_it_closes_the_gate_first() -> None:
    rig = Rig()
    rig.driving()
    assert rig.measure(0.01) == []
    outputs = rig.measure(0.015)
    assert kinds(outputs) == ["RadiusGrew", "Persist"]
    assert one(outputs, RadiusGrew) == RadiusGrew(rig.t, 0.015, 0.015, rig.seq)
    assert rig.state.gate_open
    outputs = rig.measure(0.016)
    assert kinds(outputs) == ["GateChanged", "Send", "RadiusGrew", "Persist", "Persist", "AttemptSpent", "DrawSeed", "StartJob"]
    assert (one(outputs, GateChanged).reason, sources(outputs)) == ("radius_above_verified", ["recovery"])
    job = one(outputs, StartJob)
    assert (job.attempt, job.radius, job.hold_radius) == (2, pytest.approx(1.5 * 0.016), pytest.approx(1.5 * 0.16))
    assert sources(rig.observe()) == ["recovery"]
    assert rig.measure(0.02) != []  # grows on; the running attempt covers it
    rig.verified()
    outputs = rig.stored()
    assert kinds(outputs) == ["CertificateInstalled", "Persist"]
    assert reopen(rig) == 3
    assert core.status(rig.state)["certificate"] == "c2"


def test_a_failed_verification_at_the_grown_radius_revokes_and_stops() -> None:
    rig = Rig()
    rig.driving()
    rig.measure(0.5)
    outputs = rig.verified(passed=False)
    assert one(outputs, Revoked) == Revoked(rig.t, "c1", "verification_failed_at_grown_radius")
    assert kinds(outputs).index("Persist") < kinds(outputs).index("StopController")
    assert reason(rig) == "certificate_revoked"
    assert sources(rig.observe()) == ["recovery"]


def test_a_reverification_that_cannot_be_carried_out_or_signed_fails_closed() -> None:
    for sign in (False, True):
        rig = Rig()
        rig.driving()
        rig.measure(0.5)
        outputs = rig.verified(**({} if sign else {"attempt": 9}))
        if sign:
            outputs = rig.feed(CertificateFailed(rig.t, "disk full"))
        assert one(outputs, Revoked).certificate_id == "c1"
        assert of(outputs, StopController)


def test_a_radius_that_outgrows_the_reverification_is_verified_once_more_and_then_revoked() -> None:
    rig = Rig()
    rig.driving()
    rig.measure(0.02)
    rig.measure(0.1)
    assert one(rig.verified(), StartJob).radius == pytest.approx(0.15)
    rig.measure(0.2)
    assert one(rig.verified(), Revoked).reason == "verification_failed_at_grown_radius"
    rig = Rig()
    rig.driving()
    rig.measure(0.02)
    rig.measure(0.1)
    rig.request("undeploy")
    assert kinds(rig.verified()) == ["AttemptEnded", "Persist"]  # nobody waits for it any more


def test_growth_while_another_controller_is_verified_waits_for_that_attempt() -> None:
    rig = Rig()
    rig.driving()
    rig.request("verify", digest="next")
    assert of(rig.measure(0.02), StartJob) == []
    assert not rig.state.gate_open
    outputs = rig.verified(passed=False)
    assert one(outputs, StartJob).digest == "controller"


def test_an_alarm_ends_everything_on_its_gap_until_a_fresh_campaign() -> None:
    rig = Rig()
    rig.driving()
    assert kinds(rig.measure(0.001, e_value=99.9)) == ["Persist"]  # no alarm, and not to be forgotten
    outputs = rig.measure(0.001, e_value=100.0)
    assert kinds(outputs)[:2] == ["GateChanged", "Send"]
    assert (one(outputs, GateChanged).reason, sources(outputs)) == ("watch_alarm", ["recovery"])
    assert one(outputs, AlarmRaised) == AlarmRaised(rig.t, 100.0, 0.01, 1)
    assert one(outputs, Revoked) == Revoked(rig.t, "c1", "watch_alarm")
    assert of(outputs, StopController)
    assert rig.measure(0.5, e_value=1e9) == []  # the gap is refuted already
    assert one(rig.request("deploy", digest="controller"), Answer).exit_code == 1

    rig = Rig(of(rig.outputs, Persist)[-1].memory)  # a restart
    assert core.status(rig.state)["alarm"]
    assert "stays refuted" in one(rig.request("clear", text="watch_alarm"), Answer).text
    assert "sample anew" in one(rig.request("deploy", digest="controller"), Answer).text
    rig.gap()
    assert rig.state.memory.epochs == 2
    rig.deploying()
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    assert reopen(rig) >= 3


def test_an_alarm_refuses_the_deployment_that_waits_and_the_certificate_that_is_being_signed() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    rig.verified()
    outputs = rig.measure(0.001, e_value=1e3)
    assert one(outputs, Answer).exit_code == 1
    outputs = rig.stored()
    assert one(outputs, Revoked).reason == "gap_void"
    assert rig.state.memory.certificates == ()
    assert all(len(found) == 1 for found in answers(rig).values())


def test_discrepancies_of_another_epoch_and_without_a_gap_do_not_count() -> None:
    rig = Rig()
    assert rig.measure(5.0, e_value=1e9) == []
    rig.gap()
    assert rig.measure(5.0, e_value=1e9, epoch=7) == []
    assert rig.measure(5.0, epoch=1) != []


@pytest.mark.parametrize(
    "changes",
    [{"discrepancy": 9.0, "fault": "jump"}, {"discrepancy": math.nan}, {"discrepancy": -1.0}, {"discrepancy": 0.001, "e_value": math.inf}],
    ids=str,
)
def test_measurement_faults_do_not_grow_the_gap_and_too_many_close_the_gate(changes: dict[str, Any]) -> None:
    rig = Rig()
    rig.gap()
    rig.measure(**changes)  # nothing is deployed: does not count
    rig.deploying()
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    reopen(rig)
    assert rig.measure(**changes) == rig.measure(**changes) == []
    outputs = rig.measure(**changes)
    assert (one(outputs, GateChanged).reason, sources(outputs)) == ("measurement_faults", ["recovery"])
    assert rig.state.memory.radius == 0.01
    assert rig.state.faults == 3
    rig.request("clear", text="measurement_faults")
    assert reopen(rig) == 3
