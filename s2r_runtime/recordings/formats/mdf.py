"""MF4 and MDF 3 measurement files, through `asammdf`: a channel group is a topic (by its name, else `group0`), its channels are fields.

Stamps are the group's master channel, s. Physical values, in the units that the file states; enumerations keep their numbers. The library
takes in a group at once, so what a file claims is bounded before. A group of raw CAN or LIN frames has no signals: extract them first
(`asammdf`: extract_bus_logging, with the DBC).
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from s2r_runtime.errors import RecordingError, one_line
from s2r_runtime.recordings.formats.series import Array, Run, Samples, Topic
from s2r_runtime.recordings.formats.sizes import check_size, check_values

KIND = "MF4 measurement file"
BUS = ("CAN_DataFrame", "LIN_Frame", "FLX_Frame")


class MeasurementFile:
    """`Opened` for an MDF file."""

    kind = KIND
    drawn = False

    def __init__(self, path: Path) -> None:
        self.notes: list[str] = []
        self._path = path
        check_size(path)
        with _quiet(path):
            import asammdf

            self._file: Any = _with_silent_end(asammdf).MDF(path)
            self._places = dict(self._named())

    def topics(self) -> list[Topic]:
        """Channel groups; the first and the last stamp are read, and the first value of each channel for its type."""
        return [self._topic(name, place) for name, place in self._places.items()]

    def read(self, wanted: Mapping[str, Sequence[str]]) -> list[Run]:
        """Whole channels."""
        samples = {}
        for name, fields in wanted.items():
            place = self._places[name]
            indices = self._channels(place)
            check_values(self._path, self._cycles(place) * (1 + len(fields)))
            with _quiet(self._path):
                found = self._selected([indices[field] for field in fields], place)
                t = np.asarray(self._file.get_master(place), dtype=np.float64)
                values = {field: _values(one) for field, one in zip(fields, found, strict=True)}
            if any(len(one) != len(t) for one in values.values()):
                raise RecordingError(f"{self._path}: this MF4 (ASAM MDF) file cannot be read: {name} has fewer values than stamps")
            samples[name] = Samples(t, values)
        return [Run(samples)]

    def _named(self) -> Iterator[tuple[str, int]]:
        taken: set[str] = set()
        for place, group in enumerate(self._file.groups):
            about = group.channel_group
            name = str(getattr(about, "acq_name", "") or "").strip() or f"group{place}"
            if name in taken:
                name = f"{name}[{place}]"
            taken.add(name)
            yield name, place

    def _cycles(self, place: int) -> int:
        return int(self._file.groups[place].channel_group.cycles_nr)

    def _channels(self, place: int) -> dict[str, int]:
        """Field -> index; of two channels of one name the first one."""
        master = self._file.masters_db.get(place)
        found: dict[str, int] = {}
        for index, channel in enumerate(self._file.groups[place].channels):
            if index != master:
                found.setdefault(channel.name, index)
        return found

    def _selected(self, indices: Sequence[int], place: int, count: int | None = None) -> list[Any]:
        asked = [(None, place, index) for index in indices]
        return list(self._file.select(asked, ignore_value2text_conversions=True, record_count=count, copy_master=False)) if asked else []

    def _topic(self, name: str, place: int) -> Topic:
        n, indices = self._cycles(place), self._channels(place)
        nothing = Topic(name, "channel group", n, float("nan"), float("nan"), {})
        if any(bus in indices for bus in BUS):
            return nothing._replace(note="raw bus frames, no signals: extract them with the DBC first (asammdf: extract_bus_logging)")
        if not n:
            return nothing._replace(note="empty")
        check_values(self._path, n)
        with _quiet(self._path):
            first = float(self._file.get_master(place, record_offset=0, record_count=1)[0])
            last = float(self._file.get_master(place, record_offset=n - 1, record_count=1)[0])
            heads = self._selected(list(indices.values()), place, 1)
        fields = {
            field: str(one.unit or "")
            for field, one in zip(indices, heads, strict=True)
            if one.samples.dtype.kind in "biuf" and one.samples.ndim == 1
        }
        return Topic(name, "channel group", n, first, last, fields, "" if fields else "no channel of numbers")


def _values(signal: Any) -> Array:
    values = np.asarray(signal.samples, dtype=np.float64)
    invalid = getattr(signal, "invalidation_bits", None)
    if invalid is not None and len(invalid) == len(values):
        values = np.where(np.asarray(invalid, dtype=bool), np.nan, values)
    return values


@contextlib.contextmanager
def _quiet(path: Path) -> Iterator[None]:
    """What the library raises at bytes that are no MDF becomes one line, and what it prints and warns of nothing."""
    logger = logging.getLogger("asammdf")
    before, logger.disabled = logger.disabled, True
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    except (RecordingError, ImportError):
        raise
    except MemoryError:
        raise RecordingError(f"{path}: does not fit into memory") from None
    except Exception as error:  # noqa: BLE001 - as above
        why = one_line(str(error), 120) or type(error).__name__
        raise RecordingError(f"{path}: this MF4 (ASAM MDF) file cannot be read: {why}") from None
    finally:
        logger.disabled = before


def _with_silent_end(library: Any) -> Any:
    """The library, whose objects do not complain on stderr when they end after a failed start (`__del__` assumes that `__init__`
    has ended: 8.8).
    """
    from asammdf.blocks import mdf_v3, mdf_v4

    for kind in (mdf_v3.MDF3, mdf_v4.MDF4):
        end = getattr(kind, "__del__", None)
        if end is not None and not hasattr(end, "silent"):

            def silent(self: Any, end: Any = end) -> None:
                with contextlib.suppress(Exception):
                    end(self)

            silent.silent = True  # type: ignore[attr-defined]
            kind.__del__ = silent  # type: ignore[method-assign]
    return library


def open_mdf(path: Path) -> MeasurementFile:
    """`Opened` for an MDF file. Raises RecordingError."""
    return MeasurementFile(path)
