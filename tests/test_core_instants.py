"""Control instants to the letter: which observation is one, which is believed, what the robot is told when nobody answers."""

from __future__ import annotations

import itertools
import math
import random
from typing import Any

import msgspec
import pytest
from core_rig import DT, Rig, S, kinds, lockstep, of, one, reason, sources

from s2r_runtime.messages import (
    Ask,
    Command,
    Decided,
    GateChanged,
    LinkChanged,
    Observation,
    Observed,
    Output,
    Proposed,
    RecorderChanged,
    Send,
    SourceStarted,
    SourceStopped,
    StopController,
    Ticked,
)


def see(rig: Rig, observation: Observation) -> list[Output]:
    return rig.feed(Observed(rig.t, observation))


def changed(rig: Rig, **changes: Any) -> None:
    rig.state = msgspec.structs.replace(rig.state, **changes)


def sent(outputs: list[Output]) -> Send:
    return one(outputs, Send)


# ---------------------------------------------------------------- which observation is believed


@pytest.mark.parametrize(
    "wrong",
    [{"fault": "marked"}, {"x": (0.5, 0.2)}, {"x": (0.5, 0.2, 0.0, 0.0)}, {"x": (0.5, 0.2, math.nan)}, {"x": (math.inf, 0.2, 0.0)}],
    ids=str,
)
def test_one_thing_wrong_makes_an_observation_unusable(wrong: dict[str, Any]) -> None:
    rig = Rig()
    rig.observe()
    good = rig.state.observation
    rig.observe(**wrong)
    assert (rig.state.trouble, reason(rig)) == ("observation_invalid", "no_controller")
    assert rig.state.observation == good
    rig.observe()
    assert rig.state.trouble == ""


@pytest.mark.parametrize(("seq", "stamp"), [(0, 1), (1, 0), (1, -1), (-1, 1), (-1, -1)])
def test_number_and_stamp_must_both_grow(seq: int, stamp: int) -> None:
    """Even where a newer number was seen in between, on an observation that could not be used."""
    rig = Rig()
    rig.observe()
    good = rig.state.observation
    assert good is not None
    rig.observe((math.nan, 0.0, 0.0))
    rig.t += 1
    see(rig, Observation(good.seq + (2 if seq > 0 else seq), good.stamp_ns + stamp, (0.0, 0.0, 0.0)))
    assert rig.state.trouble == "observation_out_of_order"
    assert rig.state.observation == good


def test_a_number_that_came_before_is_a_repetition_whatever_stands_beside_it() -> None:
    rig = Rig()
    rig.observe()
    good = rig.state.observation
    assert see(rig, Observation(rig.seq, rig.t + 1, (1.0, 0.0, 0.0))) == []
    assert rig.state.observation == good
    rig.observe((math.nan, 0.0, 0.0))
    assert see(rig, Observation(rig.seq, rig.t + 1, (1.0, 0.0, 0.0))) == []
    assert (rig.state.observation, rig.state.trouble) == (good, "observation_invalid")


def test_in_lockstep_a_stray_must_come_twice_with_nothing_good_in_between() -> None:
    rig = lockstep()
    for _ in range(3):
        rig.observe()
    past = Observation(1, 1, (0.0, 0.0, 0.0))
    see(rig, past)
    assert rig.state.trouble == "observation_out_of_order"
    rig.observe()
    see(rig, past)
    assert rig.state.trouble == "observation_out_of_order"
    see(rig, past)
    assert (rig.state.trouble, rig.state.observation) == ("", past)


def test_a_robot_that_started_anew_closes_the_gate_for_that_reason() -> None:
    rig = Rig()
    rig.driving()
    rig.t += S
    outputs = see(rig, Observation(1, 1, (0.5, 0.2, 0.0)))
    assert [change.reason for change in of(outputs, GateChanged)][:2] == ["observation_stale", "observation_out_of_order"]
    assert rig.state.trouble == ""


def test_a_link_that_goes_takes_all_that_was_observed_along() -> None:
    rig = Rig()
    rig.observe()
    rig.observe((math.nan, 0.0, 0.0))
    changed(rig, odd_seq=1, answered=False)
    rig.feed(LinkChanged(rig.t, up=False))
    s = rig.state
    assert (s.observation, s.trouble, s.seen_seq, s.odd_seq, s.control_seq, s.control_stamp_ns) == (None, "", None, None, None, None)
    assert s.answered


# ---------------------------------------------------------------- which observation is an instant


