"""Signs and frames: x north, y west, theta counter-clockwise; MAVLink's east, down and clockwise end at the door."""

from __future__ import annotations

import math
from typing import Any

import pytest
from s2r_mavlink.dialect import ATTITUDE, GLOBAL_POSITION_INT, LOCAL_POSITION_NED, ODOMETRY, VISION_POSITION_ESTIMATE
from s2r_mavlink.pose import QUANTITIES, Pose, PoseSource

NAN_21 = (math.nan,) * 21


def local(states: tuple[str, ...] = QUANTITIES, source: str = "local", origin: tuple[float, float] = (0.0, 0.0)) -> PoseSource:
    return PoseSource(source, states, origin)


def odometry(yaw: float, velocity: tuple[float, float], turn: float, frame: int = 1, child: int = 12, resets: int = 0) -> tuple[Any, ...]:
    q = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    return (1_500_000, 3.0, 4.0, 0.0, *q, *velocity, 0.0, 0.0, 0.0, turn, *NAN_21, *NAN_21, frame, child, resets, 0, 0)


def test_north_east_and_clockwise_become_x_minus_y_and_counter_clockwise() -> None:
    source = local()
    assert source.take(ATTITUDE, (1000, 0.1, 0.2, 0.5, 0.0, 0.0, 0.2)) is None
    pose = source.take(LOCAL_POSITION_NED, (1000, 3.0, 4.0, -1.0, 1.0, 0.0, 0.0))
    assert pose is not None
    assert (pose.stamp_ns, pose.fault) == (1_000_000_000, "")
    got = dict(zip(QUANTITIES, pose.x, strict=True))
    assert got == pytest.approx({"x": 3.0, "y": -4.0, "theta": -0.5, "speed": math.cos(0.5), "vx": 1.0, "vy": 0.0, "w": -0.2})


def test_robot_that_drives_east_and_turns_right_says_so() -> None:
    """East is -y. Its heading is -pi/2 here, and turning right lowers it."""
    source = local()
    source.take(ATTITUDE, (1000, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.3))
    pose = source.take(LOCAL_POSITION_NED, (1000, 0.0, 2.0, 0.0, 0.0, 1.5, 0.0))
    assert pose is not None
    got = dict(zip(QUANTITIES, pose.x, strict=True))
    assert got == pytest.approx({"x": 0.0, "y": -2.0, "theta": -math.pi / 2, "speed": 1.5, "vx": 0.0, "vy": -1.5, "w": -0.3}, abs=1e-12)


