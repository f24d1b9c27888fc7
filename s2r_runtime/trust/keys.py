"""Ed25519 key pairs that sign certificates and logs, as files.

Private: PEM (PKCS8, not encrypted), readable by its owner only; public: PEM beside it, `<name>.pub`. Both are what `openssl` reads
and writes. The private key stays on the machine that signs; whoever checks needs the public one. A new pair comes with
an empty ledger of offline certification (guarantee G4): a key without its ledger certifies nothing.

A file that says whom to believe (a private key, a trusted public one, a list of revoked ones) must be this user's or root's, no symlink,
and in a folder where nobody else can put another in its place; a private key can be read by nobody else.

Rotation puts a new pair in the place of the old one and goes on in its ledger: what was spent stays spent. Revocation: `revocations`.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable
from glob import escape
from pathlib import Path

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.bounded_file import read_bounded
from s2r_runtime.files.durable import check_own, open_own

FILE_MAX = 16 << 10
"""Bytes. A key file has a few hundred."""


def config_dir() -> Path:
    """The user's folder for keys: `$XDG_CONFIG_HOME/s2r`, or `~/.config/s2r`. A relative XDG path is void, by its specification."""
    given = Path(os.environ.get("XDG_CONFIG_HOME") or "")
    return (given if given.is_absolute() else Path.home() / ".config") / "s2r"


def default_path() -> Path:
    """The user's own signing key."""
    return config_dir() / "signing.key"


def public_path(path: Path) -> Path:
    """Where the public half of a private key's file is."""
    return path.with_suffix(".pub")


def new(path: Path) -> Path:
    """Makes a key pair and its ledger; returns the public file's path. Raises ConfigError rather than overwrite anything."""
    from s2r_runtime.trust import offline_ledger

    public = public_path(path)
    key = Ed25519PrivateKey.generate()
    private_pem, public_pem = _pems(key)
    if public == path:
        raise ConfigError(f"{path}: a private key's file cannot end in .pub")
    for taken in (path, public, offline_ledger.path_beside(path)):
        if taken.exists() or taken.is_symlink():
            raise ConfigError(f"{taken}: is there already and is not overwritten; give another path, or move it away")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        _create(path, private_pem, 0o600)
        _create(public, public_pem, 0o644)
        offline_ledger.create(path)
    except FileExistsError:
        raise ConfigError(f"{path}: is there already and is not overwritten; give another path, or move it away") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
    return public


def load(path: Path, *, revoked: bool = False) -> Ed25519PrivateKey:
    """The private key. Raises ConfigError if it can't be read, others could read or replace it, it is no Ed25519 key, or, unless asked for,
    one that was revoked (on the user's list, or one beside it).
    """
    pem = _read_private(path)
    key = _parsed(pem, path)
    if not revoked:
        from s2r_runtime.trust import revocations

        name = fingerprint(public_bytes(key))
        if (entry := revocations.known(revocations.places(path.parent)).get(name)) is not None:
            raise ConfigError(f"{path}: the key {name} was {entry}; it signs nothing any more: s2r keys rotate {path}")
    return key


