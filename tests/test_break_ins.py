"""Somebody wants a controller to move the robot that no certificate covers: over the control socket, beside it, and through the state."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from daemon_rig import Rig, made_up_certificate

from s2r_runtime.controllers.file import load
from s2r_runtime.files import durable
from s2r_runtime.messages import Memory, Revoked, Tries
from s2r_runtime.trust import certificate, keys, revocations

RECKLESS = "    return np.tile([0.2, 0.0], (len(x), 1))\n"
PAST_S = 1_700_000_000.0

AS_NOBODY = """
import json, os, socket, sys
os.setgid(65534); os.setuid(65534)
s = socket.socket(socket.AF_UNIX)
try:
    s.connect(sys.argv[1])
    s.sendall(sys.argv[2].encode() + b"\\n")
    print(s.makefile().read())
except OSError as error:
    print(error)
"""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    opened = Rig(tmp_path)
    opened.environment["XDG_CONFIG_HOME"] = str(tmp_path / "config")
    yield opened
    opened.close()


def foreign_key(folder: Path) -> Path:
    keys.new(folder / "foreign" / "signing.key")
    return folder / "foreign" / "signing.key"


def moved_by(rig: Rig) -> set[str]:
    return {command["source"] for command in rig.applied()} if (rig.folder / "applied.jsonl").exists() else set()


def refused_certificates(rig: Rig, good: Path, reckless: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[Path, str, str]]:
    """What a person might bring: (controller, certificate, words of the refusal)."""
    own, honest = rig.state / "key.pem", rig.certificate(good)
    other = rig.folder / "other.toml"
    other.write_text(rig.profile.read_text().replace("x = [-1.6, 1.6]", "x = [-9.0, 9.0]"))
    with monkeypatch.context() as then:
        then.setattr(time, "time", lambda: PAST_S)
        expired = rig.certificate(good)
    stranger = made_up_certificate(rig.profile, foreign_key(rig.folder), reckless, radius=0.01, verified=0.02, epoch=1)
    swapped = json.loads(stranger) | {"public_key": json.loads(honest)["public_key"]}
    return {
        "none": (reckless, "", "there is no gap yet"),
        "another controller's": (reckless, honest, "is of the controller"),
        "a foreign key's": (reckless, stranger, "which is not trusted here"),
        "a foreign one with the robot's key written in": (reckless, msgspec.json.encode(swapped).decode(), "changed after it was signed"),
        "changed": (good, honest.replace('"verified_radius":0.02', '"verified_radius":9.02'), "changed after it was signed"),
        "expired": (good, expired, "expired"),
        "another profile's": (good, made_up_certificate(other, own, good, radius=0.01, verified=0.02, epoch=1), "its profile is"),
        "nonsense": (good, "{}", "is no certificate"),
    }


@pytest.mark.slow
def test_nothing_but_a_certificate_of_its_own_makes_a_controller_drive(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    good, reckless = rig.controller(), rig.controller(RECKLESS, "reckless.py")
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    for name, (path, text, words) in refused_certificates(rig, good, reckless, monkeypatch).items():
        answer = rig.ask("deploy", path=str(path), certificate=text)
        assert answer["exit_code"] in {1, 78}, name
        assert words in answer["text"], (name, answer)
        assert rig.status()["gate"] == "closed"
    assert moved_by(rig) <= {"recovery"}

    assert rig.deploy(good)["exit_code"] == 0
    rig.until_status(gate="open", driving="controller")
    while_one_drives(rig, good, reckless)

    (rig.state / revocations.NAME).write_text("{}")  # while nobody knows who is revoked nobody drives, and no certificate ends for it
    rig.until_status(gate="closed", reason="recorder_down", driving="recovery", revoked={})
    (rig.state / revocations.NAME).unlink()
    rig.until_status(gate="open", driving="controller")

    own = keys.load_public(rig.state / "key.pub")
    entry = revocations.revoke(rig.state / revocations.NAME, keys.fingerprint(own), "a laptop was stolen")
    rig.until_status(gate="closed", driving="recovery", controller=None)
    (why,) = rig.status()["revoked"].values()
    assert why.startswith("key: signed with the key ed25519:")
    assert why.endswith(str(entry))
    again = rig.ask("deploy", path=str(good), certificate=rig_certificate_by_force(rig, good))
    assert (again["exit_code"], "was revoked" in again["text"]) == (78, True)
    rig.stop()
    assert all(c["u"] == [0.0, 0.5] for c in rig.applied() if c["source"] == "controller")
    assert rig.messages("event/certificates_distrusted") != []
    assert [m.reason for m in rig.messages("out/revoked") if isinstance(m, Revoked)] == [why]
    carried = rig.folder / "carried" / "key.pem"
    carried.parent.mkdir(mode=0o700)
    carried.touch(0o600)
    carried.write_bytes((rig.state / "key.pem").read_bytes())
    refused = rig.s2r("run", str(rig.profile), "--state", str(rig.state), "--key", str(carried))
    assert (refused.returncode, "own key was revoked" in refused.stderr) == (78, True), refused.stderr
    audited = ("audit", *map(str, rig.log_files()), "--key", str(rig.state / "key.pub"))
    assert (before := rig.s2r(*audited)).returncode == 0, before.stdout
    assert rig.s2r("keys", "revoke", entry.fingerprint, "--reason", "a laptop was stolen").returncode == 0
    told = rig.s2r(*audited, "--json")
    found = json.loads(told.stdout)
    assert (told.returncode, found["ok"], [one["valid"] for one in found["certificates"]]) == (1, False, [False, False])
    assert "nothing shows that this is no forgery" in found["signed_by"]


def while_one_drives(rig: Rig, good: Path, reckless: Path) -> None:
    """A certified controller drives, and others want to."""
    code, said = rig.refused()
    assert (code, "another process uses the state" in said) == (78, True)
    own, rig.state = rig.state, rig.folder / "elsewhere"
    code, said = rig.refused()
    assert (code, "shows that robot 'rig' has a past" in said) == (78, True), said
    logs, rig.logs = rig.logs, rig.folder / "other logs"
    code, said = rig.refused()
    rig.state, rig.logs = own, logs
    assert (code, "already running" in said) == (78, True), said
    if os.getuid() == 0:
        for path in (rig.socket, *rig.socket.parents):
            if path in (Path("/"), Path("/tmp")):
                break
            path.chmod(0o777)
        for verb in (
            {"verb": "stop"},
            {"verb": "deploy", "path": str(reckless)},
            {"verb": "clear", "text": "emergency_stop"},
            {"verb": "status"},
        ):
            heard = subprocess.run(
                [sys.executable, "-c", AS_NOBODY, str(rig.socket), json.dumps(verb)], capture_output=True, text=True, check=True, cwd="/"
            )
            # the kernel may throw the answer away together with what was not read; test_control.py holds that it is given
            assert "accepted" not in heard.stdout, heard
        rig.state.chmod(0o700)
    good.write_text(reckless.read_text())
    stranger = made_up_certificate(rig.profile, rig.folder / "foreign" / "signing.key", reckless, radius=0.01, verified=0.02, epoch=1)
    (rig.state / "certificates" / "planted.json").write_text(stranger)
    before = rig.status()["observation"]["seq"]
    rig.until(lambda: rig.status()["observation"]["seq"] > before + 50)
    status = rig.status()
    assert (status["gate"], status["driving"], len(status["revoked"])) == ("open", "controller", 0)
    assert moved_by(rig) <= {"recovery", "controller"}
    good.write_text(rig.controller(name="again.py").read_text())


def rig_certificate_by_force(rig: Rig, controller: Path) -> str:
    """As `Rig.certificate`, by somebody who does not ask whether the key was revoked."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(revocations, "known", lambda _: {})
        return rig.certificate(controller)


