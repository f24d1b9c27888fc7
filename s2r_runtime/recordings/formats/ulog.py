"""PX4's ULog, through `pyulog`: each logged message is a topic (`battery_status`, its second instance `battery_status[1]`).

Stamps are the autopilot's, µs since it started. The library takes in the whole file (of the topics that are wanted), so size is bounded. A
file that was cut is read up to there; so is one with damage in it, as far as the library finds its way again, and that is said.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from s2r_runtime.errors import RecordingError, one_line
from s2r_runtime.recordings.formats.series import InMemory, Run, Samples, Topic
from s2r_runtime.recordings.formats.sizes import check_size

KIND = "PX4 ULog"
TIME = "timestamp"


class ULogFile:
    """`Opened` for a ULog."""

    kind = KIND
    drawn = False

    def __init__(self, path: Path) -> None:
        import pyulog

        self._path, self._library = path, pyulog
        self.notes: list[str] = []
        check_size(path)
        self._all: InMemory | None = None

    def topics(self) -> list[Topic]:
        """Every logged message with its numbers; padding is none."""
        self._all = self._all or self._loaded(None)
        return self._all.topics()

    def read(self, wanted: Mapping[str, Sequence[str]]) -> list[Run]:
        """Samples of the messages that are wanted."""
        names = sorted({name.partition("[")[0] for name in wanted})
        return (self._all or self._loaded(names)).read(wanted)

    def _loaded(self, names: list[str] | None) -> InMemory:
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # it prints what it thinks of damaged files
                log: Any = self._library.ULog(str(self._path), names)
        except MemoryError:
            raise RecordingError(f"{self._path}: does not fit into memory; a shorter log would") from None
        except Exception as error:  # noqa: BLE001 - it raises what it likes at bytes that are no ULog
            why = one_line(str(error), 120) or type(error).__name__
            raise RecordingError(f"{self._path}: this PX4 ULog cannot be read: {why}") from None
        self.notes = ["is damaged; what could not be read is left out"] if log.file_corruption else []
        samples = {name: self._samples(data) for data in log.data_list if TIME in data.data for name in [_name(data)]}
        if not samples:
            raise RecordingError(f"{self._path}: this PX4 ULog holds no logged message")
        return InMemory(KIND, [Run(samples)])

    @staticmethod
    def _samples(data: Any) -> Samples:
        kinds = {field.field_name: field.type_str for field in data.field_data}
        values = {
            name: column.astype(np.float64)
            for name, column in data.data.items()
            if name != TIME and not name.rpartition(".")[2].startswith("_padding") and kinds.get(name) != "char"
        }
        return Samples(data.data[TIME].astype(np.float64) * 1e-6, values)


def _name(data: Any) -> str:
    return data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
