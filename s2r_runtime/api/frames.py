"""Tables of other libraries as tables of ours: pandas and polars DataFrames, and dicts of arrays. None of the libraries is imported.

Numbers become float64. Text is read as a cell of a CSV is. Dates become seconds since the first of them. What a library writes for "no
value" (NaN, None, NA, NaT) is *not received*. A pandas index counts as a column if it has a name; without one, an index of dates is `t`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from decimal import Decimal
from numbers import Real
from typing import Any

import numpy as np

from s2r_runtime.errors import RecordingError
from s2r_runtime.recordings.tables import SEGMENT, TIME, ArrayTable, Cells

NANOSECOND = np.timedelta64(1, "ns")


def is_frame(value: object) -> bool:
    """Whether it is a DataFrame, by what it offers."""
    return hasattr(value, "columns") and hasattr(value, "shape") and hasattr(value, "__getitem__")


def array_table(value: Any, name: str) -> ArrayTable:
    """A DataFrame, or a mapping of column names to one-dimensional arrays, as a table.

    name: how messages call it. The cells are copied. Raises RecordingError for columns of another shape or of different lengths, two
    columns of one name, and a name that is no text.
    """
    found: dict[str, Cells] = {}
    pairs = list(value.items() if isinstance(value, Mapping) else _columns(value))
    if unnamed := [column for column, _ in pairs if not isinstance(column, str)]:
        raise RecordingError(
            f"{name}: the column {unnamed[0]!r} has no name; columns must be named by text, as the model's states and inputs"
        )
    if twice := [(column, n) for column, n in Counter(column for column, _ in pairs).items() if n > 1]:
        raise RecordingError(f"{name}: column {twice[0][0]!r} is there {twice[0][1]} times, must be there once")
    for column, given in pairs:
        cells = _labels(given) if column == SEGMENT else _cells(given, column, name)
        if found and len(cells) != len(first := next(iter(found.values()))):
            raise RecordingError(
                f"{name}: column {column!r} has {len(cells)} rows, {next(iter(found))!r} has {len(first)}; must be of one length"
            )
        found[column] = cells
    return ArrayTable(name, found)


def _columns(frame: Any) -> Iterator[tuple[Any, Any]]:
    """Names and series, in order; of pandas with the index where it counts."""
    if hasattr(frame, "get_columns"):  # polars
        yield from zip(frame.columns, frame.get_columns(), strict=True)
        return
    index = getattr(frame, "index", None)
    kind = str(getattr(index, "dtype", ""))
    name = getattr(index, "name", None)
    name = TIME if name is None and kind.startswith(("datetime64", "timedelta64")) and TIME not in frame.columns else name
    if isinstance(name, str) and name not in frame.columns:
        yield name, index
    for k, column in enumerate(frame.columns):
        yield column, frame.iloc[:, k]


def _array(given: Any, column: str, where: str) -> np.ndarray[Any, Any]:
    kind = str(getattr(given, "dtype", ""))
    if kind.startswith("datetime64") and hasattr(given, "to_numpy"):
        values = given.to_numpy(dtype="datetime64[ns]")  # also with a time zone
    else:
        values = np.ma.filled(given.astype(np.float64), np.nan) if isinstance(given, np.ma.MaskedArray) else np.asarray(given)
    if values.ndim != 1:
        raise RecordingError(f"{where}: column {column!r} has the shape {values.shape}, must be (n,): one value a row")
    return np.asarray(values)


def _cells(given: Any, column: str, where: str) -> Cells:
    """Numbers, or text where there is anything else."""
    values = _array(given, column, where)
    if values.dtype.kind in "fiu":
        return np.array(values, dtype=np.float64)
    if values.dtype.kind in "mM":
        there = ~np.isnat(values)
        begin = values[there][0] if values.dtype.kind == "M" and there.any() else 0
        seconds = np.full(len(values), np.nan)
        seconds[there] = (values[there] - begin).astype("timedelta64[ns]") / (1e9 * NANOSECOND)
        return seconds
    cells = values.tolist()
    lacking = [_is_missing(cell) for cell in cells]
    if all(gone or (isinstance(cell, Real | Decimal) and not isinstance(cell, bool)) for cell, gone in zip(cells, lacking, strict=True)):
        return np.array([math.nan if gone else float(cell) for cell, gone in zip(cells, lacking, strict=True)], dtype=np.float64)
    return tuple("" if gone else str(cell) for cell, gone in zip(cells, lacking, strict=True))


def _labels(given: Any) -> tuple[str, ...]:
    """Labels of runs, as a file would have them."""
    return tuple("" if _is_missing(cell) else str(cell) for cell in _array(given, SEGMENT, "").tolist())


def _is_missing(cell: object) -> bool:
    return cell is None or type(cell).__name__ in {"NAType", "NaTType"} or (isinstance(cell, float) and math.isnan(cell))
