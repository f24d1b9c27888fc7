"""What outlives a crash: whole files or refusals, never a silent reset."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from s2r_runtime.core.ledger import share
from s2r_runtime.daemon.persistence import StateFolder
from s2r_runtime.errors import ConfigError
from s2r_runtime.files import durable
from s2r_runtime.messages import MEMORY_SCHEMA, CertificateFacts, Gap, Memory
from s2r_runtime.trust import offline_ledger

GAP = Gap(0.25, 0.5, 0.75, 50, "ball", (1.0, 1.0, 0.0525), 161, 0, 0.03, 0.0152, 1, "sha256:aa", "sha256:bb", {"out_of_region": 3})
FACTS = CertificateFacts("sha256:01", "sha256:02", "sha256:03", "sha256:04", "sha256:05", 1, 0.25, 0.375, 1000, 2000, 1)
MEMORY = Memory(
    "rover", MEMORY_SCHEMA, epochs=2, attempts=5, gap=GAP, radius=0.3, certificates=(FACTS,), revoked={"sha256:00": "watch"}, latched=("x",)
)


def test_what_is_saved_comes_back_equal(tmp_path: Path) -> None:
    with StateFolder(tmp_path / "rover", "rover") as folder:
        folder.save(MEMORY)
    with StateFolder(tmp_path / "rover", "rover") as folder:
        assert folder.memory() == MEMORY
    assert (tmp_path / "rover").stat().st_mode & 0o777 == 0o700
    assert (tmp_path / "rover" / "state.json").stat().st_mode & 0o777 == 0o600


def test_a_robot_without_a_past_begins_with_a_fresh_memory(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()  # an empty folder is no past
    with StateFolder(tmp_path, "rover") as folder:
        assert folder.memory(signs=[tmp_path / "logs", tmp_path / "not-there"]) == Memory("rover", MEMORY_SCHEMA)


def test_every_single_flipped_bit_in_a_state_is_refused(tmp_path: Path) -> None:
    with StateFolder(tmp_path, "rover") as folder:
        folder.save(MEMORY)
        file = tmp_path / "state.json"
        whole = file.read_bytes()
        for place in range(8 * len(whole)):
            changed = bytearray(whole)
            changed[place // 8] ^= 1 << place % 8
            with pytest.raises(ConfigError, match="damaged"):
                durable.unseal(bytes(changed), "state", Memory, "state.json")
        file.write_bytes(whole[:-1] + b" ")
        with pytest.raises(ConfigError, match=r"state\.json: is damaged"):
            folder.memory()


def test_a_state_cut_anywhere_is_refused(tmp_path: Path) -> None:
    with StateFolder(tmp_path, "rover") as folder:
        folder.save(MEMORY)
        whole = (tmp_path / "state.json").read_bytes()
        for length in range(len(whole)):
            with pytest.raises(ConfigError, match="damaged"):
                durable.unseal(whole[:length], "state", Memory, "state.json")


@pytest.mark.parametrize("sign", ["begun", "campaign.json", "logs/run.mcap"])
def test_a_deleted_state_of_a_robot_with_a_past_is_refused(tmp_path: Path, sign: str) -> None:
    with StateFolder(tmp_path, "rover") as folder:
        (tmp_path / sign).parent.mkdir(exist_ok=True)
        (tmp_path / sign).write_bytes(b"something")
        with pytest.raises(ConfigError, match=r"is missing, but .* has a past"):
            folder.memory(signs=[tmp_path / "logs"])


def test_deleting_the_state_does_not_reset_the_counters(tmp_path: Path) -> None:
    with StateFolder(tmp_path, "rover") as folder:
        folder.save(MEMORY)
        (tmp_path / "state.json").unlink()
        with pytest.raises(ConfigError, match="has a past"):
            folder.memory()


def test_state_of_another_robot_schema_or_kind_is_refused(tmp_path: Path) -> None:
    with StateFolder(tmp_path, "rover") as folder:
        folder.save(MEMORY)
        folder.save_campaign({"k": 1})
    with StateFolder(tmp_path, "other") as folder:
        with pytest.raises(ConfigError, match="is the state of robot 'rover', not of 'other'"):
            folder.memory()
        with pytest.raises(ConfigError, match="campaign of robot 'rover'"):
            folder.campaign()
        with pytest.raises(ValueError, match="memory of robot 'rover'"):
            folder.save(MEMORY)
    with StateFolder(tmp_path, "rover") as folder:
        newer = durable.seal("state", msgspec.structs.replace(MEMORY, schema=MEMORY_SCHEMA + 1))
        (tmp_path / "state.json").write_bytes(newer)
        with pytest.raises(ConfigError, match=f"has state schema {MEMORY_SCHEMA + 1}"):
            folder.memory()
        (tmp_path / "state.json").write_bytes((tmp_path / "campaign.json").read_bytes())
        with pytest.raises(ConfigError, match="damaged"):
            folder.memory()
        (tmp_path / "state.json").write_bytes(durable.seal("state", {"robot": "rover", "unheard_of": 1}))
        with pytest.raises(ConfigError, match="written by another version"):
            folder.memory()


def test_two_processes_cannot_share_a_state(tmp_path: Path) -> None:
    code = "import sys; from pathlib import Path; from s2r_runtime.daemon.persistence import StateFolder as Folder"
    code += "; Folder(Path(sys.argv[1]), 'rover')"
    with StateFolder(tmp_path, "rover"):
        second = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False)
    assert "another process uses the state of robot 'rover'" in second.stderr
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False).returncode == 0


def test_a_folder_that_others_can_write_to_is_refused(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(ConfigError, match="chmod 700"):
        StateFolder(tmp_path / "open", "rover")


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be used for the state of robot 'rover'"):
        StateFolder(tmp_path / "file" / "rover", "rover")


def test_a_campaign_is_kept_and_forgotten(tmp_path: Path) -> None:
    with StateFolder(tmp_path, "rover") as folder:
        assert folder.campaign() is None
        folder.save_campaign({"index": 7, "x0": [0.1, -2.5e-9], "name": "ü"})
        assert folder.campaign() == {"index": 7, "x0": [0.1, -2.5e-9], "name": "ü"}
        folder.forget_campaign()
        folder.forget_campaign()
        assert folder.campaign() is None


def test_a_number_that_is_not_finite_is_never_written(tmp_path: Path) -> None:
    with StateFolder(tmp_path, "rover") as folder:
        folder.save(MEMORY)
        with pytest.raises(ValueError, match="must be finite"):
            folder.save(msgspec.structs.replace(MEMORY, radius=float("nan")))
        assert folder.memory() == MEMORY


def test_a_full_disk_leaves_the_old_state_whole(tmp_path: Path) -> None:
    with StateFolder(tmp_path, "rover") as folder:
        folder.save(MEMORY)
        before = (tmp_path / "state.json").read_bytes()
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))  # the kernel refuses the rest of the write
        try:
            with pytest.raises(OSError, match="File too large"):
                folder.save(msgspec.structs.replace(MEMORY, attempts=6))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert (tmp_path / "state.json").read_bytes() == before
        assert folder.memory() == MEMORY
        assert not list(tmp_path.glob(".*.new"))


WRITER = """
import sys
from pathlib import Path
from s2r_runtime.messages import MEMORY_SCHEMA, Memory
from s2r_runtime.daemon.persistence import StateFolder
folder = StateFolder(Path(sys.argv[1]), "rover")
attempts = folder.memory().attempts
while True:
    attempts += 1
    folder.save(Memory("rover", MEMORY_SCHEMA, attempts=attempts, latched=("x" * 5000,)))
    print(attempts, flush=True)
