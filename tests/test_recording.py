"""The log keeps what it took, whatever happens to the process, the disk or the bytes.

Run as a script this file is a process that records, for the tests that kill it: `python test_recording.py MODE PATH [HZ]`.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import itertools
import os
import random
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from mcap.reader import NonSeekingReader, make_reader

from s2r_runtime.errors import RecordingError
from s2r_runtime.messages import Ask, Command, Decided, Frame, Measured, Observation, Observed, Proposed, Send, Struct, Ticked
from s2r_runtime.recording.channels import CHANNELS, Unrecorded, schema
from s2r_runtime.recording.reading import Entry
from s2r_runtime.recording.recorder import Recorder
from s2r_runtime.recording.writer import Writer, read

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))


def messages(n: int, seed: int = 1) -> list[Struct]:
    rng = random.Random(seed)
    made: list[Struct] = []
    for i in range(n):
        t = i * 1_000_000
        x = (rng.gauss(0, 1), rng.gauss(0, 1), rng.uniform(-3, 3))
        made.append(
            (
                Frame(t, "robot/observation", rng.randbytes(40)),
                Observed(t, Observation(i, t, x)),
                Ask(t, "controller", i),
                Proposed(t, Command(i, t, "controller", x[:2], i, 100_000_000)),
                Decided(t, "controller", i, i, True, "allowed", 0.1),
                Send(t, i, "controller", x[:2], i, 100_000_000),
                Frame(t, "robot/command", rng.randbytes(24), inbound=False),
            )[i % 7]
        )
    return made


def record(path: Path, what: list[Struct], every: int = 40, signer: Ed25519PrivateKey | None = KEY, run: str = "test") -> str:
    """A closed log with a chunk every so many messages and an attachment in the middle."""
    writer = Writer(path, run=run, signer=signer, attachments=[("profile.toml", "application/toml", b"name = 1\n")], timed=False)
    for i, message in enumerate(what):
        writer.write(message, i * 1_000_000)
        if i % every == every - 1:
            writer.flush()
        if i == len(what) // 2:
            writer.attach("model.toml", "application/toml", b"[model]\n")
    return writer.close()


def test_everything_written_is_read_back_in_order_and_to_the_bit(tmp_path: Path) -> None:
    what = messages(500)
    head = record(tmp_path / "a.mcap", what)
    reading = read(tmp_path / "a.mcap")
    entries = list(reading)
    assert [entry.message for entry in entries] == what
    assert [entry.raw for entry in entries] == [msgspec.json.encode(message) for message in what]
    assert [entry.log_time_ns for entry in entries] == [i * 1_000_000 for i in range(500)]
    assert reading.ending.kind == "closed"
    assert reading.head.hex() == head
    assert [(a.name, a.data) for a in reading.attachments] == [("profile.toml", b"name = 1\n"), ("model.toml", b"[model]\n")]
    assert reading.metadata["s2r"]["version.msgspec"]


def test_readers_of_the_mcap_package_open_it_and_find_no_fault(tmp_path: Path) -> None:
    what = messages(500)
    record(tmp_path / "a.mcap", what)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        seals = summary.statistics.chunk_count
        assert summary.statistics.message_count == 500 + seals
        found = [(channel.topic, message.data) for _, channel, message in reader.iter_messages()]
        assert [name for name, _ in found].count("log/chain") == seals
        assert len(list(reader.iter_messages(topics=["event/observed"]))) == sum(isinstance(m, Observed) for m in what)
        assert [a.name for a in reader.iter_attachments()] == ["profile.toml", "model.toml"]
        assert next(iter(reader.iter_metadata())).metadata["run"] == "test"
    with (tmp_path / "a.mcap").open("rb") as file:
        streamed = NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        assert [(channel.topic, message.data) for _, channel, message in streamed] == found


def opens_in_foxglove(part: dict[str, object]) -> bool:
    """What its JSON Schema reader asks for: no references or unions, objects with properties, arrays of plain values or objects."""
    kind = part.get("type")
    if kind == "object":
        properties = part.get("properties")
        return isinstance(properties, dict) and all(opens_in_foxglove(one) for one in properties.values())
    if kind == "array":
        items = part.get("items")
        return isinstance(items, dict) and items.get("type") != "array" and "contentEncoding" not in items and opens_in_foxglove(items)
    return kind in {"string", "number", "integer", "boolean"}


@pytest.mark.parametrize("name", CHANNELS)
def test_the_schema_of_every_channel_opens_in_foxglove(name: str) -> None:
    found = schema(CHANNELS[name])
    assert found["type"] == "object"
    assert opens_in_foxglove(found)
    assert "$ref" not in str(found)


def test_log_time_never_goes_back_but_messages_keep_their_own(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.mcap", run="test")
    for t in (5, 9, 3, 10):
        writer.write(Ticked(t), t)
    writer.close()
    assert [(entry.log_time_ns, entry.message) for entry in read(tmp_path / "a.mcap")] == [
        (5, Ticked(5)),
        (9, Ticked(9)),
        (9, Ticked(3)),
        (10, Ticked(10)),
    ]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_a_number_that_is_not_finite_is_refused_when_it_is_written(tmp_path: Path, value: float) -> None:
    writer = Writer(tmp_path / "a.mcap", run="test")
    with pytest.raises(ValueError, match="must be finite"):
        writer.write(Measured(1, 1, value, "", 1.0, 1, 0), 1)
    writer.write(Ticked(2), 2)
    writer.close()
    assert [entry.message for entry in read(tmp_path / "a.mcap")] == [Ticked(2)]


def test_rotation_loses_nothing_and_the_next_part_continues_the_chain(tmp_path: Path) -> None:
    what = messages(3000)
    writer = Writer(tmp_path / "a.mcap", run="test", signer=KEY, rotate_bytes=20_000, timed=False)
    for i, message in enumerate(what):
        writer.write(message, i)
        if i % 50 == 0:
            writer.flush()
    head = writer.close()
    parts = [read(path) for path in writer.parts]
    assert len(parts) > 3
    assert [entry.message for part in parts for entry in part] == what
    assert [part.ending.kind for part in parts] == ["rotated"] * (len(parts) - 1) + ["closed"]
    assert [part.part for part in parts] == list(range(1, len(parts) + 1))
    for before, after in itertools.pairwise(parts):
        assert after.previous_head == before.head
        assert after.first_index == before.ending.index
    assert parts[-1].head.hex() == head


def test_the_anchor_claims_nothing_of_a_part_that_was_not_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other thread turns to the next part just when this one is about to sync what it has."""
    writer = Writer(tmp_path / "a.mcap", run="test", signer=KEY, rotate_bytes=2_000, timed=False)
    writer.deferring = True
    synced: list[int] = []
    for call in ("fsync", "fdatasync"):
        do = getattr(os, call)
        monkeypatch.setattr(os, call, lambda fd, do=do: (do(fd), synced.append(os.fstat(fd).st_ino)))
    complete = writer._file.complete

    def turned_meanwhile() -> None:
        complete()
        if len(writer.parts) == 1:
            for i, message in enumerate(messages(300)):
                writer.write(message, i)
            writer.flush()

    monkeypatch.setattr(writer._file, "complete", turned_meanwhile)
    writer.sync()
    assert len(writer.parts) == 2
    assert writer.anchor.records == 0 or writer.parts[0].stat().st_ino in synced
    writer.sync()
    assert writer.parts[0].stat().st_ino in synced
    assert writer.anchor.records == writer.recorded > 0
    writer.close()


