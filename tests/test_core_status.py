"""The status, whole: every key and its value, from the first moment to a controller that drives."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from core_rig import DT, GAP, Rig, S, memory

from s2r_runtime.core import ledger, stream
from s2r_runtime.core import reducer as core
from s2r_runtime.core.status import samples_to_certificate
from s2r_runtime.messages import LinkChanged, Memory, Proposal, SampleTaken, SourceStarted

NOTHING: dict[str, Any] = {
    "gate": "closed",
    "reason": "not_started",
    "controller": None,
    "stage": None,
    "certificate": None,
    "clock_behind_s": 0,
    "certificate_left_s": None,
    "radius": None,
    "gap_radius": None,
    "verified_radius": None,
    "headroom_used": None,
    "samples_to_certificate": None,
    "stream": None,
    "driven": None,
    "e_value": 1.0,
    "alarm": False,
    "epoch": 0,
    "attempts": 0,
    "beta": 0.0,
    "beta_spent": 0.0,
    "beta_left": 0.0,
    "latched": [],
    "driving": None,
    "campaign": None,
    "inputs": None,
    "unfinished_epoch": None,
    "refused_campaign": None,
    "next_campaign": None,
    "next_attempt": None,
    "permit_left_s": 0.0,
    "jobs": [],
    "measurement_faults": 0,
    "episodes": 0,
    "runs": None,
    "model": "",
    "proposal": None,
    "traced": False,
    "link": False,
}
BEGUN = NOTHING | {
    "reason": "no_controller",
    "samples_to_certificate": 161,
    "beta": 0.05,
    "beta_left": 0.05,
    "driving": "recovery",
    "model": "model",
    "link": True,
}


def status(rig: Rig) -> dict[str, object]:
    return core.status(rig.state)


def differs(found: dict[str, object], base: dict[str, Any]) -> dict[str, object]:
    """Where it is another than the base; both have the same keys. (What comes next follows from the counters: `test_core_refused`.)"""
    assert list(found) == list(base)
    return {key: value for key, value in found.items() if value != base[key] and not key.startswith("next_")}


def test_before_the_start_there_is_nothing() -> None:
    assert status(Rig(start=False)) == NOTHING


def test_a_robot_without_a_past_lacks_a_campaign() -> None:
    rig = Rig()
    rig.observe()
    assert differs(status(rig), BEGUN) == {}
    rig.feed(LinkChanged(rig.t, up=False))
    assert differs(status(rig), BEGUN) == {"reason": "link_down", "link": False}


def test_a_permit_runs_out() -> None:
    rig = Rig()
    rig.observe()
    rig.request("permit", duration_s=0.05)
    assert differs(status(rig), BEGUN) == {"permit_left_s": 0.05}
    rig.observe()
    assert status(rig)["permit_left_s"] == pytest.approx(0.05 - DT / S)
    rig.observe()
    assert status(rig)["permit_left_s"] == 0.0


def test_a_campaign_shows_how_far_it_came_and_what_was_spent_on_it() -> None:
    rig = Rig()
    rig.sampling()
    spent = ledger.share(0.05, 1)
    base = BEGUN | {"epoch": 1, "beta_spent": spent, "beta_left": 0.05 - spent, "permit_left_s": 60.0, "unfinished_epoch": 1}
    assert differs(status(rig), base) == {"campaign": {"epoch": 1, "taken": 0, "n": 161, "running": True}}
    zeros = (0.0, 0.0, 0.0)
    rig.feed(SampleTaken(rig.t, 1, 6, 1, 1, (0.0, 0.0), zeros, zeros, (), 1))
    rig.feed(SampleTaken(rig.t, 2, 9, 1, 1, (0.0, 0.0), zeros, zeros, (), 1))  # of another epoch
    campaign = {"epoch": 1, "taken": 7, "n": 161, "running": True}
    assert differs(status(rig), base) == {"campaign": campaign, "samples_to_certificate": 154}
    rig.feed(SampleTaken(rig.t, 1, 160, 1, 1, (0.0, 0.0), zeros, zeros, (), 1))
    assert status(rig)["samples_to_certificate"] == 0
    rig.request("stop")
    interrupted = differs(status(rig), base)
    assert interrupted == {"reason": "emergency_stop", "latched": ["emergency_stop"]}


def test_given_inputs_are_no_campaign() -> None:
    rig = Rig()
    rig.observe()
    rig.request("permit", duration_s=60.0)
    rig.request("excite", digest="inputs", count=5)
    base = BEGUN | {"permit_left_s": 60.0}
    assert differs(status(rig), base) == {"inputs": {"digest": "inputs", "driven": 0, "n": 5, "running": False}}
    rig.feed(SourceStarted(rig.t, "sampler", "inputs"))
    rig.observe()
    rig.propose(source="sampler")
    found = status(rig)
    assert (found["inputs"], found["driving"]) == ({"digest": "inputs", "driven": 1, "n": 5, "running": True}, "sampler")


def test_a_verification_and_then_a_controller_that_drives() -> None:
    rig = Rig()
    rig.gap()
    rig.request("deploy", digest="controller")
    found = status(rig)
    assert (found["controller"], found["stage"], found["certificate"], found["jobs"]) == ("controller", "verifying", None, ["deploy"])
    assert (found["reason"], found["attempts"], found["samples_to_certificate"]) == ("verification_running", 1, 0)
    rig.verified()
    rig.stored()
    assert (status(rig)["stage"], status(rig)["certificate"]) == ("starting", "c1")
    rig.feed(SourceStarted(rig.t, "controller", "controller"))
    for _ in range(8):
        rig.observe()
        rig.propose()
    rig.measure(0.012)
    rig.measure(0.001, fault="jump")
    found = status(rig)
    assert (found["gate"], found["reason"], found["stage"], found["driving"]) == ("open", "allowed", "running", "controller")
    assert (found["radius"], found["gap_radius"], found["verified_radius"]) == (0.012, 0.01, 0.015)
    assert found["headroom_used"] == pytest.approx(0.8)
    assert (found["certificate_left_s"], found["measurement_faults"], found["alarm"]) == (1000, 1, False)
    seen = found["stream"]
    assert isinstance(seen, dict)
    counts = rig.state.memory.watch_counts
    assert seen == {
        "n": 10,
        "exceedances": 1,
        "exceedance_upper": stream.share_above(1, 10, 0.01),
        "quantile": stream.quantile(counts, 0.01, 0.03, 0.01),
        "epsilon": 0.03,
        "alpha": 0.01,
        "e_value": 1.0,
        "alarm_at": 100.0,
        "change": 0.0,
        "change_at": 1e5,
        "exchange": 1.0,
        "exchange_at": 100.0,
    }
    rig.measure(0.001, e_value=1e3)
    assert (status(rig)["alarm"], status(rig)["e_value"], status(rig)["latched"]) == (True, 1e3, ["watch_alarm"])


def test_a_proposal_says_whose_decision_it_is() -> None:
    proposal = Proposal("better", "model", "campaign", 1, ("gain of w",))
    for adopt in ("ask", "always"):
        rig = Rig(memory(proposal=proposal, traced=True), adopt=adopt, start=False)
        assert status(rig)["proposal"] is None
        rig.state = msgspec.structs.replace(Rig(memory(traced=True)).state, settings=rig.settings)
        rig.state = msgspec.structs.replace(rig.state, memory=msgspec.structs.replace(rig.state.memory, proposal=proposal))
        found = status(rig)
        assert found["proposal"] == {**msgspec.structs.asdict(proposal), "adopt": adopt}
        assert found["traced"] is True


@pytest.mark.parametrize(("verified", "used"), [(0.02, 0.5), (0.0, None), (5e-324, None), (math.inf, 0.0)])
def test_the_headroom_is_a_number_or_nothing(verified: float, used: float | None) -> None:
    facts = msgspec.structs.replace(memory().certificates[0], verified_radius=verified)
    rig = Rig(memory(radius=0.01))
    rig.observe()
    rig.request("deploy", digest="controller")
    kept = msgspec.structs.replace(rig.state.memory, certificates=(facts,))
    rig.state = msgspec.structs.replace(rig.state, memory=kept)
    assert status(rig)["headroom_used"] == used


def test_samples_are_lacking_until_a_gap_is_in_force() -> None:
    def lacking(past: Memory, **changes: Any) -> object:
        return samples_to_certificate(Rig(past, **changes).state)

    fresh = Memory("r", memory().schema)
    assert lacking(fresh) == 161
    assert lacking(fresh, campaign_n=500) == 500
    assert lacking(fresh, epsilon=1e-9) is None
    assert lacking(memory()) == 0
    assert lacking(memory(alarm_epoch=1)) == ledger.campaign_size(0.03, ledger.share(0.05, 2), 0)
    assert lacking(memory(gap=None, campaign_epoch=2, campaign_n=222, epochs=2)) == 222
    assert GAP.epoch == 1
