"""The host's clock without the time in which the daemon itself stood still.

A process that was stopped, or a machine that slept, was late itself: what others owed it meanwhile, they may send at once. So one look at
this clock counts for at most LOOK_S, however long ago the last look was. It measures how long a disk or a process is waited for. It never
measures how old an observation or a command is: the robot's time runs on.
"""

from __future__ import annotations

import time
from collections.abc import Callable

LOOK_S = 0.1
"""Five ticks of the loop: a busy machine delays most ticks by less, and a pause of the process counts for one look."""
TURN_S = 0.02
"""A turn of the loop takes no longer, or the loop was late with it."""


class AwakeClock:
    """`look` from the daemon's loop, with every turn; `now_ns` and `now_s` from any thread. Starts where the host's clock stands."""

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self._looked_ns = self._now_ns = clock()
        self.stood_still_ns = 0
        """For how long turns of the loop were late, in all."""

    def look(self) -> None:
        """Time goes on up to now, by LOOK_S at most."""
        at_ns = self._clock()
        passed_ns = max(0, at_ns - self._looked_ns)
        self._now_ns += min(passed_ns, round(LOOK_S * 1e9))
        self.stood_still_ns += max(0, passed_ns - round(TURN_S * 1e9))
        self._looked_ns = at_ns

    def now_ns(self) -> int:
        """ns, as of the last look."""
        return self._now_ns

    def now_s(self) -> float:
        """s, as of the last look."""
        return self._now_ns * 1e-9
