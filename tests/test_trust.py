"""Whom the daemon believes, and what becomes of certificates in force when that changes."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from core_rig import Rig as Core
from core_rig import kinds, one
from daemon_rig import PROFILE, made_up_certificate

from s2r_runtime.core import reducer as core
from s2r_runtime.daemon.trust import Trust, certificate_file
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import MEMORY_SCHEMA, CertificateFacts, CertificatesDistrusted, Memory, Revoked, Send, StopController
from s2r_runtime.trust import certificate, keys, revocations


class Robot:
    """A state folder with a certificate by the robot's own key and one by a colleague's, both in force."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        keys.new(folder / "key.pem")
        keys.new(folder / "colleague" / "signing.key")
        (folder / "trusted").mkdir(mode=0o700)
        (folder / "certificates").mkdir(mode=0o700)
        self.colleague = folder / "trusted" / "colleague.pub"
        self.colleague.write_bytes((folder / "colleague" / "signing.pub").read_bytes())
        (folder / "rig.toml").write_text(PROFILE.format(clock="lockstep", more=""))
        self.facts = [self._certified(key, epoch) for epoch, key in enumerate(("key.pem", "colleague/signing.key"), 1)]
        self.memory = Memory(robot="rig", schema=MEMORY_SCHEMA, certificates=tuple(self.facts))
        self.trust = Trust(folder, keys.load_public(folder / "key.pub"))

    def _certified(self, key: str, epoch: int) -> CertificateFacts:
        path = self.folder / "controller.py"
        path.write_text("def control(x, theta, parameters):\n    return x[:, :2] * 0\n")
        text = made_up_certificate(self.folder / "rig.toml", self.folder / key, path, radius=0.01, verified=0.02, epoch=epoch).encode()
        public = keys.load_public((self.folder / key).with_suffix(".pub"))
        facts = certificate.facts(certificate.load(text, [public]))
        certificate_file(self.folder / "certificates", facts.id).write_bytes(text)
        return facts

    def distrusted(self) -> dict[str, str]:
        """Certificates that the next look finds fault with, and why."""
        return {identity: why for event in self.trust.look(self.memory) for identity, why in event.reasons.items()}

    def fingerprint(self, key: str) -> str:
        return keys.fingerprint(keys.load_public(self.folder / key))


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Robot:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return Robot(tmp_path)


def test_nothing_happens_while_nothing_changes_and_a_trusted_key_counts(robot: Robot) -> None:
    assert robot.distrusted() == {}
    assert robot.distrusted() == {}
    assert len(robot.trust.keys()) == 2
    assert robot.trust.own_objection() == ""


@pytest.mark.parametrize("whose_list", ["the robot's", "the user's"])
def test_a_revoked_key_takes_what_it_signed_along_and_nothing_else(robot: Robot, whose_list: str) -> None:
    assert robot.distrusted() == {}
    place = (robot.folder if whose_list == "the robot's" else keys.config_dir()) / revocations.NAME
    entry = revocations.revoke(place, robot.fingerprint("trusted/colleague.pub"), "left the company")
    assert robot.distrusted() == {robot.facts[1].id: f"signed with the key {entry.fingerprint}, which was {entry}"}
    assert robot.distrusted() == {}  # it is said once
    assert robot.trust.keys() == (keys.load_public(robot.folder / "key.pub"),)
    assert robot.trust.own_objection() == ""
    own = revocations.revoke(place, robot.fingerprint("key.pub"), "stolen")
    assert set(robot.distrusted()) == {facts.id for facts in robot.facts}
    assert robot.trust.own_objection() == f"this daemon's own key was {own}; s2r keys rotate, and start it anew"
    assert robot.trust.keys() == ()
    with pytest.raises(ConfigError, match="own key was revoked"):
        robot.trust.check_own()


def test_a_key_that_was_revoked_is_not_believed_again_by_a_daemon_whose_list_is_taken_away(robot: Robot) -> None:
    place = robot.folder / revocations.NAME
    entry = revocations.revoke(place, robot.fingerprint("trusted/colleague.pub"), "left the company")
    assert set(robot.distrusted()) == {robot.facts[1].id}
    place.unlink()
    assert robot.trust.objection(keys.load_public(robot.colleague)).endswith(str(entry))
    assert robot.trust.keys() == (keys.load_public(robot.folder / "key.pub"),)


