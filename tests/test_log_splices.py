"""Files of logs put together anew by somebody who has two whole runs of one robot, signed with its key, and not the key: no part, tail
or attachment of one passes for the other's, and nothing that was left unread counts as audited.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from audit_bench import PUBLIC, Bench

from s2r_runtime.audit.log import AuditResult, audit
from s2r_runtime.recording.layout import attachment_fields, attachment_record
from s2r_runtime.recording.reading import read
from s2r_runtime.recording.salvage import recover

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))
import log_forger as forger


class Runs(NamedTuple):
    """Two runs of one robot, each in parts and each whole; and the first one once more, as it went on after another turn of events."""

    a: list[Path]
    b: list[Path]
    fork: list[Path]
    whole_a: Path
    whole_b: Path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder = tmp_path_factory.mktemp("runs")
    first = Bench(folder).sample().drive(60).stop()
    second = Bench(folder, seed=2, memory=first.state.memory).drive(60).stop()
    other = Bench.__new__(Bench)
    other.items = list(first.items)
    del other.items[len(other.items) // 2]

    def parts(bench: Any, name: str, run: str) -> list[Path]:
        bench.write(folder / f"{name}.mcap", run=run, rotate_bytes=12_000)
        return sorted(folder.glob(f"{name}*.mcap"), key=lambda path: read(path).part)

    return Runs(
        parts(first, "a", "one"),
        parts(second, "b", "two"),
        parts(other, "f", "one"),
        first.write(folder / "whole-a.mcap", run="one"),
        second.write(folder / "whole-b.mcap", run="two"),
    )


def refused(result: AuditResult, what: str) -> None:
    assert not result.ok, result.text()
    said = [*result.incomplete, *result.unchecked, *([] if result.first_difference is None else [result.first_difference.what])]
    assert any(what in one for one in said), said


def test_the_runs_hold_as_they_are(runs: Runs) -> None:
    assert min(len(runs.a), len(runs.b), len(runs.fork)) >= 3
    for paths in (runs.a, [*runs.a, *runs.b], [runs.whole_a, runs.whole_b]):
        result = audit(paths, PUBLIC)
        assert result.ok, result.text()
        assert result.missing == []


def test_a_middle_part_that_was_removed_is_missed(runs: Runs) -> None:
    refused(audit([runs.a[0], *runs.a[2:]], PUBLIC), "part 2 of run one")


def test_a_part_of_another_run_does_not_stand_in_for_one(runs: Runs, tmp_path: Path) -> None:
    """Under the missing one's name."""
    posing = tmp_path / runs.a[1].name
    posing.write_bytes(runs.b[1].read_bytes())
    refused(audit([runs.a[0], posing, *runs.a[2:]], PUBLIC), "part 2 of run one")


def test_a_part_of_the_same_run_as_it_might_have_gone_on_does_not_continue_it(runs: Runs) -> None:
    """The machine was put back to an earlier state, and the run went on otherwise: same name, same key."""
    assert len(runs.a) == len(runs.fork)
    refused(audit([*runs.a[:-1], runs.fork[-1]], PUBLIC), "this part does not continue the one before")


def test_parts_are_known_by_what_they_say_and_not_by_their_names(runs: Runs, tmp_path: Path) -> None:
    swapped = [runs.a[0], tmp_path / runs.a[1].name, tmp_path / runs.a[2].name, *runs.a[3:]]
    swapped[1].write_bytes(runs.a[2].read_bytes())
    swapped[2].write_bytes(runs.a[1].read_bytes())
    assert audit(swapped, PUBLIC).ok


def test_a_part_that_says_another_number_is_damaged(runs: Runs, tmp_path: Path) -> None:
    two, three = runs.a[1].read_bytes(), runs.a[2].read_bytes()
    for name, data, old, new in (("x", two, b"2", b"3"), ("y", three, b"3", b"2")):
        at = data.index(b"\x04\x00\x00\x00part") + 8 + 4
        assert data[at : at + 1] == old
        (tmp_path / name).write_bytes(data[:at] + new + data[at + 1 :])
    result = audit([runs.a[0], tmp_path / "y", tmp_path / "x", *runs.a[3:]], PUBLIC)
    assert (result.ok, result.chain) == (False, "broken")


