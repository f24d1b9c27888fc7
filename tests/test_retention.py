"""Old logs are deleted when the profile keeps no more, and never one that holds what a valid certificate rests on."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Rig

from s2r_runtime import messages as m
from s2r_runtime.daemon.retention import Retention
from s2r_runtime.recording.channels import LogDeleted
from s2r_runtime.recording.reading import read

NOW_S = 1_700_000_000
MODEL, OTHER = "sha256:model", "sha256:other"


class Robot:
    """A folder of logs, one a run, each of 1000 bytes and a day younger than the one before."""

    def __init__(self, folder: Path, keep_bytes: int = 0, keep_days: float = 0.0) -> None:
        self.logs, self.state = folder / "logs", folder / "state"
        self.logs.mkdir(exist_ok=True)
        self.state.mkdir(mode=0o700, exist_ok=True)
        self.said: list[str] = []
        self.keep = keep_bytes, keep_days
        self.retention = self.again()
        self.runs = 0

    def again(self) -> Retention:
        """The daemon, started anew."""
        self.retention = Retention(self.logs, self.state, "r", *self.keep, self.said.append)
        return self.retention

    def run(self, *messages: m.Struct, parts: int = 1, known: bool = True) -> str:
        """A run that logs these."""
        self.runs += 1
        name = f"r-2026010{self.runs}T000000Z"
        for part in range(1, parts + 1):
            path = self.logs / (f"{name}.mcap" if part == 1 else f"{name}.{part:03d}.mcap")
            path.write_bytes(bytes(1000))
            os.utime(path, (NOW_S - (20 - self.runs) * 86_400,) * 2)
        if known:
            self.retention.begin(name)
        for message in messages:
            self.retention.note(message)
        assert self.retention.save()
        return name

    def left(self, memory: m.Memory, unix_s: int = NOW_S) -> list[str]:
        """Runs whose logs are there after a look."""
        self.retention.prune(memory, unix_s)
        return sorted({path.name.split(".")[0] for path in self.logs.iterdir()})


def facts(epoch: int, attempt: int, model: str = MODEL, identity: str = "c") -> m.CertificateFacts:
    return m.CertificateFacts(identity, "k", model, "t", "p", epoch, 0.1, 0.2, NOW_S - 1000, NOW_S + 86_400, attempt)


def memory(**fields: Any) -> m.Memory:
    return m.Memory("r", 1, **{"model_digest": MODEL, **fields})


def campaign(epoch: int) -> m.StartCampaign:
    return m.StartCampaign(0, epoch, 10, 0.01, 1, False)


def test_without_a_limit_nothing_is_deleted(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    made = [robot.run() for _ in range(4)]
    assert robot.left(memory()) == made


def test_the_oldest_runs_go_first_and_only_as_many_as_must(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_bytes=3500)
    made = [robot.run(parts=2) for _ in range(4)]
    assert robot.left(memory()) == made[3:], "2000 bytes each: one run fits, and the current one is never deleted"
    assert [gone.run for gone in robot.retention.deleted()] == made[:3]
    assert all("deleted (2000 bytes" in line for line in robot.said)


def test_logs_that_are_too_old_go(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_days=17.5)
    made = [robot.run() for _ in range(4)]
    assert robot.left(memory()) == made[2:], "the first two are 19 and 18 days old"


def test_what_a_valid_certificate_rests_on_stays_until_it_is_expired_or_revoked(tmp_path: Path) -> None:
    """Campaign in one run (interrupted, and finished in another), verification in a third, driving in between."""
    robot = Robot(tmp_path, keep_bytes=1)
    began = robot.run(m.EpochChanged(0, 1, 0.01), campaign(1))
    finished = robot.run(campaign(1))
    robot.run(m.Ticked(0))
    issued = robot.run(m.AttemptSpent(0, 3, 0.01, "k", 0.1), m.CertificateStored(0, facts(1, 3)))
    robot.run(m.Ticked(0))
    current = robot.run()
    assert robot.left(memory()) == [began, finished, issued, current], "also when it is in force no more: it can be deployed again"
    robot.again().begin(current)
    assert robot.left(memory(), NOW_S + 80_000) == [began, finished, issued, current]
    assert robot.left(memory(revoked={"c": "by hand"})) == [current]


def test_an_expired_certificate_holds_nothing_any_more(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_bytes=1)
    robot.run(campaign(1), m.CertificateStored(0, facts(1, 1)))
    current = robot.run()
    assert robot.left(memory(), NOW_S + 86_400 + 7200) == [current]


def test_a_campaign_that_goes_on_keeps_its_logs(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_bytes=1)
    made = [robot.run(campaign(epoch)) for epoch in (1, 2, 3)]
    current = robot.run()
    assert robot.left(memory(campaign_epoch=2)) == [made[1], current]


def test_a_repaired_model_keeps_its_trace_and_the_rows_that_it_was_fitted_on(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_bytes=1)
    rows = robot.run(m.Ticked(0))
    robot.run(m.Ticked(0))
    traced = robot.run(
        m.JobFinished(0, 1, "trace", trace={"proposal": {"digest": MODEL}, "recording": {"parts": [{"run": rows, "first": 0, "last": 9}]}})
    )
    robot.run(m.ModelAdopted(0, OTHER, 0, proposed=True))
    current = robot.run()
    assert robot.left(memory()) == [rows, traced, current]


def test_a_log_of_which_nobody_knows_what_it_holds_stays(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_bytes=1)
    copied = robot.run(known=False)
    robot.run()
    current = robot.run()
    assert robot.left(memory()) == [copied, current]
    (robot.state / "log_evidence.json").write_text("{")
    robot.again()
    newest = robot.run()
    assert robot.left(memory()) == [copied, current, newest]
    assert any("no log from before is deleted" in line for line in robot.said)


@pytest.mark.parametrize("data", [b"\xff", b'{"\xff": {}}', b"[1]", b"[" * 100_000])
def test_a_note_that_is_damaged_frees_no_log_and_stops_no_daemon(tmp_path: Path, data: bytes) -> None:
    robot = Robot(tmp_path, keep_bytes=1)
    first = robot.run(campaign(1))
    robot.run()
    (robot.state / "log_evidence.json").write_bytes(data)
    robot.again()
    third = robot.run()
    assert first in robot.left(memory())
    assert third in robot.left(memory())
    assert "cannot be read" in robot.said[0]


def test_nothing_may_rest_on_a_log_of_which_it_could_not_be_noted(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.run()
    robot.retention.note(campaign(5))
    (robot.state / ".log_evidence.json.new").mkdir()
    assert not robot.retention.save()
    (robot.state / ".log_evidence.json.new").rmdir()
    assert robot.retention.save()


def test_deleting_goes_on_beside_the_daemon(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_bytes=1)
    robot.run()
    current = robot.run()
    robot.retention.prune_beside(memory(), NOW_S)
    deadline = time.monotonic() + 30.0
    while not (gone := robot.retention.deleted()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(gone) == 1
    assert robot.left(memory()) == [current]


@pytest.mark.parametrize("field", ["keep_bytes", "keep_days"])
def test_a_limit_below_zero_is_refused(tmp_path: Path, field: str) -> None:
    from s2r_runtime.errors import ConfigError
    from s2r_runtime.profile import load_profile

    text = (Path(__file__).parent.parent / "profiles" / "robotarium.toml").read_text()
    (tmp_path / "p.toml").write_text(text + f"\n[recording]\n{field} = -1\n")
    with pytest.raises(ConfigError, match=f"recording.{field} is -1"):
        load_profile(tmp_path / "p.toml")


def test_a_daemon_deletes_what_its_profile_does_not_keep_and_its_log_says_so_to_the_end(tmp_path: Path) -> None:
    rig = Rig(tmp_path, more="[recording]\nkeep_bytes = 1\n")
    try:
        rig.start()
        rig.stop()
        (first,) = rig.log_files()
        rig.start()
        rig.until(lambda: not first.exists())
        rig.stop()
        (second,) = rig.log_files()
        audited = rig.s2r("audit", str(second), "--json")
    finally:
        rig.close()
    (gone,) = [entry.message for entry in read(second) if entry.channel == "log/deleted"]
    assert isinstance(gone, LogDeleted)
    assert (gone.run, gone.files) == (first.stem, 1)
    assert len(gone.head) == 64
    assert audited.returncode == 0, audited.stdout
    assert any(first.stem in one and gone.head in one for one in json.loads(audited.stdout)["missing"])
