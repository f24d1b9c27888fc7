"""A robot's state held against its newest log, when the daemon starts: a state that was put back from a copy must not forget.

    S   the state as it was last saved                   L   the memory with which the newest log ends (its last `Persist`, or `Started`)

    S forgets nothing that L knows                       S counts: it was saved when the log was lost, or logged elsewhere (`-o FILE`)
    S forgets something, L nothing that S knows          L counts: S is an older copy, was edited, or did not reach the disk
    each forgets something that the other knows          nobody knows what was spent: the daemon does not start

What is latched in either is latched. A log counts only if its first seal, and the name in it, are this robot's own: by a key that it
signs with, signed with before, or trusts. What any other file in the folder claims is reported, and changes nothing. Before anything
rests on a log it is read in full; an own one that is damaged starts nothing. The newest log is the one with the highest number in its
metadata: a name has the time of a wall clock, which may have been wrong. The samples of an unfinished campaign are compared with the logs
in the same way: who takes them once more may choose.

What no log shows that is still there, this can't: a whole folder that was put back, logs included, or logs that were deleted. Then the
heads that were published elsewhere tell (docs/log-format.md), and the audit over the logs that somebody kept.
"""

from __future__ import annotations

import contextlib
import re
from bisect import insort
from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import count, islice, takewhile
from pathlib import Path

import msgspec

from s2r_runtime.core.gaps import REFUTED
from s2r_runtime.core.runs import CONTROLLERS
from s2r_runtime.core.stream import stood
from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.messages import BEHAVIOURS, Memory, Persist, SampleTaken, Started
from s2r_runtime.recording.glance import glance
from s2r_runtime.recording.layout import ABOUT
from s2r_runtime.recording.reading import Reading

SAID = ("event/started", "out/persist")
TAKEN = ("event/sample_taken",)
RUNS = 3
"""Newest runs that say something and are looked into: logs of before they were numbered may be older than their names. One that ended
before its first event says nothing, and does not count.
"""
NUMBER = "number"
"""Of a log among all of its robot's, in its first metadata record."""
_NAME = re.compile(r"-(\d{8}T\d{6}Z)(?:-(\d{1,9}))?(?:\.(\d{3,9}))?\.mcap")
"""What follows the robot in a log's name: when the run began, which of several in that second, which part of it."""
_DIGITS = re.compile(r"[0-9]{1,15}")
SHOWN = 3
"""Names of logs that do not count, said in the one line about them."""


class Logs:
    """The logs of one robot in a folder. keys: public ones; a log counts if it is sealed with one of them."""

    def __init__(self, folder: Path, robot: str, keys: Collection[bytes]) -> None:
        self._robot, self._keys = robot, keys
        self.foreign: list[Path] = []
        """Files that were looked at, and are not this robot's own."""
        found: dict[tuple[str, int], list[tuple[int, Path]]] = {}
        for path in folder.glob(f"{robot}-*.mcap"):
            if name := _NAME.fullmatch(path.name.removeprefix(robot)):
                found.setdefault((name[1], int(name[2] or 1)), []).append((int(name[3] or 1), path))
        runs = [(began, [path for _, path in sorted(parts)]) for began, parts in found.items()]
        self._runs = sorted((max(map(_number, parts)), began, parts) for began, parts in runs)
        self._counted: dict[Path, bool] = {}

    @property
    def next_number(self) -> int:
        """One more than the highest of those that count."""
        return next((number + 1 for number, _ in self._newest_first()), 1)

    def _newest_first(self) -> Iterator[tuple[int, list[Path]]]:
        """Number and parts of each run, by the number of its first part that is this robot's own: what a foreign one in its place claims
        makes it neither newer nor older.
        """
        pending = self._runs.copy()
        while pending:
            most, began, parts = pending.pop()
            own = next(filter(self._counts, parts), None)
            number = -1 if own is None else _number(own)
            if number == most:
                yield number, parts
            elif own is not None:
                insort(pending, (number, began, parts))

    def runs(self) -> Iterator[list[Path]]:
        """The files of each run that are this robot's own, part by part; the newest run first."""
        for _, parts in self._newest_first():
            yield list(filter(self._counts, parts))

    def ends(self) -> Iterator[tuple[Memory, Path]]:
        """What each run ends with, and where it says so, the newest first."""
        for _, parts in self._newest_first():
            found = _last_memory(filter(self._counts, reversed(parts)))
            if found is not None and found[0].robot == self._robot:
                yield found

    def _counts(self, path: Path) -> bool:
        """See `_is_own`; each file is looked at once."""
        if path not in self._counted:
            self._counted[path] = self._is_own(path)
        return self._counted[path]

    def _is_own(self, path: Path) -> bool:
        """Whether the file begins with a seal by one of the keys, and is of the run that its name says. Nothing else in it is checked."""
        try:
            reading = Reading(path)
            own = reading.public_key in self._keys and path.stem in {reading.run, f"{reading.run}.{reading.part:03}"}
            if own and next(iter(reading), None) is not None:
                return reading.signed
            if not own or reading.ending.kind == "broken":  # else a crash cut it before its first seal
                self.foreign.append(path)
        except RecordingError:  # no log at all
            pass
        return False


