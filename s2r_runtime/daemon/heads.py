"""How far the log is on the disk: told to the robot's side, and now and then to the journal, where nobody who changes the log can
take it back (docs/log-format.md).
"""

from __future__ import annotations

from collections.abc import Callable

from s2r_runtime.daemon.every import Every
from s2r_runtime.messages import LogHead

HEAD_NS = 1_000_000_000
LINE_NS = 600_000_000_000


class Heads:
    """say: a line for the journal, once in `LINE_NS`."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._told: LogHead | None = None
        self._head, self._line = Every(HEAD_NS), Every(LINE_NS)

    def tick(self, now_ns: int, head: LogHead | None, tell: Callable[[LogHead], None]) -> None:
        """head: the newest, if there is one; `tell` takes it where it is another than before, at most once in `HEAD_NS`."""
        if head is None or head == self._told or not self._head.due(now_ns):
            return
        self._told = head
        tell(head)
        if self._line.due(now_ns):
            self._say(f"log of run {head.run}, {head.records} records: head {head.head}")
