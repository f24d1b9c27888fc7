"""Which logs may be deleted when there are too many: never one that holds the evidence of a certificate that is still valid.

A certificate rests on the campaign of its epoch, the gap made of it, its verification attempt, and, where its model was repaired, on the
trace that made the model and the rows that it was fitted on. A log that holds any of this stays as long as the certificate is neither
expired nor revoked. So does what the gap in force rests on, a campaign that goes on, a model that waits to be adopted, and every log of
which nobody knows what it holds.

What a log holds is noted in the state folder (`log_evidence.json`) before anything may rest on it. Logs are deleted by whole runs, the
oldest first, never the run that goes on; every deletion is said, and logged. How old a log is, and whether a certificate has expired,
is not left to the wall clock alone (`believed_time`).
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec

from s2r_runtime.daemon.believed_time import BelievedTime
from s2r_runtime.errors import S2RError
from s2r_runtime.files.durable import read, replace
from s2r_runtime.messages import (
    AttemptSpent,
    CertificateFacts,
    CertificateStored,
    EpochChanged,
    IssueCertificate,
    JobFinished,
    LogHead,
    Memory,
    ModelAdopted,
    SampleTaken,
    StartCampaign,
    Struct,
)
from s2r_runtime.recording.channels import LogDeleted

DAY_S = 86_400
CLOCK_S = 3600
"""A certificate counts as valid for so long after its end: wall clocks may be wrong, and a log that is gone is gone."""
NOTED = frozenset((StartCampaign, SampleTaken, EpochChanged, AttemptSpent, IssueCertificate, CertificateStored, ModelAdopted, JobFinished))
GOING = ".deleted"
"""Ends the name of a file that is being deleted: renaming takes no time, deleting a large file may."""
_PART = re.compile(r"\.\d{3,}$")


class Held(msgspec.Struct):
    """What the log of a run holds, as tags (`epoch:3`, `attempt:5`, `model:sha256:...`); certificates that were stored in it."""

    tags: set[str] = set()
    certificates: list[CertificateFacts] = []
    head: str = ""
    seen_s: float = 0.0
    """Unix time that was believed when the run was seen to go on; a file's own time is as right as the clock was."""


