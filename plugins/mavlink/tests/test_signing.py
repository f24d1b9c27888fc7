"""Signatures: the same as pymavlink's, without its holes. Each hole is shown on pymavlink first."""

from __future__ import annotations

import json
import random
import time
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink
from s2r_mavlink.dialect import MESSAGES
from s2r_mavlink.frames import build, header
from s2r_mavlink.signing import LATEST, RESERVE, Signing, read_key, stamp_of

from s2r_runtime.errors import ConfigError

KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))
NOW = 1_795_000_000.0
MINUTE = 60 * 100_000


def peer(key: bytes | None = KEY, at: float = NOW) -> Any:
    """Somebody else's end."""
    mav = mavlink.MAVLink(None, 1, 1)
    mav.robust_parsing = True
    if key is not None:
        mav.signing.secret_key, mav.signing.sign_outgoing = key, True
        mav.signing.timestamp = stamp_of(at)
    return mav


def beat(mav: Any) -> bytes:
    """A frame of theirs."""
    data: bytes = mav.heartbeat_encode(10, 3, 129, 15, 4).pack(mav)
    mav.seq = (mav.seq + 1) % 256
    return data


def verdict(signing: Signing, frame: bytes) -> str:
    return signing.verify(frame, signed=header(frame).signed)


def ours(tmp_path: Path, at: float = NOW, key: bytes = KEY) -> Signing:
    return Signing(key, tmp_path / "floor.json", at)


def until_written(signing: Signing) -> None:
    end = time.monotonic() + 10.0
    while signing._keeper._written != signing._keeper._floor and time.monotonic() < end:
        time.sleep(0.001)


def forged(stamp: int) -> bytes:
    """A frame that anybody can make: stamped as he likes, signed with a key that is not the robot's."""
    mav = peer(OTHER_KEY)
    mav.signing.timestamp = stamp
    return beat(mav)


def test_frame_signed_here_is_the_one_that_pymavlink_signs(tmp_path: Path) -> None:
    signing, mav = ours(tmp_path), peer()
    mav.srcComponent = 191
    for number in range(5):
        mav.seq = number
        mav.signing.timestamp = stamp_of(NOW + 1.0) + number
        content = MESSAGES[0].pack(15, 10, 3, 129, 4, 3)
        assert signing.sign(build(0, content, number, 1, 191, signed=True), NOW + 1.0) == beat(mav)


def test_peer_that_holds_the_key_is_believed_both_ways(tmp_path: Path) -> None:
    signing, mav = ours(tmp_path), peer(at=NOW + 1.0)
    assert [verdict(signing, beat(mav)) for _ in range(3)] == ["", "", ""]
    frame = signing.sign(build(0, MESSAGES[0].pack(0, 18, 8, 0, 3, 3), 1, 1, 191, signed=True), NOW + 1.0)
    assert [m.get_type() for m in mav.parse_buffer(frame)] == ["HEARTBEAT"]


def test_forged_frame_from_the_far_future_locks_nobody_out(tmp_path: Path) -> None:
    far = stamp_of(NOW) + 365 * 24 * 60 * MINUTE
    theirs = peer()
    theirs.parse_buffer(forged(far))
    real = peer(at=NOW + 1.0)
    assert [m.get_type() for m in theirs.parse_buffer(beat(real))] == ["BAD_DATA"], "the hole in the reference is closed: say so here"

    signing, real = ours(tmp_path), peer(at=NOW + 1.0)
    assert verdict(signing, forged(far)) == "bad_signature"
    assert verdict(signing, beat(real)) == ""
    signing.close()
    assert json.loads((tmp_path / "floor.json").read_text())["newest"] < far


def test_fresh_receiver_refuses_what_was_recorded_before_it_began(tmp_path: Path) -> None:
    recorded = beat(peer(at=NOW - 50.0))
    fresh = peer()
    assert [m.get_type() for m in fresh.parse_buffer(recorded)] == ["HEARTBEAT"], "the hole in the reference is closed: say so here"
    assert verdict(ours(tmp_path), recorded) == "old_stamp"


@pytest.mark.parametrize("orderly", [True, False])
def test_restarted_receiver_refuses_what_an_earlier_run_heard(tmp_path: Path, orderly: bool) -> None:
    """Also on a computer whose clock begins in 1970 every time, and after a crash."""
    first, mav = ours(tmp_path, at=0.0), peer(at=NOW)
    recorded = [beat(mav) for _ in range(50)]
    assert all(verdict(first, frame) == "" for frame in recorded)
    if orderly:
        first.close()
    else:
        first._keeper.close()  # a crash: what was written ahead is all that is left
    second = ours(tmp_path, at=0.0)
    assert [verdict(second, frame) for frame in recorded] == ["old_stamp"] * 50


def test_peer_that_lags_behind_follows_and_is_believed(tmp_path: Path) -> None:
    """An autopilot without a clock: it takes over the first stamp that it hears, as the protocol asks."""
    signing, mav = ours(tmp_path), peer(at=NOW - 30.0)
    assert verdict(signing, beat(mav)) == "old_stamp"
    mav.parse_buffer(signing.sign(build(0, MESSAGES[0].pack(0, 18, 8, 0, 3, 3), 1, 1, 191, signed=True), NOW))
    assert verdict(signing, beat(mav)) == ""


