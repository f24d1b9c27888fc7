"""A log is followed while it grows, whatever it is at that moment: half a record, damaged, rotated, cut, no log at all."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from s2r_runtime.errors import RecordingError
from s2r_runtime.live.feed import Feed, Row, first_part, next_part, overview, rows
from s2r_runtime.messages import Observation, Observed, Ticked
from s2r_runtime.recording.reading import read
from s2r_runtime.recording.writer import Writer


def written(path: Path, n: int = 300, *, close: bool = True, rotate_bytes: int = 0) -> Writer:
    """A log with a chunk every 10 messages, and an attachment in front and one on the way."""
    about = [("profile.toml", "application/toml", b"name = 1\n")]
    writer = Writer(path, run="test", attachments=about, timed=False, rotate_bytes=rotate_bytes)
    for i in range(n):
        message = Ticked(i) if i % 3 else Observed(i, Observation(i, i, (0.1 * i, float(i % 7))))
        writer.write(message, i * 1_000_000)
        if i == n // 2:
            writer.attach("model/second", "application/toml", b"x" * 100)
        if i % 10 == 9:
            writer.flush()
    if close:
        writer.close()
    else:
        writer.flush()
    return writer


def expected(*paths: Path) -> list[Row]:
    """What the reader that checks everything gives."""
    return [Row(entry.log_time_ns, entry.channel, entry.message) for path in paths for entry in read(path)]


def drained(feed: Feed) -> list[Row]:
    found: list[Row] = []
    while feed.more():
        found += feed.poll(4000)
    return found


def without_seals(found: list[Row]) -> list[Row]:
    return [row for row in found if row.channel != "log/chain"]


@pytest.mark.parametrize("seed", range(5))
def test_a_growing_log_gives_each_message_once_and_in_order(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    written(tmp_path / "whole.mcap")
    whole = (tmp_path / "whole.mcap").read_bytes()
    path, at = tmp_path / "growing.mcap", 0
    path.touch()
    feed, found = Feed(path), []
    while at < len(whole):
        at = min(len(whole), at + rng.randrange(1, 2000))
        path.write_bytes(whole[:at])
        found += feed.poll(rng.choice((100, 1000, 1 << 20)))
    found += drained(feed)
    assert without_seals(found) == expected(tmp_path / "whole.mcap")
    assert (feed.ended, feed.skipped, sorted(feed.attached)) == ("closed", 0, ["model/second", "profile.toml"])


def test_a_write_that_failed_and_came_again_is_read_once(tmp_path: Path) -> None:
    written(tmp_path / "whole.mcap")
    whole = (tmp_path / "whole.mcap").read_bytes()
    path = tmp_path / "growing.mcap"
    path.write_bytes(whole[:5000] + b"\xff" * 3000)
    feed = Feed(path)
    found = [row for _ in range(5) for row in feed.poll()]
    path.write_bytes(whole)
    found += drained(feed)
    assert without_seals(found) == expected(tmp_path / "whole.mcap")
    assert feed.skipped == 0


def test_what_is_damaged_for_good_is_skipped_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path)
    feed = Feed(path)
    span = feed.spans()[7]
    data = bytearray(path.read_bytes())
    data[span.offset + 100] ^= 0xFF
    path.write_bytes(data)
    found = without_seals(drained(feed))
    assert (feed.skipped, feed.ended, len(found)) == (1, "closed", 290)


def test_parts_of_a_run_follow_each_other_also_while_they_are_written(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = Writer(path, run="test", timed=False, rotate_bytes=3000)
    feed, found = Feed(path), []
    for i in range(400):
        writer.write(Ticked(i), i)
        if i % 10 == 9:
            writer.flush()
            found += feed.poll()
    writer.close()
    found += drained(feed)
    assert len(writer.parts) > 3
    assert without_seals(found) == expected(*writer.parts)
    assert (feed.ended, feed.skipped, feed.path) == ("closed", 0, writer.parts[-1])
    assert {first_part(part) for part in writer.parts} == {path}
    assert [next_part(part) for part in writer.parts] == [*writer.parts[1:], None]


def test_from_the_end_only_what_is_new_comes_and_attachments_are_there(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = Writer(path, run="test", timed=False, rotate_bytes=3000, attachments=[("profile.toml", "application/toml", b"name = 1\n")])
    for i in range(200):
        writer.write(Ticked(i), i)
        writer.flush()
    feed = Feed(path, {"event/ticked"})
    feed.to_end()
    assert (feed.poll(), feed.path, sorted(feed.attached)) == ([], writer.parts[-1], ["profile.toml"])
    writer.write(Ticked(200), 200)
    writer.flush()
    assert [row.message for row in drained(feed)] == [Ticked(200)]


def test_a_log_that_a_crash_cut_gives_what_is_there_and_does_not_end(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path, close=False)
    path.write_bytes(path.read_bytes()[:-30])
    feed = Feed(path)
    assert without_seals(drained(feed)) == expected(path)
    assert feed.ended == ""
    path.write_bytes(path.read_bytes() + bytes(4096))  # what a power cut leaves
    assert (drained(feed), feed.ended) == ([], "")


def test_a_range_of_time_and_an_overview(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path)
    found = list(rows(path, {"event/ticked"}, 100_000_000, 200_000_000))
    assert found == [row for row in expected(path) if row.channel == "event/ticked" and 100_000_000 <= row.log_ns <= 200_000_000]
    assert [len(some) for some in overview(path, {"event/ticked", "event/observed"}, 5)] == [10] * 5
    assert len(list(overview(path, {"event/ticked"}, 1000))) == len(Feed(path).spans())


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"t,x\n0,1\n", "is no log of s2r"),
        (b"\x89MCAP0\r\n\x01" + (14).to_bytes(8, "little") + bytes(4) + b"\x06\0\0\0foreig", "MCAP file of others"),
    ],
)
def test_what_is_no_log_is_one_clear_line(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match=says) as error:
        Feed(tmp_path / "a.mcap").poll()
    assert "\n" not in str(error.value)
    with pytest.raises(RecordingError, match="cannot be read"):
        Feed(tmp_path / "none.mcap")


def test_noise_never_raises(tmp_path: Path) -> None:
    rng = random.Random(7)
    written(tmp_path / "a.mcap", 60)
    whole = (tmp_path / "a.mcap").read_bytes()
    for k in range(300):
        data = bytearray(whole)
        for _ in range(rng.randrange(1, 6)):
            data[rng.randrange(200, len(data))] = rng.randrange(256)
        path = tmp_path / f"{k % 3}.mcap"
        path.write_bytes(data[: rng.choice((len(data), rng.randrange(300, len(data))))])
        feed = Feed(path)
        assert len(drained(feed)) <= 200
        feed.close()
