"""How sources come and go and how runs begin and end, field by field: what is reset, what stays, what is told to whom."""

from __future__ import annotations

import math
from typing import Any

import msgspec
from core_rig import GAP, Rig, S, kinds, memory, of, one, reason, sources

from s2r_runtime import gate
from s2r_runtime.core import certificates, drive, gaps, ledger, repair, requests, stream
from s2r_runtime.core import reducer as core
from s2r_runtime.core import sources as sources_of
from s2r_runtime.core.state import Campaign, Deployment, Job, Turn, certificate, job, situation, unix_now
from s2r_runtime.messages import (
    MEMORY_SCHEMA,
    SERIAL,
    Answer,
    CampaignFinished,
    CertificatesDistrusted,
    GateChanged,
    LinkChanged,
    Memory,
    Persist,
    Revoked,
    SampleTaken,
    SourceStarted,
    SourceStopped,
    Started,
    StopCampaign,
    StopController,
    Stopping,
    Ticked,
    TraceEnded,
    WallClockRead,
)

replace = msgspec.structs.replace


def changed(rig: Rig, **changes: Any) -> None:
    rig.state = replace(rig.state, **changes)


def remembered(rig: Rig, **changes: Any) -> None:
    changed(rig, memory=replace(rig.state.memory, **changes))


# ---------------------------------------------------------------- beginning


def test_before_anything_happened_nothing_is_so() -> None:
    state = msgspec.to_builtins(core.initial())
    assert state.pop("memory") == msgspec.to_builtins(Memory("", 0))
    said = {"gate_reason": "not_started", "gate_said": "not_started"}
    true = {"recorder_ok": True, "analytics_up": True, "answered": True}
    numbers = {"controller_seq": -1, "sampler_seq": -1, "next_job": 1, "saved_e_value": 1.0, "read_unix_s": -1}
    assert {key: value for key, value in state.items() if value} == said | true | numbers
    assert {repr(value) for key, value in state.items() if not value} == {"None", "''", "False", "0", "0.0", "()"}
    assert Deployment("c", 1, "starting") == Deployment("c", 1, "starting", certificate_id="", running="")
    assert Campaign(1, 2, 3) == Campaign(1, 2, 3, running=False, taken=0, inputs="")
    plain = Job(1, "gap", 2, 3)
    assert plain == Job(1, "gap", 2, 3, "", 0, 0.0, 0.0, "", again=False, stretch="campaign", least_radius=0.0)


def test_the_constants_of_the_core_are_these() -> None:
    assert (certificates.ROUNDING, drive.RETURNED_WITHIN_M, drive.LOST_AFTER_REPEATS, gaps.REFUTED) == (1e-9, 0.05, 2, 100)
    assert (ledger.MAX_SAMPLES, repair.GROWN, repair.PROFILE, requests.LONGEST_PERMIT_S) == (10**9, 1.1, -1, 86_400.0)
    assert repair.STRETCHES == {"": "campaign", "campaign": "campaign", "drive": "drive", "inputs": "inputs"}
    assert set(requests.HINTS) <= {*gate.REASONS}
    assert set(sources_of.INTERRUPTS) <= {*gate.REASONS}
    assert sources_of.FAULTS == ("raised", "died", "deadline", "malformed", "inconsistent")
    assert (stream.BINS, stream.EXACT_TERMS, stream.EDGES[:3], stream.EDGES[16:18]) == (33, 30, (0.0, 0.0625, 0.125), (1.0, 1.25))


