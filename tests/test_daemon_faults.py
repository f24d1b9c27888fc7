"""Faults in a running daemon: each is noticed, nothing moves that may not, and a certified controller drives again.

All of them, hundreds of times: python tools/bench_daemon_faults.py --count 500
"""

from __future__ import annotations

from pathlib import Path

from daemon_faults import FAULTS, Drill, judged

SHARE = {
    "controller forks": {"controller_fault"},
    "worker killed": {"no_certificate"},
    "monotonic clock steps": set(),
    "disk full": {"recorder_down"},
    "second daemon": set(),
    "recorder dead": {"recorder_down"},
    "state from the future": set(),
}
"""What the gate must have said of each, at least; the others have their own ways to be noticed."""


def test_seven_faults_in_one_robots_life_are_noticed_move_nothing_and_mend(tmp_path: Path) -> None:
    drill = Drill(tmp_path)
    try:
        drill.begin()
        for name, least in SHARE.items():
            assert least <= set(drill.run(name).reasons), name
        drill.rig.stop()
        found = judged(drill)
        assert found["commands"] > 100
    finally:
        drill.rig.close()


def test_the_faults_that_the_bench_counts_have_names_that_say_what_they_are() -> None:
    assert len(FAULTS) > 45
    assert SHARE.keys() <= FAULTS.keys()
