"""MATLAB files up to version 7, through `scipy.io`: vectors that share a length with a vector of stamps.

    x, y, v, t           vectors of one length: one table, with the stamps in `t` (or time, tout, timestamp)
    log.x, log.t         fields of a structure: a topic of their own; so are Simulink's structures with time (signals(k).values)
    pose (N, 3)          columns pose[0], pose[1], pose[2]

Version 7.3 is HDF5 and is not read. The library takes in a variable at once, so what a file claims is bounded before.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from s2r_runtime.errors import RecordingError, one_line
from s2r_runtime.recordings.formats.series import Array, InMemory, Run, Samples, Topic
from s2r_runtime.recordings.formats.sizes import check_packed, check_size, check_values

KIND = "MATLAB file"
TIMES = ("t", "time", "Time", "tout", "timestamp", "stamp", "T")
MAX_COLUMNS = 64
"""Of a matrix; a wider one is an image or a table of something else."""
MAX_DEPTH = 4
HEADER_BYTES, TAG_BYTES, VARIABLE, PACKED = 128, 8, 14, 15
"""Of version 5: text, version and byte order; then variables, each after its type (15: packed with zlib) and its size."""
NEWEST = b"MATLAB 7."
"""The first words of an HDF5 file by MATLAB: 7.3, and 7.0 before it."""


def open_matlab(path: Path) -> InMemory:
    """`Opened` for a MAT-file. Raises RecordingError."""
    from scipy import io
    from scipy.io.matlab import MatlabOpaque

    check_size(path)
    check_packed(path, _unpacked_bytes(path))
    with path.open("rb") as file:
        if file.read(len(NEWEST)) == NEWEST:
            raise RecordingError(f"{path}: this is a MATLAB file of version 7.3 (HDF5), which is not read; in MATLAB: save(FILE, '-v7')")
    try:
        check_values(path, sum(int(np.prod(shape, dtype=np.float64)) for _, shape, _ in _listed(path)))
        found = io.loadmat(path, struct_as_record=False, squeeze_me=True, chars_as_strings=True)
    except RecordingError:
        raise
    except MemoryError:
        raise RecordingError(f"{path}: does not fit into memory") from None
    except Exception as error:  # noqa: BLE001 - it raises what it likes at bytes that are no MAT-file
        raise RecordingError(f"{path}: this MATLAB file cannot be read: {one_line(str(error), 120) or type(error).__name__}") from None
    samples: dict[str, Samples] = {}
    unusable: list[Topic] = []
    for name, table in _tables({key: value for key, value in found.items() if not key.startswith("__")}, "", 0):
        stamps = next((one for one in TIMES if one in table and table[one].ndim == 1), None)
        if stamps is None:
            listed_names = ", ".join(list(table)[:8])
            unusable.append(Topic(name, "", 0, float("nan"), float("nan"), {}, f"no vector of stamps (t or time) beside {listed_names}"))
            continue
        t = table.pop(stamps)
        fields = {field: values for one, array in table.items() for field, values in _columns(one, array, len(t))}
        if fields:
            samples[name] = Samples(t, fields)
    objects = any(isinstance(value, MatlabOpaque) for value in found.values())
    note = "objects of MATLAB classes (string, datetime, table, timetable) are not read; save numbers: x = tab.x" if objects else ""
    if not samples and not unusable:
        raise RecordingError(f"{path}: this MATLAB file holds no series: neither vectors nor structures of them" + (note and f"; {note}"))
    return InMemory(KIND, [Run(samples)], unusable=unusable, notes=[note] if note else [])


def _unpacked_bytes(path: Path) -> int:
    """What a version 5 file says of the size of its packed variables: their first tag is unpacked, before the library unpacks more."""
    total = 0
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
        order = "<" if head.endswith(b"IM") else ">"
        while head.startswith(b"MATLAB 5") and len(tag := file.read(TAG_BYTES)) == TAG_BYTES:
            kind, size = struct.unpack(f"{order}II", tag)
            if kind not in (VARIABLE, PACKED) or not size:
                break
            if kind == PACKED:
                after = file.tell() + size
                with contextlib.suppress(zlib.error, struct.error):  # its reader says what is wrong
                    total += struct.unpack(f"{order}II", zlib.decompressobj().decompress(file.read(min(size, 1024)), TAG_BYTES))[1]
                file.seek(after)
            else:
                file.seek(size, os.SEEK_CUR)
    return total


def _listed(path: Path) -> Sequence[tuple[str, tuple[int, ...], str]]:
    """(name, shape, class) of the variables; none where SciPy cannot list them, as with objects of a class: then the memory of the
    reader's process is what bounds them.
    """
    from scipy import io

    try:
        return io.whosmat(path)  # type: ignore[no-any-return]
    except TypeError:
        return ()


def _tables(values: dict[str, Any], name: str, depth: int) -> Iterator[tuple[str, dict[str, Array]]]:
    """Numeric arrays that stand side by side, structure by structure."""
    numbers = {key: np.asarray(value, dtype=np.float64) for key, value in values.items() if _is_numeric(value)}
    with_time = "time" in numbers and "signals" in values  # Simulink: structure with time
    if with_time:
        for place, one in enumerate(np.atleast_1d(values["signals"])):
            fields = _fields_of(one)
            if _is_numeric(fields.get("values")):
                numbers[str(fields.get("label") or f"signals[{place}]")] = np.asarray(fields["values"], dtype=np.float64)
    if numbers:
        yield name, numbers
    for key, value in values.items() if depth < MAX_DEPTH else ():
        inner = {} if with_time and key == "signals" else _fields_of(value)
        if inner:
            yield from _tables(inner, f"{name}.{key}" if name else key, depth + 1)


def _fields_of(value: Any) -> dict[str, Any]:
    names = getattr(value, "_fieldnames", None)
    return {name: getattr(value, name) for name in names} if names else {}


def _is_numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.ndim in (1, 2) and value.size > 1


def _columns(name: str, array: Array, n: int) -> Iterator[tuple[str, Array]]:
    """Columns of an array whose rows (or, if not, columns) are as many as there are stamps."""
    if array.ndim == 1:
        if len(array) == n:
            yield name, array
        return
    if array.shape[0] != n and array.shape[1] == n:
        array = array.T
    if array.shape[0] == n and array.shape[1] <= MAX_COLUMNS:
        for column in range(array.shape[1]):
            yield f"{name}[{column}]", array[:, column]
