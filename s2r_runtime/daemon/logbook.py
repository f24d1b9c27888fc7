"""The daemon's log: one recorder a run, its files' names, and what is attached to it.

A recorder that lost a message is at its end (a log has no holes). Then a new run begins in a new file, as soon as the disk takes one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime.daemon.past import NUMBER
from s2r_runtime.daemon.retention import Retention
from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.messages import LogHead, Struct
from s2r_runtime.modelspec import ModelSpec, dump_model
from s2r_runtime.profile import Recording
from s2r_runtime.recording.recorder import Health, Recorder
from s2r_runtime.recording.writer import Writer

Attachment = tuple[str, str, bytes]


class Logbook:
    """Call `begin` before anything else. Nothing waits for the disk but `durable`, `settled`, `begin` and `close`."""

    def __init__(
        self,
        folder: Path,
        robot: str,
        settings: Recording,
        signer: Ed25519PrivateKey,
        *,
        lockstep: bool,
        file: Path | None,
        number: int = 1,
        retention: Retention | None = None,
        disk_timeout_s: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """file: the log's path, if it isn't to have a name of its own in `folder`. number: the first log's, among all of this robot's.
        retention: notes what the logs are evidence of.
        disk_timeout_s: how long the disk is waited for. clock: s, of the time for which messages wait to be written.
        """
        self._folder, self._robot, self._file = folder, robot, file
        self._settings, self._signer, self._lockstep = settings, signer, lockstep
        self._disk_timeout_s, self._clock = disk_timeout_s, clock
        self._numbers = count(number)
        self._writer: Writer | None = None
        self._recorder: Recorder | None = None
        self._next: Writer | None = None
        self._trying: threading.Thread | None = None
        self._earlier: list[Path] = []
        self._attached: dict[str, Attachment] = {}
        self._retention = retention

    def begin(self, profile: Path, model: ModelSpec, files: Mapping[str, str] | None = None) -> None:
        """The first log, with the profile's file and the model in force attached. files: those that the profile's transport names.

        Raises RecordingError or ConfigError if it can't.
        """
        for name, data in (("profile.toml", profile.read_bytes()), ("model.toml", dump_model(model).encode())):
            self._attached[name] = (name, "application/toml", data)
        for name, text in (files or {}).items():
            self._attached[f"profile/{name}"] = (f"profile/{name}", "text/plain", text.encode())
        self._use(self._new())

    def prepare(self) -> bool:
        """After a fault: whether a new log is there to `switch` to. Tries in a thread, as the disk may hang; call it now and then."""
        if self._recorder is not None:
            self._recorder.close(0.0)  # its thread goes on: when there is room it writes its last words
        if self._next is None and (self._trying is None or not self._trying.is_alive()):
            self._trying = threading.Thread(target=self._try, name="new-log", daemon=True)
            self._trying.start()
        return self._next is not None

    def switch(self) -> None:
        """Goes on in the log that was prepared."""
        writer, self._next = self._next, None
        if writer is not None:
            self._use(writer)

    def _try(self) -> None:
        """A log that the disk does not take the first bytes of is none."""
        writer = None
        try:
            writer = self._new()
            writer.durable()
            self._next = writer
        except (RecordingError, ConfigError):
            return
        except OSError:
            if writer is not None:
                writer.abandon()
                for path in writer.parts:
                    path.unlink(missing_ok=True)

    def _new(self) -> Writer:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self._folder}: no log can be written there: {error.strerror}") from None
        path = self._path()
        return Writer(
            path,
            run=path.stem,
            signer=self._signer,
            metadata={"robot": self._robot, NUMBER: str(next(self._numbers))},
            attachments=list(self._attached.values()),
            rotate_bytes=self._settings.rotate_bytes,
            rotate_s=self._settings.rotate_after,
            timed=False,
        )

    def _use(self, writer: Writer) -> None:
        if self._writer is not None:
            self._earlier += self._writer.parts
        self._writer = writer
        if self._retention is not None:
            self._retention.begin(writer.path.stem)
        waits_s = self._disk_timeout_s if self._lockstep else 0.0  # there the robot waits too, so a slow log may slow the loop down
        self._recorder = Recorder(writer, block_s=waits_s, max_delay_s=max(self._settings.max_delay, waits_s), clock=self._clock)

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of this process, oldest first."""
        return (*self._earlier, *(self._writer.parts if self._writer is not None else ()))

    @property
    def parts(self) -> tuple[Path, ...]:
        """The files of this run, oldest first."""
        return tuple(self._writer.parts) if self._writer is not None else ()

    @property
    def run(self) -> str:
        """This run's name."""
        return self._writer.path.stem if self._writer is not None else ""

    @property
    def faulty(self) -> bool:
        """Whether a message was lost, so that this run's log is at its end."""
        return self._recorder is not None and self._recorder.health().unrecorded > 0

    def put(self, message: Struct, t_ns: int) -> None:
        """Records a message. One that cannot be taken shows in `health`."""
        if self._retention is not None:
            self._retention.note(message)
        if self._recorder is not None:
            self._recorder.put(message, t_ns)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Puts a file into the log, once."""
        if self._recorder is not None and name not in self._attached:
            self._attached[name] = (name, media_type, data)
            self._recorder.attach(name, media_type, data)

    def durable(self) -> bool:
        """Whether all that was put is on the disk now, and what it is evidence of noted there."""
        noted = self._retention is None or self._retention.save(self.anchor())
        return noted and self._recorder is not None and self._recorder.durable(self._disk_timeout_s)

    @property
    def behind(self) -> bool:
        """Whether more of the log waits for the disk than may be lost (`recording.max_delay`)."""
        return self._recorder is not None and self._recorder.delay_s > self._settings.max_delay

    def caught_up(self, timeout_s: float) -> bool:
        """Waits until it is not `behind`. False: not within the time."""
        return self._recorder is None or self._recorder.caught_up(self._settings.max_delay, timeout_s)

    def settled(self) -> bool:
        """Whether all that was put so far came to the disk, by itself and within a few seconds. For a thread that has time."""
        recorder = self._recorder
        return recorder is not None and recorder.settled(self._disk_timeout_s)

    def health(self) -> Health:
        """How it is."""
        return (
            self._recorder.health()
            if self._recorder is not None
            else Health(ok=False, detail="no log", unrecorded=0, pending_bytes=0, recorded=0)
        )

    def anchor(self) -> LogHead | None:
        """How far the log is on the disk, and the head of its chain there; None before the first of it is."""
        found = None if self._recorder is None else self._recorder.anchor
        return found if found is not None and found.records else None

    def close(self) -> tuple[Health, str]:
        """Ends the log; (how it ended, head of its chain)."""
        if self._recorder is None:
            return self.health(), ""
        health = self._recorder.close()
        if self._retention is not None:
            self._retention.save(self.anchor(), last=True)
        return health, self._recorder.head

    def _path(self) -> Path:
        base = self._file
        if base is None:
            stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())  # a name, not a decision: the wall clock will do
            base = self._folder / f"{self._robot}-{stamp}.mcap"
        path, number = base, 1
        while path.exists():
            number += 1
            path = base.with_stem(f"{base.stem}-{number}")
        return path
