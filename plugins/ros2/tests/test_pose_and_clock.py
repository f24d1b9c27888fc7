"""A pose on the plane out of one in space, and a clock that only rises out of stamps that may not."""

from __future__ import annotations

import math
import random

import pytest
from s2r_ros2.cdr import Malformed
from s2r_ros2.clock import RobotClock
from s2r_ros2.payloads import Located
from s2r_ros2.pose import QUANTITIES, Planar

SECOND = 1_000_000_000
ALL = Planar(QUANTITIES, 0.2)


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, ...]:
    """x, y, z, w of rotations about the fixed axes x, y, z, in that order."""
    cr, sr, cp, sp, cy, sy = (f(0.5 * a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy


def at(orientation: tuple[float, ...], position: tuple[float, ...] = (1.0, 2.0, 0.0), twist: tuple[float, ...] = (0.0,) * 6) -> Located:
    return Located(SECOND, "odom", "base", position, orientation, twist)


# ---------------------------------------------------------------- pose


def test_heading_is_the_yaw_and_either_sign_of_a_quaternion_is_the_same() -> None:
    draw = random.Random(1)
    for _ in range(500):
        yaw = draw.uniform(-math.pi, math.pi)
        q = quaternion(draw.uniform(-0.1, 0.1), draw.uniform(-0.1, 0.1), yaw)
        for signed in (q, tuple(-value for value in q)):
            theta = ALL.states(at(signed))[2]
            assert math.remainder(theta - yaw, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-12)


def test_speeds_are_the_twist_in_the_frame_they_are_named_for() -> None:
    yaw = 0.7
    x, y, theta, speed, vx, vy, w = ALL.states(at(quaternion(0.0, 0.0, yaw), twist=(0.5, 0.1, 9.0, 9.0, 9.0, -0.3)))
    assert (x, y, theta, speed, w) == pytest.approx((1.0, 2.0, yaw, 0.5, -0.3))
    assert (vx, vy) == pytest.approx((0.5 * math.cos(yaw) - 0.1 * math.sin(yaw), 0.5 * math.sin(yaw) + 0.1 * math.cos(yaw)))


@pytest.mark.parametrize("tilt", [(0.25, 0.0), (0.0, -0.25), (0.18, 0.18), (math.pi, 0.0)])
def test_robot_that_is_tilted_beyond_the_limit_is_a_fault(tilt: tuple[float, float]) -> None:
    with pytest.raises(Malformed, match="tilted by"):
        ALL.states(at(quaternion(*tilt, 0.4)))


def test_robot_that_is_tilted_within_the_limit_is_taken() -> None:
    x, y, theta, *_ = ALL.states(at(quaternion(0.19, 0.0, 0.4)))
    assert (x, y) == (1.0, 2.0)
    assert theta == pytest.approx(0.4, abs=0.19**2), "tilted by less than the limit, the yaw stays what it is to second order"


@pytest.mark.parametrize("length", [0.0, 0.5, 0.98, 1.02, 100.0])
def test_quaternion_of_another_length_is_a_fault(length: float) -> None:
    with pytest.raises(Malformed, match="orientation has length"):
        ALL.states(at(tuple(length * value for value in quaternion(0.0, 0.0, 1.0))))
    ALL.states(at(tuple(1.005 * value for value in quaternion(0.0, 0.0, 1.0))))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e8])
def test_numbers_that_are_used_must_be_sane(value: float) -> None:
    q = quaternion(0.0, 0.0, 0.3)
    for i in range(3):
        with pytest.raises(Malformed, match="position"):
            ALL.states(at(q, tuple(value if i == j else 0.0 for j in range(3))))
    for i in range(4):
        with pytest.raises(Malformed, match="orientation"):
            ALL.states(at(tuple(value if i == j else v for j, v in enumerate(q))))
    for i in (0, 1, 5):
        with pytest.raises(Malformed, match="twist"):
            ALL.states(at(q, twist=tuple(value if i == j else 0.0 for j in range(6))))
    assert ALL.states(at(q, twist=(0.1, 0.0, value, value, value, 0.0)))[3] == 0.1, "what a robot on the plane doesn't do is not asked"
    assert Planar(("x", "y", "theta"), 0.2).states(at(q, twist=(value,) * 6))[:2] == (1.0, 2.0)


