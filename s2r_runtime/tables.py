"""Recordings in table form: CSV, or CSV.gz (docs/recordings.md).

A header row; `t` in seconds; one column for each measured state and each input; an optional `segment` column for runs that are
not contiguous (any labels; the rows of one run stand together); a blank cell means *not received at this stamp*. Stamps do not
run backwards within a run; equal stamps are allowed (two streams, two rows). Columns that nobody asked for are not looked at.
"""

from __future__ import annotations

import csv
import difflib
import gzip
import io
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.canonical import digest
from s2r_runtime.errors import RecordingError

if TYPE_CHECKING:
    from _csv import Reader

Array = NDArray[np.float64]

TIME, SEGMENT = "t", "segment"

LARGEST = 1e30
"""In size, whatever the unit: what is beyond (the largest float of 32 or 64 bits) says that there is no value, and its square overflows."""


@dataclass(frozen=True)
class Table:
    """t: (N,) s. columns: name -> (N,), NaN where nothing was received. segment: (N,) number of the run, 0, 1, ..., or None; segments: what
    the file calls them.
    """

    t: Array
    columns: dict[str, Array]
    segment: NDArray[np.int64] | None
    segments: tuple[str, ...] = ()

    def content_digest(self, names: Sequence[str]) -> str:
        """Digest of the numbers in `t`, since the first stamp and to the microsecond, and in these columns: the same for every
        file that says the same, packed, formatted or shifted in time.
        """
        t = np.round(self.t - self.t[0], 6)
        numbers = np.column_stack([t, *(self.columns[name] for name in names)]) + 0.0  # no -0
        numbers[np.isnan(numbers)] = np.nan
        return digest(np.ascontiguousarray(numbers, dtype="<f8").tobytes())


def read_csv(path: Path | str, wanted: Sequence[str] | None = None, optional: Sequence[str] = (), time: str = TIME) -> Table:
    """Reads the columns `wanted` (None: all), and those of `optional` that are there. time: the column of the stamps.

    Raises RecordingError, one line: file, line, column, value, what would be right.
    """
    path = Path(path)
    header, rows = _opened(path)
    names = _checked_names(path, header, wanted, optional, time)
    for name in optional:
        if name not in header and (near := [h for h in header if h.lower() == name.lower()]):
            raise RecordingError(f"{path}: lacks the column {name!r}, and has {near[0]!r}; column names must match exactly")
    names += [name for name in dict.fromkeys(optional) if name in header and name not in names]
    cells, lines = _cells(path, rows, len(header))
    numbers = {name: _numbers(path, name, cells[header.index(name)], lines) for name in (time, *names)}
    t = numbers.pop(time)
    if blank := np.flatnonzero(np.isnan(t)).tolist():
        raise RecordingError(f"{path}: line {lines[blank[0]]}: column {time!r} is blank, every row needs its stamp")
    segment, called = _segments(path, cells[header.index(SEGMENT)], lines) if SEGMENT in header else (None, ())
    _check_time(path, t, segment, lines)
    return Table(t, numbers, segment, called)


def header_of(path: Path | str) -> list[str]:
    """Names of the columns. Raises RecordingError as `read_csv`."""
    return _opened(Path(path))[0]


def _opened(path: Path) -> tuple[list[str], Reader]:
    """The header, and the rows after it."""
    rows = csv.reader(io.StringIO(_text(path), newline=""), strict=True)
    try:
        return [name.strip() for name in next(rows)], rows
    except StopIteration:
        raise RecordingError(f"{path}: is empty, must start with a header row") from None
    except csv.Error as error:
        raise RecordingError(f"{path}: line 1: not CSV: {error}") from None


def _text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if path.suffix == ".gz" or data.startswith(b"\x1f\x8b"):
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError, zlib.error) as error:
            raise RecordingError(f"{path}: is not a whole gzip file: {error}") from None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise RecordingError(f"{path}: line {line}: not UTF-8 text (byte {data[error.start]:#04x})") from None
    if "\0" in text:
        raise RecordingError(f"{path}: line {text.count(chr(10), 0, text.index(chr(0))) + 1}: holds a zero byte, is not a CSV file")
    return text


