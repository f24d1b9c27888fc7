"""What the daemon keeps: campaigns that survive interruptions, and a log that survives kills and full disks."""

from __future__ import annotations

import json
import resource
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Rig

from s2r_runtime.daemon.persistence import StateFolder
from s2r_runtime.daemon.sampler import Keeper, Kept
from s2r_runtime.messages import (
    CampaignFinished,
    EpochChanged,
    Frame,
    GateChanged,
    LinkChanged,
    Observed,
    RecorderChanged,
    SampleTaken,
    Send,
    Started,
)
from s2r_runtime.recording.reading import read


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    opened = Rig(tmp_path)
    yield opened
    opened.close()


@pytest.fixture
def realtime(tmp_path: Path) -> Iterator[Rig]:
    opened = Rig(tmp_path, clock="realtime")
    yield opened
    opened.close()


# ---------------------------------------------------------------- campaigns


@pytest.mark.slow
def test_campaign_founds_a_gap_and_one_seed_gives_one_campaign(tmp_path: Path) -> None:
    (gap, samples), again = (seeded_campaign(tmp_path / name, "7") for name in ("a", "b"))
    assert (gap, samples) == again
    assert (gap["epoch"], gap["n"]) == (1, len(samples))


def seeded_campaign(folder: Path, seed: str) -> tuple[dict[str, Any], list[Any]]:
    folder.mkdir()
    rig = Rig(folder)
    try:
        rig.start_robot()
        rig.start("--seed", seed)
        heard: list[dict[str, Any]] = []
        rig.until(lambda: rig.status()["observation"])
        rig.ask("permit", duration_s=3600.0)
        answer = rig.ask("sample", heard)
        assert answer["exit_code"] == 0, answer
        assert any("samples taken; computing the gap" in line.get("text", "") for line in heard)
        rig.stop()
    finally:
        rig.close()
    return answer["data"], [(s.u, s.x0, s.x1, s.held) for s in rig.messages("event/sample_taken") if isinstance(s, SampleTaken)]


