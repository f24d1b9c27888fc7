"""A bag as named time series (hook `s2r_formats`): every topic with numbers, and every pair of frames of a transform topic.

    /odom                      fields of its messages: /odom.pose.pose.position.x
    /tf[odom->base_footprint]  translation.x, ..., rotation: one topic a pair of frames

Topics are listed in one pass that decodes the first message of each; signals are read in a second pass that decodes only their topics.
Messages are taken one by one: memory holds the numbers that are wanted, a chunk of the file, and nothing else.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from s2r_ros2.bag_files import open_bag
from s2r_ros2.cdr import Malformed
from s2r_ros2.interfaces import TF
from s2r_ros2.payloads import Located, decode_transforms
from s2r_ros2.records import Channel, Message, Messages
from s2r_ros2.typed import LARGEST_BYTES, Types, fields_of, getter_of, stamp_of
from s2r_runtime.errors import RecordingError
from s2r_runtime.recordings.formats.series import Run, Samples, Topic

TREES = (TF, "tf/msg/tfMessage")
PAIRS = 64
"""Pairs of frames of a transform topic that are listed."""
TRANSFORM = ("translation.x", "translation.y", "translation.z", "rotation.x", "rotation.y", "rotation.z", "rotation.w")
ENCODINGS = ("cdr", "ros1")
NS = 1e-9


class _Seen:
    """What a pass knows of a topic."""

    def __init__(self, kind: str) -> None:
        self.kind, self.n, self.first, self.last = kind, 0, 0, 0
        self.fields: list[str] = []
        self.note = ""
        self.tried = False

    def at(self, t_ns: int) -> None:
        self.first = min(self.first, t_ns) if self.n else t_ns
        self.last = max(self.last, t_ns) if self.n else t_ns
        self.n += 1

    def topic(self, name: str) -> Topic:
        first, last = (self.first * NS, self.last * NS) if self.n else (float("nan"), float("nan"))
        return Topic(name, self.kind, self.n, first, last, dict.fromkeys(self.fields, ""), self.note)


class _Column:
    """Samples of a topic as they are read."""

    def __init__(self, fields: Sequence[str]) -> None:
        self.fields = list(fields)
        self.t, self.stamp = array("d"), array("d")
        self.values = [array("d") for _ in fields]
        self.stamped = False

    def add(self, t_ns: int, stamp_ns: int, numbers: Sequence[float]) -> None:
        self.t.append(t_ns * NS)
        self.stamp.append(stamp_ns * NS)
        self.stamped |= stamp_ns != 0
        for column, number in zip(self.values, numbers, strict=True):
            column.append(number)

    def samples(self) -> Samples:
        t = np.array(self.t)
        order = np.argsort(t, kind="stable")
        values = {name: np.array(column)[order] for name, column in zip(self.fields, self.values, strict=True)}
        return Samples(t[order], values, np.array(self.stamp)[order] if self.stamped else None)


class BagSeries:
    """`Opened` for a bag."""

    drawn = False

    def __init__(self, path: Path) -> None:
        import rosbags.typesys  # noqa: F401 - fields of messages need it: said before anything is read

        self._path = path
        self.notes: list[str] = []
        self.kind = "ROS 1 bag" if _is_rosbag1(path) else "ROS 2 bag"
        self._topics: list[Topic] | None = None

    def topics(self) -> list[Topic]:
        """All topics, in the order of their names."""
        if self._topics is None:
            self._topics = self._listed()
        return self._topics

    def read(self, wanted: Mapping[str, Sequence[str]]) -> list[Run]:
        """Samples of these fields. Messages that are no such messages are left out, and counted in a note."""
        columns = {name: _Column(fields) for name, fields in wanted.items()}
        getters = {name: [getter_of(field) for field in fields] for name, fields in wanted.items()}
        trees = {name.partition("[")[0] for name in wanted if "->" in name}
        bag = open_bag(self._path)
        types = Types(bag.definitions)
        wrong: Counter[str] = Counter()
        for message in bag.messages({*wanted, *trees}):
            topic = message.channel.topic
            try:
                if topic in trees:
                    for name, at in _transforms(message, types):
                        if name in columns:
                            located = dict(zip(TRANSFORM, (*at.position, *at.orientation), strict=True))
                            columns[name].add(message.log_ns, at.stamp_ns, [located[field] for field in columns[name].fields])
                    continue
                found = types.decode(message.channel, message.data)
            except ValueError as error:
                wrong[str(error)] += 1
                continue
            columns[topic].add(message.log_ns, stamp_of(found), [get(found) for get in getters[topic]])
        self.notes = self._notes(bag, wrong)
        return [Run({name: column.samples() for name, column in columns.items()})]

    def _listed(self) -> list[Topic]:
        bag = open_bag(self._path)
        types = Types(bag.definitions)
        seen: dict[str, _Seen] = {}
        for message in bag.messages():
            topic = seen.setdefault(message.channel.topic, _Seen(message.channel.kind))
            topic.at(message.log_ns)
            if message.channel.kind in TREES:
                _note_pairs(seen, message, types)
            elif not topic.tried:
                topic.tried = True
                topic.fields, topic.note = _described(message, types)
        for channel in bag.counts:
            seen.setdefault(channel.topic, _Seen(channel.kind))
        self.notes = self._notes(bag, Counter())
        if not seen:
            raise RecordingError(f"{self._path}: this bag holds no topic" + (" (it ends early)" if bag.cut else ""))
        return [seen[name].topic(name) for name in sorted(seen)]

    def _notes(self, bag: Messages, wrong: Counter[str]) -> list[str]:
        notes = []
        if bag.cut:
            missing = getattr(bag, "missing", [])
            notes.append(
                f"parts that metadata.yaml names are missing: {', '.join(missing)}" if missing else "ends early; it is read up to there"
            )
        if bag.broken:
            notes.append(f"{bag.broken} damaged parts or messages are left out")
        if wrong:
            why, _ = wrong.most_common(1)[0]
            notes.append(f"{wrong.total()} messages could not be decoded, and are left out: {why}")
        return notes


def _described(message: Message, types: Types) -> tuple[list[str], str]:
    """Fields of a topic by its first message, and why there are none."""
    channel = message.channel
    if channel.encoding not in ENCODINGS:
        return [], f"encoding {channel.encoding or 'unknown'}, must be cdr"
    if len(message.data) > LARGEST_BYTES:
        return [], f"messages of {len(message.data)} bytes: images, clouds and the like have no signals"
    try:
        return list(fields_of(types.decode(channel, message.data))), ""
    except ValueError as error:
        return [], str(error)


def _note_pairs(seen: dict[str, _Seen], message: Message, types: Types) -> None:
    try:
        found = _transforms(message, types)
    except ValueError:
        return
    for name, _ in found:
        if name not in seen and sum(1 for one in seen if one.startswith(f"{message.channel.topic}[")) >= PAIRS:
            continue
        pair = seen.setdefault(name, _Seen(TF))
        pair.fields = list(TRANSFORM)
        pair.at(message.log_ns)


def _transforms(message: Message, types: Types) -> list[tuple[str, Located]]:
    """(topic of the pair, transform) of a transform message. Raises ValueError."""
    channel: Channel = message.channel
    try:
        found = decode_transforms(types.to_cdr(channel, message.data))
    except Malformed as error:
        raise ValueError(f"{channel.kind}: {error}") from None
    return [(f"{channel.topic}[{at.frame.lstrip('/')}->{at.child.lstrip('/')}]", at) for at in found]


def _is_rosbag1(path: Path) -> bool:
    if path.is_dir():
        return False
    with path.open("rb") as file:
        return file.read(7) == b"#ROSBAG"


def open_series(path: Path) -> Any:
    """The reader of bags. Raises RecordingError, ImportError."""
    return BagSeries(path)
