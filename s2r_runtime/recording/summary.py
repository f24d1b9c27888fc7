"""The end of a log that was closed: index and statistics, made by walking over the file.

The writer writes it, the reader makes it anew and compares, a recovery completes a cut file by it. It is not gathered while the
log is written, since memory would then grow with the log.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, DataEnd, Footer, MetadataIndex, Statistics, SummaryOffset

from s2r_runtime.recording.layout import CHUNK, INDEX, MAGIC, RECORD, attachment_fields, metadata_fields, pack

ReadAt = Callable[[int, int], bytes]
"""(length, offset) -> bytes of the file; raises EOFError where there are fewer."""


WINDOW = 2048
"""Bytes read at once: about what the indexes of a chunk of 50 ms at 100 Hz take."""
_CHUNK_INDEX = struct.Struct("<BQQQQQI")
"""Opcode, length, first and last log time, offset and length of the chunk, bytes of (channel, offset) pairs that follow."""
_PAIR = struct.Struct("<HQ")
_COMPRESSION = struct.Struct("<QI4sQQ")
"""Bytes of the message indexes, length of the compression's name, that name, size compressed and not."""


class Span(NamedTuple):
    """A chunk and its index in the file, as the summary tells of them. `counts`: channel -> messages."""

    offset: int
    length: int
    first_ns: int
    last_ns: int
    size: int
    compressed: int
    counts: dict[int, int]


def spans(read_at: ReadAt, end: int) -> Iterator[Span | tuple[int, bytes]]:
    """Walks a sound data section up to `end` by its lengths alone: a Span for each chunk, (offset, record) for the rest.

    Read_at(length, offset) gives bytes of the file. Memory does not grow with the file: that is why indexes are not gathered
    while the log is written.
    """
    offset, read_at = len(MAGIC), _windows(read_at, end)
    while offset < end:
        opcode, length = RECORD.unpack(read_at(RECORD.size, offset))
        after = offset + RECORD.size + length
        if opcode != Opcode.CHUNK:
            yield offset, read_at(RECORD.size + length, offset)
            offset = after
            continue
        _, _, first, last, size, _, _, _, compressed = CHUNK.unpack(read_at(CHUNK.size, offset))
        counts: dict[int, int] = {}
        at = after
        while at < end:
            head = read_at(INDEX.size, at)
            if head[0] != Opcode.MESSAGE_INDEX:
                break
            _, _, channel, pairs = INDEX.unpack(head)
            counts[channel] = pairs // 16
            at += INDEX.size + pairs
        yield Span(offset, after - offset, first, last, size, compressed, counts)
        offset = at


def _windows(read_at: ReadAt, end: int) -> ReadAt:
    """Reads a little more than it is asked for: the heads of a chunk's indexes, and of what follows, lie side by side."""
    begin, data = 0, b""

    def windowed(length: int, offset: int) -> bytes:
        nonlocal begin, data
        if not begin <= offset <= begin + len(data) - length:
            begin, data = offset, read_at(max(length, min(WINDOW, end - offset)), offset)
        return data[offset - begin : offset - begin + length]

    return windowed


def tail(read_at: ReadAt, end: int, crc: int, schemas: Mapping[int, bytes], channels: Mapping[int, bytes]) -> Iterator[bytes]:
    """All that follows a data section which ends at `end` with that CRC-32: from DataEnd to the last magic, piece by piece.

    schemas, channels: id -> record. The writer writes it, the reader compares with it, a recovery completes a cut file by it.
    """
    yield pack(DataEnd(crc))
    start = offset = end + len(pack(DataEnd(crc)))
    running = 0
    groups: list[SummaryOffset] = []
    totals = _Totals(schemas, channels)
    for opcode, records in (
        (Opcode.SCHEMA, iter([schemas[i] for i in sorted(schemas)])),
        (Opcode.CHANNEL, iter([channels[i] for i in sorted(channels)])),
        (Opcode.CHUNK_INDEX, totals.chunk_indexes(read_at, end)),
        (Opcode.STATISTICS, totals.statistics()),
        (Opcode.ATTACHMENT_INDEX, iter(totals.attachments)),
        (Opcode.METADATA_INDEX, iter(totals.metadata)),
    ):
        begun = offset
        for record in records:
            running = zlib.crc32(record, running)
            offset += len(record)
            yield record
        if offset > begun:
            groups.append(SummaryOffset(opcode, begun, offset - begun))
    offsets = b"".join(pack(group) for group in groups)
    yield offsets
    footer = pack(Footer(start, offset, 0))[:-4]
    yield footer + struct.pack("<I", zlib.crc32(footer, zlib.crc32(offsets, running))) + MAGIC


class _Totals:
    """What the summary adds up. The lists fill while `chunk_indexes` is consumed."""

    def __init__(self, schemas: Mapping[int, bytes], channels: Mapping[int, bytes]) -> None:
        self.attachments: list[bytes] = []
        self.metadata: list[bytes] = []
        self._schemas, self._channels = len(schemas), len(channels)
        self._chunks = 0
        self._first: int | None = None
        self._last = 0
        self._counts: dict[int, int] = {}

    def chunk_indexes(self, read_at: ReadAt, end: int) -> Iterator[bytes]:
        for item in spans(read_at, end):
            if not isinstance(item, Span):
                self._other(*item)
                continue
            self._chunks += 1
            self._first = item.first_ns if self._first is None else min(self._first, item.first_ns)
            self._last = max(self._last, item.last_ns)
            for channel, count in item.counts.items():
                self._counts[channel] = self._counts.get(channel, 0) + count
            yield _chunk_index(item)

    def statistics(self) -> Iterator[bytes]:
        yield pack(
            Statistics(
                message_count=sum(self._counts.values()),
                schema_count=self._schemas,
                channel_count=self._channels,
                attachment_count=len(self.attachments),
                metadata_count=len(self.metadata),
                chunk_count=self._chunks,
                message_start_time=self._first or 0,
                message_end_time=self._last,
                channel_message_counts=dict(sorted(self._counts.items())),
            )
        )

    def _other(self, offset: int, record: bytes) -> None:
        if record[0] == Opcode.ATTACHMENT:
            found = attachment_fields(record)
            self.attachments.append(
                pack(AttachmentIndex(offset, len(record), found.log_time_ns, 0, len(found.data), found.name, found.media_type))
            )
        elif record[0] == Opcode.METADATA:
            self.metadata.append(pack(MetadataIndex(offset, len(record), metadata_fields(record)[0])))


def _chunk_index(span: Span) -> bytes:
    begin = at = span.offset + span.length
    pairs = []
    for channel, count in span.counts.items():
        pairs.append(_PAIR.pack(channel, at))
        at += INDEX.size + 16 * count
    size = _PAIR.size * len(pairs)
    length = _CHUNK_INDEX.size - RECORD.size + size + _COMPRESSION.size
    head = _CHUNK_INDEX.pack(Opcode.CHUNK_INDEX, length, span.first_ns, span.last_ns, span.offset, span.length, size)
    return b"".join((head, *pairs, _COMPRESSION.pack(at - begin, 4, b"zstd", span.compressed, span.size)))