def test_an_instant_has_its_own_stamp_and_an_unusable_one_at_most_a_period_more() -> None:
    rig = Rig()
    rig.observe()
    rig.observe(after=4 * DT)
    assert rig.state.control_stamp_ns == rig.t
    last = rig.t
    rig.observe((math.nan, 0.0, 0.0), stamp_ns=10**18)
    assert rig.state.control_stamp_ns == last + DT
    rig.observe((math.nan, 0.0, 0.0), stamp_ns=last + 2 * DT - DT // 20)
    assert rig.state.control_stamp_ns == last + 2 * DT - DT // 20


def test_a_good_observation_at_the_stamp_of_an_unusable_one_is_no_second_instant() -> None:
    rig = Rig()
    rig.observe((math.nan, 0.0, 0.0))
    first = rig.t
    assert sources(rig.observe(stamp_ns=first)) == []
    assert sources(rig.observe(stamp_ns=first + DT)) == ["recovery"]


@pytest.mark.parametrize("reports", [1, 3, 7, 9, 10, 25])
def test_instants_stand_on_the_models_grid(reports: int) -> None:
    """Also where a step is no whole number of intervals: 33 ms in 7 of them are 4.714 ms, rounded to a nanosecond."""
    rig = Rig()
    instants = stamps_of_instants(rig, [round(k * DT / reports) for k in range(20 * reports)])
    assert [stamp - instants[0] for stamp in instants] == pytest.approx([k * DT for k in range(20)], abs=1)


@pytest.mark.parametrize("reports", [2.5, 9.5, 13.7])
@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_an_instant_is_the_observation_nearest_to_its_grid_point_and_none_drifts(reports: float, jitter: float) -> None:
    """No farther from it than half of the longest interval and half of what the last interval was off by."""
    rig, rng = Rig(), random.Random(3)
    times = [round((k + jitter * rng.uniform(-0.5, 0.5)) * DT / reports) for k in range(round(200 * reports))]
    instants = stamps_of_instants(rig, times)
    offsets = [(stamp - instants[0] + DT // 2) % DT - DT // 2 for stamp in instants]
    interval = DT / reports
    assert max(map(abs, offsets)) <= interval * (0.5 + 1.5 * jitter) + 1
    steps = [round((b - a) / DT) for a, b in itertools.pairwise(instants)]
    assert set(steps) == {1}


def test_a_robot_that_reports_more_slowly_than_the_step_is_answered_every_time() -> None:
    rig = Rig()
    assert len(stamps_of_instants(rig, [k * DT * 13 // 10 for k in range(50)])) == 50


def test_a_hole_in_the_observations_leaves_the_grid_where_it_was() -> None:
    rig = Rig()
    times = [k * DT // 4 for k in range(200) if not 50 <= k < 71]
    instants = stamps_of_instants(rig, times)
    assert {round((b - instants[0]) / DT * 4) % 4 for b in instants} <= {0, 3}  # the last interval before the hole's end is the hole
    assert all((stamp - instants[0]) % DT == 0 for stamp in instants[-20:])


def test_under_the_rules_of_before_an_instant_is_nine_tenths_of_a_step_after_the_last_one() -> None:
    rig = Rig(rules=0)
    instants = stamps_of_instants(rig, [k * DT // 10 for k in range(100)])
    assert {b - a for a, b in itertools.pairwise(instants)} == {DT * 9 // 10}


def stamps_of_instants(rig: Rig, times: list[int]) -> list[int]:
    """Stamps of the observations at these times after now that were answered, each the only time."""
    began, found = rig.t, []
    for when in times:
        found += [rig.t] if sources(rig.observe(after=began + when - rig.t)) else []
    return found


def test_a_command_goes_out_again_at_every_second_repetition() -> None:
    rig = lockstep()
    rig.observe()
    for _ in range(3):
        assert sources(rig.repeat()) == []
        assert sources(rig.repeat()) == ["recovery"]
    assert sources(rig.repeat()) == []
    rig.observe()  # a new instant counts its own repetitions
    assert sources(rig.repeat()) == []
    assert sources(rig.repeat()) == ["recovery"]


def test_a_lost_command_of_a_sampler_that_may_not_drive_any_more_does_not_go_out_again() -> None:
    rig = lockstep()
    rig.sampling()
    rig.observe()
    assert sources(rig.propose(source="sampler")) == ["sampler"]
    rig.request("cancel")
    rig.repeat()
    assert sources(rig.repeat()) == ["recovery"]


# ---------------------------------------------------------------- the gate's reason


def test_while_it_settles_it_says_so() -> None:
    rig = Rig()
    rig.deployed()
    assert reason(rig) == "settling"


def test_what_ended_the_last_deployment_is_the_reason_only_while_nothing_else_is() -> None:
    rig = Rig(latching=())
    rig.deployed()
    rig.feed(SourceStopped(rig.t, "controller", "died"))
    assert reason(rig) == "controller_fault"
    rig.feed(RecorderChanged(rig.t, ok=False))
    assert reason(rig) == "recorder_down"


def test_a_controllers_own_doing_latches_even_while_the_gate_settles() -> None:
    rig = Rig()
    rig.deployed()
    rig.observe()
    rig.propose((math.nan, 0.0))
    assert rig.state.memory.latched == ("command_invalid",)


def test_a_stray_command_of_the_sampler_does_not_close_a_controllers_gate_and_one_of_its_own_does() -> None:
    rig = Rig()
    rig.driving()
    outputs = rig.propose(source="sampler")
    assert kinds(outputs) == ["Decided"]
    assert one(outputs, Decided).reason == "command_out_of_order"
    assert rig.state.gate_open
    outputs = rig.propose()
    assert one(outputs, GateChanged).reason == "command_out_of_order"
    assert not rig.state.gate_open


def test_a_samplers_numbers_must_grow() -> None:
    rig = Rig()
    rig.sampling()
    for number, wanted in ((5, ["sampler"]), (5, ["recovery"]), (4, ["recovery"]), (6, ["sampler"])):
        ask = one(rig.observe(), Ask)
        command = Command(number, rig.t, "sampler", (0.1, 0.0), ask.obs_seq, S // 10)
        assert sources(rig.feed(Proposed(rig.t, command))) == wanted


# ---------------------------------------------------------------- when nobody answers


def test_a_daemon_that_stood_still_closes_the_gate_even_where_an_observation_comes_first() -> None:
    """What waited in the socket meanwhile is as old as the pause, and no stamp of the robot's says so."""
    timeout = Rig().settings.observation_timeout_ns
    for pause, stays in ((timeout, True), (timeout + 1, False), (10 * S, False)):
        rig = Rig()
        rig.driving()
        rig.observe()
        outputs = rig.observe(after=pause)
        assert rig.state.gate_open == stays
        if not stays:
            assert next(change.reason for change in of(outputs, GateChanged)) == "observation_stale"
            assert sources(outputs)[0] == "recovery"
            assert sources(rig.propose()) == ["recovery"]  # it settles anew


def test_a_robot_that_is_heard_again_and_not_yet_seen_is_told_to_stop_at_its_pace() -> None:
    rig = Rig(recovery="return")
    rig.observe((1.0, 0.0, 0.0))
    assert any(sent(rig.observe((1.0, 0.0, 0.0))).u)
    rig.feed(LinkChanged(rig.t, up=False))
    rig.feed(LinkChanged(rig.t, up=True))
    rig.t += DT
    told = sent(rig.feed(Ticked(rig.t)))
    assert (told.u, told.obs_seq) == ((0.0, 0.0), -1)


def test_a_robot_whose_last_observation_is_of_no_use_is_told_to_recover_at_its_pace() -> None:
    rig = Rig()
    rig.observe()
    rig.observe((math.nan, 0.0, 0.0))
    seq = rig.seq
    for _ in range(3):
        rig.t += DT
        told = sent(rig.feed(Ticked(rig.t)))
        assert (told.source, told.obs_seq) == ("recovery", seq)
        assert sources(rig.feed(Ticked(rig.t + DT // 2))) == []


def test_a_question_that_is_open_is_not_answered_by_a_tick() -> None:
    rig = Rig()
    rig.deployed()
    rig.observe()
    assert rig.state.asked is not None
    rig.observe((math.nan, 0.0, 0.0), after=DT // 3)
    assert sources(rig.feed(Ticked(rig.t + DT))) == []
    assert rig.state.asked is not None


def test_in_lockstep_time_alone_ends_no_question() -> None:
    rig = lockstep()
    rig.deployed()
    rig.observe()
    assert rig.state.asked is not None
    assert of(rig.feed(Ticked(rig.t + 100 * S)), StopController) == []
    assert rig.state.deployment is not None


def test_in_lockstep_a_robot_settles_anew_after_somebody_drove() -> None:
    rig = lockstep()
    assert [sources(rig.observe()) for _ in range(6)] == [["recovery"]] * 5 + [[]]
    rig.request("permit", duration_s=60.0)
    rig.request("sample")
    rig.feed(SourceStarted(rig.t, "sampler", ""))
    rig.propose((0.1, 0.0), "sampler")
    rig.request("cancel")
    assert [sources(rig.observe()) for _ in range(6)] == [["recovery"]] * 5 + [[]]


def test_in_lockstep_a_robot_on_its_way_home_has_not_settled() -> None:
    rig = lockstep(recovery="return")
    for _ in range(12):
        assert any(sent(rig.observe((1.0, 0.0, math.pi))).u)
    home = [sources(rig.observe((0.05, 0.0, 0.0))) for _ in range(6)]
    assert home == [["recovery"]] * 5 + [[]]
    assert rig.state.sent is not None
    assert rig.state.sent.u == (0.0, 0.0)
