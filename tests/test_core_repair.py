"""Core: when the residual is traced, what becomes of it, who adopts a model, and given inputs that the sampler drives."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from core_rig import Rig, S, answers, kinds, lockstep, memory, of, one, sources
from repair_rig import FOUND, PROPOSED, traced

from s2r_runtime.core import reducer as core
from s2r_runtime.messages import (
    Answer,
    CampaignFinished,
    Decided,
    InputsFinished,
    LinkChanged,
    ModelAdopted,
    Output,
    OverrideChanged,
    Persist,
    RecorderChanged,
    SourceStarted,
    SourceStopped,
    StartCampaign,
    StartInputs,
    StartJob,
    StopCampaign,
    Stopping,
    Ticked,
    TraceEnded,
)

# ---------------------------------------------------------------- when


@pytest.mark.parametrize("text", ["", "campaign", "drive", "inputs", "all of it"])
def test_only_what_was_recorded_can_be_traced(text: str) -> None:
    rig = Rig()
    answer = one(rig.request("trace", text=text), Answer)
    assert answer.exit_code == (2 if text == "all of it" else 3)
    rig.driving()
    order = one(rig.request("trace", text="drive"), StartJob)
    assert (order.kind, order.stretch, order.epoch, order.digest, order.rows) == ("trace", "drive", 1, "model", 40_000)


def test_a_drive_of_an_earlier_epoch_is_not_this_ones() -> None:
    rig = Rig()
    rig.driving()
    rig.request("undeploy")
    rig.gap()
    assert one(rig.request("trace", text="drive"), Answer).exit_code == 3


def test_a_gap_that_grows_is_traced_when_there_is_something_to_see_of_it() -> None:
    rig = Rig(trace_on_growth=True, trace_delay_ns=2 * S)
    rig.driving()
    assert of(rig.measure(0.011), StartJob) == []
    rig.t += S
    assert of(rig.feed(Ticked(rig.t)), StartJob) == []
    rig.t += S
    order = one(rig.feed(Ticked(rig.t)), StartJob)
    assert (order.kind, order.stretch, order.epoch) == ("trace", "drive", 1)
    traced(rig, {"verdict": "none"})
    rig.measure(0.0115)  # less than a tenth more than what was traced
    rig.t += 10 * S
    assert of(rig.feed(Ticked(rig.t)), StartJob) == []


def test_growth_is_traced_at_once_where_nobody_drives_who_could_show_more() -> None:
    rig = Rig(trace_on_growth=True)
    rig.driving()
    rig.measure(0.011)
    order = one(rig.request("undeploy"), StartJob)
    assert (order.kind, order.stretch) == ("trace", "drive")


def test_nothing_is_traced_of_a_growth_where_the_profile_does_not_ask_for_it_or_the_daemon_ends() -> None:
    rig = Rig()
    rig.driving()
    rig.measure(0.011)
    assert of(rig.request("undeploy"), StartJob) == []
    rig = Rig(trace_on_growth=True)
    rig.driving()
    rig.measure(0.011)
    assert of(rig.feed(Stopping(rig.t)), StartJob) == []


def test_a_trace_that_the_daemons_end_cuts_off_is_recorded_as_that() -> None:
    rig = Rig(trace_after_campaign=True)
    rig.gap()
    ended = one(rig.feed(Stopping(rig.t)), TraceEnded)
    assert (ended.stretch, ended.epoch, ended.verdict, ended.reason) == ("campaign", 1, "", "the daemon stopped before it was done")


def test_a_trace_never_keeps_a_controller_from_driving() -> None:
    rig = Rig(trace_after_campaign=True)
    rig.gap()
    assert core.status(rig.state)["jobs"] == ["trace"]
    rig.deploying()
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    for _ in range(8):
        rig.observe()
        rig.propose()
    assert rig.state.gate_open
    rig.observe()
    assert sources(rig.propose()) == ["controller"]
    outputs = traced(rig)
    assert rig.state.gate_open
    assert of(outputs, Persist) == [], "the command that comes next does not wait for the disk"
    rig.observe()
    assert sources(rig.propose()) == ["controller"]
    kept = one(rig.request("undeploy"), Persist).memory
    assert (kept.traced, kept.proposal) == (True, PROPOSED)


# ---------------------------------------------------------------- what came of it


def test_a_trace_that_fails_is_a_record_with_its_reason() -> None:
    rig = Rig()
    rig.gap()
    rig.request("trace")
    outputs = traced(rig, error="not done within 600 s")
    assert one(outputs, TraceEnded) == TraceEnded(rig.t, 2, "campaign", 1, "", "not done within 600 s")
    assert one(outputs, Answer).exit_code == 1
    assert not rig.state.memory.traced


def test_what_is_proposed_waits_and_is_shown() -> None:
    rig = Rig()
    rig.gap()
    rig.request("trace")
    outputs = traced(rig)
    assert one(outputs, TraceEnded).proposal == "better"
    assert one(outputs, Persist).memory.proposal == PROPOSED
    shown = core.status(rig.state)["proposal"]
    assert isinstance(shown, dict)
    assert (shown["digest"], shown["base"], shown["adopt"]) == ("better", "model", "ask")
    assert rig.state.memory.model_digest == "model", "nothing is adopted by itself"


@pytest.mark.parametrize(
    "trace",
    [
        {**FOUND, "verdict": "ambiguous"},
        {**FOUND, "verdict": "sensor_fault"},
        {"verdict": "traced"},
        {"verdict": "traced", "proposal": {"digest": "better", "proposed": False}},
        {"verdict": "traced", "proposal": {"digest": "", "proposed": True}},
        {"verdict": "traced", "proposal": {"digest": "model", "proposed": True}},
        {"verdict": "traced", "proposal": {"digest": 7, "proposed": True}},
        {"verdict": "traced", "proposal": "better"},
    ],
)
def test_only_a_model_of_one_certain_effect_is_proposed(trace: dict[str, Any]) -> None:
    rig = Rig(adopt="always")
    rig.gap()
    rig.request("trace")
    outputs = traced(rig, trace)
    assert one(outputs, TraceEnded).proposal == ""
    assert rig.state.memory.proposal is None
    assert of(rig.outputs, ModelAdopted) == []


# ---------------------------------------------------------------- adopting


def test_adopting_what_is_proposed_voids_the_gap_and_is_recorded_as_a_persons_decision() -> None:
    rig = Rig(memory(proposal=PROPOSED))
    outputs = rig.request("adopt", digest="better")
    assert one(outputs, ModelAdopted) == ModelAdopted(rig.t, "better", 1000, proposed=True)
    kept = of(outputs, Persist)[-1].memory
    assert (kept.model_digest, kept.gap, kept.proposal, kept.traced) == ("better", None, None, False)
    fresh = one(rig.sampling(), StartCampaign)
    assert (fresh.epoch, fresh.resume) == (2, False)
    own = Rig(memory(proposal=PROPOSED))
    assert one(own.request("adopt", digest="mine"), ModelAdopted).proposed is False
    assert own.state.memory.proposal is None, "it was of the model that is not in force any more"


def test_where_the_profile_decides_a_proposal_is_adopted_as_soon_as_nothing_drives() -> None:
    rig = Rig(adopt="always")
    rig.gap()
    rig.request("trace")
    outputs = traced(rig)
    assert one(outputs, ModelAdopted) == ModelAdopted(rig.t, "better", -1, proposed=True)
    persisted = [output.memory.model_digest for output in outputs if isinstance(output, Persist)]
    assert kinds(outputs).index("ModelAdopted") > kinds(outputs).index("Persist")
    assert persisted[-1] == "better"
    assert (rig.state.memory.gap, rig.state.memory.model_digest) == (None, "better")


def test_the_profile_does_not_decide_while_something_drives_or_works_with_the_old_model() -> None:
    rig = Rig(adopt="always")
    rig.driving()
    rig.request("trace", text="drive")
    assert of(traced(rig), ModelAdopted) == []
    rig.request("verify", digest="another")
    assert of(rig.request("undeploy"), ModelAdopted) == []
    assert one(rig.verified(passed=False), ModelAdopted).digest == "better"


def test_a_proposal_of_another_model_than_the_one_in_force_is_not_adopted() -> None:
    rig = Rig(memory(proposal=msgspec.structs.replace(PROPOSED, base="older")), adopt="always")
    rig.observe()
    assert of(rig.outputs, ModelAdopted) == []
    other = Rig(memory(model_digest="older", proposal=msgspec.structs.replace(PROPOSED, base="older")), adopt="always")
    assert other.state.memory.proposal is None, "the profile's model was changed since"
    waiting = Rig(memory(proposal=PROPOSED), adopt="always")
    assert one(waiting.outputs, ModelAdopted).digest == "better", "it waited over a restart"
    down = Rig(memory(proposal=PROPOSED), adopt="always", start=False)
    assert of(down.outputs, ModelAdopted) == []


# ---------------------------------------------------------------- given inputs


def exciting(rig: Rig, rows: int = 3) -> list[Output]:
    """As far as given inputs that are driven."""
    rig.observe()
    rig.request("permit", duration_s=60.0)
    outputs = rig.request("excite", digest="inputs", count=rows)
    rig.feed(SourceStarted(rig.t, "sampler", "inputs"))
    return outputs


def test_given_inputs_are_driven_under_the_permit_and_cost_no_epoch() -> None:
    rig = Rig()
    rig.observe()
    refused = one(rig.request("excite", digest="inputs", count=3), Answer)
    assert (refused.exit_code, "no_permit" in refused.text) == (1, True)
    assert one(rig.request("excite", digest="", count=3), Answer).exit_code == 2
    assert one(rig.request("excite", digest="inputs", count=0), Answer).exit_code == 2
    assert one(exciting(rig), StartInputs) == StartInputs(rig.t, "inputs", 3)
    assert (rig.state.memory.epochs, rig.state.memory.campaign_epoch) == (0, 0)
    for row in range(3):
        rig.observe()
        assert sources(rig.propose(source="sampler")) == ["sampler"]
        assert core.status(rig.state)["inputs"] == {"digest": "inputs", "driven": row + 1, "n": 3, "running": True}
    rig.observe()
    rig.feed(SourceStopped(rig.t, "sampler", "finished"))
    outputs = rig.feed(InputsFinished(rig.t, "inputs", 3, complete=True))
    assert sources(outputs) == ["recovery"]
    answer = one(outputs, Answer)
    assert (answer.exit_code, "no independent samples" in answer.text) == (0, True)
    assert core.status(rig.state)["inputs"] is None
    assert of(outputs, StartJob) == []


def test_given_inputs_are_traced_when_they_end_if_the_profile_says_so() -> None:
    rig = Rig(trace_after_inputs=True)
    exciting(rig, 1)
    rig.observe()
    rig.propose(source="sampler")
    rig.observe()
    order = one(rig.feed(InputsFinished(rig.t, "inputs", 1, complete=True)), StartJob)
    assert (order.kind, order.stretch, order.epoch) == ("trace", "inputs", 0)
    nothing = Rig(trace_after_inputs=True)
    exciting(nothing)
    assert of(nothing.feed(InputsFinished(nothing.t, "inputs", 0, complete=False)), StartJob) == []


def stop_by_person(rig: Rig) -> list[Output]:
    return rig.request("stop")


def override(rig: Rig) -> list[Output]:
    return rig.feed(OverrideChanged(rig.t, "manual_override"))


def cancel(rig: Rig) -> list[Output]:
    return rig.request("cancel")


def no_permit(rig: Rig) -> list[Output]:
    return rig.request("permit", duration_s=0.0)


def disk(rig: Rig) -> list[Output]:
    return rig.feed(RecorderChanged(rig.t, ok=False))


def ending(rig: Rig) -> list[Output]:
    return rig.feed(Stopping(rig.t))


def outside(rig: Rig) -> list[Output]:
    return [*rig.observe((2.5, 0.0, 0.0)), *rig.propose(source="sampler")]


def too_much(rig: Rig) -> list[Output]:
    rig.observe()
    return rig.propose((9.0, 0.0), source="sampler")


def blind(rig: Rig) -> list[Output]:
    rig.t += S
    return rig.feed(Ticked(rig.t))


def no_answer(rig: Rig) -> list[Output]:
    rig.observe()
    rig.t += S // 5
    return rig.feed(Ticked(rig.t))


@pytest.mark.parametrize(
    "end", [stop_by_person, override, cancel, no_permit, disk, ending, outside, too_much, blind, no_answer], ids=lambda end: end.__name__
)
def test_whatever_stops_the_sampler_ends_given_inputs_for_good(end: Any) -> None:
    rig = Rig()
    exciting(rig, 100)
    rig.observe()
    rig.propose(source="sampler")
    number = rig.requests
    outputs = end(rig)
    assert one(outputs, StopCampaign)
    (answer,) = answers(rig)[number]
    assert (answer.exit_code, "after 1 of 100 rows" in answer.text) == (1, True)
    assert rig.state.campaign is None
    assert rig.feed(InputsFinished(rig.t, "inputs", 1, complete=False)) == []
    later = rig.observe()
    assert "recovery" in sources([*outputs, *later])
    assert "sampler" not in sources([*outputs, *later])


def test_a_row_that_was_refused_is_not_driven_later() -> None:
    rig = Rig()
    exciting(rig)
    rig.observe()
    outputs = rig.propose((0.0, 9.0), source="sampler")
    assert one(outputs, Decided).reason == "input_out_of_bounds"
    assert one(outputs, StopCampaign).reason == "input_out_of_bounds"


def test_what_the_robot_got_before_the_first_row_does_not_break_the_sequence() -> None:
    rig = lockstep()
    exciting(rig)
    assert core.status(rig.state)["inputs"] is not None
    rig.observe()
    assert sources(rig.propose(source="sampler")) == ["sampler"]


def test_given_inputs_a_campaign_and_a_deployment_exclude_each_other() -> None:
    rig = Rig(memory())
    exciting(rig)
    assert "inputs are being driven already" in one(rig.request("sample"), Answer).text
    assert "inputs are being driven already" in one(rig.request("excite", digest="inputs", count=3), Answer).text
    for verb in ("deploy", "adopt"):
        assert one(rig.request(verb, digest="other"), Answer).exit_code == 1
    rig = Rig()
    rig.driving()
    rig.request("permit", duration_s=9.0)
    assert "a controller is deployed" in one(rig.request("excite", digest="inputs", count=3), Answer).text
    rig = Rig()
    n = one(rig.sampling(), StartCampaign).n
    assert "a campaign is under way already" in one(rig.request("excite", digest="inputs", count=3), Answer).text
    rig.feed(CampaignFinished(rig.t, 1, n, complete=True, rejected={}))
    assert "a campaign is under way already" in one(rig.request("excite", digest="inputs", count=3), Answer).text


def test_given_inputs_leave_an_unfinished_campaign_as_it_is() -> None:
    rig = Rig()
    rig.sampling()
    rig.feed(CampaignFinished(rig.t, 1, 3, complete=False, rejected={}))
    exciting(rig)
    assert rig.feed(CampaignFinished(rig.t, 0, 3, complete=True, rejected={})) == []
    assert one(rig.request("cancel"), StopCampaign)
    resumed = one(rig.sampling(), StartCampaign)
    assert (resumed.epoch, resumed.resume) == (1, True)


def test_a_link_that_breaks_ends_given_inputs() -> None:
    rig = Rig()
    exciting(rig, 100)
    rig.observe()
    rig.propose(source="sampler")
    rig.observe()
    rig.feed(LinkChanged(rig.t, up=False))
    assert rig.state.campaign is None
