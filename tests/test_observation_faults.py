"""A fault in more than a few observations is a closed gate, not a flap; and two robots under one name close it at once (docs/gate.md)."""

from __future__ import annotations

import math
import random
from pathlib import Path

import msgspec
import pytest
from core_rig import DT, Rig, of, one

from s2r_runtime.audit.log import audit
from s2r_runtime.audit.older import as_recorded
from s2r_runtime.core.status import against_sampler
from s2r_runtime.messages import (
    Decided,
    GateChanged,
    Observation,
    ObservationRefused,
    Observed,
    OverrideChanged,
    Send,
    StopCampaign,
    Ticked,
)
from s2r_runtime.profile import Profile, parse_profile, plain_table

BOUND = {"fault_share": 0.1, "fault_burst": 10}


def rig(**changes: object) -> Rig:
    return Rig(**{**BOUND, **changes})  # type: ignore[arg-type]


def faulty(it: Rig, fault: str = "malformed observation: state lacks 'x'") -> None:
    it.observe((), fault=fault)


def latched(it: Rig) -> tuple[str, ...]:
    return it.state.memory.latched


# ---------------------------------------------------------------- how many are too many


def test_every_second_one_faulty_latches_within_26_observations() -> None:
    it = rig()
    for _ in range(13):
        assert not latched(it)
        it.observe()
        faulty(it)
    assert latched(it) == ("observation_faults",)
    it.observe()
    assert it.state.gate_reason == "observation_faults", "a good one does not open what is latched"


def test_a_few_faults_do_not_latch_and_the_gate_opens_again() -> None:
    it = rig()
    it.driving()
    for _ in range(3):
        faulty(it)
        assert not it.state.gate_open
        while not it.state.gate_open:
            it.observe()
    assert latched(it) == ()


def test_what_is_faulty_all_the_time_counts_once() -> None:
    """A robot that says for an hour that it can't be driven keeps the gate closed, and has no bad link."""
    it = rig()
    it.observe()
    for _ in range(2000):
        faulty(it, "the robot can't be driven: HOLD, armed")
        assert it.state.trouble == "observation_invalid"
    assert latched(it) == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_share_below_the_bound_passes_and_one_above_latches(seed: int) -> None:
    """At 5 % the chance of a level of 10 is about 1e-6 a fault, so 6e-5 in these 1200 observations."""
    draw = random.Random(seed)
    for share, expected in ((0.02, False), (0.05, False), (0.3, True)):
        it = rig()
        it.observe()
        for _ in range(1200):
            faulty(it) if draw.random() < share else it.observe()
        assert bool(latched(it)) == expected, share


def test_observations_out_of_order_latch_at_a_half_and_not_at_one_in_twenty() -> None:
    for every, expected in ((20, False), (2, True)):
        it = rig()
        for k in range(400):
            it.observe()
            if k % every == every - 1:
                it.feed(Observed(it.t, Observation(it.seq - 3, it.t - 3 * DT, (0.5, 0.2, 0.0))))
        assert (latched(it) == ("observation_faults",)) == expected, every
        assert expected or it.state.memory.latched == ()


def test_a_single_reordered_message_latches_nothing() -> None:
    it = rig()
    it.driving()
    it.feed(ObservationRefused(it.t, "a late message"))
    assert it.state.gate_open, "what the transport dropped does not close the gate"
    it.observe()
    assert it.state.gate_open
    assert latched(it) == ()


def test_messages_that_the_transport_dropped_count_and_a_burst_counts_once() -> None:
    it = rig()
    it.driving()
    for _ in range(30):  # a copy of the stream
        it.observe()
        it.feed(ObservationRefused(it.t, "an echo of observation 7"))
    assert latched(it) == ("observation_faults",)
    assert "an echo of observation 7" in of(it.outputs, GateChanged)[-1].detail
    it = rig()
    it.observe()
    for _ in range(100):
        it.feed(ObservationRefused(it.t, "a late message"))
    assert latched(it) == ()


def test_numbers_that_are_not_finite_and_states_of_the_wrong_length_count() -> None:
    for x in ((math.nan, 0.0, 0.0), (0.1, 0.2)):
        it = rig()
        for _ in range(15):
            it.observe()
            it.observe(x)
        assert latched(it) == ("observation_faults",)


def test_repeats_of_a_robot_in_lockstep_are_no_faults() -> None:
    it = rig(lockstep=True)
    for _ in range(60):
        it.observe()
        for _ in range(5):
            it.repeat()
    assert latched(it) == ()
    assert it.state.fault_level == 0.0


@pytest.mark.parametrize(("share", "burst"), [(0.0, 0), (1.0, 10)])
def test_no_bound_is_no_bound(share: float, burst: int) -> None:
    it = rig(fault_share=share, fault_burst=burst)
    for _ in range(200):
        it.observe()
        faulty(it)
    assert latched(it) == ()


def test_everything_stops_and_goes_on_only_when_a_person_cleared_it() -> None:
    it = rig()
    it.sampling()
    outputs: list[object] = []
    while not latched(it):
        it.observe()
        it.propose((0.1, 0.0), source="sampler")
        outputs = it.observe((), fault="malformed observation: state lacks 'x'")  # type: ignore[assignment]
    assert one(outputs, StopCampaign).reason == "observation_faults"
    assert of(outputs, Send)[-1].u == (0.0, 0.0)
    told = it.outputs[-20:]
    assert any("state lacks 'x'" in getattr(output, "text", "") for output in told), "whoever waits is told what was wrong"
    refused = it.request("sample")
    text = refused[-1].text  # type: ignore[union-attr]
    assert "observation_faults: malformed observation: state lacks 'x': " in text
    assert "s2r clear observation_faults" in text
    it.request("clear", text="observation_faults")
    assert it.state.fault_level == 0.0
    it.observe()
    it.request("permit", duration_s=60.0)
    assert not any("refused" in getattr(output, "text", "") for output in it.request("sample"))


