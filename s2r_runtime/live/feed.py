"""Messages of a log while it is written, or afterwards: read chunk by chunk, without a lock and without a word to the daemon.

    feed = Feed(path, {"event/observed", "out/gate_changed"})
    feed.to_end()                     # else it begins with the first message
    while not feed.ended:
        for row in feed.poll():       # never waits; empty while nothing is new
            print(row.log_ns, row.channel, row.message)
        time.sleep(0.1)

This is for looking. A chunk's CRC is checked, chain and signatures are not: whoever rests something on a log reads it with
`recording.reading`. A record that is not all there yet is read when it is. Damage skips a chunk and is counted. The parts of a run that was
rotated follow each other by themselves.
"""

from __future__ import annotations

import mmap
import os
import re
import zlib
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.opcode import Opcode

from s2r_runtime.errors import RecordingError
from s2r_runtime.files.table_text import refuse_special
from s2r_runtime.messages import Struct
from s2r_runtime.recording.channels import CHAIN, CHANNELS, NUMBERS, decoder
from s2r_runtime.recording.layout import CHUNK, MAGIC, MAX_CHUNK, MESSAGE, RECORD, attachment_fields
from s2r_runtime.recording.origin import OURS, other_writer

READ_BYTES = 4 << 20
"""Of a file in one `poll`, at most, unless a single chunk is larger."""
ATTACHED_MAX = 16 << 20
"""Bytes of an attachment at most that is stored: profile, model, controller."""
TRIES = 20
"""Polls in which a chunk's CRC may be wrong before it is skipped: a failed write is cut off and written again."""
_PART = re.compile(r"\.(\d{3})$")
_CHAIN = NUMBERS[CHAIN]
_DECOMPRESSOR = zstandard.ZstdDecompressor()
_IN_DATA = frozenset({Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.CHUNK, Opcode.MESSAGE_INDEX})


class Row(NamedTuple):
    """One message. log_ns: its `log_time`, which is the daemon's clock, ns."""

    log_ns: int
    channel: str
    message: Struct


class Span(NamedTuple):
    """A chunk: where it is in the file, and the log times of its first and its last message, ns."""

    offset: int
    first_ns: int
    last_ns: int


