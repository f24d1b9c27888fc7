"""What a crash or damage left of a log becomes a file that any MCAP reader opens, with an account of the rest."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from mcap.reader import NonSeekingReader, make_reader

from s2r_runtime.errors import RecordingError, UsageError
from s2r_runtime.messages import Frame, Struct, Ticked
from s2r_runtime.recording.salvage import info, recover
from s2r_runtime.recording.writer import Writer, read

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
PER_CHUNK = 20


def record(path: Path, n: int = 200, first_use: int = 100) -> list[Struct]:
    """Chunks of 20 messages; a second channel is used from message `first_use` on."""
    writer = Writer(path, run="test", signer=KEY, metadata={"robot": "r"}, attachments=[("profile.toml", "text/x", b"abc")], timed=False)
    rng = random.Random(1)
    made: list[Struct] = [Ticked(i) if i < first_use or i % 2 else Frame(i, "c", rng.randbytes(30)) for i in range(n)]
    for i, message in enumerate(made):
        writer.write(message, i)
        if i % PER_CHUNK == PER_CHUNK - 1:
            writer.flush()
    writer.close()
    return made


def as_mcap(path: Path) -> list[tuple[str, bytes]]:
    """Messages but the seals, as the mcap package's indexed reader finds them; the streaming one must agree."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = [(channel.topic, message.data) for _, channel, message in reader.iter_messages()]
        assert summary.statistics.message_count == len(found)
    with path.open("rb") as file:
        streamed = NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        assert [(channel.topic, message.data) for _, channel, message in streamed] == found
    return [(topic, data) for topic, data in found if topic != "log/chain"]


@pytest.mark.slow
def test_a_log_cut_anywhere_is_recovered_to_its_last_sealed_message(tmp_path: Path) -> None:
    made = record(tmp_path / "a.mcap")
    data = (tmp_path / "a.mcap").read_bytes()
    rng = random.Random(2)
    for trial in range(150):
        cut, out = tmp_path / "cut.mcap", tmp_path / f"{trial}.mcap"
        cut.write_bytes(data[: rng.randrange(2000, len(data))])
        whole = [entry.raw for entry in read(cut)]
        account = recover(cut, out)
        assert [raw for _, raw in as_mcap(out)] == whole
        assert [entry.message for entry in read(out)] == made[: len(whole)]
        assert account["holes"] == []
        assert account["vouched"] == account["records"]
        reading = read(out)
        ending = reading.to_the_end()
        assert reading.chain == "intact"
        if account["missing"]:
            assert ending.kind == "cut"
            assert reading.metadata["s2r.recovered"]["missing"] == account["missing"]
        else:
            assert out.read_bytes() == data, "only the index was missing: it is made again, to the byte"


def test_a_whole_log_is_copied_as_it_is(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap")
    account = recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert (tmp_path / "b.mcap").read_bytes() == (tmp_path / "a.mcap").read_bytes()
    assert (account["ended"], account["missing"], account["lost_bytes"]) == ("closed", "", 0)


def test_recovering_twice_gives_the_same_file(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap")
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "a.mcap").read_bytes()[:5000])
    recover(tmp_path / "cut.mcap", tmp_path / "b.mcap")
    recover(tmp_path / "b.mcap", tmp_path / "c.mcap")
    assert (tmp_path / "c.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


@pytest.mark.slow
def test_damage_in_the_middle_costs_its_own_chunk_and_is_accounted_for(tmp_path: Path) -> None:
    made = record(tmp_path / "a.mcap")
    data = (tmp_path / "a.mcap").read_bytes()
    rng = random.Random(3)
    worst = 0
    for trial in range(150):
        place = rng.randrange(8 * 1500, 8 * (len(data) - 3000))
        flipped = bytearray(data)
        flipped[place // 8] ^= 1 << place % 8
        (tmp_path / "bad.mcap").write_bytes(flipped)
        account = recover(tmp_path / "bad.mcap", tmp_path / f"{trial}.mcap")
        found = as_mcap(tmp_path / f"{trial}.mcap")
        raws = [raw for _, raw in found]
        kept = [raw for raw in (entry.raw for entry in read(tmp_path / "a.mcap")) if raw in set(raws)]
        assert raws == kept
        lost = len(made) - len(raws)
        worst = max(worst, lost)
        assert lost <= PER_CHUNK
        assert sum(hole["records"] for hole in account["holes"]) == (lost and lost + 1)  # its seal is lost with it
        assert account["ended"] == "broken"
        assert account["vouched"] < account["records"] or not lost
    assert worst == PER_CHUNK


def test_a_log_whose_start_is_damaged_gives_its_messages_without_saying_whose(tmp_path: Path) -> None:
    made = record(tmp_path / "a.mcap")
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[30:60] = bytes(30)
    (tmp_path / "bad.mcap").write_bytes(data)
    with pytest.raises(RecordingError):
        read(tmp_path / "bad.mcap")
    account = recover(tmp_path / "bad.mcap", tmp_path / "b.mcap")
    assert len(as_mcap(tmp_path / "b.mcap")) == len(made)
    assert (account["vouched"], account["ended"]) == (0, "broken")


def test_nothing_is_written_where_there_is_nothing_to_recover_or_something_stands_already(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap")
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "a.mcap").read_bytes()[:100])
    (tmp_path / "x.csv").write_text("t,x\n0,1\n")
    for bad in ("cut.mcap", "x.csv", "missing.mcap"):
        with pytest.raises(RecordingError):
            recover(tmp_path / bad, tmp_path / "b.mcap")
    with pytest.raises(UsageError, match="exists already"):
        recover(tmp_path / "a.mcap", tmp_path / "cut.mcap")
    with pytest.raises(UsageError, match="cannot be written"):
        recover(tmp_path / "a.mcap", tmp_path / "nowhere" / "b.mcap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "cut.mcap", "x.csv"]


def test_info_tells_what_is_in_a_log_and_how_it_ended(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap")
    facts = info(tmp_path / "a.mcap")
    assert facts["channels"]["event/ticked"] == 150
    assert facts["channels"]["frame/in"] == 50
    assert (facts["run"], facts["part"], facts["ended"], facts["chain"], facts["lost_bytes"]) == ("test", 1, "closed", "intact", 0)
    assert facts["duration_s"] == pytest.approx(199e-9)
    assert facts["attachments"][0]["name"] == "profile.toml"
    assert facts["metadata"]["s2r"]["robot"] == "r"
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "a.mcap").read_bytes()[:5000])
    assert info(tmp_path / "cut.mcap")["ended"] == "cut"
