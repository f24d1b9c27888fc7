"""What outlives the daemon: the core's memory and an unfinished campaign, in the robot's state folder (docs/gate.md).

    state.json      counters, gap in force, grown radius, certificates, revocations (`messages.Memory`)
    campaign.json   an interrupted campaign, so that resuming it costs no new epoch
    begun           written once, after the first state.json: this robot has a past
    lock            held while a daemon runs: two on one state would spend the same beta twice

A file is replaced as a whole (temporary file, fsync, rename, fsync of the folder), so a crash leaves the old one or the new one. Its
content's digest stands inside, so a cut or flipped file is noticed. It is keyed to robot and schema.

Everything fails closed. The counters are the confidence that is already spent (guarantee G4): a damaged state is never
taken for an empty one, and neither is a missing one where anything says that the robot has a past (`begun`, a campaign, or what
the daemon names, such as logs). An old copy that was put back is noticed by what the newest logs end with (`past`). What no file can show
is a whole folder that was deleted or put back, logs included: the audit counts epochs and attempts over the logs that somebody kept.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.durable import lock, read, replace, seal, sync_folder, unseal
from s2r_runtime.messages import MEMORY_SCHEMA, Memory

T = TypeVar("T")


class StateFolder:
    """One robot's state, locked for as long as this is open. Use as a context manager, or call `close`."""

    def __init__(self, path: Path, robot: str) -> None:
        """Makes the folder (0700) and takes its lock. Raises ConfigError if it can't, or if another process has it."""
        self.path, self.robot = path, robot
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            status = path.stat()
            if status.st_uid not in (0, os.geteuid()):
                raise ConfigError(f"{path}: belongs to user {status.st_uid}; a robot's state must be this user's ({os.geteuid()}) own")
            if status.st_mode & 0o022:
                raise ConfigError(f"{path}: others than its owner can write to it, so they could forge what was spent; chmod 700 it")
            self._lock = lock(path / "lock", wait=False)
        except BlockingIOError:
            raise ConfigError(
                f"{path}: another process uses the state of robot {robot!r}; two would spend the same confidence twice"
            ) from None
        except OSError as error:
            raise ConfigError(f"{path}: cannot be used for the state of robot {robot!r}: {error.strerror}") from None

    def memory(self, signs: Iterable[Path] = ()) -> Memory:
        """The memory as last saved, or a fresh one for a robot without a past.

        signs: files, or folders that are not empty, whose presence says that there was an earlier state (logs). Raises
        ConfigError if the state is damaged, of another robot or schema, or missing although there are such signs.
        """
        file = self.path / "state.json"
        if not (file.exists() or file.is_symlink()):
            self._refuse_a_past(signs)
            return Memory(robot=self.robot, schema=MEMORY_SCHEMA)
        memory = unseal(read(file), "state", Memory, str(file))
        if memory.robot != self.robot:
            raise ConfigError(
                f"{file}: is the state of robot {memory.robot!r}, not of {self.robot!r}; give each robot a state folder of its own"
            )
        if memory.schema != MEMORY_SCHEMA:
            raise ConfigError(f"{file}: has state schema {memory.schema}, this version reads {MEMORY_SCHEMA}")
        return memory

    def save(self, memory: Memory) -> None:
        """Durable when this returns. Raises OSError if the disk does not take it (the old state is then whole), ValueError if
        the memory is not this robot's.
        """
        if memory.robot != self.robot or memory.schema != MEMORY_SCHEMA:
            raise ValueError(
                f"memory of robot {memory.robot!r}, schema {memory.schema}; this is the state of {self.robot!r}, schema {MEMORY_SCHEMA}"
            )
        replace(self.path / "state.json", seal("state", memory))
        begun = self.path / "begun"
        if not begun.exists():  # after the state: a crash in between leaves a state, which is what `begun` stands for
            replace(begun, f"Robot {self.robot!r} has a past: beta was spent. See state.json.\n".encode())

    def campaign(self) -> dict[str, Any] | None:
        """The unfinished campaign's snapshot, or None. Raises ConfigError if it is damaged or another robot's."""
        file = self.path / "campaign.json"
        if not (file.exists() or file.is_symlink()):
            return None
        kept = unseal(read(file), "campaign", dict[str, Any], str(file))
        if kept.get("robot") != self.robot or not isinstance(kept.get("snapshot"), dict):
            raise ConfigError(f"{file}: is a campaign of robot {kept.get('robot')!r}, not of {self.robot!r}")
        snapshot: dict[str, Any] = kept["snapshot"]
        return snapshot

    def save_campaign(self, snapshot: Any) -> None:
        """Keeps a campaign's snapshot (a struct or plain data with text keys). Raises OSError as `save`."""
        replace(self.path / "campaign.json", seal("campaign", {"robot": self.robot, "snapshot": snapshot}))

    def forget_campaign(self) -> None:
        """The campaign is over."""
        with contextlib.suppress(FileNotFoundError):
            (self.path / "campaign.json").unlink()
            sync_folder(self.path)

    def close(self) -> None:
        """Frees the lock; may be called twice."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> StateFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _refuse_a_past(self, signs: Iterable[Path]) -> None:
        for sign in (self.path / "begun", self.path / "campaign.json", *signs):
            if sign.is_dir() and not any(sign.iterdir()):
                continue
            if sign.exists():
                raise ConfigError(
                    f"{self.path / 'state.json'}: is missing, but {sign} shows that robot {self.robot!r} has a past; put the state "
                    "back from a copy, or move the whole folder away to begin a new life (earlier certificates are then void)"
                )
