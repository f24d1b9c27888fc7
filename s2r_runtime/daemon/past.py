"""A robot's state held against its newest log, when the daemon starts: a state that was put back from a copy must not forget.

    S   the state as it was last saved                   L   the memory with which the newest log ends (its last `Persist`, or `Started`)

    S forgets nothing that L knows                       S counts: it was saved when the log was lost, or logged elsewhere (`-o FILE`)
    S forgets something, L nothing that S knows          L counts: S is an older copy, was edited, or did not reach the disk
    each forgets something that the other knows          nobody knows what was spent: the daemon does not start

What is latched in either is latched. L counts only after its log was read in full, and under a key that this robot signs with or trusts.
The samples of an unfinished campaign are held against the logs in the same way: who takes them once more may choose.

What no log shows that is still there, this can't: a whole folder that was put back, logs included, or logs that were deleted. Then the
heads that were published elsewhere tell (docs/log-format.md), and the audit over the logs that somebody kept.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import count, islice, takewhile
from pathlib import Path

import msgspec

from s2r_runtime.core.gaps import REFUTED
from s2r_runtime.core.stream import stood
from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.messages import BEHAVIOURS, Memory, Persist, SampleTaken, Started
from s2r_runtime.recording.glance import glance
from s2r_runtime.recording.reading import Reading

SAID = ("event/started", "out/persist")
TAKEN = ("event/sample_taken",)
RUNS = 3
"""Newest runs that say something and are looked into: another may be older than its name. One that ended before its first event says
nothing, and does not count.
"""
_NAME = re.compile(r"-(\d{8}T\d{6}Z)(?:-(\d+))?(?:\.(\d{3,}))?\.mcap")
"""What follows the robot in a log's name: when the run began, which of several in that second, which part of it."""


def runs(folder: Path, robot: str) -> list[list[Path]]:
    """The files of each run of that robot in the folder, part by part; the newest run first."""
    found: dict[tuple[str, int], list[tuple[int, Path]]] = {}
    for path in folder.glob(f"{robot}-*.mcap"):
        if name := _NAME.fullmatch(path.name.removeprefix(robot)):
            found.setdefault((name[1], int(name[2] or 1)), []).append((int(name[3] or 1), path))
    return [[path for _, path in sorted(found[run])] for run in sorted(found, reverse=True)]


def reconciled(state: Memory, folder: Path, keys: Collection[bytes], say: Callable[[str], None]) -> Memory:
    """The memory to start with. keys: public ones, whose logs count. Raises ConfigError if state and logs cannot both be true."""
    latest: tuple[str, ...] | None = None
    seen = 0
    for told, path in islice(_told(folder, state.robot), RUNS):
        if latest is None:
            latest = told.latched
            # a run whose clock was ahead has the newest name for long; since then a person may have said so
            seen = told.latest_unix_s if told.clock_cleared >= state.clock_cleared else 0
        if what := forgotten(told, state):
            if gained := forgotten(state, told):
                raise ConfigError(
                    f"the state of robot {state.robot!r} forgets {what}, which {path} knows, and that log does not know {gained}: put the "
                    "newest state.json back, or move state and logs away to begin a new life (earlier certificates are then void)"
                )
            say(f"the saved state forgets {what}; going on from what {path.name} ends with")
            state = msgspec.structs.replace(_in_full(path, told, keys, what), latched=_both(told.latched, state.latched))
    if seen > state.latest_unix_s:
        say(f"the saved state does not know of the time {seen} s that the newest log ends with; certificates expire by that")
        state = msgspec.structs.replace(state, latest_unix_s=seen)
    if missing := [reason for reason in latest or () if reason not in state.latched]:
        say(f"the saved state does not know that {', '.join(missing)} is latched, as the newest log ends with; it is latched")
        state = msgspec.structs.replace(state, latched=_both(state.latched, tuple(missing)))
    return state


def _both(one: tuple[str, ...], other: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys((*one, *other)))


def _told(folder: Path, robot: str) -> Iterator[tuple[Memory, Path]]:
    """What each run ends with, and where it says so, the newest first."""
    for parts in runs(folder, robot):
        told, path = _last_memory(parts)
        if told is not None and told.robot == robot:
            yield told, path


def _last_memory(parts: list[Path]) -> tuple[Memory | None, Path]:
    for path in reversed(parts):
        for message in glance(path, SAID, newest_first=True):
            if isinstance(message, Persist | Started):
                return message.memory, path
    return None, parts[-1]


def _in_full(path: Path, told: Memory, keys: Collection[bytes], lost: str) -> Memory:
    """What that log ends with when all that it is sealed with is checked. Raises ConfigError if it doesn't hold."""
    found: Memory | None = None
    where = f"the saved state forgets {lost}, which {path} knows; but that log "
    try:
        reading = Reading(path, SAID)
        if reading.public_key not in keys:
            raise ConfigError(f"{where}is signed with a key that this robot does not trust; put the newest state.json back")
        for entry in reading:
            message = entry.message
            if isinstance(message, Persist | Started):
                found = message.memory
    except RecordingError as error:
        raise ConfigError(f"{where}cannot be read ({error}); put the newest state.json back") from None
    if reading.ending.kind == "broken" or found is None or forgotten(told, found):
        raise ConfigError(f"{where}is damaged ({reading.ending.detail or 'its end does not hold'}); put the newest state.json back")
    return found