def test_a_key_that_is_taken_out_of_the_trusted_ones_takes_its_certificates_along(robot: Robot) -> None:
    assert robot.distrusted() == {}
    robot.colleague.unlink()
    assert list(robot.distrusted()) == [robot.facts[1].id]


def test_while_a_list_cannot_be_read_nobody_is_believed_and_no_certificate_ends_for_good(robot: Robot) -> None:
    assert robot.distrusted() == {}
    place = robot.folder / revocations.NAME
    entry = revocations.revoke(place, robot.fingerprint("trusted/colleague.pub"), "left the company")
    whole = place.read_bytes()
    for spoiled in (b"{}", whole[:-7], b""):
        place.write_bytes(spoiled)
        for _ in range(2):  # it is looked at again and again
            assert robot.distrusted() == {}
            assert "is damaged" in robot.trust.trouble
        assert "is damaged" in robot.trust.own_objection(), "and nothing is signed meanwhile"
        with pytest.raises(ConfigError, match="is damaged"):
            robot.trust.keys()
    with pytest.raises(ConfigError, match="is damaged"):
        Trust(robot.folder, keys.load_public(robot.folder / "key.pub"))
    place.write_bytes(whole)
    assert robot.distrusted() == {robot.facts[1].id: f"signed with the key {entry.fingerprint}, which was {entry}"}
    assert robot.trust.trouble == ""


def test_a_list_whose_permissions_change_is_looked_at(robot: Robot) -> None:
    place = robot.folder / revocations.NAME
    revocations.revoke(place, f"ed25519:{0:032x}", "")
    assert robot.distrusted() == {}
    place.chmod(0o666)
    assert robot.distrusted() == {}
    assert "others than its owner can write" in robot.trust.trouble
    place.chmod(0o600)
    assert robot.distrusted() == {}
    assert robot.trust.trouble == ""


def test_a_list_that_cannot_be_read_and_goes_away_again_leaves_no_trouble(robot: Robot) -> None:
    assert robot.distrusted() == {}
    (robot.folder / revocations.NAME).write_text("{}")
    assert robot.distrusted() == {}
    (robot.folder / revocations.NAME).unlink()
    assert robot.distrusted() == {}
    assert robot.trust.trouble == ""


@pytest.mark.parametrize("how", ["gone", "cut", "another's", "wider in the memory"])
def test_a_certificate_in_force_is_what_its_file_says(robot: Robot, how: str) -> None:
    file, other = (certificate_file(robot.folder / "certificates", facts.id) for facts in robot.facts)
    if how == "gone":
        file.unlink()
    elif how == "cut":
        file.write_bytes(file.read_bytes()[:-9])
    elif how == "another's":
        file.write_bytes(other.read_bytes())
    else:
        wider = msgspec.structs.replace(robot.facts[0], verified_radius=9.0)
        robot.memory = msgspec.structs.replace(robot.memory, certificates=(wider, robot.facts[1]))
    assert list(robot.distrusted()) == [robot.facts[0].id]


def test_a_rotated_key_is_believed_only_where_it_was_asked_for(robot: Robot) -> None:
    _, kept = keys.rotate(robot.folder / "key.pem")
    own = keys.load_public(robot.folder / "key.pub")
    robot.trust = Trust(robot.folder, own)
    assert list(robot.distrusted()) == [robot.facts[0].id]
    (robot.folder / "trusted" / f"{kept.name}.pub").write_bytes(kept.read_bytes())
    robot.trust = Trust(robot.folder, own)
    assert robot.distrusted() == {}


def test_the_gate_closes_with_the_very_event_and_only_on_what_is_distrusted() -> None:
    rig = Core()
    rig.driving()
    assert kinds(rig.feed(CertificatesDistrusted(rig.t, {"nobody's": "revoked"}))) == []
    assert rig.state.gate_open
    outputs = rig.feed(CertificatesDistrusted(rig.t, {"nobody's": "revoked", "c1": "signed with a key that was revoked"}))
    assert kinds(outputs)[:4] == ["GateChanged", "Send", "Revoked", "Persist"]
    assert one(outputs, Send).source == "recovery"
    assert one(outputs, Revoked).reason == "key: signed with a key that was revoked"
    assert one(outputs, StopController).reason == "certificate_revoked"
    assert core.status(rig.state)["reason"] == "certificate_revoked"
    assert rig.state.memory.certificates == ()
    assert kinds(rig.feed(CertificatesDistrusted(rig.t, {"c1": "again"}))) == []