def test_sampling_needs_a_permit_and_ends_with_it(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    refused = rig.ask("sample")
    assert (refused["exit_code"], "no_permit" in refused["text"]) == (1, True)
    rig.ask("permit", duration_s=20.0)  # of the robot's time
    ended = rig.ask("sample")
    assert ended["exit_code"] == 1
    assert "permit_expired" in ended["text"]
    rig.ask("permit", duration_s=3600.0)
    assert rig.ask("sample")["exit_code"] == 0
    assert rig.status()["epoch"] == 1


@pytest.mark.slow
def test_campaign_that_was_killed_goes_on_without_a_new_epoch_and_its_log_is_complete(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(rig.socket))
        client.sendall(b'{"verb": "sample"}\n')
        rig.until(lambda: (rig.status()["campaign"] or {}).get("taken", 0) >= 4)
        kept_in = rig.state / "campaign.json"
        rig.until(lambda: kept_in.exists() and b'"x0"' in kept_in.read_bytes())  # it is kept beside the loop, a little later
    rig.kill()
    rig.start()
    answer = rig.sample()
    assert answer["exit_code"] == 0, answer
    status = rig.status()
    assert (status["epoch"], status["unfinished_epoch"]) == (1, None)
    rig.stop()
    first, second = rig.log_files()
    began = [m for m in rig.messages("out/epoch_changed") if isinstance(m, EpochChanged) and m.gap is None]
    assert len(began) == 1
    samples = [entry.message for entry in read(second, ["event/sample_taken"])]
    finished = [entry.message for entry in read(second, ["event/campaign_finished"])]
    assert [s.index for s in samples if isinstance(s, SampleTaken)] == list(range(len(samples)))
    assert any(s.again for s in samples if isinstance(s, SampleTaken))
    assert [(f.n, f.complete) for f in finished if isinstance(f, CampaignFinished)] == [(len(samples), True)]
    again = {s.x0 for s in samples if isinstance(s, SampleTaken)}
    kept = [s.x0 in again for s in [e.message for e in read(first, ["event/sample_taken"])] if isinstance(s, SampleTaken)]
    assert kept[0]
    assert kept == sorted(kept, reverse=True), "but for the last ones, which the kill took back"


def test_a_campaign_is_kept_only_as_far_as_the_log_has_it(tmp_path: Path) -> None:
    """Samples that no log has look made up: a campaign with them would not be gone on with after a kill."""
    said: list[str] = []
    in_log = threading.Event()
    with StateFolder(tmp_path / "state", "robot") as folder:
        keeper = Keeper(folder, in_log.is_set, said.append)
        kept = Kept(1, 4, {"index": 0}, (), ())
        for _ in range(2):
            keeper.keep(kept)
            time.sleep(0.2)
        assert said == ["the campaign cannot be kept, so an interruption would lose it: the log does not take its samples"]
        assert folder.campaign() is None
        in_log.set()
        keeper.keep(kept)
        keeper.close()
        assert folder.campaign() is not None


@pytest.mark.slow
def test_robot_that_freezes_is_a_lost_link_and_the_campaign_goes_on_when_it_is_back(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    assert rig.robot is not None
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(rig.socket))
        client.sendall(b'{"verb": "sample"}\n')
        rig.until(lambda: (rig.status()["campaign"] or {}).get("taken", 0) >= 2)
        rig.robot.send_signal(signal.SIGSTOP)
        rig.until_status(link=False)
        rig.robot.send_signal(signal.SIGCONT)
        rig.until(lambda: rig.status()["radius"])
    changes = [m.up for m in rig.messages("event/link_changed") if isinstance(m, LinkChanged)]
    assert changes == [True, False, True]


@pytest.mark.slow
def test_one_campaign_runs_without_a_daemon_and_goes_on_after_an_interruption(rig: Rig) -> None:
    rig.start_robot()
    out = rig.folder / "campaign.mcap"
    first = rig.campaign(out)
    rig.until(lambda: out.exists() and sum(1 for _ in read(out, ["event/sample_taken"])) >= 3)
    first.send_signal(signal.SIGINT)
    assert first.wait(30.0) == 1
    assert "the same command goes on" in json.loads((rig.folder / "campaign.json").read_text())["text"]
    assert rig.campaign(out).wait(60.0) == 0
    answer = json.loads((rig.folder / "campaign.json").read_text())
    assert answer["log"] == str(out.with_stem("campaign-2"))
    assert answer["gap"]["n"] == answer["n"] == sum(1 for _ in read(Path(answer["log"]), ["event/sample_taken"]))
    again = rig.campaign(out)
    assert again.wait(30.0) == 2
    assert "is there already" in (rig.folder / "campaign.txt").read_text()


# ---------------------------------------------------------------- the log


def test_kill_loses_at_most_100_ms_of_the_log(realtime: Rig) -> None:
    realtime.start_robot("--dt", "0.01")
    realtime.start()
    realtime.until(lambda: realtime.status()["recorded"] > 300)
    time.sleep(0.3)
    realtime.kill()
    killed_ns = time.monotonic_ns()
    frames = [m for m in realtime.messages("frame/in") if isinstance(m, Frame)]
    # the killing itself took a moment, and so did the last datagram; what the log may lack is 100 ms
    assert killed_ns - frames[-1].arrival_ns < 150_000_000


def test_full_disk_closes_the_gate_and_room_opens_the_way_again(realtime: Rig) -> None:
    realtime.start_robot()
    realtime.start()
    assert realtime.daemon is not None
    realtime.until(lambda: realtime.status()["observation"])
    size = realtime.log_files()[-1].stat().st_size
    limit_files(realtime.daemon.pid, size + 4096)
    realtime.until_status(gate="closed", reason="recorder_down")
    assert "link" in realtime.status()
    realtime.ask("permit", duration_s=60.0)
    assert "recorder_down" in realtime.ask("sample")["text"]
    limit_files(realtime.daemon.pid, resource.RLIM_INFINITY)
    realtime.until_status(recorder="ok", reason="no_controller")
    assert realtime.stop() == 0
    assert [m.ok for m in realtime.messages("event/recorder_changed") if isinstance(m, RecorderChanged)] == [False, True]
    observed = [m.observation.seq for m in realtime.messages("event/observed") if isinstance(m, Observed)]
    assert observed == list(range(observed[0], observed[-1] + 1))  # nothing recorded was lost meanwhile


@pytest.mark.slow
def test_log_that_had_to_leave_something_out_ends_there_and_a_new_one_begins_when_there_is_room(realtime: Rig) -> None:
    realtime.start_robot()
    realtime.start()
    assert realtime.daemon is not None
    realtime.until(lambda: realtime.status()["observation"])
    limit_files(realtime.daemon.pid, 1000)
    for _ in range(400):
        realtime.to_daemon(garbage="x" * 60_000)  # a flood that memory cannot hold for long
    realtime.until(lambda: "memory for the log is full" in realtime.status()["recorder"] or realtime.status()["recorder"])
    before = len(realtime.applied())
    time.sleep(3.0)  # it tries again by now
    assert realtime.status()["reason"] == "recorder_down"
    assert len(realtime.applied()) > before  # the robot is told to recover all the same
    limit_files(realtime.daemon.pid, resource.RLIM_INFINITY)
    realtime.until_status(recorder="ok", gate="closed", reason="no_controller", link=True)
    assert realtime.stop() == 0
    first, second = realtime.log_files()
    assert [entry.message.count > 0 for entry in read(first, ["log/unrecorded"])] == [True]  # type: ignore[attr-defined]
    assert next(iter(read(second))).channel == "event/started"
    assert not list(realtime.logs.glob("*-*-*.mcap"))
    for log in (first, second):
        found = json.loads(realtime.s2r("audit", str(log), "--key", str(realtime.state / "key.pub"), "--json").stdout)
        assert found["ok"], found


@pytest.mark.slow
def test_memory_that_the_disk_refuses_closes_the_gate_and_is_saved_when_there_is_room(realtime: Rig) -> None:
    realtime.start_robot()
    realtime.start()
    assert realtime.daemon is not None
    realtime.until(lambda: realtime.status()["observation"])
    limit_files(realtime.daemon.pid, 50)
    assert realtime.ask("stop")["exit_code"] == 0  # stopping is always possible
    status = realtime.until(lambda: (found := realtime.status())["recorder"] != "ok" and found)
    assert (status["gate"], status["latched"]) == ("closed", ["emergency_stop"])
    limit_files(realtime.daemon.pid, resource.RLIM_INFINITY)
    realtime.until_status(recorder="ok")
    realtime.until(lambda: (realtime.state / "state.json").exists() and b"emergency_stop" in (realtime.state / "state.json").read_bytes())
    realtime.kill()
    realtime.start()
    assert realtime.status()["latched"] == ["emergency_stop"]


def limit_files(pid: int, size: int) -> None:
    """What a file of that process may grow to: a full disk, but for the error's number."""
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


@pytest.mark.slow
def test_log_is_the_events_in_the_order_in_which_they_were_handled(rig: Rig) -> None:
    from s2r_runtime.core import reducer as core

    rig.start_robot()
    rig.start()
    assert rig.sample()["exit_code"] == 0
    rig.stop()
    state, due = core.initial(), []
    for entry in read(rig.log_files()[-1]):
        kind = entry.channel.split("/")[0]
        if kind == "event":
            assert due == []
            state, outputs = core.handle(state, entry.message)
            due = list(outputs)
            if any(isinstance(output, GateChanged) and not output.open for output in due):
                due.sort(key=lambda output: not isinstance(output, Send))
        elif kind == "out":
            assert entry.message in due
            due.remove(entry.message)
    assert state.stopping
    assert isinstance(rig.messages("event/started")[0], Started)