# ---------------------------------------------------------------- clock


def test_only_rising_stamps_are_taken() -> None:
    clock = RobotClock(SECOND)
    taken = [clock.take(s, 10 * SECOND + i) for i, s in enumerate((5, 3, 5, 9, 8, 10))]
    assert taken == ["taken", "old", "old", "taken", "old", "taken"]
    assert clock.old == 3


def test_stamp_from_the_far_future_does_not_lock_the_robot_out() -> None:
    clock = RobotClock(SECOND)
    for k in range(10):
        assert clock.take(k * SECOND // 20, k * SECOND // 20) == "taken"
    assert clock.take(3600 * SECOND, SECOND // 2) == "ahead"
    assert clock.take(SECOND // 2, SECOND // 2 + 1) == "taken"


def test_clock_that_was_set_back_goes_on_above_its_old_stamps_after_the_silence() -> None:
    clock = RobotClock(SECOND)
    clock.take(100 * SECOND, 0)
    assert clock.take(40 * SECOND, SECOND // 2) == "old"
    assert clock.take(41 * SECOND, SECOND) == "restarted"
    assert clock.stamp() == 101 * SECOND
    assert clock.take(41 * SECOND + 7, SECOND + 7) == "taken"
    assert clock.stamp() == 101 * SECOND + 7


@pytest.mark.parametrize("pace", [1.0, 1.0001, 0.6, 3.0])
def test_late_messages_are_told_from_fresh_ones_at_any_pace(pace: float) -> None:
    """pace: the robot's seconds in one of the host's; a simulator's is not 1."""
    draw = random.Random(3)
    clock = RobotClock(SECOND)
    origin = 1_700_000_000 * SECOND
    worst = 0.0
    for k in range(400):
        true = k * SECOND // 20
        s = origin + round(pace * true)
        a = true + 3_000_000 + round(draw.expovariate(1.0) * 2_000_000)
        assert clock.take(s, a) == "taken"
        if k > 100:
            worst = max(worst, clock.age_ns(s, a))
    assert worst < 60e6, "fresh ones are fresh"
    true = 400 * SECOND // 20
    s, a = origin + round(pace * true), true + 500_000_000
    assert clock.take(s, a) == "taken"
    assert clock.age_ns(s, a) == pytest.approx(497e6, abs=60e6)


def test_ages_are_not_judged_before_there_is_something_to_compare_with() -> None:
    clock = RobotClock(SECOND)
    clock.take(0, 0)
    clock.take(1, 900_000_000)
    assert clock.age_ns(1, 900_000_000) == 0.0


def test_burst_after_a_stall_is_told_from_fresh_poses_and_a_pause_is_believed_after_ten_seconds() -> None:
    clock = RobotClock(SECOND // 2)
    for k in range(200):
        clock.take(k * SECOND // 20, k * SECOND // 20 + 2_000_000)
    now = 10 * SECOND + 800_000_000  # nothing came for 0.8 s, then all at once
    ages = []
    for k in range(200, 216):
        assert clock.take(k * SECOND // 20, now + k) == "taken"
        ages.append(clock.age_ns(k * SECOND // 20, now + k))
    assert ages[0] == pytest.approx(800e6, abs=5e6)
    assert ages[-1] == pytest.approx(50e6, abs=5e6)
    paused = 5 * SECOND
    late = []
    for k in range(216, 600):
        a = k * SECOND // 20 + paused + 2_000_000
        assert clock.take(k * SECOND // 20, a) == "taken"
        late.append(clock.age_ns(k * SECOND // 20, a) > 300e6)
    assert late[0]
    assert 8.0 < sum(late) / 20 < 12.0
    assert not any(late[-100:])
