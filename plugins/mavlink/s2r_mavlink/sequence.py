"""Whose turn it is: a sender's numbers, modulo 256, tell what was lost, what came late, and that a second sender uses the same ids.

d = (number - newest) mod 256.  0: again.  1 to `NEAR`: next.  To `AHEAD`: skipped.  Above 256 - `BEHIND`: late.  Else: off the track.
Before one that is next or skipped, d - 1 were lost. What has no stamp of its own may be acted on only if it is next: a recorded frame
that is played again has any number.
Off the track, another track is tried: it takes over after `PROOF` frames in a row without one of the old track between them, or at once
if the old one was silent for `SILENT_NS` (a robot started anew, a long loss). Both in turns are a conflict: two senders, or a replay.
"""

from __future__ import annotations

from collections import deque
from typing import Literal

Place = Literal["next", "skipped", "late", "again", "off"]

NEAR, AHEAD, BEHIND = 8, 32, 16
"""A frame whose checksum nobody here can check is near or off: its number may be noise."""
PROOF = 4
SILENT_NS = 500_000_000
CONFLICTS, WITHIN_NS = 8, 10_000_000_000
"""So many conflicts in so long are two senders. A few replayed frames are none."""


class Sequence:
    """Of one sender. lost: frames that were missing when a newer one came; off, again: frames off the track, and repeated ones."""

    def __init__(self) -> None:
        self._newest = -1
        self._heard_ns = 0
        self._other = -1
        self._proof = 0
        self._conflicts: deque[int] = deque(maxlen=CONFLICTS)
        self.lost = self.off = self.again = 0

    def place(self, number: int, now_ns: int, *, checked: bool = True) -> Place:
        """Where this frame stands. `again` and `off` are never acted on, `skipped` and `late` only where a stamp says more."""
        d = (number - self._newest) & 0xFF
        if self._newest < 0 or (d > AHEAD and now_ns - self._heard_ns > SILENT_NS and checked):
            return self._next(number, now_ns, 0)
        if 0 < d <= (AHEAD if checked else NEAR):
            if self._proof:
                self._conflicts.append(now_ns)
            self._next(number, now_ns, d - 1)
            return "next" if d <= NEAR else "skipped"
        if d == 0:
            self.again += 1
            return "again"
        if d > 256 - BEHIND:
            return "late"
        return self._try(number, now_ns) if checked else "off"

    def _next(self, number: int, now_ns: int, lost: int) -> Place:
        self._newest, self._heard_ns, self._proof = number, now_ns, 0
        self.lost += lost
        return "next"

    def _try(self, number: int, now_ns: int) -> Place:
        """Off the track: another one?"""
        self._proof = self._proof + 1 if self._proof and 0 < (number - self._other) & 0xFF <= AHEAD else 1
        self._other = number
        if self._proof >= PROOF:
            return self._next(number, now_ns, (number - self._newest - 1) & 0xFF)
        self.off += 1
        return "off"

    def shared(self, now_ns: int) -> bool:
        """Whether two senders use these ids."""
        return len(self._conflicts) == CONFLICTS and now_ns - self._conflicts[0] <= WITHIN_NS