@pytest.mark.parametrize("raw", [b"\xff", b'{"t_ns": "\xff"}', b"[1]", b"{"])
def test_what_is_no_message_is_said_to_be_of_another_version(raw: bytes) -> None:
    with pytest.raises(RecordingError, match="of another version"):
        _ = Entry(3, "event/ticked", 0, raw).message


def test_a_file_that_is_no_log_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"t,x,y\n0,1,2\n")
    with pytest.raises(RecordingError, match=r"a\.mcap: is not a log"):
        read(tmp_path / "a.mcap")
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        read(tmp_path / "b.mcap")


def test_a_log_that_exists_is_never_written_over(tmp_path: Path) -> None:
    Writer(tmp_path / "a.mcap", run="test").close()
    before = (tmp_path / "a.mcap").read_bytes()
    with pytest.raises(RecordingError, match="cannot be created: File exists"):
        Writer(tmp_path / "a.mcap", run="test")
    assert (tmp_path / "a.mcap").read_bytes() == before


@pytest.mark.parametrize("folder", ["/proc", "/nowhere"])
def test_a_folder_that_cannot_be_written_is_named(folder: str) -> None:
    with pytest.raises(RecordingError, match=r"a\.mcap: the log cannot be created"):
        Writer(Path(folder) / "a.mcap", run="test")


