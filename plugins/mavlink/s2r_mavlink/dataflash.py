"""ArduPilot's DataFlash logs (`.bin`, or as text) as named time series (hook `s2r_formats`), through pymavlink's reader.

Each message is a topic; one that has instances is a topic an instance (`IMU[0]`, `IMU[1]`). Stamps are the autopilot's, `TimeUS` (older
logs: `TimeMS`). The library finds the messages, their formats and units; their numbers are taken from the mapped file, a type at a time, so
memory holds where each message is and the numbers that are wanted. A log that was cut is read up to there, damage in it is passed over.
"""

from __future__ import annotations

import contextlib
import io
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from s2r_runtime.errors import RecordingError, one_line
from s2r_runtime.recordings.formats.series import Array, Run, Samples, Topic
from s2r_runtime.recordings.formats.sizes import check_size

KIND = "ArduPilot DataFlash log"
HEADER = b"\xa3\x95"
SELF = HEADER + b"\x80"
SHORTEST = 3
"""Bytes of a message at least: its header. The library never ends on a shorter one."""
KINDS = {
    "b": "i1", "B": "u1", "M": "i1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8",
    "g": "<f2", "f": "<f4", "d": "<f8", "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4",
    "n": "S4", "N": "S16", "Z": "S64", "a": "V64",
}  # fmt: skip
"""Letter of a format -> how it is stored (libraries/AP_Logger/README.md)."""
TEXTS = "nNZa"
TIMES = {"TimeUS": 1e-6, "TimeMS": 1e-3}
ATTITUDE = {"Roll": "deg", "Pitch": "deg", "Yaw": "deg"}
OLD_UNITS = {"ATT": ATTITUDE, "AHR2": ATTITUDE, "EKF1": ATTITUDE, "NKF1": ATTITUDE, "XKF1": ATTITUDE}
"""Of messages in logs that state none (before 2018)."""
BLOCK = 65_536


class DataFlashLog:
    """`Opened` for a DataFlash log."""

    kind = KIND
    drawn = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self.notes: list[str] = []
        check_size(path)
        self._text = _is_text(path)
        if not self._text:
            _check_lengths(path)
        with _quiet(path):
            from pymavlink import DFReader

            self._log: Any = (DFReader.DFReader_text if self._text else DFReader.DFReader_binary)(str(path))
        self._formats: dict[str, Any] = {one.name: one for one in self._log.formats.values() if _time_of(one)}

    def topics(self) -> list[Topic]:
        """Messages with a stamp."""
        found = []
        for name, form in sorted(self._formats.items()):
            for topic, samples in sorted(self._samples(name, form, []).items()):
                fields = {} if not len(samples.t) else _fields(form)
                first, last = (float(samples.t.min()), float(samples.t.max())) if len(samples.t) else (float("nan"),) * 2
                found.append(Topic(topic, "DataFlash message", len(samples.t), first, last, fields))
        if not found:
            raise RecordingError(f"{self._path}: this ArduPilot DataFlash log holds no message with a stamp")
        return found

    def read(self, wanted: Mapping[str, Sequence[str]]) -> list[Run]:
        """Samples of these messages."""
        found = {}
        for topic, fields in wanted.items():
            name = topic.partition("[")[0]
            samples = self._samples(name, self._formats[name], fields)
            if topic in samples:
                found[topic] = samples[topic]
        return [Run(found)]

    def _samples(self, name: str, form: Any, fields: Sequence[str]) -> dict[str, Samples]:
        """Message, or message[instance] -> samples."""
        time = _time_of(form)
        columns = [time, *fields, *([form.instance_field] if form.instance_field else [])]
        numbers = self._by_message(name, columns) if self._text else self._by_format(form, columns)
        t = numbers[0] * TIMES[time]
        values = dict(zip(fields, numbers[1:], strict=False))
        if not form.instance_field:
            return {name: Samples(t, values)} if len(t) else {}
        found = {}
        for instance in np.unique(numbers[-1]).tolist():
            rows = numbers[-1] == instance
            found[f"{name}[{instance:.0f}]"] = Samples(t[rows], {field: column[rows] for field, column in values.items()})
        return found

    def _by_format(self, form: Any, columns: Sequence[str]) -> list[Array]:
        """Columns of all messages of a type, from the mapped file."""
        stored = np.dtype([(f"c{place}", KINDS[letter]) for place, letter in enumerate(form.format)])
        places = [form.colhash[name] for name in columns]
        found: list[list[Array]] = [[np.empty(0)] for _ in columns]
        if stored.itemsize != form.len - SHORTEST:
            return [np.empty(0) for _ in columns]
        data = np.frombuffer(self._log.data_map, dtype=np.uint8)
        offsets = np.asarray(self._log.offsets[form.type], dtype=np.int64)
        offsets = offsets[offsets + form.len <= len(data)] + SHORTEST
        for k in range(0, len(offsets), BLOCK):
            rows = data[offsets[k : k + BLOCK, None] + np.arange(stored.itemsize)]
            block = np.ascontiguousarray(rows).view(stored)[:, 0]
            for column, place in zip(found, places, strict=True):
                multiplier = form.msg_mults[place]
                values = block[f"c{place}"].astype(np.float64)
                column.append(values / (1.0 / multiplier) if multiplier else values)
        return [np.concatenate(column) for column in found]

    def _by_message(self, name: str, columns: Sequence[str]) -> list[Array]:
        """The same of a log as text."""
        found = [array("d") for _ in columns]
        with _quiet(self._path):
            self._log.rewind()
            while (message := self._log.recv_match(type=[name])) is not None:
                for column, one in zip(found, columns, strict=True):
                    column.append(float(getattr(message, one)))
        return [np.array(column) for column in found]


def _time_of(form: Any) -> str:
    return next((name for name in TIMES if name in form.columns), "")


def _fields(form: Any) -> dict[str, str]:
    """Numbers of a message -> units, as the values come out of the library."""
    found = {}
    old = OLD_UNITS.get(form.name, {}) if form.units is None else {}
    for place, name in enumerate(form.columns):
        if name in TIMES or name == form.instance_field or place >= len(form.format) or form.format[place] in TEXTS:
            continue
        found[name] = str(form.units[place]) if form.units is not None else old.get(name, "")
    return found


def _is_text(path: Path) -> bool:
    with path.open("rb") as file:
        return not file.read(2).startswith(HEADER)


def _check_lengths(path: Path) -> None:
    """Raises RecordingError for a log that describes a message without a length: the library would not come to an end."""
    import mmap

    with path.open("rb") as file, contextlib.closing(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)) as data:
        at = data.find(SELF)
        while 0 <= at < len(data) - 5:
            if data[at + 4] < SHORTEST:
                raise RecordingError(f"{path}: this ArduPilot DataFlash log is damaged: it describes a message of {data[at + 4]} bytes")
            at = data.find(SELF, at + 3)


@contextlib.contextmanager
def _quiet(path: Path) -> Iterator[None]:
    """What the library raises at bytes that are no log becomes one line, and what it prints nothing."""
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    except (RecordingError, ImportError):
        raise
    except MemoryError:
        raise RecordingError(f"{path}: does not fit into memory") from None
    except Exception as error:  # noqa: BLE001 - as above
        why = one_line(str(error), 120) or type(error).__name__
        raise RecordingError(f"{path}: this ArduPilot DataFlash log cannot be read: {why}") from None


def open_dataflash(path: Path) -> DataFlashLog:
    """`Opened` for a DataFlash log. Raises RecordingError."""
    return DataFlashLog(path)
