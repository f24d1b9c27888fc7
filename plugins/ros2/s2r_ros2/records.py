"""Messages of a bag, whatever the bag's format: what its readers have in common.

A message's payload may be compressed by itself (rosbag2's compression mode `message`): it then begins as a zstd frame does, 28 b5 2f fd,
which no CDR does (its first byte is 00).
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

import zstandard

ZSTD = b"\x28\xb5\x2f\xfd"
PAYLOAD_BYTES = 1 << 26
"""Of a message that was decompressed at most; what is longer is taken for damage."""


class Channel(NamedTuple):
    """A topic. kind: the message's type, as `nav_msgs/msg/Odometry`; encoding: of its payloads (`cdr`; `ros1` in bags of ROS 1)."""

    topic: str
    kind: str
    encoding: str


class Message(NamedTuple):
    """log_ns: when it was recorded."""

    channel: Channel
    log_ns: int
    data: bytes


class Definition(NamedTuple):
    """How a bag describes a type. language: `ros2msg`, `ros2idl`, `ros1msg`."""

    language: str
    text: str


class Messages(Protocol):
    """A bag that is being read. counts: topics seen so far, with how many messages; definitions: by type; broken: parts or payloads left
    out; cut: it ends before its end. `messages` gives those of the topics in `only` (None: all); the others are counted. Raises
    RecordingError for what is no bag.
    """

    path: Path
    counts: dict[Channel, int]
    definitions: dict[str, Definition]
    broken: int
    cut: bool

    def messages(self, only: Container[str] | None = None) -> Iterator[Message]:
        """All messages, in the bag's order."""


def kind_of(name: str) -> str:
    """`nav_msgs/msg/Odometry`, also of `nav_msgs/Odometry`, as ROS 1 and converters write it."""
    return name.replace("/", "/msg/") if name.count("/") == 1 else name


def unpacked(data: bytes) -> bytes:
    """The payload of a message that may be compressed by itself. Raises ValueError."""
    if not data.startswith(ZSTD):
        return data
    try:
        found = zstandard.ZstdDecompressor().stream_reader(data).read(PAYLOAD_BYTES + 1)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from None
    if len(found) > PAYLOAD_BYTES:
        raise ValueError(f"a message of more than {PAYLOAD_BYTES} bytes")
    return bytes(found)
