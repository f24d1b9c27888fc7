"""Frames with the robot's ids from another address: a copy of the robot's own by another way, or another robot's?

Whatever the robot's own address sends as well, before or within WAIT frames after, is a copy. What it does not is another robot's; FRAMES
of them within WITHIN_NS, while the robot's own address goes on, are a second robot.
"""

from __future__ import annotations

from collections import deque

from s2r_mavlink.frames import header, payload

KEPT = 64
WAIT = 16
"""Frames of the robot's, a third of a second or less: a way that is slower by more is no use to anybody."""
FRAMES = 3
WITHIN_NS = 10_000_000_000


class Elsewhere:
    """count: frames that turned out to be another robot's."""

    def __init__(self) -> None:
        self._own: deque[int] = deque(maxlen=KEPT)
        self._strange: deque[tuple[int, int]] = deque(maxlen=KEPT)
        self._signs: deque[int] = deque(maxlen=FRAMES)
        self._accepted = 0
        self.count = 0

    def strange(self, frame: bytes) -> None:
        """It came from another address than the robot's."""
        content = _content(frame)
        if content not in self._own:
            self._strange.append((content, self._accepted))

    def own(self, frame: bytes, now_ns: int) -> None:
        """It came from the robot's address."""
        self._accepted += 1
        content = _content(frame)
        self._own.append(content)
        if not self._strange:
            return
        self._strange = deque((one for one in self._strange if one[0] != content), KEPT)
        while self._strange and self._accepted - self._strange[0][1] > WAIT:
            self._strange.popleft()
            self._signs.append(now_ns)
            self.count += 1

    def shared(self, now_ns: int) -> bool:
        """Whether there is a second robot."""
        return len(self._signs) == FRAMES and now_ns - self._signs[0] <= WITHIN_NS


def _content(frame: bytes) -> int:
    """A frame without what a router changes on its way: version, signature."""
    facts = header(frame)
    return hash((facts.number, facts.system, facts.component, facts.sequence, payload(frame)))
