"""What time it is, as far as that is known: for what cannot be undone.

A wall clock may be wrong by years: set by hand, without a battery, or told so by a server. The kernel's count of seconds since the computer
started (which goes on while it sleeps) cannot be set. So with b the time that was believed last and e the seconds that were counted since,

    time  =  min(wall, b + e + SLACK_S)

A clock that is behind makes everything look younger than it is, and what is young stays. By what it is ahead it may be right: the
computer was off, and nobody counted. An offset that lasted for BELIEVED_AFTER_S counted seconds is believed, forward or back. Meanwhile
somebody may notice: where the clock is ahead certificates expire, and the gate closes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from s2r_runtime.errors import S2RError
from s2r_runtime.files.durable import read, replace

SLACK_S = 3600.0
"""A wall clock that is ahead by less is believed: what rests on it keeps an hour of doubt anyway."""
BELIEVED_AFTER_S = 7 * 86_400.0
"""Counted by the kernel, also between two runs of the daemon. Short of that, logs are kept longer than was asked for, which costs room
and nothing else.
"""
_BOOT = Path("/proc/sys/kernel/random/boot_id")


def _boot() -> str:
    try:
        return _BOOT.read_text().strip()
    except OSError:
        return ""  # then nothing counts over a restart of the daemon


class _Stood(msgspec.Struct):
    """believed_s: Unix time that was believed when `counted_s` were counted since the start `boot`.

    For `held_s` seconds the clock has been ahead of it by least_s to most_s.
    """

    believed_s: float
    boot: str
    counted_s: float
    least_s: float
    most_s: float
    held_s: float = 0.0


class BelievedTime:
    """file: where it is kept from run to run. newest_s: Unix time of the youngest trace of earlier runs, if nothing is kept; None: there
    is none, and the clock is believed as it is. wall, counted: s; boot: an identity of the computer's start, since which is counted.
    """

    def __init__(
        self,
        file: Path,
        newest_s: float | None,
        *,
        wall: Callable[[], float] = time.time,
        counted: Callable[[], float] = lambda: time.clock_gettime(time.CLOCK_BOOTTIME),
        boot: Callable[[], str] = _boot,
    ) -> None:
        self._file, self._newest_s = file, newest_s
        self._wall, self._counted, self._boot = wall, counted, boot
        self._stood: _Stood | None = None
        try:
            if file.exists():
                self._stood = msgspec.json.decode(read(file), type=_Stood)
        except (S2RError, OSError, ValueError, RecursionError):  # as if it were not there: what follows believes less, not more
            pass

    def now(self) -> float:
        """Unix time, s."""
        wall_s, counted_s, boot = self._wall(), self._counted(), self._boot()
        stood = self._stood
        if stood is None:
            begin_s = wall_s if self._newest_s is None else min(wall_s, self._newest_s)
            stood = _Stood(begin_s, boot, counted_s, wall_s - begin_s, wall_s - begin_s)
        elapsed_s = max(counted_s - stood.counted_s, 0.0) if boot and boot == stood.boot else 0.0
        believed_s, held_s = stood.believed_s + elapsed_s, stood.held_s + elapsed_s
        lead_s = wall_s - believed_s
        least_s, most_s = min(stood.least_s, lead_s), max(stood.most_s, lead_s)
        if held_s >= BELIEVED_AFTER_S:
            step_s = max(least_s, 0.0) + min(most_s, 0.0)
            believed_s, lead_s, held_s = believed_s + step_s, lead_s - step_s, 0.0
            least_s = most_s = lead_s
        self._stood = _Stood(believed_s, boot, counted_s, least_s, most_s, held_s)
        return min(wall_s, believed_s + SLACK_S)

    @property
    def believed_s(self) -> float:
        """What was believed when it was asked last, whatever the clock says; 0 before."""
        return 0.0 if self._stood is None else self._stood.believed_s

    def save(self) -> None:
        """Keeps it. Where the disk does not take it, less is believed the next time."""
        if self._stood is not None:
            try:
                replace(self._file, msgspec.json.encode(self._stood))
            except OSError:
                return
