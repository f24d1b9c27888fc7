"""The ledger of offline certification: which gap epochs and verification attempts a key has paid for, by robot (guarantee G4).

    epoch i spends 3 beta / (pi^2 i^2), attempt j spends 3 beta / (pi^2 j^2)

It lies beside the key, `<name>.ledger.json`, and belongs to it: what a key may state depends on what was tried with it. An entry is
durable before its number is given out, and never taken back. Two processes that certify at once get different numbers. A
ledger that is damaged or missing is an error, never an empty one: starting again from 1 would be a retry without paying.
"""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Literal

import msgspec

from s2r_runtime.core.ledger import share
from s2r_runtime.daemon.persistence import lock, read, replace, seal, unseal
from s2r_runtime.errors import ConfigError

SCHEMA = 1


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One thing paid for. `subject`: what it was for; `unix_s`: when, for the reader only."""

    robot: str
    kind: Literal["epoch", "attempt"]
    number: int
    subject: tuple[str, ...]
    unix_s: int


class Content(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All entries, oldest first."""

    schema: int
    entries: tuple[Entry, ...] = ()


def path_beside(key_path: Path) -> Path:
    """Where a key's ledger is."""
    return key_path.with_suffix(".ledger.json")


def create(key_path: Path) -> Path:
    """An empty ledger for a key that never certified anything. Raises ConfigError if there is one."""
    path = path_beside(key_path)
    held = _locked(path)
    try:
        if path.exists():
            raise ConfigError(f"{path}: is there already; a ledger is never begun anew")
        replace(path, seal("ledger", Content(SCHEMA)))
    finally:
        os.close(held)
    return path


def open_ledger(key_path: Path, robot: str) -> Ledger:
    """The key's ledger, for one robot. Raises ConfigError if it is missing or damaged."""
    ledger = Ledger(path_beside(key_path), robot)
    ledger.entries()
    return ledger


class Ledger:
    """What one key has spent on one robot. Every call reads the file anew, so any number of processes may use it."""

    def __init__(self, path: Path, robot: str) -> None:
        self.path, self.robot = path, robot

    def entries(self) -> tuple[Entry, ...]:
        """This robot's entries, oldest first. Raises ConfigError if the ledger is missing or damaged."""
        return tuple(e for e in self._content().entries if e.robot == self.robot)

    def epoch_for(self, *subject: str) -> int:
        """The epoch in which this gap stands; spends a new one for a gap that was not asked for before.

        subject: everything the gap depends on, as digests: the recording, the model, the profile (its norm, epsilon, discards).
        One gap serves many certificates, so asking again for the same one costs nothing.
        """
        return self._number("epoch", subject, again=True)

    def spend_attempt(self, *subject: str) -> int:
        """A new verification attempt, paid for whether or not it passes, also on what was tried before."""
        return self._number("attempt", subject, again=False)

    def spent(self, beta: float) -> float:
        """How much of the budget beta is gone: sum of 3 beta/(pi^2 i^2) over the epochs and over the attempts."""
        return math.fsum(share(beta, entry.number) for entry in self.entries())

    def _number(self, kind: Literal["epoch", "attempt"], subject: tuple[str, ...], *, again: bool) -> int:
        held = _locked(self.path)
        try:
            content = self._content()
            mine = [e for e in content.entries if e.robot == self.robot and e.kind == kind]
            if again and (known := [e for e in mine if e.subject == subject]):
                return known[0].number
            entry = Entry(self.robot, kind, len(mine) + 1, subject, int(time.time()))
            try:
                replace(self.path, seal("ledger", Content(SCHEMA, (*content.entries, entry))))
            except OSError as error:
                raise ConfigError(f"{self.path}: cannot be written, so nothing may be certified: {error.strerror}") from None
            return entry.number
        finally:
            os.close(held)

    def _content(self) -> Content:
        if not self.path.exists():
            raise ConfigError(
                f"{self.path}: is missing, so nobody knows what this key has spent; put it back, or make another key with s2r keys new"
            )
        content = unseal(read(self.path), "ledger", Content, str(self.path))
        if content.schema != SCHEMA:
            raise ConfigError(f"{self.path}: has ledger schema {content.schema}, this version reads {SCHEMA}")
        return content


def _locked(path: Path) -> int:
    try:
        return lock(path.with_name(path.name + ".lock"), wait=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be locked: {error.strerror}") from None