def test_receiver_without_a_key_has_no_say_and_one_with_a_key_wants_signatures(tmp_path: Path) -> None:
    unsigned = peer(key=None)
    signed = beat(peer())
    assert [m.get_type() for m in unsigned.parse_buffer(signed)] == ["HEARTBEAT"], "the hole in the reference is closed: say so here"
    assert verdict(ours(tmp_path), beat(unsigned)) == "unsigned"


def test_bad_frame_takes_good_ones_with_it_in_the_strict_reference() -> None:
    """Why this package has a framer of its own (test_frames.py shows that it doesn't)."""
    mav = peer(key=None)
    mav.robust_parsing = False
    good = [beat(mav) for _ in range(3)]
    bad = bytearray(good[1])
    bad[12] ^= 1
    receiver = peer(key=None)
    receiver.robust_parsing = False
    with pytest.raises(mavlink.MAVError):
        receiver.parse_buffer(good[0] + bytes(bad) + good[2])


@pytest.mark.parametrize("change", ["payload", "stamp", "link", "signature", "sender"])
def test_changed_bit_is_refused(tmp_path: Path, change: str) -> None:
    frame = bytearray(beat(peer(at=NOW + 1.0)))
    at = {"payload": 12, "stamp": -12, "link": -13, "signature": -1, "sender": 5}[change]
    frame[at] ^= 1
    assert verdict(ours(tmp_path), bytes(frame)) == "bad_signature"


def test_replayed_repeated_and_reordered_frames_are_refused(tmp_path: Path) -> None:
    signing, mav = ours(tmp_path), peer(at=NOW + 1.0)
    frames = [beat(mav) for _ in range(30)]
    assert verdict(signing, frames[10]) == ""
    for frame in frames[:11]:
        assert verdict(signing, frame) == "old_stamp"
    assert verdict(signing, frames[11]) == ""


def test_streams_have_stamps_of_their_own(tmp_path: Path) -> None:
    signing, first, second = ours(tmp_path), peer(at=NOW + 5.0), peer(at=NOW + 1.0)
    second.signing.link_id = 3
    assert verdict(signing, beat(first)) == ""
    assert verdict(signing, beat(second)) == ""


def test_own_stamps_only_rise_over_clock_steps_and_restarts(tmp_path: Path) -> None:
    stamps: list[int] = []

    def sign(signing: Signing, at: float) -> None:
        frame = signing.sign(build(0, MESSAGES[0].pack(0, 18, 8, 0, 3, 3), 1, 1, 191, signed=True), at)
        stamps.append(int.from_bytes(frame[-12:-6], "little"))

    draw = random.Random(1)
    for run in range(4):
        signing = ours(tmp_path, at=draw.choice((0.0, NOW, NOW - 1e6)))
        for _ in range(20):
            sign(signing, draw.choice((0.0, NOW, NOW + draw.uniform(-100.0, 100.0))))
        if run % 2:
            signing.close()
        else:
            signing._keeper.close()
    assert stamps == sorted(set(stamps))


def test_floor_is_written_ahead_of_need(tmp_path: Path) -> None:
    signing, mav = ours(tmp_path), peer(at=NOW + 1.0)
    for minute in range(20):
        mav.signing.timestamp = stamp_of(NOW) + (minute + 1) * MINUTE // 4
        assert verdict(signing, beat(mav)) == ""
        until_written(signing)
        kept = json.loads((tmp_path / "floor.json").read_text())["newest"]
        assert mav.signing.timestamp <= kept <= mav.signing.timestamp + RESERVE


def test_who_holds_the_key_cannot_drive_the_count_to_its_end(tmp_path: Path) -> None:
    signing, mav = ours(tmp_path), peer()
    mav.signing.timestamp = (1 << 48) - 2
    assert verdict(signing, beat(mav)) == "far_future"
    assert signing.sign(build(0, b"\1", 1, 1, 191, signed=True), NOW)
    assert stamp_of(time.time()) < LATEST


@pytest.mark.parametrize(
    ("text", "mode", "says"),
    [
        ("00" * 31, 0o600, "must hold 64 hexadecimal digits"),
        ("xy" * 32, 0o600, "must hold 64 hexadecimal digits"),
        ("00" * 32, 0o644, "others can read it"),
    ],
)
def test_key_file_that_is_no_good_is_one_line(tmp_path: Path, text: str, mode: int, says: str) -> None:
    path = tmp_path / "key"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(ConfigError, match=says):
        read_key(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_key(tmp_path / "none")


def test_state_file_that_is_no_good_is_one_line(tmp_path: Path) -> None:
    for text in ("", "{}", '{"newest": -1}', '{"newest": "x"}', "[1]"):
        (tmp_path / "floor.json").write_text(text)
        with pytest.raises(ConfigError, match="must hold"):
            ours(tmp_path)