class Retention:
    """folder: of the logs. state: where what they hold is noted. keep_bytes, keep_days: of all logs; 0: any. say: a line for the journal.

    `note`, `begin` and `save` belong to the daemon's loop, `prune` to a thread of its own.
    """

    def __init__(
        self,
        folder: Path,
        state: Path,
        robot: str,
        keep_bytes: int,
        keep_days: float,
        say: Callable[[str], None],
        believed: Callable[[Path, float | None], BelievedTime] = BelievedTime,
    ) -> None:
        self._folder, self._file, self._robot, self._say = folder, state / "log_evidence.json", robot, say
        self._keep_bytes, self._keep_days = keep_bytes, keep_days
        self._lock = threading.Lock()
        self._run = ""
        self._dirty = False
        self._runs: dict[str, Held] = self._load()
        self._deleted: list[LogDeleted] = []
        newest_s = max((when for files in self._on_disk().values() for _, _, when in files), default=None)
        self._time = believed(state / "log_time.json", newest_s)
        self._thread: threading.Thread | None = None

    def _load(self) -> dict[str, Held]:
        if not self._file.exists():
            return {}
        try:
            return msgspec.json.decode(read(self._file), type=dict[str, Held])
        except (S2RError, ValueError, RecursionError) as error:  # msgspec's and Unicode's are ValueErrors
            self._say(f"{self._file}: cannot be read ({error}); no log from before is deleted, as nobody knows what rests on it")
            return {}

    # ---- what logs hold

    def begin(self, run: str) -> None:
        """A run's log begins."""
        with self._lock:
            self._run = run
            self._time.now()
            self._runs.setdefault(run, Held()).seen_s = self._time.believed_s
            self._dirty = True

    def note(self, message: Struct) -> None:
        """A message is about to be logged."""
        if type(message) not in NOTED or not (tags := _tags(message)):
            return
        with self._lock:
            held = self._runs.setdefault(self._run, Held())
            for run in (self._run, *_runs_before(message)):
                there = self._runs.get(run)
                if there is not None and not tags <= there.tags:
                    there.tags |= tags
                    self._dirty = True
            if isinstance(message, CertificateStored) and message.facts not in held.certificates:
                held.certificates.append(message.facts)
                self._dirty = True

    def save(self, head: LogHead | None = None, *, last: bool = False) -> bool:
        """Whether what was noted is on the disk now: nothing may rest on a log before. head: of this run's, as far as it is on the disk;
        it alone is worth a write if it is the last.
        """
        with self._lock:
            if not (self._dirty or last):
                return True
            if head is not None and head.run in self._runs:
                self._runs[head.run].head = head.head
            try:
                replace(self._file, msgspec.json.encode(self._runs, order="deterministic"))
            except OSError:
                return False
            self._dirty = False
            return True

    # ---- what is deleted

    def prune_beside(self, memory: Callable[[], Memory]) -> None:
        """Begins to delete what may be, in a thread: a file system may take its time for a large file."""
        if (self._keep_bytes or self._keep_days) and (self._thread is None or not self._thread.is_alive()):
            self._thread = threading.Thread(target=self.prune, args=(memory,), name="log-retention", daemon=True)
            self._thread.start()

    def deleted(self) -> list[LogDeleted]:
        """What was deleted since the last call, to be logged."""
        with self._lock:
            found, self._deleted = self._deleted, []
        return found

    def prune(self, memory: Callable[[], Memory]) -> None:
        """Deletes the oldest logs that may be deleted until the others are few and young enough. memory: as it is when it is asked."""
        for left in self._folder.glob(f"{self._robot}-*{GOING}"):  # of a daemon that was killed while it deleted
            with contextlib.suppress(OSError):
                left.unlink()
        with self._lock:
            unix_s = self._time.now()
            if (current := self._runs.get(self._run)) is not None:
                current.seen_s = self._time.believed_s
            seen = {run: held.seen_s for run, held in self._runs.items()}
        self._time.save()
        runs = self._on_disk()
        total = sum(size for files in runs.values() for _, size, _ in files)
        for run in sorted(runs, key=lambda run: max(seen.get(run, 0.0), min(when for _, _, when in runs[run]))):
            last_s = max(seen.get(run, 0.0), *(when for _, _, when in runs[run]))
            old = self._keep_days > 0 and last_s < unix_s - self._keep_days * DAY_S
            many = self._keep_bytes > 0 and total > self._keep_bytes
            if old or many:
                reason = f"older than {self._keep_days:g} days" if old else f"all logs together had {total} bytes"
                total -= self._delete(run, runs[run], reason, memory, unix_s)

    def _on_disk(self) -> dict[str, list[tuple[Path, int, float]]]:
        """Run -> (file, bytes, time of its last change), part by part."""
        found: dict[str, list[tuple[Path, int, float]]] = {}
        for path in sorted(self._folder.glob(f"{self._robot}-*.mcap"), key=lambda path: (len(path.name), path.name)):  # .002 behind none
            try:
                about = path.lstat()
            except FileNotFoundError:
                continue
            found.setdefault(_PART.sub("", path.stem), []).append((path, about.st_size, about.st_mtime))
        return found

    def _delete(self, run: str, files: list[tuple[Path, int, float]], reason: str, memory: Callable[[], Memory], unix_s: float) -> int:
        """All of it, or nothing, if nothing rests on it. How many bytes that gave."""
        gone = []
        with self._lock:  # whatever is noted from here on finds the log gone, or is noted before
            held = self._runs.get(run)
            if held is None or run == self._run or held.tags & _needed(memory(), unix_s, self._runs.values()):
                return 0
            for path, _, _ in reversed(files):  # the last part first, so that what an interruption leaves can be audited
                try:
                    gone.append(path.rename(path.with_name(path.name + GOING)))
                except OSError as error:
                    self._say(f"{path}: cannot be deleted: {error.strerror}")
                    for other in gone:
                        with contextlib.suppress(OSError):
                            other.rename(other.with_name(other.name.removesuffix(GOING)))
                    return 0
            del self._runs[run]
            total = sum(size for _, size, _ in files)
            self._deleted.append(LogDeleted(0, run, len(files), total, held.head, reason))
            self._dirty = True
            self._say(
                f"log of run {run} deleted ({total} bytes, head {held.head or 'not known'}): {reason}; no valid certificate rests on it"
            )
        for path in gone:
            with contextlib.suppress(OSError):  # it is tried again at the next look
                path.unlink()
        return total


def _tags(message: Struct) -> set[str]:
    """What a log is evidence of, by holding this message."""
    match message:
        case StartCampaign() | SampleTaken() | EpochChanged():
            return {f"epoch:{message.epoch}"}
        case AttemptSpent():
            return {f"attempt:{message.attempt}"}
        case IssueCertificate():
            return {f"attempt:{message.verification.attempt}", f"epoch:{message.gap.epoch}"}
        case CertificateStored():
            return {f"certificate:{message.facts.id}"}
        case ModelAdopted():
            return {f"model:{message.digest}"}
        case JobFinished(gap=gap) if gap is not None:
            return {f"epoch:{gap.epoch}"}
        case JobFinished(verification=verification) if verification is not None:
            return {f"attempt:{verification.attempt}"}
        case JobFinished(trace=trace) if trace is not None:
            proposal = trace.get("proposal")
            return {f"model:{proposal['digest']}"} if isinstance(proposal, dict) and "digest" in proposal else set()
        case _:
            return set()


def _runs_before(message: Struct) -> list[str]:
    """Other runs that hold rows which a trace was made on."""
    trace = message.trace if isinstance(message, JobFinished) else None
    recording: Any = None if trace is None else trace.get("recording")
    return [] if recording is None else [part["run"] for part in recording["parts"]]


def _needed(memory: Memory, unix_s: float, logs: Iterable[Held]) -> set[str]:
    """What something that is valid, or may become it, rests on."""
    needed = {f"epoch:{memory.campaign_epoch}", f"model:{memory.model_digest}"}
    if memory.gap is not None:
        needed.add(f"epoch:{memory.gap.epoch}")
    if memory.proposal is not None:
        needed.add(f"model:{memory.proposal.digest}")
    for facts in (*memory.certificates, *(facts for held in logs for facts in held.certificates)):
        if facts.id not in memory.revoked and unix_s <= facts.expires_unix_s + CLOCK_S:
            needed |= {f"certificate:{facts.id}", f"epoch:{facts.epoch}", f"attempt:{facts.attempt}", f"model:{facts.model_digest}"}
    return needed
