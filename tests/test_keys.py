"""Key pairs: never overwritten, never readable by others, of the right kind or refused."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed448 import Ed448PrivateKey
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime.cli.main import main
from s2r_runtime.errors import ConfigError, UsageError
from s2r_runtime.files import durable
from s2r_runtime.trust import keys, offline_ledger, revocations


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
    new = f"keys.new(Path({str(tmp_path / 'd' / 'k.key')!r}))"
    code = f"import os; os.umask(0); from pathlib import Path; from s2r_runtime.trust import keys; {new}"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "d" / "k.key").stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "d").stat().st_mode & 0o777 == 0o700


# ---------------------------------------------------------------- whose file it is


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A key pair in a folder of its own; the user's configuration is somewhere else."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    keys.new(tmp_path / "keys" / "signing.key")
    return tmp_path / "keys" / "signing.key"


def test_a_key_that_is_a_symlink_or_a_pipe_is_refused(pair: Path) -> None:
    link = pair.with_name("link.key")
    link.symlink_to(pair)
    with pytest.raises(ConfigError, match="is a symlink; a private key must be a file of its own"):
        keys.load(link)
    os.mkfifo(pair.with_name("pipe.key"), 0o600)
    with pytest.raises(ConfigError, match="is no file"):
        keys.load(pair.with_name("pipe.key"))


def test_a_key_in_a_folder_where_others_can_replace_it_is_refused(pair: Path) -> None:
    for mode in (0o777, 0o770, 0o703):
        pair.parent.chmod(mode)
        with pytest.raises(ConfigError, match=f"others can put another file in its place .*mode {mode:o}.*chmod go-w"):
            keys.load(pair)
    for mode in (0o755, 0o750, 0o700, 0o1777):  # the last as /tmp: who doesn't own a file there can't replace it
        pair.parent.chmod(mode)
        keys.load(pair)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file away")
def test_a_key_or_a_folder_of_another_user_is_refused(pair: Path) -> None:
    os.chown(pair, 12345, -1)
    with pytest.raises(ConfigError, match="belongs to user 12345; a private key must be this user's"):
        keys.load(pair)
    os.chown(pair, 0, -1)
    os.chown(pair.parent, 12345, -1)
    with pytest.raises(ConfigError, match="its folder belongs to user 12345"):
        keys.load(pair)


def test_a_trusted_key_that_others_could_have_put_there_is_refused(pair: Path) -> None:
    trusted = pair.with_suffix(".pub")
    trusted.chmod(0o664)
    with pytest.raises(ConfigError, match="others than its owner can write a trusted key"):
        keys.load_trusted([trusted])
    trusted.chmod(0o644)
    trusted.parent.chmod(0o777)
    with pytest.raises(ConfigError, match="others can put another file in its place"):
        keys.load_trusted([trusted.parent])
    trusted.parent.chmod(0o755)
    (trusted.parent / "planted.pub").symlink_to(trusted)
    with pytest.raises(ConfigError, match="is a symlink"):
        keys.load_trusted([trusted.parent])


# ---------------------------------------------------------------- rotation


def test_a_rotated_key_is_another_one_and_what_was_spent_stays_spent(pair: Path) -> None:
    offline_ledger.open_ledger(pair, "rover").spend_attempt("controller")
    before = keys.load(pair)
    public, kept = keys.rotate(pair)
    after = keys.load(pair)
    assert keys.public_bytes(after) == keys.load_public(public) != keys.public_bytes(before)
    assert keys.load_public(kept) == keys.public_bytes(before)
    assert offline_ledger.open_ledger(pair, "rover").spend_attempt("controller") == 2
    assert pair.stat().st_mode & 0o777 == 0o600
    assert keys.load_trusted([pair.parent]) == (keys.public_bytes(after),)  # the old one bears no name that a folder of trusted keys takes
    assert [path.name for path in pair.parent.iterdir() if before.private_bytes_raw() in path.read_bytes()] == []


def test_a_key_without_its_ledger_is_not_rotated_into_a_fresh_budget(pair: Path) -> None:
    offline_ledger.path_beside(pair).unlink()
    kept = pair.read_bytes()
    with pytest.raises(ConfigError, match="is missing, so nobody knows what this key has spent"):
        keys.rotate(pair)
    assert pair.read_bytes() == kept


# ---------------------------------------------------------------- revocation


def test_a_revoked_key_signs_nothing_and_can_only_be_rotated(pair: Path) -> None:
    name = keys.fingerprint(keys.public_bytes(keys.load(pair)))
    entry = revocations.revoke(pair.parent / revocations.NAME, name, "the laptop\nwas stolen")
    assert str(entry).endswith(": the laptop was stolen")
    with pytest.raises(
        ConfigError, match=f"the key {name} was revoked on .*: the laptop was stolen; it signs nothing any more: s2r keys rotate"
    ):
        keys.load(pair)
    keys.rotate(pair)
    keys.load(pair)


def test_the_users_own_list_counts_everywhere_and_an_entry_stays_as_it_was(pair: Path) -> None:
    name = keys.fingerprint(keys.public_bytes(keys.load(pair)))
    mine = keys.config_dir() / revocations.NAME
    first = revocations.revoke(mine, name, "first")
    assert revocations.revoke(mine, name, "second") == first
    assert revocations.known(revocations.places(pair.parent)) == {name: first}
    with pytest.raises(ConfigError, match="was revoked"):
        keys.load(pair)


@pytest.mark.parametrize("what", ["cut", "flipped", "another kind", "newer", "not readable"])
def test_a_list_that_cannot_be_read_is_no_empty_list(pair: Path, what: str) -> None:
    path = pair.parent / revocations.NAME
    revocations.revoke(path, "ed25519:" + "0" * 32, "")
    data = path.read_bytes()
    if what == "not readable":
        path.unlink()
        path.symlink_to("/nowhere")
    else:
        path.write_bytes(
            {
                "cut": data[:-5],
                "flipped": data.replace(b"ed25519:0", b"ed25519:1"),
                "another kind": durable.seal("ledger", {"schema": 1, "revoked": []}),
                "newer": durable.seal("revocations", {"schema": 2, "revoked": []}),
            }[what]
        )
    with pytest.raises(ConfigError, match=r"revoked\.json: (is damaged|has schema 2|is a symlink)"):
        keys.load(pair)
    with pytest.raises(ConfigError):
        revocations.revoke(path, "ed25519:" + "1" * 32, "")


@pytest.mark.parametrize("folder", ["loop", "a file", "n" * 300])
def test_a_list_that_cannot_be_looked_for_is_no_empty_list(pair: Path, folder: str) -> None:
    there = pair.parent.parent / folder
    if folder == "loop":
        there.symlink_to(there)
    elif folder == "a file":
        there.write_text("")
    with pytest.raises(ConfigError, match=r"revoked\.json: cannot be read"):
        revocations.known([there / revocations.NAME])


def test_what_is_no_fingerprint_is_refused(pair: Path) -> None:
    for name in ("", "ed25519:", "ed25519:" + "g" * 32, "ed25519:" + "0" * 31, "x.pub"):
        with pytest.raises(UsageError, match="is no key's fingerprint"):
            revocations.revoke(pair.parent / revocations.NAME, name, "")


def test_two_that_revoke_at_once_lose_neither(pair: Path) -> None:
    path = pair.parent / revocations.NAME
    code = (
        f"import sys; from pathlib import Path; from s2r_runtime.trust import revocations\n"
        f"for i in range(10): revocations.revoke(Path({str(path)!r}), f'ed25519:{{i:x}}' + sys.argv[1] * 31, '')"
    )
    both = [subprocess.Popen([sys.executable, "-c", code, digit]) for digit in "ab"]
    assert [process.wait(60) for process in both] == [0, 0]
    assert len(revocations.known([path])) == 20


def test_the_verbs_list_rotate_and_revoke(pair: Path, capsys: pytest.CaptureFixture[str]) -> None:
    public = str(keys.public_path(pair))
    name = keys.fingerprint(keys.load_public(Path(public)))
    assert main(["keys", "revoke", public, "--reason", "lost"]) == 0
    assert main(["keys", "rotate", str(pair)]) == 0
    assert "its ledger goes on" in capsys.readouterr().out
    assert main(["keys", "list", "--state", str(pair.parent), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["keys"]
    assert [(one["use"], one["fingerprint"] == name, bool(one["revoked"])) for one in found] == [
        ("signs", False, False),
        ("revoked", True, True),
    ]
    assert main(["keys", "revoke", "nonsense"]) == 2
    assert main(["keys", "rotate", str(pair), "--trust-old"]) == 2


def test_an_old_key_stays_trusted_under_any_umask_but_not_a_revoked_one(pair: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (pair.parent / "state.json").touch()
    old = keys.load_public(keys.public_path(pair))
    before = os.umask(0)
    try:
        assert main(["keys", "rotate", str(pair), "--trust-old"]) == 0
    finally:
        os.umask(before)
    assert keys.load_trusted([pair.parent / "trusted"]) == (old,)
    capsys.readouterr()
    second = keys.load_public(keys.public_path(pair))
    assert main(["keys", "revoke", keys.fingerprint(second)]) == 0
    assert main(["keys", "rotate", str(pair), "--trust-old"]) == 2
    assert "nothing makes it trusted again" in capsys.readouterr().err
    assert keys.load_public(keys.public_path(pair)) == second, "nothing was rotated"
    (pair.parent / "state.json").touch()
    assert main(["keys", "rotate", str(pair)]) == 0
    (pair.parent / "trusted").rename(pair.parent / "elsewhere")
    (pair.parent / "trusted").write_text("in the way")
    assert main(["keys", "rotate", str(pair), "--trust-old"]) == 78
    assert "so the key is not trusted" in capsys.readouterr().err


def test_what_is_no_key_among_the_trusted_is_listed_as_that(pair: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trusted = pair.parent / "trusted"
    trusted.mkdir(mode=0o700)
    (trusted / "gone.pub").symlink_to("/nowhere")
    (trusted / "folder.pub").mkdir()
    assert main(["keys", "list", "--state", str(pair.parent), "--json"]) == 0
    found = {Path(one["path"]).name: one["problem"] for one in json.loads(capsys.readouterr().out)["keys"] if one["use"] == "trusted"}
    assert found.keys() == {"gone.pub", "folder.pub"}
    assert "is a symlink" in found["gone.pub"]
    assert "is no file" in found["folder.pub"]


def test_a_key_is_not_revoked_where_no_daemon_would_see_it(pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", "revoke", str(keys.public_path(pair)), "--state", str(tmp_path / "typo")]) == 2
    assert "nothing was revoked" in capsys.readouterr().err
    assert not (tmp_path / "typo").exists()
