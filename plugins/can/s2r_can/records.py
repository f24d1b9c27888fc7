"""CAN frames as bytes, as they stand in the runtime's log: records, one after the other.

    stamp_ns  u64   when it came, on the host's monotonic clock; 0 in a frame that was sent
    id        u32   identifier, and SocketCAN's flags: bit 31 extended, 30 remote, 29 error frame
    flags     u8    1 CAN FD, 2 bit-rate switch, 4 error state indicator, 8 a bus-off that stops the robot until a person clears it
    length    u8    bytes of payload, 0 to 64
    payload

little endian. An identifier with its flags is called a *key* here. Error frames have SocketCAN's error class as identifier.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

HEADER = struct.Struct("<QIBB")
EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
FD, SWITCH, INDICATOR, STOPS = 1, 2, 4, 8
PAYLOAD_MAX = 64
STAMP_MAX = 1e11
"""s: no log's clock is beyond that."""
RECORDS_MAX = 4096
"""Bytes of records in one frame that is decoded: a receiver with the longest queue gives fewer at a time."""
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""What a CAN FD frame can carry, bytes."""

BUS_OFF, RESTARTED = 0x40, 0x100
"""Error classes (linux/can/error.h): the controller left the bus; it is back."""


class LogFrame(NamedTuple):
    """A frame of a log. t: s, as the log counts. channel: as the log calls it. key: identifier with its flags."""

    t: float
    channel: str
    key: int
    payload: bytes


def frame_of(message: Any, t: float) -> LogFrame | None:
    """A frame from python-can's Message; None for one that cannot be: a stamp that is no time, an identifier or a length beyond CAN's."""
    identifier, payload = message.arbitration_id, bytes(message.data)
    if not abs(t) < STAMP_MAX or not 0 <= identifier <= (0x1FFFFFFF if message.is_extended_id else 0x7FF):
        return None
    if message.is_error_frame:
        return LogFrame(t, str(message.channel), identifier | ERROR, payload)
    if message.is_remote_frame and not message.is_fd:  # CAN FD has none: python-can's ASC reader takes a frame without data for one
        return LogFrame(t, str(message.channel), key_of(identifier, extended=message.is_extended_id) | REMOTE, b"")
    if len(payload) > PAYLOAD_MAX or (not message.is_fd and len(payload) != min(message.dlc, 8)):
        return None
    return LogFrame(t, str(message.channel), key_of(identifier, extended=message.is_extended_id), payload)


class Record(NamedTuple):
    """One CAN frame. key: identifier with its flags."""

    stamp_ns: int
    key: int
    flags: int
    payload: bytes


def packed(record: Record) -> bytes:
    """Its bytes."""
    return HEADER.pack(record.stamp_ns, record.key, record.flags, len(record.payload)) + record.payload


def records(data: bytes) -> Iterator[Record]:
    """The records in a frame's bytes. Raises ValueError where they are none."""
    at, end = 0, len(data)
    while at < end:
        if end - at < HEADER.size:
            raise ValueError(f"{end - at} bytes are no CAN frame")
        stamp_ns, key, flags, length = HEADER.unpack_from(data, at)
        at += HEADER.size
        if length > end - at or length > PAYLOAD_MAX:
            raise ValueError(f"a payload of {length} bytes, {end - at} are there")
        yield Record(stamp_ns, key, flags, data[at : at + length])
        at += length


def key_of(arbitration_id: int, *, extended: bool) -> int:
    """The key of a data frame."""
    return arbitration_id | EXTENDED if extended else arbitration_id


def spelled(key: int) -> str:
    """An identifier as people write it."""
    return f"{key & 0x1FFFFFFF:08X}" if key & EXTENDED else f"{key & 0x7FF:03X}"
