"""Lines for the daemon's journal: each once in a while, however often its reason comes."""

from __future__ import annotations

from collections import deque

LINES_MOST = 20
AGAIN_NS = 60_000_000_000


class Journal:
    """`now_ns` is set by whoever lets time pass."""

    def __init__(self) -> None:
        self.now_ns = 0
        self._lines: deque[str] = deque(maxlen=LINES_MOST)
        self._said: dict[str, int] = {}

    def say(self, line: str) -> None:
        """A line, unless it was said a short while ago."""
        if self.now_ns - self._said.get(line, -AGAIN_NS) >= AGAIN_NS:
            if len(self._said) >= LINES_MOST:
                self._said.clear()
            self._said[line] = self.now_ns
            self._lines.append(line)

    def take(self) -> list[str]:
        """Lines since the last call."""
        lines = list(self._lines)
        self._lines.clear()
        return lines
