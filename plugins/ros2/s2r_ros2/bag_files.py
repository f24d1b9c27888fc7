"""A bag of any kind as messages: one MCAP or SQLite file, a ROS 1 bag, or a folder with the parts of a split bag and its metadata.yaml.

The parts are read in the order of metadata.yaml, or, where the recorder died before it wrote that, of the numbers in their names. A part
that metadata.yaml names and that is not there is said.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from pathlib import Path

import zstandard

from s2r_ros2.mcap_records import Bag
from s2r_ros2.records import ZSTD, Channel, Definition, Message, Messages
from s2r_ros2.rosbag1_records import Rosbag1
from s2r_ros2.sqlite_records import SQLITE, SqliteBag
from s2r_runtime.errors import RecordingError

METADATA = "metadata.yaml"
METADATA_BYTES = 20_000_000
SUFFIXES = (".mcap", ".db3")
PACKED = ("", ".zstd", ".gz")
_PATHS = re.compile(r"^(\s*)relative_file_paths:\s*\n((?:\1\s*-[^\n]*\n?)+)", re.MULTILINE)
_ITEM = re.compile(r"^\s*-\s*(.*?)\s*$", re.MULTILINE)


def open_bag(path: Path) -> Messages:
    """The reader for it, by its content. Raises RecordingError."""
    if path.is_dir():
        return _Folder(path)
    try:
        with path.open("rb") as file:
            start = file.read(len(SQLITE))
            file.seek(0)
            if start.startswith(ZSTD):
                start = zstandard.ZstdDecompressor().stream_reader(file).read(len(SQLITE))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    except zstandard.ZstdError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from None
    if start.startswith(b"#ROSBAG"):
        return Rosbag1(path)
    if start.startswith(SQLITE) or path.name.lower().endswith((".db3", ".db3.gz")):
        return SqliteBag(path)
    return Bag(path)


class _Folder:
    """A bag folder (`records.Messages`). missing: parts that are not there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: dict[Channel, int] = {}
        self.definitions: dict[str, Definition] = {}
        self.broken = 0
        self.cut = False
        self.parts, self.missing = _parts(path)

    def messages(self, only: Container[str] | None = None) -> Iterator[Message]:
        """Messages of these topics, part after part. A part that cannot be read at all is counted as broken if others can."""
        self.cut = bool(self.missing)
        trouble: RecordingError | None = None
        for part in self.parts:
            bag = open_bag(part)
            bag.definitions = self.definitions
            try:
                yield from bag.messages(only)
            except RecordingError as error:
                trouble = trouble or error
                self.broken += 1
            for channel, count in bag.counts.items():
                self.counts[channel] = self.counts.get(channel, 0) + count
            self.broken += bag.broken
            self.cut |= bag.cut
        if trouble is not None and not any(self.counts.values()):
            raise trouble


def _parts(path: Path) -> tuple[list[Path], list[str]]:
    """Files of the bag in their order, and names of those that are not there. Raises RecordingError."""
    named = _named(path / METADATA)
    found = []
    missing = []
    for name in named:
        there = next((one for one in ((path / Path(name).name).with_name(Path(name).name + end) for end in PACKED) if one.is_file()), None)
        if there is None:
            missing.append(name)
        elif there not in found:
            found.append(there)
    if not found:
        ends = tuple(suffix + end for suffix in SUFFIXES for end in PACKED)
        found = sorted((one for one in path.iterdir() if one.is_file() and one.name.lower().endswith(ends)), key=_order)
    if not found:
        names = f"; {METADATA} names {', '.join(missing[:3])}" if missing else ""
        raise RecordingError(f"{path}: this folder has no part of a ROS 2 bag (.mcap, .db3){names}")
    return found, missing


def _named(metadata: Path) -> list[str]:
    """`relative_file_paths` of metadata.yaml, which is all of it that is needed."""
    try:
        if metadata.stat().st_size > METADATA_BYTES:
            return []
        text = metadata.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    match = _PATHS.search(text)
    return [item.strip("'\"") for item in _ITEM.findall(match.group(2))] if match else []


def _order(path: Path) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", path.name)]
