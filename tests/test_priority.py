"""A daemon with real-time priority: what it starts stands behind it, and what computes for minutes leaves real time."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os, subprocess, sys
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
except PermissionError:
    raise SystemExit("not permitted")
child = "import os; from s2r_runtime.child import stand_back; stand_back({}); "
child += "print(os.sched_getscheduler(0), os.sched_getparam(0).sched_priority)"
for levels in (1, 2, 99, None):
    subprocess.run([sys.executable, "-c", child.format(levels)], check=True)
"""


def test_helpers_stand_behind_a_daemon_with_real_time_priority() -> None:
    said = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    if "not permitted" in said.stderr:
        pytest.skip("this user may not have real-time priority")
    fifo, other = os.SCHED_FIFO, os.SCHED_OTHER
    assert said.stdout.splitlines() == [f"{fifo} 19", f"{fifo} 18", f"{fifo} 1", f"{other} 0"]


def test_without_real_time_priority_nothing_changes() -> None:
    from s2r_runtime.child import stand_back

    before = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
    stand_back(1)
    stand_back(None)
    assert (os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)) == before