class Feed:
    """One run's log, from its file `path` on. channels: those wanted (None: all). attached: where attachments go (default: a new table).
    Not for two threads at once.

    `ended`: `closed` after the run's last message; else empty, also at the end of a log that a crash cut: nothing shows that nobody
    writes it any more. `attached`: files inside the log that were met so far, by name.
    `skipped`: chunks and messages that could not be read.

    Raises RecordingError for a file that cannot be read or is no log of s2r.
    """

    def __init__(self, path: Path, channels: Collection[str] | None = None, attached: dict[str, bytes] | None = None) -> None:
        self._names = {NUMBERS[name]: name for name in (CHANNELS if channels is None else channels)}
        self.attached = {} if attached is None else attached
        self.ended = ""
        self.skipped = 0
        self._fd = -1
        self._before: tuple[Path, int, int] | None = None
        self._open(path)

    def _open(self, path: Path) -> None:
        refuse_special(path)
        try:
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
        self.close()
        self.path, self._fd = path, fd
        self._at, self._tries, self._final, self._stuck = 0, 0, "", False

    def close(self) -> None:
        """Frees the file; may be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def poll(self, read_bytes: int = READ_BYTES) -> list[Row]:
        """Rows that are new since the last call, in the log's order: of `read_bytes` of the file, or of one larger chunk. Never waits."""
        rows: list[Row] = []
        if self.ended or not self._begun():
            return rows
        data = os.pread(self._fd, read_bytes, self._at)
        used = self._records(data, rows)
        if used:
            self._at += used
        elif not self._large(data, rows) and not self._tries:
            self._go_on(whole=data[:1] == bytes([Opcode.DATA_END]))
        return rows

    def more(self) -> bool:
        """Whether the last `poll` got anywhere: False at the end of what is there."""
        before, self._before = self._before, (self.path, self._at, self._tries + self._stuck)
        return not self.ended and before != self._before

    def to_end(self) -> None:
        """Goes to what is not written yet, over all parts that exist. Gives out no message; attachments on the way are stored."""
        while True:
            last = 0
            for span in self._spans():
                last = span.offset
            if last:
                self._at = last
                self.poll(RECORD.size)  # this chunk; what follows it is read by its lengths
            path = next_part(self.path)
            if path is None:
                return
            self._open(path)

    def seek(self, log_ns: int) -> None:
        """Goes to the first chunk of this part that has a message at or after log_ns; without one, to its last chunk."""
        for span in self._spans():
            self._at = span.offset
            if span.last_ns >= log_ns:
                return

    def spans(self) -> list[Span]:
        """Chunks of this part, as far as it is written. Reads lengths alone: a second for a gigabyte. Where `poll` goes on is unchanged."""
        return list(self._spans())

    def at(self, span: Span) -> list[Row]:
        """Rows of one chunk of this part; where `poll` goes on is unchanged."""
        head = os.pread(self._fd, RECORD.size, span.offset)
        content = _content(os.pread(self._fd, RECORD.size + RECORD.unpack(head)[1], span.offset)) if len(head) == RECORD.size else None
        rows: list[Row] = []
        if content is not None:
            self._messages(content, rows)
        return rows

    # ---- records

    def _begun(self) -> bool:
        """Whether the file has its first bytes."""
        if self._at:
            return True
        head = os.pread(self._fd, 256, 0)
        if OURS.encode() in head and head.startswith(MAGIC):
            self._at = len(MAGIC)
            return True
        if other := other_writer(self.path):
            raise RecordingError(f"{self.path}: is an MCAP file of others ({other}), not a log of s2r")
        if head.strip(b"\0") and not MAGIC.startswith(head[: len(MAGIC)]):
            raise RecordingError(f"{self.path}: is no log of s2r (its first bytes are not those of one)")
        return False

    def _records(self, data: bytes, rows: list[Row]) -> int:
        """Takes whole records off the data; how many bytes they have."""
        at = 0
        while at + RECORD.size <= len(data):
            opcode, length = RECORD.unpack_from(data, at)
            end = at + RECORD.size + length
            if opcode not in _IN_DATA or end > len(data):
                break
            if opcode == Opcode.CHUNK and not self._chunk(data[at:end], rows):
                break
            if opcode == Opcode.ATTACHMENT and length <= ATTACHED_MAX:
                self._attachment(data[at:end])
            at = end
        return at

    def _large(self, data: bytes, rows: list[Row]) -> bool:
        """Takes the one record that is larger than what was read, if all of it is there."""
        opcode, length = RECORD.unpack_from(data) if len(data) >= RECORD.size else (0, 0)
        end = self._at + RECORD.size + length
        if opcode not in _IN_DATA or RECORD.size + length <= len(data) or end > os.fstat(self._fd).st_size:
            return False
        if length <= MAX_CHUNK:
            if not self._records(os.pread(self._fd, RECORD.size + length, self._at), rows):
                return False
        else:
            self.skipped += 1
        self._at = end
        return True

    def _go_on(self, *, whole: bool) -> None:
        """At what is not there yet (or, whole, after all of a part): with the next part, if there is one."""
        path = next_part(self.path)
        if path is None:
            self.ended = "closed" if whole and self._final != "rotated" else ""
        elif whole or self._final or self._stuck:
            self.skipped += not (whole or self._final)
            self._open(path)
        else:
            self._stuck = True  # looks once more: the next part exists when all of this one is written, but perhaps not when it was read

    def _chunk(self, record: bytes, rows: list[Row]) -> bool:
        """False: it is damaged, which may be because it is being written once more."""
        content = _content(record)
        if content is None and self._tries < TRIES:
            self._tries += 1
            return False
        self._tries = 0
        if content is None:
            self.skipped += 1
        else:
            self._messages(content, rows)
        return True

    def _messages(self, content: bytes, rows: list[Row]) -> None:
        """Rows of a chunk's content."""
        at, size, unpack, names = 0, len(content), MESSAGE.unpack_from, self._names
        while at + MESSAGE.size <= size:
            opcode, length, channel, _, log_ns, _ = unpack(content, at)
            end = at + RECORD.size + length
            if opcode == Opcode.MESSAGE:
                name = names.get(channel)
                if name is not None:
                    try:
                        rows.append(Row(log_ns, name, decoder(name).decode(content[at + MESSAGE.size : end])))
                    except (ValueError, RecursionError):  # of another version
                        self.skipped += 1
                if channel == _CHAIN:
                    self._final = _final(content[at + MESSAGE.size : end])
            at = end

    def _attachment(self, record: bytes) -> None:
        try:
            found = attachment_fields(record)
        except ValueError:
            self.skipped += 1
        else:
            self.attached[found.name] = found.data

    # ---- by lengths alone

    def _spans(self) -> Iterator[Span]:
        """Chunks from where the file begins."""
        if not self._begun():
            return
        with mmap.mmap(self._fd, 0, access=mmap.ACCESS_READ) as data:
            at, size, unpack = len(MAGIC), len(data), RECORD.unpack_from
            while at + RECORD.size <= size:
                opcode, length = unpack(data, at)
                end = at + RECORD.size + length
                if opcode not in _IN_DATA or end > size:
                    return
                if opcode == Opcode.CHUNK and end - at >= CHUNK.size:
                    _, _, first, last, *_ = CHUNK.unpack_from(data, at)
                    yield Span(at, first, last)
                elif opcode == Opcode.ATTACHMENT and length <= ATTACHED_MAX:
                    self._attachment(data[at:end])
                at = end


