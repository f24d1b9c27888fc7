"""Takes a log apart and puts it together again, as somebody would who knows the format by heart: every CRC, index, statistic and, if he
wants, every head of the chain fits. All that he may lack is the key.

    forge(parts, effort, key, since)
                                  effort "bytes": CRCs, sizes, indexes and summary fit
                                         "chain": heads and digests in the seals fit too; signatures are the old ones
                                         "sign": and every seal is signed with `key`, which the metadata does not name
                                         "pose": and the metadata names it
"""

from __future__ import annotations

import hashlib
import io
import struct
import zlib
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec
import zstandard
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from mcap.records import DataEnd, Footer

from s2r_runtime.recording.blocks import take
from s2r_runtime.recording.chain import GENESIS, advance, signed
from s2r_runtime.recording.channels import Seal
from s2r_runtime.recording.layout import (
    CHUNK,
    CHUNK_FIELDS,
    MAGIC,
    MESSAGE,
    MESSAGE_FIELDS,
    declared,
    index_records,
    metadata_fields,
    pack,
    stored,
)
from s2r_runtime.recording.reading import read
from s2r_runtime.recording.start import FIRST, make_start
from s2r_runtime.recording.summary import tail

Effort = Literal["bytes", "chain", "sign", "pose"]


@dataclass
class Msg:
    """A message as it lies in a chunk."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes

    def record(self) -> bytes:
        """The message's record as MCAP has it."""
        return MESSAGE.pack(5, MESSAGE_FIELDS + len(self.data), self.channel, self.sequence, self.log_time, self.publish_time) + self.data


@dataclass
class Piece:
    """A block: records before the chunk (the file's start is not among them), declarations, messages. The seal is the last message.

    data: the chunk's compressed form, if it is not to be made by `level` (None: stored raw).
    """

    prefix: list[bytes] = field(default_factory=list)
    declarations: list[bytes] = field(default_factory=list)
    messages: list[Msg] = field(default_factory=list)
    level: int | None = 1
    data: bytes | None = None
    index: bytes | None = None
    times: tuple[int, int] | None = None


@dataclass
class Parts:
    """A log."""

    start: bytes
    pieces: list[Piece]
    closing: bool = True
    """Whether data end and summary follow."""


def apart(path: Path) -> Parts:
    """A sound log, taken apart."""
    size, start, pieces, at = path.stat().st_size, read(path).start, list[Piece](), 0
    with path.open("rb") as file:
        while True:
            file.seek(at or len(start))
            block = take(file, at, size, b"" if at else start)
            if block is None or block.last:
                return Parts(start, pieces, closing=block is not None)
            found = [Msg(channel, number, t_ns, t_ns, block.content[begin:end]) for channel, number, t_ns, begin, end in block.messages]
            prefix = block.prefix if at else block.prefix[1:]
            pieces.append(Piece(list(prefix), list(block.declarations), found, None if block.plain else 1))
            at = block.end


def copied(parts: Parts) -> Parts:
    """One that can be changed: messages are shared, replace them."""
    pieces = [Piece(list(p.prefix), list(p.declarations), list(p.messages), p.level, p.data, p.index, p.times) for p in parts.pieces]
    return Parts(parts.start, pieces, parts.closing)


def forge(parts: Parts, effort: Effort, key: Ed25519PrivateKey | None = None, since: int = 0) -> bytes:
    """The file. since: the block from which on seals are made anew; those before it stay as they are."""
    out, head, seal_record = bytearray(start(parts, effort, key)), GENESIS, b""
    for number, piece in enumerate(parts.pieces):
        prefix = b"".join(piece.prefix)
        content = bytearray(b"".join(piece.declarations))
        index: dict[int, array[int]] = {}
        for position, message in enumerate(piece.messages):
            if effort != "bytes" and position == len(piece.messages) - 1:
                first = bytes(out) if number == 0 else b""
                head = advance(head, seal_record, [first, prefix, content])
                if number >= since:
                    message = resealed(message, head, hashlib.sha256(b"" if number == 0 else out).digest(), effort, key)
                seal_record = message.record()
            index.setdefault(message.channel, array("Q")).extend((message.log_time, len(content)))
            content += message.record()
        out += prefix + framed(piece, bytes(content), index)
    if parts.closing:
        out += summary(bytes(out), parts)
    return bytes(out)


def start(parts: Parts, effort: Effort, key: Ed25519PrivateKey | None) -> bytes:
    """The file's first records; where somebody poses as the signer, with the forger's key in them."""
    if effort != "pose" or key is None:
        return parts.start
    _, fields = metadata_fields(parts.start[len(FIRST) :])
    own = {name: fields.pop(name) for name in ("run", "part", "first_index", "public_key", "previous_head")}
    public = key.public_key().public_bytes_raw()
    return make_start(fields, run=own["run"], part=int(own["part"]), first_index=int(own["first_index"]), public_key=public)


def resealed(message: Msg, head: bytes, file: bytes, effort: Effort, key: Ed25519PrivateKey | None) -> Msg:
    """A seal made anew over what was changed, as far as the effort goes; a message that is no seal stays as it is."""
    try:
        seal = msgspec.structs.replace(msgspec.json.decode(message.data, type=Seal), head=head, file=file)
    except msgspec.DecodeError:
        return message
    if effort in {"sign", "pose"} and key is not None:
        seal = signed(msgspec.structs.replace(seal, t_ns=message.log_time, count=message.sequence, signature=b""), key)
    return Msg(message.channel, message.sequence, message.log_time, message.publish_time, msgspec.json.encode(seal))


def framed(piece: Piece, content: bytes, index: dict[int, array[int]]) -> bytes:
    """The chunk and its index."""
    data = piece.data
    if data is None:
        data = stored(content) if piece.level is None and len(content) < 1 << 17 else compressed(content, piece.level or 1)
    times = piece.times or ((piece.messages[0].log_time, piece.messages[-1].log_time) if piece.messages else (0, 0))
    head = CHUNK.pack(6, CHUNK_FIELDS + len(data), *times, len(content), zlib.crc32(content), 4, b"zstd", len(data))
    return head + data + (index_records(index) if piece.index is None else piece.index)


def compressed(content: bytes, level: int = 1) -> bytes:
    """A zstd frame of one chunk."""
    return zstandard.ZstdCompressor(level=level).compress(content)


def summary(data: bytes, parts: Parts) -> bytes:
    """From the data end on."""
    schemas: dict[int, bytes] = {}
    channels: dict[int, bytes] = {}
    for piece in parts.pieces:
        try:
            found = declared(piece.declarations)
        except (ValueError, struct.error):
            continue
        schemas |= found[0]
        channels |= found[1]
    file = io.BytesIO(data)

    def read_at(length: int, offset: int) -> bytes:
        file.seek(offset)
        return file.read(length)

    try:
        return b"".join(tail(read_at, len(data), zlib.crc32(data), schemas, channels))
    except (ValueError, struct.error, EOFError):  # what was put in is no record: he ends as well as he can
        return pack(DataEnd(zlib.crc32(data))) + pack(Footer(0, 0, 0)) + MAGIC
