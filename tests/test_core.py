"""The core: how a run starts, and campaigns, gaps and models, in the order in which it persists, records and acts."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from core_rig import GAP, SETTINGS, Rig, S, answers, kinds, lockstep, memory, of, one

from s2r_runtime.core import reducer as core
from s2r_runtime.evidence import bounds
from s2r_runtime.messages import (
    MEMORY_SCHEMA,
    Answer,
    Ask,
    CampaignFinished,
    Decided,
    EpochChanged,
    Event,
    GateChanged,
    JobFinished,
    LinkChanged,
    Memory,
    ModelAdopted,
    Observation,
    Observed,
    OverrideChanged,
    Persist,
    RecorderChanged,
    Requested,
    Revoked,
    SampleTaken,
    Send,
    SourceStarted,
    SourceStopped,
    StartCampaign,
    StartController,
    Started,
    StartJob,
    StopCampaign,
    Ticked,
)

# ---------------------------------------------------------------- start


def test_before_started_nothing_is_sent_and_requests_are_answered() -> None:
    rig = Rig(start=False)
    assert rig.observe() == []
    assert rig.propose() == []
    assert rig.feed(OverrideChanged(rig.t, "emergency_stop")) == []
    assert one(rig.request("deploy", digest="c"), Answer).exit_code == 1
    assert core.status(rig.state)["reason"] == "not_started"


@pytest.mark.parametrize(("memory", "word"), [(Memory("other", MEMORY_SCHEMA), "other"), (Memory("r", 99), "schema 99")])
def test_a_foreign_memory_stays_closed_with_its_reason_and_is_never_written(memory: Memory, word: str) -> None:
    rig = Rig(memory, start=False)
    changed = one(rig.feed(Started(S, 1500, rig.settings, memory)), GateChanged)
    assert (changed.open, changed.reason) == (False, "memory_refused")
    assert rig.feed(LinkChanged(S, up=True)) + rig.observe() + rig.feed(Ticked(rig.t)) == []
    answer = one(rig.request("sample"), Answer)
    assert answer.exit_code == 78
    assert word in answer.text


def test_a_restart_goes_on_where_it_was() -> None:
    rig = Rig(memory())
    assert of(rig.outputs, Persist) == []
    assert rig.state.memory == memory()
    assert core.status(rig.state)["e_value"] == 3.0
    assert one(rig.request("deploy", digest="controller"), StartController).certificate_id == "c1"


@pytest.mark.parametrize(
    ("changes", "reason"), [({"model_digest": "new"}, "model_changed"), ({"campaign_digest": "new"}, "profile_changed")]
)
def test_another_model_or_comparison_voids_gap_and_certificates_but_not_the_counters(changes: dict[str, str], reason: str) -> None:
    rig = Rig(memory(campaign_epoch=2, campaign_n=160, epochs=2), **changes)
    kept = rig.state.memory
    assert (kept.gap, kept.certificates, kept.radius, kept.campaign_epoch) == (None, (), 0.0, 0)
    assert (kept.epochs, kept.attempts, kept.revoked) == (2, 1, {"c1": reason})
    assert one(rig.outputs, Revoked).reason == reason
    assert of(rig.outputs, Persist)[-1].memory == kept
    assert one(rig.request("deploy", digest="controller"), Answer).exit_code == 1


def test_a_first_start_takes_the_model_and_a_second_one_in_the_same_run_changes_nothing() -> None:
    rig = Rig()
    assert one(rig.outputs, Persist).memory.model_digest == "model"
    assert rig.feed(Started(rig.t, 9, msgspec.structs.replace(SETTINGS, robot="q"), Memory("q", MEMORY_SCHEMA))) == []
    assert rig.state.memory.robot == "r"


# ---------------------------------------------------------------- campaigns


def test_an_epoch_is_on_disk_before_its_campaign_moves_anything() -> None:
    rig = Rig()
    outputs = rig.sampling()
    assert kinds(outputs) == ["Persist", "EpochChanged", "StartCampaign"]
    assert (one(outputs, Persist).memory.epochs, one(outputs, Persist).memory.campaign_epoch) == (1, 1)
    assert one(outputs, EpochChanged).beta == pytest.approx(bounds.epoch_beta(0.05, 1))
    assert one(outputs, EpochChanged).gap is None
    order = one(outputs, StartCampaign)
    assert (order.epoch, order.resume) == (1, False)
    assert order.n == bounds.sample_size(0.03, bounds.epoch_beta(0.05, 1) / 2)


def test_too_few_samples_are_refused_saying_how_many_are_needed() -> None:
    needed = bounds.sample_size(0.03, bounds.epoch_beta(0.05, 1) / 2)
    for rig, count in ((Rig(), 100), (Rig(campaign_n=100), 0)):
        answer = one(rig.sampling(count), Answer)
        assert answer.exit_code == 3
        assert f"at least {needed} samples" in answer.text
        assert f"{needed - 100} too few" in answer.text
        assert rig.state.memory.epochs == 0
    assert one(Rig().sampling(needed), StartCampaign).n == needed
    assert one(Rig(campaign_n=500).sampling(), StartCampaign).n == 500
    assert one(Rig(epsilon=1e-12).sampling(), Answer).exit_code == 3


@pytest.mark.parametrize(
    ("event", "word"),
    [
        (LinkChanged(2 * S, up=False), "link_down"),
        (RecorderChanged(2 * S, ok=False), "recorder_down"),
        (OverrideChanged(2 * S, "manual_override"), "manual_override"),
        (Ticked(2 * S), "observation_stale"),
        (Requested(2 * S, 90, "permit", 1, duration_s=0.0), "no_permit"),
        (Ticked(100 * S), "permit_expired"),
        (Observed(2 * S, Observation(99, 2 * S, (2.5, 0.0, 0.0))), "outside_geofence"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_campaign_begins_only_where_the_sampler_may_drive(event: Event, word: str) -> None:
    rig = Rig()
    rig.observe()
    rig.request("permit", duration_s=60.0)
    rig.feed(event)
    rig.t = event.t_ns
    answer = one(rig.request("sample"), Answer)
    assert answer.exit_code == 1
    assert word in answer.text
    assert rig.state.memory.epochs == 0


def test_the_sampler_drives_through_the_gate_and_a_refused_command_becomes_recovery() -> None:
    rig = Rig(latching=("input_out_of_bounds",))  # which is about controllers
    rig.sampling()
    assert one(rig.observe(), Ask).source == "sampler"
    assert one(rig.propose((0.2, 3.0), "sampler"), Send) == Send(rig.t, 2, "sampler", (0.2, 3.0), rig.seq, S // 10)
    rig.observe()
    outputs = rig.propose((0.3, 0.0), "sampler")
    assert kinds(outputs) == ["Decided", "Send"]
    assert (one(outputs, Decided).reason, one(outputs, Decided).margin) == ("input_out_of_bounds", pytest.approx(-0.1))
    assert (one(outputs, Send).source, one(outputs, Send).u) == ("recovery", (0.0, 0.0))
    rig.observe((2.5, 0.0, 0.0))
    assert one(rig.propose((0.0, 0.0), "sampler"), Decided).reason == "outside_geofence"
    assert rig.state.memory.latched == ()
    assert rig.state.campaign is not None
    assert not rig.state.gate_open


def test_a_sampler_that_left_the_geofence_stays_out_where_the_profile_says_so() -> None:
    rig = Rig(latching=("outside_geofence",))
    rig.sampling()
    rig.observe((2.5, 0.0, 0.0))
    outputs = rig.propose((0.0, 0.0), "sampler")
    assert kinds(outputs) == ["Decided", "Send", "StopCampaign", "Answer", "Persist"]
    assert one(outputs, StopCampaign).reason == "latched:outside_geofence"
    assert one(rig.request("sample"), Answer).exit_code == 1
    rig.request("clear", text="outside_geofence")
    assert one(rig.sampling(), StartCampaign).resume


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (Ticked(62 * S), "permit_expired"),
        (RecorderChanged(2 * S, ok=False), "recorder_down"),
        (OverrideChanged(2 * S, "emergency_stop"), "emergency_stop"),
        (Requested(2 * S, 90, "permit", 1), "no_permit"),
        (SourceStopped(2 * S, "sampler", "raised", "boom"), "raised: boom"),
        (SourceStopped(2 * S, "sampler", "start_failed"), "start_failed"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_interrupted_campaign_goes_on_in_its_epoch_at_no_cost(event: Event, reason: str) -> None:
    rig = lockstep()
    begun = one(rig.sampling(), StartCampaign)
    rig.observe()
    rig.feed(SampleTaken(rig.t, 1, 41, 1, 1, (0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (), 1))
    outputs = rig.feed(event)
    assert one(outputs, Send).source == "recovery"  # the open question is answered
    assert [stop.reason for stop in of(outputs, StopCampaign)] == ([] if isinstance(event, SourceStopped) else [reason])
    assert reason in answers(rig)[2][0].text
    assert "42 of" in answers(rig)[2][0].text
    rig.feed(RecorderChanged(rig.t, ok=True))
    rig.t = max(rig.t, event.t_ns)
    rig.request("clear", text="emergency_stop")
    outputs = rig.sampling()
    assert kinds(outputs) == ["StartCampaign"]  # nothing is spent
    again = one(outputs, StartCampaign)
    assert again == msgspec.structs.replace(begun, t_ns=again.t_ns, resume=True)
    assert rig.state.memory.epochs == 1


def test_a_campaign_that_goes_on_keeps_its_number_of_samples() -> None:
    rig = Rig()
    n = one(rig.sampling(), StartCampaign).n
    rig.request("stop")
    rig.request("clear", text="emergency_stop")
    assert one(rig.sampling(n + 1), Answer).exit_code == 2
    assert one(rig.sampling(n), StartCampaign).resume


def test_cancelling_gives_the_epoch_up_for_good() -> None:
    rig = lockstep()
    rig.sampling()
    rig.observe()
    outputs = rig.request("cancel")
    assert kinds(outputs) == ["Send", "StopCampaign", "Answer", "Persist", "Answer"]
    assert answers(rig)[2][0].exit_code == 1
    assert one(rig.sampling(), StartCampaign).epoch == 2
    rig.request("stop")
    assert kinds(rig.request("cancel")) == ["Persist", "Answer"]  # an interrupted one
    assert one(rig.request("cancel"), Answer).exit_code == 2


def test_a_campaign_that_ends_between_two_questions_sends_nothing() -> None:
    for event in (CampaignFinished(2 * S, 1, 3, complete=False, rejected={}), Requested(2 * S, 9, "cancel", 1)):
        rig = Rig()
        rig.sampling()
        assert of(rig.feed(event), Send) == []
    assert rig.feed(SampleTaken(2 * S, 1, 0, 1, 1, (0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (), 1)) == []


def test_a_campaign_that_ends_early_founds_no_gap() -> None:
    for n, complete in ((57, False), (57, True)):
        rig = lockstep()
        rig.sampling()
        rig.observe()
        outputs = rig.feed(CampaignFinished(rig.t, 1, n, complete, {}, "stuck"))
        assert kinds(outputs) == ["Send", "Answer"]
        assert (one(outputs, Answer).exit_code, "57 of" in one(outputs, Answer).text) == (3, True)
        assert rig.feed(CampaignFinished(rig.t, 1, n, complete, {})) == []


def test_a_gap_in_force_ends_every_certificate_before_it() -> None:
    rig = Rig(memory())
    outputs = rig.gap(radius=0.02)
    assert kinds(outputs) == ["Revoked", "Persist", "EpochChanged", "Answer"]
    kept = one(outputs, Persist).memory
    assert (kept.gap, kept.radius, kept.certificates, kept.campaign_epoch, kept.watch_n) == (rig.state.memory.gap, 0.02, (), 0, 0)
    assert kept.revoked == {"c1": "new_epoch"}
    assert one(outputs, EpochChanged).gap == kept.gap
    assert [a.exit_code for a in answers(rig)[2]] == [0]


@pytest.mark.parametrize(
    "changes",
    [
        {"n": 150},
        {"n": 0},
        {"epoch": 2},
        {"model_digest": "another"},
        {"radius": math.nan},
        {"radius": -1.0},
        {"hold_radius": math.inf},
        {"epsilon": 0.04},
        {"discarded": 1},
    ],
    ids=str,
)
def test_a_gap_that_does_not_carry_its_statement_never_comes_into_force(changes: dict[str, Any]) -> None:
    rig = Rig()
    assert one(rig.gap(**changes), Answer).exit_code == 1
    assert rig.state.memory.gap is None
    assert one(rig.sampling(), StartCampaign).resume


def test_a_gap_job_that_fails_is_said_and_can_be_tried_again() -> None:
    for error in ("out of memory", ""):
        rig = Rig()
        n = one(rig.sampling(), StartCampaign).n
        rig.feed(CampaignFinished(rig.t, 1, n, complete=True, rejected={}))
        assert one(rig.request("sample"), Answer).exit_code == 2
        assert one(rig.request("cancel"), Answer).exit_code == 2
        assert one(rig.finish_gap(None, error), Answer).exit_code == 1
        assert rig.finish_gap(GAP) == []
        assert one(rig.sampling(), StartCampaign).resume


def test_a_sampler_that_nobody_asked_for_is_stopped() -> None:
    rig = Rig()
    assert one(rig.feed(SourceStarted(rig.t, "sampler", "")), StopCampaign).reason == "not_requested"
    assert rig.feed(SourceStarted(rig.t, "recovery", "")) == []
    assert rig.feed(SourceStopped(rig.t, "sampler", "stopped")) == []
    rig.sampling()
    assert rig.feed(SourceStopped(rig.t, "sampler", "finished")) == []  # CampaignFinished says the rest


def test_a_campaign_and_a_deployment_exclude_each_other() -> None:
    rig = Rig(memory())
    rig.sampling()
    assert one(rig.request("sample"), Answer).exit_code == 2
    assert kinds(rig.request("deploy", digest="controller")) == ["Answer"]
    assert rig.outputs[-1].exit_code == 1  # type: ignore[union-attr]
    rig = Rig()
    rig.driving()
    rig.request("permit", duration_s=9.0)
    assert kinds(rig.request("sample")) == ["Answer"]
    assert rig.outputs[-1].exit_code == 1  # type: ignore[union-attr]
    assert one(Rig(memory()).request("sample", count=-1), Answer).exit_code == 2


# ---------------------------------------------------------------- permits, traces, models


@pytest.mark.parametrize("seconds", [-1.0, math.nan, math.inf, 86401.0])
def test_a_permit_has_a_limited_time(seconds: float) -> None:
    rig = Rig()
    assert one(rig.request("permit", duration_s=seconds), Answer).exit_code == 2
    assert rig.state.permit_until_ns is None


def test_tracing_is_a_job_on_the_campaign_in_force() -> None:
    rig = Rig()
    assert one(rig.request("trace"), Answer).exit_code == 3
    rig.gap()
    order = one(rig.request("trace"), StartJob)
    assert (order.kind, order.epoch) == ("trace", 1)
    assert one(rig.request("trace"), Answer).exit_code == 2
    outputs = rig.feed(JobFinished(rig.t, order.job_id, "trace", trace={"verdict": "traced"}))
    assert one(outputs, Answer).exit_code == 0
    assert rig.state.memory.traced
    for trace, error in ((None, ""), ({"verdict": "none"}, "timeout"), ({}, "")):
        order = one(rig.request("trace"), StartJob)
        assert one(rig.feed(JobFinished(rig.t, order.job_id, "trace", trace=trace, error=error)), Answer).exit_code == 1


def test_the_residual_is_traced_after_a_campaign_where_the_profile_says_so() -> None:
    rig = Rig(trace_after_campaign=True)
    order = one(rig.gap(), StartJob)
    assert order.kind == "trace"
    assert of(rig.feed(JobFinished(rig.t, order.job_id, "trace", trace={"verdict": "none"})), Answer) == []
    assert not rig.state.memory.traced


def test_adopting_a_model_ends_all_that_was_shown_with_the_old_one() -> None:
    rig = Rig(memory(alarm_epoch=1, traced=True))
    outputs = rig.request("adopt", digest="better")
    assert kinds(outputs) == ["Revoked", "Persist", "Persist", "ModelAdopted", "Answer"]
    kept = of(outputs, Persist)[-1].memory
    assert (kept.model_digest, kept.gap, kept.alarm_epoch, kept.traced, kept.epochs) == ("better", None, 0, False, 1)
    assert one(outputs, ModelAdopted) == ModelAdopted(rig.t, "better", 1000)
    assert one(rig.request("adopt", digest="better"), Answer).exit_code == 0
    assert one(rig.request("adopt"), Answer).exit_code == 2
    same = Rig(memory())
    assert kinds(same.request("adopt", digest="model")) == ["Answer"]
    assert same.state.memory == memory()
    assert one(rig.request("deploy", digest="controller"), Answer).exit_code == 1


def test_a_model_is_adopted_only_while_nothing_drives_or_works_with_the_old_one() -> None:
    rig = Rig()
    n = one(rig.sampling(), StartCampaign).n
    assert one(rig.request("adopt", digest="better"), Answer).exit_code == 1
    rig.feed(CampaignFinished(rig.t, 1, n, complete=True, rejected={}))
    assert one(rig.request("adopt", digest="better"), Answer).exit_code == 1
    rig = Rig()
    rig.driving()
    assert one(rig.request("adopt", digest="better"), Answer).exit_code == 1