def _number(path: Path) -> int:
    """A log's number as its beginning claims; 0 if it has none."""
    try:
        text = Reading(path).metadata[ABOUT].get(NUMBER, "")
    except RecordingError:
        return 0
    return int(text) if _DIGITS.fullmatch(text) else 0


def reconciled(state: Memory, logs: Logs, keys: Collection[bytes], say: Callable[[str], None]) -> Memory:
    """The memory to start with. keys: public ones, whose logs count. Raises ConfigError if state and logs cannot both be true."""
    newest: tuple[Memory, Path] | None = None
    for claimed, path in islice(logs.ends(), RUNS):
        newest = newest or (claimed, path)
        if what := forgotten(claimed, state):
            if gained := forgotten(state, claimed):
                raise ConfigError(
                    f"the state of robot {state.robot!r} forgets {what}, which {path} knows, and that log does not know {gained}: put the "
                    "newest state.json back, or move state and logs away to begin a new life (earlier certificates are then void)"
                )
            say(f"the saved state forgets {what}; going on from what {path.name} ends with")
            state = msgspec.structs.replace(_in_full(path, claimed, keys, what), latched=_both(claimed.latched, state.latched))
    if logs.foreign:
        names = ", ".join(path.name for path in logs.foreign[:SHOWN])
        more = f" and {len(logs.foreign) - SHOWN} more" if len(logs.foreign) > SHOWN else ""
        say(f"logs that no key of this robot sealed under their name: {names}{more}; nothing that they hold counts")
    return state if newest is None else _with_latches(state, *newest, keys, say)


def _with_latches(state: Memory, claimed: Memory, path: Path, keys: Collection[bytes], say: Callable[[str], None]) -> Memory:
    """The state with what the newest log, at `path`, ends with as latched, and with its latest time."""
    # a run whose clock was ahead may be the newest; since then a person may have cleared it
    seen = claimed.latest_unix_s if claimed.clock_cleared >= state.clock_cleared else 0
    later = seen > state.latest_unix_s
    missing = tuple(reason for reason in claimed.latched if reason not in state.latched)
    if later or missing:
        _in_full(path, claimed, keys, f"the time {seen} s" if later else f"that {', '.join(missing)} is latched")
    if later:
        say(f"the saved state does not know of the time {seen} s that the newest log ends with; certificates expire by that")
        state = msgspec.structs.replace(state, latest_unix_s=seen)
    if missing:
        say(f"the saved state does not know that {', '.join(missing)} is latched, as the newest log ends with; it is latched")
        state = msgspec.structs.replace(state, latched=_both(state.latched, missing))
    return state


def _both(one: tuple[str, ...], other: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys((*one, *other)))


def _last_memory(newest_first: Iterable[Path]) -> tuple[Memory, Path] | None:
    for path in newest_first:
        for message in glance(path, SAID, newest_first=True):
            if isinstance(message, Persist | Started):
                return message.memory, path
    return None


def _in_full(path: Path, claimed: Memory, keys: Collection[bytes], lost: str) -> Memory:
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
    if reading.ending.kind == "broken" or found is None or forgotten(claimed, found):
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
    if what := _runs_lost(before, now):
        return what
    if now.campaign_epoch and now.campaign_epoch == before.campaign_epoch and now.campaign_n != before.campaign_n:
        return f"that the campaign of epoch {now.campaign_epoch} was fixed beforehand at {before.campaign_n} samples"
    if before.gap is None or now.gap is None or before.gap.epoch != now.gap.epoch:
        return ""
    return _of_one_epoch(before, now, now.gap.epoch)


def _runs_lost(before: Memory, now: Memory) -> str:
    """As `lost`, of the runs that controllers drove (guarantee G10)."""
    if now.run_sequences < before.run_sequences or now.runs_cleared < before.runs_cleared:
        return f"sequences of runs: {before.run_sequences} were begun"
    if now.drives < before.drives:
        return f"drives: {before.drives} starts and ends of controllers were seen"
    known = {(one.controller, one.certificate): one for one in now.runs}
    for one in before.runs:
        later = known.get((one.controller, one.certificate))
        if later is not None and later.number == one.number:
            if later.n < one.n or later.unsafe < one.unsafe or later.censored < one.censored or (one.exceeded and not later.exceeded):
                return f"runs of controller {one.controller}: {one.n} were counted, {one.unsafe} of them unsafe"
        elif later is None and not one.certificate and now.runs_cleared == before.runs_cleared and len(now.runs) < CONTROLLERS:
            return f"the {one.n} runs of controller {one.controller}"
    return ""


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


def campaign_logs(logs: Logs, robot: str, epoch: int) -> list[Path]:
    """Logs that may hold samples of that epoch's campaign, the newest run first: back to `RUNS` that ended before it began."""
    found: list[Path] = []
    before = 0
    for parts in logs.runs():
        found += parts
        ending = _last_memory(reversed(parts))
        before += ending is not None and ending[0].robot == robot and ending[0].epochs < epoch
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
