"""The robot's clock: stamps that only rise, and how old is what comes. Stamps and arrivals decide, nothing else: an audit repeats it.

s: a stamp on the robot's clock (ns since it started), a: its arrival on the host's clock (ns). (S, A): the newest one that was taken.

Order     taken if 0 < s - S <= slack + pace (a - A). Lower: old (late, repeated, replayed). Higher: ahead (no clock runs so fast; forged).
          After `restart_ns` in which nothing was taken, either means that the clock began anew: what follows goes on above the old stamps.
Age       the host's time of s is  h(s) = base + rate s.  rate: host seconds in one of the robot's, 1 but in a simulator; the median slope
          between the least delayed arrivals of the last few moments. base: the lowest line of this slope above which they all lie.
          An answered question about the time (asked at p, answered with the robot's s' at q) shows that h(s') >= p, which lifts a base
          that is too low, and that half of q - p is spent on the way.
          age = a - h(s) + (q - p)/2. It tells a burst of old observations after a stall, and a queue that has grown, from fresh ones.
"""

from __future__ import annotations

from collections import deque
from itertools import combinations
from statistics import median
from typing import Literal

Verdict = Literal["taken", "old", "ahead", "restarted"]

SECOND = 1_000_000_000
RESTART_GAP_NS = SECOND
MOMENT_NS = 400_000_000
MOMENTS = 6
"""The line is laid through the last 2.4 s in which something came: long against jitter, short against a simulator's moods."""
FEWEST = 3
"""Moments before ages are judged."""
SLACK_NS = SECOND
PACE = 2.0
"""Of the pace that was seen."""
SLACK_AT_FIRST_NS = 60 * SECOND
PACE_AT_FIRST = 100.0
"""Until the pace is known: simulators run up to so many times faster."""
ROUND_TRIPS = 3
ROUND_TRIP_MOST_NS = 10 * SECOND


class RobotClock:
    """restart_ns: silence after which the robot may count anew. Counters: old, ahead (dropped stamps), restarts."""

    def __init__(self, restart_ns: int) -> None:
        self._restart_ns = restart_ns
        self._newest: tuple[int, int] | None = None
        self._offset = 0
        self.old = self.ahead = self.restarts = 0
        self._forget()

    def _forget(self) -> None:
        self._best: tuple[int, int] | None = None
        self._moment_ns = 0
        self._moments: deque[tuple[int, int]] = deque(maxlen=MOMENTS)
        self._asked: deque[tuple[int, int, int]] = deque(maxlen=ROUND_TRIPS)
        self._origin = (0, 0)
        self._rate: float | None = None
        self._base = 0.0

    @property
    def heard_ns(self) -> int:
        """Arrival of the newest stamp that was taken; 0 before the first."""
        return 0 if self._newest is None else self._newest[1]

    @property
    def round_trip_ns(self) -> int:
        """The shortest of the last answered questions; 0 if none was answered."""
        return min((q - p for _, p, q in self._asked), default=0)

    @property
    def offset_ns(self) -> int:
        """Host's clock minus robot's, by the question that was answered fastest; known to half of its round trip; 0 if none was."""
        if not self._asked:
            return 0
        s, p, q = min(self._asked, key=lambda one: one[2] - one[1])
        return (p + q) // 2 - s

    @property
    def pace(self) -> float:
        """Robot's seconds in one of the host's, as far as it is known."""
        return 1.0 / self._rate if self._rate else 1.0

    def take(self, s: int, a: int) -> Verdict:
        """Whether this stamp counts. After `restarted` everything that was known of the clock is forgotten, but no stamp falls."""
        if self._newest is None:
            self._accept(s, a)
            return "taken"
        newest, heard = self._newest
        known = self._rate is not None
        reach = (SLACK_NS if known else SLACK_AT_FIRST_NS) + (PACE * self.pace if known else PACE_AT_FIRST) * (a - heard)
        if 0 < s - newest <= reach:
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
        """How long ago the stamp was made, when it came; as far as that can be known."""
        late = 0.0 if self._rate is None else max(0.0, self._over(s, a, self._rate) - self._base)
        return late + 0.5 * self.round_trip_ns

    def answered(self, s: int, p: int, q: int) -> None:
        """The robot told its time s; it was asked at p and the answer came at q."""
        if not 0 <= q - p <= ROUND_TRIP_MOST_NS:
            return
        self._asked.append((s, p, q))
        self._lift()

    # ------------------------------------------------------------------ the line

    def _accept(self, s: int, a: int) -> None:
        self._newest = (s, a)
        if self._best is None:
            if not self._moments:
                self._origin = (s, a)
            self._best, self._moment_ns = (s, a), a
            return
        rate = 1.0 if self._rate is None else self._rate
        if self._over(s, a, rate) < self._over(*self._best, rate):
            self._best = (s, a)
        if a - self._moment_ns >= MOMENT_NS:
            self._moments.append(self._best)
            self._best = None
            self._lay()

    def _over(self, s: int, a: int, rate: float) -> float:
        """a - rate s, from the origin."""
        return (a - self._origin[1]) - rate * (s - self._origin[0])

    def _lay(self) -> None:
        if len(self._moments) < FEWEST:
            return
        slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in combinations(self._moments, 2) if b[0] != a[0]]
        rate = median(slopes)
        self._rate = rate
        self._base = min(self._over(s, a, rate) for s, a in self._moments)
        self._lift()

    def _lift(self) -> None:
        """Raises the line to what answered questions show; only where they are about the same clock as the stamps."""
        if self._rate is None or self._newest is None:
            return
        for s, p, _ in self._asked:
            if abs(s - self._newest[0]) <= ROUND_TRIP_MOST_NS:
                self._base = max(self._base, self._over(s, p, self._rate))
