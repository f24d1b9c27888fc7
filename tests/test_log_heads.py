"""A head that a daemon published is one that its log reaches, whatever happened since; who cuts the tail off is found out by it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Rig

from s2r_runtime.daemon.heads import HEAD_NS, LINE_NS, Heads
from s2r_runtime.messages import LogHead
from s2r_runtime.recording.reading import read


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    opened = Rig(tmp_path)
    yield opened
    opened.close()


def audit(rig: Rig, path: Path, *heads: str) -> tuple[int, dict[str, Any]]:
    """Exit code and account of `s2r audit`."""
    done = rig.s2r("audit", str(path), *(part for head in heads for part in ("--head", head)), "--json")
    return done.returncode, json.loads(done.stdout)


@pytest.mark.slow
def test_a_killed_daemons_log_reaches_every_head_that_it_published_and_a_shortened_one_does_not(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    heads: list[dict[str, Any]] = []
    for _ in range(3):
        known = len(heads)
        rig.ask("permit", duration_s=10.0 + known)  # persisted, so the disk has the log after it
        rig.until(lambda: heads.append(rig.status()["log_head"]) or (heads[-1] and heads[-1] not in heads[:-1]))
    rig.kill()
    (path,) = rig.log_files()
    published = list(dict.fromkeys(head["head"] for head in heads if head))
    code, whole = audit(rig, path, *published)
    assert (code, whole["ok"]) == (0, True), whole
    assert whole["recomputed"]["published heads"] == len(published) >= 3
    assert heads[-1]["run"] == path.stem
    assert heads[-1]["records"] <= whole["records"]
    data = path.read_bytes()
    reading = read(path)
    reading.sought = frozenset(map(bytes.fromhex, published))
    ends = [(set(reading.met), reading.offset) for _ in reading]
    before_last = next(offset for met, offset in ends if len(met) == len(published) - 1)
    (rig.folder / "short.mcap").write_bytes(data[:before_last])
    assert audit(rig, rig.folder / "short.mcap")[0] == 0, "alone it cannot be told from a crash"
    code, short = audit(rig, rig.folder / "short.mcap", *published)
    assert (code, short["ok"]) == (1, False)
    assert "head that was published" in short["first_difference"]["what"]


@pytest.mark.slow
def test_the_last_head_in_the_journal_is_that_of_the_closed_log(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    assert rig.stop() == 0
    (path,) = rig.log_files()
    said = next(line.split()[-1] for line in rig.said().splitlines() if " ends at " in line)
    code, result = audit(rig, path, said)
    assert (code, result["head"], result["missing"]) == (0, said, [])
    noted = json.loads((rig.state / "log_evidence.json").read_text())
    assert noted[path.stem].pop("seen_s") > 0.0
    assert noted == {path.stem: {"tags": [], "certificates": [], "head": said}}, "so it may be deleted some day (docs/log-format.md)"


def test_a_head_is_told_once_and_at_most_every_second_and_the_journal_hears_of_it_now_and_then() -> None:
    def head(records: int) -> LogHead:
        return LogHead("run", 1, records, "00", "11")

    told: list[LogHead] = []
    lines: list[str] = []
    heads = Heads(lines.append)
    heads.tick(0, None, told.append)  # nothing is on the disk yet
    for now_ns, records in ((0, 5), (HEAD_NS, 5), (HEAD_NS + 1, 6), (HEAD_NS + 2, 7), (2 * HEAD_NS + 1, 7), (LINE_NS, 8)):
        heads.tick(now_ns, head(records), told.append)
    assert [one.records for one in told] == [5, 6, 7, 8]
    assert lines == ["log of run run, 5 records: head 00", "log of run run, 8 records: head 00"]
