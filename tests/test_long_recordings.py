"""Long recordings, and files that only look like one: bounded in memory and time, thinned by a rule that is said."""

from __future__ import annotations

import gzip
import json
import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from s2r_runtime.errors import RecordingError
from s2r_runtime.files.canonical import digest
from s2r_runtime.files.table_text import Limits, TextLines
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recordings.loading import load_transitions
from s2r_runtime.recordings.table_rows import MAX_SEGMENT_ROWS, UNITS, RowStore
from s2r_runtime.recordings.tables import read_csv
from s2r_runtime.trace.data import readers

MB = 1 << 20
MODEL = ("--model", "unicycle", "--dt", "0.1")
UNICYCLE = compose(ModelSpec("unicycle", 0.1))


PEAK = "def peak(): return int(open('/proc/self/status').read().partition('VmHWM:')[2].split()[0])\n"
"""kB of this program. `ru_maxrss` counts what the process held that started it, too, until it became this one."""


def refused(path: Path, *more: str) -> str:
    """What `s2r gap` says of a file, within the 300 MB and the 5 s of its own processor time that it may take."""
    limit = PEAK + (
        "import resource, sys; from s2r_runtime.cli.main import main; code = main(sys.argv[1:])\n"
        "print(peak(), resource.getrusage(resource.RUSAGE_SELF).ru_utime); sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", limit, "gap", str(path), *MODEL, *more], capture_output=True, text=True, timeout=60, check=False
    )
    kilobytes, seconds = done.stdout.split()
    assert done.returncode == 2, done.stderr
    assert int(kilobytes) < 300_000
    assert float(seconds) < 5.0
    (line,) = done.stderr.strip().splitlines()
    return line