def forgotten(before: Memory, now: Memory) -> str:
    """What the one knows of what only ever grows, and the other does not; or empty. `now` follows `before` without anything between."""
    if before.robot != now.robot:
        return f"robot {before.robot!r}"
    if now.epochs < before.epochs or now.attempts < before.attempts:
        return f"epochs or attempts: {before.epochs} and {before.attempts} were spent, and it says {now.epochs} and {now.attempts}"
    if what := lost(before, now):
        return what
    if now.epochs == before.epochs and now.campaign_epoch and not before.campaign_epoch:
        return f"that the campaign of epoch {now.campaign_epoch} ended"
    if now.gap is None:
        return ""
    if before.gap is None or before.gap.epoch != now.gap.epoch:
        older = now.gap.epoch <= before.epochs and now.gap.epoch != before.campaign_epoch
        return f"that the gap of epoch {now.gap.epoch} is not in force any more" if older else ""
    return f"the gap of epoch {before.gap.epoch} as it was found" if before.gap != now.gap else ""


def lost(before: Memory, now: Memory) -> str:
    """As `forgotten`, of one robot, whatever runs lie between the two: the audit holds runs against each other by this, too."""
    if gone := before.revoked.keys() - now.revoked.keys():
        return f"that certificate {min(gone)} was revoked"
    if not set(before.refuted) <= set(now.refuted) and len(now.refuted) < REFUTED:
        return "samples whose gap was refuted or outgrown"
    if now.campaign_epoch and now.campaign_epoch == before.campaign_epoch and now.campaign_n != before.campaign_n:
        return f"that the campaign of epoch {now.campaign_epoch} was fixed beforehand at {before.campaign_n} samples"
    if before.gap is None or now.gap is None or before.gap.epoch != now.gap.epoch:
        return ""
    return _of_one_epoch(before, now, now.gap.epoch)


def _of_one_epoch(before: Memory, now: Memory, epoch: int) -> str:
    """As `lost`, of what belongs to a gap that is in force in both."""
    if before.alarm_epoch == epoch != now.alarm_epoch:
        return f"that the watch refuted the gap of epoch {epoch}"
    if now.radius < before.radius:
        return f"that the gap grew to {before.radius}"
    if now.watch_n < before.watch_n or now.watch_exceedances < before.watch_exceedances:
        return f"discrepancies of epoch {epoch}: {before.watch_n} were counted"
    if (now.watch_n, now.watch_exceedances) == (before.watch_n, before.watch_exceedances) and stood(now) != stood(before):
        return f"what the watch made of the {before.watch_n} discrepancies of epoch {epoch}"
    if (now.model_digest, now.campaign_digest) != (before.model_digest, before.campaign_digest):
        return f"of which model and with which settings the gap of epoch {epoch} was measured"
    if now.gap_attempts < before.gap_attempts or (not set(before.behaviours) <= set(now.behaviours) and len(now.behaviours) < BEHAVIOURS):
        return f"controllers that were tried on the gap of epoch {epoch}"
    if before.traced and not now.traced:
        return "that an effect was traced that the model lacks (guarantee G8)"
    return ""


def campaign_logs(folder: Path, robot: str, epoch: int) -> list[Path]:
    """Logs that may hold samples of that epoch's campaign, the newest run first: back to `RUNS` that ended before it began."""
    found: list[Path] = []
    before = 0
    for parts in runs(folder, robot):
        found += parts
        told, _ = _last_memory(parts)
        before += told is not None and told.robot == robot and told.epochs < epoch
        if before == RUNS:
            break
    return found


def samples(logs: Iterable[Path], epoch: int, keys: Collection[bytes]) -> list[SampleTaken]:
    """The samples of that epoch's campaign as the logs have them, by their index, as far as none is missing.

    keys: public ones. A gap will rest on them, so a log counts under one of these alone, and as far as all that it is sealed with holds.
    """
    found: dict[int, SampleTaken] = {}
    for path in logs:
        if any(isinstance(message, SampleTaken) and message.epoch == epoch for message in glance(path, TAKEN)):
            for sample in _sealed(path, keys):
                if sample.epoch == epoch:
                    found.setdefault(sample.index, sample)
    return [found[index] for index in takewhile(found.__contains__, count())]


def _sealed(path: Path, keys: Collection[bytes]) -> Iterator[SampleTaken]:
    with contextlib.suppress(RecordingError, OSError):  # what follows is not known
        reading = Reading(path, TAKEN)
        if reading.public_key in keys:
            for entry in reading:
                message = entry.message
                if isinstance(message, SampleTaken):
                    yield message