def test_backward_is_negative_speed() -> None:
    source = local(("speed",))
    source.take(ATTITUDE, (1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert source.take(LOCAL_POSITION_NED, (1000, 0.0, 0.0, 0.0, -0.7, 0.0, 0.0)) == Pose(1_000_000_000, (-0.7,))


def test_heading_is_carried_on_to_the_position() -> None:
    source = local(("theta",))
    source.take(ATTITUDE, (980, 0.0, 0.0, 3.13, 0.0, 0.0, 1.0))
    pose = source.take(LOCAL_POSITION_NED, (1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert pose is not None
    assert pose.x[0] == pytest.approx(2.0 * math.pi - 3.15)


@pytest.mark.parametrize("attitude_ms", [899, 1101])
def test_position_without_a_heading_of_its_time_is_none(attitude_ms: int) -> None:
    source = local()
    assert source.take(LOCAL_POSITION_NED, (1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)) is None
    source.take(ATTITUDE, (attitude_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert source.take(LOCAL_POSITION_NED, (1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)) is None
    assert source.unpaired == 2


def test_attitude_of_the_far_future_locks_no_other_out_and_a_late_one_is_no_news() -> None:
    source = local(("theta",))
    source.take(ATTITUDE, (4_000_000_000, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0))
    source.take(ATTITUDE, (1000, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0))
    source.take(ATTITUDE, (980, 0.0, 0.0, 0.4, 0.0, 0.0, 0.0))
    assert source.take(LOCAL_POSITION_NED, (1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)) == Pose(1_000_000_000, (-0.5,))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("place", range(1, 7))
def test_number_that_is_none_is_a_fault_without_numbers(bad: float, place: int) -> None:
    for spoilt in (ATTITUDE, LOCAL_POSITION_NED):
        source = local()
        messages = {ATTITUDE: [1000, 0.0, 0.0, 0.5, 0.0, 0.0, 0.1], LOCAL_POSITION_NED: [1000, 1.0, 2.0, 0.0, 0.1, 0.2, 0.0]}
        messages[spoilt][place] = bad
        source.take(ATTITUDE, tuple(messages[ATTITUDE]))
        pose = source.take(LOCAL_POSITION_NED, tuple(messages[LOCAL_POSITION_NED]))
        assert pose is not None
        assert all(map(math.isfinite, pose.x))
        read = place in ((3, 6) if spoilt == ATTITUDE else (1, 2, 4, 5))
        assert (pose.x == ()) == bool(pose.fault) == read


def test_odometry_in_every_frame_that_senders_use() -> None:
    """North-east-down, forward-right-down and forward-left-up; velocities in the body's frame or in the local one."""
    expected = {"x": 3.0, "y": -4.0, "theta": -0.5, "speed": 1.0, "vx": math.cos(0.5), "vy": -math.sin(0.5), "w": -0.2}
    for frame, child, velocity in ((1, 12, (1.0, 0.0)), (20, 8, (1.0, 0.0)), (1, 1, (math.cos(0.5), math.sin(0.5)))):
        pose = local(source="odometry").take(ODOMETRY, odometry(0.5, velocity, 0.2, frame, child))
        assert pose is not None
        assert (pose.stamp_ns, pose.fault) == (1_500_000_000, "")
        assert dict(zip(QUANTITIES, pose.x, strict=True)) == pytest.approx(expected)
    left_up = list(odometry(-0.5, (1.0, 0.0), -0.2, 21, 12))
    left_up[2] = -4.0
    pose = local(source="odometry").take(ODOMETRY, tuple(left_up))
    assert pose is not None
    assert dict(zip(QUANTITIES, pose.x, strict=True)) == pytest.approx(expected)


def test_odometry_in_an_unknown_frame_or_without_an_attitude_is_a_fault() -> None:
    pose = local(source="odometry").take(ODOMETRY, odometry(0.5, (1.0, 0.0), 0.2, frame=0))
    assert pose is not None
    assert "frame 0" in pose.fault
    for q in ((0.0,) * 4, (math.nan,) * 4, (math.inf, 0.0, 0.0, math.inf)):
        fields = list(odometry(0.5, (1.0, 0.0), 0.2))
        fields[4:8] = q
        pose = local(source="odometry").take(ODOMETRY, tuple(fields))
        assert pose is not None
        assert pose.fault


def test_estimator_that_was_reset_is_a_fault_once() -> None:
    source = local(source="odometry")
    faults = []
    for resets in (0, 0, 1, 1):
        pose = source.take(ODOMETRY, odometry(0.0, (0.0, 0.0), 0.0, resets=resets))
        assert pose is not None
        faults.append(pose.fault)
    assert faults == ["", "", "the position estimate was reset", ""]


def test_vision_tells_the_pose_only() -> None:
    fields = (2_000_000, 1.0, 2.0, 0.0, 0.0, 0.0, 0.25, *NAN_21, 0)
    assert local(("x", "y", "theta"), "vision").take(VISION_POSITION_ESTIMATE, fields) == Pose(2_000_000_000, (1.0, -2.0, -0.25))


def test_gps_is_metres_from_the_origin() -> None:
    """A minute of latitude is a nautical mile, 1852 m, to the ellipsoid's half per cent; of longitude times the cosine."""
    source = local(("x", "y"), "gps", (48.0, 11.0))
    source.take(ATTITUDE, (1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    pose = source.take(GLOBAL_POSITION_INT, (1000, 480_166_667, 110_166_667, 0, 0, 0, 0, 0, 0))
    assert pose is not None
    assert pose.x[0] == pytest.approx(1852.0, rel=0.006)
    assert pose.x[1] == pytest.approx(-1852.0 * math.cos(math.radians(48.0)), rel=0.006)
    # the ellipsoid's own figures at 48 degrees: 111.1996 km and 74.6280 km a degree
    assert pose.x[0] == pytest.approx(111_199.6 / 60.0, rel=1e-4)
    assert -pose.x[1] == pytest.approx(74_628.0 / 60.0, rel=1e-4)
