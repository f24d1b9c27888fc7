"""Given inputs: a table of what to command, one row a period, as `s2r trace --suggest` writes it and `s2r sample --inputs` drives it.

A CSV with a header: `t` in s, and one column for each input of the model (named as in the model, or as the profile's `columns` map
it). Row k is held from t0 + k dt on, for one period. Every cell must be a number inside its input's bounds, every stamp on the model's
grid: exactly what is written is driven, or nothing is.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence

import msgspec

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.canonical import digest
from s2r_runtime.recordings.units import number_of

BYTES_MAX = 8 << 20
ROWS_MAX = 100_000
"""Almost an hour at 33 Hz. A sequence that long was not meant as one."""
OFF_GRID = 0.02
"""Of dt: stamps are printed with a few digits."""

Rows = tuple[tuple[float, ...], ...]


class GivenInputs(msgspec.Struct, frozen=True):
    """`digest`: of the file's bytes; text: those; rows: (nu,) each, in the model's order."""

    digest: str
    text: str
    rows: Rows


def parse_inputs(
    data: bytes, where: str, inputs: Sequence[str], bounds: Mapping[str, tuple[float, float]], dt: float, columns: Mapping[str, str]
) -> GivenInputs:
    """The inputs in a file. Raises ConfigError, one line: which row, which column, what it is and what it must be."""
    if len(data) > BYTES_MAX:
        raise ConfigError(f"{where}: has {len(data)} bytes, must have at most {BYTES_MAX}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{where}: is not UTF-8 text: {error.reason} at byte {error.start}") from None
    table = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        lines = [(table.line_num, row) for row in table if any(row)]
    except csv.Error as error:
        raise ConfigError(f"{where}: line {table.line_num}: not CSV: {error}") from None
    if not lines:
        raise ConfigError(f"{where}: is empty, must start with a header row")
    header = [name.strip() for name in lines[0][1]]
    places = _places(header, where, inputs, columns)
    if not 1 <= len(lines) - 1 <= ROWS_MAX:
        raise ConfigError(f"{where}: has {len(lines) - 1} rows, must have 1 to {ROWS_MAX}")
    rows: list[tuple[float, ...]] = []
    begin = 0.0
    for number, (line, cells) in enumerate(lines[1:]):
        at = f"{where}: line {line}"
        if len(cells) != len(header):
            raise ConfigError(f"{at}: has {len(cells)} cells, the header has {len(header)}")
        t, *u = (_number(cells[place], at, header[place]) for place in places)
        begin = t if number == 0 else begin
        if not abs(t - begin - number * dt) <= OFF_GRID * dt:
            raise ConfigError(f"{at}: t is {t:g} s, must be {begin + number * dt:g} s: one row a period of the model, {dt:g} s")
        for name, value in zip(inputs, u, strict=True):
            low, high = bounds[name]
            if not low <= value <= high:
                raise ConfigError(f"{at} (t {t:g} s): {name} is {value:g}, must be within its bounds {low:g} to {high:g}")
        rows.append(tuple(u))
    return GivenInputs(digest(data), text, tuple(rows))


def _places(header: list[str], where: str, inputs: Sequence[str], columns: Mapping[str, str]) -> list[int]:
    """Columns of t and of each input."""
    if wrong := [name for name in header if header.count(name) > 1]:
        raise ConfigError(f"{where}: column {wrong[0]!r} is there {header.count(wrong[0])} times, must be there once")
    names = ["t", *(name if name in header else columns.get(name, name) for name in inputs)]
    if missing := [name for name in names if name not in header]:
        raise ConfigError(f"{where}: lacks the column {missing[0]!r}; it must have t and one for each input: {', '.join(inputs)}")
    if extra := [name for name in header if name not in names]:
        raise ConfigError(f"{where}: has a column {extra[0]!r} that is no input of this model; its inputs: {', '.join(inputs)}")
    return [header.index(name) for name in names]


def _number(cell: str, at: str, name: str) -> float:
    try:
        value = number_of(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{at}: {name} is {cell.strip() or 'blank'}, must be a number")
    return value
