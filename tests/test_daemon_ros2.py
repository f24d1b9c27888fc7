"""The daemon with the stand-in robot over Zenoh, as ROS 2 speaks it: the whole loop, robots that fall silent, commands of others."""

from __future__ import annotations

import contextlib
import itertools
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from ros2_rig import Ros2Rig

from s2r_runtime.messages import Decided, LinkChanged, Observed, Proposed, Send

pytest.importorskip("s2r_ros2")

from s2r_ros2.payloads import encode_twist_stamped
from s2r_ros2.testing import Node


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Ros2Rig]:
    opened = Ros2Rig(tmp_path)
    yield opened
    opened.close()


@pytest.mark.slow
def test_campaign_certificate_drive_and_audit_over_ros2(rig: Ros2Rig) -> None:
    rig.start_robot("--eager")
    rig.start()
    assert rig.sample()["exit_code"] == 0
    answer = rig.ask("deploy", path=str(rig.law()))
    assert answer["exit_code"] == 0, answer
    rig.until(lambda: rig.status()["scenarios"] >= 1)
    counters = rig.status()["counters"]
    assert rig.stop() == 0
    assert counters["received"] > 500
    assert counters["malformed"] == 0, counters
    missed = sum(counters[name] for name in ("dropped_in", "dropped_out", "lost", "old"))
    assert missed <= counters["received"] / 100, counters  # a busy machine may lose some: nothing here waits for a slow reader
    assert {m.source for m in rig.messages("out/send") if isinstance(m, Send)} == {"recovery", "sampler", "controller"}
    (log,) = rig.log_files()
    rig.profile.unlink()  # the log has all that is needed
    found = json.loads(rig.s2r("audit", str(log), "--key", str(rig.state / "key.pub"), "--rerun-controllers", "--json").stdout)
    assert (found["ok"], found["first_difference"], found["chain"]) == (True, None, "intact"), found
    assert [certificate["valid"] for certificate in found["certificates"]]


def test_campaign_outlives_a_robot_that_falls_silent_starts_anew_and_sets_its_clock(tmp_path: Path) -> None:
    """And nobody else gets to command it: not from the controllers' side, and from its own side only with the gate closed."""
    with contextlib.closing(Ros2Rig(tmp_path, "rmw", "twist_stamped", 0.25)) as rig:
        survive(rig)


def survive(rig: Ros2Rig) -> None:
    rig.start_robot("--lose", "0.02")
    rig.start()
    rig.until(lambda: rig.status()["observation"])
    rig.ask("permit", duration_s=3600.0)
    campaign = subprocess.Popen(
        [sys.executable, "-m", "s2r_runtime.cli.main", "sample", str(rig.profile), "--socket", str(rig.socket), "--json"],
        stdout=subprocess.PIPE,
        env=rig.environment,
    )
    for wanted, line in ((1, "silent 0.8"), (2, "reboot 0.7"), (3, "clock -30")):
        rig.until(lambda n=wanted: (rig.status()["campaign"] or {}).get("taken", 0) >= n)
        rig.tell(line)
        if line.startswith("clock"):
            rig.until(lambda: rig.status()["counters"]["restarts"])
        else:
            rig.until_status(link=False)
        rig.until_status(link=True)
    out, _ = campaign.communicate(timeout=90.0)
    answer = json.loads(out)
    assert answer["exit_code"] == 0, answer
    proposed(rig)
    stopped(rig)
    counters = rig.status()["counters"]
    rig.stop()
    assert counters["lost"] > 0
    assert counters["restarts"] >= 1
    assert counters["malformed"] == counters["dropped_out"] == 0
    assert [m.up for m in rig.messages("event/link_changed") if isinstance(m, LinkChanged)].count(False) >= 3
    good = [m.observation for m in rig.messages("event/observed") if isinstance(m, Observed) and not m.observation.fault]
    assert all(b.stamp_ns > a.stamp_ns and b.seq > a.seq for a, b in itertools.pairwise(good))
    assert all(abs(b.x[0] - a.x[0]) < 0.05 for a, b in itertools.pairwise(good) if b.seq - a.seq == 1)
    decided = [m for m in rig.messages("out/decided") if isinstance(m, Decided) and m.source == "external"]
    assert {(m.allow, m.reason) for m in decided} == {(False, "source_not_allowed")}
    assert {m.source for m in rig.messages("out/send") if isinstance(m, Send)} == {"recovery", "sampler"}
    (log,) = rig.log_files()
    found = json.loads(rig.s2r("audit", str(log), "--key", str(rig.state / "key.pub"), "--json").stdout)
    assert (found["ok"], found["first_difference"]) == (True, None), found


def proposed(rig: Ros2Rig) -> None:
    """Somebody's Nav2 on the controllers' side."""
    node = Node(rig.layout, "odometry", rig.command, connect=rig.far, gid=b"a navigator's id")
    with contextlib.closing(node):
        before = rig.status()["observation"]["x"]

        def propose() -> bool:
            for _ in range(10):
                node.put(node.command_key, encode_twist_stamped(1, "base_link", (0.2, 0.0, 0.0, 0.0, 0.0, 2.0)))
                time.sleep(0.01)
            return bool(rig.status()["counters"]["proposals"] >= 50)

        rig.until(propose)
        after = rig.status()["observation"]["x"]
    assert abs(_first(after) - _first(before)) < 0.05, "the robot hears nobody there"
    assert "manual_override" not in rig.status()["reason"]
    uninvited = [m.command for m in rig.messages("event/proposed") if isinstance(m, Proposed) and m.command.source == "external"]
    assert uninvited[0].u == (0.2, 2.0)


def stopped(rig: Ros2Rig) -> None:
    """The robot's button, and another node that commands it on its own side."""
    rig.tell("emergency_stop")
    rig.until(lambda: "emergency_stop" in rig.status()["reason"])
    rig.tell("release")
    node = Node(rig.layout, "odometry", rig.command, connect=rig.near, gid=b"a joystick's id!")
    with contextlib.closing(node):
        rig.until(lambda: node.put(node.command_key, b"anything") or bool(rig.messages_of_overrides() & {"manual_override"}))


def _first(x: object) -> float:
    return float(x["x"] if isinstance(x, dict) else x[0])  # type: ignore[index]


@pytest.mark.slow
def test_flood_of_nonsense_on_the_pose_topic_holds_the_loop_no_longer_than_it_may_and_latches(rig: Ros2Rig) -> None:
    """By another publisher on the robot's side, up to the longest message. Nothing is driven until a person clears it."""
    rig.start_robot()
    rig.start("--held", str(rig.folder / "held"))
    rig.until(lambda: (seen := rig.status()["observation"]) and not seen["fault"])
    stranger = Node(rig.layout, "odometry", "twist", connect=rig.near)
    try:
        end = time.monotonic() + 3.0
        while time.monotonic() < end:
            for size in (0, 700, 300_000):
                stranger.session.put(stranger.pose_key, bytes(size))
            time.sleep(0.001)
        rig.until(lambda: "observation_faults" in rig.status()["latched"])
    finally:
        stranger.close()
    seq = rig.status()["observation"]["seq"]
    rig.until(lambda: rig.status()["observation"]["seq"] > seq + 5)
    assert rig.status()["gate"] == "closed"
    assert rig.stop() == 0
    assert max(json.loads((rig.folder / "held").read_text()).values()) < 0.02
