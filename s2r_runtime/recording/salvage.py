"""`s2r log info` and `s2r log recover`: what is in a log, and a clean file of what a crash or damage left of one.

What is good is copied byte for byte, so that chain and signatures still vouch for it; a new index makes it readable by any MCAP
reader. After damage in the middle the sound chunks behind it are kept too: nothing vouches for those any more, and reading
the result as a log ends before them.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec

from s2r_runtime.errors import RecordingError, UsageError
from s2r_runtime.recording.blocks import Block, Damage, find, take
from s2r_runtime.recording.channels import CHANNELS
from s2r_runtime.recording.entries import entries
from s2r_runtime.recording.layout import RECOVERED, declaration, declared, metadata_record
from s2r_runtime.recording.reading import Ending, read
from s2r_runtime.recording.start import make_start
from s2r_runtime.recording.summary import tail

NEW_START = make_start({}, run="")
"""For a file whose own start is damaged: nobody knows which run it was."""


class Hole(msgspec.Struct, frozen=True):
    """Messages that are gone: `records` of them, from number `first` on."""

    first: int
    records: int


class Account(msgspec.Struct, frozen=True):
    """What a recovery kept. `vouched`: messages that the chain still covers; `lost_bytes`: bytes of the file that were dropped."""

    output: str
    ended: str
    records: int
    vouched: int
    holes: list[Hole]
    lost_bytes: int
    missing: str


def info(path: Path, progress: Callable[[float, float], None] | None = None) -> dict[str, Any]:
    """What a log holds and how it ended. Reads and checks all of it; raises RecordingError if it is not a log, or holds no message.

    progress: (bytes read, bytes of the file).
    """
    reading = read(path, ())
    for block in reading.blocks():
        for _ in entries(block, reading.topics, reading.wanted, reading.counts, path):
            pass
        if progress is not None:
            progress(float(reading.offset), float(reading.size))
    ending = reading.ending
    if not reading.counts:
        more = "; s2r log recover looks for sound ones behind the damage" if ending.kind == "broken" else ""
        raise RecordingError(f"{path}: holds no message that could be read: {ending.detail}{more}")
    start = reading.first_ns or 0
    return {
        "file": str(path),
        "bytes": path.stat().st_size,
        "run": reading.run,
        "part": reading.part,
        "records": sum(reading.counts.values()),
        "duration_s": (reading.last_ns - start) / 1e9,
        "channels": dict(sorted(reading.counts.items())),
        "attachments": [
            {"name": a.name, "media_type": a.media_type, "bytes": len(a.data), "sha256": hashlib.sha256(a.data).hexdigest()}
            for a in reading.attachments
        ],
        "metadata": reading.metadata,
        "ended": ending.kind,
        "detail": ending.detail,
        "lost_bytes": ending.lost_bytes,
        "chain": reading.chain,
        "head": reading.head.hex(),
        "key": reading.public_key.hex(),
    }


def recover(path: Path, out: Path) -> dict[str, Any]:
    """Writes what is good of a log into a new file, and gives the `Account` as plain data.

    Raises UsageError if `out` exists or cannot be made, RecordingError if there is nothing to recover.
    """
    if out.exists():
        raise UsageError(f"{out}: exists already; recover writes a new file")
    good = _good(path)
    partial = out.with_name(out.name + ".part")
    try:
        with path.open("rb") as source, partial.open("wb+") as target:
            account = _copy(good, source, target, str(out))
            target.flush()
            os.fsync(target.fileno())
        if account.records:
            partial.rename(out)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise UsageError(f"{out}: cannot be written: {error.strerror}") from None
    if not account.records:
        partial.unlink(missing_ok=True)
        raise RecordingError(f"{path}: holds no message that could be recovered: {good.ending.detail}")
    plain: dict[str, Any] = msgspec.to_builtins(account)
    return plain


class _Good(NamedTuple):
    """What can be copied as it is: `start`, then the file's bytes from its end to `end`, then `lacking`. records: messages in it.

    `indexed`: so the copy is a whole file. `complete`: no message is missing.
    """

    start: bytes
    end: int
    records: int
    ending: Ending
    lacking: bytes
    indexed: bool
    complete: bool
    schemas: dict[int, bytes]
    channels: dict[int, bytes]


def _good(path: Path) -> _Good:
    try:
        reading = read(path, ())
        ending = reading.to_the_end()
        if not reading.counts and ending.kind != "broken":
            raise RecordingError(f"{path}: holds no message that could be recovered: {ending.detail}")
        records = sum(reading.counts.values())
        start, tables = reading.start or NEW_START, reading.declarations
        return _Good(start, ending.offset, records, ending, reading.lacking, reading.indexed, reading.sealed_for_good, *tables)
    except RecordingError as error:
        if not path.is_file():
            raise
        with path.open("rb") as source:
            size = os.fstat(source.fileno()).st_size
            if find(source, 0, size) is None:
                raise
        return _Good(NEW_START, 0, 0, Ending("broken", 0, 0, size, str(error)), b"", False, False, {}, {})


def _copy(good: _Good, source: BinaryIO, target: BinaryIO, name: str) -> Account:
    ending = good.ending
    size = os.fstat(source.fileno()).st_size
    target.write(good.start)
    _copy_bytes(source, target, len(good.start), good.end)
    target.write(good.lacking)
    if good.indexed:
        return Account(name, ending.kind, good.records, good.records, [], 0, "" if good.complete else ending.detail)
    holes: list[Hole] = []
    records, kept_bytes, expected = good.records, max(good.end, len(good.start)), ending.index
    for block in _sound(source, good.end, size) if ending.kind == "broken" else ():
        first = block.messages[0][1] + (expected & ~0xFFFFFFFF)
        holes += [Hole(expected, first - expected)] if first > expected else []
        expected = first + len(block.messages)
        records += len(block.messages)
        kept_bytes += block.end - block.offset
        _declare(block, good.schemas, good.channels, target)
        source.seek(block.offset)
        target.write(source.read(block.end - block.offset))
        target.write(block.lacking)
    missing = "" if good.complete and ending.kind == "cut" else _missing(ending, holes)
    if missing:
        target.write(metadata_record(RECOVERED, {"ended": ending.kind, "detail": ending.detail, "missing": missing}))
    _complete(target, good.schemas, good.channels)
    return Account(name, ending.kind, records, good.records, holes, max(0, size - kept_bytes), missing)


def _missing(ending: Ending, holes: list[Hole]) -> str:
    if ending.kind == "cut":
        return f"what came after the first {ending.index} messages: {ending.detail}; {ending.lost_bytes} bytes could not be used"
    gone = "; ".join(f"{hole.records} messages from number {hole.first} on" for hole in holes) or "an unknown number of messages"
    return f"{gone}; damaged {ending.detail}; nothing vouches for what follows the first {ending.index} messages"


def _sound(source: BinaryIO, offset: int, size: int) -> Iterator[Block]:
    """Sound chunks at or after an offset, whatever lies between them."""
    while (at := find(source, offset, size)) is not None:
        source.seek(at)
        try:
            block = take(source, at, size, strict=False)
        except Damage:  # find() just took it: the file changes under our feet
            return
        if block is None:
            return
        yield block
        offset = block.end


def _declare(block: Block, schemas: dict[int, bytes], channels: dict[int, bytes], target: BinaryIO) -> None:
    """Before a chunk: the channels that only a lost chunk declared, as this version numbers them."""
    new_schemas, new_channels, _ = declared(block.declarations)
    schemas |= new_schemas
    channels |= new_channels
    for number in sorted({channel for channel, *_ in block.messages} - channels.keys()):
        if number <= len(CHANNELS):
            schemas[number], channels[number] = declaration(number)
            target.write(schemas[number] + channels[number])


def _copy_bytes(source: BinaryIO, target: BinaryIO, start: int, end: int) -> None:
    source.seek(start)
    while start < end and (data := source.read(min(end - start, 1 << 20))):
        target.write(data)
        start += len(data)


def _complete(target: BinaryIO, schemas: dict[int, bytes], channels: dict[int, bytes]) -> None:
    """Writes the index after the data."""
    end, crc = target.tell(), 0
    target.seek(0)
    while data := target.read(1 << 20):
        crc = zlib.crc32(data, crc)
    fd = target.fileno()
    target.seek(end)
    target.writelines(tail(lambda length, offset: os.pread(fd, length, offset), end, crc, schemas, channels))


__all__ = ["Account", "Hole", "info", "recover"]
