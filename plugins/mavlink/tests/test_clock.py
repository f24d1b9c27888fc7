"""The robot's clock: what is taken, what is dropped, how old it is. Clocks here are made up, in ns."""

from __future__ import annotations

import itertools
import random

import pytest
from s2r_mavlink.clock import MOMENT_NS, RobotClock

MS, SECOND = 1_000_000, 1_000_000_000
RESTART = SECOND // 2
BOOT = 7 * 60 * SECOND
"""The host's clock when the robot's began."""


def running(seconds: float, pace: float = 1.0, hz: float = 50.0, seed: int = 1, jitter_ms: float = 3.0) -> tuple[RobotClock, int, int]:
    """A clock that has heard a robot for so long, with a random delay of up to `jitter_ms`; and its newest stamp and arrival."""
    clock, draw = RobotClock(RESTART), random.Random(seed)
    s = a = 0
    for k in range(int(seconds * hz)):
        s = int(k * pace * SECOND / hz)
        a = BOOT + int(k * SECOND / hz) + int(draw.uniform(0.0, jitter_ms) * MS)
        assert clock.take(s, a) == "taken"
    return clock, s, a


def test_older_stamps_and_the_same_one_again_are_dropped() -> None:
    clock, s, a = running(3.0)
    for back in (0, 1, 20 * MS, 2 * SECOND):
        assert clock.take(s - back, a + MS) == "old"
    assert clock.old == 4
    assert clock.take(s + 20 * MS, a + 20 * MS) == "taken"


@pytest.mark.parametrize("ahead_s", [2.0, 60.0, 3600.0, 4_294_967.0])
def test_stamp_that_no_clock_can_show_yet_is_dropped_and_locks_nobody_out(ahead_s: float) -> None:
    clock, s, a = running(3.0)
    assert clock.take(s + int(ahead_s * SECOND), a + MS) == "ahead"
    assert clock.take(s + 20 * MS, a + 20 * MS) == "taken"


def test_before_the_pace_is_known_a_forged_stamp_locks_the_robot_out_only_for_the_restart_time() -> None:
    clock, s, a = running(0.5)
    assert clock.take(s + 50 * SECOND, a + MS) == "taken"
    assert clock.take(s + 20 * MS, a + 20 * MS) == "old"
    assert clock.take(s + 600 * MS, a + 600 * MS) == "restarted"


def test_robot_that_starts_anew_goes_on_above_its_old_stamps() -> None:
    clock, s, a = running(5.0)
    before = clock.stamp()
    assert clock.take(1 * SECOND, a + 100 * MS) == "old", "the old robot may still be there"
    assert clock.take(2 * SECOND, a + RESTART) == "restarted"
    assert clock.stamp() >= before + SECOND
    after = clock.stamp()
    assert clock.take(2 * SECOND + 20 * MS, a + RESTART + 20 * MS) == "taken"
    assert clock.stamp() == after + 20 * MS
    assert clock.restarts == 1
    assert s > 2 * SECOND


def test_second_robot_with_an_older_clock_is_never_taken_while_the_first_is_there() -> None:
    clock, s, a = running(3.0)
    for k in range(1, 500):
        assert clock.take(s + k * 20 * MS, a + k * 20 * MS) == "taken"
        assert clock.take(SECOND + k * 20 * MS, a + k * 20 * MS + MS) == "old"


def test_clock_goes_on_after_a_long_silence() -> None:
    clock, s, a = running(3.0)
    assert clock.take(s + 3600 * SECOND, a + 3600 * SECOND) == "taken"


@pytest.mark.parametrize("pace", [0.3, 1.0, 1.0003, 5.0, 20.0])
def test_fresh_observations_are_young_at_any_pace(pace: float) -> None:
    """A simulator's clock may run faster or slower; jitter of 3 ms is no age."""
    clock, s, a = running(10.0, pace=pace)
    draw = random.Random(2)
    for k in range(1, 200):
        stamp, arrival = s + int(k * 20 * MS * pace), a + k * 20 * MS + int(draw.uniform(0.0, 3.0) * MS)
        assert clock.take(stamp, arrival) == "taken"
        assert clock.age_ns(stamp, arrival) < 15 * MS
    assert clock.pace == pytest.approx(pace, rel=0.02)