def forged(rig: Rig, controller: Path, key: Path, verified: float = 0.02, *, tries: Tries | None = None, told: bool = True) -> str:
    """A state in which a certificate is in force, sealed as the daemon seals it, its file beside it; the certificate's id.

    verified: another radius makes another certificate, also within the same second. told: whether the memory knows of a fixed seed.
    """
    text = made_up_certificate(rig.profile, key, controller, radius=0.01, verified=verified, epoch=1, tries=tries).encode()
    one = certificate.load(text, [keys.load_public(key.with_suffix(".pub"))])
    memory = durable.unseal((rig.state / "state.json").read_bytes(), "state", Memory, "state")
    facts = certificate.facts(one)
    facts = msgspec.structs.replace(facts, fixed_seed=facts.fixed_seed and told)
    durable.replace(rig.state / "state.json", durable.seal("state", msgspec.structs.replace(memory, certificates=(facts,), gap=one.gap)))
    durable.replace(rig.state / "certificates" / f"{facts.id.removeprefix('sha256:')}.json", text)
    return facts.id


@pytest.mark.parametrize("told", [False, True])
def test_the_state_of_a_simulation_that_fixed_its_seeds_carries_no_certificate(rig: Rig, told: bool) -> None:
    """Also one of an earlier version, whose memory does not say so: the certificate does."""
    good = rig.controller()
    rig.start_robot()
    rig.start()
    assert rig.deploy(good)["exit_code"] == 0
    rig.stop()
    identity = forged(rig, good, rig.state / "key.pem", 0.03, tries=Tries(1, 1, 1, fixed=True), told=told)
    rig.start()
    status = rig.status()
    assert (status["certificate"], list(status["revoked"])) == (None, [identity])
    assert "is of a simulation that fixed its seeds beforehand" in status["revoked"][identity]


