"""What frames mean: whose pose, in which frame, in which order, and what a command's bytes are."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import Any

import pytest
from s2r_ros2.keys import attached, attachment, envelope, opened
from s2r_ros2.payloads import (
    Located,
    decode_twist,
    decode_twist_stamped,
    encode_bool,
    encode_transforms,
    encode_twist,
    encode_twist_stamped,
)
from s2r_ros2.testing import message
from s2r_ros2.transport import Ros2Transport

from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged

MS = 1_000_000
START = 1_700_000_000_000 * MS
STATES, INPUTS = ("x", "y", "theta"), ("v", "w")
A, B = bytes(range(16)), bytes(range(16, 32))


def transport(model: tuple[tuple[str, ...], tuple[str, ...]] = (STATES, INPUTS), **options: Any) -> Ros2Transport:
    return Ros2Transport({"robot_listen": "tcp/127.0.0.1:1", **options}, *model)


def frame(
    k: int, x: tuple[float, ...] = (0.1, 0.2, 0.3), *, gid: bytes = b"", seq: int | None = None, pose: str = "odometry", **at: Any
) -> Frame:
    """Pose k of a robot at 20 Hz, as it arrives."""
    stamp = at.get("stamp", START + 50 * k * MS)
    extra = attachment(k + 1 if seq is None else seq, stamp, gid) if gid else b""
    return Frame(at.get("arrival", 50 * k * MS), "pose", envelope(extra, message(pose, stamp, x, at.get("twist", ()))))


def good(said: list[Any]) -> list[Observation]:
    return [m for m in said if isinstance(m, Observation) and not m.fault]


def faults(said: list[Any]) -> list[str]:
    return [m.fault for m in said if isinstance(m, Observation) and m.fault]


def test_first_pose_brings_the_link_up_and_each_is_an_observation() -> None:
    t = transport()
    first = t.decode(frame(0))
    assert isinstance(first[0], LinkChanged)
    assert first[0].up
    (o,) = good([*first, *t.decode(frame(0))])
    assert (o.seq, o.stamp_ns) == (0, START)
    assert o.x == pytest.approx((0.1, 0.2, 0.3))
    assert t.counters()["old"] == 1


def test_lost_ones_are_counted_by_sequence_or_by_period_and_leave_a_hole_in_the_numbers() -> None:
    for options, more in (({"layout": "rmw"}, {"gid": A}), ({"period": 0.05}, {})):
        t = transport(**options)
        said = [m for k in (0, 1, 4, 5) for m in t.decode(frame(k, **more))]
        assert [o.seq for o in good(said)] == [0, 1, 4, 5]
        assert t.counters()["lost"] == 2
    silent = transport()
    assert [o.seq for o in good([m for k in (0, 4) for m in silent.decode(frame(k))])] == [0, 1]


def test_publisher_of_other_transforms_too_loses_nothing_by_its_count() -> None:
    t = transport(layout="rmw", pose="tf", frame="odom", child_frame="base_footprint", period=0.05)
    said = [m for k in (0, 1, 2, 5) for m in t.decode(frame(k, gid=A, seq=7 * k + 1, pose="tf"))]
    assert [o.seq for o in good(said)] == [0, 1, 2, 5]
    assert t.counters()["lost"] == 2, "by the stamps"


def test_two_poses_of_one_message_are_two_observations() -> None:
    t = transport(layout="rmw", pose="tf", frame="odom", child_frame="base_footprint")
    ours = [Located(START + k * MS, "odom", "base_footprint", (0.1 * k, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) for k in (1, 2)]
    said = t.decode(Frame(5, "pose", envelope(attachment(1, 1, A), encode_transforms(ours))))
    assert [o.x[0] for o in good(said)] == [0.1, 0.2]


def test_another_publisher_is_a_fault_while_the_first_is_heard_and_the_robot_once_it_is_not() -> None:
    t = transport(layout="rmw")
    assert good(t.decode(frame(0, gid=A)))
    assert faults(t.decode(frame(1, gid=B))) == ["malformed pose: another publisher is on the topic"]
    assert good(t.decode(frame(2, gid=A)))
    assert good(t.decode(frame(20, gid=B)))
    assert faults(t.decode(frame(21, gid=A)))


def test_sequence_that_does_not_rise_is_a_fault() -> None:
    t = transport(layout="rmw")
    t.decode(frame(0, gid=A, seq=50))
    assert "sequence" in faults(t.decode(frame(1, gid=A, seq=50)))[0]
    assert good(t.decode(frame(2, gid=A, seq=51)))


def test_payload_without_attachment_is_a_fault_under_rmw() -> None:
    t = transport(layout="rmw")
    assert "no attachment" in faults(t.decode(frame(0)))[0]


def test_pose_in_another_frame_or_of_another_one_is_a_fault() -> None:
    (why,) = faults(transport(frame="map", child_frame="base_footprint").decode(frame(0)))
    assert why == "malformed pose: it is of base_footprint in 'odom', not of base_footprint in 'map'"
    assert faults(transport(child_frame="base_link").decode(frame(0)))
    assert good(transport(frame="odom", child_frame="base_footprint").decode(frame(0)))
    t = transport()
    t.decode(frame(0))  # what the first one had holds for all
    other = Frame(50 * MS, "pose", envelope(b"", message("odometry", START + 50 * MS, (0.0, 0.0, 0.0)).replace(b"odom\0", b"xdom\0")))
    assert faults(t.decode(other))


def test_transform_is_picked_out_of_a_message_and_others_mean_nothing() -> None:
    t = transport(pose="tf", frame="odom", child_frame="base_footprint")
    assert good(t.decode(frame(0, pose="tf")))[0].x == pytest.approx((0.1, 0.2, 0.3))
    other = transport(pose="tf", frame="map", child_frame="odom")
    assert other.decode(frame(0, pose="tf")) == []
    assert other.counters()["foreign"] == 1


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_pose_that_is_not_finite_is_a_fault_and_the_next_good_one_counts(value: float) -> None:
    t = transport()
    t.decode(frame(0))
    assert faults(t.decode(frame(1, (value, 0.0, 0.0))))
    assert good(t.decode(frame(2)))


def test_robot_that_does_not_stamp_is_a_fault_unless_the_arrival_counts() -> None:
    assert "stamp is zero" in faults(transport().decode(frame(0, stamp=0)))[0]
    t = transport(stamp="arrival")
    said = [m for k in range(3) for m in t.decode(frame(k, stamp=0))]
    assert [o.stamp_ns for o in good(said)[1:]] == [50 * MS, 100 * MS]


def test_clock_that_is_set_back_takes_the_link_down_and_up() -> None:
    t = transport(observation_timeout=0.3)
    for k in range(5):
        t.decode(frame(k))
    hour = 3600 * 1000 * MS
    assert refusals(t.decode(frame(5, stamp=START - hour)))
    said = t.decode(frame(12, stamp=START - hour + 350 * MS))
    assert [m.up for m in said if isinstance(m, LinkChanged)] == [False, True]
    (o,) = good(said)
    assert o.stamp_ns == START + 200 * MS + 1000 * MS
    assert o.seq == 6


def test_pose_that_took_much_longer_than_the_fastest_is_a_fault() -> None:
    t = transport(max_age=0.3)
    for k in range(60):
        assert good(t.decode(frame(k)))
    assert "later than the fastest" in faults(t.decode(frame(60, arrival=3000 * MS + 400 * MS)))[0]
    assert good(t.decode(frame(70)))


def test_speeds_come_from_odometrys_twist() -> None:
    t = transport((("x", "y", "theta", "speed"), INPUTS))
    assert good(t.decode(frame(0, twist=(0.4, 0.0, 0.0, 0.0, 0.0, 0.1))))[0].x[3] == 0.4


# ---------------------------------------------------------------- commands


def command(u: tuple[float, ...] = (0.1, -0.5), t_ns: int = 0) -> Command:
    return Command(1, t_ns, "sampler", u, 0, 80 * MS)


def test_command_is_a_twist() -> None:
    extra, payload = opened(transport().encode(command()).data)
    assert extra == b""
    assert decode_twist(payload) == (0.1, 0.0, 0.0, 0.0, 0.0, -0.5)


def test_inputs_go_where_the_profile_says() -> None:
    t = transport((STATES, ("gas", "wheel")), inputs={"gas": "linear.x", "wheel": "angular.z"})
    assert decode_twist(opened(t.encode(command()).data)[1]) == (0.1, 0.0, 0.0, 0.0, 0.0, -0.5)


def test_stamped_command_has_the_robots_time_as_its_newest_pose_tells_it() -> None:
    t = transport(command="twist_stamped", layout="rmw", command_frame="base")
    t.decode(frame(10, gid=A))
    extra, payload = opened(t.encode(command(t_ns=500 * MS + 20 * MS)).data)
    assert decode_twist_stamped(payload) == (0.1, 0.0, 0.0, 0.0, 0.0, -0.5)
    assert payload == encode_twist_stamped(START + 500 * MS + 20 * MS, "base", (0.1, 0.0, 0.0, 0.0, 0.0, -0.5))
    assert attached(extra)[:2] == (1, START + 520 * MS)
    assert attached(opened(t.encode(command()).data)[0]).sequence == 2


def test_an_audit_encodes_the_same_bytes() -> None:
    frames = [frame(k, gid=A) for k in range(4)]
    made = []
    for _ in range(2):
        t = transport(command="twist_stamped", layout="rmw")
        data = []
        for k, one in enumerate(frames):
            t.decode(one)
            data.append(t.encode(command((0.01 * k, 0.0), one.arrival_ns + 3 * MS)).data)
        made.append(data)
    assert made[0] == made[1]


def test_commands_of_others_are_external_and_bad_ones_faulty() -> None:
    t = transport()
    twist = encode_twist((0.7, 0.0, 0.0, 0.0, 0.0, 0.2))
    (theirs,) = t.decode(Frame(5, "proposal", envelope(b"", twist)))
    assert isinstance(theirs, Command)
    assert (theirs.source, theirs.u, theirs.fault) == ("external", (0.7, 0.2), "")
    for data in (b"", envelope(b"", twist[:-1]), envelope(b"", encode_twist((math.nan,) * 6))):
        (bad,) = t.decode(Frame(5, "proposal", data))
        assert isinstance(bad, Command)
        assert bad.fault
        assert bad.u == ()


def test_command_of_another_node_on_the_robots_side_is_an_override() -> None:
    (told,) = transport().decode(Frame(5, "stranger", b"anything"))
    assert told == OverrideChanged(5, "manual_override", "another node commands /cmd_vel on the robot's side")


def test_button_stops_the_robot_and_so_does_garbage_on_its_topic() -> None:
    t = transport(emergency_stop="e_stop", manual_override="joy/taken")
    assert t.decode(Frame(5, "emergency_stop", envelope(b"", encode_bool(False)))) == []
    assert t.decode(Frame(5, "manual_override", envelope(b"", encode_bool(True)))) == [OverrideChanged(5, "manual_override", "joy/taken")]
    (told,) = t.decode(Frame(5, "manual_override", envelope(b"", b"?")))
    assert isinstance(told, OverrideChanged)
    assert told.kind == "emergency_stop"


# ---------------------------------------------------------------- two robots, echoes, order


def refusals(said: list[Any]) -> list[str]:
    return [m.detail for m in said if isinstance(m, ObservationRefused)]


def twins(said: list[Any]) -> list[str]:
    return [m.detail for m in said if isinstance(m, OverrideChanged) and m.kind == "robot_twin"]


def test_second_publisher_is_a_twin_as_soon_as_the_first_goes_on() -> None:
    t = transport(layout="rmw")
    assert good(t.decode(frame(0, gid=A)))
    assert not twins(t.decode(frame(1, gid=B)))
    said = t.decode(frame(2, gid=A))
    assert isinstance(said[0], OverrideChanged), "before the observation that somebody would answer"
    assert twins(said) == [f"publisher {A.hex()} goes on after another one was heard"]


def test_twin_that_lasts_is_said_once_a_second() -> None:
    t = transport(layout="rmw")
    said = [(k, twins(t.decode(frame(k, gid=(A, B)[k % 2])))) for k in range(100)]
    at = [0.05 * k for k, told in said if told]
    assert at[0] == 0.1
    assert len(at) == 5
    assert min(b - a for a, b in pairwise(at)) >= 1.0


@pytest.mark.parametrize("pause", [12, 100])
def test_restarted_publisher_is_no_twin(pause: int) -> None:
    """Its count begins anew, its gid is another, and the old one is silent for longer than the observation timeout (0.5 s)."""
    t = transport(layout="rmw")
    said = [m for k in range(20) for m in t.decode(frame(k, gid=A, seq=1000 + k))]
    said += [m for k in range(20 + pause, 80 + pause) for m in t.decode(frame(k, gid=B, seq=k - pause - 19))]
    assert not twins(said)
    assert len(good(said)) == 80


def test_publisher_that_restarts_within_the_timeout_is_faulty_until_then_and_no_twin() -> None:
    t = transport(layout="rmw")
    said = [m for k in range(10) for m in t.decode(frame(k, gid=A))]
    said += [m for k in range(11, 60) for m in t.decode(frame(k, gid=B, seq=k))]
    assert not twins(said)
    assert set(faults(said)) == {"malformed pose: another publisher is on the topic"}
    assert len(good(said)) == 10 + 60 - 19  # from 0.5 s after the last one


def test_first_robot_that_comes_back_beside_its_replacement_is_a_twin() -> None:
    t = transport(layout="rmw")
    t.decode(frame(0, gid=A))
    assert good(t.decode(frame(20, gid=B)))
    assert faults(t.decode(frame(21, gid=A)))
    assert twins(t.decode(frame(22, gid=B)))


def test_sequence_numbers_that_interleave_under_one_gid_are_a_twin() -> None:
    t = transport(layout="rmw")
    said: list[Any] = []
    for k in range(6):
        said += t.decode(frame(2 * k, gid=A, seq=1000 + k))
        said += t.decode(frame(2 * k + 1, gid=A, seq=5 + k))
    assert twins(said) == ["poses go on in two tracks of stamps or sequence numbers"]


def test_twice_as_many_poses_as_the_period_says_are_two_robots() -> None:
    """Behind a bridge nothing names the publisher; the clocks agree, so that stamps rise."""
    t = transport(period=0.05)
    alone = [m for k in range(40) for m in t.decode(frame(k))]
    assert not twins(alone)
    said = []
    for k in range(40, 80):
        said += t.decode(frame(k))
        said += t.decode(frame(k, (3.0, 1.0, 0.0), stamp=START + (50 * k + 21) * MS, arrival=(50 * k + 21) * MS))
    assert re.fullmatch(r"a pose comes every (29|3\d)\.?\d* ms, transport\.period is 50 ms: two robots, or another period", twins(said)[0])
    first = next(i for i, m in enumerate(said) if isinstance(m, OverrideChanged))
    assert first <= 32, "within 16 periods"


def test_second_robot_whose_clock_is_behind_is_a_twin_where_the_period_is_known() -> None:
    t = transport(period=0.05)
    said = []
    for k in range(40):
        said += t.decode(frame(k))
        said += t.decode(frame(k, (3.0, 1.0, 0.0), stamp=START + (50 * k - 733) * MS, arrival=(50 * k + 21) * MS))
    assert twins(said)[0] == "poses go on in two tracks of stamps or sequence numbers"


def test_echoes_and_late_poses_are_refused_and_no_twin() -> None:
    for options in ({}, {"period": 0.05}, {"layout": "rmw"}):
        t = transport(**options)
        gid = {"gid": A} if "layout" in options else {}
        said = [m for k in range(40) for m in (*t.decode(frame(k, **gid)), *t.decode(frame(max(0, k - 3), arrival=50 * k * MS + 5, **gid)))]
        assert set(refusals(said)) == {"an echo: this pose was heard before"}
        assert not twins(said)
        assert len(good(said)) == 40
        t = transport(**options)
        order = [k + (1, -1)[k % 2] for k in range(40)]  # every second one is late
        said = [m for place, k in enumerate(order) for m in t.decode(frame(k, arrival=50 * place * MS, **gid))]
        assert set(refusals(said)) == {"a late pose: a newer one was heard before"}
        assert not twins(said)


def test_transform_that_is_published_again_is_no_echo() -> None:
    t = transport(layout="rmw", pose="tf", frame="odom", child_frame="base_footprint")
    said = [m for k in range(20) for n in range(2) for m in t.decode(frame(k, gid=A, seq=2 * k + n + 1, pose="tf"))]
    assert not refusals(said)
    assert len(good(said)) == 20
