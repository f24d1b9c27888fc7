"""Framing, byte for byte what pymavlink makes and reads; and what it does with bytes that are no frame."""

from __future__ import annotations

import random
import struct
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx as crc16
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink
from s2r_mavlink import frames
from s2r_mavlink.dialect import CRC_EXTRA, MESSAGES
from s2r_mavlink.frames import (
    DATAGRAM,
    FALSE_STARTS,
    LONGEST,
    Framer,
    build,
    header,
    is_frame,
    newest,
    packed,
    payload,
    renumbered,
)

GOOD = build(0, bytes(9), 1, 1, 1)
OPAQUE = 163
"""AHRS of ArduPilot's own dialect: a message that `common` doesn't have."""


def theirs(number: int, draw: random.Random, mav: Any, *, v1: bool = False) -> tuple[bytes, tuple[Any, ...]]:
    """A frame of that message as pymavlink packs it, with random values; and the values in wire order, flat."""
    kind = mavlink.mavlink_map[number]
    values: dict[str, Any] = {}
    for name, length, type_name in zip(kind.ordered_fieldnames, kind.array_lengths, _types(kind), strict=True):
        one = [_value(type_name, draw) for _ in range(max(1, length))]
        values[name] = bytes(draw.randrange(1, 128) for _ in range(length)) if type_name == "char" and length else one if length else one[0]
    message = kind(**{name: values[name] for name in kind.fieldnames})
    data: bytes = message.pack(mav, force_mavlink1=v1)
    flat: list[Any] = []
    for name in kind.ordered_fieldnames:
        flat += values[name] if isinstance(values[name], list) else [values[name]]
    return data, tuple(flat)


def _types(kind: Any) -> list[str]:
    by_name = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    return [by_name[name] for name in kind.ordered_fieldnames]


def _value(type_name: str, draw: random.Random) -> Any:
    if type_name == "char":
        return bytes([draw.randrange(1, 128)])
    if type_name in ("float", "double"):
        return struct.unpack("f", struct.pack("f", draw.uniform(-100.0, 100.0)))[0]
    bits = int("".join(c for c in type_name.split("_", maxsplit=1)[0] if c.isdigit()))
    return draw.randrange(0, 1 << bits) if type_name.startswith("u") else draw.randrange(-(1 << (bits - 1)), 1 << (bits - 1))


def random_frame(draw: random.Random, mav: Any) -> bytes:
    """Any message of the dialect, of any sender."""
    mav.srcSystem, mav.srcComponent, mav.seq = draw.randrange(1, 256), draw.randrange(1, 256), draw.randrange(256)
    number = draw.choice([n for n in mavlink.mavlink_map if n >= 0])
    data, _ = theirs(number, draw, mav, v1=number < 256 and draw.random() < 0.2)
    return data


# ---------------------------------------------------------------- the tables


def test_every_checksum_seed_of_the_dialect_is_pymavlinks() -> None:
    assert {number: kind.crc_extra for number, kind in mavlink.mavlink_map.items() if number >= 0} == CRC_EXTRA


@pytest.mark.parametrize("number", sorted(MESSAGES))
def test_message_is_laid_out_as_pymavlink_lays_it_out(number: int) -> None:
    kind, ours = mavlink.mavlink_map[number], MESSAGES[number]
    assert ours.name == kind.msgname
    if ours.name != "TIMESYNC":  # this version of the reference doesn't know its extension
        assert struct.calcsize(kind.unpacker.format) == ours.layout.size
    assert list(ours.fields)[: len(kind.ordered_fieldnames)] == kind.ordered_fieldnames


@pytest.mark.parametrize("number", sorted(MESSAGES))
def test_frame_of_pymavlink_says_here_what_was_packed(number: int) -> None:
    draw, mav = random.Random(number), mavlink.MAVLink(None, 7, 11)
    for _ in range(20):
        mav.seq = draw.randrange(256)
        data, values = theirs(number, draw, mav)
        assert is_frame(data)
        facts = header(data)
        assert (facts.number, facts.system, facts.component, facts.sequence, facts.signed, facts.known) == (
            number,
            7,
            11,
            mav.seq,
            False,
            True,
        )
        got = MESSAGES[number].unpack(payload(data))[: len(values)]
        assert got == tuple(v.rstrip(b"\0").ljust(len(g), b"\0") if isinstance(v, bytes) else v for v, g in zip(values, got, strict=True))


