"""Old logs are deleted when the profile keeps no more, and never one that holds what a valid certificate rests on."""

from __future__ import annotations

import errno
import functools
import json
import os
import time
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Rig

from s2r_runtime import messages as m
from s2r_runtime.daemon.believed_time import BELIEVED_AFTER_S, SLACK_S, BelievedTime
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
        self.wall_s, self.counted_s, self.boot = NOW_S - 20 * 86_400.0, 1000.0, "a"
        self.retention = self.again()
        self.runs = 0

    def again(self) -> Retention:
        """The daemon, started anew."""
        clocks = {"wall": lambda: self.wall_s, "counted": lambda: self.counted_s, "boot": lambda: self.boot}
        believed = functools.partial(BelievedTime, **clocks)
        self.retention = Retention(self.logs, self.state, "r", *self.keep, self.said.append, believed)
        return self.retention

    def wait(self, until_s: float) -> None:
        """Until then, by both clocks."""
        self.counted_s += until_s - self.wall_s
        self.wall_s = until_s

    def run(self, *messages: m.Struct, parts: int = 1, known: bool = True, now: bool = False) -> str:
        """A run that logs these: a day after the one before, or now, whatever the clock says."""
        self.runs += 1
        if not now:
            self.wait(NOW_S - (20 - self.runs) * 86_400.0)
        name = f"r-2026010{self.runs}T000000Z"
        for part in range(1, parts + 1):
            path = self.logs / (f"{name}.mcap" if part == 1 else f"{name}.{part:03d}.mcap")
            path.write_bytes(bytes(1000))
            os.utime(path, (self.wall_s,) * 2)
        if known:
            self.retention.begin(name)
        for message in messages:
            self.retention.note(message)
        assert self.retention.save()
        return name

    def left(self, memory: m.Memory, unix_s: int = NOW_S) -> list[str]:
        """Runs whose logs are there after a look at that time, which came as time comes."""
        self.wait(unix_s)
        return self.look(memory)

    def look(self, memory: m.Memory) -> list[str]:
        """Runs whose logs are there after a look now."""
        self.retention.prune(lambda: memory)
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
    robot.retention.prune_beside(memory)
    deadline = time.monotonic() + 30.0
    while not (gone := robot.retention.deleted()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(gone) == 1
    assert robot.left(memory()) == [current]


# ---------------------------------------------------------------- wall clocks

YEAR_S = 365 * 86_400


def test_a_clock_set_forward_deletes_nothing_that_is_young_and_expires_no_certificate(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_days=30.0)
    held = robot.run(campaign(1), m.CertificateStored(0, facts(1, 1)))
    made = [held, *(robot.run() for _ in range(3))]
    assert robot.left(memory()) == made
    robot.wall_s += YEAR_S
    assert robot.look(memory()) == made, "while it runs"
    robot.again().begin(made[-1])
    assert robot.look(memory()) == made, "after another start of the daemon"
    robot.boot, robot.counted_s = "b", 10.0
    robot.keep = 1, 30.0
    robot.again().begin(made[-1])
    assert robot.look(memory()) == [held, made[-1]], (
        "after another start of the computer: what must go for its bytes goes, evidence does not"
    )
    robot.wall_s -= YEAR_S
    robot.keep = 0, 30.0
    robot.again().begin(made[-1])
    assert robot.look(memory()) == [held, made[-1]]


def test_logs_from_before_any_time_was_noted_are_as_young_as_their_files(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_days=30.0)
    made = [robot.run() for _ in range(3)]
    assert not (robot.state / "log_time.json").exists()
    robot.wall_s += YEAR_S
    robot.again().begin(made[-1])
    assert robot.look(memory()) == made


def test_a_clock_that_stays_ahead_is_believed_after_a_week_or_two(tmp_path: Path) -> None:
    """A robot that was a month in a cupboard."""
    robot = Robot(tmp_path, keep_days=30.0)
    made = [robot.run() for _ in range(3)]
    assert robot.left(memory()) == made
    robot.wall_s, robot.boot, robot.counted_s = robot.wall_s + YEAR_S, "b", 10.0
    assert robot.look(memory()) == made
    for _ in range(int(BELIEVED_AFTER_S // 86_400) - 1):
        assert robot.left(memory(), robot.wall_s + 86_400) == made
    for _ in range(int(BELIEVED_AFTER_S // 86_400) + 1):
        left = robot.left(memory(), robot.wall_s + 86_400)
    assert left == made[-1:]


def test_a_log_that_was_written_while_the_clock_stood_in_1970_is_no_old_one(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_days=30.0)
    made = [robot.run() for _ in range(2)]
    assert robot.left(memory()) == made
    robot.wall_s, robot.counted_s = 1000.0, robot.counted_s + 600.0
    robot.again()
    made.append(robot.run(now=True))
    robot.wall_s, robot.counted_s = NOW_S + 1200.0, robot.counted_s + 600.0
    made.append(robot.run(now=True))
    assert robot.look(memory()) == made


def test_believed_time_follows_an_honest_clock_to_the_second_and_a_wrong_one_by_the_hour(tmp_path: Path) -> None:
    clock = {"wall": float(NOW_S), "counted": 0.0}
    file = tmp_path / "log_time.json"

    def time_now() -> BelievedTime:
        return BelievedTime(file, None, wall=lambda: clock["wall"], counted=lambda: clock["counted"], boot=lambda: "a")

    one = time_now()
    for _ in range(100):
        clock["wall"] += 60.0 + 0.003
        clock["counted"] += 60.0
        assert one.now() == clock["wall"]
    one.save()
    clock["wall"] += YEAR_S
    assert abs(time_now().now() - (clock["wall"] - YEAR_S + SLACK_S)) < 1.0
    clock["wall"] -= 2 * YEAR_S
    assert one.now() == clock["wall"], "what is behind keeps logs"
    file.write_bytes(b"{")
    clock["wall"] += YEAR_S
    assert time_now().now() == clock["wall"]
    assert BelievedTime(file, 5.0, wall=lambda: 1e9, counted=lambda: 0.0, boot=lambda: "a").now() == 5.0 + SLACK_S


def test_what_comes_to_rest_on_a_log_while_others_are_deleted_keeps_it(tmp_path: Path) -> None:
    """The look began before; a campaign's epoch is in force again when it comes to that log."""
    robot = Robot(tmp_path, keep_bytes=1)
    made = [robot.run(campaign(epoch)) for epoch in (1, 2)]
    current = robot.run()
    asked: list[int] = []

    def meanwhile() -> m.Memory:
        asked.append(1)
        return memory(campaign_epoch=2 if len(asked) > 1 else 0)

    robot.retention.prune(meanwhile)
    assert sorted(path.stem for path in robot.logs.iterdir()) == [made[1], current]


def test_a_run_goes_as_a_whole_or_stays_and_its_last_part_goes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot(tmp_path, keep_bytes=1)
    made = [robot.run(parts=3), robot.run()]
    before = sorted(robot.logs.iterdir())
    rename, tried = Path.rename, list[str]()

    def fails_once(path: Path, target: Path) -> Path:
        tried.append(path.name.removeprefix(made[0]))
        if len(tried) == 3:
            raise PermissionError(errno.EACCES, "Permission denied")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", fails_once)
    assert robot.look(memory()) == made
    assert tried[:3] == [".003.mcap", ".002.mcap", ".mcap"]
    assert sorted(robot.logs.iterdir()) == before
    assert robot.retention.deleted() == []
    assert robot.look(memory()) == made[1:]
    (gone,) = robot.retention.deleted()
    assert (gone.run, gone.files) == (made[0], 3)


def test_what_a_kill_left_of_a_deletion_is_deleted_at_the_next_look(tmp_path: Path) -> None:
    robot = Robot(tmp_path, keep_bytes=10**9)
    current = robot.run()
    (robot.logs / "r-20260101T000000Z.mcap.deleted").write_bytes(b"x")
    (robot.logs / "other-20260101T000000Z.mcap.deleted").write_bytes(b"x")
    assert robot.left(memory()) == ["other-20260101T000000Z", current]


@pytest.mark.parametrize("field", ["keep_bytes", "keep_days"])
def test_a_limit_below_zero_is_refused(tmp_path: Path, field: str) -> None:
    from s2r_runtime.errors import ConfigError
    from s2r_runtime.profile import load_profile

    text = (Path(__file__).parent.parent / "profiles" / "robotarium.toml").read_text()
    (tmp_path / "p.toml").write_text(text + f"\n[recording]\n{field} = -1\n")
    with pytest.raises(ConfigError, match=f"recording.{field} is -1"):
        load_profile(tmp_path / "p.toml")


@pytest.mark.slow
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