"""


def test_a_process_killed_while_saving_leaves_all_that_it_had_saved(tmp_path: Path) -> None:
    told = 0
    for kill in range(8):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
        assert writer.stdout is not None
        writer.stdout.readline()
        time.sleep(0.005 + 0.0037 * kill)  # anywhere in a save
        os.kill(writer.pid, signal.SIGKILL)
        told = max([told, *(int(line) for line in writer.stdout.read().splitlines() if line.isdigit())])
        writer.stdout.close()
        writer.wait()
        with StateFolder(tmp_path, "rover") as folder:
            assert folder.memory().attempts >= told
    assert told > 8


# ---------------------------------------------------------------- the ledger of offline certification


@pytest.fixture
def key(tmp_path: Path) -> Path:
    """A key's path with an empty ledger beside it."""
    offline_ledger.create(tmp_path / "signing.key")
    return tmp_path / "signing.key"


def test_each_attempt_is_paid_for_and_the_same_gap_only_once(key: Path) -> None:
    ledger = offline_ledger.open_ledger(key, "rover")
    assert [ledger.spend_attempt("c1"), ledger.spend_attempt("c1"), ledger.spend_attempt("c2")] == [1, 2, 3]
    assert [
        ledger.epoch_for("rec1", "m1"),
        ledger.epoch_for("rec2", "m1"),
        ledger.epoch_for("rec1", "m1"),
        ledger.epoch_for("rec1", "m2"),
    ] == [
        1,
        2,
        1,
        3,
    ]
    again = offline_ledger.open_ledger(key, "rover")
    assert again.spent(0.05) == pytest.approx(2 * sum(share(0.05, i) for i in (1, 2, 3)))
    assert [(e.kind, e.number) for e in again.entries()][:3] == [("attempt", 1), ("attempt", 2), ("attempt", 3)]


