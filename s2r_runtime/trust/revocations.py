"""Keys that are not to be believed any more: a list in a file, which only grows.

    revoked.json    sealed (its digest stands inside), in the user's configuration folder and in a robot's state folder; both count

A key is revoked when somebody else may have it. Nothing that it signed can then be told from a forgery, whenever it says that it was
signed: certificates by it are refused, those in force are revoked, and an audit of a log that it signed fails. (A key that is only
to be replaced is rotated instead, see `keys.rotate`.) There is no way back: make another key. A list that can't be read or was changed is
an error, never an empty list.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable
from pathlib import Path

import msgspec

from s2r_runtime.errors import ConfigError, UsageError, one_line
from s2r_runtime.files.durable import lock, read, replace, seal, unseal

SCHEMA = 1
NAME = "revoked.json"
FINGERPRINT = re.compile(r"ed25519:[0-9a-f]{32}")
REASON_MAX = 200


class Revocation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """fingerprint: as `keys.fingerprint` writes it. unix_s: when it was put on the list, for the reader only."""

    fingerprint: str
    unix_s: int
    reason: str

    def __str__(self) -> str:
        when = time.strftime("%Y-%m-%d", time.gmtime(self.unix_s))
        return f"revoked on {when}" + (f": {self.reason}" if self.reason else "")


class _Content(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    schema: int
    revoked: tuple[Revocation, ...] = ()


def places(*folders: Path) -> tuple[Path, ...]:
    """The lists that count: the user's own, and those in these folders."""
    from s2r_runtime.trust.keys import config_dir

    return tuple(dict.fromkeys(folder / NAME for folder in (config_dir(), *folders)))


def known(lists: Iterable[Path]) -> dict[str, Revocation]:
    """By fingerprint; the earliest entry of each. Raises ConfigError for a list that can't be read, or that others could have written."""
    found: dict[str, Revocation] = {}
    for path in lists:
        for entry in _content(path).revoked:
            if entry.fingerprint not in found or entry.unix_s < found[entry.fingerprint].unix_s:
                found[entry.fingerprint] = entry
    return found


def revoke(path: Path, fingerprint: str, reason: str) -> Revocation:
    """Puts a key on the list, durably; the entry that is there already, if there is one. Raises UsageError for what is no fingerprint,
    ConfigError if the list can't be written.
    """
    if not FINGERPRINT.fullmatch(fingerprint):
        raise UsageError(f"{fingerprint!r}: is no key's fingerprint, must be ed25519: and 32 hex digits (s2r keys list), or a .pub file")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        held = lock(path.with_name(path.name + ".lock"), wait=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        content = _content(path)
        for entry in content.revoked:
            if entry.fingerprint == fingerprint:
                return entry
        entry = Revocation(fingerprint, int(time.time()), one_line(reason, REASON_MAX))
        replace(path, seal("revocations", _Content(SCHEMA, (*content.revoked, entry))))
        return entry
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written, so the key is NOT revoked: {error.strerror}") from None
    finally:
        os.close(held)


def _content(path: Path) -> _Content:
    from s2r_runtime.files.durable import check_own

    try:
        path.lstat()
    except FileNotFoundError:
        return _Content(SCHEMA)
    except OSError as error:  # what cannot be looked at may be a list all the same
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    check_own(path, "a list of revoked keys")
    content = unseal(read(path), "revocations", _Content, str(path))
    if content.schema != SCHEMA:
        raise ConfigError(f"{path}: has schema {content.schema} of revocations, this version reads {SCHEMA}")
    return content
