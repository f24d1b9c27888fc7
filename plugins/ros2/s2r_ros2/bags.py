"""The hook `s2r_recordings`: rosbag2 bags in MCAP files -> states and inputs, by the profile's topics and frames.

Messages are judged as on the wire (`observer.Told`). A pose's stamp is its header's (or, with stamp = arrival, when it was recorded). A
command has no stamp that could be trusted: it counts from when it was recorded, log time l, which is brought to the clock of the stamps s
by

    s = l              if the fastest pose of the stretch was recorded 0 to 0.5 s after its stamp: it is the same clock
    s = l - delay(l)   otherwise (simulated time, another computer's clock); delay: the least of l - s over poses of the same second

and acts until the next one, or for `command_timeout`. Where l - s jumps by more than a second the clock was set, or began anew: another
stretch.
"""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_ros2.cdr import Malformed
from s2r_ros2.interfaces import TWIST, TWIST_STAMPED
from s2r_ros2.mcap_records import Bag, Channel
from s2r_ros2.observer import Told
from s2r_ros2.options import TWIST_FIELDS, Options, checked
from s2r_ros2.payloads import decode_transforms, decode_twist, decode_twist_stamped
from s2r_runtime.errors import RecordingError

Array = NDArray[np.float64]
Rows = tuple[Array, Array]

JUMP_NS = 1_000_000_000
SAME_CLOCK_S = (-0.01, 0.5)
BIN_S = 1.0
NAMED_MOST = 12
"""Topics or frames that a message names."""
_TWISTS = {TWIST: decode_twist, TWIST_STAMPED: decode_twist_stamped}


class _Read:
    """What a bag says: poses (log ns, stamp ns, states) and commands (log ns, inputs), in its order."""

    def __init__(self, path: Path, options: Options) -> None:
        self.bag, self._options = Bag(path), options
        self._told = Told(options)
        self._columns = [TWIST_FIELDS.index(field) for field in options.fields]
        self.poses: list[tuple[int, int, tuple[float, ...]]] = []
        self.commands: list[tuple[int, tuple[float, ...]]] = []
        self.wrong: Counter[str] = Counter()
        self.edges: Counter[tuple[str, str]] = Counter()
        pose, command = _names(options, options.pose_topic), _names(options, options.command_topic)
        for message in self.bag.messages():
            channel = message.channel
            if channel.encoding != "cdr":
                continue
            if channel.topic in pose and channel.kind == options.pose_type:
                self._pose(message.log_ns, message.data)
            elif channel.topic in command and channel.kind in _TWISTS:
                self._command(message.log_ns, channel, message.data)
        self.poses.sort(key=lambda row: row[0])
        self.commands.sort(key=lambda row: row[0])

    def _pose(self, log_ns: int, data: bytes) -> None:
        try:
            found = self._told.poses(data)
            if not found:
                self.edges.update((at.frame, at.child) for at in decode_transforms(data))
        except Malformed as error:
            self.wrong[str(error)] += 1
            return
        for stamp_ns, x in found:
            self.poses.append((log_ns, log_ns if self._options.stamp == "arrival" else stamp_ns, x))

    def _command(self, log_ns: int, channel: Channel, data: bytes) -> None:
        try:
            twist = _TWISTS[channel.kind](data)
        except Malformed as error:
            self.wrong[f"{channel.topic}: {error}"] += 1
            return
        u = tuple(twist[column] for column in self._columns)
        if all(map(np.isfinite, u)):
            self.commands.append((log_ns, u))
        else:
            self.wrong[f"{channel.topic}: not finite"] += 1

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
                raise RecordingError(f"{path}: has no transform {o.frame} -> {o.child_frame}; it has: {frames}")
            if self.wrong:
                why, count = self.wrong.most_common(1)[0]
                raise RecordingError(f"{path}: no pose in it can be believed; {count} of them: {why}")
            wanted = " or ".join(sorted(_names(o, o.pose_topic)))
            raise RecordingError(f"{path}: holds no {o.pose_type} on {wanted}; it has: {there}")
        if not self.commands:
            wanted = " or ".join(sorted(_names(o, o.command_topic)))
            raise RecordingError(f"{path}: holds no {TWIST} or {TWIST_STAMPED} on {wanted}; it has: {there}")


def read(path: Path, states: tuple[str, ...], inputs: tuple[str, ...], options: dict[str, Any]) -> list[tuple[Rows, Rows]]:
    """A bag's stretches; see `hookspecs.s2r_recordings`. Raises ConfigError, RecordingError."""
    known = checked(options, states, inputs, connected=False)
    found = _Read(path, known)
    found.check()
    origin = found.poses[0][1]
    delays = np.array([log - stamp for log, stamp, _ in found.poses])
    cuts = [0, *(np.flatnonzero(np.abs(np.diff(delays)) > JUMP_NS) + 1).tolist(), len(delays)]
    # a command between two stretches is of the nearer one
    edges = [-np.inf, *((found.poses[cut - 1][0] + found.poses[cut][0]) / 2 for cut in cuts[1:-1]), np.inf]
    stretches = []
    for (begin, end), (since, until) in zip(pairwise(cuts), pairwise(edges), strict=True):
        commands = [row for row in found.commands if since <= row[0] < until]
        stretches.append(_stretch(found.poses[begin:end], commands, origin, known.command_timeout, (len(states), len(inputs))))
    return stretches


def _stretch(poses: list[Any], commands: list[Any], origin: int, timeout_s: float, widths: tuple[int, int]) -> tuple[Rows, Rows]:
    """Rows on the clock of the stamps, s since `origin`. A pose that is not newer than the one before it is left out."""
    log = np.array([(row[0] - poses[0][0]) for row in poses]) * 1e-9
    stamp = np.array([(row[1] - origin) for row in poses]) * 1e-9
    newest = np.maximum.accumulate(stamp)
    kept = np.concatenate([[True], stamp[1:] > newest[:-1]])
    x = np.array([row[2] for row in poses]).reshape(-1, widths[0])
    log_u = np.array([(row[0] - poses[0][0]) for row in commands]) * 1e-9
    t_u = log_u - _delay(log, (np.array([row[0] - row[1] for row in poses])) * 1e-9, log_u) + (poses[0][0] - origin) * 1e-9
    u = np.array([row[1] for row in commands]).reshape(-1, widths[1])
    return (stamp[kept], x[kept]), _lapsing(t_u, u, timeout_s)


def _delay(log: Array, delay: Array, at: Array) -> Array:
    """What is taken off a log time, s."""
    least = float(delay.min())
    if SAME_CLOCK_S[0] <= least <= SAME_CLOCK_S[1]:
        return np.zeros(len(at))
    bins = np.floor(log / BIN_S)
    best = [np.flatnonzero(bins == b)[np.argmin(delay[bins == b])] for b in np.unique(bins)]
    return np.asarray(np.interp(at, log[best], delay[best]))


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
