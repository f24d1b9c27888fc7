"""What a computer can hold is measured, and what it cannot hold is said in one line each."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from daemon_rig import Rig

from s2r_runtime.controllers.processor import family, used
from s2r_runtime.daemon import computer
from s2r_runtime.daemon.computer import Ability, measure, not_held
from s2r_runtime.profile import Gate, Machine, Recording

GOOD = Ability(0.001, 100, 0.01, 10, 1.0)


def test_it_is_measured_on_the_disk_of_the_folder_and_leaves_it_as_it_was(tmp_path: Path) -> None:
    begun = time.monotonic()
    found = measure(tmp_path, 0.5)
    assert 0.0 < found.wake_s <= time.monotonic() - begun
    assert 0.0 < found.sync_s <= time.monotonic() - begun
    assert 0.0 < found.share <= 1.0
    assert found.wakes >= computer.NAPS
    assert found.syncs >= 1
    assert list(tmp_path.iterdir()) == []
    assert measure(tmp_path / "nowhere", 0.1).trouble == "No such file or directory"


@pytest.mark.parametrize(
    ("ability", "names"),
    [
        (GOOD, []),
        (GOOD._replace(wake_s=0.15), ["gate.controller_deadline (0.05 s), gate.command_ttl (0.1 s)"]),
        (GOOD._replace(sync_s=0.8), ["recording.max_delay (0.5 s)"]),
        (GOOD._replace(sync_s=7.1), ["recording.max_delay (0.5 s)", "machine.disk_timeout (5 s)"]),
        (GOOD._replace(share=0.25), ["4.0 times as long"]),
        (GOOD._replace(trouble="No space left on device"), ["No space left on device"]),
    ],
)
def test_what_it_cannot_hold_is_said_with_the_setting(ability: Ability, names: list[str]) -> None:
    said = not_held(ability, Gate(), Recording(), Machine(), realtime=True)
    assert len(said) == len(names)
    assert all(name in line for name, line in zip(names, said, strict=True)), said


def test_in_lockstep_the_robot_waits_so_that_no_delay_closes_the_gate() -> None:
    assert not_held(GOOD._replace(wake_s=3.0, sync_s=7.0), Gate(), Recording(), Machine(), realtime=False) == []


def test_the_daemon_says_at_its_start_what_this_computer_cannot_hold(tmp_path: Path) -> None:
    rig = Rig(tmp_path, clock="realtime", more="[recording]\nmax_delay = 0.1\n[machine]\ndisk_timeout = 0.1")
    try:
        rig.start()
        rig.until(lambda: "this computer: " in rig.said())
    finally:
        rig.close()


@pytest.mark.slow
def test_doctor_tries_the_computer_beside_busy_loops() -> None:
    argv = [sys.executable, "-m", "s2r_runtime.cli.main", "doctor", "--load", "--json"]
    found = json.loads(subprocess.run(argv, capture_output=True, text=True, check=False, timeout=100).stdout)
    lines = [finding for finding in found["findings"] if finding["what"] == "computer"]
    assert f"beside {os.cpu_count()} busy loops" in lines[0]["detail"]
    assert all(finding["ok"] is None for finding in lines[1:])


@pytest.mark.slow
def test_what_a_process_waits_for_a_processor_is_counted() -> None:
    """Five want one processor: it waits four times as long as it runs."""
    program = "import os, time\nos.sched_setaffinity(0, {0})\nwhile True: pass"
    busy = [subprocess.Popen([sys.executable, "-S", "-c", program], start_new_session=True) for _ in range(5)]
    try:
        before = None
        while before is None or before.ran_ns < 50_000_000:
            time.sleep(0.02)
            before = used(busy[0].pid)
        time.sleep(2.0)
        after = used(busy[0].pid)
        assert after is not None
        ran_ns, waited_ns = after.ran_ns - before.ran_ns, after.waited_ns - before.waited_ns
        assert after.ready
        assert waited_ns > ran_ns, (ran_ns, waited_ns)
        assert {one.pid for one in busy} <= set(family(os.getpid()))
    finally:
        for one in busy:
            one.kill()
            one.wait()
    assert used(busy[0].pid) is None
