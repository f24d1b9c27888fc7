"""Logs that are no texts, through python-can's readers: Vector BLF, and python-can's SQLite database.

python-can's BLF reader unpacks whatever a container claims and does not end at an object of no size, so both are looked at before.
A database's `messages` must be a table, since a view could run for ever.
"""

from __future__ import annotations

import logging
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO

from s2r_can.records import LogFrame, frame_of
from s2r_can.tally import Tally
from s2r_runtime.errors import RecordingError, one_line
from s2r_runtime.recordings.formats.sizes import content_of

CONTAINER_MAX = 32 << 20
"""Bytes of a BLF container, unpacked: Vector's tools and python-can write 128 KiB."""
_OBJECT = struct.Struct("<4sHHII")
_HEADER = struct.Struct("<4sLBBBBBBBBQQLL8H8H")
_CONTAINER, _PACKED, _PREFIX = 10, 2, 16
_FRAMES = (1, 73, 86, 100, 101)
"""Object types that python-can reads: CAN_MESSAGE, CAN_ERROR_EXT, CAN_MESSAGE2, CAN_FD_MESSAGE, CAN_FD_MESSAGE_64."""


def blf(path: Path, tally: Tally) -> Iterator[LogFrame]:
    """A BLF's frames. One that was cut is read up to there. Raises RecordingError."""
    import can

    with content_of(path) as file:
        whole = _looked_through(path, file, tally)
    try:
        with _quiet(), content_of(path) as file:
            for message in can.BLFReader(file):
                frame = frame_of(message, message.timestamp)
                tally.frames += frame is not None
                if frame is None:
                    tally.left_out["frames that are damaged or have no time"] += 1
                else:
                    yield frame
    except Exception as error:  # noqa: BLE001 - its reader raises what it likes at bytes that are none of its own
        if not tally.frames or whole:
            said = one_line(str(error), 120) or type(error).__name__
            raise RecordingError(f"{path}: cannot be read as BLF after {tally.frames} frames: {said}") from None
    if not whole:
        tally.said.append(f"ends in the middle of an object: read up to there, {tally.frames} frames")
    if not tally.frames:
        raise RecordingError(f"{path}: holds no CAN frame{''.join(f'; {note}' for note in tally.notes())}")


def _looked_through(path: Path, file: IO[bytes], tally: Tally) -> bool:
    """Whether the file ends with a whole object. Counts objects that are no CAN frames."""
    head = file.read(_HEADER.size)
    if len(head) < _HEADER.size or not head.startswith(b"LOGG"):
        raise RecordingError(f"{path}: cannot be read as BLF: its header is not whole")
    file.read(max(0, min(int.from_bytes(head[4:8], "little"), 1 << 16) - len(head)))
    tail = b""
    while data := file.read(_OBJECT.size):
        if len(data) < _OBJECT.size:
            return False
        signature, _, _, size, kind = _OBJECT.unpack(data)
        if signature != b"LOBJ" or size < _OBJECT.size:
            raise RecordingError(f"{path}: cannot be read as BLF: it is damaged {file.tell() - len(data)} bytes from its beginning")
        body = file.read(size - _OBJECT.size)
        if kind == _CONTAINER:
            tail = _walk(path, tail + _unpacked(path, body), tally)
        if len(body) < size - _OBJECT.size:
            return False
        file.read(size % 4)
    return True


def _unpacked(path: Path, body: bytes) -> bytes:
    if int.from_bytes(body[:2], "little") != _PACKED:
        return body[_PREFIX:]
    unpacker = zlib.decompressobj()
    try:
        data = unpacker.decompress(body[_PREFIX:], CONTAINER_MAX)
    except zlib.error as error:
        raise RecordingError(f"{path}: cannot be read as BLF: {error}") from None
    if unpacker.unconsumed_tail:
        raise RecordingError(f"{path}: has a container of more than {CONTAINER_MAX >> 20} MiB, which is refused")
    return data


def _walk(path: Path, data: bytes, tally: Tally) -> bytes:
    """Looks at the objects in a container; returns the beginning of one that goes on in the next."""
    at = 0
    while True:
        found = data.find(b"LOBJ", at, at + 8)
        if found < 0 or found + _OBJECT.size > len(data):
            return data[at:]
        _, _, _, size, kind = _OBJECT.unpack_from(data, found)
        if size < _OBJECT.size or size > CONTAINER_MAX:
            raise RecordingError(f"{path}: cannot be read as BLF: an object of {size} bytes")
        if found + size > len(data):
            return data[at:]
        if kind not in _FRAMES:
            tally.left_out["objects that are no CAN frame"] += 1
        at = found + size


def sqlite(path: Path, tally: Tally) -> Iterator[LogFrame]:
    """Frames of a database that python-can wrote. Raises RecordingError."""
    import can

    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            found = database.execute("SELECT type FROM sqlite_master WHERE name = 'messages'").fetchall()
        if found != [("table",)]:
            raise RecordingError(f"{path}: has no table `messages`, as python-can writes it")
        reader = can.SqliteReader(path)
        try:
            for message in reader:
                frame = frame_of(message, message.timestamp)
                tally.frames += frame is not None
                if frame is None:
                    tally.left_out["frames that are damaged"] += 1
                else:
                    yield frame
        finally:
            reader.stop()
    except RecordingError:
        raise
    except Exception as error:  # noqa: BLE001 - of rows with other columns it raises what it likes
        said = one_line(str(error), 120) or type(error).__name__
        raise RecordingError(f"{path}: cannot be read as python-can's SQLite log after {tally.frames} frames: {said}") from None
    if not tally.frames:
        raise RecordingError(f"{path}: holds no CAN frame")


@contextmanager
def _quiet() -> Iterator[None]:
    """What python-can would print about a file is counted here."""
    logger = logging.getLogger("can.io")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)
