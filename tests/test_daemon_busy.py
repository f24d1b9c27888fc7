"""A computer that is busy: slow disks, processes that stand still. The gate does what it must for the robot, and needs nobody after."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from daemon_rig import Rig

from s2r_runtime.messages import AnswerLate, GateChanged, RecorderChanged, Send, SourceStopped

SLOW_S = 1.0
"""Of each write: twice `recording.max_delay`."""


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


@pytest.mark.slow
def test_in_lockstep_the_robot_waits_for_a_slow_disk_and_the_campaign_ends_as_it_would(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    answer = rig.background("sample") if rig.until(lambda: rig.status()["observation"]) and rig.ask("permit", duration_s=3600.0) else None
    assert answer is not None
    rig.until(lambda: len(rig.applied()) > 50)
    rig.to_daemon(sabotage="slow write", value=SLOW_S)
    time.sleep(2.0 * SLOW_S)
    rig.to_daemon(sabotage="slow write", value=0.0)
    assert answer()["exit_code"] == 0
    assert rig.stop() == 0
    assert rig.messages("event/recorder_changed") == []
    assert "relied on" not in rig.said()


@pytest.mark.slow
def test_in_lockstep_a_disk_that_hangs_keeps_the_robot_waiting_so_that_a_kill_costs_no_more(rig: Rig) -> None:
    """The robot is told nothing after `recording.max_delay`, so nothing later can be lost. What was told is in the log up to there."""
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    rig.background("sample")
    rig.until(lambda: len(rig.applied()) > 50)
    rig.to_daemon(sabotage="slow write", value=60.0)
    time.sleep(2.0)
    before = rig.applied()
    time.sleep(1.0)
    assert len(rig.applied()) == len(before), "it went on"
    rig.kill()
    sent = [message.seq for message in rig.messages("out/send") if isinstance(message, Send)]
    assert sent == [command["seq"] for command in before[: len(sent)]], "it is a log of what the robot was told"


def test_in_real_time_a_slow_disk_closes_the_gate_and_the_campaign_waits_for_it(realtime: Rig) -> None:
    rig = realtime
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    rig.background("sample")
    rig.until(lambda: rig.status()["phase"])
    rig.to_daemon(sabotage="slow write", value=SLOW_S)
    rig.until(lambda: rig.status()["recorder"] != "ok")
    assert rig.status()["phase"], "the campaign waits"
    rig.to_daemon(sabotage="slow write", value=0.0)
    rig.until(lambda: rig.status()["recorder"] == "ok" and rig.status()["driving"] == "sampler")
    assert rig.stop() == 0
    changes = [(m.ok, m.late) for m in rig.messages("event/recorder_changed") if isinstance(m, RecorderChanged)]
    assert changes[:1] == [(False, True)]
    assert (True, False) in changes
    stopped = [m.detail for m in rig.messages("event/source_stopped") if isinstance(m, SourceStopped)]
    assert all("recorder" not in detail for detail in stopped), stopped


@pytest.mark.slow
def test_a_machine_that_stands_still_for_a_second_drives_on_without_a_person(realtime: Rig) -> None:
    rig = realtime
    rig.start_robot()
    rig.start()
    assert rig.deploy()["exit_code"] == 0
    rig.until_status(gate="open", driving="controller")
    assert rig.daemon is not None
    pids = rig.status()["pids"]
    everybody = [rig.daemon.pid, pids["controller"], pids["analytics"]]
    for _ in range(3):
        for how in (signal.SIGSTOP, signal.SIGCONT):
            for pid in everybody:
                os.kill(pid, how)
            time.sleep(1.0 if how == signal.SIGSTOP else 0.0)
        rig.until_status(gate="open", driving="controller")
    assert (rig.status()["latched"], rig.status()["pids"]) == ([], pids)
    assert rig.stop() == 0
    closed = {m.reason for m in rig.messages("out/gate_changed") if isinstance(m, GateChanged) and not m.open}
    assert closed & {"observation_stale", "command_stale"}, "how old things are is not forgiven"
    assert "recorder_down" not in closed


@pytest.mark.slow
def test_a_controller_that_stands_still_alone_is_at_fault(realtime: Rig) -> None:
    rig = realtime
    rig.start_robot()
    rig.start()
    assert rig.deploy()["exit_code"] == 0
    rig.until_status(gate="open", driving="controller")
    os.kill(rig.status()["pids"]["controller"], signal.SIGSTOP)
    rig.until_status(gate="closed", latched=["controller_fault"])
    assert rig.stop() == 0
    asked = [m for m in rig.messages("event/answer_late") if isinstance(m, AnswerLate)]
    assert len(asked) <= 1, "only where the daemon was late itself"
