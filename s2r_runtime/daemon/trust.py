"""Whom the daemon believes: its own key and those in `trusted/`, less the revoked ones; and which certificates that leaves.

A certificate in force stays in force only while a file of its own in `certificates/` says what the memory says, signed by such a key. That
is looked at when the daemon starts, so that a memory that was written by somebody else carries no certificate that nobody signed; and
within a second of every change of a list of revoked keys or of `trusted/`.

While such a list can't be read nobody knows what still counts: the gate is closed (`trouble`, which the daemon reports as it does a disk
that takes no log), but no certificate ends for it. That is for good, and what can't be read now may be readable in a second, and say
nothing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

import msgspec

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.durable import read
from s2r_runtime.messages import CertificateFacts, CertificatesDistrusted, Memory
from s2r_runtime.trust import certificate as certificates
from s2r_runtime.trust import keys, revocations

_Seen = tuple[tuple[str, int, int, int], ...]


class Trust:
    """folder: the robot's state. own: the public half of the key that the daemon signs with. former: of those before it. simulated:
    whether certificates whose seed was fixed count.
    """

    def __init__(self, folder: Path, own: bytes, former: tuple[bytes, ...] = (), *, simulated: bool = False) -> None:
        """Raises ConfigError if a list of revoked keys or a trusted key can't be read, or could be somebody else's work."""
        self._former, self._simulated = former, simulated
        self._own, self._trusted, self._certificates = own, folder / "trusted", folder / "certificates"
        self._lists = revocations.places(folder)
        self._revoked: dict[str, revocations.Revocation] = {}
        self._seen: _Seen | None = None
        self._looked_at: tuple[str, ...] = ()
        self.trouble = ""
        """Why nobody knows at the moment whose signature counts, or empty."""
        self.keys()

    def keys(self) -> tuple[bytes, ...]:
        """Public keys whose signature counts. Raises ConfigError as above."""
        return self._read()[0]

    def log_keys(self) -> tuple[bytes, ...]:
        """Public keys whose logs are this robot's past: also those that were rotated, as what they show as spent stays spent. Raises as
        above.
        """
        believed, revoked = self._read()
        return tuple(dict.fromkeys((*believed, *(key for key in self._former if keys.fingerprint(key) not in revoked))))

    def _read(self) -> tuple[tuple[bytes, ...], dict[str, revocations.Revocation]]:
        """Public keys whose signature counts, and the revoked ones."""
        revoked = self._revoked = revocations.known(self._lists) | self._revoked  # a list only grows: an entry that is gone was taken out
        return tuple(key for key in (self._own, *keys.load_trusted([self._trusted])) if keys.fingerprint(key) not in revoked), revoked

    def objection(self, key: bytes) -> str:
        """Why a signature by this key is not believed, or empty. Raises ConfigError as above."""
        return _objection(key, *self._read())

    def own_objection(self) -> str:
        """Why this daemon signs nothing any more, or empty."""
        try:
            entry = self._read()[1].get(keys.fingerprint(self._own))
        except ConfigError as error:
            return str(error)
        return "" if entry is None else f"this daemon's own key was {entry}; s2r keys rotate, and start it anew"

    def check_own(self) -> None:
        """Raises ConfigError if this daemon's own key was revoked, on whatever list: what it signs, its log too, is believed by nobody."""
        if problem := self.own_objection():
            raise ConfigError(problem)

    def look(self, memory: Memory) -> tuple[CertificatesDistrusted, ...]:
        """What is not believed any more, if anything has changed since the last look."""
        now, ids = self._state(), tuple(facts.id for facts in memory.certificates)
        if now == self._seen and set(ids) <= set(self._looked_at) and not self.trouble:
            return ()
        try:
            believed = self._read()
        except ConfigError as error:
            self.trouble = str(error)
            return ()
        self.trouble, self._seen, self._looked_at = "", now, ids
        reasons = {facts.id: why for facts in memory.certificates if (why := self._problem(facts, *believed))}
        return (CertificatesDistrusted(0, reasons),) if reasons else ()

    def _problem(self, facts: CertificateFacts, trusted: tuple[bytes, ...], revoked: Mapping[str, revocations.Revocation]) -> str:
        file = certificate_file(self._certificates, facts.id)
        try:
            data = read(file)
            if why := _objection(certificates.signer(data), trusted, revoked):
                return why
            found = certificates.facts(certificates.load(data, trusted, None, str(file)))
        except ConfigError as error:
            return str(error)
        if not self._simulated and (why := certificates.fixed_seed_problem(found)):
            return why
        known = msgspec.structs.replace(facts, fixed_seed=found.fixed_seed)  # an earlier version's memory does not have it: the file counts
        return "" if found == known else f"{file}: says something else than the robot's state"

    def _state(self) -> _Seen:
        files = [*self._lists, self._trusted]
        with contextlib.suppress(OSError):
            files += sorted(self._trusted.glob("*.pub"))
        found = []
        for file in files:
            try:
                status = file.lstat()
            except OSError:
                found.append((str(file), 0, 0, 0))
            else:
                found.append((str(file), status.st_ctime_ns, status.st_size, status.st_ino))  # ctime: its permissions count too
        return tuple(found)


def _objection(key: bytes, trusted: tuple[bytes, ...], revoked: Mapping[str, revocations.Revocation]) -> str:
    name = keys.fingerprint(key)
    if (entry := revoked.get(name)) is not None:
        return f"signed with the key {name}, which was {entry}"
    return "" if key in trusted else f"signed with the key {name}, which is not trusted here"


def certificate_file(folder: Path, identity: str) -> Path:
    """Where a certificate of that id is."""
    return folder / f"{identity.removeprefix('sha256:')}.json"