@pytest.mark.parametrize("number", sorted(MESSAGES))
def test_frame_built_here_is_the_frame_that_pymavlink_builds(number: int) -> None:
    draw, mav = random.Random(number + 1), mavlink.MAVLink(None, 1, 191)
    for _ in range(20):
        mav.seq = draw.randrange(256)
        data, values = theirs(number, draw, mav)
        missing = (0,) * (len(struct.unpack(MESSAGES[number].layout.format, bytes(MESSAGES[number].layout.size))) - len(values))
        assert build(number, MESSAGES[number].pack(*values, *missing), mav.seq, 1, 191) == data


def test_version_1_says_the_same() -> None:
    draw, mav = random.Random(5), mavlink.MAVLink(None, 3, 4)
    for number in (n for n in MESSAGES if n < 256):
        data, values = theirs(number, draw, mav, v1=True)
        assert is_frame(data)
        facts = header(data)
        assert (facts.number, facts.system, facts.component, facts.signed) == (number, 3, 4, False)
        assert MESSAGES[number].unpack(payload(data))[0] == values[0]


def test_renumbered_frame_differs_in_its_number_and_checksum_only() -> None:
    first = build(0, MESSAGES[0].pack(15, 10, 3, 129, 4, 3), 7, 1, 191)
    second = renumbered(first, 300)
    assert (header(second).sequence, payload(second)) == (300 & 0xFF, payload(first))
    assert is_frame(second)


# ---------------------------------------------------------------- streams


def test_frames_are_found_however_the_stream_is_cut() -> None:
    draw, mav = random.Random(2), mavlink.MAVLink(None)
    for _ in range(30):
        frames = [random_frame(draw, mav) for _ in range(40)]
        stream, framer, got = b"".join(frames), Framer(datagrams=False), []
        at = 0
        while at < len(stream):
            piece = draw.choice((1, 2, 3, 7, 12, 50, 300, 2000))
            got += framer.feed(stream[at : at + piece])
            at += piece
        assert got == frames
        assert framer.malformed == 0


def test_same_frames_as_pymavlink_in_a_stream_with_noise_between_them() -> None:
    """Noise without the two bytes that begin a frame, which is what its robust parser promises to skip."""
    draw, mav = random.Random(3), mavlink.MAVLink(None)
    noise = [b for b in range(256) if b not in (0xFD, 0xFE)]
    for _ in range(20):
        stream = b""
        for _ in range(30):
            stream += bytes(draw.choices(noise, k=draw.randrange(6))) + random_frame(draw, mav)
        reference = mavlink.MAVLink(None)
        reference.robust_parsing = True
        expected = [bytes(m.get_msgbuf()) for m in reference.parse_buffer(stream) if m.get_type() != "BAD_DATA"]
        assert Framer(datagrams=False).feed(stream) == expected


def test_bad_frame_never_takes_a_good_one_with_it() -> None:
    """Where a length is corrupted the reference skips good frames behind it."""
    draw, mav = random.Random(4), mavlink.MAVLink(None)
    for _ in range(300):
        bad = bytearray(random_frame(draw, mav))
        bad[draw.randrange(len(bad))] ^= 1 << draw.randrange(8)
        if is_frame(bytes(bad)):
            continue  # a bit of a message that nobody can check, or of the signature's flag
        good = [random_frame(draw, mav) for _ in range(12)]
        framer = Framer(datagrams=False)
        got = framer.feed(bytes(bad) + b"".join(good) + bytes(LONGEST))
        assert [f for f in got if f in good] == good
        assert framer.malformed >= 1


def test_corrupted_frame_of_a_known_message_is_never_a_frame() -> None:
    """One or two flipped bits: the checksum finds all of them (Hamming distance 4 at these lengths)."""
    draw = random.Random(6)
    frame = build(32, MESSAGES[32].pack(1234, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0), 9, 1, 1)
    for _ in range(5000):
        bad = bytearray(frame)
        # not the number: that of a message that `common` lacks makes it one whose checksum nobody can tell
        for _ in range(draw.randint(1, 2)):
            bad[draw.choice([i for i in range(len(frame)) if i not in (7, 8, 9)])] ^= 1 << draw.randrange(8)
        assert bytes(bad) == frame or not is_frame(bytes(bad))


