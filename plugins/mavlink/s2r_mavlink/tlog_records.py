"""Records of a telemetry log (`.tlog`, `.tlog.gz`), block by block, so that memory does not grow with the file.

    record = stamp (8 bytes, big-endian, microseconds of the logging computer's clock) and one whole frame

What is no record is skipped up to the next byte that begins a frame, and a last one that was cut is left out.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from s2r_mavlink.frames import LONGEST, V1, V2, header, length_at, whole
from s2r_runtime.errors import RecordingError
from s2r_runtime.recordings.formats.sizes import content_of

STAMP = 8
_BEGINS = re.compile(b"[" + re.escape(bytes([V1, V2])) + b"]")
STAMP_MAX_US = 1 << 53
"""In the year 2255."""
BLOCK = 1 << 20
RECORD_MAX = STAMP + LONGEST
AHEAD = RECORD_MAX + STAMP + 1
"""Bytes that show whether a record is one, and another follows."""


class Record(NamedTuple):
    """host_s: the logging computer's clock."""

    host_s: float
    system: int
    component: int
    number: int
    frame: bytes


def checked(frame: bytes) -> bool | None:
    """Whether the checksum holds; None for a message that the dialect does not have."""
    return whole(frame, 0, len(frame)) if header(frame).known else None


def records(path: Path, skipped: list[int], check: Callable[[bytes], bool | None] = checked) -> Iterator[Record]:
    """In the file's order. skipped: takes the number of bytes that are no record. check: of a frame, None if it cannot be checked: then
    it is one if another begins behind it, or the file ends. Raises RecordingError.
    """
    data, at, ended, lost = b"", 0, False, 0
    blocks = _blocks(path)
    while True:
        if not ended and len(data) - at < AHEAD:
            block = next(blocks, b"")
            ended = not block
            data, at = data[at:] + block, 0
            continue
        if len(data) - at <= STAMP:
            break
        start = at + STAMP
        size = length_at(data, start)
        frame = data[start : start + size] if size > 0 else b""
        good = check(frame) if frame and len(frame) == size else False
        if good or (good is None and _follows(data, start + size)):
            facts = header(frame)
            yield Record(int.from_bytes(data[at:start], "big") * 1e-6, facts.system, facts.component, facts.number, frame)
            at = start + size
        else:
            begins = _BEGINS.search(data, start + 1)
            place = (begins.start() if begins else len(data)) - STAMP
            at, lost = place, lost + place - at
    if lost := lost + len(data) - at:
        skipped.append(lost)


def _follows(data: bytes, end: int) -> bool:
    return end == len(data) or (end + STAMP < len(data) and data[end + STAMP] in (V1, V2))


def _blocks(path: Path) -> Iterator[bytes]:
    try:
        with content_of(path) as file:
            while block := file.read(BLOCK):
                yield block
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise RecordingError(f"{path}: is not a whole gzip file: {error}") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
