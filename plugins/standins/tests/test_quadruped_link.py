"""The quadruped as a process over real Zenoh, spoken to as docs/zenoh.md says."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from contextlib import AbstractContextManager
from typing import Any

import pytest
import standin_talk
from s2r_zenoh.transport import ZenohTransport
from standin_talk import PATIENCE_S, Talk, drive

from s2r_runtime.messages import Frame, Observation, OverrideChanged

pytest.importorskip("mujoco")
from s2r_standins.quadruped_body import Quadruped
from s2r_standins.quadruped_sheet import QuadrupedSheet

QUIET = ("--sigma-position", "0", "--sigma-heading", "0")


def talk(*arguments: str) -> AbstractContextManager[Talk]:
    return standin_talk.talk("quadruped", *arguments)


def decoded(channel: str, *frames: dict[str, Any]) -> list[Any]:
    """What the runtime's transport makes of them."""
    transport = ZenohTransport({"robot_listen": "tcp/127.0.0.1:1"}, ("x", "y", "theta"), ("v", "w"))
    return [event for i, frame in enumerate(frames) for event in transport.decode(Frame(i, channel, json.dumps(frame).encode()))]


def pose(seen: dict[str, Any]) -> tuple[float, float, float]:
    return seen["state"]["x"], seen["state"]["y"], seen["state"]["theta"]


def test_lockstep_walks_as_in_process_whatever_the_timing_and_says_so_while_it_waits() -> None:
    effect = "weak_leg leg=rear_right strength=0.6"
    with talk("--seed", "5", "--start", "0.5", "-0.2", "1.0", "--effect", effect) as t:
        assert t.reply() == {"t": 0.0, "done": f"effect {effect}"}
        seen = drive(t, 8, 0.12, 0.2)
        time.sleep(0.3)
        repeat = json.loads(t.inbox.get(timeout=PATIENCE_S))
        assert repeat == seen[-1], "nobody answers: nothing moves"
        seen += drive_on(t, seen[-1], 4, -0.1, 0.0)
    assert [o["seq"] for o in seen] == list(range(13))
    assert [o["stamp_ns"] for o in seen] == [100_000_000 * k for k in range(13)]
    robot = Quadruped(QuadrupedSheet(), (0.5, -0.2, 1.0), seed=5)
    robot.switch_on(effect)
    expected = [robot.observe()]
    for k in range(12):
        robot.step(*((0.12, 0.2) if k < 8 else (-0.1, 0.0)), 0.1)
        expected.append(robot.observe())
    assert [pose(o) for o in seen] == expected, "the same robot, to the bit"
    good = [event for event in decoded("observation", *seen) if isinstance(event, Observation)]
    assert [event.fault for event in good] == [""] * 13


def drive_on(t: Talk, last: dict[str, Any], periods: int, v: float, w: float) -> list[dict[str, Any]]:
    """Answers the last observation and those that follow."""
    seen = [last]
    for _ in range(periods):
        t.command(seen[-1], v, w)
        seen.append(t.observe())
    return seen[1:]


def test_realtime_robot_keeps_time_and_stands_when_nobody_commands_it() -> None:
    with talk(*QUIET, "--realtime") as t:
        seen = drive(t, 8, 0.15, 0.0)
        # the last command lives 0.1 s; then a stride is ended, and it stands
        for _ in range(12):
            seen.append(t.observe())
        at = pose(seen[-1])
        for _ in range(4):
            seen.append(t.observe())
        assert all(o["stamp_ns"] == 100_000_000 * o["seq"] for o in seen)
        assert at[0] > 0.01
        assert math.dist(pose(seen[-1]), at) < 1e-3


def test_fall_presses_the_red_button_once_and_leaves_no_observation_that_passes_for_one() -> None:
    limp = [word for leg in ("rear_left", "rear_right") for word in ("--effect", f"weak_leg leg={leg} strength=0 @0.2")]
    with talk(*limp) as t:
        seen = drive(t, 20, 0.1, 0.0)
        button = json.loads(t.overrides.get(timeout=PATIENCE_S))
        assert t.overrides.empty()
        told = [t.reply() for _ in range(3)]
        t.say("clear")
        t.command(seen[-1], 0.1, 0.0)
        after = t.observe()
    assert button["kind"] == "emergency_stop"
    assert button["detail"].startswith("fell: trunk at 0.")
    assert told[2]["trouble"] == button["detail"]
    fell = next(i for i, o in enumerate(seen) if not o["state"])
    assert 2 < fell < 20
    for o in [*seen[fell:], after]:
        assert o["state"] == {}
        assert o["trouble"] == button["detail"]
    faults = [e.fault for e in decoded("observation", *seen, after) if isinstance(e, Observation)]
    assert faults[:fell] == [""] * fell
    assert all("state lacks" in fault for fault in faults[fell:])
    assert [type(e) for e in decoded("override", button)] == [OverrideChanged]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--start", "0", "nan", "0"], "--start: must be finite"),
        (["--lose-commands", "1"], "--lose-commands: must be in [0, 1)"),
        (["--effect", "payload mass=heavy"], "mass must be a number from 0 to 10 kg"),
    ],
)
def test_bad_setting_is_one_clear_line(arguments: list[str], says: str) -> None:
    argv = [sys.executable, "-m", "s2r_standins.quadruped", *arguments]
    done = subprocess.run(argv, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=PATIENCE_S, check=False)
    assert done.returncode == 78
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
