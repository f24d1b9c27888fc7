"""What a person is answered, word for word where the words say what to do next, and what an answer leaves behind."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from core_rig import Rig, kinds, memory, of, one, sources
from loaded_rig import loaded

from s2r_runtime.core import reducer as core
from s2r_runtime.messages import (
    Answer,
    AttemptEnded,
    CampaignFinished,
    CertificateFailed,
    InputsFinished,
    JobFinished,
    Output,
    Persist,
    Revoked,
    SourceStarted,
    SourceStopped,
    StartJob,
    StopCampaign,
    StopController,
    Stopping,
)

NEXT = "the gate stays closed until these are cleared"


def said(outputs: list[Output]) -> list[tuple[int, str, bool]]:
    return [(answer.exit_code, answer.text, answer.final) for answer in of(outputs, Answer)]


def final(code: int, text: str) -> list[tuple[int, str, bool]]:
    return [(code, text, True)]


def ready() -> Rig:
    """A robot that is seen, and a gap with a certificate on it."""
    rig = Rig(memory())
    rig.observe()
    return rig


def latched(*reasons: str) -> Rig:
    rig = Rig(memory(latched=reasons))
    rig.observe()
    return rig


# ---------------------------------------------------------------- stops, clearing, revoking


def test_a_stop_says_what_ends_it() -> None:
    assert said(ready().request("stop")) == final(0, "stopped; nothing drives until: s2r clear emergency_stop")


@pytest.mark.parametrize(
    ("held", "text", "code", "words"),
    [
        ((), "", 2, "no reason is not latched; nothing is latched"),
        ((), "link_down", 2, "link_down is not latched; nothing is latched"),
        (("watch_alarm", "link_down"), "", 2, "no reason is not latched; latched: watch_alarm, link_down"),
        (("watch_alarm",), "command_invalid", 2, "command_invalid is not latched; latched: watch_alarm"),
        (("command_invalid",), "latched:command_invalid", 0, "command_invalid cleared"),
        (("watch_alarm",), "watch_alarm", 0, "watch_alarm cleared"),
    ],
)
def test_clearing_says_what_is_latched_and_what_is_not(held: tuple[str, ...], text: str, code: int, words: str) -> None:
    rig = latched(*held)
    assert said(rig.request("clear", text=text)) == final(code, words)


def test_clearing_an_alarm_says_that_the_gap_stays_refuted() -> None:
    rig = Rig(memory(latched=("watch_alarm", "command_invalid"), alarm_epoch=1))
    assert said(rig.request("clear", text="command_invalid")) == final(0, "command_invalid cleared")
    assert said(rig.request("clear", text="watch_alarm")) == final(0, "watch_alarm cleared; the gap stays refuted, sample anew: s2r sample")


def test_what_was_cleared_is_on_the_disk_before_it_is_said_and_before_anything_drives() -> None:
    rig = latched("command_invalid")
    outputs = rig.request("clear", text="command_invalid")
    assert kinds(outputs)[0] == "Persist"
    assert one(outputs, Persist).memory.latched == ()


def test_clearing_measurement_faults_forgives_them_and_clearing_others_does_not() -> None:
    for reason, left in (("measurement_faults", 0), ("command_invalid", 3)):
        rig = Rig()
        rig.driving()
        for _ in range(3):
            rig.measure(0.001, fault="jump")
        rig.state = msgspec.structs.replace(rig.state, memory=msgspec.structs.replace(rig.state.memory, latched=(reason,)))
        rig.request("clear", text=reason)
        assert rig.state.faults == left


def test_clearing_what_ended_the_last_deployment_takes_it_out_of_the_status_and_nothing_else_does() -> None:
    for reason in ("controller_fault", "command_invalid"):
        rig = Rig()
        rig.deployed()
        rig.feed(SourceStopped(rig.t, "controller", "died"))
        other = msgspec.structs.replace(rig.state.memory, latched=("controller_fault", "command_invalid"))
        rig.state = msgspec.structs.replace(rig.state, memory=other)
        rig.request("clear", text=reason)
        assert rig.state.ended == ("" if reason == "controller_fault" else "controller_fault")


def test_revoking_says_how_many_which_and_what_there_is() -> None:
    rig = Rig(memory())
    assert said(rig.request("revoke", text="c9")) == final(2, "no certificate c9; in force: c1")
    outputs = rig.request("revoke", text="c1")
    assert [(one.certificate_id, one.reason) for one in of(outputs, Revoked)] == [("c1", "by_operator")]
    assert said(outputs) == final(0, "certificate c1 revoked")
    assert said(rig.request("revoke", text="c1")) == final(0, "certificate c1 was revoked before: by_operator")
    assert said(rig.request("revoke", text="c9")) == final(2, "no certificate c9; in force: none")
    assert said(rig.request("revoke")) == final(0, "there is no certificate to revoke")
    rig = Rig(memory())
    outputs = rig.request("revoke")
    assert [(one.certificate_id, one.reason) for one in of(outputs, Revoked)] == [("c1", "by_operator")]
    assert said(outputs) == final(0, "1 certificates revoked")
    assert rig.state.memory.revoked == {"c1": "by_operator"}


# ---------------------------------------------------------------- permits, sampling, inputs


@pytest.mark.parametrize(
    ("seconds", "code", "text", "lasts"),
    [
        (60.0, 0, "the sampler may drive for 60 s", 60.0),
        (0.5, 0, "the sampler may drive for 0.5 s", 0.5),
        (86_400.0, 0, "the sampler may drive for 86400 s", 86_400.0),
        (0.0, 0, "the sampler may not drive", 0.0),
        (86_400.5, 2, "a permit lasts 0 (none) to 86400 s, not 86400.5", 0.0),
        (-1.0, 2, "a permit lasts 0 (none) to 86400 s, not -1.0", 0.0),
        (math.inf, 2, "a permit lasts 0 (none) to 86400 s, not inf", 0.0),
        (math.nan, 2, "a permit lasts 0 (none) to 86400 s, not nan", 0.0),
    ],
)
def test_a_permit_says_how_long_it_lasts(seconds: float, code: int, text: str, lasts: float) -> None:
    rig = ready()
    assert said(rig.request("permit", duration_s=seconds)) == final(code, text)
    assert core.status(rig.state)["permit_left_s"] == lasts


def test_a_permit_that_is_taken_back_ends_the_campaign_at_once() -> None:
    rig = Rig()
    rig.sampling()
    outputs = rig.request("permit", duration_s=0.0)
    assert one(outputs, StopCampaign).reason == "no_permit"
    assert rig.state.campaign is None
    assert said(outputs)[-1] == (0, "the sampler may not drive", True)


@pytest.mark.parametrize(
    ("prepare", "verb", "code", "text"),
    [
        (lambda rig: None, "sample", 1, "refused: no_permit: give one: s2r permit DURATION"),
        (lambda rig: rig.request("stop"), "sample", 1, "refused: emergency_stop: s2r clear emergency_stop, when it is safe"),
        (
            lambda rig: (rig.request("permit", duration_s=9.0), rig.observe((math.nan, 0.0, 0.0))),
            "sample",
            1,
            "refused: observation_invalid",
        ),
        (lambda rig: rig.request("deploy", digest="controller"), "sample", 1, "refused: a controller is deployed; undeploy it first"),
        (lambda rig: None, "cancel", 2, "there is no campaign to cancel"),
        (lambda rig: None, "undeploy", 2, "no controller is deployed"),
        (lambda rig: None, "deploy", 2, "deploy needs a controller"),
        (lambda rig: None, "verify", 2, "verify needs a controller"),
        (lambda rig: None, "adopt", 2, "adopt needs a model"),
    ],
)
def test_what_stands_against_a_request_is_said_with_what_would_help(
    prepare: Callable[[Rig], object], verb: str, code: int, text: str
) -> None:
    rig = ready()
    if verb == "sample" and "permit" not in text and "stop" not in text:
        rig.request("permit", duration_s=60.0)
    prepare(rig)
    assert said(rig.request(verb)) == final(code, text)


def test_a_latched_reason_is_named_with_its_hint() -> None:
    rig = latched("outside_geofence")
    rig.request("permit", duration_s=60.0)
    text = "refused: latched:outside_geofence: the sampler may only drive inside it; bring the robot back"
    assert said(rig.request("sample")) == final(1, text)


def test_samples_and_rows_are_counted_from_one() -> None:
    rig = ready()
    rig.request("permit", duration_s=60.0)
    assert said(rig.request("sample", count=-1)) == final(2, "-1 samples make no campaign")
    assert said(rig.request("excite", digest="inputs", count=0)) == final(2, "there are no inputs to drive")
    assert said(rig.request("excite", digest="", count=5)) == final(2, "there are no inputs to drive")
    assert said(rig.request("excite", digest="inputs", count=1)) == []
    assert said(rig.request("sample")) == final(2, "inputs are being driven already")


def exciting(rows: int = 5) -> Rig:
    rig = ready()
    rig.request("permit", duration_s=60.0)
    rig.request("excite", digest="inputs", count=rows)
    rig.feed(SourceStarted(rig.t, "sampler", "inputs"))
    return rig


@pytest.mark.parametrize(
    ("event", "code", "text"),
    [
        ({"n": 5, "complete": True}, 0, "5 rows driven and recorded; no gap: these inputs were chosen, not drawn"),
        ({"n": 4, "complete": True}, 1, "inputs ended after 4 of 5 rows"),
        ({"n": 5, "complete": False}, 1, "inputs ended after 5 of 5 rows"),
        ({"n": 3, "complete": False, "detail": "no time"}, 1, "inputs ended after 3 of 5 rows: no time"),
    ],
    ids=str,
)
def test_given_inputs_end_with_what_became_of_them(event: dict[str, Any], code: int, text: str) -> None:
    rig = exciting()
    ((found, words, done),) = said(rig.feed(InputsFinished(rig.t, "inputs", **event)))
    assert (found, done) == (code, True)
    assert words.startswith(text)
    assert words == text or code == 0
    assert rig.state.campaign is None


def test_a_sequence_that_got_a_hole_in_it_says_what_made_it() -> None:
    rig = exciting()
    rig.observe((math.nan, 0.0, 0.0))
    assert rig.state.campaign is not None  # nothing was driven yet, so there is no hole
    rig.observe()
    rig.propose(source="sampler")
    outputs = rig.observe((math.nan, 0.0, 0.0))
    if rig.state.asked is not None:
        outputs = rig.propose(source="sampler")
    assert said(outputs) == final(1, "inputs stopped after 1 of 5 rows: observation_invalid")


def test_the_end_of_other_inputs_ends_none() -> None:
    rig = exciting()
    assert rig.feed(InputsFinished(rig.t, "others", 5, True)) == []
    assert rig.state.campaign is not None


def test_cancelling_inputs_and_campaigns_says_how_far_they_came_and_stops_the_sampler() -> None:
    rig = exciting()
    rig.observe()
    rig.propose(source="sampler")
    rig.observe()
    outputs = rig.request("cancel")
    assert sources(outputs) == ["recovery"]
    assert one(outputs, StopCampaign).reason == "cancelled"
    assert said(outputs) == [(1, "inputs stopped after 1 of 5 rows: cancelled", True), (0, "inputs cancelled after 1 of 5 rows", True)]
    rig = Rig()
    rig.sampling()
    rig.observe()
    assert rig.state.asked is not None
    outputs = rig.request("cancel")
    assert sources(outputs) == ["recovery"]
    assert one(outputs, StopCampaign).reason == "cancelled"
    assert said(outputs) == [
        (1, "campaign of epoch 1 cancelled after 0 of 161 samples", True),
        (0, "campaign of epoch 1 cancelled; its share of beta is spent", True),
    ]
    assert (rig.state.memory.campaign_epoch, rig.state.memory.campaign_n, rig.state.memory.epochs) == (0, 0, 1)


@pytest.mark.parametrize(
    ("event", "text"),
    [
        ({"n": 161, "complete": False}, "campaign of epoch 1 ended after 161 of 161 samples; s2r sample goes on with it"),
        ({"n": 7, "complete": True}, "campaign of epoch 1 ended after 7 of 161 samples; s2r sample goes on with it"),
        (
            {"n": 7, "complete": False, "detail": "the robot is gone"},
            "campaign of epoch 1 ended after 7 of 161 samples: the robot is gone; s2r sample goes on with it",
        ),
    ],
    ids=str,
)
def test_a_campaign_that_is_not_complete_says_so(event: dict[str, Any], text: str) -> None:
    rig = Rig()
    rig.sampling()
    outputs = rig.feed(CampaignFinished(rig.t, 1, rejected={}, **event))
    assert said(outputs) == final(3, text)
    assert of(outputs, StartJob) == []


def test_a_complete_campaign_orders_its_gap_and_says_so_on_the_way() -> None:
    rig = Rig()
    rig.sampling()
    outputs = rig.feed(CampaignFinished(rig.t, 1, 161, True, {}))
    job = one(outputs, StartJob)
    assert (job.kind, job.epoch, job.beta) == ("gap", 1, pytest.approx(3 * 0.05 / math.pi**2))
    assert said(outputs) == [(0, "161 samples taken; computing the gap", False)]
    assert said(rig.request("cancel")) == final(2, "there is no campaign to cancel")
    assert said(rig.request("deploy", digest="c")) == final(1, "refused: a campaign is under way")
    assert said(rig.feed(loaded(2))) == [(1, "certificate offline refused: a campaign is under way", False)]


@pytest.mark.parametrize(("error", "text"), [("killed", "killed"), ("", "the worker returned none")], ids=["an error", "nothing"])
def test_a_gap_job_without_a_gap_says_why(error: str, text: str) -> None:
    rig = Rig()
    rig.sampling()
    rig.feed(CampaignFinished(rig.t, 1, 161, True, {}))
    assert said(rig.finish_gap(None, error)) == final(1, f"no gap: {text}; s2r sample tries again with the samples that are there")
    assert rig.state.memory.campaign_n == 161


# ---------------------------------------------------------------- deployments


def test_undeploying_says_so_and_tells_the_daemon_why() -> None:
    rig = Rig()
    rig.deployed()
    outputs = rig.request("undeploy")
    assert one(outputs, StopController).reason == "undeployed"
    assert said(outputs) == final(0, "undeployed")


def test_a_deployment_says_what_still_keeps_the_gate_closed() -> None:
    for held, more in (((), ""), (("command_invalid", "watch_alarm"), f"; {NEXT}: command_invalid, watch_alarm")):
        rig = Rig(memory(latched=held))
        rig.observe()
        rig.request("deploy", digest="controller")
        assert said(rig.feed(SourceStarted(rig.t, "controller", "controller"))) == final(0, f"deployed under certificate c1{more}")


@pytest.mark.parametrize(
    ("reason", "detail", "text"),
    [
        ("finished", "", "refused: the controller is gone (finished)"),
        ("start_failed", "no memory", "refused: the controller is gone (start_failed: no memory)"),
        ("raised", "", "refused: the controller failed (raised)"),
        ("died", "SIGKILL", "refused: the controller failed (died: SIGKILL)"),
    ],
)
def test_a_controller_that_ends_before_it_runs_is_told_with_its_reason(reason: Any, detail: str, text: str) -> None:
    rig = ready()
    rig.request("deploy", digest="controller")
    outputs = rig.feed(SourceStopped(rig.t, "controller", reason, detail))
    assert said(outputs) == final(1, text)
    assert of(outputs, StopController) == []  # it is gone already


def test_the_reason_of_an_attempt_is_in_its_record() -> None:
    for changes, reason in (({}, "every required law passed"), ({"reason": "all passed, narrowly"}, "all passed, narrowly")):
        rig = Rig()
        rig.gap()
        rig.request("deploy", digest="controller")
        assert one(rig.verified(**changes), AttemptEnded).reason == reason
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    outputs = rig.feed(JobFinished(rig.t, rig.state.jobs[0].id, "verify"))
    assert (one(outputs, AttemptEnded).passed, one(outputs, AttemptEnded).reason) == (False, "the worker returned no verification")
    assert said(outputs)[-1][1].endswith("failed: the worker returned no verification")


def test_a_certificate_that_fails_is_told_to_whom_it_concerns() -> None:
    rig = ready()
    assert said(rig.feed(CertificateFailed(rig.t, "its key is not trusted", 9))) == [
        (1, "certificate refused: its key is not trusted", False)
    ]
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    rig.verified()
    assert rig.state.issuing is not None
    outputs = rig.feed(CertificateFailed(rig.t, "no key", rig.state.issuing.request_id))
    assert said(outputs) == final(1, "refused: the certificate could not be issued: no key")
    assert rig.state.issuing is None


def test_after_the_end_and_before_the_start_requests_are_told_which_it_is() -> None:
    rig = Rig(start=False)
    assert said(rig.request("stop")) == final(1, "the daemon has not started")
    rig = Rig()
    rig.feed(Stopping(rig.t))
    assert said(rig.request("stop")) == final(1, "the daemon is stopping")
