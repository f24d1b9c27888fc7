"""The log of a running daemon, read while it is written: each look reads what came since the last one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from s2r_runtime.errors import RecordingError
from s2r_runtime.recording.reading import Reading


class FollowedLog:
    """All parts of one run of a daemon. newest: the part that it writes now, from `s2r status`. Raises RecordingError if that is no log."""

    def __init__(self, newest: Path, channels: Iterable[str]) -> None:
        self._folder, self._channels = newest.parent, tuple(channels)
        self._run = Reading(newest).run
        self._parts: list[Reading] = []

    @property
    def paths(self) -> list[Path]:
        """Its parts, in order."""
        return [part.path for part in self._parts]

    def parts(self) -> Iterator[Reading]:
        """Those that may hold something new, in order. Iterate each for its new entries."""
        if not self._parts:
            self._find()
        at = max(len(self._parts) - 1, 0) if self._parts and self._parts[0].over else 0
        while at < len(self._parts):
            part = self._parts[at]
            yield part
            if part.sealed_for_good and at + 1 == len(self._parts):
                self._find()
            at += 1

    def _find(self) -> None:
        """Parts that were begun since, as far as they follow one after the other."""
        known, found = {part.path for part in self._parts}, {}
        for path in self._folder.glob("*.mcap"):
            if path not in known:
                try:
                    part = Reading(path, self._channels, growing=True)
                except RecordingError:
                    continue  # another program's, or one whose first bytes are about to come
                if part.run == self._run:
                    found[part.part] = part
        after = self._parts[-1].part + 1 if self._parts else min(found, default=0)
        while after in found:
            self._parts.append(found[after])
            after += 1
