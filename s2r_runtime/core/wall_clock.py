"""The time of day, for expiry alone: it never goes back, within a run or from one to the next.

    believed  =  max(reading, believed before + what the monotonic clock counted since)            (in lockstep: max of both readings)

A wall clock that is set back, or a computer without a battery that begins in 1970, would let a certificate drive again that has expired.
So an earlier reading counts for nothing, and the latest time is in the memory: once in `KEPT_EVERY_S`, at an orderly end, and at once when
a certificate expires. A start with an earlier clock goes on from there. That a clock was ahead by mistake only a person knows: `s2r clear
wall_clock` believes the clock as it is, and revokes every certificate that had expired by the time believed before.
"""

from __future__ import annotations

from s2r_runtime.core.certificates import revoke
from s2r_runtime.core.state import Turn, unix_now
from s2r_runtime.messages import LATEST_TIME

REASON = "wall_clock"
KEPT_EVERY_S = 600
"""What a kill may forget of the time; a certificate that had expired is known to have."""


def begin(turn: Turn, unix_s: int) -> None:
    """A run begins at this reading."""
    if turn.settings.rules >= LATEST_TIME:
        turn.set(read_unix_s=unix_s, unix_s=max(unix_s, turn.memory.latest_unix_s))


def read(turn: Turn, unix_s: int) -> None:
    """The clock was read."""
    if turn.settings.rules < LATEST_TIME:
        turn.set(unix_s=unix_s, unix_ns=turn.now)
        return
    turn.set(read_unix_s=unix_s, unix_s=max(unix_s, unix_now(turn.state)), unix_ns=turn.now)
    now, kept = unix_now(turn.state), turn.memory.latest_unix_s
    if now - kept >= KEPT_EVERY_S or any(kept < facts.expires_unix_s <= now for facts in turn.memory.certificates):
        turn.remember(latest_unix_s=now)


def end(turn: Turn) -> None:
    """An orderly end."""
    if turn.settings.rules >= LATEST_TIME:
        turn.remember(latest_unix_s=max(unix_now(turn.state), turn.memory.latest_unix_s))


def clear(turn: Turn, request_id: int) -> None:
    """A person says that the clock is right, although it is behind the latest time."""
    now, reading = unix_now(turn.state), turn.state.read_unix_s
    if not turn.state.clock_behind_s:
        turn.answer(request_id, 2, f"{REASON} is not latched: the clock is not behind the latest time that was seen")
        return
    expired = [facts.id for facts in turn.memory.certificates if facts.expires_unix_s <= now]
    revoke(turn, expired, "expired")
    turn.set(unix_s=reading, unix_ns=turn.now)
    turn.remember(latest_unix_s=reading, clock_cleared=turn.memory.clock_cleared + 1)
    turn.persist()
    turn.answer(request_id, 0, f"the clock is believed as it is, {now - reading} s back; {len(expired)} certificates had expired")
