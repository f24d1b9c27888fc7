"""What the watch has seen outlives the process that measures, the daemon, and a kill; the audit measures all of it again."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from daemon_rig import Rig

from s2r_runtime.messages import AnalyticsChanged, Measured, Started


@pytest.mark.slow
def test_the_watch_goes_on_over_the_death_of_its_process_and_a_restart_and_the_audit_makes_it_again(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    try:
        rig.start_robot()
        rig.start()
        body = "    return np.tile([0.05, 0.5], (len(x), 1))\n"
        assert rig.deploy(rig.controller(body))["exit_code"] == 0
        rig.until_status(gate="open", driving="controller")
        rig.until(lambda: rig.status()["stream"]["n"] > 100)
        pid = rig.status()["pids"]["analytics"]
        os.kill(pid, signal.SIGKILL)
        rig.until(lambda: rig.status()["pids"]["analytics"] not in (0, pid))
        rig.until_status(gate="open", analytics="up")
        before = rig.status()
        seen = before["stream"]["n"]
        rig.until(lambda: rig.status()["stream"]["n"] > seen + 50)
        assert before["headroom_used"] == before["radius"] / before["verified_radius"]
        assert before["samples_to_certificate"] == 0
        assert 0.0 < before["stream"]["exceedance_upper"] < 1.0
        said = rig.s2r("status", "--socket", str(rig.socket)).stdout
        assert "samples to certificate 0" in said
        assert "exceedance_upper" in said
        rig.stop()

        rig.start()
        kept = rig.status()["stream"]["n"]
        assert kept > seen
        rig.until(lambda: rig.status()["observation"])
        assert rig.ask("deploy", path=str(rig.folder / "controller.py"))["exit_code"] == 0
        rig.until_status(gate="open", driving="controller")
        rig.until(lambda: rig.status()["stream"]["n"] > kept + 200)  # a kill loses the last 100 ms of them
        rig.kill()
        measured = [m for m in rig.messages("event/measured") if isinstance(m, Measured)]
        assert [m.n for m in measured] == list(range(1, len(measured) + 1))
        assert len(measured) > kept + 20
        assert measured[-1].change > 0.0
        started = [m.memory for m in rig.messages("event/started") if isinstance(m, Started)][-1]
        assert kept == started.watch_n == sum(started.watch_counts)
        found = json.loads(rig.s2r("audit", *map(str, rig.log_files()), "--key", str(rig.state / "key.pub"), "--json").stdout)
        assert (found["ok"], found["first_difference"]) == (True, None), found
    finally:
        rig.close()


@pytest.mark.slow
def test_a_watch_that_falls_behind_and_catches_up_is_measured_again_by_the_audit(tmp_path: Path) -> None:
    rig = Rig(tmp_path, clock="realtime", more="[machine]\nwatch_delay = 0.3\nprocess_timeout = 60.0\n")
    try:
        rig.start_robot()
        rig.start()
        assert rig.deploy(rig.controller())["exit_code"] == 0
        rig.until(lambda: rig.status()["stream"]["n"] > 20)
        pid = rig.status()["pids"]["analytics"]
        os.kill(pid, signal.SIGSTOP)
        rig.until_status(analytics="down", gate="closed")
        os.kill(pid, signal.SIGCONT)
        rig.until_status(analytics="up")
        seen = rig.status()["stream"]["n"]
        rig.until(lambda: rig.status()["stream"]["n"] > seen + 10)
        assert rig.status()["pids"]["analytics"] == pid
        rig.stop()
        assert [(m.up, m.late) for m in rig.messages("event/analytics_changed") if isinstance(m, AnalyticsChanged)] == [
            (False, True),
            (True, True),
        ]
        found = json.loads(rig.s2r("audit", *map(str, rig.log_files()), "--key", str(rig.state / "key.pub"), "--json").stdout)
        assert (found["ok"], found["first_difference"]) == (True, None), found
    finally:
        rig.close()