def test_frame_that_nobody_can_check_counts_only_where_the_next_one_begins() -> None:
    content = bytes(range(1, 20))
    opaque = b"\xfd" + bytes((len(content), 0, 0, 5, 1, 1)) + OPAQUE.to_bytes(3, "little") + content + b"\x12\x34"
    known = build(0, MESSAGES[0].pack(15, 10, 3, 129, 4, 3), 6, 1, 1)
    assert Framer(datagrams=False).feed(opaque + known) == [opaque, known]
    assert not header(opaque).known
    assert Framer(datagrams=False).feed(opaque + b"\x00" + known) == [known]


def test_datagram_that_ends_within_a_frame_takes_nothing_from_the_next() -> None:
    frame = build(0, MESSAGES[0].pack(15, 10, 3, 129, 4, 3), 6, 1, 1)
    framer = Framer(datagrams=True)
    assert framer.feed(frame[:-3]) == []
    assert framer.feed(frame + frame[:5]) == [frame]
    assert framer.malformed == 2


def test_flag_that_nobody_understands_is_no_frame() -> None:
    frame = bytearray(build(0, MESSAGES[0].pack(15, 10, 3, 129, 4, 3), 6, 1, 1))
    frame[2] = 2
    assert Framer(datagrams=False).feed(bytes(frame)) == []


def test_environment_does_not_switch_the_checksum_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """As MAV_IGNORE_CRC does in the reference."""
    monkeypatch.setenv("MAV_IGNORE_CRC", "1")
    frame = bytearray(build(0, MESSAGES[0].pack(15, 10, 3, 129, 4, 3), 6, 1, 1))
    frame[12] ^= 1
    assert Framer(datagrams=True).feed(bytes(frame)) == []


@given(data=st.binary(max_size=600))
@settings(max_examples=300, deadline=None, derandomize=True)
def test_any_bytes_are_cut_into_whole_frames_or_nothing(data: bytes) -> None:
    for datagrams in (True, False):
        framer = Framer(datagrams=datagrams)
        for frame in framer.feed(data):
            assert frame in data
            assert len(frame) <= LONGEST


@pytest.mark.parametrize("datagrams", [True, False])
@pytest.mark.parametrize("noise", [b"\xfe", b"\xfe\x00", b"\xfd\x00\x00"])
def test_noise_of_nothing_but_false_starts_costs_a_bounded_number_of_checksums(
    noise: bytes, datagrams: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = 0

    def counted(data: bytes) -> int:
        nonlocal tried
        tried += 1
        return int(crc16(data))

    monkeypatch.setattr(frames, "crc16", counted)
    framer = Framer(datagrams=datagrams)
    assert not [frame for frame in framer.feed(noise * 40_000) if header(frame).known]
    assert tried <= FALSE_STARTS + 1
    assert framer.malformed <= FALSE_STARTS + 1
    assert framer.feed(GOOD) == [GOOD], "what comes after it is read"


def test_good_frame_between_the_false_starts_of_a_bad_line_is_found() -> None:
    assert Framer(datagrams=False).feed(b"\xfe" * (FALSE_STARTS // 2) + GOOD * 40)[-20:] == [GOOD] * 20


@given(st.lists(st.integers(1, LONGEST), max_size=60), st.integers(0, 3000))
def test_frames_are_packed_whole_and_the_newest_are_taken(sizes: list[int], most: int) -> None:
    made = [bytes([k & 0xFF]) * size for k, size in enumerate(sizes)]
    pieces = packed(made)
    assert b"".join(pieces) == b"".join(made)
    assert all(0 < len(piece) <= DATAGRAM for piece in pieces)
    last = newest(made, most)
    assert last == made[len(made) - len(last) :]
    assert sum(map(len, last)) <= most
    assert len(last) == len(made) or sum(map(len, last)) + len(made[-len(last) - 1]) > most
