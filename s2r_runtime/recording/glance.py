"""A glance into a log: the messages on a few channels, found by the lengths of its records alone.

Chunks that hold none of the channels are stepped over unread, so that a file of a gigabyte costs a second. What is given out has its
chunk's CRC; chain and signatures are not looked at, and damage ends the glance or skips a chunk. It is for comparing; whoever rests
something on what it says reads the log in full (`reading`).
"""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

import msgspec
import zstandard
from mcap.opcode import Opcode

from s2r_runtime.messages import Struct
from s2r_runtime.recording.channels import NUMBERS, decoder
from s2r_runtime.recording.layout import CHUNK, MAGIC, MAX_CHUNK, MESSAGE, RECORD
from s2r_runtime.recording.summary import Span, spans

_DECOMPRESSOR = zstandard.ZstdDecompressor()


def glance(path: Path, channels: Collection[str], *, newest_first: bool = False) -> Iterator[Struct]:
    """The messages on these channels, in order. Nothing, if the file can't be read or is no log: never raises for what is in it."""
    names = {NUMBERS[name]: name for name in channels}
    if not path.is_file():  # opening a FIFO waits for whoever writes to it
        return
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[: len(MAGIC)] != MAGIC:
                return
            found = _chunks_with(data, names.keys())
            for span in reversed(found) if newest_first else found:
                messages = list(_messages(data, span, names))
                yield from reversed(messages) if newest_first else messages
    except (OSError, ValueError):  # gone, no file, or empty
        return


def _chunks_with(data: mmap.mmap, wanted: Collection[int]) -> list[Span]:
    def read_at(length: int, offset: int) -> bytes:
        if offset + length > len(data):
            raise EOFError
        return data[offset : offset + length]

    found: list[Span] = []
    try:
        for item in spans(read_at, len(data)):
            if isinstance(item, Span):
                if not wanted or item.counts.keys() & wanted:
                    found.append(item)
            elif item[1][0] == Opcode.DATA_END:
                break
    except EOFError:  # a crash cut it, or a length is wrong
        pass
    return found


def _messages(data: mmap.mmap, span: Span, names: dict[int, str]) -> Iterator[Struct]:
    crc = CHUNK.unpack_from(data, span.offset)[5]
    if span.size > MAX_CHUNK:
        return
    try:
        packed = data[span.offset + CHUNK.size : span.offset + span.length]
        if zstandard.get_frame_parameters(packed).content_size != span.size:  # else so much memory is asked for, whatever it says
            return
        content = _DECOMPRESSOR.decompress(packed, max_output_size=span.size)
    except zstandard.ZstdError:
        return
    if zlib.crc32(content) != crc:
        return
    at = 0
    while at + RECORD.size <= len(content):
        opcode, length = RECORD.unpack_from(content, at)
        end = at + RECORD.size + length
        if opcode == Opcode.MESSAGE and end <= len(content) and at + MESSAGE.size <= end:
            name = names.get(MESSAGE.unpack_from(content, at)[2])
            if name is not None:
                try:
                    yield decoder(name).decode(content[at + MESSAGE.size : end])
                except (msgspec.DecodeError, ValueError, RecursionError):  # of another version
                    return
        at = end
