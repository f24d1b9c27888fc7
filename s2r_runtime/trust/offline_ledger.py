"""The ledger of offline certification: which gap epochs and verification attempts a key has paid for, by robot (guarantee G4).

    epoch i spends 3 beta / (pi^2 i^2), attempt j spends 3 beta / (pi^2 j^2)

Whatever controller an attempt is of, all attempts share this one budget: given everything before it, attempt j certifies wrongly
with probability at most its share, since its seed is drawn only after it was paid for (`seeds`). The union bound over the attempts then
holds however many controllers were tried, and however each was chosen.

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
from s2r_runtime.errors import ConfigError
from s2r_runtime.evidence import seeds
from s2r_runtime.files.durable import lock, read, replace, seal, unseal
from s2r_runtime.messages import Tries

SCHEMA = 1


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One thing paid for. `subject`: what it was for; `unix_s`: when, for the reader only.

    Of an attempt: `epoch`: of its gap (0: none that founds a certificate); `seed`: drawn once the entry was durable; `behaviour`: of the
    controller, once it has answered (`probe`). An entry of an earlier version has none of them.
    """

    robot: str
    kind: Literal["epoch", "attempt"]
    number: int
    subject: tuple[str, ...]
    unix_s: int
    epoch: int = 0
    seed: int | None = None
    behaviour: str = ""


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

    def spend_attempt(self, *subject: str, epoch: int = 0) -> int:
        """A new verification attempt on the gap of that epoch, paid for whether or not it passes, also on what was tried before."""
        return self._number("attempt", subject, again=False, epoch=epoch)

    def draw_seed(self, attempt: int) -> int:
        """The attempt's seed: drawn now that the attempt is paid for, durable in the ledger before it is used, and drawn only once."""
        paid = [e for e in self.entries() if e.kind == "attempt" and e.number == attempt and e.seed is None]
        if not paid:
            raise ConfigError(f"{self.path}: attempt {attempt} was not paid for, or has its seed")
        seed = seeds.drawn()
        self._note(attempt, seed=seed)
        return seed

    def ended(self, attempt: int, behaviour: str) -> Tries:
        """The attempt is over, the controller behaves so (empty: it gave no answer). What was tried until then, this one included."""
        self._note(attempt, behaviour=behaviour)
        made = [e for e in self.entries() if e.kind == "attempt" and e.number <= attempt]
        on_gap = [e for e in made if e.epoch == made[-1].epoch]
        return Tries(attempt, len(on_gap), len({e.behaviour or e.subject for e in on_gap}))

    def spent(self, beta: float) -> float:
        """How much of the budget beta is gone: sum of 3 beta/(pi^2 i^2) over the epochs and over the attempts."""
        return math.fsum(share(beta, entry.number) for entry in self.entries())

    def _number(self, kind: Literal["epoch", "attempt"], subject: tuple[str, ...], *, again: bool, epoch: int = 0) -> int:
        held = _locked(self.path)
        try:
            content = self._content()
            mine = [e for e in content.entries if e.robot == self.robot and e.kind == kind]
            if again and (known := [e for e in mine if e.subject == subject]):
                return known[0].number
            entry = Entry(self.robot, kind, len(mine) + 1, subject, int(time.time()), epoch)
            self._write((*content.entries, entry))
            return entry.number
        finally:
            os.close(held)

    def _note(self, attempt: int, **changes: int | str) -> None:
        """What became of an attempt."""
        held = _locked(self.path)
        try:
            key = self.robot, "attempt", attempt
            entries = self._content().entries
            self._write(tuple(msgspec.structs.replace(e, **changes) if (e.robot, e.kind, e.number) == key else e for e in entries))
        finally:
            os.close(held)

    def _write(self, entries: tuple[Entry, ...]) -> None:
        try:
            replace(self.path, seal("ledger", Content(SCHEMA, entries)))
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be written, so nothing may be certified: {error.strerror}") from None

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
