"""Read in a process of its own or in this one, a log gets the same verdict, word for word; and the process leaves nothing behind."""

from __future__ import annotations

import multiprocessing
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from audit_bench import PUBLIC, Bench

from s2r_runtime.audit import ahead
from s2r_runtime.audit.ahead import Ahead
from s2r_runtime.audit.log import audit
from s2r_runtime.errors import S2RError
from s2r_runtime.recording.channels import CHANNELS
from s2r_runtime.recording.reading import read
from s2r_runtime.recording.salvage import recover


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return Bench(tmp_path_factory.mktemp("run")).sample().drive(60).stop()


def both_ways(monkeypatch: pytest.MonkeyPatch, paths: Sequence[Path], **options: Any) -> list[str]:
    """What is said: read here, read ahead, and read ahead in many small pieces."""
    said = []
    for worth, sent in ((1 << 40, 1), (0, 1 << 20), (0, 1)):
        monkeypatch.setattr(ahead, "WORTH_BYTES", worth)
        monkeypatch.setattr(ahead, "SENT_BYTES", sent)
        try:
            said.append(msgspec.json.encode(audit(paths, PUBLIC, **options)).decode())
        except S2RError as error:
            said.append(f"refused: {error}")
        assert not multiprocessing.active_children()
    return said


@pytest.mark.slow
def test_the_verdict_is_the_same_on_logs_whole_cut_recovered_rotated_and_damaged(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run.write(tmp_path / "a.mcap")
    data = whole.read_bytes()
    rng = random.Random(1)
    cases: dict[str, list[Path]] = {"whole": [whole]}
    for name, cut in (("half", len(data) // 2), ("index", len(data) - 60), ("start", 30)):
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(data[:cut])
        cases[name] = [path]
    recover(cases["half"][0], tmp_path / "recovered.mcap")
    cases["recovered"] = [tmp_path / "recovered.mcap"]
    for number in range(8):
        flipped = bytearray(data)
        flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path = tmp_path / f"flipped-{number}.mcap"
        path.write_bytes(flipped)
        cases[path.stem] = [path]
    (tmp_path / "parts").mkdir()
    run.write(tmp_path / "parts" / "p.mcap", rotate_bytes=30_000)
    parts = sorted((tmp_path / "parts").iterdir(), key=lambda path: read(path).part)
    cases |= {"parts": parts, "a part lacks": [parts[0], *parts[2:]], "the first lacks": parts[1:], "the last lacks": parts[:-1]}
    for name, paths in cases.items():
        here, one, many = both_ways(monkeypatch, paths)
        assert here == one == many, name
    assert '"ok":true' in both_ways(monkeypatch, parts)[1]


@pytest.mark.slow
def test_published_heads_are_looked_for_there_as_well(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = run.write(tmp_path / "a.mcap")
    reading = read(path)
    reading.to_the_end()
    for heads in ([reading.head], [bytes(32)]):
        here, one, many = both_ways(monkeypatch, [path], heads=heads)
        assert here == one == many
        assert ('"published heads":1' in here) == (heads == [reading.head])


@pytest.mark.slow
def test_afterwards_the_reading_knows_what_it_would_know_had_it_been_read_here(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "WORTH_BYTES", 0)
    path = run.write(tmp_path / "a.mcap")
    here, there = read(path), read(path)
    process = Ahead([there])
    assert list(process.entries(there)) == list(here)
    process.close()
    for name in ("ending", "head", "chain", "attachments", "metadata", "counts", "offset", "last_ns", "declarations", "sealed_for_good"):
        assert getattr(there, name) == getattr(here, name), name


@pytest.mark.slow
def test_an_audit_that_is_given_up_ends_the_process(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "WORTH_BYTES", 0)
    path = run.write(tmp_path / "a.mcap")

    def enough(*_: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        audit([path], progress=enough)
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_a_process_that_dies_fails_the_audit_and_passes_nothing(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "WORTH_BYTES", 0)
    monkeypatch.setattr(ahead, "SENT_BYTES", 1)
    reading = read(run.write(tmp_path / "a.mcap"))
    process = Ahead([reading])
    found = process.entries(reading)
    assert next(found) == next(iter(read(reading.path)))
    process._process.kill()
    with pytest.raises(RuntimeError, match="could not be read: the process died"):
        for _ in found:
            pass
    assert not reading.over
    process.close()


@pytest.mark.slow
def test_a_channel_that_is_not_known_is_refused_at_the_same_message(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = run.write(tmp_path / "a.mcap")
    fewer = {name: kind for name, kind in CHANNELS.items() if name != "event/link_changed"}
    for module in ("reading", "entries"):
        monkeypatch.setattr(f"s2r_runtime.recording.{module}.CHANNELS", fewer)
    here, one, many = both_ways(monkeypatch, [path])
    assert here == one == many
    assert "which this version does not know" in here
