"""Recordings in table form: CSV, CSV.gz, or in memory (docs/recordings.md).

A header row (comments with # or % may stand before it, or be it); the
stamps (`t`, s); one column for each measured state and each input, by the model's name, a usual other one
(`column_names`) or one that the person stated; an optional `segment` column for runs that are not contiguous (any labels; the rows of
one run stand together). A blank cell, or a word for "no value" (`MISSING`), means *not received at this stamp*. Stamps do not run backwards
within a run; equal stamps are allowed (two streams, two rows). Columns that nobody asked for are not looked at.

Read in one pass, block by block: what is stored is 8 bytes a number.
"""

from __future__ import annotations

import csv
import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import RecordingError
from s2r_runtime.files.table_text import Limits, Progress, TextLines
from s2r_runtime.modelspec import SEGMENT, TIME
from s2r_runtime.recordings.column_names import Place, missing, places, told
from s2r_runtime.recordings.table_rows import RowStore, Subset

if TYPE_CHECKING:
    from _csv import Reader

__all__ = [
    "LARGEST", "MISSING", "SEGMENT", "TIME", "ArrayTable", "Limits", "Source", "Subset", "Table", "header_of", "missing_columns",
    "places_of", "read_csv",
]  # fmt: skip

Array = NDArray[np.float64]
Cells = Array | tuple[str, ...]
"""(n,) numbers, or text as in a file."""

LARGEST = 1e30
"""In size, whatever the unit: what is beyond (the largest float of 32 or 64 bits) says that there is no value, and its square overflows."""
MISSING = frozenset(("nan", "+nan", "-nan", "na", "n/a", "<na>", "null", "none", "nil"))
"""Cells, in small letters, that hold no value: what pandas, NumPy, R, MATLAB and databases write where there is none."""

COMMENT, MAX_COMMENTS = ("#", "%"), 10_000
"""What begins a comment before the table, and the most such lines."""
LATEST_S = 1e11
"""No clock is beyond that, so stamps that are have another unit: since 1970 there are 1.8e9 s, 1.8e12 ms."""
BLOCK_ROWS, BLOCK_CELLS = 8192, 400_000
"""Rows that are Python objects at a time; fewer of a wide table."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(inf|infinity)", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class Table:
    """t: (N,) s. columns: name -> (N,), NaN where nothing was received. segment: (N,) number of the run, 0, 1, ..., or None; segments: what
    the file calls them. file_digest: of the file's bytes; content: of all its rows (`content_digest`). piece: (N,) number of the contiguous
    stretch, where only a subset of the rows is here. notes: what was guessed or converted, one sentence each.
    """

    t: Array
    columns: dict[str, Array]
    segment: NDArray[np.int64] | None
    segments: tuple[str, ...] = ()
    file_digest: str = ""
    content: str = ""
    piece: NDArray[np.int64] | None = None
    subset: Subset | None = None
    notes: tuple[str, ...] = ()

    def content_digest(self, names: Sequence[str]) -> str:
        """Digest of the numbers in `t`, since the first stamp and to the microsecond, and in these columns: the same for every
        file that holds the same, packed, formatted or shifted in time. Of a table that was read: of all its rows and names.
        """
        if self.content:
            return self.content
        content = _Content()
        for a in range(0, len(self.t), BLOCK_ROWS):
            content.add(self.t[a : a + BLOCK_ROWS], [self.columns[name][a : a + BLOCK_ROWS] for name in names])
        return content.digest


@dataclass(frozen=True, eq=False)
class ArrayTable:
    """A table in memory, which is read as a file with the same cells is.

    name: how messages call it; columns: name -> (n,) cells, all of one length. Numbers are NaN, and text is blank, where nothing was
    received; the labels of `segment` are text.
    """

    name: str
    columns: Mapping[str, Cells]

    def __str__(self) -> str:
        return self.name

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of names and cells: what stands for the file's bytes (guarantee G6)."""
        found = hashlib.sha256()
        for name, cells in self.columns.items():
            data = cells.astype("<f8").tobytes() if isinstance(cells, np.ndarray) else "\0".join(cells).encode(errors="surrogatepass")
            found.update(f"{name}\0{len(cells)}\0".encode(errors="surrogatepass") + data)
        return "sha256:" + found.hexdigest()

    def blocks(self) -> Iterator[tuple[list[Cells], range]]:
        """Columns of cells, and the numbers of their rows, as of a file."""
        most = _block_rows(len(self.columns))
        for a in range(0, len(self), most):
            yield [cells[a : a + most] for cells in self.columns.values()], range(a, min(a + most, len(self)))