@pytest.mark.parametrize("cut", ["at a seal", "in a chunk"])
def test_what_follows_a_part_that_was_cut_is_not_taken_for_audited(runs: Runs, tmp_path: Path, cut: str) -> None:
    """Who cuts the middle part has the later ones unread: that may not pass."""
    parts = forger.apart(runs.a[1])
    parts.pieces, parts.closing = parts.pieces[:-2], False
    data = forger.forge(parts, "bytes")
    short = tmp_path / runs.a[1].name
    short.write_bytes(data if cut == "at a seal" else data[:-40])
    refused(audit([runs.a[0], short, *runs.a[2:]], PUBLIC), "follows a part whose end is missing")
    alone = audit([runs.a[0], short], PUBLIC)
    assert alone.ok, "and alone it is what a crash might have left"
    assert "was cut after" in alone.missing[0]


@pytest.mark.parametrize("whole", [False, True], ids=["after its last block", "after its end"])
def test_the_tail_of_another_run_is_no_tail(runs: Runs, tmp_path: Path, whole: bool) -> None:
    one, other = forger.apart(runs.whole_a), forger.apart(runs.whole_b)
    if whole:
        data = runs.whole_a.read_bytes() + runs.whole_b.read_bytes()
    else:
        one.pieces = one.pieces[:-3] + other.pieces[-3:]
        data = forger.forge(one, "chain")
    path = tmp_path / "spliced.mcap"
    path.write_bytes(data)
    result = audit([path], PUBLIC)
    assert (result.ok, result.chain) == (False, "broken")


def test_an_attachment_of_another_run_under_this_ones_name_is_damage(runs: Runs, tmp_path: Path) -> None:
    """A certificate, bytes and signature and all, of the other run."""
    one, other = forger.apart(runs.whole_a), [read(runs.whole_b)]
    other[0].to_the_end()
    foreign = next(attached for attached in other[0].attachments if attached.name.startswith("controller/"))
    place = next((p, i) for p in one.pieces for i, r in enumerate(p.prefix) if r[0] == 9 and attachment_fields(r).name == "profile.toml")
    old = attachment_fields(place[0].prefix[place[1]])
    place[0].prefix[place[1]] = attachment_record(old.name, old.media_type, old.log_time_ns, foreign.data)
    path = tmp_path / "swapped.mcap"
    for effort in ("bytes", "chain"):
        path.write_bytes(forger.forge(one, effort))  # type: ignore[arg-type]
        result = audit([path], PUBLIC)
        assert (result.ok, result.chain, result.records) == (False, "broken", 0)


def test_a_recovered_file_never_passes_for_the_whole_one(runs: Runs, tmp_path: Path) -> None:
    data = runs.whole_a.read_bytes()
    cut, out = tmp_path / "cut.mcap", tmp_path / "whole-a.mcap"
    cut.write_bytes(data[: len(data) * 3 // 4])
    recover(cut, out)
    result = audit([out], PUBLIC)
    assert result.ok
    assert "was recovered" in result.missing[0]
    reading = read(runs.whole_a)
    reading.to_the_end()
    refused(audit([out], PUBLIC, heads=[reading.head]), "the log does not come to a head that was published")
    stripped = tmp_path / "stripped.mcap"
    at = out.read_bytes().rindex(b"s2r.recovered", 0, out.read_bytes().rindex(b"\x89MCAP0\r\n"))
    stripped.write_bytes(out.read_bytes()[: at - 13] + out.read_bytes()[at + 200 :])
    again = audit([stripped], PUBLIC)
    assert not again.ok or again.missing


def test_a_run_cannot_be_given_twice(runs: Runs, tmp_path: Path) -> None:
    from s2r_runtime.errors import RecordingError

    twice = tmp_path / "again.mcap"
    twice.write_bytes(runs.whole_a.read_bytes())
    with pytest.raises(RecordingError, match="is part 1 of run 'one', and so is"):
        audit([runs.whole_a, twice], PUBLIC)