@pytest.mark.slow
def test_a_bomb_of_zeros_and_one_of_rows_are_refused(tmp_path: Path) -> None:
    zeros, rows = tmp_path / "zeros.csv.gz", tmp_path / "rows.csv.gz"
    packer = zlib.compressobj(6, wbits=31)
    zeros.write_bytes(b"".join(packer.compress(bytes(MB)) for _ in range(200)) + packer.flush())
    assert "line 1: holds a zero byte" in refused(zeros)
    packer = zlib.compressobj(6, wbits=31)
    head, body = b"t,x,y,theta,v,w\n", b"0,0,0,0,0,0\n" * (MB // 12)
    rows.write_bytes(packer.compress(head) + b"".join(packer.compress(body) for _ in range(60)) + packer.flush())
    assert "unpacks to more than 100 times its size" in refused(rows)
    with pytest.raises(
        RecordingError, match=r"unpacks to more than 0\.05 GB of text, at most 0\.05 GB are read; to read more: --max-gb GB"
    ):
        for _ in TextLines(rows, Limits(0.05e9, None)):
            pass


@pytest.mark.slow
def test_a_file_of_20_gb_and_a_line_without_an_end_are_refused(tmp_path: Path) -> None:
    large, line = tmp_path / "large.csv", tmp_path / "line.csv"
    with large.open("wb") as file:
        file.write(b"t,x,y,theta,v,w\n")
        file.truncate(20_000_000_000)  # sparse: it takes no room
    assert "has 20 GB of text, at most 4 GB are read; to read more: --max-gb GB" in refused(large)
    assert "holds a zero byte" in refused(large, "--max-gb", "30")
    line.write_bytes(b"t,x,y,theta,v,w\n" + b"1" * (3 * MB))
    assert "line 2: is longer than 1 MB" in refused(line)


@pytest.mark.parametrize("what", ["pipe", "device"])
def test_what_is_no_regular_file_is_refused_before_it_is_opened(tmp_path: Path, what: str) -> None:
    path = tmp_path / "run.csv"
    if what == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    for call in (lambda: load_transitions(path, UNICYCLE), lambda: readers.load_dataset(path, UNICYCLE)):
        with pytest.raises(RecordingError, match=f"is a {what}, must be a"):
            call()


def test_a_file_that_grows_while_it_is_read_ends_where_it_ended(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,x\n" + "".join(f"{k},1\n" for k in range(300_000)))
    lines = TextLines(path)
    whole = digest(path.read_bytes())
    count = 0
    for _ in lines:
        if count % 100_000 == 0:
            with path.open("a") as file:
                file.write("0,0\n" * 1000)
        count += 1
    assert count == 300_001
    assert lines.digest == whole


def table(path: Path, rows: int, segments: int = 0) -> Path:
    """A unicycle at 10 Hz whose x is off by the row's number times 1e-9."""
    k = np.arange(rows)
    columns = [0.1 * k, 0.02 * k + 1e-9 * k, 0 * k, 0 * k, 0.2 + 0 * k, 0.0 * k]
    names = "t,x,y,theta,v,w"
    if segments:
        columns, names = [k // (rows // segments), *columns], "segment," + names
    with path.open("w") as file:
        file.write(names + "\n")
        np.savetxt(file, np.column_stack(columns), delimiter=",", fmt="%.10g")
    return path


@pytest.mark.slow
def test_reading_stores_eight_bytes_a_number(tmp_path: Path) -> None:
    """A table of 300 000 rows as text, packed: 7 columns of which 6 are read take 14 MB, where objects took some 200 MB."""
    path = table(tmp_path / "run.csv", 300_000)
    packed = tmp_path / "run.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes(), 1))
    script = PEAK + (
        "import sys, numpy; from s2r_runtime.recordings.tables import read_csv; import csv, gzip, hashlib\n"
        "before = peak(); table = read_csv(sys.argv[1]); print(len(table.t), peak() - before)"
    )
    for one in (path, packed):
        done = subprocess.run([sys.executable, "-c", script, str(one)], capture_output=True, text=True, check=True)
        rows, kilobytes = map(int, done.stdout.split())
        assert rows == 300_000
        assert kilobytes < 70_000, one


@pytest.mark.slow
def test_a_thinned_table_is_spread_over_the_recording_and_keeps_its_digest(tmp_path: Path) -> None:
    path = table(tmp_path / "run.csv", 100_000)
    whole, part = read_csv(path), read_csv(path, max_rows=6400)
    assert whole.subset is None
    assert part.subset is not None
    assert part.subset.rows == 100_000
    assert 3200 < part.subset.used == len(part.t) <= 6400
    assert UNITS // 2 < len(part.subset.stretches) <= UNITS
    assert part.content == whole.content
    assert part.file_digest == whole.file_digest == digest(path.read_bytes())
    begins = np.array([a for a, _ in part.subset.stretches])
    np.testing.assert_allclose(np.diff(begins), begins[1] - begins[0])  # evenly
    assert begins[-1] > 0.9 * whole.t[-1]
    place = np.searchsorted(whole.t, part.t)
    np.testing.assert_array_equal(part.columns["x"], whole.columns["x"][place])


def test_whole_segments_are_thinned_by_their_number_alone() -> None:
    store = RowStore(1, 1000, whole_segments=True)
    for a in range(0, 10_000, 700):  # blocks that no segment of 50 rows ends with
        k = np.arange(a, min(a + 700, 10_000))
        store.add(0.1 * k, [1.0 * k], k // 50)
    t, (values,), segment, piece, subset = store.end()
    assert segment is not None
    assert piece is not None
    assert subset is not None
    numbers, counts = np.unique(segment, return_counts=True)
    assert set(counts.tolist()) == {50}  # none is cut
    assert set(np.diff(numbers).tolist()) == {16}  # 200 segments, of which 20 fit
    np.testing.assert_allclose(t, 0.1 * values)


def test_of_an_endless_segment_the_first_rows_count() -> None:
    store = RowStore(0, None, whole_segments=True)
    for a in range(0, 100_000, 1000):
        k = np.arange(a, a + 1000)
        store.add(0.1 * k, [], (k >= 99_990).astype(np.int64))
    _, _, segment, piece, _ = store.end()
    assert piece is None
    assert np.bincount(segment).tolist() == [MAX_SEGMENT_ROWS, 10]


def test_the_gap_of_a_long_drive_says_which_rows_it_is_of(tmp_path: Path, monkeypatch, capsys) -> None:
    from s2r_runtime.cli.main import main
    from s2r_runtime.recordings import loading as transitions

    monkeypatch.setattr(transitions, "MAX_VALUES", 6 * 6400)
    path = table(tmp_path / "run.csv", 20_000)
    assert main(["gap", str(path), *MODEL, "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    used, stretches = found["subset"]["used"], found["subset"]["stretches"]
    assert found["subset"]["rows"] == 20_000
    assert used <= 6400
    assert len(found["subset"]["stretches_s"]) == stretches
    assert found["n"] + found["rejected"]["cut"] == used - stretches  # a transition less than rows in each, and the first 3 s left out
    assert main(["gap", str(path), *MODEL]) == 3
    assert (
        f"subset          {used} of 20000 rows are used: {stretches} stretches of consecutive rows, evenly spread"
        in capsys.readouterr().out
    )


def test_a_long_trace_uses_stretches_and_says_so(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(readers, "MAX_ROWS", 1280)
    data = readers.load_dataset(table(tmp_path / "run.csv", 5000), UNICYCLE)
    assert data.subset is not None
    assert data.rows == data.subset.used <= 1280
    assert len(data.runs) == len(data.subset.stretches)
    assert all(len(run.y) == 20 for run in data.runs)


def test_long_segments_stay_runs_of_their_own(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(readers, "MAX_ROWS", 1280)
    data = readers.load_dataset(table(tmp_path / "run.csv", 6000, segments=3), UNICYCLE)
    assert data.subset is not None
    ends = [run.start_s + 0.1 * (len(run.y) - 1) for run in data.runs]
    assert not any(run.start_s < at - 0.05 < end for run, end in zip(data.runs, ends, strict=True) for at in (200.0, 400.0))
