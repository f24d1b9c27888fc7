"""Takes a log apart, block by block, and trusts none of its bytes.

A block is what lies between two seals (see `chain`). It is given out only when all of it is there and is, byte for byte, what the
writer would have written; otherwise `Damage` says where it isn't.
"""

from __future__ import annotations

import errno
import os
import zlib
from array import array
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.opcode import Opcode

from s2r_runtime.files.limits import ATTACHED, MB
from s2r_runtime.recording.layout import (
    CHUNK,
    CHUNK_FIELDS,
    MAX_CHUNK,
    MAX_MESSAGES,
    MESSAGE,
    MESSAGE_FIELDS,
    RECORD,
    declared,
    index_records,
    stored,
)

_DECOMPRESSOR = zstandard.ZstdDecompressor()
_MARK = (4).to_bytes(4, "little") + b"zstd"
"""What the middle of every chunk's head looks like."""
_MARK_AT = CHUNK.size - 8 - len(_MARK)
ZEROS = 16
"""A block ends with the place of its seal (8 bytes, not 0), so it has no more than 7 zeros at its end."""


class Damage(Exception):
    """Bytes at `offset` are not what they would have to be. `cut`: as if the file just ended there."""

    def __init__(self, offset: int, detail: str, *, cut: bool = False) -> None:
        super().__init__(detail)
        self.offset, self.detail, self.cut = offset, detail, cut


Part = tuple[int, int, int, int, int]
"""One message inside a chunk's content: channel, sequence, log time in ns, start, stop; its data is content[start:stop]."""


class Block(NamedTuple):
    """A block in the file: bytes offset..end are all of it. messages: the seal is the last one.

    `last`: it ends with a data end, not a chunk (then there are no messages). `lacking`: what the file does not have of its
    message index. `plain`: its chunk has the one form that anybody can make of its content (`layout.stored`).
    """

    offset: int
    end: int
    prefix: list[bytes]
    content: bytes
    declarations: list[bytes]
    messages: list[Part]
    last: bool = False
    lacking: bytes = b""
    plain: bool = False


def take(file: BinaryIO, offset: int, size: int, start: bytes = b"", *, strict: bool = True) -> Block | None:
    """The block at `offset` of a file that ends at `size`; None if it ends there.

    start: what the block begins with and has been read already (of the first one). strict: a wrong message index counts; else
    the block ends before it. Raises Damage.
    """
    prefix = [start] if start else []
    at = offset + len(start)
    while True:
        head = file.read(max(0, min(RECORD.size, size - at)))
        if not head:
            if prefix:
                raise Damage(offset, "the records at the end were not sealed", cut=True)
            return None
        if len(head) < RECORD.size:
            raise Damage(at, "the file ends inside a record", cut=True)
        opcode, length = RECORD.unpack(head)
        if opcode == Opcode.DATA_END:
            return Block(offset, at, prefix, b"", [], [], last=True)
        if opcode not in {Opcode.ATTACHMENT, Opcode.METADATA, Opcode.CHUNK}:
            raise Damage(at, f"a record of kind {opcode} has no place here")
        if opcode == Opcode.CHUNK:
            block, wrong = _chunk_block(file, offset, at, size, prefix, head)
            if strict and wrong:
                raise Damage(block.end, "a chunk's index is not that of its messages")
            return block
        if at + RECORD.size + length > size:
            raise Damage(at, "the file ends inside an attachment", cut=True)
        if at + RECORD.size + length - offset > ATTACHED.value():  # before memory is taken for what a length claims
            raise Damage(at, f"attachments of more than {ATTACHED.value() / MB:g} MB in a row; {ATTACHED.more()}")
        prefix.append(head + file.read(length))
        at += RECORD.size + length


def _chunk_block(file: BinaryIO, offset: int, at: int, size: int, prefix: list[bytes], head: bytes) -> tuple[Block, bool]:
    """The block whose chunk stands at `at`, and whether its index is wrong (then it ends before the index)."""
    if at + CHUNK.size > size:
        raise Damage(at, "the file ends inside a chunk", cut=True)
    head += file.read(CHUNK_FIELDS)
    _, length, first, last, content_size, crc, name_size, name, data_size = CHUNK.unpack(head)
    if (name_size, name, data_size + CHUNK_FIELDS) != (4, b"zstd", length) or max(content_size, data_size) > MAX_CHUNK:
        raise Damage(at, "a chunk's head contradicts itself")
    if at + CHUNK.size + data_size > size:
        raise Damage(at, "the file ends inside a chunk", cut=True)
    data = file.read(data_size)
    content = _content(data, content_size, crc, at)
    declarations, messages, index = _walk(content, at)
    if (first, last) != (messages[0][2], messages[-1][2]):
        raise Damage(at, "a chunk's times are not those of its messages")
    expected = index_records(index)
    index_at = at + CHUNK.size + data_size
    found = file.read(min(len(expected), size - index_at))
    plain = data_size > content_size and len(messages) == 1 and data == stored(content)
    block = Block(offset, index_at + len(found), prefix, content, declarations, messages, lacking=expected[len(found) :], plain=plain)
    if found == expected or (index_at + len(found) == size and expected.startswith(found)):
        return block, False
    return block._replace(end=index_at, lacking=expected), True