def _final(seal: bytes) -> str:
    """Why nothing follows this seal in its file; empty where something does."""
    return next((end for end in ("rotated", "closed") if f'"end":"{end}"'.encode() in seal), "")


def _content(record: bytes) -> bytes | None:
    """What is in a chunk; None if it is damaged."""
    if len(record) < CHUNK.size:
        return None
    _, _, _, _, size, crc, _, name, packed = CHUNK.unpack_from(record)
    if name != b"zstd" or size > MAX_CHUNK or CHUNK.size + packed != len(record):
        return None
    try:
        if zstandard.get_frame_parameters(record[CHUNK.size :]).content_size != size:
            return None
        content = _DECOMPRESSOR.decompress(record[CHUNK.size :], max_output_size=size)
    except zstandard.ZstdError:
        return None
    return content if zlib.crc32(content) == crc else None


def next_part(path: Path) -> Path | None:
    """The file that continues this one, if it exists: `run.mcap`, `run.002.mcap`, `run.003.mcap`, ..."""
    first = first_part(path)
    number = int(found[1]) if path != first and (found := _PART.search(path.stem)) else 1
    follows = first.with_suffix(f".{number + 1:03d}{first.suffix}")
    return follows if follows.is_file() else None


def first_part(path: Path) -> Path:
    """The first file of the run that this file is a part of; the file itself if there is no other."""
    if found := _PART.search(path.stem):
        first = path.with_name(path.stem[: found.start()] + path.suffix)
        if int(found[1]) > 1 and first.is_file():
            return first
    return path


def rows(path: Path, channels: Collection[str] | None = None, start_ns: int = 0, end_ns: int | None = None) -> Iterator[Row]:
    """What is there of a run, from its file `path` on; start_ns, end_ns: log times, both included. Memory does not grow with the log."""
    feed = Feed(path, channels)
    try:
        if start_ns:
            feed.seek(start_ns)
        while feed.more():
            for row in feed.poll():
                if end_ns is not None and row.log_ns > end_ns:
                    return
                if row.log_ns >= start_ns:
                    yield row
    finally:
        feed.close()


def overview(path: Path, channels: Collection[str], n: int) -> Iterator[Sequence[Row]]:
    """Rows of at most n chunks, evenly over one file: a quick look at a long log."""
    feed = Feed(path, channels)
    try:
        spans = feed.spans()
        n = min(n, len(spans))
        for k in range(n):
            yield feed.at(spans[k * len(spans) // n])
    finally:
        feed.close()


__all__ = ["Feed", "Row", "Span", "first_part", "next_part", "overview", "rows"]