@pytest.mark.slow
def test_a_log_cut_anywhere_reads_to_its_last_sealed_message(tmp_path: Path) -> None:
    what = messages(300)
    record(tmp_path / "a.mcap", what)
    data = (tmp_path / "a.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    ends = []
    for length in [*range(0, 2000, 5), *range(2000, len(data), 29), *range(len(data) - 100, len(data))]:
        cut.write_bytes(data[:length])
        reading = read(cut)
        found = [entry.message for entry in reading]
        assert found == what[: len(found)]
        assert reading.ending.kind == "cut", length
        ends.append(len(found))
    assert ends == sorted(ends)
    assert set(range(0, 301, 40)) - {320} <= {*ends, 280}


def outcome(path: Path) -> tuple[str, list[Struct], int]:
    try:
        reading = read(path)
        found = [entry.message for entry in reading]
    except RecordingError as error:
        return str(error), [], 0
    return reading.ending.kind, found, reading.ending.index


@pytest.mark.slow
def test_every_flipped_bit_in_a_closed_log_is_detected(tmp_path: Path) -> None:
    what = messages(24)
    record(tmp_path / "small.mcap", what, every=10)
    data = (tmp_path / "small.mcap").read_bytes()
    path = tmp_path / "flipped.mcap"
    for place in range(0, 8 * len(data), 37):
        flipped = bytearray(data)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        kind, found, _ = outcome(path)
        assert kind not in {"closed", "rotated", "cut"}, place
        assert found == what[: len(found)], place


@pytest.mark.slow
def test_flipped_bits_anywhere_in_a_longer_log_are_detected(tmp_path: Path) -> None:
    what = messages(300)
    record(tmp_path / "a.mcap", what)
    data = (tmp_path / "a.mcap").read_bytes()
    rng = random.Random(3)
    path = tmp_path / "flipped.mcap"
    for _ in range(800):
        flipped = bytearray(data)
        for _ in range(rng.choice((1, 1, 1, 2, 16))):
            place = rng.randrange(8 * len(data))
            flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        kind, found, _ = outcome(path)
        assert kind not in {"closed", "rotated"}
        assert found == what[: len(found)]


@pytest.mark.slow
def test_a_flipped_bit_in_a_cut_log_is_detected_or_changes_nothing_that_is_read(tmp_path: Path) -> None:
    what = messages(300)
    record(tmp_path / "a.mcap", what)
    data = (tmp_path / "a.mcap").read_bytes()
    rng = random.Random(4)
    path = tmp_path / "flipped.mcap"
    undetected = 0
    for _ in range(800):
        length = rng.randrange(3000, len(data) - 4000)
        path.write_bytes(data[:length])
        _, all_there, _ = outcome(path)
        flipped = bytearray(data[:length])
        place = rng.randrange(8 * length)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        kind, found, _ = outcome(path)
        assert found == what[: len(found)]
        if kind == "cut":
            undetected += found == all_there
            assert found == all_there or len(all_there) - len(found) <= 40, place
    assert undetected < 160, "only bits of the lost tail, and of what compresses to the same, may go unseen"


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Where the chunks of a log stand, each with its index: (start, end)."""
    found, at = [], 8
    while data[at] != 0x0F:
        length = int.from_bytes(data[at + 1 : at + 9], "little") + 9
        if data[at] == 0x06:
            found.append((at, at + length))
        elif data[at] == 0x07:
            found[-1] = (found[-1][0], at + length)
        at += length
    return found


@pytest.mark.parametrize("what", ["drop", "swap", "repeat", "splice"])
def test_chunks_dropped_reordered_repeated_or_spliced_in_are_named_by_the_first_record(tmp_path: Path, what: str) -> None:
    original = messages(300)
    record(tmp_path / "a.mcap", original)
    record(tmp_path / "b.mcap", messages(300, seed=2), run="other")
    data, other = (tmp_path / "a.mcap").read_bytes(), (tmp_path / "b.mcap").read_bytes()
    places, foreign = chunks(data), chunks(other)
    path = tmp_path / "c.mcap"
    for i in range(len(places) - 1):
        (a, b), (c, d) = places[i], places[i + 1]
        made = {
            "drop": data[:a] + data[b:],
            "swap": data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:],
            "repeat": data[:b] + data[a:b] + data[b:],
            "splice": data[:a] + other[foreign[i][0] : foreign[i][1]] + data[b:],
        }[what]
        path.write_bytes(made)
        kind, found, index = outcome(path)
        good = i + (what == "repeat")
        assert kind == "broken"
        assert found == original[: len(found)]
        assert index == len(found) + good  # messages, and one seal a good chunk


def test_zeros_that_a_power_cut_left_at_the_end_are_a_cut_not_damage(tmp_path: Path) -> None:
    what = messages(300)
    record(tmp_path / "a.mcap", what)
    data = (tmp_path / "a.mcap").read_bytes()
    for start, end in chunks(data)[3:5]:
        for zeros_from in (end, start + 30, (start + end) // 2):
            (tmp_path / "a.mcap").write_bytes(data[:zeros_from] + bytes(4096))
            kind, found, _ = outcome(tmp_path / "a.mcap")
            assert kind == "cut"
            assert found == what[: len(found)]
            assert len(found) >= 120


# ---------------------------------------------------------------- the recorder's thread


def test_the_recorder_keeps_the_order_of_puts_and_blocks_nothing(tmp_path: Path) -> None:
    what = messages(5000)
    recorder = Recorder(Writer(tmp_path / "a.mcap", run="test", signer=KEY, timed=False))
    assert all(recorder.put(message, i) for i, message in enumerate(what))
    assert recorder.durable()
    assert recorder.close().ok
    reading = read(tmp_path / "a.mcap")
    assert [entry.message for entry in reading] == what
    assert reading.head.hex() == recorder.head


def test_what_durable_has_promised_is_in_the_file_before_it_returns(tmp_path: Path) -> None:
    recorder = Recorder(Writer(tmp_path / "a.mcap", run="test", signer=KEY, timed=False, chunk_s=60.0))
    for i in range(20):
        recorder.put(Ticked(i), i)
        assert recorder.durable()
        assert [entry.message for entry in read(tmp_path / "a.mcap")][-1] == Ticked(i)
    recorder.close()


def test_while_the_disk_hangs_put_goes_on_and_health_says_so(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.mcap", run="test", timed=False)
    recorder = Recorder(writer)
    with writer._writing:  # as a write that does not come back
        for i in range(1000):
            assert recorder.put(Ticked(i), i)
        assert not recorder.durable(0.05)
        deadline = time.monotonic() + 20
        while recorder.health().ok and time.monotonic() < deadline:
            time.sleep(0.02)
        assert "nothing reached the disk" in recorder.health().detail
    assert recorder.durable()
    assert recorder.health().ok
    assert recorder.close().ok
    assert [entry.message for entry in read(tmp_path / "a.mcap")] == [Ticked(i) for i in range(1000)]


def test_how_much_may_wait_for_the_disk_is_the_profiles_and_a_write_in_time_keeps_the_health_good(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.mcap", run="test", timed=False)
    recorder = Recorder(writer, max_delay_s=60.0)
    with writer._writing:
        recorder.put(Ticked(1), 1)
        time.sleep(0.8)
        assert recorder.health().ok
        assert 0.8 <= recorder.delay_s < 60.0
        assert not recorder.caught_up(0.1, 0.05)
    assert recorder.caught_up(0.5, 20.0)
    assert recorder.close().ok


def test_a_pause_of_the_process_is_no_stall_of_the_disk(tmp_path: Path) -> None:
    """The clock stands for the daemon's, which counts one look for a pause of any length."""
    now_s = 0.0
    writer = Writer(tmp_path / "a.mcap", run="test", timed=False)
    recorder = Recorder(writer, max_delay_s=0.5, clock=lambda: now_s)
    with writer._writing:
        recorder.put(Ticked(1), 1)
        now_s = 0.1
        assert recorder.health().ok
        now_s = 0.6
        assert "nothing reached the disk for 0.6 s (recording.max_delay is 0.5 s)" in recorder.health().detail
    assert recorder.durable()
    assert recorder.health().ok
    assert recorder.close().ok


def test_a_dead_recorder_is_seen_at_once_however_long_the_disk_may_take(tmp_path: Path) -> None:
    recorder = Recorder(Writer(tmp_path / "a.mcap", run="test", timed=False), max_delay_s=1e6)
    ident = recorder._thread.ident
    assert ident is not None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), ctypes.py_object(SystemExit))
    recorder._thread.join(20.0)
    assert "died" in recorder.health().detail
    assert not recorder.put(Ticked(1), 1)


