"""The robot as a process, spoken to as docs/zenoh.md says, without this project's transport."""

from __future__ import annotations

import itertools
import json
import signal
import subprocess
import sys
import time
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
import standin_talk
from s2r_standins.robotarium import ROBOT
from standin_talk import PATIENCE_S, Talk, drive

from s2r_runtime.errors import ConfigError
from s2r_runtime.profile import parse_profile

QUIET = ("--sigma-position", "0", "--sigma-heading", "0")


def talk(*arguments: str) -> AbstractContextManager[Talk]:
    return standin_talk.talk("robotarium", *arguments)


def test_lockstep_moves_one_period_for_each_answer_and_repeats_itself_while_it_waits() -> None:
    with talk(*QUIET, "--latency", "0", "--start", "0.5", "0.2", "0") as t:
        seen = drive(t, 5, 0.1, 0.0)
        assert [o["seq"] for o in seen] == list(range(6))
        assert [o["stamp_ns"] for o in seen] == [33_000_000 * k for k in range(6)]
        assert [o["state"]["x"] for o in seen] == pytest.approx([0.5 + 0.0033 * k for k in range(6)])
        repeat = t.inbox.get(timeout=PATIENCE_S)
        assert json.loads(repeat) == seen[-1]
        t.command({"seq": 3, "stamp_ns": 10**9}, 0.1, 0.0)  # answers what is long past
        assert json.loads(t.inbox.get(timeout=PATIENCE_S)) == seen[-1]


def test_one_seed_gives_one_story_whatever_the_timing() -> None:
    stories = []
    for pause in (0.0, 0.25):
        with talk("--seed", "5", "--lose-observations", "0.2", "--lose-commands", "0.1") as t:
            story = drive(t, 10, 0.1, 0.4)
            time.sleep(pause)
            t.command(story[-1], 0.1, -0.4)
            story.append(t.observe())
            stories.append([(o["seq"], o["state"]) for o in story])
    assert stories[0] == stories[1]
    assert stories[0][-1][0] > 11, "some observations were lost"


def test_lost_command_leaves_the_last_one_in_force_until_its_time_to_live_is_over() -> None:
    with talk(*QUIET, "--latency", "0", "--seed", "3", "--lose-observations", "0.6") as t:
        seen = drive(t, 12, 0.2, 0.0)
        for before, after in itertools.pairwise(seen):
            # answered once, then on its own for the other periods: moving until 100 ms are over, the answered period included
            periods = after["seq"] - before["seq"]
            assert after["state"]["x"] - before["state"]["x"] == pytest.approx(0.0066 * min(periods, 4))
        assert max(b["seq"] - a["seq"] for a, b in itertools.pairwise(seen)) > 4


def test_realtime_robot_keeps_time_and_stops_when_nobody_commands_it() -> None:
    with talk(*QUIET, "--latency", "0", "--realtime") as t:
        seen = drive(t, 10, 0.2, 0.0)
        moved = seen[-1]["state"]["x"]
        assert moved > 0.0
        silent = [t.observe() for _ in range(12)]
        assert silent[-1]["seq"] > silent[0]["seq"]
        # the last command lives 100 ms: after 4 more periods at the latest, and one on its way, nothing moves
        assert silent[-1]["state"]["x"] == silent[6]["state"]["x"]
        assert [o["stamp_ns"] for o in silent] == [33_000_000 * o["seq"] for o in silent]


def test_effect_from_the_start_at_a_time_and_from_stdin_begin_when_they_are_told_to() -> None:
    with talk(*QUIET, "--latency", "0", "--effect", "input_gain:w gain=0.5", "--effect", "input_gain:v gain=0 @0.066") as t:
        assert t.reply() == {"t": 0.0, "done": "effect input_gain:w gain=0.5"}
        seen = drive(t, 4, 0.1, 1.0)
        turned = [b["state"]["theta"] - a["state"]["theta"] for a, b in itertools.pairwise(seen)]
        assert turned == pytest.approx([0.0165] * 4)
        assert seen[2]["state"]["x"] > seen[1]["state"]["x"]
        assert seen[3]["state"] == {**seen[2]["state"], "theta": seen[3]["state"]["theta"]}, "the second one stops it at 0.066 s"
        assert t.reply()["t"] == 0.066
        t.say("clear @+0.066")
        t.say("effect nonsense @1")
        assert "nonsense" in t.reply()["error"]
        t.say("effect input_gain:w gain=2 @+zero")
        assert "seconds" in t.reply()["error"]
        t.command(seen[-1], 0.1, 1.0)
        more = [t.observe()]
        for _ in range(3):
            t.command(more[-1], 0.1, 1.0)
            more.append(t.observe())
        assert t.reply() == {"t": 0.198, "done": "clear"}
        turned = [b["state"]["theta"] - a["state"]["theta"] for a, b in zip([seen[-1], *more], more, strict=False)]
        assert turned == pytest.approx([0.0165, 0.0165, 0.033, 0.033])


