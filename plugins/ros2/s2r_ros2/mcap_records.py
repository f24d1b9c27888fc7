"""The messages of an MCAP file, from its start, as far as it holds: no index is needed (https://mcap.dev/spec).

    magic 8, then records: opcode u8, length u64, content                    little endian; texts are length u32, bytes
    schema   id u16, name, encoding, data       channel  id u16, schema u16, topic, encoding, metadata
    message  channel u16, sequence u32, log time u64, publish time u64, data
    chunk    first and last time u64, uncompressed size u64, CRC-32 u32, compression ("", zstd, lz4), length u64, records

A file that ends inside a record is read up to there, and so is a chunk that ends inside its compressed data. A chunk in the middle that
does not decompress, or whose CRC (where it has one: rosbag2 writes none) is wrong, is left out and counted. rosbag2's own choices:
ros2/rosbag2, rosbag2_storage_mcap/src/mcap_storage.cpp (profile ros2, encoding cdr, schema encoding ros2msg, log time = publish time =
reception).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Container, Iterator
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard

from s2r_ros2.records import Channel, Definition, Message, kind_of, unpacked
from s2r_runtime.errors import RecordingError
from s2r_runtime.recordings.formats.sizes import content_of

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 3, 4, 5, 6, 15
RECORD_MAX = 1 << 30
"""Bytes of a record or of a chunk's content at most: what is longer is taken for damage."""
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
GZIP, ZSTD = b"\x1f\x8b", b"\x28\xb5\x2f\xfd"


class Bag:
    """An MCAP file that is being read (`records.Messages`); `broken`: chunks left out, and payloads that do not unpack."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: dict[Channel, int] = {}
        self.definitions: dict[str, Definition] = {}
        self.broken = 0
        self.cut = False
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        self._only: Container[str] | None = None

    def messages(self, only: Container[str] | None = None) -> Iterator[Message]:
        """Messages of these topics (None: of all), in the file's order. Raises RecordingError for what is no MCAP file."""
        self._only = only
        try:
            with content_of(self.path) as file:
                if file.read(len(MAGIC)) != MAGIC:
                    raise RecordingError(f"{self.path}: is not an MCAP file")
                yield from self._records(file)
        except (OSError, EOFError, zlib.error, zstandard.ZstdError) as error:
            if not self.counts:
                raise RecordingError(f"{self.path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
            self.cut = True

    def _records(self, file: BinaryIO) -> Iterator[Message]:
        while True:
            head = file.read(_RECORD.size)
            if len(head) < _RECORD.size:
                self.cut = True
                return
            opcode, length = _RECORD.unpack(head)
            if opcode == DATA_END:
                return
            if length > RECORD_MAX or opcode == 0:
                self.cut = True
                return
            content = file.read(length)
            whole = len(content) == length
            if opcode == CHUNK:
                yield from self._chunk(content, whole=whole)
            elif whole:
                yield from self._record(opcode, content)
            if not whole:
                self.cut = True
                return

    def _chunk(self, content: bytes, *, whole: bool) -> Iterator[Message]:
        try:
            _, _, size, crc = _CHUNK.unpack_from(content)
            compression, at = _text(content, _CHUNK.size)
            data = _decompressed(compression, content[at + 8 :], size)
            wrong = whole and (len(data) != size or (crc and zlib.crc32(data) != crc))
        except (struct.error, ValueError, RuntimeError, zstandard.ZstdError):
            wrong = True
        if wrong:
            self.broken += 1
            return
        at = 0
        while len(data) - at >= _RECORD.size:
            opcode, length = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if length > len(data) - at:
                return
            yield from self._record(opcode, data[at : at + length])
            at += length

    def _record(self, opcode: int, content: bytes) -> Iterator[Message]:
        try:
            if opcode == MESSAGE:
                number, _, log_ns, _ = _MESSAGE.unpack_from(content)
                channel = self._channels.get(number)
                if channel is not None:
                    self.counts[channel] += 1
                    if self._only is None or channel.topic in self._only:
                        yield Message(channel, log_ns, unpacked(content[_MESSAGE.size :]))
            elif opcode == SCHEMA:
                name, at = _text(content, 2)
                language, at = _text(content, at)
                self._schemas[int.from_bytes(content[:2], "little")] = name
                self.definitions.setdefault(kind_of(name), Definition(language, _text(content, at)[0]))
            elif opcode == CHANNEL:
                number, schema = struct.unpack_from("<HH", content)
                topic, at = _text(content, 4)
                self._channels[number] = Channel(topic, kind_of(self._schemas.get(schema, "")), _text(content, at)[0])
                self.counts.setdefault(self._channels[number], 0)
        except (struct.error, ValueError):
            self.broken += 1


def _text(content: bytes, at: int) -> tuple[str, int]:
    """A text, and where it ends."""
    (length,) = struct.unpack_from("<I", content, at)
    at += 4
    if length > len(content) - at:
        raise ValueError("a text goes beyond its record")
    return content[at : at + length].decode("utf-8", "replace"), at + length


def _decompressed(compression: str, data: bytes, size: int) -> bytes:
    """At most `size` bytes; fewer if the data end early."""
    if size > RECORD_MAX:
        raise ValueError("a chunk is too large")
    if compression == "":
        return data[:size]
    if compression == "zstd":
        return zstandard.ZstdDecompressor().stream_reader(data).read(size)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    raise ValueError(f"compression {compression!r} is not known")
