"""CSV that SavvyCAN and GVRET loggers write: `Time Stamp,ID,Extended,Dir,Bus,LEN,D1,...,D8`, columns by their names.

Time Stamp is in microseconds, or in seconds where it has a decimal point. ID and bytes are hexadecimal; bytes beyond LEN do not count.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from s2r_can.records import EXTENDED, PAYLOAD_MAX, STAMP_MAX, LogFrame
from s2r_can.tally import Tally
from s2r_runtime.errors import RecordingError

NEEDED = ("time stamp", "id", "extended", "len", "d1")
_STAMP = re.compile(r"-?\d{1,18}(\.\d{0,12})?", re.ASCII)
_HEX = re.compile(r"(?:0[xX])?([0-9A-Fa-f]{1,8})")
_BYTE = re.compile(r"[0-9A-Fa-f]{1,2}")
_FLAGS = {"true": True, "1": True, "false": False, "0": False}


def is_header(line: str) -> bool:
    """Whether a line is the header of such a file."""
    return set(NEEDED) <= set(_names(line))


def frames(path: Path, lines: Iterator[tuple[int, str]], tally: Tally) -> Iterator[LogFrame]:
    """The frames, in the log's order. lines: (number, text with its end). Raises RecordingError."""
    names = _names(next(lines, (0, ""))[1])
    if not set(NEEDED) <= set(names):
        raise RecordingError(f"{path}: is no SavvyCAN log: its header must have the columns {', '.join(NEEDED)}")
    places = {name: place for place, name in enumerate(names)}
    number = 1
    for number, line in lines:
        if not line.strip():
            continue
        if not line.endswith("\n"):
            tally.left_out["line that was cut at the log's end"] += 1
            continue
        frame = _frame([cell.strip() for cell in line.split(",")], places)
        if frame is None:
            tally.unreadable(number, line)
        else:
            tally.frames += 1
            yield frame
    tally.check(path, "SavvyCAN", number)


def _names(line: str) -> list[str]:
    return [name.strip().lower() for name in line.split(",")]


def _frame(cells: list[str], places: dict[str, int]) -> LogFrame | None:
    """A line's frame; None for one that is none."""

    def cell(name: str) -> str:
        place = places.get(name, len(cells))
        return cells[place] if place < len(cells) else ""

    stamp, identifier, extended, length = cell("time stamp"), _HEX.fullmatch(cell("id")), _FLAGS.get(cell("extended").lower()), cell("len")
    if not _STAMP.fullmatch(stamp) or identifier is None or extended is None or not re.fullmatch(r"\d{1,2}", length, re.ASCII):
        return None
    t = float(stamp) if "." in stamp else 1e-6 * int(stamp)
    key, size = int(identifier[1], 16), int(length)
    data = [cell(f"d{k + 1}") for k in range(size)]
    if key > (0x1FFFFFFF if extended else 0x7FF) or size > PAYLOAD_MAX or abs(t) > STAMP_MAX or not all(map(_BYTE.fullmatch, data)):
        return None
    return LogFrame(t, cell("bus") or "0", key | EXTENDED if extended else key, bytes(int(one, 16) for one in data))
