"""Two robots under one name, and echoes, noticed in what a transport hears. For transports; depends on nothing but what it is told.

A robot that restarts falls silent under its old identity (publisher, boot number, count). Two robots go on, both. So a second robot is
proved when the one that is followed is heard *after* another one was: `Pair`. Where senders do not name themselves, `Track` tells an echo
and a late message from another count:

    number accepted before, same content     echo
    number accepted before, other content    other: one robot does not say two things under one number
    number never accepted, in its place      late (its stamp lies between those of its neighbours, where stamps are given, and it is not
                                             far below the next one)
    all else                                 other
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from typing import Literal

from s2r_runtime.messages import ObservationRefused, OverrideChanged

WITHIN_NS = 5_000_000_000
"""Between two signs of one second robot at most: it reports once a second at the least."""
AGAIN_NS = 1_000_000_000
"""A twin that lasts is said again after so long, so that whoever clears it too early finds it again."""
KEPT = 64
"""Accepted messages that are remembered: what is later than that is no late message."""
Kind = Literal["echo", "late", "other"]


class Pair:
    """signs: how many times the robot must go on after the other one before that is proof: 1 where senders name themselves, 2 elsewhere."""

    def __init__(self, signs: int = 1) -> None:
        self._signs, self._seen = signs, 0
        self._waiting = False
        self._newest_ns = self._said_ns = -(1 << 62)

    def other(self) -> None:
        """Something came in the robot's name that is another's."""
        self._waiting = True

    def goes_on(self, now_ns: int) -> bool:
        """The robot that is followed was heard. True: there are two, and that is to be said now."""
        if not self._waiting:
            return False
        self._waiting = False
        self._seen = self._seen + 1 if now_ns - self._newest_ns <= WITHIN_NS else 1
        self._newest_ns = now_ns
        if self._seen < self._signs or now_ns - self._said_ns < AGAIN_NS:
            return False
        self._said_ns = now_ns
        return True

    def forget(self) -> None:
        """The robot started anew: who was heard before it is not another one."""
        self._waiting, self._seen = False, 0


class Track:
    """The last accepted messages: numbers that rise, contents, and stamps where there are any.

    early: by how much a number may be below the very first one, and the message still be late (in their unit). deep: by how much below the
    next one that was accepted.
    """

    def __init__(self, early: int = 8, deep: int = KEPT) -> None:
        self._early, self._deep = early, deep
        self._kept: deque[tuple[int, int, int]] = deque(maxlen=KEPT)
        self._first = True

    def accept(self, number: int, content: object, stamp: int = 0) -> None:
        """It was taken. number: above all before it. content: hashable."""
        if len(self._kept) == KEPT:
            self._first = False
        self._kept.append((number, stamp, hash(content)))

    def judge(self, number: int, content: object, stamp: int = 0) -> Kind:
        """What a message is that was not taken, and does not come after the newest."""
        kept = self._kept
        at = bisect_left(kept, number, key=lambda one: one[0])
        if at < len(kept) and kept[at][0] == number:
            return "echo" if kept[at][1:] == (stamp, hash(content)) else "other"
        if at == 0:
            before_first = self._first and kept and kept[0][0] - number <= self._early and stamp <= kept[0][1]
            return "late" if before_first else "other"
        if at == len(kept) or kept[at][0] - number > self._deep:
            return "other"
        return "late" if not stamp or kept[at - 1][1] <= stamp <= kept[at][1] else "other"

    def forget(self) -> None:
        """The robot counts anew."""
        self._kept.clear()
        self._first = True


class Numbered:
    """Both, for robots that number their observations: what `decode` gives besides them.

    >>> robot = Numbered()
    >>> robot.taken(7, 70, (0.1,), 0), robot.dropped(5, 50, (0.3,), 1)
    ([], [ObservationRefused(t_ns=1, detail='observation 5 came late')])
    """

    def __init__(self) -> None:
        self._track, self._pair = Track(), Pair(signs=2)

    def taken(self, seq: int, stamp_ns: int, x: object, now_ns: int) -> list[OverrideChanged]:
        """An observation counts; what goes before it."""
        self._track.accept(seq, x, stamp_ns)
        twin = self._pair.goes_on(now_ns)
        return [OverrideChanged(now_ns, "robot_twin", "observations go on in two tracks of numbers and stamps")] if twin else []

    def dropped(self, seq: int, stamp_ns: int, x: object, now_ns: int) -> list[ObservationRefused]:
        """An observation does not come after the newest, in number or stamp."""
        kind = self._track.judge(seq, x, stamp_ns)
        if kind == "other":
            self._pair.other()
        why = {"echo": "is an echo", "late": "came late", "other": "is not the robot's, or replayed"}[kind]
        return [ObservationRefused(now_ns, f"observation {seq} {why}")]

    def forget(self) -> None:
        """The robot started anew."""
        self._track.forget()
        self._pair.forget()
