"""How a log lies on disk: MCAP records, byte for byte, in the one order in which this software writes them.

    magic  Header  Metadata("s2r")
    ( Attachment | Metadata | Chunk MessageIndex... )*
    DataEnd  summary  Footer  magic                     only after a clean close

Every chunk ends with a seal (`channels.Seal`). All that is not content follows from the content, so a reader makes it anew and
compares: there is no byte in which a flipped bit could hide. Rare records are packed by the `mcap` package; messages,
their index and chunks, of which there are many, here. https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import sys
import zlib
from array import array
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import msgspec
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    McapRecord,
    Schema,
)

from s2r_runtime.recording.channels import CHANNELS, schema

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "s2r-runtime log 2"
ABOUT = "s2r"
"""Name of the first metadata record: run, part, key, versions."""
RECOVERED = "s2r.recovered"
"""Name of the metadata record that `salvage` adds: what was missing."""

MAX_CHUNK = 64 << 20
"""Bytes of a chunk's content at most: what a reader is ready to allocate for a file it doesn't trust."""
START_MAX = 1 << 20
"""Bytes of the first metadata record at most."""
MAX_MESSAGES = 1 << 16
"""Of a chunk: one is closed at 1 MB, and a message takes 31 bytes at least."""

STORED_MAX = 128 << 10
"""Bytes of a zstd block at most (RFC 8878, 3.1.1.2.4)."""

RECORD = struct.Struct("<BQ")
"""Opcode and length of what follows."""
MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time."""
MESSAGE_FIELDS = MESSAGE.size - RECORD.size
CHUNK = struct.Struct("<BQQQQII4sQ")
"""Opcode, length, first and last log time, size and CRC of the content, length of its compression's name, that name, bytes that follow."""
CHUNK_FIELDS = CHUNK.size - RECORD.size
INDEX = struct.Struct("<BQHI")
"""Opcode, length, channel, bytes of (log time, offset) pairs that follow."""


def pack(record: McapRecord) -> bytes:
    """Bytes of a record."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def declaration(number: int) -> tuple[bytes, bytes]:
    """Schema and channel record of one of this version's channels."""
    name = list(CHANNELS)[number - 1]
    data = msgspec.json.encode(schema(CHANNELS[name]))
    kind = Schema(id=number, name=f"s2r.{CHANNELS[name].__name__}", encoding="jsonschema", data=data)
    return pack(kind), pack(Channel(id=number, schema_id=number, topic=name, message_encoding="json", metadata={}))


def chunk(
    content: bytes, index: Mapping[int, array[int]], first_ns: int, last_ns: int, compressor: zstandard.ZstdCompressor | None
) -> bytes:
    """A chunk record and its message indexes. index: channel -> log time, offset, log time, offset, ... compressor: None: `stored`."""
    data = stored(content) if compressor is None else compressor.compress(content)
    head = CHUNK.pack(Opcode.CHUNK, CHUNK_FIELDS + len(data), first_ns, last_ns, len(content), zlib.crc32(content), 4, b"zstd", len(data))
    return b"".join((head, data, index_records(index)))


def stored(content: bytes) -> bytes:
    """Content as a zstd frame of one raw block (RFC 8878, 3.1.1): of all the frames that mean the same, the one that anybody makes.

    Raises ValueError for content that does not fit into one.
    """
    n = len(content)
    if n > STORED_MAX:
        raise ValueError(f"{n} bytes cannot be stored as one block, must be at most {STORED_MAX}")
    code, size = (0, struct.pack("<B", n)) if n < 256 else (1, struct.pack("<H", n - 256)) if n < 65792 else (2, struct.pack("<I", n))
    return b"\x28\xb5\x2f\xfd" + bytes([code << 6 | 0x20]) + size + (1 | n << 3).to_bytes(3, "little") + content


def index_records(index: Mapping[int, array[int]]) -> bytes:
    """The message index records that follow a chunk."""
    parts = []
    for channel, pairs in index.items():
        if sys.byteorder != "little":
            pairs = array("Q", pairs)
            pairs.byteswap()
        packed = pairs.tobytes()
        parts += [INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(packed), channel, len(packed)), packed]
    return b"".join(parts)


class Attached(NamedTuple):
    """A file inside the log."""

    name: str
    media_type: str
    log_time_ns: int
    data: bytes


def attachment_record(name: str, media_type: str, log_time_ns: int, data: bytes) -> bytes:
    """An attachment record; its CRC covers all fields."""
    body = struct.pack("<QQ", log_time_ns, 0) + _text(name) + _text(media_type) + struct.pack("<Q", len(data)) + data
    return RECORD.pack(Opcode.ATTACHMENT, len(body) + 4) + body + struct.pack("<I", zlib.crc32(body))


def attachment_fields(record: bytes) -> Attached:
    """The attachment in a record. Raises ValueError if the record is not the one that `attachment_record` makes of it."""
    cursor = _Cursor(record, RECORD.size)
    log_time = cursor.number("<Q")
    cursor.number("<Q")
    found = Attached(cursor.text(), cursor.text(), log_time, cursor.take(cursor.number("<Q")))
    if attachment_record(found.name, found.media_type, found.log_time_ns, found.data) != record:
        raise ValueError("attachment is damaged")
    return found


def metadata_record(name: str, fields: Mapping[str, str]) -> bytes:
    """A metadata record, its keys sorted."""
    pairs = b"".join(_text(key) + _text(value) for key, value in sorted(fields.items()))
    body = _text(name) + struct.pack("<I", len(pairs)) + pairs
    return RECORD.pack(Opcode.METADATA, len(body)) + body


def metadata_fields(record: bytes) -> tuple[str, dict[str, str]]:
    """Name and fields. Raises ValueError if the record is not the one that `metadata_record` makes of them."""
    cursor = _Cursor(record, RECORD.size)
    name = cursor.text()
    end = cursor.number("<I") + cursor.at
    fields: dict[str, str] = {}
    while cursor.at < end:
        key = cursor.text()
        fields[key] = cursor.text()
    if metadata_record(name, fields) != record:
        raise ValueError("metadata is damaged")
    return name, fields


def declared(records: Iterable[bytes]) -> tuple[dict[int, bytes], dict[int, bytes], dict[int, str]]:
    """(schemas, channels, topics) by id, from schema and channel records. Raises ValueError for anything else."""
    schemas: dict[int, bytes] = {}
    channels: dict[int, bytes] = {}
    topics: dict[int, str] = {}
    for record in records:
        cursor = _Cursor(record, RECORD.size)
        number = cursor.number("<H")
        if record[0] == Opcode.SCHEMA:
            schemas[number] = record
        elif record[0] == Opcode.CHANNEL and cursor.number("<H") in schemas:
            channels[number] = record
            topics[number] = cursor.text()
            if record != pack(Channel(number, topics[number], "json", {}, struct.unpack_from("<H", record, RECORD.size + 2)[0])):
                raise ValueError(f"channel {topics[number]!r} is not declared as this software does")
        else:
            raise ValueError("a chunk holds something that is neither schema, channel nor message")
    return schemas, channels, topics


def _text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


class _Cursor:
    """Reads fields off a record; raises ValueError past its end."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data, self.at = data, at

    def take(self, n: int) -> bytes:
        if self.at + n > len(self._data):
            raise ValueError("a field reaches past the end of its record")
        self.at += n
        return self._data[self.at - n : self.at]

    def number(self, form: str) -> int:
        return int(struct.unpack(form, self.take(struct.calcsize(form)))[0])

    def text(self) -> str:
        return self.take(self.number("<I")).decode()
