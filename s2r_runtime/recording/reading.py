"""Reads a log, in constant memory, and says how it ended.

Nothing is given out before the seal after it was checked: bytes, CRC, sequence, chain, signature. A file that a crash cut
reads to its last sealed message. What differs from what the writer would have written, be it one bit, ends the reading
there, with the place named.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Literal

import msgspec
from mcap.opcode import Opcode

from s2r_runtime.errors import RecordingError
from s2r_runtime.files.table_text import refuse_special
from s2r_runtime.recording.blocks import Block, Damage, extent, find, take
from s2r_runtime.recording.chain import advance, is_signed_by
from s2r_runtime.recording.channels import CHAIN, CHANNELS, Seal
from s2r_runtime.recording.entries import Checked, Entry, entries
from s2r_runtime.recording.layout import (
    ABOUT,
    MESSAGE,
    RECOVERED,
    Attached,
    attachment_fields,
    declared,
    metadata_fields,
)
from s2r_runtime.recording.start import read_start
from s2r_runtime.recording.summary import tail


class Ending(msgspec.Struct, frozen=True):
    """How a log ended. `index`: all messages of the run before it are good; `offset`: bytes of the file that are.

    closed: properly, all is there. rotated: likewise, and the next part goes on. cut: the end is not there (a crash), all
    before it is. broken: something is there that was not recorded like this.
    """

    kind: Literal["closed", "rotated", "cut", "broken"]
    index: int
    offset: int
    lost_bytes: int
    detail: str


_FOUND = (
    *("head", "signed", "met", "metadata", "lacking", "indexed", "first_ns"),
    *("_at", "_index", "_log_time", "_final", "_ending", "_schemas", "_channels"),
)


class Reading:
    """A log file that is being read: iterate it once for its entries, then look at `ending`.

    path: of one part. channels: give out these only (None: all but the seals); all are checked. metadata,
    attachments: those that stood before what was read so far. Raises RecordingError for a file that is no log of this
    software, or of another version.
    """

    def __init__(self, path: Path, channels: Iterable[str] | None = None, *, growing: bool = False) -> None:
        """growing: it is being written; iterate it once more for what came since."""
        self.path, self._growing = path, growing
        self.wanted = frozenset(CHANNELS) - {CHAIN} if channels is None else frozenset(channels)
        refuse_special(path)
        try:
            with path.open("rb") as file:
                self.size = os.fstat(file.fileno()).st_size
                self._until = extent(file, self.size)
                file.seek(0)
                start = read_start(file, path, self._until)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
        self.start = start.raw
        """What the file begins with, up to the metadata that says what it is; empty if it ends before."""
        self.run, self.part, self.first_index, self._key = start.run, start.part, start.first_index, start.key
        self.public_key = b"" if start.key is None else start.key.public_bytes_raw()
        self.previous_head = self.head = start.previous_head
        self.metadata: dict[str, dict[str, str]] = {ABOUT: dict(start.fields)}
        self.attachments: list[Attached] = []
        self.counts: dict[str, int] = {}
        self.signed = False
        self.lacking = b""
        """What a cut file does not have of its last chunk's index."""
        self.sought: frozenset[bytes] = frozenset()
        """Heads to look out for; `met`: those that the chain came by."""
        self.met: set[bytes] = set()
        self.indexed = False
        """Whether the index at the end is there, and right."""
        self._ending: Ending | None = None
        self._index = self.first_index
        self._at = self._crc = self._log_time = 0
        self._sha = hashlib.sha256()
        self._seal, self._final = b"", ""
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self.topics: dict[int, str] = {}
        """Channels declared so far, by the number that messages bear."""
        self.first_ns: int | None = None
        self._digests: dict[str, bytes] = {}

    @property
    def over(self) -> bool:
        """Whether it has ended."""
        return self._ending is not None

    @property
    def ending(self) -> Ending:
        """How it ended; raises RuntimeError while it has not."""
        if self._ending is None:
            raise RuntimeError(f"{self.path}: is still being read")
        return self._ending

    def to_the_end(self) -> Ending:
        """Reads all, gives out nothing."""
        for _ in self:
            pass
        return self.ending

    @property
    def last_ns(self) -> int:
        """Log time of the last message read."""
        return self._log_time

    @property
    def sealed_for_good(self) -> bool:
        """Whether the seal that nothing follows was read: no message is missing, whatever became of the index."""
        return bool(self._final)

    @property
    def chain(self) -> str:
        """`intact`, `broken`, or `unsigned tail` (a log without a key, or nothing of it)."""
        if self._ending is not None and self._ending.kind == "broken":
            return "broken"
        return "intact" if self.signed else "unsigned tail"

    @property
    def declarations(self) -> tuple[dict[int, bytes], dict[int, bytes]]:
        """Schema and channel records read so far, by id."""
        return self._schemas, self._channels

    @property
    def offset(self) -> int:
        """Bytes of the file that were read and found good."""
        return self._at

    # ---- the messages

    def __iter__(self) -> Iterator[Entry]:
        """The entries, once. Afterwards `ending` is there."""
        for block in self.blocks():
            yield from entries(block, self.topics, self.wanted, self.counts, self.path)

    def blocks(self) -> Iterator[Checked]:
        """The same by whole blocks, each checked before it is given out; `counts` then counts nothing."""
        if self._growing and (self._final or (self._ending is not None and self._ending.kind == "broken")):
            return
        self._file: BinaryIO = self.path.open("rb")
        try:
            if self._growing:
                self._grow()
            if not self.start:
                raise Damage(0, "the file ends before its first record", cut=True)
            while (block := self._take()) is not None:
                if self._growing and (block.last or block.lacking):  # the rest of it is about to come
                    break
                if block.last:
                    self._finish(block)
                    return
                self._check(block)
                self._note(block)
                index, self._at = self._index, block.end
                self._index += len(block.messages)
                yield Checked(index, block.end, block.content, block.messages)
                if block.lacking:
                    self.lacking = block.lacking
                    self._end("cut", "the file ends inside a chunk's index")
                    return
            self._end("cut", "the index is missing" if self._final else "the file ends between two chunks")
        except Damage as damage:
            self._damaged(damage)
        finally:
            self._file.close()

    def _grow(self) -> None:
        """Looks how long the file is by now."""
        self._ending, self.size = None, os.fstat(self._file.fileno()).st_size
        self._until = extent(self._file, self.size)

    # ---- read by another process (`audit.ahead`)

    def follow(self, end: int, topics: dict[int, str], attachments: list[Attached]) -> None:
        """It came so far, met these attachments, and channels if there are new ones."""
        self._at = end
        self.topics |= topics
        self.attachments += attachments

    def found(self) -> dict[str, Any]:
        """What it knows at the end, beyond what can be followed; `adopt` takes it over."""
        return {name: getattr(self, name) for name in _FOUND}

    def adopt(self, found: dict[str, Any]) -> None:
        """As if it had been read here."""
        for name in _FOUND:
            setattr(self, name, found[name])

    # ---- blocks

    def _take(self) -> Block | None:
        start = b"" if self._at else self.start
        self._file.seek(self._at + len(start))
        return take(self._file, self._at, self._until, start)

    def _check(self, block: Block) -> None:
        """Sequence, times, chain and signature of a block."""
        if self._final:
            raise Damage(block.offset, "something follows the last seal")
        schemas, declarations, topics = declared(block.declarations)
        for known, new in ((self._schemas, schemas), (self._channels, declarations)):
            if any(known.get(number, record) != record for number, record in new.items()):
                raise Damage(block.offset, "a channel is declared once more, and otherwise")
            known.update(new)
        self.topics |= topics
        if self.first_ns is None:
            self.first_ns = block.messages[0][2]
        before_ns = self._log_time
        for number, (_, sequence, log_time_ns, _, _) in enumerate(block.messages, self._index):
            if sequence != number & 0xFFFFFFFF:
                raise Damage(block.offset, f"message {number} is missing or out of its place")
            if log_time_ns < before_ns:
                raise Damage(block.offset, f"message {number} goes back in time")
            self._log_time = before_ns = log_time_ns
        channel, _, sealed_ns, start, _ = block.messages[-1]
        if self.topics.get(channel) != CHAIN:
            raise Damage(block.offset, "a chunk is not sealed")
        raw = block.content[start:]
        try:
            seal = msgspec.json.decode(raw, type=Seal)
        except msgspec.DecodeError as error:
            raise Damage(block.offset, f"a seal cannot be read: {error}") from None
        seal_at = start - MESSAGE.size
        head = advance(self.head, self._seal, [*block.prefix, memoryview(block.content)[:seal_at]])
        count = self._index + len(block.messages) - 1
        if msgspec.json.encode(Seal(sealed_ns, count, head, self._sha.digest(), seal.end, seal.signature)) != raw:
            raise Damage(block.offset, "the chain does not hold: this is not what was sealed")
        if self._key is None:
            if seal.signature:
                raise Damage(block.offset, "a seal is signed in a log that has no key")
        elif not is_signed_by(seal, self._key):
            raise Damage(block.offset, "a seal's signature is not that of the log's key")
        if seal.end and not block.plain:
            raise Damage(block.offset, "the last seal does not stand alone, as it is written")
        self.head, self.signed, self._final = head, self._key is not None, seal.end
        self._seal = block.content[seal_at:]
        if head in self.sought:
            self.met.add(head)
        self._digest_until(block.end)

    def _digest_until(self, end: int) -> None:
        self._file.seek(self._at)
        data = self._file.read(end - self._at)
        self._crc = zlib.crc32(data, self._crc)
        self._sha.update(data)

    def _note(self, block: Block) -> None:
        for record in block.prefix:
            data = record[len(self.start) :] if record is block.prefix[0] and block.offset == 0 else record
            if data and data[0] == Opcode.ATTACHMENT:
                attached = _attached(data, block.offset)
                if self._digests.setdefault(attached.name, digest := hashlib.sha256(attached.data).digest()) != digest:
                    raise Damage(block.offset, f"there are two attachments {attached.name!r}, and they differ")
                self.attachments.append(attached)
            elif data:
                name, fields = _metadata(data, block.offset)
                self.metadata[name] = fields

    # ---- the end

    def _finish(self, block: Block) -> None:
        """After the data section: the rest must be exactly what `tail` makes, or a beginning of it."""
        for record in block.prefix:
            if record[0] != Opcode.METADATA or _metadata(record, block.offset)[0] != RECOVERED:
                raise Damage(block.offset, "a record at the end was not sealed")
            self.metadata[RECOVERED] = _metadata(record, block.offset)[1]
        self._digest_until(block.end)
        at = self._at = block.end
        self._file.seek(at)
        for piece in tail(self._read_at, block.end, self._crc, self._schemas, self._channels):
            found = self._file.read(min(len(piece), max(0, self._until - at)))
            if found != piece:
                if at + len(found) == self._until and piece.startswith(found):
                    self._end("cut", "the file ends inside its index")
                    return
                raise Damage(at, "the index at the end is not that of the messages")
            at += len(piece)
        if at != self.size:
            raise Damage(at, "something follows the end")
        self._at, self.indexed = at, True
        if RECOVERED in self.metadata or not self._final:
            self._end("cut", "was recovered from a file that was cut" if block.prefix else "the last seal is missing")
        else:
            self._end("closed" if self._final == "closed" else "rotated", "")

    def _read_at(self, length: int, offset: int) -> bytes:
        return os.pread(self._file.fileno(), length, offset)

    def _damaged(self, damage: Damage) -> None:
        """A cut tail has nothing good after it; if there is something, a record in the middle was damaged."""
        if damage.cut and find(self._file, self._at, self._until) is None:
            self._end("cut", damage.detail)
        else:
            self._end("broken", f"at byte {damage.offset}: {damage.detail}")

    def _end(self, kind: Literal["closed", "rotated", "cut", "broken"], detail: str) -> None:
        self._ending = Ending(kind, self._index, self._at, self.size - self._at, detail)


def _attached(record: bytes, offset: int) -> Attached:
    try:
        return attachment_fields(record)
    except ValueError as error:
        raise Damage(offset, str(error)) from None


def _metadata(record: bytes, offset: int) -> tuple[str, dict[str, str]]:
    try:
        return metadata_fields(record)
    except ValueError as error:
        raise Damage(offset, str(error)) from None


def read(path: Path, channels: Iterable[str] | None = None) -> Reading:
    """Opens a log for reading: see `Reading`."""
    return Reading(path, channels)


__all__ = ["Ending", "Entry", "Reading", "read"]
