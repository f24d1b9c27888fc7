"""Parquet files and folders of them (LeRobot data sets), through `pyarrow`: one table, read column by column and batch by batch.

    number             a field;  list of numbers: name[0], name[1], ... (LeRobot: observation.state[0], action[0]);  struct: name.field
    t, time, timestamp the stamps, s (a column of Arrow's type timestamp too); another one by --column t=NAME
    episode_index      each episode is a run of its own (ordinary driving)
    segment            runs that are samples of a campaign, as in a CSV (docs/recordings.md)

LeRobot: data/chunk-*/*.parquet in the order of their names; meta/info.json names the entries of a list (observation.state.shoulder_pan).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from s2r_runtime.errors import RecordingError, one_line
from s2r_runtime.modelspec import SEGMENT
from s2r_runtime.recordings.formats.series import Array, Run, Samples, Topic
from s2r_runtime.recordings.formats.sizes import check_packed, check_values

KIND = "Parquet table"
TIMES = ("t", "time", "timestamp", "Time", "stamp", "time_s", "timestamp_s")
EPISODE = "episode_index"
BATCH = 65_536
MAX_WIDTH = 256
"""Entries of a list; a longer one is an image."""
MAX_INFO_BYTES = 20_000_000


class _Column(NamedTuple):
    """How a field is read: the file's column, the struct's field in it or "", and the entry of the list (-1: it is none)."""

    column: str
    inner: str
    entry: int


class ParquetTable:
    """`Opened` for a file or a folder."""

    kind = KIND

    def __init__(self, path: Path) -> None:
        import pyarrow
        import pyarrow.compute
        import pyarrow.parquet

        self._arrow, self._path = pyarrow, path
        self.notes: list[str] = []
        self._files = _files(path)
        self._columns: dict[str, _Column] = {}
        with self._guarded(self._files[0]) as first:
            schema, rows = first.schema_arrow, first.metadata.num_rows
            check_packed(self._files[0], _unpacked_bytes(first, schema.names))
            head = next(first.iter_batches(batch_size=64), None) if rows else None
        for field in schema:
            self._add(field, None if head is None else head.column(schema.get_field_index(field.name)))
        self._add_names()
        self._time = next((name for name in TIMES if name in schema.names), "")
        self._labels = next((name for name in (SEGMENT, EPISODE) if name in schema.names), "")
        self.drawn = self._labels == SEGMENT
        if not self._columns:
            raise RecordingError(f"{path}: this Parquet file has no column of numbers; it has: {', '.join(schema.names[:12])}")

    def topics(self) -> list[Topic]:
        """One: the table."""
        runs = self.read({"": []})
        stamps = np.concatenate([run.samples[""].t for run in runs])
        whole = np.isfinite(stamps).any()
        note = "" if self._time else f"no column of stamps by a usual name ({', '.join(TIMES[:3])}): --column t=NAME"
        if len(runs) > 1 or self._labels:
            note = "; ".join(filter(None, [note, f"{len(runs)} runs, by {self._labels}"]))
        fields = dict.fromkeys((name for name in self._columns if name != self._labels), "")
        first, last = (float(np.nanmin(stamps)), float(np.nanmax(stamps))) if whole else (np.nan, np.nan)
        lasts = sum(float(np.ptp(run.samples[""].t)) for run in runs) if whole and len(runs) > 1 else 0.0
        return [Topic("", "table", len(stamps), first, last, fields, note, lasts)]

    def read(self, wanted: Mapping[str, Sequence[str]]) -> list[Run]:
        """Runs of the table."""
        names = list(wanted.get("", []))
        needed = list(dict.fromkeys([*(self._columns[name].column for name in names), *filter(None, (self._time, self._labels))]))
        parts: list[tuple[Array, list[str], list[Array]]] = []
        total = 0
        for path in self._files:
            with self._guarded(path) as file:
                check_packed(path, _unpacked_bytes(file, needed))
                total += file.metadata.num_rows * max(1, len(names))
                check_values(self._path, total)
                if missing := [name for name in needed if name not in file.schema_arrow.names]:
                    raise RecordingError(f"{path}: lacks the column {missing[0]!r}, which {self._files[0]} has")
                parts += [self._batch(batch, names) for batch in file.iter_batches(batch_size=BATCH, columns=needed or None)]
        if not parts:
            raise RecordingError(f"{self._path}: holds no row")
        t = np.concatenate([part[0] for part in parts])
        labels = [label for part in parts for label in part[1]]
        columns = {name: np.concatenate([part[2][place] for part in parts]) for place, name in enumerate(names)}
        return list(self._runs(t, labels, columns))

    def _batch(self, batch: Any, names: Sequence[str]) -> tuple[Array, list[str], list[Array]]:
        def column(name: str) -> Any:
            return batch.column(batch.schema.get_field_index(name))

        t = self._numbers(column(self._time)) if self._time else np.full(batch.num_rows, np.nan)
        labels = [str(one) for one in column(self._labels).to_pylist()] if self._labels else []
        return t, labels, [self._field(column(self._columns[name].column), self._columns[name]) for name in names]

    def _runs(self, t: Array, labels: list[str], columns: dict[str, Array]) -> Iterator[Run]:
        if not labels:
            yield Run({"": Samples(t, columns)})
            return
        edges = [0, *(k for k in range(1, len(labels)) if labels[k] != labels[k - 1]), len(labels)]
        seen: set[str] = set()
        for a, b in pairwise(edges):
            label = labels[a]
            if label in seen:
                raise RecordingError(f"{self._path}: {self._labels} {label} goes on after another one began; its rows must stand together")
            seen.add(label)
            name = label if self._labels == SEGMENT else f"episode {label}"
            yield Run({"": Samples(t[a:b], {one: values[a:b] for one, values in columns.items()})}, name)

    # ------------------------------------------------------------ columns

    def _add(self, field: Any, head: Any) -> None:
        """The fields of one column. head: its first rows."""
        types, kind = self._arrow.types, field.type
        if types.is_struct(kind):
            for inner in kind:
                if self._is_number(inner.type):
                    self._columns[f"{field.name}.{inner.name}"] = _Column(field.name, inner.name, -1)
        elif types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
            if self._is_number(kind.value_type):
                for entry in range(min(self._width(kind, head), MAX_WIDTH)):
                    self._columns[f"{field.name}[{entry}]"] = _Column(field.name, "", entry)
        elif self._is_number(kind):
            self._columns[field.name] = _Column(field.name, "", -1)

    def _width(self, kind: Any, head: Any) -> int:
        if self._arrow.types.is_fixed_size_list(kind):
            return int(kind.list_size)
        widths = self._arrow.compute.list_value_length(head).drop_null() if head is not None else []
        return int(max((int(one.as_py()) for one in widths), default=0))

    def _is_number(self, kind: Any) -> bool:
        types = self._arrow.types
        return bool(
            types.is_integer(kind)
            or types.is_floating(kind)
            or types.is_boolean(kind)
            or types.is_decimal(kind)
            or types.is_timestamp(kind)
        )

    def _numbers(self, column: Any) -> Array:
        """(N,) of a column of numbers or time stamps (s); NaN for null."""
        compute, types = self._arrow.compute, self._arrow.types
        kind, scale = column.type, 1.0
        if types.is_timestamp(kind):
            column, scale = compute.cast(column, self._arrow.int64()), {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        elif not self._is_number(kind):
            raise RecordingError(f"{self._path}: the column of stamps has the type {kind}, must be numbers in s")
        given = compute.cast(column, self._arrow.float64(), safe=False)
        return np.asarray(given.to_numpy(zero_copy_only=False), dtype=np.float64) * scale

    def _field(self, column: Any, how: _Column) -> Array:
        compute = self._arrow.compute
        if how.inner:
            return self._numbers(compute.struct_field(column, how.inner))
        if how.entry < 0:
            return self._numbers(column)
        longer = compute.fill_null(compute.greater(compute.list_value_length(column), how.entry), fill_value=False)
        found = np.full(len(column), np.nan)
        mask = longer.to_numpy(zero_copy_only=False).astype(bool)
        if mask.any():
            found[mask] = self._numbers(compute.list_element(column.filter(longer), how.entry))
        return found

    def _add_names(self) -> None:
        """What meta/info.json calls the entries of lists."""
        info = self._path / "meta" / "info.json"
        try:
            if not self._path.is_dir() or info.stat().st_size > MAX_INFO_BYTES:
                return
            features = json.loads(info.read_text(encoding="utf-8")).get("features", {})
        except (OSError, ValueError, AttributeError):
            return
        for feature, about in features.items() if isinstance(features, dict) else ():
            names = about.get("names") if isinstance(about, dict) else None
            while isinstance(names, dict) and names:
                names = next(iter(names.values()))
            for entry, name in enumerate(names if isinstance(names, list) else ()):
                field = f"{feature}[{entry}]"
                if isinstance(name, str) and field in self._columns:
                    self._columns.setdefault(f"{feature}.{name}", self._columns[field])

    def _guarded(self, path: Path) -> _Guarded:
        return _Guarded(self._arrow, path)


def _unpacked_bytes(file: Any, columns: Sequence[str]) -> int:
    """What the file says of these columns' size in memory."""
    groups = [file.metadata.row_group(index) for index in range(file.metadata.num_row_groups)]
    parts = [group.column(index) for group in groups for index in range(group.num_columns)]
    return sum(part.total_uncompressed_size for part in parts if part.path_in_schema.partition(".")[0] in columns)