def test_refused_for_a_faulty_observation_says_what_is_wrong_with_it() -> None:
    it = rig()
    it.observe()
    faulty(it)
    it.request("permit", duration_s=60.0)
    text = it.request("sample")[-1].text  # type: ignore[union-attr]
    assert text == "refused: observation_invalid: malformed observation: state lacks 'x'"


# ---------------------------------------------------------------- two robots


@pytest.mark.parametrize("recovery", ["stop", "hold", "return"])
def test_a_twin_stops_everything_at_once_with_zero_input(recovery: str) -> None:
    it = rig(recovery=recovery, recovery_input=(0.1, 0.5))
    it.driving()
    outputs = it.feed(OverrideChanged(it.t, "robot_twin", "publisher 0102 goes on after 0304"))
    closed = one(outputs, GateChanged)
    assert (closed.open, closed.reason, closed.detail) == (False, "robot_twin", "publisher 0102 goes on after 0304")
    assert one(outputs, Send).u == (0.0, 0.0)
    assert it.state.deployment is None
    for _ in range(20):
        it.observe()
    assert it.state.gate_reason == "robot_twin"
    assert all(send.u == (0.0, 0.0) for send in of(it.outputs, Send)[-20:])


def test_what_a_twin_sends_latches_nothing_besides() -> None:
    it = rig()
    it.observe()
    it.feed(OverrideChanged(it.t, "robot_twin", "two"))
    for _ in range(60):
        it.observe()
        faulty(it, "another publisher is on the topic")
    assert latched(it) == ("robot_twin",)
    assert it.state.fault == "two"


def test_a_twin_outlives_a_restart_and_keeps_the_sampler_out() -> None:
    it = rig()
    it.feed(OverrideChanged(it.t, "robot_twin", "two"))
    again = Rig(it.state.memory, **BOUND)  # type: ignore[arg-type]
    again.observe()
    again.request("permit", duration_s=60.0)
    text = again.request("sample")[-1].text  # type: ignore[union-attr]
    assert text.startswith("refused: robot_twin: two robots answer to one name")
    again.request("clear", text="robot_twin")
    assert again.request("sample")[-1].__class__.__name__ == "StartCampaign"


# ---------------------------------------------------------------- why a sample was rejected


def test_a_sample_is_never_rejected_because_it_was_allowed() -> None:
    it = rig()
    it.sampling()
    it.observe()
    allowed = it.propose((0.1, 0.0), source="sampler")
    assert one(allowed, Decided).allow
    it.observe((), fault="malformed", after=DT // 4)  # between two instants: nobody is asked
    it.t += DT
    outputs = it.feed(Ticked(it.t))  # the robot isn't seen: the recovery command goes out in the sampler's place
    assert one(outputs, Send).source == "recovery"
    assert against_sampler(it.state, tuple(outputs)) == "observation_invalid"
    it.observe()
    refused = it.propose((9.0, 0.0), source="sampler")
    assert against_sampler(it.state, tuple(refused)) == "input_out_of_bounds"


# ---------------------------------------------------------------- profiles and logs of before


def _profile(text: str = "", *, as_before: tuple[str, ...] = ()) -> Profile:
    table = (Path(__file__).parent.parent / "profiles" / "robotarium.toml").read_text(encoding="utf-8")
    return parse_profile(table + text, "p.toml", Path(), as_before=as_before)


def test_a_profile_of_before_is_audited_as_it_was() -> None:
    then, now = _profile(as_before=("gate",)), _profile()
    assert (then.gate.fault_share, now.gate.fault_share) == (0.0, 0.1)
    assert "fault_share" not in plain_table("gate", then.gate)
    assert then.digest() != now.digest()
    assert set(msgspec.to_builtins(now.gate)) - set(plain_table("gate", then.gate)) == {"fault_share", "fault_burst"}


def test_a_log_of_before_is_replayed_by_its_own_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    """`Bench(...).sample().drive(40).stop()` as the version before wrote it."""
    import audit_bench

    monkeypatch.setattr(audit_bench.BenchTask, "horizon", 150)  # of the task that it drove
    log = Path(__file__).parent / "replay" / "log_before_fault_bound.mcap"
    result = audit([log], audit_bench.PUBLIC)
    assert result.ok, result.text()
    assert "1 runs by an earlier version's rule" in result.text()


def test_a_record_of_before_may_lack_later_fields_and_nothing_else() -> None:
    now = b'{"type":"started","settings":{"a":1,"later":0.0},"t_ns":5}'
    assert as_recorded(now, now)
    assert as_recorded(now, b'{"type":"started","settings":{"a":1},"t_ns":5}')
    for other in (
        b'{"type":"started","settings":{"a":1},"t_ns":6}',
        b'{"type":"started","t_ns":5,"settings":{"a":1}}',
        b'{"type":"started","settings":{"a":1,"a":1},"t_ns":5}',
        b'{"type":"started","settings":{"a":1},"t_ns":5,"more":1}',
        b'{"type":"started", "settings":{"a":1},"t_ns":5}',
        b'{"type":"started","settings":{"a":1.0},"t_ns":5}',
        b"{",
    ):
        assert not as_recorded(now, other), other


@pytest.mark.parametrize("setting", ["fault_share = -0.1", "fault_share = 1.5", "fault_burst = -1"])
def test_a_bound_that_makes_no_sense_is_refused(setting: str) -> None:
    from s2r_runtime.errors import ConfigError

    with pytest.raises(ConfigError, match=r"gate\.fault_"):
        _profile(f"\n[gate]\n{setting}\n")
