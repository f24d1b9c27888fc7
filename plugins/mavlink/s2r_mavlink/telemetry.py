"""Telemetry logs (`.tlog`) as named time series (hook `s2r_formats`): every message that the log holds, with its numbers and units.

Each message is a topic. One with several senders is a topic a sender (`ATTITUDE[1:1]`: system, component), one with instances a topic an
instance (`BATTERY_STATUS[0]`, `NAMED_VALUE_FLOAT[volts]`). Layouts and units are those of pymavlink's dialect `ardupilotmega`, which has
`common` in it. So are the values that mean that there is none (65535 for `hdg`): they are missing. Stamps are the logging computer's; a
message with `time_boot_ms` has its sender's, too. Two passes: what there is, then the numbers that are wanted.
"""

from __future__ import annotations

import math
import re
import struct
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from fastcrc.crc16 import mcrf4xx as crc16

from s2r_mavlink.frames import header, payload
from s2r_mavlink.tlog_records import Record, checked, records
from s2r_runtime.errors import RecordingError
from s2r_runtime.recordings.formats.series import Array, Run, Samples, Topic
from s2r_runtime.recordings.formats.sizes import check_values

KIND = "MAVLink telemetry log"
TIMES = ("time_boot_ms", "time_usec", "time_unix_usec")
BOOT = "time_boot_ms"
DEFINITIONS = ("minimal", "standard", "common", "ardupilotmega")
NO_VALUE = re.compile(r"\[?(U?)INT(\d+)_MAX\]?")
"""How a definition writes that a number is none, of a field or of each element of one."""
Sender = tuple[str, int, int, str]
"""(message, system, component, instance)."""


class Layout(NamedTuple):
    """A message: its numbers in wire order, arrays flat (`q[0]`), None for text. units: of the numbers that are signals."""

    name: str
    unpacker: struct.Struct
    columns: tuple[str | None, ...]
    units: Mapping[str, str]
    instance: str
    crc_extra: int

    def values(self, content: bytes) -> tuple[Any, ...]:
        """In the order of `columns`. Missing bytes are zeros that the sender left out."""
        size = self.unpacker.size
        return self.unpacker.unpack(content[:size].ljust(size, b"\0"))


@dataclass
class _Seen:
    n: int = 0
    first_s: float = math.inf
    last_s: float = -math.inf


class TelemetryLog:
    """`Opened` for a telemetry log."""

    kind = KIND
    drawn = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: dict[Sender, _Seen] = {}
        skipped: list[int] = []
        unknown: Counter[int] = Counter()
        for record in records(path, skipped, _whole):
            layout = layouts().get(record.number)
            if layout is None:
                unknown[record.number] += 1
                continue
            seen = self._seen.setdefault(_sender(layout, record), _Seen())
            seen.n += 1
            seen.first_s, seen.last_s = min(seen.first_s, record.host_s), max(seen.last_s, record.host_s)
        if not self._seen:
            raise RecordingError(f"{path}: holds no MAVLink message that is known here, must be a telemetry log (.tlog)")
        self._names = _names(list(self._seen))
        self.notes = [f"{sum(skipped)} bytes are no record of a telemetry log and left out"] if skipped else []
        if unknown:
            listed = ", ".join(f"{number} ({n})" for number, n in sorted(unknown.items())[:8])
            self.notes.append(f"{sum(unknown.values())} messages of other dialects are left out, by their numbers: {listed}")

    def topics(self) -> list[Topic]:
        """Messages, by name."""
        by_name = {layout.name: layout for layout in layouts().values()}
        return [
            Topic(name, "MAVLink message", seen.n, seen.first_s, seen.last_s, by_name[sender[0]].units)
            for name, sender, seen in sorted((self._names[sender], sender, seen) for sender, seen in self._seen.items())
        ]

    def read(self, wanted: Mapping[str, Sequence[str]]) -> list[Run]:
        """Samples of these messages."""
        sought = {sender: name for sender, name in self._names.items() if name in wanted}
        check_values(self._path, sum(self._seen[sender].n * (len(wanted[name]) + 2) for sender, name in sought.items()))
        columns = {name: [array("d") for _ in range(len(wanted[name]) + 2)] for name in sought.values()}
        numbers = {number for number, layout in layouts().items() if any(layout.name == sender[0] for sender in sought)}
        for record in records(self._path, [], _whole):
            if record.number not in numbers:
                continue
            layout = layouts()[record.number]
            name = sought.get(_sender(layout, record))
            if name is None:
                continue
            values = dict(zip(layout.columns, layout.values(payload(record.frame)), strict=True))
            row = (record.host_s, values.get(BOOT, math.nan) * 1e-3, *(values[field] for field in wanted[name]))
            for column, value in zip(columns[name], row, strict=True):
                column.append(value)
        found = {}
        messages = {name: sender[0] for sender, name in sought.items()}
        for name, (host, boot, *series) in columns.items():
            stamps = np.array(boot)
            fields = {field: _known(messages[name], field, np.array(one)) for field, one in zip(wanted[name], series, strict=True)}
            found[name] = Samples(
                np.array(host), fields, stamps if len(stamps) and np.ptp(stamps) > 0.0 else None
            )  # senders without a clock say 0
        return [Run(found)]