def test_a_run_begins_at_its_own_time() -> None:
    rig = Rig(start=False)
    rig.feed(Started(5 * S, 1500, rig.settings, rig.memory))
    assert (rig.state.now_ns, rig.state.unix_ns, rig.state.unix_s) == (5 * S, 5 * S, 1500)
    assert unix_now(rig.state) == 1500
    rig.feed(Ticked(7 * S + S // 2))
    assert unix_now(rig.state) == 1502
    rig.feed(WallClockRead(8 * S, 1600))
    assert (rig.state.unix_ns, unix_now(rig.state)) == (8 * S, 1600)


def test_the_gates_first_reason_is_known_from_the_start_on() -> None:
    rig = Rig(start=False)
    outputs = rig.feed(Started(S, 1500, rig.settings, rig.memory))
    assert [change.reason for change in of(outputs, GateChanged)] == ["link_down"]
    assert reason(rig) == "link_down"


def test_a_first_start_voids_nothing_and_takes_model_and_campaign_as_they_are() -> None:
    rig = Rig(Memory("r", MEMORY_SCHEMA, gap=GAP, radius=0.01), start=False)
    outputs = rig.feed(Started(S, 1500, rig.settings, rig.memory))
    kept = one(outputs, Persist).memory
    assert (kept.gap, kept.model_digest, kept.campaign_digest) == (GAP, "model", "campaign")


def test_another_comparison_is_remembered_as_the_one_in_force() -> None:
    rig = Rig(memory(campaign_digest="other"), start=False)
    outputs = rig.feed(Started(S, 1500, rig.settings, rig.memory))
    assert (rig.state.memory.gap, rig.state.memory.campaign_digest) == (None, "campaign")
    assert [one.reason for one in of(outputs, Revoked)] == ["profile_changed"]


def test_a_refused_memory_is_the_gates_reason_and_says_whose_it_is() -> None:
    rig = Rig(Memory("other", MEMORY_SCHEMA), start=False)
    (change,) = of(rig.feed(Started(S, 1500, rig.settings, rig.memory)), GateChanged)
    text = "the memory is of robot 'other', this is 'r'"
    assert change == GateChanged(S, open=False, reason="memory_refused", detail=text)
    assert (reason(rig), rig.state.gate_said, rig.state.refusal) == ("memory_refused", "memory_refused", text)
    assert rig.feed(Started(S, 1500, rig.settings, memory())) == []  # not even with the right one: it is started again for that
    assert one(rig.request("stop"), Answer) == Answer(S, 1, 78, text)


# ---------------------------------------------------------------- ending


def test_the_last_event_ends_every_job_and_tells_who_waits() -> None:
    rig = Rig()
    rig.gap()
    rig.request("verify", digest="c")
    rig.request("trace")
    outputs = rig.feed(Stopping(rig.t))
    assert [(answer.exit_code, answer.text) for answer in of(outputs, Answer)] == [(1, "the daemon stopped before this was done")] * 2
    assert [ended.stretch for ended in of(outputs, TraceEnded)] == ["campaign"]
    assert (rig.state.jobs, rig.state.issuing, reason(rig)) == ((), None, "stopping")
    assert situation(rig.state).stopping


def test_a_certificate_that_is_being_signed_at_the_end_is_told_to_nobody_later() -> None:
    rig = Rig()
    rig.gap()
    request = rig.requests + 1
    rig.request("verify", digest="c")
    rig.verified()
    assert rig.state.issuing is not None
    outputs = rig.feed(Stopping(rig.t))
    assert [answer.request_id for answer in of(outputs, Answer)] == [request]
    assert rig.state.issuing is None
    assert of(outputs, TraceEnded) == []


# ---------------------------------------------------------------- sources


def test_a_deployment_that_ends_forgives_its_faults_and_answers_only_its_own_question() -> None:
    rig = Rig()
    rig.driving()
    rig.measure(0.001, fault="jump")
    assert rig.state.faults == 1
    rig.observe()
    assert sources(rig.request("undeploy")) == ["recovery"]
    assert rig.state.faults == 0
    rig = Rig()
    rig.sampling()
    rig.observe()
    assert rig.state.asked is not None
    assert sources(rig.feed(SourceStopped(rig.t, "controller", "died"))) == []
    assert rig.state.asked is not None


def test_numbers_of_commands_begin_anew_with_each_source() -> None:
    rig = Rig()
    rig.driving()
    assert rig.state.controller_seq > 0
    rig.request("undeploy")
    rig.request("deploy", digest="controller")
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    assert rig.state.controller_seq == -1
    rig = Rig()
    rig.sampling()
    rig.observe()
    rig.propose(source="sampler")
    assert rig.state.sampler_seq > 0
    rig.request("cancel")
    rig.request("sample")
    rig.feed(SourceStarted(rig.t, "sampler", ""))
    assert rig.state.sampler_seq == -1


def test_a_second_controller_is_a_fault_that_is_told_once_with_its_reason() -> None:
    rig = Rig()
    rig.driving()
    outputs = rig.feed(SourceStarted(rig.t, "controller", "controller"))
    assert [stop.reason for stop in of(outputs, StopController)] == ["malformed"]
    change = next(change for change in of(outputs, GateChanged))
    assert (change.reason, change.detail) == ("controller_fault", "malformed: a second one started beside it")


def test_a_controller_that_is_gone_is_not_told_to_stop() -> None:
    for why in ("raised", "finished"):
        rig = Rig()
        rig.driving()
        assert of(rig.feed(SourceStopped(rig.t, "controller", why)), StopController) == []  # type: ignore[arg-type]
        assert rig.state.deployment is None


def test_a_sampler_that_stops_leaves_a_controller_alone() -> None:
    rig = Rig()
    rig.driving()
    rig.feed(SourceStopped(rig.t, "sampler", "raised"))
    assert rig.state.gate_open
    rig.feed(SourceStopped(rig.t, "recovery", "raised"))
    assert rig.state.gate_open


def test_a_campaign_that_was_stopped_says_where_and_that_it_can_go_on() -> None:
    rig = Rig()
    rig.sampling()
    outputs = rig.feed(SourceStopped(rig.t, "sampler", "raised"))
    assert of(outputs, StopCampaign) == []
    text = "campaign of epoch 1 stopped after 0 of 161 samples: raised; s2r sample goes on with it"
    assert [(answer.exit_code, answer.text) for answer in of(outputs, Answer)] == [(1, text)]


def test_a_link_that_comes_back_forgets_nothing() -> None:
    rig = Rig()
    rig.observe()
    rig.feed(LinkChanged(rig.t, up=True))
    assert rig.state.observation is not None


def test_a_clock_that_steps_back_takes_the_time_of_everything_along() -> None:
    rig = Rig()
    rig.observe()
    rig.feed(WallClockRead(rig.t, 1600))
    rig.feed(Ticked(rig.t - S // 2))
    assert rig.state.now_ns == rig.t - S // 2
    assert (rig.state.unix_ns, unix_now(rig.state)) == (rig.t - S // 2, 1600)
    assert rig.state.permit_until_ns is None
    assert situation(rig.state).clock_ns == rig.t - S // 2
    assert sources(rig.feed(Ticked(rig.t))) == []  # nothing was sent yet, by this clock, that could be due again


# ---------------------------------------------------------------- what the gate is told


def test_a_certificate_is_found_by_its_id_alone() -> None:
    first, second = (replace(memory().certificates[0], id=name) for name in ("c1", "c2"))
    rig = Rig(memory(certificates=(first, second)))
    assert certificate(rig.state) is None
    rig.observe()
    rig.request("deploy", digest="controller")
    assert certificate(rig.state) == second
    remembered(rig, certificates=(first, replace(second, id="")))
    assert certificate(rig.state) is None


def test_the_gate_is_told_what_is_so() -> None:
    rig = Rig()
    seen = situation(rig.state)
    assert (seen.radius, seen.epoch, seen.alarmed, seen.campaign_running, seen.revoked) == (math.inf, 0, False, False, False)
    assert (seen.asked_seq, seen.asked_ns) == (None, 0)
    rig.sampling()
    rig.observe()
    rig.propose(source="sampler")
    rig.observe()
    seen = situation(rig.state)
    assert (seen.campaign_running, seen.asked_seq, seen.asked_ns) == (True, rig.seq, rig.t)
    assert seen.last_command_seq == rig.state.sampler_seq > rig.state.controller_seq
    changed(rig, campaign=replace(rig.state.campaign, running=False))  # type: ignore[type-var]
    assert not situation(rig.state).campaign_running


def test_a_revoked_certificate_is_told_to_the_gate_even_while_its_deployment_is_there() -> None:
    rig = Rig(memory())
    rig.observe()
    rig.request("deploy", digest="controller")
    remembered(rig, revoked={"c1": "by_operator"})
    assert situation(rig.state).revoked


def test_a_verification_beside_driving_is_told_to_the_gate() -> None:
    rig = Rig()
    rig.driving()
    assert not situation(rig.state).verifying
    rig.measure(0.5)
    assert job(rig.state, "reverify") is not None
    assert situation(rig.state).verifying


def test_what_may_wait_for_the_disk_is_written_as_soon_as_nothing_drives_and_no_campaign_runs() -> None:
    for campaign, writes in ((True, False), (False, True)):
        rig = Rig()
        rig.sampling() if campaign else rig.observe()
        turn = Turn(rig.state, rig.settings, rig.t)
        turn.remember_later(traced=True)
        turn.persist()
        assert (kinds(turn.outputs) == ["Persist"]) == writes
        assert turn.state.unsaved != writes


def test_measured_is_what_the_watch_counted() -> None:
    rig = Rig(memory())
    assert (rig.state.measured, rig.state.e_value) == (7, 3.0)


# ---------------------------------------------------------------- campaigns and gaps


def test_a_sample_counts_for_its_own_campaign() -> None:
    zeros = (0.0, 0.0, 0.0)
    rig = Rig()
    rig.sampling()
    for epoch, index in ((1, 4), (2, 9)):
        rig.feed(SampleTaken(rig.t, epoch, index, 1, 1, (0.0, 0.0), zeros, zeros, (), 1))
    assert rig.state.campaign is not None
    assert rig.state.campaign.taken == 5


def test_the_end_of_another_campaign_ends_none_and_asks_nobody() -> None:
    rig = Rig()
    rig.sampling()
    rig.observe()
    assert rig.feed(CampaignFinished(rig.t, 2, 161, True, {})) == []
    assert rig.state.campaign is not None
    assert sources(rig.feed(CampaignFinished(rig.t, 1, 161, True, {}))) == ["recovery"]


def test_too_few_samples_and_none_asked_for_say_how_many_are_lacking() -> None:
    rig = Rig()
    rig.observe()
    rig.request("permit", duration_s=60.0)
    answer = one(rig.request("sample", count=100), Answer)
    assert (answer.exit_code, answer.text) == (
        3,
        "epoch 1 needs at least 161 samples at epsilon 0.03 with 0 discarded; 100 are 61 too few",
    )


def test_samples_that_depend_on_each_other_end_their_campaign_for_good() -> None:
    rig = Rig()
    outputs = rig.gap(white_reason=f"{SERIAL}: 0.9")
    kept = one(outputs, Persist).memory
    assert (kept.campaign_epoch, kept.campaign_n, kept.gap, kept.epochs) == (0, 0, None, 1)
    assert kinds(outputs) == ["Persist", "Answer"]
    assert one(outputs, Answer).exit_code == 3


def test_an_error_beside_a_gap_is_an_error() -> None:
    for white in ("", f"{SERIAL}: 0.9"):
        rig = Rig()
        rig.sampling()
        rig.feed(CampaignFinished(rig.t, 1, 161, True, {}))
        outputs = rig.finish_gap(replace(GAP, n=161, white_reason=white), "killed")
        text = "no gap: killed; s2r sample tries again with the samples that are there"
        assert [(answer.exit_code, answer.text) for answer in of(outputs, Answer)] == [(1, text)]
        assert rig.state.memory.gap is None


def test_a_gap_in_force_ends_what_was_known_of_the_one_before() -> None:
    rig = Rig(memory(alarm_epoch=1, traced=True, campaign_epoch=0, campaign_n=5, watch_exceedances=3))
    outputs = rig.gap()
    kept = rig.state.memory
    assert (kept.alarm_epoch, kept.traced, kept.campaign_n, kept.campaign_epoch, kept.campaign_digest) == (0, False, 0, 0, "campaign")
    assert (kept.watch_n, kept.watch_exceedances, kept.watch_e_value, kept.watch_counts) == (0, 0, 1.0, ())
    assert kept.refuted == ("transitions",)
    (answer,) = [answer for answer in of(outputs, Answer) if answer.final]
    assert (answer.exit_code, answer.text) == (0, "gap of epoch 2: 0.01 at epsilon 0.03, from 206 samples")


def test_adopting_begins_without_anything_of_the_old_model() -> None:
    rig = Rig(memory(campaign_epoch=2, campaign_n=300, watch_exceedances=3))
    changed(rig, trace_due_ns=5, traced_radius=1.0, driven=True)
    outputs = rig.request("adopt", digest="better")
    kept = rig.state.memory
    assert (kept.gap, kept.campaign_epoch, kept.campaign_n, kept.watch_exceedances, kept.model_digest) == (None, 0, 0, 0, "better")
    assert (rig.state.trace_due_ns, rig.state.traced_radius, rig.state.driven) == (None, 0.0, False)
    assert [one.reason for one in of(outputs, Revoked)] == ["model_changed"]
    assert of(outputs, Answer)[-1].exit_code == 0


def test_an_alarm_latches_revokes_its_own_epochs_certificates_and_says_why() -> None:
    other = replace(memory().certificates[0], id="other", epoch=9)
    rig = Rig(memory(certificates=(memory().certificates[0], other)))
    rig.observe()
    outputs = rig.measure(0.001, e_value=1e3)
    assert rig.state.memory.latched == ("watch_alarm",)
    assert [(one.certificate_id, one.reason) for one in of(outputs, Revoked)] == [("c1", "watch_alarm")]


def test_only_the_certificates_that_are_named_are_distrusted() -> None:
    other = replace(memory().certificates[0], id="other", controller_digest="x")
    rig = Rig(memory(certificates=(memory().certificates[0], other)))
    outputs = rig.feed(CertificatesDistrusted(rig.t, {"c1": "revoked", "nobody's": "revoked"}))
    assert [(one.certificate_id, one.reason) for one in of(outputs, Revoked)] == [("c1", "key: revoked")]
    assert [facts.id for facts in rig.state.memory.certificates] == ["other"]