def _read_private(path: Path) -> bytes:
    try:
        with os.fdopen(open_own(path, "a private key"), "rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            if mode & 0o077:
                raise ConfigError(f"{path}: others than its owner can use this private key (mode {mode:o}); chmod 600 {path}")
            return file.read(FILE_MAX)
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no signing key; make one with: s2r keys new {path}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None


def _parsed(pem: bytes, path: Path) -> Ed25519PrivateKey:
    try:
        key = serialization.load_pem_private_key(pem, password=None)
    except TypeError:
        raise ConfigError(f"{path}: is protected by a password, which a daemon cannot type; must be a plain PKCS8 PEM file") from None
    except (ValueError, UnsupportedAlgorithm):
        raise ConfigError(f"{path}: is no private key in PEM form") from None
    if not isinstance(key, Ed25519PrivateKey):
        raise ConfigError(f"{path}: is a private key of another kind, must be Ed25519")
    return key


def load_public(path: Path) -> bytes:
    """The public key's 32 bytes. Raises ConfigError if it can't be read or is no Ed25519 public key."""
    pem = read_bounded(path, FILE_MAX)
    try:
        key = serialization.load_pem_public_key(pem)
    except (ValueError, UnsupportedAlgorithm):
        hint = "; this is a private key, give the .pub beside it" if b"PRIVATE" in pem else ""
        raise ConfigError(f"{path}: is no public key in PEM form{hint}") from None
    if not isinstance(key, Ed25519PublicKey):
        raise ConfigError(f"{path}: is a public key of another kind, must be Ed25519")
    return key.public_bytes_raw()


def load_trusted(paths: Iterable[Path]) -> tuple[bytes, ...]:
    """The public keys in these files, and in the `*.pub` files of these folders. A path that is not there is no key. Raises ConfigError for
    one that others could have put there.
    """
    files = [file for path in paths for file in (sorted(path.glob("*.pub")) if path.is_dir() else [path]) if file.exists()]
    return tuple(dict.fromkeys(load_trusted_file(file) for file in files))


def load_trusted_file(path: Path) -> bytes:
    """The public key in this file. Raises ConfigError if others could have put it there, or it is none."""
    check_own(path, "a trusted key")
    return load_public(path)


def rotate(path: Path) -> tuple[Path, Path]:
    """A new pair in the place of this one; the ledger goes on. Returns the new public file, and where the old public key is kept, under a
    name that nobody takes for a trusted key's. Raises ConfigError if the old one is no key, or nothing can be written.
    """
    from s2r_runtime.files.durable import replace
    from s2r_runtime.trust import offline_ledger

    old = load(path, revoked=True)
    if not offline_ledger.path_beside(path).exists():
        raise ConfigError(f"{offline_ledger.path_beside(path)}: is missing, so nobody knows what this key has spent; put it back first")
    public = public_path(path)
    kept = _former_path(public, public_bytes(old))
    private_pem, public_pem = _pems(Ed25519PrivateKey.generate())
    try:
        replace(kept, _pems(old)[1], 0o644)
        replace(path, private_pem)
        replace(public, public_pem, 0o644)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
    return public, kept


def _former_path(public: Path, key: bytes) -> Path:
    return public.with_name(f"{public.name}.{fingerprint(key).partition(':')[2][:8]}")


def former(path: Path) -> tuple[bytes, ...]:
    """Public keys that were in the place of this private key before `rotate`. Raises ConfigError as `load_trusted`."""
    public = public_path(path)
    found = ((file, load_trusted_file(file)) for file in sorted(public.parent.glob(f"{escape(public.name)}.????????")))
    return tuple(key for file, key in found if file == _former_path(public, key))


def trust(public: Path, folder: Path) -> Path:
    """Puts a copy of a public key's file among those that are trusted, under any umask one that nobody else can write. Raises ConfigError
    if it can't be written.
    """
    from s2r_runtime.files.durable import replace

    path = folder / f"{public.name}.pub"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        replace(path, public.read_bytes(), 0o644)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written, so the key is not trusted: {error.strerror}") from None
    return path


def public_bytes(key: Ed25519PrivateKey) -> bytes:
    """The 32 bytes of a private key's public half."""
    return key.public_key().public_bytes_raw()


def fingerprint(public: bytes) -> str:
    """A short name for a public key, to be read to each other: the first 16 bytes of its SHA-256."""
    return "ed25519:" + hashlib.sha256(public).hexdigest()[:32]


def fits(public: bytes, signature: bytes, message: bytes) -> bool:
    """Whether the signature is this key's, of this message."""
    try:
        Ed25519PublicKey.from_public_bytes(public).verify(signature, message)
    except (InvalidSignature, ValueError):
        return False
    return True


def _pems(key: Ed25519PrivateKey) -> tuple[bytes, bytes]:
    """Both halves, private first."""
    private = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return private, key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


def _create(path: Path, data: bytes, mode: int) -> None:
    """Raises FileExistsError if anything has that name, be it a symlink."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    with os.fdopen(descriptor, "wb") as file:
        os.fchmod(descriptor, mode)
        file.write(data)
        file.flush()
        os.fsync(descriptor)
