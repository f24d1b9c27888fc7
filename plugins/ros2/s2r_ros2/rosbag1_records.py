"""The messages of a ROS 1 bag (`.bag`, version 2.0), through `rosbags`, chunk by chunk.

A bag without an index (its recorder was killed: `.bag.active`) has to be indexed first (`rosbag reindex`). Chunks are unpacked to a bounded
size.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable, Container, Iterator
from pathlib import Path
from typing import Any

import lz4.frame

from s2r_ros2.records import Channel, Definition, Message, kind_of
from s2r_runtime.errors import RecordingError, one_line

CHUNK_BYTES = 1 << 30
"""Of an unpacked chunk at most (`rosbag record` makes chunks of 768 kB)."""


class Rosbag1:
    """A ROS 1 bag (`records.Messages`), whose payloads are serialized as ROS 1 does (encoding `ros1`)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: dict[Channel, int] = {}
        self.definitions: dict[str, Definition] = {}
        self.broken = 0
        self.cut = False

    def messages(self, only: Container[str] | None = None) -> Iterator[Message]:
        """Messages of these topics (None: of all), by the time of recording. Raises RecordingError; ImportError without `rosbags`."""
        from rosbags.rosbag1 import Reader

        reader: Any = Reader(self.path)
        try:
            reader.open()
        except Exception as error:  # noqa: BLE001 - it raises what it likes at bytes that are no bag
            raise RecordingError(f"{self.path}: this ROS 1 bag cannot be read: {_said(error)}") from None
        try:
            yield from self._opened(reader, only)
        finally:
            reader.close()

    def _opened(self, reader: Any, only: Container[str] | None) -> Iterator[Message]:
        for place, chunk in reader.chunks.items():
            reader.chunks[place] = chunk._replace(decompressor=_bounded(chunk.decompressor))
        channels: dict[int, Channel] = {}
        chosen = []
        for connection in reader.connections:
            channel = Channel(connection.topic, kind_of(connection.msgtype), "ros1")
            channels[connection.id] = channel
            self.counts.setdefault(channel, 0)
            self.definitions.setdefault(channel.kind, Definition("ros1msg", connection.msgdef.data))
            if only is None or connection.topic in only:
                chosen.append(connection)
            else:
                self.counts[channel] += connection.msgcount
        if not chosen:
            return
        try:
            for connection, t_ns, data in reader.messages(connections=chosen):
                channel = channels[connection.id]
                self.counts[channel] += 1
                yield Message(channel, t_ns, bytes(data))
        except Exception as error:  # noqa: BLE001 - as above
            if not any(self.counts[channels[one.id]] for one in chosen):
                raise RecordingError(f"{self.path}: this ROS 1 bag cannot be read: {_said(error)}") from None
            self.cut = True


def _bounded(decompress: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """The same, to a bounded size. Which one it is shows in what the data begin with; a chunk as it is begins with a small length."""

    def unpack(data: bytes) -> bytes:
        if data.startswith(b"BZh"):
            return bz2.BZ2Decompressor().decompress(data, CHUNK_BYTES)
        if data.startswith(b"\x04\x22\x4d\x18"):
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=CHUNK_BYTES))
        return decompress(data)

    return unpack


def _said(error: Exception) -> str:
    text = one_line(str(error), 120) or type(error).__name__
    return text + ("; rosbag reindex makes the index" if "index" in text.lower() else "")