class _Guarded:
    """A Parquet file that is open; what the library raises becomes one line."""

    def __init__(self, arrow: Any, path: Path) -> None:
        self._arrow, self._path, self._file = arrow, path, None

    def __enter__(self) -> Any:
        try:
            self._file = self._arrow.parquet.ParquetFile(self._path)
        except (OSError, ValueError, RuntimeError, MemoryError) as error:
            raise self._said(error) from None
        return self._file

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if self._file is not None:
            self._file.close()
        if isinstance(error, OSError | ValueError | RuntimeError | MemoryError | NotImplementedError) and not isinstance(
            error, RecordingError
        ):
            raise self._said(error) from None

    def _said(self, error: BaseException) -> RecordingError:
        if isinstance(error, MemoryError):
            return RecordingError(f"{self._path}: does not fit into memory")
        return RecordingError(f"{self._path}: this Parquet file cannot be read: {one_line(str(error), 120) or type(error).__name__}")


def _files(path: Path) -> list[Path]:
    """The file; of a folder its Parquet files, or those below data/, in the order of their names with numbers as numbers."""
    if not path.is_dir():
        return [path]
    found = list(path.glob("*.parquet")) or list(path.glob("data/**/*.parquet"))
    if not found:
        raise RecordingError(f"{path}: holds no Parquet file")
    return sorted(
        found, key=lambda one: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", one.relative_to(path).as_posix())]
    )


def open_parquet(path: Path) -> ParquetTable:
    """`Opened` for a Parquet file or a folder of them. Raises RecordingError."""
    return ParquetTable(path)
