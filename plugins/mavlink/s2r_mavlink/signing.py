"""Signatures of MAVLink 2: who holds the key made this frame, and it is not an old one.

    signed frame = frame, link id [1], stamp [6], signature [6]
    signature    = the first 6 bytes of SHA-256(key, frame, link id, stamp)
    stamp        = 10 microseconds since 2015-01-01; of one stream (link id, system, component) strictly rising

What the reference implementation in Python (pymavlink 2.4.50) leaves open is closed here, and held by tests:

- a stamp counts only after its signature was found good: a forged frame from the far future locks nobody out;
- `floor`: a stream that was not heard before must be newer than everything that any run before this one saw or sent. The floor is written
  to disk ahead of time, so that it holds after a crash too. A peer that lags behind follows the first signed frame that it hears from us,
  as the protocol asks of it; a recording does not;
- without a key nothing that is signed counts, and with one nothing that isn't.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import threading
from contextlib import suppress
from pathlib import Path

from s2r_runtime.errors import ConfigError

EPOCH_2015_S = 1_420_070_400
PER_SECOND = 100_000
KEY_BYTES = 32
LATEST = 1 << 47
"""A stamp of the year 2059: even who holds the key can't drive the count (48 bits) to its end, after which nobody could sign any more."""
RESERVE = 60 * PER_SECOND
"""How far ahead the floor is written. It is written again when half of that is used: so twice a minute, by a thread of its own."""


def read_key(path: Path) -> bytes:
    """The key in a file of 64 hexadecimal digits that only its owner can read. Raises ConfigError."""
    try:
        mode, text = path.stat().st_mode, path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not text"
        raise ConfigError(f"transport.signing_key_file: {path}: cannot be read: {why}") from None
    if mode & 0o077:
        raise ConfigError(f"transport.signing_key_file: {path}: others can read it, must be readable by its owner only (chmod 600)")
    with suppress(ValueError):
        key = bytes.fromhex(text)
        if len(key) == KEY_BYTES:
            return key
    raise ConfigError(f"transport.signing_key_file: {path}: must hold {2 * KEY_BYTES} hexadecimal digits")


def stamp_of(unix_s: float) -> int:
    """A wall-clock time as a stamp; never below zero (a companion computer without a clock of its own begins in 1970)."""
    return max(0, int((unix_s - EPOCH_2015_S) * PER_SECOND))


def default_state(key: bytes) -> Path:
    """Where the floor of this key is kept."""
    root = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return root / "s2r" / "mavlink-signing" / f"{hashlib.sha256(key).hexdigest()[:16]}.json"


class Signing:
    """Signs and verifies under one key. state: the file that keeps the floor. Raises ConfigError if that file is no good."""

    def __init__(self, key: bytes, state: Path, unix_s: float, link: int = 0) -> None:
        self._key, self._state, self._link = key, state, link
        self._streams: dict[tuple[int, int, int], int] = {}
        self._floor = self._newest = max(stamp_of(unix_s), _kept(state))
        self._reserved = self._newest + RESERVE
        try:
            _keep(state, self._reserved)
        except OSError as error:
            raise ConfigError(f"transport.signing_state: {state}: cannot be written: {error.strerror}") from None
        self._keeper = _Keeper(state)

    def sign(self, frame: bytes, unix_s: float) -> bytes:
        """The frame (made with `signed`) with its signature behind it. Stamps only rise, also where the wall clock steps back."""
        self._newest = max(self._newest + 1, stamp_of(unix_s))
        self._look_ahead()
        body = frame + bytes((self._link,)) + self._newest.to_bytes(6, "little")
        return body + hashlib.sha256(self._key + body).digest()[:6]

    def verify(self, frame: bytes, *, signed: bool) -> str:
        """Why this whole frame does not count, or empty. Only one that counts changes anything."""
        if not signed:
            return "unsigned"
        if not hmac.compare_digest(hashlib.sha256(self._key + frame[:-6]).digest()[:6], frame[-6:]):
            return "bad_signature"
        stream, stamp = (frame[-13], frame[5], frame[6]), int.from_bytes(frame[-12:-6], "little")
        if stamp <= self._streams.get(stream, self._floor):
            return "old_stamp"
        if stamp >= LATEST:
            return "far_future"
        self._streams[stream] = stamp
        if stamp > self._newest:
            self._newest = stamp
            self._look_ahead()
        return ""

    def close(self) -> None:
        """Writes where the stamps stand; may be called twice."""
        self._keeper.close()
        with suppress(OSError):  # what was written ahead holds
            _keep(self._state, self._newest)

    def _look_ahead(self) -> None:
        """Has the floor of a later run written before it is needed, without waiting for the disk."""
        if self._newest + RESERVE // 2 >= self._reserved:
            self._reserved = self._newest + RESERVE
            self._keeper.keep(self._reserved)


class _Keeper:
    """Writes the newest floor that it is given, from a thread of its own. A write that fails is tried again with the next."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._wake = threading.Condition()
        self._floor, self._written, self._ending = 0, 0, False
        self._thread = threading.Thread(target=self._run, name="mavlink-signing", daemon=True)
        self._thread.start()

    def keep(self, floor: int) -> None:
        """Returns at once."""
        with self._wake:
            self._floor = floor
            self._wake.notify()

    def close(self) -> None:
        """Writes what is left; may be called twice."""
        with self._wake:
            self._ending = True
            self._wake.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._wake:
                while self._floor == self._written and not self._ending:
                    self._wake.wait()
                floor, ending = self._floor, self._ending
            if floor != self._written:
                with suppress(OSError):
                    _keep(self._path, floor)
                self._written = floor
            elif ending:
                return


def _kept(path: Path) -> int:
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))["newest"]
    except FileNotFoundError:
        return 0
    except (OSError, ValueError, KeyError, TypeError):
        kept = None
    if not isinstance(kept, int) or not 0 <= kept < 1 << 48:
        raise ConfigError(f'transport.signing_state: {path}: must hold {{"newest": STAMP}}; deleting it forgets what was heard before')
    return kept


def _keep(path: Path, newest: int) -> None:
    """Durably: to a temporary file, then renamed over the old one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix(".new")
    with fresh.open("w", encoding="utf-8") as file:
        json.dump({"newest": newest}, file)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)
