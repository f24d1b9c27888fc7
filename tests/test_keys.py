"""Key pairs: never overwritten, never readable by others, of the right kind or refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed448 import Ed448PrivateKey
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime import keys, offline_ledger
from s2r_runtime.errors import ConfigError


def test_a_new_pair_signs_and_its_public_half_checks(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "signing.key"
    public = keys.new(path)
    assert public == tmp_path / "deep" / "signing.pub"
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    key = keys.load(path)
    assert keys.public_bytes(key) == keys.load_public(public)
    signature = key.sign(b"message")
    assert keys.fits(keys.load_public(public), signature, b"message")
    assert not keys.fits(keys.load_public(public), signature, b"massage")
    assert not keys.fits(b"too short", signature, b"message")


def test_a_new_key_comes_with_an_empty_ledger(tmp_path: Path) -> None:
    keys.new(tmp_path / "signing.key")
    assert offline_ledger.open_ledger(tmp_path / "signing.key", "rover").entries() == ()


@pytest.mark.parametrize("taken", ["signing.key", "signing.pub", "signing.ledger.json"])
def test_nothing_is_overwritten(tmp_path: Path, taken: str) -> None:
    (tmp_path / taken).write_text("precious")
    with pytest.raises(ConfigError, match=f"{taken}: is there already and is not overwritten"):
        keys.new(tmp_path / "signing.key")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [(taken, "precious")]


def test_a_symlink_in_the_way_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "signing.key").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="is not overwritten"):
        keys.new(tmp_path / "signing.key")
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o644, 0o610])
def test_a_key_that_others_can_use_is_refused_with_the_remedy(tmp_path: Path, mode: int) -> None:
    keys.new(tmp_path / "signing.key")
    (tmp_path / "signing.key").chmod(mode)
    with pytest.raises(ConfigError, match=f"mode {mode:o}.*chmod 600"):
        keys.load(tmp_path / "signing.key")
    (tmp_path / "signing.key").chmod(0o400)
    keys.load(tmp_path / "signing.key")


def _private(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    path.chmod(0o600)
    return path


def test_what_is_no_ed25519_key_is_said_to_be_so(tmp_path: Path) -> None:
    pem, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    other = Ed448PrivateKey.generate()
    locked = Ed25519PrivateKey.generate().private_bytes(pem, pkcs8, serialization.BestAvailableEncryption(b"word"))
    cases = [
        (tmp_path / "none", "there is no signing key; make one with: s2r keys new"),
        (tmp_path, "cannot be read|is no file"),
        (_private(tmp_path / "a", b"hello"), "is no private key in PEM form"),
        (_private(tmp_path / "b", other.private_bytes(pem, pkcs8, serialization.NoEncryption())), "of another kind, must be Ed25519"),
        (_private(tmp_path / "c", locked), "protected by a password"),
    ]
    for path, message in cases:
        with pytest.raises(ConfigError, match=message):
            keys.load(path)
    public = tmp_path / "d.pub"
    public.write_bytes(other.public_key().public_bytes(pem, serialization.PublicFormat.SubjectPublicKeyInfo))
    with pytest.raises(ConfigError, match="public key of another kind, must be Ed25519"):
        keys.load_public(public)
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        keys.load_public(tmp_path / "none")
    keys.new(tmp_path / "signing.key")
    with pytest.raises(ConfigError, match=r"this is a private key, give the \.pub beside it"):
        keys.load_public(tmp_path / "signing.key")


def test_trusted_keys_come_from_files_and_folders(tmp_path: Path) -> None:
    for name in ("a", "b"):
        keys.new(tmp_path / f"{name}.key")
    a, b = (keys.load_public(tmp_path / f"{name}.pub") for name in ("a", "b"))
    assert keys.load_trusted([tmp_path / "b.pub", tmp_path, tmp_path / "none"]) == (b, a)
    assert keys.fingerprint(a) != keys.fingerprint(b)
    assert keys.fingerprint(a).startswith("ed25519:")


def test_the_default_place_follows_the_user_and_not_a_relative_setting(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    assert keys.default_path() == tmp_path / ".config" / "s2r" / "signing.key"
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "conf"))
    assert keys.default_path() == tmp_path / "conf" / "s2r" / "signing.key"
    monkeypatch.setenv("XDG_CONFIG_HOME", "conf")
    assert keys.default_path() == tmp_path / ".config" / "s2r" / "signing.key"


def test_a_key_is_private_from_its_first_byte_under_any_umask(tmp_path: Path) -> None:
    code = (
        f"import os; os.umask(0); from pathlib import Path; from s2r_runtime import keys; keys.new(Path({str(tmp_path / 'd' / 'k.key')!r}))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "d" / "k.key").stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "d").stat().st_mode & 0o777 == 0o700
