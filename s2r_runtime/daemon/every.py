"""What is done now and then, and no more often."""

from __future__ import annotations


class Every:
    """Due at first, and then again each time that `period_ns` has passed since it last was."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._next_ns = 0

    def due(self, now_ns: int) -> bool:
        """Whether it is to be done now; who asks is taken to do it. now_ns: the host's monotonic clock."""
        if now_ns < self._next_ns:
            return False
        self._next_ns = now_ns + self._period_ns
        return True
