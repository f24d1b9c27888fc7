"""What payloads mean, from the bytes alone."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from s2r_zenoh.transport import ZenohTransport
from s2r_zenoh.wire import PAYLOAD_MAX, Wire

from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged

SECOND = 1_000_000_000


def wire() -> Wire:
    return Wire(("x", "theta"), ("v", "w"), restart_ns=SECOND // 2)


def frame(payload: Any, arrival_ns: int = 0, channel: str = "observation") -> Frame:
    data = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    return Frame(arrival_ns, channel, data)


def observation(seq: int, stamp_ns: int | None = None, boot: int = 0, **state: float) -> dict[str, Any]:
    return {"seq": seq, "stamp_ns": seq * 1000 if stamp_ns is None else stamp_ns, "state": {"x": 0.1, "theta": 0.2, **state}, "boot": boot}


def seen(w: Wire, payload: Any, arrival_ns: int = 0) -> list[Observation]:
    return [m for m in w.decode(frame(payload, arrival_ns)) if isinstance(m, Observation)]


def test_first_observation_reports_the_link_up_before_itself() -> None:
    up, first = wire().decode(frame(observation(5), 77))
    assert up == LinkChanged(77, up=True)
    assert first == Observation(5, 5000, (0.1, 0.2))


def test_state_is_taken_by_name_and_what_the_model_does_not_know_is_ignored() -> None:
    payload = {"stamp_ns": 1, "battery": 0.7, "state": {"theta": 3, "gripper": 1.0, "x": -2.5}, "seq": 0}
    assert seen(wire(), payload) == [Observation(0, 1, (-2.5, 3.0))]


@pytest.mark.parametrize(
    ("payload", "says"),
    [
        (b"", "truncated"),
        (b"not json", "malformed"),
        (b"[1, 2]", "Expected `object`"),
        (b"\xff\xfe\x00", "malformed"),
        (b'{"seq":1,"stamp_ns":2,"state":{"\xff":1}}', "utf-8"),
        (b'{"seq":1,"stamp_ns":2,"more":' + b"[" * 60_000, "more than 100 objects"),
        (b'{"seq":1,"stamp_ns":2,"state":' + b" " * PAYLOAD_MAX, "at most 65536"),
        (b'{"seq":1,"stamp_ns":2,"state":{"x":NaN,"theta":0}}', "malformed"),
        (b'{"seq":1,"stamp_ns":2,"state":{"x":1e999,"theta":0}}', "out of range"),
        (b'{"seq":1,"stamp_ns":2,"state":{"x":-Infinity,"theta":0}}', "malformed"),
        (b'{"seq":1,"stamp_ns":2,"state":{"x":null,"theta":0}}', "got `null`"),
        (b'{"seq":1,"stamp_ns":2,"state":{"x":"0.1","theta":0}}', "got `str`"),
        (b'{"seq":1,"stamp_ns":2,"state":{"x":true,"theta":0}}', "got `bool`"),
        (observation(1, x=1e12), "x is beyond 1e+09"),
        ({"seq": 1, "stamp_ns": 2, "state": {"x": 0.1}}, "lacks 'theta'"),
        ({"seq": 1, "stamp_ns": 2}, "missing required field `state`"),
        (observation(-1), "seq must be in 0"),
        (observation(10**30, 5), "seq must be in 0"),
        (observation(1, -5), "stamp_ns must be in 0"),
        (b'{"seq":1.5,"stamp_ns":2,"state":{"x":0,"theta":0}}', "got `float`"),
    ],
)
def test_malformed_observation_is_a_fault_with_its_reason_and_no_numbers(payload: Any, says: str) -> None:
    w = wire()
    seen(w, observation(3))
    (fault,) = seen(w, payload)
    assert fault.x == ()
    assert says in fault.fault
    assert fault.fault.startswith("malformed observation: ")
    assert (fault.seq, fault.stamp_ns) == (3, 3000)
    assert w.malformed == 1
    assert seen(w, observation(4)) == [Observation(4, 4000, (0.1, 0.2))], "the next good one counts"


@pytest.mark.parametrize("state", ["{}", '{"x": 0.1}', '{"x": NaN, "theta": 0}', '{"x": 1e999, "theta": 0}', "null", '"fallen"'])
def test_observation_without_a_usable_state_keeps_its_place_so_that_a_waiting_robot_is_answered(state: str) -> None:
    w = wire()
    seen(w, observation(3, boot=7))
    (fault,) = seen(w, b'{"seq": 5, "stamp_ns": 5000, "state": %s, "boot": 7}' % state.encode())
    assert (fault.seq, fault.stamp_ns, fault.x) == (5, 5000, ())
    assert (w.newest, w.lost, w.malformed) == (5, 1, 1)
    assert seen(w, observation(4, boot=7)) == [], "older than that"
    assert seen(w, observation(6, boot=7)) == [Observation(6, 6000, (0.1, 0.2))]


def test_unusable_observation_of_another_boot_or_with_a_stamp_that_does_not_rise_moves_nothing() -> None:
    w = wire()
    seen(w, observation(3, boot=7))
    for payload in (b'{"seq": 5, "stamp_ns": 5000, "state": {}, "boot": 8}', b'{"seq": 5, "stamp_ns": 3000, "state": {}, "boot": 7}'):
        (fault,) = seen(w, payload)
        assert (fault.seq, fault.stamp_ns) == (3, 3000)
    assert seen(w, observation(4, boot=7)) == [Observation(4, 4000, (0.1, 0.2))]


def test_repeat_is_nothing_new_and_an_older_one_is_dropped() -> None:
    w = wire()
    seen(w, observation(7))
    assert w.decode(frame(observation(7))) == []
    assert w.decode(frame(observation(5))) == [ObservationRefused(0, "it came late: observation 5")]
    assert (w.old, w.lost) == (1, 0)
    seen(w, observation(10))
    assert w.lost == 2


def test_a_robot_that_waited_through_a_silence_is_observed_again_above_its_old_number() -> None:
    w = wire()
    seen(w, observation(7), arrival_ns=5)
    assert w.decode(frame(observation(7), arrival_ns=6)) == []
    down, up, again = w.decode(frame(observation(7), arrival_ns=5 + 2 * SECOND))
    assert isinstance(down, LinkChanged)
    assert isinstance(up, LinkChanged)
    assert (down.up, down.detail, up.up) == (False, "the robot was silent, and waits where it was", True)
    assert isinstance(again, Observation)
    assert again.seq > 7
    assert again.x == (0.1, 0.2)


def test_same_seq_with_other_content_and_a_stamp_that_does_not_rise_are_faults() -> None:
    w = wire()
    seen(w, observation(7))
    assert "used before" in seen(w, observation(7, x=0.5))[0].fault
    assert "does not rise" in seen(w, observation(8, 7000))[0].fault


@pytest.mark.parametrize(("boot", "gap"), [(1, 0), (0, SECOND)])
def test_robot_started_anew_goes_on_above_its_old_numbers_with_the_link_down_between(boot: int, gap: int) -> None:
    w = wire()
    seen(w, observation(900), arrival_ns=5)
    down, up, after = w.decode(frame(observation(0, 0, boot), arrival_ns=5 + gap))
    assert isinstance(down, LinkChanged)
    assert isinstance(up, LinkChanged)
    assert isinstance(after, Observation)
    assert (down.up, up.up) == (False, True)
    assert "started anew" in down.detail
    assert after.seq > 901
    assert after.stamp_ns >= 900_000 + SECOND
    assert seen(w, observation(1, 33, boot), 6 + gap) == [Observation(after.seq + 1, after.stamp_ns + 33, (0.1, 0.2))]
    answer = json.loads(w.encode(Command(1, 2, "sampler", (0.0, 0.0), after.seq + 1, 3)))
    assert answer["obs_seq"] == 1, "the robot is answered in its own count"


def test_forged_number_from_the_future_locks_the_robot_out_only_until_the_restart_time() -> None:
    w = wire()
    seen(w, observation(10), 0)
    seen(w, observation(10**9), 1)
    assert seen(w, observation(11), 2) == []
    assert seen(w, observation(12), 2 + SECOND)[0].x == (0.1, 0.2)


def test_keep_alives_of_a_waiting_robot_hold_off_the_restart_time() -> None:
    w = wire()
    for quarter in range(12):
        w.decode(frame(observation(10), quarter * SECOND // 4))
    assert seen(w, observation(9), 3 * SECOND) == []


def test_robot_without_a_boot_number_that_repeats_an_old_count_is_one_that_started_anew_after_the_restart_time() -> None:
    """In lockstep it waits and repeats itself: the transport must hand on what it repeats, or nobody would ever answer it."""
    transport = ZenohTransport({"robot_listen": "tcp/127.0.0.1:1", "observation_timeout": 0.5}, ("x", "theta"), ("v", "w"))
    first, again = (json.dumps(observation(seq)).encode() for seq in (900, 0))

    def heard(data: bytes, at_ns: int) -> list[Any]:
        transport._observations._waiting.append((at_ns, data))
        return [m for f in transport.receive() for m in transport.decode(f)]

    assert heard(first, 0)[-1] == Observation(900, 900_000, (0.1, 0.2))
    assert heard(first, SECOND // 10) == [], "it waits"
    for k in (1, 2):
        (refused,) = heard(again, SECOND // 5 * k)
        assert isinstance(refused, ObservationRefused), "an echo of the past, for all that is known"
    down, up, anew = heard(again, SECOND)
    assert (down.up, up.up, anew.seq > 900, anew.x) == (False, True, True, (0.1, 0.2))
    transport.send(transport.encode(Command(1, SECOND, "controller", (0.1, 0.0), anew.seq, SECOND)))
    assert heard(again, SECOND + 1) == [], "it waits"
    assert transport.counters()["repeated"] == 2, "and gets its answer once more, which may have been lost"


# ---------------------------------------------------------------- two robots, echoes, order


def twins(said: list[Any]) -> list[str]:
    return [m.detail for m in said if isinstance(m, OverrideChanged) and m.kind == "robot_twin"]


def refusals(said: list[Any]) -> list[str]:
    return [m.detail for m in said if isinstance(m, ObservationRefused)]


def told(payloads: list[dict[str, Any]], period_ns: int = SECOND // 40) -> list[Any]:
    w = wire()
    return [m for k, payload in enumerate(payloads) for m in w.decode(frame(payload, k * period_ns))]


def test_boot_number_that_goes_on_after_another_one_is_a_twin_before_anybody_is_answered() -> None:
    w = wire()
    w.decode(frame(observation(7, boot=1), 0))
    assert not twins(w.decode(frame(observation(900, boot=2), 1)))
    said = w.decode(frame(observation(8, boot=1), 2))
    assert isinstance(said[0], OverrideChanged)
    assert said[0].detail == "the robot with boot 1 goes on at seq 8 after one with boot 2 was heard"


def test_robot_that_starts_anew_again_and_again_is_no_twin() -> None:
    assert not twins(told([observation(k, boot=boot) for boot in (1, 2, 3, 1, 2) for k in range(5)]))


@pytest.mark.parametrize("ahead", [0, 1, 10, 63, 500, 10_000])
@pytest.mark.parametrize("first", [0, 1000])
def test_two_counts_that_interleave_are_a_twin_at_any_distance(ahead: int, first: int) -> None:
    """Two robots without boot numbers; the clock of the second one is another."""
    both = [(observation(first + k), observation(first + k + ahead, 77 + 1000 * (first + k), x=3.0)) for k in range(200)]
    said = told([one for pair in both for one in pair])
    assert twins(said)


@pytest.mark.parametrize(("ahead", "most"), [(0, 6), (500, 6), (-30, 6)])
def test_two_counts_are_a_twin_within_three_observations_each(ahead: int, most: int) -> None:
    both = [(observation(100 + k), observation(100 + k + ahead, 77 + 1000 * (k + 30), x=3.0)) for k in range(-20, 3)]
    flat = [observation(100 + k) for k in range(-60, -20)] + [one for pair in both for one in pair]
    said = [twins([m]) for m in told(flat)]
    w, heard = wire(), 0
    for k, payload in enumerate(flat):
        heard += k >= 40
        if twins(w.decode(frame(payload, k * SECOND // 40))):
            break
    assert any(said)
    assert heard <= most + 1


def test_echoes_and_late_observations_are_refused_and_no_twin() -> None:
    said = told([one for k in range(3, 60) for one in (observation(k), observation(k - 3))])
    assert set(refusals(said)[3:]) == {f"an echo of observation {k}" for k in range(3, 57)}
    assert not twins(said)
    assert len([m for m in said if isinstance(m, Observation)]) == 57
    said = told([observation(k + (1, -1)[k % 2]) for k in range(60)])
    assert set(refusals(said)) == {f"it came late: observation {k}" for k in range(0, 60, 2)}
    assert not twins(said)


def test_single_late_observation_is_refused_and_that_is_all() -> None:
    order = [*range(10), 11, 10, *range(12, 30)]
    said = told([observation(k) for k in order])
    assert refusals(said) == ["it came late: observation 10"]
    assert [m.seq for m in said if isinstance(m, Observation)] == [k for k in range(30) if k != 10]
    assert not any(m.fault for m in said if isinstance(m, Observation))


@pytest.mark.parametrize("boot", [0, 1])
def test_legitimate_restart_is_no_twin(boot: int) -> None:
    w = wire()
    said = [m for k in range(50) for m in w.decode(frame(observation(500 + k), k * SECOND // 20))]
    after = 50 * SECOND // 20 + SECOND
    said += [m for k in range(50) for m in w.decode(frame(observation(k, boot=boot), after + k * SECOND // 20))]
    assert not twins(said)
    assert not refusals(said)
    assert [m.up for m in said if isinstance(m, LinkChanged)] == [True, False, True]


def test_command_is_named_inputs_with_all_that_the_robot_needs() -> None:
    data = wire().encode(Command(12, 400, "controller", (0.1, -0.25), 11, 100_000_000))
    expected = {"seq": 12, "t_ns": 400, "obs_seq": 11, "ttl_ns": 100_000_000, "source": "controller", "input": {"v": 0.1, "w": -0.25}}
    assert json.loads(data) == expected


def test_proposal_is_somebody_elses_command() -> None:
    (command,) = wire().decode(frame({"input": {"v": 1, "w": 0.5}, "seq": 3, "obs_seq": 2}, 9, "proposal"))
    assert command == Command(3, 9, "external", (1.0, 0.5), 2, 0)
    for bad in (b"", {"input": {"v": 1}}, {"input": {"v": 1e10, "w": 0}}, {"input": {"v": 1, "w": 0}, "seq": -1}):
        (command,) = wire().decode(frame(bad, 9, "proposal"))
        assert isinstance(command, Command)
        assert command.fault
        assert command.source == "external"
        assert command.u == ()


def test_override_stops_and_so_does_garbage_in_its_place() -> None:
    w = wire()
    assert w.decode(frame({"kind": "manual_override", "detail": "stick"}, 4, "override")) == [
        OverrideChanged(4, "manual_override", "stick")
    ]
    for garbage in (b"", b"{}", b'{"kind":"dance"}'):
        (stop,) = w.decode(frame(garbage, 4, "override"))
        assert isinstance(stop, OverrideChanged)
        assert stop.kind == "emergency_stop"


def test_frame_of_another_channel_is_not_for_us() -> None:
    assert wire().decode(frame(b"x", channel="somebody")) == []


@given(data=st.binary(max_size=300))
@settings(max_examples=300, deadline=None, derandomize=True)
def test_any_bytes_decode_to_something_without_a_number_in_it(data: bytes) -> None:
    for channel in ("observation", "proposal", "override"):
        for message in wire().decode(frame(data, channel=channel)):
            assert getattr(message, "fault", "") or isinstance(message, OverrideChanged)


@given(events=st.lists(st.tuples(st.integers(0, 8), st.integers(0, 3), st.integers(0, SECOND)), max_size=30))
@settings(max_examples=300, deadline=None, derandomize=True)
def test_numbers_and_stamps_rise_whatever_comes_and_decoding_again_gives_the_same(events: list[tuple[int, int, int]]) -> None:
    arrival, frames = 0, []
    for seq, boot, wait in events:
        arrival += wait
        frames.append(frame(observation(seq, boot=boot), arrival))
    w, again = wire(), wire()
    messages = [m for f in frames for m in w.decode(f)]
    assert messages == [m for f in frames for m in again.decode(f)]
    good = [m for m in messages if isinstance(m, Observation) and not m.fault]
    for field in ("seq", "stamp_ns"):
        values = [getattr(m, field) for m in good]
        assert values == sorted(set(values))
