"""A robot that starts anew, with stamps that go on, while it is driven and while it is sampled: nothing is measured across that."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Rig

from s2r_runtime.messages import LinkChanged, Measured, Observed, SampleTaken


@pytest.fixture
def rig(tmp_path: Path) -> Any:
    rig = Rig(tmp_path)
    yield rig
    rig.close()


def restart_robot(rig: Rig) -> None:
    """Its commands under way are gone; its numbers and stamps are later than any before."""
    assert rig.robot is not None
    rig.robot.kill()
    rig.robot.wait()
    since = rig.applied()[-1]["at"] + 5
    rig.start_robot("--since", str(since))
    rig.until(lambda: rig.applied()[-1]["at"] > since + 10)


def restarts(rig: Rig) -> int:
    return sum(not m.up and m.detail == "the robot started anew" for m in rig.messages("event/link_changed") if isinstance(m, LinkChanged))


def audited(rig: Rig) -> dict[str, Any]:
    said = rig.s2r("audit", *map(str, rig.log_files()), "--key", str(rig.state / "key.pub"), "--json")
    return dict(json.loads(said.stdout))


@pytest.mark.slow
def test_commands_from_before_a_robots_restart_do_not_make_the_gap_grow(rig: Rig) -> None:
    """Each leaves one period of motion in the model's delay line: 5 mm, beside a radius of 2 mm."""
    path = rig.controller("    return np.tile([0.15, 1.0], (len(x), 1))\n")
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    certificate = rig.certificate(path, radius=0.002, verified=0.02)
    assert rig.ask("deploy", path=str(path), certificate=certificate)["exit_code"] == 0
    for _ in range(3):
        seen = rig.until_status(gate="open", driving="controller")["stream"]["n"]
        rig.until(lambda seen=seen: rig.status()["stream"]["n"] > seen + 30)
        restart_robot(rig)
    seen = rig.until_status(gate="open")["stream"]["n"]
    rig.until(lambda: rig.status()["stream"]["n"] > seen + 30)
    assert rig.status()["radius"] == 0.002
    rig.stop()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    assert rig.ask("deploy", path=str(path))["exit_code"] == 0
    seen = rig.status()["stream"]["n"]
    rig.until(lambda: rig.status()["stream"]["n"] > seen + 30)
    assert rig.status()["radius"] == 0.002, "nor do those from before the daemon's own"
    rig.stop()
    assert restarts(rig) == 3
    assert max(m.discrepancy for m in rig.messages("event/measured") if isinstance(m, Measured)) < 0.002
    found = audited(rig)
    assert (found["ok"], found["first_difference"]) == (True, None), found


LATENCY = 12
"""Periods: 0.4 s, four times the hysteresis of the gate."""


def fall_silent(rig: Rig) -> None:
    """It is not heard for longer than the link allows, and goes on with all commands in transit."""
    assert rig.robot is not None
    rig.robot.send_signal(signal.SIGSTOP)
    rig.until_status(reason="link_down")
    rig.robot.send_signal(signal.SIGCONT)


@pytest.mark.parametrize("event", [fall_silent, restart_robot], ids=["link lost", "robot restarted"])
def test_a_delay_longer_than_the_hysteresis_makes_no_gap_grow_over_a_break(rig: Rig, event: Callable[[Rig], None]) -> None:
    """Whether commands from before it still act is unknown: nothing is measured until it cannot matter."""
    rig.profile.write_text(rig.profile.read_text().replace("delay = 0.033", f"delay = {0.033 * LATENCY:.3f}"))
    path = rig.controller("    return np.tile([0.15, 1.0], (len(x), 1))\n")
    latency = ("--latency", str(LATENCY))
    rig.start_robot(*latency)
    start, rig.start_robot = rig.start_robot, lambda *options: start(*latency, *options)  # type: ignore[method-assign]
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    certificate = rig.certificate(path, radius=0.002, verified=0.02)
    assert rig.ask("deploy", path=str(path), certificate=certificate)["exit_code"] == 0
    for _ in range(3):
        seen = rig.until_status(gate="open", driving="controller")["stream"]["n"]
        rig.until(lambda seen=seen: rig.status()["stream"]["n"] > seen + 30)
        event(rig)
    seen = rig.until_status(gate="open")["stream"]["n"]
    rig.until(lambda: rig.status()["stream"]["n"] > seen + 30)
    assert rig.status()["radius"] == 0.002
    rig.stop()
    assert max(m.discrepancy for m in rig.messages("event/measured") if isinstance(m, Measured)) < 0.002
    found = audited(rig)
    assert (found["ok"], found["first_difference"]) == (True, None), found


@pytest.mark.slow
def test_no_sample_spans_a_robots_restart(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    answer = rig.background("sample", count=60)
    for taken in (1, 3):
        rig.until(lambda taken=taken: ((s := rig.status())["campaign"] or {"taken": 0})["taken"] >= taken and s["phase"] == "hold")
        restart_robot(rig)
    assert answer()["exit_code"] in (0, 1)
    rig.stop()
    entries = rig.messages("event/observed", "event/link_changed", "event/sample_taken")
    at = [m.t_ns for m in entries if isinstance(m, LinkChanged) and not m.up]
    samples = [m for m in entries if isinstance(m, SampleTaken)]
    assert samples
    spans = [(s.start_ns - sum(s.past_ns), s.start_ns + s.hold_ns) for s in samples]
    first_after = [min(m.observation.stamp_ns for m in entries if isinstance(m, Observed) and m.t_ns > t) for t in at]
    assert first_after
    assert not [(a, b, t) for a, b in spans for t in first_after if a < t <= b]
    found = audited(rig)
    assert (found["ok"], found["first_difference"]) == (True, None), found
