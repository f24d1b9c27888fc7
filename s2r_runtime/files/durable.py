"""Files that are whole or refused: replaced at once, with their digest inside, and nobody else's.

A file is replaced by a temporary one, fsync, rename, and fsync of the folder: a crash leaves the old one or the new one.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.canonical import canonical, digest

FILE_MAX = 64 << 20
"""Bytes. No state is that big; something else bearing its name might be."""

T = TypeVar("T")


def check_own(path: Path, what: str) -> None:
    """Raises ConfigError unless the file is this user's or root's, no symlink, and nobody else can write or replace it; OSError never."""
    try:
        descriptor = open_own(path, what)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        mode = stat.S_IMODE(os.fstat(descriptor).st_mode)
    finally:
        os.close(descriptor)
    if mode & 0o022:
        raise ConfigError(f"{path}: others than its owner can write {what} (mode {mode:o}); look whose it is, then chmod go-w {path}")


def open_own(path: Path, what: str) -> int:
    """A descriptor of the file. Raises ConfigError for a symlink, what is no file, or what is, or can be replaced by, somebody else's."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise ConfigError(f"{path}: is a symlink; {what} must be a file of its own") from None
        raise
    try:
        status, folder = os.fstat(descriptor), path.resolve().parent.stat()
        if not stat.S_ISREG(status.st_mode):
            raise ConfigError(f"{path}: is no file")
        for owner, whose in ((status.st_uid, f"{path}:"), (folder.st_uid, f"{path}: its folder")):
            if owner not in (0, os.geteuid()):
                raise ConfigError(f"{whose} belongs to user {owner}; {what} must be this user's ({os.geteuid()}) own")
        if folder.st_mode & 0o022 and not folder.st_mode & stat.S_ISVTX:
            mode = stat.S_IMODE(folder.st_mode)
            raise ConfigError(
                f"{path}: others can put another file in its place (folder's mode {mode:o}); chmod go-w {path.resolve().parent}"
            )
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def seal(kind: str, content: Any) -> bytes:
    """Canonical JSON with the content's digest inside. Raises ValueError on a number that is not finite."""
    return _sealed(kind, canonical(content))


def _sealed(kind: str, body: bytes) -> bytes:
    return b'{"kind":"' + kind.encode() + b'","digest":"' + digest(body).encode() + b'","content":' + body + b"}\n"


def unseal(data: bytes, kind: str, content: type[T], where: str) -> T:
    """What `seal` was given. Raises ConfigError if it was cut, changed, is of another kind, or does not fit the type."""
    frame = len(_sealed(kind, b"")) - len(b"}\n")
    body = data[frame : -len(b"}\n")]
    if _sealed(kind, body) != data:
        raise ConfigError(f"{where}: is damaged (its digest does not fit its content); put it back from a copy, it is not reset by itself")
    try:
        return msgspec.json.decode(body, type=content)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{where}: was written by another version: {error}") from None


def read(file: Path) -> bytes:
    """The file's bytes. Raises ConfigError if it can't be read, is far too big, no file of its own, or others could have written it."""
    check_own(file, "this")
    try:
        if (size := file.stat().st_size) > FILE_MAX:
            raise ConfigError(f"{file}: has {size} bytes, more than any file of its kind")
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from None


def replace(file: Path, data: bytes, mode: int = 0o600) -> None:
    """Puts `data` in the file's place, durably and as a whole. Raises OSError; what was there before is then untouched.

    One writer at a time (callers hold a lock): the temporary file has a fixed name, so a crash leaves at most one behind.
    """
    temporary = file.with_name(f".{file.name}.new")
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW, mode)
        with os.fdopen(descriptor, "wb") as stream:
            os.fchmod(descriptor, mode)
            stream.write(data)
            stream.flush()
            os.fsync(descriptor)
        temporary.replace(file)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    sync_folder(file.parent)


def lock(file: Path, *, wait: bool) -> int:
    """A descriptor that holds the file's lock until it is closed (or the process ends). Raises BlockingIOError if `wait` is
    false and somebody else has it. The file is its own: a file that is replaced as a whole cannot carry a lock.
    """
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def sync_folder(folder: Path) -> None:
    """Makes what was renamed or removed in a folder durable. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
