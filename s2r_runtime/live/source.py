"""Where what is shown comes from: a running daemon's log, followed from run to run, or a log that was written before.

One status is requested of the daemon, at the beginning. After that only its files are read: a daemon that ends, is killed or starts again
is followed into the newest log of its folder.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from s2r_runtime.daemon import control
from s2r_runtime.errors import RecordingError, UsageError
from s2r_runtime.live.feed import Feed, Row, first_part, rows
from s2r_runtime.messages import Started

STARTED = "event/started"
PAUSE_S = 10.0
"""A longer pause in a log is left out of its replay: the clock was set, or nobody was there."""
AT_ONCE = 1000
"""Rows in one `poll` of a replay."""
SILENT_S = 2.0
"""Without a word (a daemon ticks every 20 ms), after which a newer log is looked for."""


class Running:
    """A daemon's log from now on. Raises UsageError if no daemon answers, RecordingError if its log cannot be read.

    `poll` gives what is new. `started`, `status`: how the run began and where it stands, for what is not in the log again.
    """

    def __init__(self, channels: Collection[str] | None, robot: str | None = None, socket: Path | None = None) -> None:
        path = socket or control.find_socket(robot)
        assert path is not None  # noqa: S101 - one is required there
        self.status: Mapping[str, Any] = control.call(path, {"verb": "status"})["data"]
        self.robot = str(self.status["robot"])
        self._channels = channels
        self.attached: dict[str, bytes] = {}
        first = first_part(Path(self.status["log"]))
        self.started = beginning(first)
        self._first, self.folder = first, first.parent
        self.feed = Feed(first, channels, self.attached)
        self.feed.to_end()
        self._heard_s = time.monotonic()

    def poll(self) -> list[Row]:
        """Rows that are new. Never waits, and never raises: a log that cannot be read gives none."""
        now_s = time.monotonic()
        try:
            found = self.feed.poll()
        except RecordingError:
            found = []
        if found:
            self._heard_s = now_s
        elif now_s - self._heard_s > SILENT_S:
            self._heard_s = now_s
            self._look_for_newer()
        return found

    def _look_for_newer(self) -> None:
        logs = {first_part(path) for path in self._first.parent.glob(f"{self.robot}-*.mcap")} - {self._first}
        try:
            newest = max(logs, key=_age, default=None)
            if newest is not None and _age(newest) > _age(self._first):
                feed = Feed(newest, self._channels, self.attached)
                self.feed.close()
                self._first, self.feed = newest, feed
        except (OSError, RecordingError):  # deleted meanwhile, or not there yet
            pass


def _age(path: Path) -> int:
    return path.stat().st_mtime_ns


def beginning(path: Path) -> Started:
    """How the run began whose first file this is. Raises RecordingError if the log does not have it."""
    for row in rows(path, {STARTED}):
        if isinstance(row.message, Started):
            return row.message
    raise RecordingError(f"{path}: does not hold the beginning of its run; give the run's first file")


class Replay:
    """A log in the pace in which it was written, `speed` times as fast. Raises UsageError for no file, RecordingError for no log."""

    def __init__(self, path: Path, channels: Collection[str] | None, speed: float = 1.0) -> None:
        if not path.is_file():
            raise UsageError(f"{path}: no such log file")
        self.started = beginning(path)
        self.robot = self.started.settings.robot
        self.attached: dict[str, bytes] = {}
        self.folder = path.parent
        self._feed, self._speed = Feed(path, channels, self.attached), speed
        self._rows = self._all()
        self._next: Row | None = next(self._rows, None)
        self._due_s, self._last_ns = time.monotonic(), 0 if self._next is None else self._next.log_ns

    def poll(self) -> list[Row]:
        """Rows that are due. Never waits."""
        now_s = time.monotonic()
        found: list[Row] = []
        while self._next is not None and self._due_s <= now_s and len(found) < AT_ONCE:
            found.append(self._next)
            self._next = next(self._rows, None)
            if self._next is not None:
                passed_s = (self._next.log_ns - self._last_ns) * 1e-9
                self._due_s += passed_s / self._speed if 0.0 <= passed_s <= PAUSE_S else 0.0
                self._last_ns = self._next.log_ns
        return found

    def _all(self) -> Iterator[Row]:
        while self._feed.more():
            yield from self._feed.poll()
