"""The core while something drives: one command per control instant, what closes the gate, what goes out then, what opens it again."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from core_rig import DT, Rig, S, kinds, lockstep, memory, of, one, reason, reopen, sources

from s2r_runtime.core import reducer as core
from s2r_runtime.messages import (
    AnalyticsChanged,
    Answer,
    Ask,
    Decided,
    EpisodeEnded,
    GateChanged,
    LinkChanged,
    Persist,
    Send,
    SourceStarted,
    SourceStopped,
    StartController,
    StopController,
    Ticked,
)

# ---------------------------------------------------------------- opening


def test_the_gate_opens_after_its_hysteresis_and_is_recorded_before_the_first_command() -> None:
    rig = Rig()
    rig.deployed()
    seen = []
    for _ in range(6):
        assert one(rig.observe(), Ask).source == "controller"
        outputs = rig.propose()
        seen.append((one(outputs, Decided).reason, *sources(outputs)))
    assert seen == [("settling", "recovery")] * 3 + [("allowed", "controller")] * 3  # 0.1 s at 33 ms since it was deployed
    opened = [i for i, output in enumerate(rig.outputs) if isinstance(output, GateChanged) and output.open]
    first = next(i for i, output in enumerate(rig.outputs) if isinstance(output, Send) and output.source == "controller")
    assert len(opened) == 1
    assert opened[0] < first


def test_without_hysteresis_the_gate_opens_at_once_and_says_so_before_it_sends() -> None:
    rig = Rig(hysteresis_ns=0)
    rig.deployed()
    assert rig.state.gate_open
    rig.observe()
    rig.propose((0.5, 0.0))
    rig.observe()
    assert kinds(rig.propose()) == ["Decided", "Send"]


def test_an_allowed_command_goes_out_as_it_is_for_as_long_as_both_say() -> None:
    rig = Rig()
    rig.driving()
    rig.observe()
    assert one(rig.propose((0.2, -3.0), ttl_ns=5), Send) == Send(rig.t, rig.state.send_seq, "controller", (0.2, -3.0), rig.seq, 5)
    rig.observe()
    assert one(rig.propose((0, 1), ttl_ns=S), Send).ttl_ns == S // 10


def test_the_gate_opens_within_an_answer_if_the_hysteresis_ends_there() -> None:
    rig = Rig()
    rig.deployed()
    rig.observe(after=S // 10 - 1)
    rig.t += 1
    assert kinds(rig.propose()) == ["Decided", "GateChanged", "Send"]


# ---------------------------------------------------------------- control instants


def test_each_control_instant_gets_exactly_one_command_in_real_time() -> None:
    rig = Rig()
    rig.driving()
    for step, sends in ((DT // 4, 0), (3 * DT // 4, 1), (DT // 2, 0), (DT // 2, 1), (DT, 1), (5 * DT, 1), (DT // 2, 0)):
        outputs = rig.observe(after=step)
        if rig.state.asked is not None:
            outputs += rig.propose()
        assert len(of(outputs, Send)) == sends, step


def test_a_second_observation_while_the_question_is_open_begins_no_instant() -> None:
    rig = Rig()
    rig.driving()
    asked = one(rig.observe(), Ask)
    assert rig.observe() == []
    assert one(rig.propose(), Send).obs_seq == asked.obs_seq
    assert one(rig.observe(), Ask).obs_seq == rig.seq


def test_with_nobody_to_ask_the_recovery_command_goes_out_in_real_time_forever() -> None:
    rig = Rig()
    for _ in range(100):
        assert sources(rig.observe()) == ["recovery"]


def test_in_lockstep_the_core_falls_silent_after_the_robot_has_settled() -> None:
    rig = lockstep()
    assert [sources(rig.observe()) for _ in range(5)] == [["recovery"]] * 5
    assert rig.observe() == []
    for _ in range(5):
        assert rig.repeat() == []
    assert rig.feed(Ticked(rig.t)) == []


def test_silence_ends_with_a_source_that_is_asked_about_the_waiting_instant_exactly_once() -> None:
    rig = lockstep()
    for _ in range(6):
        rig.observe()
    rig.request("permit", duration_s=60.0)
    assert of(rig.request("sample"), Ask) == []
    assert rig.repeat() == []  # its source has not started
    # a transport may keep repetitions to itself, so the core waits for none
    assert one(rig.feed(SourceStarted(rig.t, "sampler", "")), Ask) == Ask(rig.t, "sampler", rig.seq)
    assert rig.repeat() == []
    assert sources(rig.propose((0.1, 0.0), "sampler")) == ["sampler"]
    assert rig.repeat() == []
    assert one(rig.observe(), Ask).source == "sampler"


def test_silence_ends_when_the_gate_may_settle_and_the_robots_clock_runs_again() -> None:
    rig = lockstep()
    rig.deployed()
    rig.feed(AnalyticsChanged(rig.t, up=False))
    while rig.observe():
        pass
    assert rig.repeat() == []
    assert one(rig.feed(AnalyticsChanged(rig.t, up=True)), Ask).source == "controller"
    assert rig.repeat() == []
    assert sources(rig.propose()) == ["recovery"]
    assert reopen(rig) == 3


def test_a_command_that_was_lost_on_its_way_goes_out_again_the_same() -> None:
    rig = lockstep()
    rig.driving()
    rig.observe()
    sent = one(rig.propose(), Send)
    assert rig.repeat() == []  # it may just have crossed the command
    assert one(rig.repeat(), Send) == msgspec.structs.replace(sent, seq=sent.seq + 1)
    rig.feed(AnalyticsChanged(rig.t, up=False))
    rig.repeat()
    assert sources(rig.repeat()) == ["recovery"]  # its source may not drive any more
    rig.repeat()
    assert sources(rig.repeat()) == ["recovery"]


def test_a_lost_command_does_not_go_out_again_while_the_gate_settles() -> None:
    rig = lockstep()
    rig.driving()
    rig.observe()
    rig.propose()
    rig.feed(AnalyticsChanged(rig.t, up=False))
    rig.feed(AnalyticsChanged(rig.t, up=True))
    rig.repeat()
    assert sources(rig.repeat()) == ["recovery"]


def test_a_samplers_lost_command_goes_out_again_while_it_may_drive() -> None:
    rig = lockstep()
    rig.sampling()
    rig.observe()
    rig.propose((0.1, 0.0), "sampler")
    rig.repeat()
    assert sources(rig.repeat()) == ["sampler"]
    rig.feed(LinkChanged(rig.t, up=False))
    rig.observe(after=0)
    assert sources(rig.outputs[-1:]) == []  # asked, and refused below
    assert sources(rig.propose((0.1, 0.0), "sampler")) == ["recovery"]


def test_a_repeated_observation_is_ignored_in_real_time() -> None:
    rig = Rig()
    rig.observe()
    assert [rig.repeat() for _ in range(4)] == [[]] * 4


def test_in_lockstep_an_observation_that_came_too_early_is_answered_when_it_is_due_and_never_sooner() -> None:
    rig = lockstep()
    rig.observe()
    assert rig.observe(after=DT // 2) == []
    assert rig.repeat() == []


def test_in_lockstep_a_robot_that_went_on_without_its_answer_is_answered_where_it_waits() -> None:
    rig = lockstep()
    rig.driving()
    rig.observe()
    assert rig.observe() == []
    rig.propose()
    assert one(rig.repeat(), Ask).obs_seq == rig.seq


# ---------------------------------------------------------------- refusals


def test_gate_stays_closed_after_nan_until_cleared() -> None:
    rig = Rig()
    rig.driving()
    rig.observe()
    outputs = rig.propose((math.nan, 0.0))
    assert kinds(outputs) == ["Decided", "GateChanged", "Send", "Persist"]
    assert (one(outputs, Decided).reason, sources(outputs)) == ("command_invalid", ["recovery"])
    assert one(outputs, Persist).memory.latched == ("command_invalid",)
    for _ in range(20):
        assert sources(rig.observe()) == ["recovery"]
    assert reason(rig) == "latched:command_invalid"
    assert one(rig.request("clear", text="outside_region"), Answer).exit_code == 2
    assert one(rig.request("clear"), Answer).exit_code == 2
    assert one(rig.request("clear", text="latched:command_invalid"), Answer).exit_code == 0
    assert reopen(rig) == 3


def test_a_latch_survives_a_restart() -> None:
    rig = Rig(memory(latched=("command_invalid",)))
    rig.request("deploy", digest="controller")
    outputs = rig.feed(SourceStarted(rig.t, "controller", "controller"))
    assert "command_invalid" in one(outputs, Answer).text
    assert sources(rig.observe()) == ["recovery"]


def test_an_input_out_of_bounds_closes_the_gate_for_the_hysteresis() -> None:
    rig = Rig()
    rig.driving()
    rig.observe()
    outputs = rig.propose((0.21, 0.0))
    assert kinds(outputs) == ["Decided", "GateChanged", "Send"]
    assert reopen(rig) == 4
    assert [change.reason for change in of(rig.outputs, GateChanged)][-2:] == ["input_out_of_bounds", "allowed"]


def test_a_controller_that_is_refused_over_and_over_does_not_fill_the_log_with_changes() -> None:
    rig = Rig()
    rig.driving()
    before = len(of(rig.outputs, GateChanged))
    for _ in range(50):
        rig.observe()
        assert sources(rig.propose((0.21, 0.0))) == ["recovery"]
    assert len(of(rig.outputs, GateChanged)) == before + 1


@pytest.mark.parametrize(
    "changes", [{"obs_seq": 0}, {"obs_seq": 10**6}, {"seq": 1}, {"t_ns": 0}, {"t_ns": 10**18}, {"ttl_ns": -1}, {"fault": "x"}], ids=str
)
def test_an_answer_that_is_not_fresh_and_in_order_never_goes_out(changes: dict[str, Any]) -> None:
    rig = Rig()
    rig.driving()
    rig.observe()
    outputs = rig.propose(**changes)
    assert not one(outputs, Decided).allow
    assert sources(outputs) == ["recovery"]
    assert not rig.state.gate_open


def test_a_second_answer_closes_the_gate_and_a_late_one_is_only_refused() -> None:
    rig = Rig()
    rig.driving()
    rig.observe()
    rig.propose()
    outputs = rig.propose()
    assert (one(outputs, Decided).reason, sources(outputs)) == ("command_out_of_order", ["recovery"])
    assert kinds(rig.propose()) == ["Decided"]
    assert kinds(rig.propose(source="sampler")) == ["Decided"]


def test_a_stray_answer_while_the_gate_settles_leaves_the_question_open() -> None:
    rig = Rig()
    rig.deployed()
    rig.observe()
    assert kinds(rig.propose(obs_seq=1)) == ["Decided"]
    assert kinds(rig.propose(source="sampler")) == ["Decided"]
    assert sources(rig.propose()) == ["recovery"]


def test_only_what_closed_an_open_gate_latches() -> None:
    rig = Rig(latching=("link_down", "no_controller", "observation_missing", "observation_stale"))
    rig.observe()
    rig.feed(Ticked(rig.t + S))
    assert rig.state.memory.latched == ()
    rig.t += S
    rig.driving()
    rig.feed(Ticked(rig.t + S))
    assert rig.state.memory.latched == ("observation_stale",)


@pytest.mark.parametrize("source", ["external", "recovery"])
def test_nobody_elses_command_moves_the_robot_or_the_gate(source: str) -> None:
    rig = Rig()
    rig.driving()
    before = rig.state
    outputs = rig.propose(source=source)
    assert kinds(outputs) == ["Decided"]
    assert one(outputs, Decided).reason == "source_not_allowed"
    assert rig.state == before
    rig.observe()
    assert kinds(rig.propose(source=source)) == ["Decided"]
    assert sources(rig.propose()) == ["controller"]


# ---------------------------------------------------------------- sources that fail


@pytest.mark.parametrize("how", ["raised", "died", "deadline", "malformed"])
def test_a_controller_that_fails_is_answered_for_and_stays_out_until_cleared_and_deployed_again(how: Any) -> None:
    rig = lockstep()
    rig.driving()
    rig.observe()
    outputs = rig.feed(SourceStopped(rig.t, "controller", how, "boom"))
    assert kinds(outputs)[:2] == ["GateChanged", "Send"]
    assert (one(outputs, GateChanged).reason, one(outputs, GateChanged).detail) == ("controller_fault", f"{how}: boom")
    assert (sources(outputs), one(outputs, Send).obs_seq) == (["recovery"], rig.seq)
    assert sources(rig.observe()) == ["recovery"]
    outputs = rig.request("deploy", digest="controller")
    assert of(outputs, StartController)
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    assert sources(rig.observe()) == ["recovery"]
    rig.request("clear", text="controller_fault")
    assert reopen(rig) == 3


def test_a_fault_that_does_not_latch_stays_visible_until_the_next_deployment() -> None:
    rig = Rig(latching=())
    rig.driving()
    rig.observe()
    rig.feed(SourceStopped(rig.t, "controller", "died"))
    rig.observe()
    assert reason(rig) == "controller_fault"
    rig.request("deploy", digest="controller")
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    assert reopen(rig) == 3


def test_a_controller_that_finishes_is_no_fault() -> None:
    rig = Rig()
    rig.driving()
    rig.feed(EpisodeEnded(rig.t, 0, 200, 1.0, 1.0))
    outputs = rig.feed(SourceStopped(rig.t, "controller", "finished"))
    assert kinds(outputs) == ["GateChanged", "Send"]
    assert (reason(rig), rig.state.memory.latched, core.status(rig.state)["episodes"]) == ("no_controller", (), 1)
    assert rig.feed(SourceStopped(rig.t, "controller", "finished")) == []


def test_a_question_that_nobody_answers_ends_with_the_commands_time_to_live() -> None:
    rig = Rig()
    rig.driving()
    rig.observe()
    rig.t += S // 10
    assert rig.feed(Ticked(rig.t)) == []
    rig.t += 1
    outputs = rig.feed(Ticked(rig.t))
    assert kinds(outputs)[:2] == ["GateChanged", "Send"]
    assert one(outputs, StopController).reason == "deadline"
    rig = Rig()
    rig.sampling()
    rig.observe()
    rig.t += S // 10 + 1
    assert sources(rig.feed(Ticked(rig.t))) == ["recovery"]


def test_undeploying_answers_an_open_question_with_the_recovery_command() -> None:
    rig = Rig()
    rig.deployed()
    rig.observe()  # settling
    outputs = rig.request("undeploy")
    assert sources(outputs) == ["recovery"]
    assert kinds(rig.propose()) == ["Decided"]