@cache
def layouts() -> dict[int, Layout]:
    """By message number."""
    from pymavlink.dialects.v20 import ardupilotmega

    return {number: _layout(message) for number, message in ardupilotmega.mavlink_map.items()}


def _known(message: str, field: str, values: Array) -> Array:
    """NaN where the dialect says that a value is none."""
    none = _no_values().get((message, field.partition("[")[0]))
    return values if none is None else np.where(values == none, math.nan, values)


@cache
def _no_values() -> dict[tuple[str, str], float]:
    """(message, field) -> the value that means that there is none, by the definitions that pymavlink is made from."""
    from xml.etree import ElementTree

    from pymavlink.dialects import v20

    found = {}
    for name in DEFINITIONS:
        path = Path(v20.__path__[0]) / f"{name}.xml"
        for message in ElementTree.parse(path).iter("message") if path.exists() else ():  # noqa: S314 - of an installed package
            for field in message.iter("field"):
                none = NO_VALUE.fullmatch(field.get("invalid", ""))
                if none is not None:
                    sign, bits = none.groups()
                    found[message.get("name", ""), field.get("name", "")] = float(2 ** (int(bits) - (not sign)) - 1)
    return found


def _layout(message: Any) -> Layout:
    columns: list[str | None] = []
    units: dict[str, str] = {}
    letters = message.native_format.decode()[1:]
    for name, letter, length in zip(message.ordered_fieldnames, letters, message.array_lengths, strict=True):
        if letter == "c":
            columns.append(None if name != message.instance_field else name)
            continue
        names = [f"{name}[{k}]" for k in range(length)] if length else [name]
        columns += names
        if name not in TIMES and name != message.instance_field:
            units |= dict.fromkeys(names, message.fieldunits_by_name.get(name, ""))
    return Layout(message.msgname, message.unpacker, tuple(columns), units, message.instance_field or "", message.crc_extra)


def _sender(layout: Layout, record: Record) -> Sender:
    if not layout.instance:
        return layout.name, record.system, record.component, ""
    value = layout.values(payload(record.frame))[layout.columns.index(layout.instance)]
    text = value.split(b"\0")[0].decode("ascii", "replace").strip() if isinstance(value, bytes) else str(value)
    return layout.name, record.system, record.component, text


def _names(senders: Sequence[Sender]) -> dict[Sender, str]:
    """Topics: the message, the sender where several send it, the instance."""
    nodes: dict[str, set[tuple[int, int]]] = {}
    for message, system, component, _ in senders:
        nodes.setdefault(message, set()).add((system, component))
    return {
        sender: sender[0] + (f"[{sender[1]}:{sender[2]}]" if len(nodes[sender[0]]) > 1 else "") + (f"[{sender[3]}]" if sender[3] else "")
        for sender in senders
    }


def _whole(frame: bytes) -> bool | None:
    """Whether the checksum holds, of all messages of this dialect."""
    layout = layouts().get(header(frame).number)
    if layout is None:
        return checked(frame)
    end = (10 if frame[0] == 0xFD else 6) + frame[1]
    return bool(crc16(frame[1:end] + bytes([layout.crc_extra])) == frame[end] | frame[end + 1] << 8)


def open_tlog(path: Path) -> TelemetryLog:
    """`Opened` for a telemetry log. Raises RecordingError."""
    return TelemetryLog(path)
