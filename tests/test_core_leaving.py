"""Who asked for what drives is gone: the core stops it in the same event, and keeps what can go on."""

from __future__ import annotations

import pytest
from core_rig import Rig, answers, kinds, lockstep, of, one, sources

from s2r_runtime.messages import Answer, SampleTaken, SourceStarted, StartCampaign, StopCampaign, StopController


@pytest.mark.parametrize("own", [True, False])
def test_a_campaign_is_stopped_at_once_and_goes_on_at_no_cost(own: bool) -> None:
    rig = Rig()
    order = one(rig.sampling(), StartCampaign)
    rig.feed(SampleTaken(rig.t, order.epoch, 0, 1, 1, (0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (), 1))
    rig.observe()
    rig.propose(source="sampler")
    assert rig.state.sent is not None
    assert rig.state.sent.source == "sampler"
    outputs = rig.request("pause", count=rig.requests if own else 0, text="Ctrl-C" if own else "")
    assert kinds(outputs) == ["StopCampaign", "Answer", "Send", "Answer"]
    assert sources(outputs) == ["recovery"]
    first, second = of(outputs, Answer)
    why = "Ctrl-C" if own else "paused by user 1000"
    assert first.text == f"campaign of epoch 1 stopped after 1 of {order.n} samples: {why}; s2r sample goes on with it"
    assert (first.exit_code, second.exit_code) == (1, 0)
    again = one(rig.request("sample"), StartCampaign)
    assert (again.epoch, again.n, again.resume, rig.state.memory.epochs) == (1, order.n, True, 1)


def test_the_campaign_of_somebody_else_goes_on() -> None:
    rig = Rig()
    rig.sampling()
    outputs = rig.request("pause", count=rig.requests + 7)
    assert one(outputs, Answer).exit_code == 2
    assert rig.state.campaign is not None


def test_in_lockstep_the_instant_that_waits_gets_the_recovery_command() -> None:
    rig = lockstep()
    rig.sampling()
    rig.observe()
    outputs = rig.request("pause")
    assert sources(outputs) == ["recovery"]
    assert of(outputs, StopCampaign)


def test_given_inputs_end_for_good() -> None:
    rig = Rig()
    rig.observe()
    rig.request("permit", duration_s=60.0)
    rig.request("excite", digest="inputs", count=5)
    rig.feed(SourceStarted(rig.t, "sampler", "inputs"))
    outputs = rig.request("pause", count=rig.requests, text="its command is gone")
    assert one(outputs, StopCampaign).reason == "its command is gone"
    assert [a.text for a in of(outputs, Answer)] == [
        "inputs stopped after 0 of 5 rows: its command is gone",
        "stopped the inputs, after 0 of 5 rows",
    ]
    assert rig.state.campaign is None


@pytest.mark.parametrize("stage", ["verifying", "starting"])
def test_a_controller_that_does_not_drive_yet_is_not_deployed(stage: str) -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    number = rig.requests
    if stage == "starting":
        rig.verified()
        rig.stored()
    outputs = rig.request("pause", count=number, text="Ctrl-C")
    assert rig.state.deployment is None
    assert bool(of(outputs, StopController)) == (stage == "starting")
    assert answers(rig)[number][0].text == "not deployed: Ctrl-C; nothing drives"
    if stage == "verifying":
        rig.verified()  # paid for, so it is finished; nothing starts
        rig.stored()
    rig.observe()
    assert rig.state.deployment is None


def test_a_controller_that_drives_was_answered_and_drives_on() -> None:
    rig = Rig()
    rig.driving()
    number = next(n for n, found in answers(rig).items() if any("deployed under" in a.text for a in found))
    outputs = rig.request("pause", count=number, text="its command is gone")
    assert one(outputs, Answer).exit_code == 2
    assert rig.state.gate_open
