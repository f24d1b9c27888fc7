"""CDR: what another implementation wrote is read exactly, in both byte orders, and what is not exactly a message is refused.

golden.json was written by rosbags 0.11.9 (its own CDR and its own message definitions, of ROS 2 Jazzy).
"""

from __future__ import annotations

import json
import math
import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from s2r_ros2 import payloads
from s2r_ros2.cdr import PAYLOAD_MAX, Malformed, Reader, Writer
from s2r_ros2.interfaces import BOOL, ODOMETRY, POSE_STAMPED, TF, TWIST, TWIST_STAMPED
from s2r_ros2.payloads import Located

GOLDEN: dict[str, dict[str, str]] = json.loads((Path(__file__).parent / "golden.json").read_text())
WHERE = ((1.25, -2.5, 0.125), (0.0, 0.0, 0.6, 0.8))
MOTION = (0.25, 0.0, 0.0, 0.0, 0.0, -0.5)
SAID: dict[str, Any] = {
    ODOMETRY: Located(1_700_000_000_123_456_789, "odom", "base_footprint", *WHERE, MOTION),
    POSE_STAMPED: Located(7_000_000_005, "map", "", *WHERE),
    TF: [Located(9_000_000_008, "map", "odom", *WHERE), Located(9_000_000_008, "odom", "base_footprint", *WHERE)],
    TWIST: MOTION,
    TWIST_STAMPED: MOTION,
    BOOL: True,
}
DECODE: dict[str, Callable[[bytes], Any]] = {
    ODOMETRY: payloads.decode_odometry,
    POSE_STAMPED: payloads.decode_pose_stamped,
    TF: payloads.decode_transforms,
    TWIST: payloads.decode_twist,
    TWIST_STAMPED: payloads.decode_twist_stamped,
    BOOL: payloads.decode_bool,
}
KINDS = sorted(DECODE)


def golden(kind: str, order: str = "le") -> bytes:
    return bytes.fromhex(GOLDEN[kind][order])


@pytest.mark.parametrize("order", ["le", "be"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_another_implementation_wrote_is_read_exactly(kind: str, order: str) -> None:
    assert DECODE[kind](golden(kind, order)) == SAID[kind]


@pytest.mark.parametrize("big", [False, True])
def test_what_is_written_is_what_another_implementation_writes(big: bool) -> None:
    order = "be" if big else "le"
    assert payloads.encode_pose_stamped(SAID[POSE_STAMPED], big=big) == golden(POSE_STAMPED, order)
    assert payloads.encode_transforms(SAID[TF], big=big) == golden(TF, order)
    assert payloads.encode_twist(MOTION, big=big) == golden(TWIST, order)
    assert payloads.encode_twist_stamped(7_000_000_005, "base_link", MOTION, big=big) == golden(TWIST_STAMPED, order)
    assert payloads.encode_bool(True, big=big) == golden(BOOL, order)
    # the golden one has covariances
    ours, theirs = payloads.encode_odometry(SAID[ODOMETRY], big=big), golden(ODOMETRY, order)
    assert len(ours) == len(theirs)
    assert payloads.decode_odometry(ours) == payloads.decode_odometry(theirs)


@pytest.mark.parametrize("length", range(12))
def test_numbers_are_aligned_to_the_body_whatever_the_length_of_a_text(length: int) -> None:
    at = SAID[ODOMETRY]._replace(frame="f" * length, child="c" * (3 * length % 7))
    data = payloads.encode_odometry(at)
    assert payloads.decode_odometry(data) == at
    body = data[4:]
    assert len(body) % 8 == 0, "float64 stand at multiples of eight from the body's start"
    assert struct.unpack_from("<d", body, len(body) - 85 * 8) == (1.25,)


@pytest.mark.parametrize("kind", KINDS)
def test_every_truncation_is_refused(kind: str) -> None:
    data = golden(kind)
    for length in range(len(data)):
        with pytest.raises(Malformed):
            DECODE[kind](data[:length])


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_left_over_is_refused_but_for_padding(kind: str) -> None:
    data = golden(kind)
    for extra in range(1, 20):
        padded = data + bytes(extra)
        if len(padded) % 4 == 0 and extra < 4:
            assert DECODE[kind](padded) == SAID[kind]
        else:
            with pytest.raises(Malformed, match="left over"):
                DECODE[kind](padded)


@pytest.mark.parametrize("head", ["0002", "0003", "0006", "0007", "0009", "000b", "0100", "ffff"])
def test_other_encapsulations_are_refused_by_name(head: str) -> None:
    with pytest.raises(Malformed, match=f"encapsulation {head}"):
        payloads.decode_twist(bytes.fromhex(head) + golden(TWIST)[2:])


@pytest.mark.parametrize("length", [2**31, 2**32 - 1, 257, 100])
def test_huge_lengths_are_refused_before_anything_is_taken(length: int) -> None:
    with pytest.raises(Malformed, match="string of"):
        payloads.decode_odometry(b"\0\1\0\0" + bytes(8) + struct.pack("<I", length) + b"odom\0")
    with pytest.raises(Malformed, match="transforms in"):
        payloads.decode_transforms(b"\0\1\0\0" + struct.pack("<I", length))
    with pytest.raises(Malformed, match="must be at most"):
        Reader(bytes(PAYLOAD_MAX + 1))


@pytest.mark.parametrize(
    ("text", "why"),
    [(b"odom", "only zero"), (b"od\0m\0", "only zero"), (b"\xff\xfe\0", "UTF-8"), (b"f" * 300 + b"\0", "at most 256")],
)
def test_strings_that_are_none_are_refused(text: bytes, why: str) -> None:
    with pytest.raises(Malformed, match=why):
        Reader(b"\0\1\0\0" + struct.pack("<I", len(text)) + text).text()


def test_empty_string_is_one_zero_or_nothing_at_all() -> None:
    assert Reader(b"\0\1\0\0" + struct.pack("<I", 1) + b"\0").text() == ""
    assert Reader(b"\0\1\0\0" + struct.pack("<I", 0)).text() == ""


@pytest.mark.parametrize(("sec", "nanosec"), [(-1, 0), (0, 1_000_000_000), (5, 2**32 - 1)])
def test_stamps_that_are_none_are_refused(sec: int, nanosec: int) -> None:
    data = Writer().numbers("iI", 4, sec, nanosec).text("map").doubles(*(0.0,) * 7).done()
    with pytest.raises(Malformed, match="a stamp of"):
        payloads.decode_pose_stamped(data)


def test_bool_is_zero_or_one() -> None:
    assert payloads.decode_bool(b"\0\1\0\0\0") is False
    assert payloads.decode_bool(b"\0\1\0\3\1\0\0\0") is True, "as CycloneDDS pads it"
    with pytest.raises(Malformed, match="bool is 2"):
        payloads.decode_bool(b"\0\1\0\0\2")


@pytest.mark.parametrize("kind", KINDS)
def test_flipped_bytes_give_a_message_or_a_refusal_and_nothing_else(kind: str) -> None:
    draw = random.Random(5)
    refused = 0
    for _ in range(1500):
        data = bytearray(golden(kind, draw.choice(("le", "be"))))
        for _ in range(draw.randint(1, 4)):
            data[draw.randrange(len(data))] = draw.randrange(256)
        try:
            DECODE[kind](bytes(data))
        except Malformed:
            refused += 1
    assert refused > 10


def test_numbers_that_are_not_finite_come_through_for_those_who_use_them_to_judge() -> None:
    assert math.isnan(payloads.decode_twist(payloads.encode_twist((math.nan,) * 6))[0])