def _checked_names(path: Path, header: list[str], wanted: Sequence[str] | None, optional: Sequence[str], time: str) -> list[str]:
    """The columns to read, without the stamps and `segment`."""
    if not any(header):
        raise RecordingError(f"{path}: is empty, must start with a header row")
    for name in (*(wanted or ()), *optional):
        if name in {time, SEGMENT}:
            raise RecordingError(f"{path}: column {name!r} has the {'stamps' if name == time else 'runs'}, can be no state or input")
    for name in (name for name in header if name) if wanted is None else (time, SEGMENT, *wanted, *optional):
        if header.count(name) > 1:
            raise RecordingError(f"{path}: column {name!r} is there {header.count(name)} times, must be there once")
    needed = [time, *(wanted or ())]
    if missing := [name for name in needed if name not in header]:
        raise RecordingError(f"{path}: {_missing(missing, header)}")
    return [name for name in (header if wanted is None else needed) if name not in {time, SEGMENT, ""}]


def _missing(missing: list[str], header: list[str]) -> str:
    if len(header) == 1 and (other := [sign for sign in (";", "\t", "|") if sign in header[0]]):
        names = ", ".join(map(repr, missing))
        return f"lacks {names}; are its columns separated by commas? {other[0]!r} seems to stand between them; decimal numbers need a point"
    if all(_is_number(name) for name in header):
        return f"starts with numbers, must start with a header row that names the columns: {', '.join(missing)}, ..."
    near = {name: difflib.get_close_matches(name, header, 1, 0.5) or [h for h in header if h.lower() == name.lower()] for name in missing}
    listed = ", ".join(f"{name!r}" + (f" (nearest: {near[name][0]!r})" if near[name] else "") for name in missing)
    return f"lacks the column{'s' if len(missing) > 1 else ''} {listed}; it has: {', '.join(header)}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _cells(path: Path, rows: Reader, width: int) -> tuple[list[tuple[str, ...]], list[int]]:
    """Columns of cells, and the line on which each row ends. Blank lines are skipped."""
    kept, lines = [], []
    try:
        for row in rows:
            if len(row) == width:
                kept.append(row)
                lines.append(rows.line_num)
            elif row:
                commas = "; are there commas in decimal numbers? They need a point" if len(row) == 2 * width else ""
                raise RecordingError(f"{path}: line {rows.line_num}: has {len(row)} cells, the header has {width}{commas}")
    except csv.Error as error:
        raise RecordingError(f"{path}: line {rows.line_num}: not CSV: {error}") from None
    if not kept:
        raise RecordingError(f"{path}: has a header and no rows")
    return list(zip(*kept, strict=True)), lines


def _numbers(path: Path, name: str, cells: tuple[str, ...], lines: list[int]) -> Array:
    """(N,), NaN for blank cells."""
    try:
        values = np.array([float(cell) if cell else math.nan for cell in cells])
    except ValueError:
        values = np.array([_number(path, name, cell, line) for cell, line in zip(cells, lines, strict=True)])
    for row in np.flatnonzero(~(np.abs(values) <= LARGEST)).tolist():
        if cells[row].strip():
            must = f"a number within {LARGEST:g}" if math.isfinite(values[row]) else "a finite number"
            raise RecordingError(f"{path}: line {lines[row]}: column {name!r} is {cells[row]!r}, must be {must} (or blank: not received)")
    return values


def _number(path: Path, name: str, cell: str, line: int) -> float:
    try:
        return float(cell) if cell.strip() else math.nan
    except ValueError:
        must = "have a decimal point" if _is_number(cell.replace(",", ".")) else "be a number (or blank: not received)"
        raise RecordingError(f"{path}: line {line}: column {name!r} is {cell!r}, must {must}") from None


def _segments(path: Path, cells: tuple[str, ...], lines: list[int]) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """(N,) 0, 1, ... in order of appearance, and what each is called."""
    numbers: list[int] = []
    seen: dict[str, int] = {}
    for label, rows in groupby(cell.strip() for cell in cells):
        line = lines[len(numbers)]
        if not label:
            raise RecordingError(f"{path}: line {line}: column {SEGMENT!r} is blank, every row needs its segment")
        if label in seen:
            raise RecordingError(f"{path}: line {line}: segment {label!r} goes on after another one began; its rows must stand together")
        seen[label] = len(seen)
        numbers += [seen[label]] * sum(1 for _ in rows)
    return np.array(numbers, dtype=np.int64), tuple(seen)


def _check_time(path: Path, t: Array, segment: NDArray[np.int64] | None, lines: list[int]) -> None:
    backwards = np.diff(t) < 0.0
    if segment is not None:
        backwards &= np.diff(segment) == 0
    if back := np.flatnonzero(backwards).tolist():
        row = back[0]
        raise RecordingError(f"{path}: line {lines[row + 1]}: time runs backwards, from {float(t[row])} s to {float(t[row + 1])} s")
