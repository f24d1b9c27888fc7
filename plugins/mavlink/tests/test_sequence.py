"""A sender's numbers: losses, late frames, and two senders under one name."""

from __future__ import annotations

import random

import pytest
from s2r_mavlink.sequence import CONFLICTS, PROOF, Sequence

MS = 1_000_000


def heard(*numbers: int, every_ms: int = 5) -> tuple[Sequence, list[str]]:
    track = Sequence()
    return track, [track.place(n & 0xFF, k * every_ms * MS) for k, n in enumerate(numbers)]


def test_numbers_in_a_row_are_next_over_the_wrap() -> None:
    track, places = heard(*range(200, 800))
    assert set(places) == {"next"}
    assert (track.lost, track.off) == (0, 0)


def test_gap_is_counted_as_lost_and_what_comes_late_is_late() -> None:
    track, places = heard(5, 6, 10, 8, 9, 11, 11)
    assert places == ["next", "next", "next", "late", "late", "next", "again"]
    assert (track.lost, track.again) == (3, 1)


def test_every_frame_of_a_lossy_link_is_found_or_counted() -> None:
    draw = random.Random(1)
    track = Sequence()
    kept = [k for k in range(20_000) if draw.random() < 0.9]
    assert {track.place(k & 0xFF, k * MS) for k in kept} <= {"next", "skipped"}
    assert track.lost == kept[-1] - kept[0] + 1 - len(kept)


def test_replayed_frames_of_long_ago_are_off_the_track_and_do_not_disturb_it() -> None:
    track, _ = heard(*range(1000))
    places = []
    for k in range(200):
        places.append(track.place((300 + k) & 0xFF, (5000 + 5 * k) * MS))
        assert track.place((1000 + k) & 0xFF, (5001 + 5 * k) * MS) == "next"
    assert set(places) <= {"off", "again", "late"}


def test_robot_that_counts_anew_is_followed_after_a_few_frames() -> None:
    track, _ = heard(*range(100))
    places = [track.place(200 + k, (500 + 5 * k) * MS) for k in range(10)]
    assert places == ["off"] * (PROOF - 1) + ["next"] * (10 - PROOF + 1)


def test_frame_after_a_larger_gap_is_for_those_with_a_stamp_only() -> None:
    track, places = heard(5, 13, 22, 54, 55)
    assert places == ["next", "next", "skipped", "skipped", "next"]
    assert track.lost == 7 + 8 + 31


def test_robot_that_was_silent_for_long_is_followed_at_once() -> None:
    track, _ = heard(*range(100))
    assert track.place(7, 2000 * MS) == "next"


@pytest.mark.parametrize("apart", [40, 100, 127, 128, 129, 200])
def test_two_senders_in_turns_are_noticed(apart: int) -> None:
    track, _ = heard(*range(10))
    for k in range(CONFLICTS + 2):
        track.place(10 + k, (100 + 10 * k) * MS)
        track.place((10 + k + apart) & 0xFF, (105 + 10 * k) * MS)
    assert track.shared(250 * MS)
    assert not track.shared(20_000 * MS), "forgotten once it is over"


def test_a_few_strange_frames_are_no_second_sender() -> None:
    track, _ = heard(*range(10))
    for k in range(CONFLICTS - 1):
        track.place((k + 150) & 0xFF, (100 + 50 * k) * MS)
        track.place(10 + k, (101 + 50 * k) * MS)
    assert not track.shared(500 * MS)


def test_number_of_a_frame_that_nobody_can_check_moves_the_track_by_little_only() -> None:
    track, _ = heard(*range(10))
    assert track.place(30, 100 * MS, checked=False) == "off"
    assert track.place(150, 100 * MS, checked=False) == "off"
    assert track.place(12, 100 * MS, checked=False) == "next"
    assert track.place(13, 105 * MS) == "next"
    assert not track.shared(110 * MS)