def test_robots_have_budgets_of_their_own(key: Path) -> None:
    assert offline_ledger.open_ledger(key, "rover").spend_attempt("c") == 1
    assert offline_ledger.open_ledger(key, "other").spend_attempt("c") == 1
    assert offline_ledger.open_ledger(key, "rover").spend_attempt("c") == 2


def test_a_damaged_or_missing_ledger_is_never_taken_for_an_empty_one(key: Path) -> None:
    offline_ledger.open_ledger(key, "rover").spend_attempt("c")
    path = offline_ledger.path_beside(key)
    whole = path.read_bytes()
    for damaged in (whole[:-10], b"", whole.replace(b'"number":1', b'"number":0'), b"{}"):
        path.write_bytes(damaged)
        with pytest.raises(ConfigError, match="damaged"):
            offline_ledger.open_ledger(key, "rover")
        with pytest.raises(ConfigError, match="damaged"):
            offline_ledger.Ledger(path, "rover").spend_attempt("c")
        assert path.read_bytes() == damaged
    path.unlink()
    with pytest.raises(ConfigError, match="is missing, so nobody knows what this key has spent"):
        offline_ledger.open_ledger(key, "rover")
    assert not path.exists()
    path.write_bytes(whole)
    with pytest.raises(ConfigError, match="is there already"):
        offline_ledger.create(key)
    path.write_bytes(durable.seal("ledger", {"schema": 2, "entries": []}))
    with pytest.raises(ConfigError, match="ledger schema 2"):
        offline_ledger.open_ledger(key, "rover")


SPENDER = """
import sys
from pathlib import Path
from s2r_runtime.trust.offline_ledger import open_ledger
ledger = open_ledger(Path(sys.argv[1]), "rover")
print(*(ledger.spend_attempt("c") for _ in range(25)))
"""


def test_processes_that_certify_at_once_never_spend_the_same_attempt(key: Path) -> None:
    running = [subprocess.Popen([sys.executable, "-c", SPENDER, str(key)], stdout=subprocess.PIPE, text=True) for _ in range(4)]
    numbers = [int(word) for process in running for word in process.communicate()[0].split()]
    assert sorted(numbers) == list(range(1, 101))


def test_a_ledger_that_cannot_be_written_certifies_nothing(key: Path) -> None:
    ledger = offline_ledger.open_ledger(key, "rover")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, hard))
    try:
        with pytest.raises(ConfigError, match="cannot be written, so nothing may be certified"):
            ledger.spend_attempt("c")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert ledger.spend_attempt("c") == 1
