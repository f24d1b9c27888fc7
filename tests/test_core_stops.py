"""Stops, the robot and its link, clocks, the recovery command: what goes wrong around a drive, and what the core sends then."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from core_rig import DT, Rig, S, answers, kinds, lockstep, of, one, reason, reopen, sources

from s2r_runtime.core import reducer as core
from s2r_runtime.messages import (
    AnalyticsChanged,
    Answer,
    AnswerLate,
    Ask,
    GateChanged,
    LinkChanged,
    Observation,
    Observed,
    Output,
    OverrideChanged,
    Persist,
    RecorderChanged,
    Send,
    StopCampaign,
    StopController,
    Stopping,
    Ticked,
)

# ---------------------------------------------------------------- stops


@pytest.mark.parametrize("how", ["request", "signal"])
def test_a_stop_beats_everything_and_latches(how: str) -> None:
    rig = Rig(recovery="hold", recovery_input=(0.1, 0.0))
    rig.driving()
    outputs = rig.request("stop") if how == "request" else rig.feed(OverrideChanged(rig.t, "emergency_stop", "button"))
    assert kinds(outputs)[:2] == ["GateChanged", "Send"]
    assert (one(outputs, Send).source, one(outputs, Send).u) == ("recovery", (0.0, 0.0))  # not the recovery that drives on
    assert of(outputs, StopController)
    assert one(outputs, Persist).memory.latched == ("emergency_stop",)
    assert one(rig.request("deploy", digest="controller"), Answer).exit_code == 1
    rig.observe()
    rig.request("permit", duration_s=9.0)
    assert one(rig.request("sample"), Answer).exit_code == 1
    assert one(rig.observe(), Send).u == (0.0, 0.0)
    rig.request("clear", text="emergency_stop")
    assert reason(rig) == "no_controller"
    assert one(rig.observe(), Send).u == (0.1, 0.0)


def test_a_stop_in_the_middle_of_a_campaign_answers_the_robot_at_once() -> None:
    rig = lockstep()
    rig.sampling()
    rig.observe()
    outputs = rig.request("stop")
    assert kinds(outputs) == ["GateChanged", "Send", "StopCampaign", "Answer", "Persist", "Answer"]
    assert one(outputs, StopCampaign).reason == "emergency_stop"
    assert kinds(rig.propose((0.1, 0.0), "sampler")) == ["Decided"]


def test_a_stop_ends_the_silence_and_the_robot_settles_once_more() -> None:
    rig = lockstep()
    for _ in range(6):
        rig.observe()
    assert one(rig.request("stop"), Send).obs_seq == rig.seq
    assert [len(of(rig.observe(), Send)) for _ in range(7)] == [1, 1, 1, 1, 1, 0, 0]
    assert sources(rig.request("stop")) == ["recovery"]
    assert rig.state.memory.latched == ("emergency_stop",)


def test_in_lockstep_a_robot_that_has_its_answer_is_stopped_with_the_next_one() -> None:
    rig = lockstep()
    rig.driving()
    assert sources(rig.request("stop")) == []
    assert one(rig.observe(), Send).u == (0.0, 0.0)


def test_the_last_event_stops_everything_answers_everybody_and_writes_the_memory() -> None:
    rig = Rig(recovery="hold", recovery_input=(0.1, 0.0))
    rig.driving()
    rig.measure(0.001)
    rig.request("verify", digest="next")
    rig.request("trace")
    outputs = rig.feed(Stopping(rig.t, "SIGTERM"))
    assert kinds(outputs)[:2] == ["GateChanged", "Send"]
    assert one(outputs, Send).u == (0.0, 0.0)
    assert isinstance(outputs[-1], Persist)
    assert outputs[-1].memory.watch_n == 10
    assert all(len(found) == 1 for found in answers(rig).values())
    assert rig.observe() + rig.feed(Ticked(rig.t)) + rig.request("permit")[1:] == []
    assert one(rig.outputs[-1:], Answer).exit_code == 1


def test_stopping_in_every_other_chapter_leaves_no_request_unanswered() -> None:
    for chapter in ("sampling", "gap", "deploying", "issuing"):
        rig = Rig()
        rig.sampling()
        if chapter != "sampling":
            rig = Rig()
            rig.gap()
        if chapter in ("deploying", "issuing"):
            rig.request("deploy", digest="controller")
        if chapter == "issuing":
            rig.verified()
        rig.feed(Stopping(rig.t))
        assert all(len(found) == 1 for found in answers(rig).values()), chapter


# ---------------------------------------------------------------- the robot and its link


@pytest.mark.parametrize(
    ("down", "up", "named"),
    [
        (RecorderChanged(1, ok=False), RecorderChanged(1, ok=True), "recorder_down"),
        (AnalyticsChanged(1, up=False), AnalyticsChanged(1, up=True), "analytics_down"),
        (LinkChanged(1, up=False), LinkChanged(1, up=True), "link_down"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_the_drive_needs_closes_the_gate_when_it_goes_and_opens_it_when_it_is_back(down: Any, up: Any, named: str) -> None:
    rig = Rig()
    rig.driving()
    rig.observe()
    outputs = rig.feed(msgspec.structs.replace(down, t_ns=rig.t))
    assert kinds(outputs)[:2] == ["GateChanged", "Send"]
    assert (one(outputs, GateChanged).reason if named != "link_down" else named, sources(outputs)) == (named, ["recovery"])
    assert kinds(rig.propose()) == ["Decided"]
    assert sources(rig.observe()) == ["recovery"]
    rig.feed(msgspec.structs.replace(up, t_ns=rig.t))
    assert reopen(rig) == 3


def test_an_answer_that_is_late_for_the_computers_reasons_closes_the_gate_and_latches_nothing() -> None:
    rig = Rig()
    rig.driving()
    rig.observe()
    asked = rig.state.asked
    assert asked is not None
    assert rig.feed(AnswerLate(rig.t, asked.obs_seq - 1)) == []
    outputs = rig.feed(AnswerLate(rig.t, asked.obs_seq, "the daemon stood still for 80 ms"))
    assert kinds(outputs) == ["GateChanged", "Send"]
    assert (one(outputs, GateChanged).reason, one(outputs, GateChanged).detail) == ("command_stale", "the daemon stood still for 80 ms")
    assert (sources(outputs), rig.state.memory.latched) == (["recovery"], ())
    assert kinds(rig.propose()) == ["Decided"], "the answer answers nothing any more"
    assert rig.state.deployment is not None
    assert reopen(rig) == 4, "the hysteresis begins with the next observation"


@pytest.mark.parametrize(("late", "goes_on"), [(True, True), (False, False)])
def test_a_campaign_waits_for_a_slow_disk_and_ends_for_a_log_that_failed(late: bool, goes_on: bool) -> None:
    rig = Rig()
    rig.sampling()
    rig.observe()
    rig.feed(RecorderChanged(rig.t, False, "nothing reached the disk", late))
    assert (rig.state.campaign is not None) == goes_on
    if goes_on:
        outputs = rig.propose(source="sampler")
        assert sources(outputs) == ["recovery"], "nothing moves meanwhile"
        rig.feed(RecorderChanged(rig.t, False, "a sync of the log failed"))
        assert rig.state.campaign is None


def test_a_link_that_goes_while_settling_still_answers_the_open_question() -> None:
    rig = lockstep()
    rig.deployed()
    rig.observe()
    assert sources(rig.feed(LinkChanged(rig.t, up=False))) == ["recovery"]


def test_the_wall_clock_runs_on_between_its_readings_in_real_time_only() -> None:
    for rig, stands in ((Rig(), False), (lockstep(), True)):
        rig.driving()
        before = core.status(rig.state)["certificate_left_s"]
        assert isinstance(before, int)
        rig.observe(after=50 * S)
        assert core.status(rig.state)["certificate_left_s"] == (before if stands else before - 50)


@pytest.mark.parametrize("x", [(math.nan, 0.0, 0.0), (0.0, 0.0), (0.0, 0.0, math.inf)], ids=str)
def test_an_unusable_observation_closes_the_gate_and_its_instant_gets_the_recovery_command(x: tuple[float, ...]) -> None:
    for rig in (Rig(), lockstep()):
        rig.driving()
        outputs = rig.observe(x)
        assert (one(outputs, GateChanged).reason, sources(outputs), one(outputs, Send).obs_seq) == (
            "observation_invalid",
            ["recovery"],
            rig.seq,
        )
        assert reopen(rig) == 4


def test_the_stamp_of_an_unusable_observation_may_be_anything() -> None:
    rig = Rig()
    rig.observe()
    for stamp in (10**18, -(10**18), 0):
        rig.observe((), stamp_ns=stamp, fault="malformed")
        assert len(of(rig.observe(), Send)) == 1
    rig = Rig()
    rig.observe((), stamp_ns=10**18, fault="malformed")  # the very first
    assert [len(of(rig.observe(), Send)) for _ in range(3)] == [1, 1, 1]
    rig = lockstep()  # the robot waits at each of them
    rig.observe()
    rig.observe((), stamp_ns=10**18, fault="malformed")
    assert [len(of(rig.observe((), fault="malformed"), Send)) for _ in range(3)] == [1, 1, 1]
    rig.feed(Observed(rig.t, Observation(rig.seq, rig.t, (), "malformed")))
    assert rig.state.trouble == "observation_invalid"


def test_outside_the_certified_region_the_recovery_controller_drives() -> None:
    rig = Rig()
    rig.driving()
    outputs = rig.observe((1.7, 0.0, 0.0))
    assert (one(outputs, GateChanged).reason, sources(outputs)) == ("outside_region", ["recovery"])
    assert reopen(rig) == 4


def test_when_the_robot_is_not_seen_any_more_it_is_told_to_recover_at_its_pace() -> None:
    rig = Rig()
    rig.driving()
    rig.t += S // 5
    assert rig.feed(Ticked(rig.t)) == []
    rig.t += 1
    outputs = rig.feed(Ticked(rig.t))
    assert (one(outputs, GateChanged).reason, sources(outputs)) == ("observation_stale", ["recovery"])
    sent = 0
    for _ in range(100):
        rig.t += DT // 3
        sent += len(of(rig.feed(Ticked(rig.t)), Send))
    assert sent == 33
    rig.feed(LinkChanged(rig.t, up=False))
    rig.t += S
    assert rig.feed(Ticked(rig.t)) == []


def test_a_robot_that_was_never_seen_is_told_nothing() -> None:
    rig = Rig()
    for _ in range(10):
        rig.t += S
        assert rig.feed(Ticked(rig.t)) == []
    assert sources(rig.request("stop")) == ["recovery"]  # but to stop, which it may hear
    assert rig.outputs[-3] == Send(rig.t, 1, "recovery", (0.0, 0.0), -1, S // 10)


def old(rig: Rig, seq: int, stamp: int) -> list[Output]:
    return rig.feed(Observed(rig.t, Observation(seq, stamp, (0.0, 0.0, 0.0))))


def test_an_observation_from_the_past_closes_the_gate_and_is_not_used() -> None:
    rig = Rig()
    rig.driving()
    for seq, stamp in ((rig.seq - 1, rig.t + 5), (rig.seq + 1, rig.t - 5), (rig.seq + 1, rig.t)):
        reopen(rig)
        outputs = old(rig, seq, stamp)
        assert (one(outputs, GateChanged).reason, sources(outputs)) == ("observation_out_of_order", ["recovery"])
        assert rig.state.observation is not None
        assert rig.state.observation.seq == rig.seq


def test_a_robot_that_started_anew_is_taken_for_what_it_is() -> None:
    rig = Rig()  # real time: once the old observation is stale
    rig.driving()
    rig.t += S // 5
    assert rig.state.observation is not None
    seen = rig.state.observation.seq
    old(rig, 0, 5)
    assert rig.state.observation.seq == seen
    rig.t += 1
    outputs = old(rig, 1, 10)
    assert one(outputs, Ask).obs_seq == 1
    assert of(outputs, Send) == []
    assert sources(rig.propose()) == ["recovery"]  # settling anew
    assert one(old(rig, 2, 10 + DT), Ask).obs_seq == 2
    rig.t += S // 5 + 1
    outputs = old(rig, 0, 3)  # and once more, while the question is open
    assert not rig.state.gate_open
    assert (one(outputs, Send).source, one(outputs, Send).obs_seq) == ("recovery", 2)
    assert one(outputs, Ask).obs_seq == 0

    rig = lockstep()  # lockstep: when it repeats itself, waiting
    rig.driving()
    assert old(rig, 0, 0) != []
    assert of(old(rig, 0, 0), Ask) != []
    assert rig.state.observation is not None
    assert rig.state.observation.seq == 0


def test_a_stray_observation_does_not_keep_a_waiting_robot_from_its_answer() -> None:
    rig = lockstep()
    rig.driving()
    rig.observe()
    assert rig.state.observation is not None
    waiting = rig.state.observation
    old(rig, 2, 3)
    rig.feed(Observed(rig.t, Observation(0, 0, (), "malformed")))
    assert rig.feed(Observed(rig.t, waiting)) == []
    assert rig.state.trouble == ""
    assert reopen(rig) >= 2


def test_a_clock_that_runs_backward_closes_the_gate_and_ends_permits() -> None:
    rig = lockstep()
    rig.driving()
    rig.request("permit", duration_s=60.0)
    rig.observe()
    rig.t -= 1
    outputs = rig.feed(Ticked(rig.t))
    assert kinds(outputs) == ["GateChanged", "Send", "GateChanged"]
    assert [change.reason for change in of(outputs, GateChanged)] == ["clock_backwards", "observation_missing"]
    assert core.status(rig.state)["permit_left_s"] == 0.0
    assert reopen(rig) == 4
    rig = lockstep()
    rig.deployed()
    rig.observe()
    rig.t -= 1
    assert sources(rig.feed(Ticked(rig.t))) == ["recovery"]  # an open question while settling


# ---------------------------------------------------------------- the recovery command


def test_hold_is_inside_the_input_bounds_and_never_anything_but_numbers() -> None:
    for held, sent in (((0.1, 1.0), (0.1, 1.0)), ((9.0, -9.0), (0.2, -3.0)), ((math.nan, 0.0), (0.0, 0.0)), ((0.1,), (0.0, 0.0))):
        assert one(Rig(recovery="hold", recovery_input=held).observe(), Send).u == sent
    assert one(Rig(input_bounds=((0.05, 0.2), (-3.0, 3.0))).observe(), Send).u == (0.05, 0.0)


def test_return_drives_home_and_stops_there_and_wherever_it_is_lost() -> None:
    rig = lockstep(recovery="return")
    for _ in range(20):  # under way the robot has not settled
        v, w = one(rig.observe((0.5, 0.0, math.pi)), Send).u
        assert (v > 0.15, abs(w) < 1e-9) == (True, True)
    assert one(rig.observe((math.nan, 0.0, 0.0)), Send).u == (0.0, 0.0)
    assert one(rig.observe((0.03, 0.03, 0.0)), Send).u == (0.0, 0.0)
    rig = Rig(recovery="return")
    assert one(rig.observe(), Send).u != (0.0, 0.0)
    rig.t += S
    assert one(rig.feed(Ticked(rig.t)), Send).u == (0.0, 0.0)
    assert one(Rig(recovery="return", model_name="bicycle").observe(), Send).u == (0.0, 0.0)
    assert one(Rig(recovery="return").observe((1e308, -1e308, 1.0)), Send).u is not None


# ---------------------------------------------------------------- status


def test_the_status_has_the_keys_of_the_design_from_the_first_moment_on() -> None:
    keys = {"gate", "reason", "controller", "certificate", "radius", "verified_radius", "e_value", "epoch", "beta_spent", "beta_left"}
    assert keys <= set(core.status(core.initial()))
    rig = Rig()
    rig.driving()
    rig.measure(0.012, e_value=2.5)
    found = core.status(rig.state)
    assert keys <= set(found)
    shown = {
        key: found[key] for key in ("gate", "reason", "controller", "certificate", "radius", "e_value", "epoch", "attempts", "driving")
    }
    assert list(shown.values()) == ["open", "allowed", "controller", "c1", 0.012, 2.5, 1, 1, "controller"]
    assert found["beta_spent"] == pytest.approx(2 * 3 * 0.05 / math.pi**2)
    assert found["beta_left"] == pytest.approx(0.05 - 2 * 3 * 0.05 / math.pi**2)
    rig = Rig()
    rig.sampling()
    assert core.status(rig.state)["campaign"] == {"epoch": 1, "taken": 0, "n": 161, "running": True}
    msgspec.json.encode(core.status(rig.state))
