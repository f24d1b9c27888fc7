"""The robot's clock: stamps that only rise, and how old is what comes. Stamps and arrivals decide, nothing else: an audit repeats it.

s: a stamp on the robot's clock (header.stamp, ns), a: its arrival on the host's monotonic clock (ns). (S, A): the newest that was taken.

Order  taken if 0 < s - S <= AHEAD + PACE (a - A). Lower: old (late, repeated, replayed). Higher: ahead (no clock runs so fast; forged).
       After `restart_ns` in which nothing was taken either means that the clock was set, or began anew: what follows goes on above the old
       stamps, one second at least.
Age    s was made at the host's time base + rate s, at the latest; age = a - (base + rate s) is what the message took beyond the fastest.
       Of every moment (0.4 s) the least delayed (s, a) is kept. rate: median slope between the last six of them; 1 where it is within 2 %
       of that, a simulator's otherwise. base: the least a - rate s of the last ten seconds (of the last six moments for a simulator's,
       whose rate wanders). No clocks are set against each other: a delay that all messages share, and one that lasts, can't be seen.
"""

from __future__ import annotations

from collections import deque
from itertools import combinations, islice
from statistics import median
from typing import Literal

Verdict = Literal["taken", "old", "ahead", "restarted"]

SECOND = 1_000_000_000
RESTART_GAP_NS = SECOND
AHEAD_NS = 60 * SECOND
PACE = 100.0
"""Robot's seconds in one of the host's: simulators run up to so many times faster."""
MOMENT_NS = 400_000_000
FOR_RATE = 6
FEWEST = 3
"""Moments before ages are judged."""
MOMENTS = 25
"""Ten seconds: a stall that is longer is a lost link, and a simulator that was paused is believed again after as long."""
SAME = 0.02


class RobotClock:
    """restart_ns: silence after which the clock may count anew. Counters: old, ahead (dropped stamps), restarts."""

    def __init__(self, restart_ns: int) -> None:
        self._restart_ns = restart_ns
        self._newest: tuple[int, int] | None = None
        self._offset = 0
        self.old = self.ahead = self.restarts = 0
        self._forget()

    def _forget(self) -> None:
        self._moments: deque[tuple[int, int]] = deque(maxlen=MOMENTS)
        self._best: tuple[int, int] | None = None
        self._begun_ns = 0
        self._rate, self._base = 1.0, 0.0
        self._origin = (0, 0)

    @property
    def newest(self) -> tuple[int, int] | None:
        """The newest stamp that was taken, on the robot's own clock, and its arrival."""
        return self._newest

    def take(self, s: int, a: int) -> Verdict:
        """Whether this stamp counts. After `restarted` everything that was known of the clock is forgotten, but no stamp falls."""
        if self._newest is None:
            self._accept(s, a)
            return "taken"
        newest, heard = self._newest
        if 0 < s - newest <= AHEAD_NS + PACE * max(a - heard, 0):
            self._accept(s, a)
            return "taken"
        if a - heard >= self._restart_ns and s != newest:
            self._offset += newest + RESTART_GAP_NS - s
            self.restarts += 1
            self._forget()
            self._accept(s, a)
            return "restarted"
        if s <= newest:
            self.old += 1
            return "old"
        self.ahead += 1
        return "ahead"

    def stamp(self) -> int:
        """The newest stamp that was taken, on a clock that never falls, ns."""
        assert self._newest is not None  # noqa: S101 - asked after one was taken
        return self._newest[0] + self._offset

    def age_ns(self, s: int, a: int) -> float:
        """How much longer than the fastest this one took; 0 while that can't be known."""
        if len(self._moments) < FEWEST:
            return 0.0
        return max(0.0, self._over((s, a)) - self._base)

    def _accept(self, s: int, a: int) -> None:
        if self._newest is None or not self._begun_ns:
            self._origin, self._begun_ns = (s, a), a
        self._newest = s, a
        if a - self._begun_ns >= MOMENT_NS and self._best is not None:
            self._moments.append(self._best)
            self._best, self._begun_ns = None, a
            self._settle()
        if self._best is None or a - s < self._best[1] - self._best[0]:
            self._best = s, a

    def _settle(self) -> None:
        """The line, once a moment."""
        last = list(islice(reversed(self._moments), FOR_RATE))
        slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in combinations(last, 2) if b[0] != a[0]]
        rate = median(slopes) if len(last) >= FEWEST and slopes else 1.0
        self._rate = 1.0 if abs(rate - 1.0) < SAME else rate
        self._base = min(map(self._over, self._moments if self._rate == 1.0 else last))

    def _over(self, point: tuple[int, int]) -> float:
        return (point[1] - self._origin[1]) - self._rate * (point[0] - self._origin[0])