@pytest.mark.parametrize("pace", [1.0, 5.0])
def test_burst_after_a_stall_is_as_old_as_it_is(pace: float) -> None:
    clock, s, a = running(10.0, pace=pace)
    ages = []
    for k in range(1, 101):  # 2 s of observations that all come at once, after 2 s
        stamp, arrival = s + int(k * 20 * MS * pace), a + 2 * SECOND + k * 10_000
        assert clock.take(stamp, arrival) == "taken"
        ages.append(clock.age_ns(stamp, arrival))
    assert ages[0] == pytest.approx(1.98 * SECOND, abs=0.02 * SECOND)
    assert ages[-1] < 0.02 * SECOND
    assert all(later <= earlier + MS for earlier, later in itertools.pairwise(ages))


def test_queue_that_grows_steadily_is_seen_by_questions_about_the_time() -> None:
    """Each observation is 5 % later than the one before: the line alone takes that for a slow clock."""
    clock = RobotClock(RESTART)
    for k in range(2000):
        s = k * 20 * MS
        delay = int(0.05 * s)
        a = BOOT + s + delay
        clock.take(s, a)
        if k % 25 == 0:
            clock.answered(s, BOOT + s, a)
    assert clock.age_ns(s, a) > 0.4 * delay


def test_simulator_that_was_paused_is_young_again_once_it_told_its_time() -> None:
    clock, s, a = running(10.0)
    a += 3 * SECOND  # the robot's clock stood still, so nothing is late
    clock.take(s + 20 * MS, a + 20 * MS)
    assert clock.age_ns(s + 20 * MS, a + 20 * MS) > 2 * SECOND, "from the arrival alone it can't be told from a stall"
    clock.answered(s + 25 * MS, a + 24 * MS, a + 26 * MS)
    assert clock.take(s + 40 * MS, a + 40 * MS) == "taken"
    assert clock.age_ns(s + 40 * MS, a + 40 * MS) < 20 * MS


def test_offset_is_known_to_half_of_the_round_trip() -> None:
    clock, s, a = running(2.0)
    draw = random.Random(3)
    for k in range(1, 4):
        s, true_host = s + SECOND, BOOT + s + SECOND
        there, back = (int(draw.uniform(0.0, 4.0) * MS) for _ in range(2))
        clock.answered(s, true_host - there, true_host + back)
        assert clock.round_trip_ns <= there + back
        assert k > 0
    assert abs(clock.offset_ns - BOOT) <= 0.5 * clock.round_trip_ns + 1
    assert a > 0


@pytest.mark.parametrize(("asked", "came"), [(BOOT + 5 * SECOND, BOOT + SECOND), (BOOT, BOOT + 60 * SECOND), (0, BOOT + SECOND)])
def test_answer_from_the_future_or_from_long_ago_is_none(asked: int, came: int) -> None:
    clock, _, _ = running(1.0)
    clock.answered(SECOND, asked, came)
    assert clock.round_trip_ns == 0


def test_same_stamps_and_arrivals_give_the_same_ages() -> None:
    """An audit computes them again."""

    def ages() -> list[float]:
        clock, draw, found = RobotClock(RESTART), random.Random(4), []
        a = 0
        for k in range(3000):
            a += int(draw.expovariate(50.0) * SECOND)
            s = k * 20 * MS
            clock.take(s, a)
            found.append(clock.age_ns(s, a))
            if k % 30 == 0:
                clock.answered(s, a - 5 * MS, a)
        return found

    assert ages() == ages()


def test_ages_are_not_judged_before_there_is_something_to_judge_by() -> None:
    clock = RobotClock(RESTART)
    for k in range(10):
        clock.take(k * 20 * MS, BOOT + k * (20 * MS + MOMENT_NS // 20))
        assert clock.age_ns(k * 20 * MS, BOOT + SECOND) == 0.0