def test_a_full_memory_ends_the_log_counts_what_is_missing_and_never_makes_a_hole(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.mcap", run="test", timed=False)
    recorder = Recorder(writer, limit_bytes=20_000)
    with writer._writing:
        taken = [recorder.put(Ticked(i), i) for i in range(1000)]
    kept = taken.index(False)
    assert not any(taken[kept:])
    assert recorder.durable() is False
    health = recorder.close()
    assert (health.ok, health.unrecorded) == (False, 1000 - kept)
    found = [entry.message for entry in read(tmp_path / "a.mcap")]
    assert found[:-1] == [Ticked(i) for i in range(kept)]
    assert isinstance(found[-1], Unrecorded)
    assert found[-1].count == 1000 - kept


def test_in_lockstep_put_waits_for_the_disk_instead_of_losing(tmp_path: Path) -> None:
    what = messages(20_000)
    recorder = Recorder(Writer(tmp_path / "a.mcap", run="test", timed=False), limit_bytes=20_000, block_s=30.0)
    assert all(recorder.put(message, i) for i, message in enumerate(what))
    assert recorder.close().ok
    assert sum(1 for _ in read(tmp_path / "a.mcap")) == len(what)


def test_a_message_that_cannot_be_written_closes_the_log_and_is_counted(tmp_path: Path) -> None:
    recorder = Recorder(Writer(tmp_path / "a.mcap", run="test", timed=False))
    assert recorder.put(Ticked(1), 1)
    assert not recorder.put(Measured(2, 2, float("nan"), "", 1.0, 1, 0), 2)
    assert not recorder.put(Ticked(3), 3)
    assert "must be finite" in recorder.health().detail
    assert recorder.close().unrecorded == 2


def test_a_killed_thread_is_seen_at_once(tmp_path: Path) -> None:
    recorder = Recorder(Writer(tmp_path / "a.mcap", run="test", timed=False))
    assert recorder.put(Ticked(1), 1)
    assert recorder.durable()
    ident = recorder._thread.ident
    assert ident is not None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), ctypes.py_object(SystemExit))
    recorder._thread.join(20)
    assert "thread" in recorder.health().detail
    assert not recorder.health().ok
    assert recorder.durable(60.0) is False
    assert [entry.message for entry in read(tmp_path / "a.mcap")] == [Ticked(1)]


