"""Tables: what is read is what is there, and what is wrong is named on one line."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from s2r_runtime.errors import RecordingError
from s2r_runtime.recordings.tables import read_csv

GOOD = "t,x,v\n0.0,1.5,\n0.1,,0.2\n0.1,1.6,\n0.3,1.7,0.1\n"


@pytest.fixture
def write(tmp_path: Path):
    def writer(content: str | bytes, name: str = "run.csv") -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return writer


def test_blank_cells_are_not_received_and_equal_stamps_are_allowed(write) -> None:
    table = read_csv(write(GOOD), ("x", "v"))
    np.testing.assert_array_equal(table.t, [0.0, 0.1, 0.1, 0.3])
    np.testing.assert_array_equal(table.columns["x"], [1.5, np.nan, 1.6, 1.7])
    np.testing.assert_array_equal(table.columns["v"], [np.nan, 0.2, np.nan, 0.1])
    assert table.segment is None


@pytest.mark.parametrize("name", ["run.csv.gz", "run.csv"])
def test_gzip_reads_like_plain_text_whatever_its_name(write, name: str) -> None:
    table = read_csv(write(gzip.compress(GOOD.encode()), name))
    assert list(table.columns) == ["x", "v"]
    assert len(table.t) == 4


@pytest.mark.parametrize(
    "text",
    [
        GOOD.replace("\n", "\r\n"),
        "\ufeff" + GOOD,
        GOOD.replace(",", " , "),
        '"t","x","v"\n"0.0","1.5",\n0.1,,0.2\n0.1,1.6,\n0.3,1.7,0.1\n\n',
    ],
    ids=["windows line ends", "byte order mark", "spaces", "quotes and a blank line"],
)
def test_dialects_that_spreadsheets_write_are_read_alike(write, text: str) -> None:
    table, plain = read_csv(write(text, "a.csv"), ("x", "v")), read_csv(write(GOOD, "b.csv"), ("x", "v"))
    np.testing.assert_array_equal(table.t, plain.t)
    np.testing.assert_array_equal(table.columns["x"], plain.columns["x"])
    np.testing.assert_array_equal(table.columns["v"], plain.columns["v"])


def test_only_the_columns_asked_for_must_be_numbers(write) -> None:
    path = write("t,x,mode\n0,1,manual\n1,2,auto\n")
    assert list(read_csv(path, ("x",)).columns) == ["x"]
    with pytest.raises(RecordingError, match=r"line 2: column 'mode' is 'manual'"):
        read_csv(path)


def test_segments_are_numbered_as_they_appear_and_time_may_start_again(write) -> None:
    table = read_csv(write("segment,t,x\nb,5,1\nb,6,2\na,0,3\na,1,4\n"), ("x",))
    assert table.segment is not None
    assert table.segment.tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty, must start with a header row"),
        ("\n\n", "is empty, must start with a header row"),
        ("t,x\n", "has a header and no rows"),
        ("t,x,y\n0,1\n", "line 2: has 2 cells, the header has 3"),
        ("t,x\n0,1\n1,2,3\n", "line 3: has 3 cells, the header has 2"),
        ("t,x\n0,1\n0.5,abc\n", "line 3: column 'x' is 'abc', must be a number (or blank: not received)"),
        ("t,x\n0,1\n0.5,1_0\n", "line 3: column 'x' is '1_0', must be a number (or blank: not received)"),
        ("t,x\n0,1\n0.5,\u0661\u0662\n", "line 3: column 'x' is '\u0661\u0662', must be a number (or blank: not received)"),
        ("t,x\n0,1\nnan,1\n", "line 3: column 't' is blank, every row needs its stamp"),
        ("t,x\n0,-inf\n", "line 2: column 'x' is '-inf', must be a finite number"),
        ("t,x\n0,1\n1,-1e31\n", "line 3: column 'x' is '-1e31', must be a number within 1e+30 (or blank: not received)"),
        ("t,x\n0,1e999\n", "line 2: column 'x' is '1e999', must be a finite number"),
        ("t,x\n0,1\n1,1\n0.5,1\n", "line 4: time runs backwards, from 1.0 s to 0.5 s"),
        ("t,x\n0,1\n,1\n", "line 3: column 't' is blank, every row needs its stamp"),
        ("t,x\n0,1\nlater,1\n", "line 3: column 't' is 'later'"),
        ("t,x,x\n0,1,1\n", "column 'x' is there 2 times, must be there once"),
        ("when,x\n0,1\n", "lacks the column 't'"),
        ("t,xx\n0,1\n", "lacks the column 'x' (nearest: 'xx'); it has: t, xx; others: --column NAME=COLUMN"),
        ("t;x\n0;1\n", "are its columns separated by commas?"),
        ("segment,t,x\n1,0,1\n2,0,1\n1,1,1\n", "line 4: segment '1' goes on after another one began"),
        ("segment,t,x\n1,0,1\n,0,1\n", "line 3: column 'segment' is blank"),
        ("segment,t,x\n1,0,1\n1,-1,1\n", "line 3: time runs backwards"),
        ('t,x\n0,"1\n', "not CSV"),
        (b"t,x\n0,\xff\n", "line 2: not UTF-8 text (byte 0xff)"),
        (b"t,x\n0,\0\n", "line 2: holds a zero byte"),
        ("t;x\n0,5;1\n", "';' seems to stand between them; decimal numbers need a point"),
        ("t\tx\n0\t1\n", "'\\t' seems to stand between them"),
        ("# a trajectory\n# timestamp tx ty qw\n0.1 1 2 1\n", "' ' seems to stand between them"),
        ("1 0 0 0.1\n1 0 0 0.2\n", "it starts with numbers, must start with a header row"),
        ("# thanks to all\n# https://example.org/a\n0.1 1 2 1\n", "it starts with numbers, must start with a header row"),
        ("# only\n# comments\n", "lacks the columns 't', 'x'"),
        ("t,x\n1403636580838555648,1\n", "column 't' has a stamp of 1.4e+18 s; if it is in ns, name it t_ns in the header"),
        ("t,x\n1403636580838,1\n", "if it is in ms, name it t_ms"),
        ("t,x\n0,0,1,5\n", "line 2: has 4 cells, the header has 2; are there commas in decimal numbers? They need a point"),
        ('t,x\n0,"1,5"\n', "line 2: column 'x' is '1,5', must have a decimal point"),
        ("0,1\n0.1,2\n", "starts with numbers, must start with a header row that names the columns: t, x"),
    ],
)
def test_what_is_wrong_is_named_on_one_line(write, text: str | bytes, message: str) -> None:
    path = write(text)
    with pytest.raises(RecordingError) as caught:
        read_csv(path, ("x",))
    told = str(caught.value)
    assert message in told
    assert told.startswith(str(path))
    assert "\n" not in told
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    "text",
    [
        "#t_ns, x [m]\n0,1\n500000000,2\n",
        "% time,x\n0,1\n0.5,2\n",
        "# a drive in the hall\n#\n# t,x\n0,1\n0.5,2\n",
        "# a drive in the hall, by hand\nt,x\n0,1\n0.5,2\n",
    ],
)
def test_comments_before_the_table_are_no_rows_and_the_last_may_be_its_header(write, text: str) -> None:
    table = read_csv(write(text), ("x",))
    assert (table.t.tolist(), table.columns["x"].tolist()) == ([0.0, 0.5], [1.0, 2.0])
    assert table.content == read_csv(write("t,x\n0,1\n0.5,2\n", "plain.csv"), ("x",)).content
    with pytest.raises(RecordingError, match=f"line {text.count(chr(10)) + 1}: "):
        read_csv(write(text + "1,zwei\n"), ("x",))


def test_all_missing_columns_are_named_with_the_nearest(write) -> None:
    with pytest.raises(RecordingError, match=r"lacks the columns 'theta' \(nearest: 'thetta'\), 'w'; it has: t, x, thetta"):
        read_csv(write("t,x,thetta\n0,1,2\n"), ("x", "theta", "w"))


@pytest.mark.parametrize("content", [b"t,x\n0,1\n", gzip.compress(b"t,x\n0,1\n", mtime=0)[:-6], b"\x1f\x8bnonsense"])
def test_a_broken_gzip_file_is_refused(write, content: bytes) -> None:
    with pytest.raises(RecordingError, match="is not a whole gzip file"):
        read_csv(write(content, "run.csv.gz"))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"none\.csv: cannot be read: No such file"):
        read_csv(tmp_path / "none.csv")


@pytest.mark.slow
def test_a_hundred_thousand_rows_are_read_exactly(write) -> None:
    n = 100_000
    rng = np.random.default_rng(4)
    values = rng.normal(size=(n, 3))
    body = "\n".join(f"{k * 0.01:.2f},{a!r},{b!r},{c!r}" for k, (a, b, c) in enumerate(values.tolist()))
    table = read_csv(write(f"t,x,y,v\n{body}\n"), ("x", "y", "v"))
    np.testing.assert_array_equal(np.column_stack([table.columns[c] for c in ("x", "y", "v")]), values)


@pytest.mark.parametrize("text", ["t,x,note,note\n0,1,a,b\n1,2,a,b\n", "t,x,,\n0,1,,\n1,2,,\n"])
def test_columns_that_nobody_asked_for_may_be_anything(tmp_path: Path, text: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(text)
    assert read_csv(path, ["x"]).columns["x"].tolist() == [1.0, 2.0]