Source = Path | ArrayTable
"""Where a table is."""


class _Content:
    """The content digest of rows that come block by block."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._first: float | None = None

    def add(self, t: Array, columns: Sequence[Array]) -> None:
        if self._first is None:
            self._first = float(t[0])
        numbers = np.column_stack([np.round(t - self._first, 6), *columns]) + 0.0  # no -0
        numbers[np.isnan(numbers)] = np.nan
        self._hash.update(np.ascontiguousarray(numbers, dtype="<f8").tobytes())

    @property
    def digest(self) -> str:
        return "sha256:" + self._hash.hexdigest()


def read_csv(
    path: Source | str,
    wanted: Sequence[str] | None = None,
    optional: Sequence[str] = (),
    columns: Mapping[str, str] | None = None,
    *,
    order: Sequence[str] = (),
    angles: Sequence[str] = (),
    max_rows: int | None = None,
    whole_segments: bool = False,
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> Table:
    """Reads the states and inputs `wanted` (None: every column, by its own name), and those of `optional` that are there.

    path: of a file, or a table in memory. columns: name (or `t`) -> column, as the person stated. order: of names in the content digest
    (default: as in `wanted`). angles: names of angles. max_rows: more rows than that are thinned (`table_rows`), by whole segments if
    `whole_segments`. limits: of the text.
    Raises RecordingError, one line: file, line (in memory: row), column, value, what would be right.
    """
    source, columns = path if isinstance(path, ArrayTable) else Path(path), dict(columns or {})
    text = None if isinstance(source, ArrayTable) else TextLines(source, limits, progress)
    header, blocks = _opened(source, text)
    found = _places(source, header, wanted, optional, columns, angles)
    names = [name for name in (order or found) if name in found and name != TIME]
    reading = _Reading(source, header, found, names, RowStore(len(names), max_rows, whole_segments=whole_segments))
    for cells, lines in blocks:
        reading.add(cells, lines, text is not None and text.has_odd)
    if not reading.store.rows:
        raise RecordingError(f"{source}: {'has a header and no rows' if text else 'has columns and no rows'}")
    t, values, segment, piece, subset = reading.store.end()
    note = told(found)
    return Table(
        t,
        dict(zip(names, values, strict=True)),
        segment,
        tuple(reading.labels),
        source.digest if isinstance(source, ArrayTable) else text.digest if text else "",
        reading.content.digest,
        piece,
        subset,
        (note,) if note else (),
    )


def header_of(path: Source | str, limits: Limits | None = None) -> list[str]:
    """Names of the columns. Raises RecordingError as `read_csv`."""
    if isinstance(path, ArrayTable):
        return list(path.columns)
    return _opened(Path(path), TextLines(Path(path), limits))[0]


def places_of(path: Source | str, wanted: Sequence[str], columns: Mapping[str, str], angles: Sequence[str] = ()) -> dict[str, Place]:
    """Where a table has these names, of those that it has. Raises RecordingError as `read_csv`."""
    return places(header_of(path), wanted, columns, str(path), angles)


def _opened(source: Source, text: TextLines | None) -> tuple[list[str], Iterator[tuple[Sequence[Cells], Sequence[int]]]]:
    """The header, and the rows after it, block by block. text: of a file."""
    if isinstance(source, ArrayTable):
        return list(source.columns), source.blocks()
    header, rows = _header(source, iter(text or ()))
    return header, _blocks(source, rows, len(header))


def _header(path: Path, text: Iterator[str]) -> tuple[list[str], Reader]:
    rows = csv.reader(_without_comments(text), strict=True)
    try:
        while not (header := next(rows)) and rows.line_num < MAX_COMMENTS:
            pass
        return [name.strip() for name in header], rows
    except StopIteration:
        raise RecordingError(f"{path}: is empty, must start with a header row") from None
    except csv.Error as error:
        raise RecordingError(f"{path}: line 1: not CSV: {error}") from None


def _without_comments(lines: Iterator[str]) -> Iterator[str]:
    """Lines behind comments (# or %), which become empty ones; the last comment is the header if a number begins the line after it."""
    last = ""
    for line in lines:
        if line.lstrip()[:1] in COMMENT:
            if last:
                yield "\n"
            last = line.lstrip(" \t" + "".join(COMMENT))
            continue
        if last:
            yield last if _names(last, line) else "\n"
        yield line
        break
    else:
        yield last
    yield from lines


def _names(comment: str, row: str) -> bool:
    """Whether a comment names the columns of the row of numbers behind it."""
    sign = next((sign for sign in ",;" if sign in row), None)
    cells = row.split(sign)
    return len(cells) == len(comment.split(sign)) and bool(cells) and _is_number(cells[0])


def _places(
    path: Source,
    header: list[str],
    wanted: Sequence[str] | None,
    optional: Sequence[str],
    columns: Mapping[str, str],
    angles: Sequence[str],
) -> dict[str, Place]:
    """Where the stamps and the names are that are to be read."""
    if not any(header):
        raise RecordingError(
            f"{path}: is empty, must {'have named columns' if isinstance(path, ArrayTable) else 'start with a header row'}"
        )
    time = columns.get(TIME, TIME)
    for name in (*(wanted or ()), *optional):
        if (column := columns.get(name, name)) in {time, SEGMENT}:
            raise RecordingError(f"{path}: column {column!r} has the {'stamps' if column == time else 'runs'}, can be no state or input")
    asked = [TIME, *(header if wanted is None else wanted)]
    asked = [name for name in dict.fromkeys(asked) if name not in {SEGMENT, ""}]
    for column in header if wanted is None else (SEGMENT, *(columns.get(name, name) for name in (*asked, *optional))):
        if column and header.count(column) > 1:
            raise RecordingError(f"{path}: column {column!r} is there {header.count(column)} times, must be there once")
    found = places(header, [*asked, *(name for name in optional if name not in asked)], columns, str(path), angles)
    if absent := [columns.get(name, name) for name in asked if name not in found]:
        raise RecordingError(f"{path}: {missing_columns(absent, header)}")
    for name, place in found.items():
        if header.count(place.column) > 1:
            raise RecordingError(
                f"{path}: column {place.column!r} ({name}) is there {header.count(place.column)} times, must be there once"
            )
    return found


def missing_columns(absent: list[str], header: list[str]) -> str:
    """What is wrong with a table that lacks these columns, or is none, in words."""
    if len(header) == 1 and (other := [sign for sign in (";", "\t", "|", " ") if len(header[0].split(sign)) > (1 if sign != " " else 2)]):
        names = ", ".join(map(repr, absent))
        said = f"lacks {names}; are its columns separated by commas? {other[0]!r} seems to stand between them; decimal numbers need a point"
        if all(map(_is_number, header[0].split())):
            said += "; it starts with numbers, must start with a header row"
        blank = "; (echo NAME,NAME,...; grep -v '^#' FILE | tr -s '[:blank:]' ',') > FILE.csv writes it so"
        return said + (blank if other[0] in "\t " else "")
    if all(_is_number(name) for name in header):
        return f"starts with numbers, must start with a header row that names the columns: {', '.join(absent)}, ..."
    return missing(absent, header)


class _Reading:
    """Checks blocks of rows, and stores their numbers."""

    def __init__(self, source: Source, header: list[str], found: Mapping[str, Place], names: list[str], store: RowStore) -> None:
        self.store, self.content, self.labels = store, _Content(), {}  # type: ignore[var-annotated]
        self._where = f"{source}: {'row' if isinstance(source, ArrayTable) else 'line'}"
        self._columns = [(found[name], header.index(found[name].column)) for name in (TIME, *names)]
        self._segment = header.index(SEGMENT) if SEGMENT in header else None
        self._last = -math.inf
        self._run = -1
        self._label = ""

    def add(self, cells: Sequence[Cells], lines: Sequence[int], odd: bool) -> None:
        """The next rows, as columns of cells.

        lines: on which each ends, or numbers of rows; odd: whether cells may hold what only looks like a number.
        """
        t, *values = (_numbers(self._where, place.column, cells[column], lines, odd) * place.scale for place, column in self._columns)
        if blank := np.flatnonzero(np.isnan(t)).tolist():
            raise RecordingError(
                f"{self._where} {lines[blank[0]]}: column {self._columns[0][0].column!r} is blank, every row needs its stamp"
            )
        if far := np.flatnonzero(np.abs(t) > LATEST_S).tolist():
            t_far = float(np.abs(t[far[0]]))
            unit = "ms" if t_far < 1e3 * LATEST_S else "us" if t_far < 1e6 * LATEST_S else "ns"
            column = self._columns[0][0].column
            raise RecordingError(
                f"{self._where} {lines[far[0]]}: column {column!r} has a stamp of {t_far:.3g} s; "
                f"if it is in {unit}, name it t_{unit} in the header"
            )
        segment = None if self._segment is None else self._numbered(cells[self._segment], lines)
        self._check_time(t, segment, lines)
        self.content.add(t, values)
        self.store.add(t, values, segment)

    def _numbered(self, cells: Cells, lines: Sequence[int]) -> NDArray[np.int64]:
        """(n,) 0, 1, ... in order of appearance."""
        numbers: list[int] = []
        for label, rows in groupby(str(cell).strip() for cell in cells):
            line = lines[len(numbers)]
            if not label:
                raise RecordingError(f"{self._where} {line}: column {SEGMENT!r} is blank, every row needs its segment")
            if label != self._label:
                if label in self.labels:
                    raise RecordingError(
                        f"{self._where} {line}: segment {label!r} goes on after another one began; its rows must stand together"
                    )
                self._label = label
                self.labels[label] = len(self.labels)
            numbers += [self.labels[label]] * sum(1 for _ in rows)
        return np.array(numbers, dtype=np.int64)

    def _check_time(self, t: Array, segment: NDArray[np.int64] | None, lines: Sequence[int]) -> None:
        backwards = np.diff(t, prepend=self._last) < 0.0
        if segment is not None:
            backwards &= np.diff(segment, prepend=self._run) == 0
            self._run = int(segment[-1])
        if back := np.flatnonzero(backwards).tolist():
            row = back[0]
            before = float(t[row - 1]) if row else self._last
            raise RecordingError(f"{self._where} {lines[row]}: time runs backwards, from {before} s to {float(t[row])} s")
        self._last = float(t[-1])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _block_rows(width: int) -> int:
    """Rows of a block; width: its columns."""
    return max(1, min(BLOCK_ROWS, BLOCK_CELLS // max(1, width)))


def _blocks(path: Path, rows: Reader, width: int) -> Iterator[tuple[list[tuple[str, ...]], list[int]]]:
    """Columns of cells, and the line on which each row ends. Blank lines are skipped."""
    kept: list[list[str]] = []
    lines: list[int] = []
    most = _block_rows(width)
    try:
        for row in rows:
            if len(row) == width:
                kept.append(row)
                lines.append(rows.line_num)
                if len(kept) >= most:
                    yield list(zip(*kept, strict=True)), lines
                    kept, lines = [], []
            elif row:
                commas = "; are there commas in decimal numbers? They need a point" if len(row) == 2 * width else ""
                raise RecordingError(f"{path}: line {rows.line_num}: has {len(row)} cells, the header has {width}{commas}")
    except csv.Error as error:
        raise RecordingError(f"{path}: line {rows.line_num}: not CSV: {error}") from None
    if kept:
        yield list(zip(*kept, strict=True)), lines


def _numbers(where: str, name: str, cells: Cells, lines: Sequence[int], odd: bool) -> Array:
    """(N,), NaN for cells without a value."""
    values = cells if isinstance(cells, np.ndarray) else _parsed(where, name, cells, lines, odd)
    if np.all(np.abs(values) <= LARGEST):
        return values
    for row in np.flatnonzero(np.abs(values) > LARGEST).tolist():
        must = f"a number within {LARGEST:g}" if math.isfinite(values[row]) else "a finite number"
        cell = str(cells[row])
        raise RecordingError(f"{where} {lines[row]}: column {name!r} is {cell!r}, must be {must} (or blank: not received)")
    return values


def _parsed(where: str, name: str, cells: tuple[str, ...], lines: Sequence[int], odd: bool) -> Array:
    try:
        if odd:
            raise ValueError
        return np.array([float(cell) if cell else math.nan for cell in cells])
    except ValueError:
        return np.array([_number(where, name, cell, line) for cell, line in zip(cells, lines, strict=True)])


def _number(where: str, name: str, cell: str, line: int) -> float:
    text = cell.strip()
    if not text or text.lower() in MISSING:
        return math.nan
    if _NUMBER.fullmatch(text):
        return float(text)
    must = "have a decimal point" if _NUMBER.fullmatch(text.replace(",", ".")) else "be a number (or blank: not received)"
    raise RecordingError(f"{where} {line}: column {name!r} is {cell!r}, must {must}")
