"""Rolling counters and the robot's clock: what is lost, repeated, old, jumped and begun anew is told apart."""

from __future__ import annotations

import random

import pytest
from s2r_can.sequence import ACCEPTED, RobotClock, Sequence

MS = 1_000_000


def counter(modulus: int = 16, **more: int) -> Sequence:
    return Sequence(modulus, **{"cycle_ns": 20 * MS, "silence_ns": 500 * MS, **more})


def test_losses_are_counted_and_the_counter_may_wrap() -> None:
    s, draw, truth, lost, t = counter(256), random.Random(1), 0, 0, 0
    assert s.judge(0, 0) == ("first", 0)
    for _ in range(5000):
        step = 1 if draw.random() < 0.9 else draw.randint(1, 8)
        truth, t, lost = truth + step, t + step * 20 * MS, lost + step - 1
        kind, missed = s.judge(truth % 256, t)
        assert kind == "next"
        lost -= missed
    assert lost == 0


def test_repeated_and_old_frames_are_not_taken_twice() -> None:
    s = counter()
    for k in range(6):
        s.judge(k, k * 20 * MS)
    assert s.judge(5, 101 * MS)[0] == "repeated"
    assert s.judge(4, 102 * MS)[0] == "old"
    assert s.judge(3, 103 * MS)[0] == "old"
    assert s.judge(6, 120 * MS) == ("next", 0)


@pytest.mark.parametrize("ahead", [5, 6, 7, 8, 9, 10])
def test_frame_far_ahead_of_its_time_is_not_believed(ahead: int) -> None:
    s = counter()
    for k in range(6):
        s.judge(k, k * 20 * MS)
    assert s.judge((5 + ahead) % 16, 101 * MS)[0] == "jumped"
    assert s.judge(6, 120 * MS) == ("next", 0)


def test_robot_that_counts_anew_is_believed_at_the_third_frame() -> None:
    s = counter(256)
    for k in range(100, 110):
        s.judge(k, k * 20 * MS)
    kinds = [s.judge(k, (110 + k) * 20 * MS)[0] for k in range(5)]
    assert kinds == ["jumped", "jumped", "restarted", "next", "next"]


@pytest.mark.parametrize("behind", [2, 9, 40, 100, 128, 200, 250])
def test_replay_beside_a_living_sender_stays_out_for_as_long_as_it_lives(behind: int) -> None:
    """Whatever was recorded earlier and is played back in time with the living: none of it is accepted, and all that lives is."""
    s = counter(256)
    replayed, living = [], []
    for k in range(1000):
        living.append(s.judge(k % 256, k * 20 * MS)[0])
        if k >= 300:
            replayed.append(s.judge((k - behind) % 256, k * 20 * MS + 10 * MS)[0])
    assert set(living) == {"first", "next"}
    assert not set(replayed) & ACCEPTED


def test_after_a_silence_any_number_goes_on_and_the_loss_follows_from_the_cycle() -> None:
    s = counter(16)
    s.judge(3, 0)
    assert s.judge(7, 1_000 * MS) == ("next", 35), "within 50 cycles the most that fits the counter is 3 + 2 * 16"
    paused = counter(16)
    paused.judge(3, 0)
    assert paused.judge(4, 900 * MS) == paused.judge(5, 920 * MS) == ("next", 0), "or the sender paused"
    s.judge(8, 1_020 * MS)
    assert s.judge(8, 3_000 * MS)[0] == "resumed"
    assert s.judge(9, 3_020 * MS) == ("next", 0)


def test_counter_with_values_that_are_not_used_begins_anew_before_them() -> None:
    s = counter(15)
    for k in range(40):
        assert s.judge(k % 15, k * 20 * MS)[0] in ("first", "next")
    assert s.judge(15, 800 * MS) == ("jumped", 0), "15 says that the sender knows no better"


def test_clock_goes_on_through_its_wrap_and_begins_anew_only_when_it_is_believed() -> None:
    c = RobotClock(16, 1000.0)
    stamps = [c.judge(k * 100 % 65536, silent=False) for k in range(2000)]
    assert all(kind == "next" for kind, _ in stamps)
    assert [ns for _, ns in stamps] == [k * 100_000 for k in range(2000)]
    last = stamps[-1][1]
    assert c.judge(1999 * 100 % 65536, silent=False)[0] == "repeated"
    back = (1999 * 100 - 30_000) % 65536
    assert [c.judge((back + k) % 65536, silent=False)[0] for k in range(3)] == ["old", "old", "restarted"]
    kind, ns = c.judge((back + 3) % 65536, silent=False)
    assert kind == "next"
    assert ns > last + 10**9 - 10**6
    assert c.judge((back - 20_000) % 65536, silent=True)[0] == "restarted", "after a silence at once"
