"""What waits for the daemon between two calls of `receive`: bounded, the oldest gives way, and a bell that rings when it matters."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from contextlib import suppress

from s2r_can.records import Record


class Bell:
    """A descriptor that is readable after `ring` until `answer`; -1 while it is not open, and rings are then not heard."""

    def __init__(self) -> None:
        self._fd = -1
        self._lock = threading.Lock()

    def open(self) -> None:
        """Makes the descriptor."""
        with self._lock:
            if self._fd < 0:
                self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """The descriptor."""
        return self._fd

    def ring(self) -> None:
        """Makes it readable; from any thread."""
        with self._lock:
            if self._fd >= 0:
                os.eventfd_write(self._fd, 1)

    def answer(self) -> None:
        """Makes it unreadable until the next `ring`."""
        if self._fd >= 0:
            with suppress(BlockingIOError):
                os.eventfd_read(self._fd)

    def close(self) -> None:
        """Frees the descriptor; may be called twice."""
        with self._lock:
            if self._fd >= 0:
                os.close(self._fd)
                self._fd = -1


class Inbox:
    """At most `capacity` records."""

    def __init__(self, bell: Bell, capacity: int) -> None:
        self._bell, self._capacity = bell, capacity
        self._waiting: deque[Record] = deque()
        self._lock = threading.Lock()
        self._rung = False
        self._second = self._in_second = 0
        self._vital: Record | None = None
        self.dropped = 0

    def put(self, record: Record, *, ring: bool, per_second: int = 0, vital: bool = False) -> bool:
        """From any thread. ring: the daemon is to come now; else it may wait for what comes next. per_second: more records than that, put
        with such a limit, are dropped at the door (0: no limit). vital: it gives way to no other; one at a time. False if this one was
        dropped.
        """
        with self._lock:
            if vital and self._vital is not None:
                self.dropped += 1
                return False
            if per_second and self._over_rate(record.stamp_ns // 1_000_000_000, per_second):
                self.dropped += 1
                return False
            if len(self._waiting) >= self._capacity:
                del self._waiting[1 if self._waiting[0] is self._vital and self._capacity > 1 else 0]
                self.dropped += 1
            self._waiting.append(record)
            self._vital = record if vital else self._vital
            if self._rung or not (ring or 2 * len(self._waiting) >= self._capacity):
                return True
            self._rung = True
        self._bell.ring()
        return True

    def take(self) -> list[Record]:
        """What waited, oldest first."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
            self._vital = None
            self._rung = False
        return taken

    def _over_rate(self, second: int, per_second: int) -> bool:
        if second != self._second:
            self._second, self._in_second = second, 0
        self._in_second += 1
        return self._in_second > per_second


class Metronome:
    """Rings the bell at a time, from a thread of its own, which does nothing else."""

    def __init__(self, bell: Bell) -> None:
        self._bell = bell
        self._due_ns: int | None = None
        self._ending = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="can-command-cycle", daemon=True)
        self._thread.start()

    def at(self, due_ns: int | None) -> None:
        """Rings then, on the host's monotonic clock, and no more at any earlier time; None: not at all."""
        with self._changed:
            self._due_ns = due_ns
            self._changed.notify()

    def close(self) -> None:
        """Ends the thread."""
        with self._changed:
            self._ending = True
            self._changed.notify()
        self._thread.join(1.0)

    def _run(self) -> None:
        with self._changed:
            while not self._ending:
                left = None if self._due_ns is None else (self._due_ns - time.monotonic_ns()) * 1e-9
                if left is not None and left <= 0.0:
                    self._due_ns = None
                    self._bell.ring()
                    continue
                self._changed.wait(left)