def test_a_disk_that_was_full_for_a_while_costs_no_message(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, __file__, "full", str(tmp_path / "a.mcap")], capture_output=True, text=True, timeout=60, check=True
    )
    seen, written = done.stdout.split()
    assert seen == "File-too-large"
    found = [entry.message for entry in read(tmp_path / "a.mcap")]
    assert found == messages(int(written))


@pytest.mark.parametrize("call", ["fdatasync", "fsync"])
def test_a_sync_that_failed_once_ends_the_log_as_the_next_one_says_nothing_of_what_was_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    do, failed = getattr(os, call), threading.Event()

    def once(fd: int) -> None:
        if not failed.is_set():
            failed.set()
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        do(fd)

    recorder = Recorder(Writer(tmp_path / "a.mcap", run="test", signer=KEY, timed=False), sync_s=0.01 if call == "fdatasync" else 60.0)
    assert recorder.put(Ticked(1), 1)
    monkeypatch.setattr(os, call, once)
    if call == "fsync":
        assert not recorder.durable(0.5), "it was tried once more, and that succeeded"
    assert failed.wait(60)
    deadline = time.monotonic() + 60
    while recorder.health().ok and time.monotonic() < deadline:
        time.sleep(0.01)
    before = recorder.anchor
    assert not recorder.durable(5)
    assert not recorder.put(Ticked(2), 2)
    assert "a sync of the log failed" in recorder.health().detail
    health = recorder.close()
    assert (health.ok, health.unrecorded) == (False, 1)
    assert recorder.anchor == before, "what is published is what the disk has"


