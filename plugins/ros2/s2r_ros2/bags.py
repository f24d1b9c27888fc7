"""The hook `s2r_recordings`: bags of any kind -> states and inputs, by the profile's topics and frames.

Messages are judged as on the wire (`observer.Told`). A pose's stamp is its header's (or, with stamp = arrival, when it was recorded). A
command has no stamp that could be trusted: it counts from when it was recorded, log time l, which is brought to the clock of the stamps
(`s2r_runtime.recordings.formats.clock`), and acts until the next one, or for `command_timeout`.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_ros2.bag_files import open_bag
from s2r_ros2.cdr import Malformed
from s2r_ros2.interfaces import TWIST, TWIST_STAMPED
from s2r_ros2.observer import Told
from s2r_ros2.options import TWIST_FIELDS, Options, checked
from s2r_ros2.payloads import decode_transforms, decode_twist, decode_twist_stamped
from s2r_ros2.records import Message
from s2r_ros2.typed import Types
from s2r_runtime.errors import MissingSignal, RecordingError
from s2r_runtime.hookspecs import ReadLog
from s2r_runtime.recordings.formats.clock import newer, on_stamps, stretches

Array = NDArray[np.float64]
Rows = tuple[Array, Array]

NAMED_MOST = 12
"""Topics or frames that a message names."""
_TWISTS = {TWIST: decode_twist, TWIST_STAMPED: decode_twist_stamped}


class _Read:
    """What a bag says: poses (log ns, stamp ns, states) and commands (log ns, inputs), in its order."""

    def __init__(self, path: Path, options: Options) -> None:
        self.bag, self._options = open_bag(path), options
        self._types = Types(self.bag.definitions)
        self._told = Told(options)
        self._columns = [TWIST_FIELDS.index(field) for field in options.fields]
        self.poses: list[tuple[int, int, tuple[float, ...]]] = []
        self.commands: list[tuple[int, tuple[float, ...]]] = []
        self.wrong: Counter[str] = Counter()
        self.edges: Counter[tuple[str, str]] = Counter()
        pose, command = _names(options, options.pose_topic), _names(options, options.command_topic)
        for message in self.bag.messages(pose | command):
            channel = message.channel
            if channel.encoding not in ("cdr", "ros1"):
                continue
            if channel.topic in pose and channel.kind == options.pose_type:
                self._pose(message)
            elif channel.topic in command and channel.kind in _TWISTS:
                self._command(message)
        self.poses.sort(key=lambda row: row[0])
        self.commands.sort(key=lambda row: row[0])

    def _pose(self, message: Message) -> None:
        log_ns = message.log_ns
        try:
            data = self._cdr(message)
            found = self._told.poses(data)
            if not found:
                self.edges.update((at.frame, at.child) for at in decode_transforms(data))
        except Malformed as error:
            self.wrong[str(error)] += 1
            return
        for stamp_ns, x in found:
            self.poses.append((log_ns, log_ns if self._options.stamp == "arrival" else stamp_ns, x))

    def _cdr(self, message: Message) -> bytes:
        """The payload as ROS 2 has it. Raises Malformed."""
        try:
            return self._types.to_cdr(message.channel, message.data)
        except ValueError as error:
            raise Malformed(str(error)) from None

    def _command(self, message: Message) -> None:
        log_ns, channel = message.log_ns, message.channel
        try:
            twist = _TWISTS[channel.kind](self._cdr(message))
        except Malformed as error:
            self.wrong[f"{channel.topic}: {error}"] += 1
            return
        u = tuple(twist[column] for column in self._columns)
        if all(map(np.isfinite, u)):
            self.commands.append((log_ns, u))
        else:
            self.wrong[f"{channel.topic}: not finite"] += 1

    def notes(self) -> tuple[str, ...]:
        """What was left out."""
        told = []
        if self.bag.cut:
            missing = getattr(self.bag, "missing", [])
            told.append(
                f"parts that metadata.yaml names are missing: {', '.join(missing)}" if missing else "ends early; it is read up to there"
            )
        if self.bag.broken:
            told.append(f"{self.bag.broken} damaged parts or messages are left out")
        if self.wrong:
            why, _ = self.wrong.most_common(1)[0]
            told.append(f"{self.wrong.total()} messages are left out, most often: {why}")
        return tuple(told)

    def check(self) -> None:
        """Raises RecordingError for a bag that lacks what is needed, naming what it has."""
        o, path = self._options, self.bag.path
        if not self.bag.counts:
            raise RecordingError(f"{path}: holds no topic" + (" (it ends early)" if self.bag.cut else ""))
        there = _listed(
            f"{c.topic} ({c.kind or 'no type'}{'' if c.encoding == 'cdr' else ', ' + c.encoding}, {n})" for c, n in self.bag.counts.items()
        )
        if not self.poses:
            if self.edges:
                frames = _listed(f"{frame} -> {child}" for frame, child in self.edges)
                raise MissingSignal(f"{path}: has no transform {o.frame} -> {o.child_frame}; it has: {frames}")
            if self.wrong:
                why, count = self.wrong.most_common(1)[0]
                raise RecordingError(f"{path}: no pose in it can be believed; {count} of them: {why}")
            wanted = " or ".join(sorted(_names(o, o.pose_topic)))
            raise MissingSignal(f"{path}: holds no {o.pose_type} on {wanted}; it has: {there}")
        if not self.commands:
            wanted = " or ".join(sorted(_names(o, o.command_topic)))
            raise MissingSignal(f"{path}: holds no {TWIST} or {TWIST_STAMPED} on {wanted}; it has: {there}")


def read(path: Path, states: tuple[str, ...], inputs: tuple[str, ...], options: dict[str, Any]) -> ReadLog:
    """A bag's stretches; see `hookspecs.s2r_recordings`. Raises ConfigError, RecordingError."""
    known = checked(options, states, inputs, connected=False)
    found = _Read(path, known)
    found.check()
    origin = found.poses[0][1]
    log = np.array([row[0] - origin for row in found.poses]) * 1e-9
    stamps = np.array([row[1] - origin for row in found.poses]) * 1e-9
    x = np.array([row[2] for row in found.poses]).reshape(-1, len(states))
    log_u = np.array([row[0] - origin for row in found.commands]) * 1e-9
    u = np.array([row[1] for row in found.commands]).reshape(-1, len(inputs))
    given = []
    for part in stretches(log, stamps):
        at, rows = stamps[part.rows], x[part.rows]
        kept = newer(at)
        chosen = (log_u >= part.since) & (log_u < part.until)
        t_u = on_stamps(log[part.rows], at, log_u[chosen])
        given.append(((at[kept], rows[kept]), _lapsing(t_u, u[chosen], known.command_timeout)))
    usual = () if options else (f"states from {known.pose_topic}, inputs from {known.command_topic}, by their usual names",)
    return ReadLog(given, (*usual, *found.notes()))


def _lapsing(t: Array, u: Array, timeout_s: float) -> Rows:
    """A command acts until the next one, or until the robot stops on its own. Stamps that fall back (clocks) are held up."""
    t = np.maximum.accumulate(t)
    lapsed = np.flatnonzero(np.append(np.diff(t), np.inf) > timeout_s)
    if timeout_s == np.inf or not len(t):
        return t, u
    return np.insert(t, lapsed + 1, t[lapsed] + timeout_s), np.insert(u, lapsed + 1, 0.0, axis=0)


def _names(options: Options, topic: str) -> set[str]:
    """How a bag may name a topic: as the robot's nodes do, which is without a bridge's namespace."""
    bare = "/" + topic.strip("/")
    return {bare, "/" + options.namespace + bare} if options.namespace else {bare}


def _listed(texts: Any) -> str:
    named = sorted(texts)
    more = f" and {len(named) - NAMED_MOST} more" if len(named) > NAMED_MOST else ""
    return ", ".join(named[:NAMED_MOST]) + more
