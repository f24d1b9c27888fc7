"""What of a log could not be used: counted, and reported in words."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from s2r_runtime.errors import RecordingError

ODD_SHARE = 0.01
"""Of the lines that may be unreadable: a text in which more are is no such log, or not only."""
SHOWN = 60
"""Characters of a line that a message shows."""


class Tally:
    """frames: how many were read. odd: lines that should be frames and are not. left_out: number of frames and events of no use
    here, by what they are. said: other notes.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.odd = 0
        self.first_odd = ""
        self.left_out: Counter[str] = Counter()
        self.said: list[str] = []

    def unreadable(self, number: int, line: str) -> None:
        """A line that should be a frame and is not."""
        self.odd += 1
        self.first_odd = self.first_odd or f"line {number}: {line.strip()[:SHOWN]!r}"

    def check(self, path: Path, kind: str, lines: int) -> None:
        """Raises RecordingError if it holds no frame, or more lines than a few are unreadable."""
        if not self.frames and not self.odd:
            raise RecordingError(f"{path}: holds no CAN frame")
        if not self.frames:
            raise RecordingError(f"{path}: is no {kind} log: {self.first_odd}")
        if self.odd > max(1.0, ODD_SHARE * lines):
            raise RecordingError(f"{path}: {self.odd} of {lines} lines are no {kind} lines, the first is {self.first_odd}")

    def notes(self) -> list[str]:
        """One line each."""
        found = list(self.said)
        if self.odd:
            lines = "1 line could" if self.odd == 1 else f"{self.odd} lines could"
            found.append(f"{lines} not be read and {'is' if self.odd == 1 else 'are'} left out, the first is {self.first_odd}")
        if self.left_out:
            found.append("left out: " + ", ".join(f"{count} {what}" for what, count in sorted(self.left_out.items())))
        return found