@pytest.mark.parametrize(("zeros", "kind"), [(4096, "broken"), (1 << 30, "cut")], ids=["the first page", "all"])
def test_a_log_whose_beginning_a_power_cut_left_as_zeros_can_be_read_and_holds_nothing(tmp_path: Path, zeros: int, kind: str) -> None:
    path = tmp_path / "a.mcap"
    writer = Writer(path, run="test", signer=KEY, timed=False)
    for i, message in enumerate(messages(600)):
        writer.write(message, i)
        if i % 50 == 0:
            writer.flush()
    writer.close()
    data = path.read_bytes()
    assert len(data) > 3 * 4096
    path.write_bytes(bytes(min(zeros, len(data))) + data[zeros:])
    reading = read(path)
    assert list(reading) == []
    assert (reading.ending.kind, reading.ending.index) == (kind, 0)


def test_what_was_put_settles_by_itself_and_is_on_the_disk_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody asked for a sync, so the thread that writes waits for none; what does not come within the time has not settled."""
    asked: list[int] = []
    writer = Writer(tmp_path / "a.mcap", run="test", signer=KEY, timed=False)
    monkeypatch.setattr(writer, "durable", lambda: asked.append(1))
    recorder = Recorder(writer, sync_s=0.01)
    for i in range(20):
        assert recorder.put(Ticked(i), i)
        assert recorder.settled(60.0)
        assert recorder.anchor.records > i, "a power cut can take no more of it"
    assert asked == []
    recorder.close()
    assert not recorder.settled(1.0)

    idle = Recorder(Writer(tmp_path / "b.mcap", run="test", signer=KEY, timed=False), sync_s=60.0)
    assert idle.put(Ticked(1), 1)
    assert not idle.settled(0.5), "it is written, and no sync came"
    idle.close()


def test_nothing_settles_on_a_disk_that_cannot_sync(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(fd: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    recorder = Recorder(Writer(tmp_path / "a.mcap", run="test", signer=KEY, timed=False), sync_s=0.01)
    monkeypatch.setattr(os, "fdatasync", fails)
    assert recorder.put(Ticked(1), 1)
    assert not recorder.settled(2.0)
    recorder.close()


def test_nothing_is_durable_while_another_sync_may_be_about_to_say_that_it_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system tells one sync of a file that it failed; one that comes just after it succeeds, before the first could say so."""
    told, honest = threading.Event(), os.fdatasync

    def fails(fd: int) -> None:
        honest(fd)
        told.set()
        time.sleep(0.3)  # it knows, but another thread runs first
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    writer = Writer(tmp_path / "a.mcap", run="test", signer=KEY, timed=False)
    recorder = Recorder(writer, sync_s=0.01)
    monkeypatch.setattr(os, "fdatasync", fails)
    assert recorder.put(Ticked(1), 1)
    assert told.wait(60)
    assert recorder.put(Ticked(2), 2)
    assert not recorder.durable(10), "what was said to be on the disk may stand behind a hole"
    assert writer.doubted
    assert recorder.anchor.records == 0
    recorder.close()