def test_a_state_that_somebody_wrote_carries_no_certificate_that_nobody_signed(rig: Rig) -> None:
    good, reckless = rig.controller(), rig.controller(RECKLESS, "reckless.py")
    rig.start_robot()
    rig.start()
    assert rig.deploy(good)["exit_code"] == 0
    rig.stop()
    foreign = foreign_key(rig.folder)

    identity = forged(rig, reckless, foreign)
    rig.start()
    status = rig.status()
    assert (status["certificate"], list(status["revoked"])) == (None, [identity])
    assert "which is not trusted here" in rig.status()["revoked"][identity]
    rig.stop()

    identity = forged(rig, reckless, foreign, 0.03)
    (rig.state / "certificates" / f"{identity.removeprefix('sha256:')}.json").unlink()
    rig.start()
    assert "cannot be read" in rig.status()["revoked"][identity]
    rig.stop()

    honest = forged(rig, good, rig.state / "key.pem", 0.025)  # the certificate is real; the state claims that it reaches farther
    memory: Any = durable.unseal((rig.state / "state.json").read_bytes(), "state", Memory, "state")
    wider = msgspec.structs.replace(memory.certificates[0], verified_radius=9.0, controller_digest=load(reckless).digest)
    durable.replace(rig.state / "state.json", durable.seal("state", msgspec.structs.replace(memory, certificates=(wider,))))
    rig.start()
    assert "says something else than the robot's state" in rig.status()["revoked"][honest]
    rig.stop()
    told = json.loads(rig.s2r("audit", *map(str, rig.log_files()), "--json").stdout)
    assert not any(one["valid"] for one in told["certificates"] if one["id"] in {identity, honest})

    memory = durable.unseal((rig.state / "state.json").read_bytes(), "state", Memory, "state")
    durable.replace(rig.state / "state.json", durable.seal("state", msgspec.structs.replace(memory, revoked={})))
    before, rig.logs = rig.log_files(), rig.folder / "where no log tells"
    time.sleep(1.0)  # a run is named by its second, and made another name of in its own folder only
    rig.start()
    rig.stop()
    told = json.loads(rig.s2r("audit", *map(str, (*before, *rig.log_files())), "--json").stdout)
    assert "the memory forgets that certificate" in told["first_difference"]["what"]
    assert moved_by(rig) <= {"recovery", "controller"}


@pytest.mark.slow
def test_a_state_folder_that_others_can_reach_into_starts_no_daemon(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.stop()
    state, elsewhere = rig.state / "state.json", rig.folder / "elsewhere.json"

    def refusal() -> str:
        code, said = rig.refused()
        (rig.folder / "refused.txt").unlink()
        assert code == 78
        return said

    state.rename(elsewhere)
    state.symlink_to(elsewhere)
    assert "state.json: is a symlink" in refusal()
    state.unlink()
    elsewhere.rename(state)
    state.chmod(0o666)
    assert "others than its owner can write" in refusal()
    state.chmod(0o600)
    (rig.state / "trusted").mkdir()
    (rig.state / "trusted" / "planted.pub").write_bytes((rig.state / "key.pub").read_bytes())
    for folder, words in ((rig.state, "others than its owner can write to it"), (rig.state / "trusted", "others can put another file")):
        folder.chmod(0o777)
        assert words in refusal()
        folder.chmod(0o700)
    key = rig.state / "key.pem"
    key.rename(rig.folder / "key.pem")
    key.symlink_to(rig.folder / "key.pem")
    assert "key.pem: is a symlink" in refusal()
    if os.getuid() == 0:
        os.chown(rig.state, 12345, -1)
        assert "belongs to user 12345" in refusal()


def _held_open(pid: int) -> set[str]:
    """What a process has open; it may close one while it is looked at."""
    found = set()
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            found.add(str(one.readlink()))
    return found


@pytest.mark.slow
def test_what_is_no_file_of_a_controller_holds_nobody_up_and_no_process_inherits_a_way_to_the_robot(rig: Rig) -> None:
    """A named pipe that nobody writes into, a device without end, a file of 20 GB: deployed and adopted while a controller drives."""
    rig.start_robot()
    rig.start()
    assert rig.deploy()["exit_code"] == 0
    rig.until_status(gate="open", driving="controller")
    os.mkfifo(rig.folder / "pipe.py")
    (rig.folder / "zero.py").symlink_to("/dev/zero")
    (rig.folder / "folder.py").mkdir()
    with (rig.folder / "large.py").open("wb") as large:
        large.truncate(20 << 30)
    for name, words in {"pipe": "is no file", "zero": "is no file", "folder": "is no file", "large": "has more than", "none": "no"}.items():
        before = rig.status()["observation"]["seq"]
        answer = rig.ask("deploy", path=str(rig.folder / f"{name}.py"))
        assert answer["exit_code"] != 0, name
        assert words in answer["text"], (name, answer)
        assert rig.ask("excite", path=str(rig.folder / f"{name}.py"))["exit_code"] != 0, name
        rig.until(lambda before=before: rig.status()["observation"]["seq"] > before + 5)
        status = rig.status()
        assert (status["gate"], status["driving"]) == ("open", "controller"), name
    pids = rig.status()["pids"]
    held = {who: _held_open(pids[who]) for who in pids}
    journal = {"/dev/null", str(rig.folder / "daemon.txt")}
    assert held["controller"] & held["analytics"] <= journal
    for who in ("controller", "analytics"):  # a pipe's two ends have one name; the daemon has the other one of each child's own
        assert {one for one in held[who] & held["daemon"] if not one.startswith("pipe:")} <= journal, who
    assert moved_by(rig) <= {"recovery", "controller"}
