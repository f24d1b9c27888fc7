"""Whatever is done to a log without its key shows, and the first record that is not vouched for is named. (10^5 of them: make bench.)"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

import bench_tamper


@pytest.mark.parametrize("seed", [11, 12])
def test_no_mutation_of_a_log_goes_unseen_and_the_first_bad_record_is_named(seed: int) -> None:
    did, seen, wrong = bench_tamper.run(1200, seed)
    assert wrong == []
    assert seen["UNSEEN"] == 0
    kinds = {what.partition(",")[0] for what in did}
    assert kinds == {one.__name__ for one in (*bench_tamper.BYTES, *bench_tamper.RECORDS)}


def test_a_log_that_was_not_touched_is_not_accused(tmp_path: Path) -> None:
    bench_tamper.record(tmp_path / "a.mcap", 1, blocks=5, per_block=20)
    target = bench_tamper.target(tmp_path / "a.mcap")
    how, problem = bench_tamper.judged(target, target.data, tmp_path / "b.mcap")
    assert (how, problem) == ("", "read as closed"), "so the bench can tell the difference"


def test_the_same_content_in_another_form_shows_in_every_chunk_the_last_one_included(tmp_path: Path) -> None:
    bench_tamper.record(tmp_path / "a.mcap", 1, blocks=5, per_block=20)
    target = bench_tamper.target(tmp_path / "a.mcap")
    parts = bench_tamper.copied(target.parts)
    for number in range(len(parts.pieces)):
        changed = bench_tamper.copied(parts)
        content = b"".join(changed.pieces[number].declarations) + b"".join(m.record() for m in changed.pieces[number].messages)
        changed.pieces[number].data = bench_tamper.zstandard.ZstdCompressor(level=19, write_checksum=True).compress(content)
        data = bench_tamper.forge(changed, "bytes")
        assert data != target.data
        how, problem = bench_tamper.judged(target, data, tmp_path / "b.mcap")
        assert (how, problem) == ("broken", ""), number


def test_a_first_part_that_says_to_begin_later_is_damaged_from_the_start(tmp_path: Path) -> None:
    bench_tamper.record(tmp_path / "a.mcap", 1, blocks=5, per_block=20)
    target = bench_tamper.target(tmp_path / "a.mcap")
    at = target.data.index(b"first_index") + len(b"first_index") + 4
    assert target.data[at : at + 1] == b"0"
    how, problem = bench_tamper.judged(target, target.data[:at] + b"2" + target.data[at + 1 :], tmp_path / "b.mcap")
    assert (how, problem) == ("no log", "")