def test_nothing_is_durable_while_the_index_of_an_earlier_part_may_have_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same where the sync under way is that of a part that was set aside."""
    writer = Writer(tmp_path / "a.mcap", run="test", signer=KEY, rotate_bytes=1_000, timed=False)
    writer.deferring = True
    for i, message in enumerate(messages(100)):
        writer.write(message, i)
    writer.flush()
    assert writer._file._aside
    told, honest = threading.Event(), os.fsync

    def sync() -> None:
        with contextlib.suppress(OSError):
            writer.sync()

    other = threading.Thread(target=sync)

    def fails(fd: int) -> None:
        honest(fd)
        if threading.current_thread() is other:
            told.set()
            time.sleep(0.3)
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", fails)
    other.start()
    assert told.wait(60)
    with pytest.raises(OSError, match="Input/output error"):
        writer.durable()
    other.join(60)
    assert writer.doubted
    writer.abandon()


# ---------------------------------------------------------------- SIGKILL

LOSS_S = 0.1
"""What a kill may cost."""


@pytest.mark.slow
@pytest.mark.parametrize("hz", [100, 1000])
def test_a_kill_costs_at_most_100_ms_and_nothing_that_was_durable(tmp_path: Path, hz: int) -> None:
    rng = random.Random(hz)
    for trial in range(8):
        path = tmp_path / f"{trial}.mcap"
        with subprocess.Popen([sys.executable, __file__, "beat", str(path), str(hz)], stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "ready\n"
            time.sleep(rng.uniform(0.05, 0.8))
            child.kill()
            lines = [line.split() for line in child.stdout.read().splitlines(keepends=True) if line.endswith("\n")]
        beats = {int(line[1]): float(line[2]) for line in lines if line[0] == "b"}
        durable = [int(line[1]) for line in lines if line[0] == "d"]
        late = max([float(line[1]) for line in lines if line[0] == "late"], default=0.0)
        reading = read(path)
        kept = [entry.message.t_ns for entry in reading if isinstance(entry.message, Ticked)]
        assert reading.ending.kind == "cut"
        assert kept == list(range(len(kept)))
        assert all(k < len(kept) for k in durable)
        lost = [t for k, t in beats.items() if k >= len(kept)]
        assert not lost or max(lost) - min(lost) <= LOSS_S + late


def beat(path: Path, hz: float) -> None:
    """Records and says so, until it is killed. A second thread tells how late this process gets its turn."""
    recorder = Recorder(Writer(path, run="test", signer=KEY, timed=False))

    def lateness() -> None:
        while True:
            begun = time.monotonic()
            time.sleep(0.02)
            os.write(1, f"late {time.monotonic() - begun - 0.02:.6f}\n".encode())

    recorder.durable()
    os.write(1, b"ready\n")
    threading.Thread(target=lateness, daemon=True).start()
    due = time.monotonic()
    k = 0
    while True:
        recorder.put(Ticked(k), k)
        os.write(1, f"b {k} {time.monotonic():.6f}\n".encode())
        if k % 50 == 20 and recorder.durable():
            os.write(1, f"d {k}\n".encode())
        k += 1
        due += 1 / hz
        time.sleep(max(0.0, due - time.monotonic()))


def full(path: Path) -> None:
    """The file may not grow beyond 20 kB; when that was noticed it may."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    recorder = Recorder(Writer(path, run="test", timed=False))
    what = messages(100_000)
    written = 0
    while recorder.health().ok:
        assert recorder.put(what[written], written * 1_000_000)
        written += 1
        time.sleep(0.0005)
    seen = recorder.health().detail.rsplit(": ", 1)[1].replace(" ", "-")
    for _ in range(500):
        assert recorder.put(what[written], written * 1_000_000)
        written += 1
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    assert recorder.durable(20)
    assert recorder.health().ok
    assert recorder.close().ok
    print(seen, written)


if __name__ == "__main__":
    if sys.argv[1] == "beat":
        beat(Path(sys.argv[2]), float(sys.argv[3]))
    else:
        full(Path(sys.argv[2]))
