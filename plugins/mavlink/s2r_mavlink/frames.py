"""MAVLink framing: bytes on a line -> whole frames, and back. What this module lets through is whole; who sent it is not its business.

    version 2   FD  length  incompat  compat  sequence  system  component  number[3]  payload[length]  checksum[2]  (signature[13])
    version 1   FE  length                    sequence  system  component  number     payload[length]  checksum[2]

    checksum = CRC-16/MCRF4XX over everything between the first byte and itself, then the message's CRC_EXTRA
    incompat bit 0: a signature follows; any other bit set: a frame that nobody here understands

Where a checksum fails, the next byte may already begin a good frame, so a bad frame never takes a good one with it. A message that the
dialect doesn't have can't be checked: it counts as a frame if the next one begins, or the bytes end, right behind it.
"""

from __future__ import annotations

from typing import NamedTuple

from fastcrc.crc16 import mcrf4xx as crc16

from s2r_mavlink.dialect import CRC_EXTRA

V1, V2 = 0xFE, 0xFD
SIGNED = 0x01
SIGNATURE = 13
LONGEST = 280
"""Bytes of the longest frame: 10 of header, 255 of payload, 2 of checksum, 13 of signature."""
DATAGRAM = 1400
"""Bytes of a datagram that no network in common use has to cut."""
FALSE_STARTS = 512
"""False starts of frames after which the rest of a piece is dropped: noise has one in 128 bytes, an attack nothing else."""

_EXTRA = {number: bytes([extra]) for number, extra in CRC_EXTRA.items()}


class Header(NamedTuple):
    """What a whole frame says about itself. `known`: the dialect has this message, so its checksum was checked."""

    number: int
    system: int
    component: int
    sequence: int
    signed: bool
    known: bool


def header(frame: bytes) -> Header:
    """Of a whole frame, as `Framer` gives it."""
    if frame[0] == V2:
        number = frame[7] | frame[8] << 8 | frame[9] << 16
        return Header(number, frame[5], frame[6], frame[4], bool(frame[2] & SIGNED), number in _EXTRA)
    return Header(frame[5], frame[3], frame[4], frame[2], False, frame[5] in _EXTRA)


def payload(frame: bytes) -> bytes:
    """Of a whole frame."""
    return frame[10 : 10 + frame[1]] if frame[0] == V2 else frame[6 : 6 + frame[1]]


def length_at(data: bytes, at: int) -> int:
    """Bytes of the frame that begins here; 0 if none does, -1 if too few bytes are there to tell."""
    left = len(data) - at
    if data[at] == V2:
        if left < 3:
            return -1
        flags = data[at + 2]
        return 0 if flags & ~SIGNED else data[at + 1] + 12 + (SIGNATURE if flags else 0)
    if data[at] == V1:
        return data[at + 1] + 8 if left >= 2 else -1
    return 0


def whole(data: bytes, at: int, size: int) -> bool:
    """Whether `size` bytes from here are a frame whose checksum holds (or can't be checked, and the next one begins behind it)."""
    length = data[at + 1]
    if data[at] == V2:
        number, end = data[at + 7] | data[at + 8] << 8 | data[at + 9] << 16, at + 10 + length
    else:
        number, end = data[at + 5], at + 6 + length
    extra = _EXTRA.get(number)
    if extra is None:
        after = at + size
        return after == len(data) or data[after] == V2 or data[after] == V1
    return crc16(data[at + 1 : end] + extra) == data[end] | data[end + 1] << 8


def is_frame(data: bytes) -> bool:
    """Whether these bytes are exactly one whole frame."""
    return len(data) >= 8 and length_at(data, 0) == len(data) and whole(data, 0, len(data))


class Framer:
    """Cuts what a line gives into frames. datagrams: frames do not go on in the next piece. `malformed`: stretches that were no frame.

    A piece costs at most `FALSE_STARTS` checksums that fail, whatever is in it.
    """

    def __init__(self, *, datagrams: bool) -> None:
        self._datagrams = datagrams
        self._rest = b""
        self.malformed = 0

    def feed(self, data: bytes) -> list[bytes]:
        """The whole frames, in order. At most one incomplete frame is kept for the next piece."""
        if self._rest:
            data, self._rest = self._rest + data, b""
        frames: list[bytes] = []
        at, end, bad, false_starts = 0, len(data), False, 0
        while at < end:
            size = length_at(data, at)
            if size > 0 and end - at >= size and whole(data, at, size):
                frames.append(data[at : at + size])
                at += size
                self.malformed += bad
                bad = False
                continue
            if not self._datagrams and (size < 0 or end - at < size):
                self._rest = data[at:]
                break
            bad = True
            false_starts += 1
            if false_starts > FALSE_STARTS:
                break
            at = _next_marker(data, at + 1)
        self.malformed += bad
        return frames


def _next_marker(data: bytes, at: int) -> int:
    """Where the next frame can begin; the end if nowhere."""
    second, first = data.find(V2, at), data.find(V1, at)
    if second < 0 or first < 0:
        return max(second, first) if max(second, first) >= 0 else len(data)
    return min(second, first)


def packed(frames: list[bytes], most: int = DATAGRAM) -> list[bytes]:
    """Frames one behind the other, in pieces of at most `most` bytes."""
    pieces: list[list[bytes]] = []
    room = 0
    for data in frames:
        if len(data) > room or not pieces:
            pieces.append([])
            room = most
        pieces[-1].append(data)
        room -= len(data)
    return [b"".join(piece) for piece in pieces]


def newest(frames: list[bytes], most: int) -> list[bytes]:
    """The last ones that have at most `most` bytes together."""
    first, room = len(frames), most
    while first and len(frames[first - 1]) <= room:
        first -= 1
        room -= len(frames[first])
    return frames[first:]


def build(number: int, content: bytes, sequence: int, system: int, component: int, *, signed: bool = False) -> bytes:
    """A frame of version 2; if `signed`, its signature is still to be put behind it (`Signing.sign`)."""
    front = bytes((len(content), SIGNED if signed else 0, 0, sequence & 0xFF, system, component))
    body = front + number.to_bytes(3, "little") + content
    return b"\xfd" + body + crc16(body + _EXTRA[number]).to_bytes(2, "little")


def renumbered(frame: bytes, sequence: int, *, signed: bool = False) -> bytes:
    """The same message of version 2, unsigned, under another sequence number."""
    return build(header(frame).number, payload(frame), sequence, frame[5], frame[6], signed=signed)