def _content(data: bytes, size: int, crc: int, at: int) -> bytes:
    try:
        if zstandard.get_frame_parameters(data).content_size != size:
            raise Damage(at, "a chunk's size is not that of its content")
        content = _DECOMPRESSOR.decompress(data, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise Damage(at, f"a chunk cannot be decompressed: {error}") from None
    if len(content) != size or zlib.crc32(content) != crc:
        raise Damage(at, "a chunk's content does not have its CRC")
    return content


def _walk(content: bytes, at: int) -> tuple[list[bytes], list[Part], dict[int, array[int]]]:
    """Declarations, messages and index of a chunk's content. Its CRC holds, so anything wrong here was written so."""
    declarations: list[bytes] = []
    messages: list[Part] = []
    index: dict[int, array[int]] = {}
    position, size = 0, len(content)
    unpack, step, head, least, message = MESSAGE.unpack_from, MESSAGE.size, RECORD.size, MESSAGE_FIELDS, int(Opcode.MESSAGE)
    padded = content + bytes(step)  # so that a message's head can be looked for wherever a record begins
    while position < size:
        opcode, length, channel, sequence, log_time, publish_time = unpack(padded, position)
        stop = position + head + length
        if stop > size or position + head > size:
            raise Damage(at, "a chunk's content ends inside a record")
        if opcode != message or length < least:
            if messages:
                raise Damage(at, "a chunk's content is not in order")
            declarations.append(content[position:stop])
        else:
            if publish_time != log_time:
                raise Damage(at, "a message has two times")
            if len(messages) == MAX_MESSAGES:
                raise Damage(at, f"a chunk holds more than {MAX_MESSAGES} messages")
            messages.append((channel, sequence, log_time, position + step, stop))
            if (pairs := index.get(channel)) is None:
                pairs = index[channel] = array("Q")
            pairs.append(log_time)
            pairs.append(position)
        position = stop
    if not messages:
        raise Damage(at, "a chunk holds no message")
    try:
        declared(declarations)
    except ValueError as error:
        raise Damage(at, str(error)) from None
    return declarations, messages, index


def extent(file: BinaryIO, size: int) -> int:
    """Bytes of a file of `size` bytes without the zeros at its end: a file system may leave those of a write that a power cut stopped.

    Fewer than ZEROS may be its own.
    """
    end = _after_data(file, size)
    while end > 0:
        start = max(0, end - (1 << 20))
        file.seek(start)
        kept = file.read(end - start).rstrip(b"\0")
        if kept:
            end = start + len(kept)
            break
        end = start
    return end if size - end >= ZEROS else size


def _after_data(file: BinaryIO, size: int) -> int:
    """Where the hole begins that a sparse file ends with, by bisection; `size` if there is none."""
    low, high = 0, size
    while low < high:
        middle = (low + high) // 2
        if _next_data(file, middle) is None:
            high = middle
        else:
            low = middle + 1
    return low


def _next_data(file: BinaryIO, offset: int) -> int | None:
    """Where a sparse file has data at or after an offset; None for nowhere, and the offset itself where a file system cannot say."""
    descriptor = file.fileno()
    before = os.lseek(descriptor, 0, os.SEEK_CUR)  # the file object counts on it
    try:
        return os.lseek(descriptor, offset, os.SEEK_DATA)
    except OSError as error:
        return None if error.errno == errno.ENXIO else offset
    finally:
        os.lseek(descriptor, before, os.SEEK_SET)


def find(file: BinaryIO, offset: int, size: int) -> int | None:
    """Offset of the next sound chunk at or after `offset`, however bad what lies before it; None if there is none."""
    window = 1 << 20
    at = offset
    while at < size and (there := _next_data(file, at)) is not None:
        at = max(at, there - _MARK_AT - len(_MARK))  # a hole holds no chunk
        file.seek(at)
        data = file.read(window + _MARK_AT + len(_MARK))
        position = data.find(_MARK, _MARK_AT)
        while position != -1:
            if _is_chunk(file, at + position - _MARK_AT, size):
                return at + position - _MARK_AT
            position = data.find(_MARK, position + 1)
        at += window
    return None


def _is_chunk(file: BinaryIO, offset: int, size: int) -> bool:
    file.seek(offset)
    if file.read(1) != bytes([Opcode.CHUNK]):
        return False
    file.seek(offset)
    try:
        return take(file, offset, size, strict=False) is not None
    except Damage:
        return False