def test_bad_commands_are_ignored_and_so_are_old_ones() -> None:
    with talk(*QUIET, "--latency", "0") as t:
        seen = drive(t, 3, 0.1, 0.0)[-1]
        for bad in (b"", b"garbage", b"[" * 50_000, b'{"seq":1}', b'{"seq":9,"t_ns":9,"obs_seq":3,"ttl_ns":1,"input":{"v":0.1}}'):
            t.session.put("s2r/robot/command", bad)
            time.sleep(0.05)
        t.session.put("s2r/robot/command", json.dumps({"seq": 1, "t_ns": 0, "obs_seq": 3, "ttl_ns": 10**8, "input": {"v": 0.2, "w": 0.0}}))
        time.sleep(0.3)
        t.command(seen, 0.0, 0.0)
        assert t.observe()["state"] == seen["state"], "none of them moved it"


def test_red_button_quit_and_end_of_stdin() -> None:
    with talk() as t:
        t.observe()
        t.say("emergency_stop")
        assert json.loads(t.overrides.get(timeout=PATIENCE_S)) == {"kind": "emergency_stop", "detail": "the robot's button"}
        t.say("quit")
        assert t.process.wait(PATIENCE_S) == 0
    with talk() as t:
        assert t.process.stdin is not None
        t.process.stdin.close()
        t.process.stdin = None
        drive(t, 3, 0.0, 0.0)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("clock", ["--lockstep", "--realtime"])
def test_signal_ends_it_cleanly(number: signal.Signals, clock: str) -> None:
    with talk(clock) as t:
        t.observe()
        t.process.send_signal(number)
        assert t.process.wait(PATIENCE_S) == 0


def test_it_does_not_outlive_who_started_it() -> None:
    code = (
        "import os, subprocess; from s2r_standins.robotarium import ROBOT;"
        "p = subprocess.Popen(ROBOT.command(1, [], connect='tcp/127.0.0.1:1'), stdin=subprocess.PIPE); print(p.pid, flush=True);"
        "import time; time.sleep(1); os.kill(os.getpid(), 9)"
    )
    parent = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=False)
    pid, end = int(parent.stdout), time.monotonic() + PATIENCE_S
    while time.monotonic() < end and _alive(pid):
        time.sleep(0.05)
    assert not _alive(pid)


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").split()[2] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--period", "-1"], "--period: must be > 0 s"),
        (["--lose-commands", "1"], "--lose-commands: must be in [0, 1)"),
        (["--effect", "nonsense"], "unknown effect 'nonsense'"),
        (["--effect", "input_gain:w gain=1 @soon"], "must be a number of seconds"),
        (["--connect", "nowhere"], "endpoint nowhere"),
    ],
)
def test_bad_setting_is_one_clear_line(arguments: list[str], says: str) -> None:
    argv = [sys.executable, "-m", "s2r_standins.robotarium", *arguments]
    done = subprocess.run(argv, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=PATIENCE_S, check=False)
    assert done.returncode == 78
    assert says in done.stderr
    assert done.stderr.count("\n") == 1


def test_demo_gets_a_profile_with_its_endpoints_and_a_controller() -> None:
    text = ROBOT.profile_text("tcp/127.0.0.1:1001", "tcp/127.0.0.1:1002")
    profile = parse_profile(text, "robotarium.toml", ROBOT.controller("good").parent)
    assert profile.transport["robot_listen"] == "tcp/127.0.0.1:1001"
    assert profile.transport["controller_listen"] == "tcp/127.0.0.1:1002"
    assert ROBOT.controller("good").is_file()
    with pytest.raises(ConfigError, match="there are: good"):
        ROBOT.controller("heroic")
