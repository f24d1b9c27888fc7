"""The link to a real robot process: found, frozen, gone, back, through a router, and left cleanly."""

from __future__ import annotations

import itertools
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
from s2r_zenoh.testing import INPUTS, STATES, ZenohRig, free_endpoint, session
from s2r_zenoh.transport import ZenohTransport

from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Command, LinkChanged, LogHead, Observation

PATIENCE_S = 15.0


@contextmanager
def robot(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """The stand-in as a process."""
    argv = [sys.executable, "-m", "s2r_standins.robotarium", "--parent", str(os.getpid()), *arguments]
    process = subprocess.Popen(argv, stdin=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        process.wait(PATIENCE_S)


class Runtime:
    """A loop like the daemon's that answers every observation with the same command."""

    def __init__(self, **options: Any) -> None:
        self.transport = ZenohTransport({"observation_timeout": 0.4, **options}, STATES, INPUTS)
        self.observations: list[Observation] = []
        self.links: list[LinkChanged] = []
        self.answering = True

    def __enter__(self) -> Runtime:
        self.transport.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.close()

    def turn(self) -> None:
        select.select([self.transport.fileno()], [], [], 0.02)
        for frame in self.transport.receive():
            for message in self.transport.decode(frame):
                if isinstance(message, LinkChanged):
                    self.links.append(message)
                elif isinstance(message, Observation) and not message.fault:
                    self.observations.append(message)
                    if self.answering:
                        k = len(self.observations)
                        command = Command(k, message.stamp_ns, "sampler", (0.1, 0.5), message.seq, 10**9)
                        self.transport.send(self.transport.encode(command))
        self.links += self.transport.poll(time.monotonic_ns())

    def until(self, ready: Any) -> bool:
        end = time.monotonic() + PATIENCE_S
        while not ready():
            if time.monotonic() > end:
                return False
            self.turn()
        return True

    def more(self, count: int = 50) -> bool:
        """Whether that many observations more come."""
        wanted = len(self.observations) + count
        return self.until(lambda: len(self.observations) >= wanted)

    @property
    def ups(self) -> list[bool]:
        return [link.up for link in self.links]


def rising(observations: list[Observation]) -> bool:
    return all(b.seq > a.seq and b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise(observations))


@pytest.mark.parametrize("first", ["robot", "runtime"])
def test_robot_and_runtime_find_each_other_whoever_comes_first(first: str) -> None:
    endpoint = free_endpoint()
    if first == "robot":
        with robot("--connect", endpoint):
            time.sleep(1.0)
            with Runtime(robot_listen=endpoint) as runtime:
                assert runtime.more()
    else:
        with Runtime(robot_listen=endpoint) as runtime:
            time.sleep(1.0)
            with robot("--connect", endpoint):
                assert runtime.more()


def test_frozen_robot_is_noticed_and_when_it_thaws_the_link_heals() -> None:
    endpoint = free_endpoint()
    with Runtime(robot_listen=endpoint) as runtime, robot("--connect", endpoint) as process:
        assert runtime.more()
        process.send_signal(signal.SIGSTOP)
        assert runtime.until(lambda: runtime.ups[-1:] == [False])
        assert "no observation for" in runtime.links[-1].detail
        for k in range(500):  # what is sent meanwhile must not be waited for, nor reach the robot later
            runtime.transport.send(runtime.transport.encode(Command(10**6 + k, 0, "sampler", (0.2, 0.0), 0, 10**9)))
        time.sleep(3.0)  # longer than the lease: the robot's session is given up and must be made again
        process.send_signal(signal.SIGCONT)
        assert runtime.until(lambda: runtime.ups[-1])
        assert runtime.more()
        assert rising(runtime.observations)


def test_robot_that_is_started_anew_goes_on_above_its_old_numbers() -> None:
    endpoint = free_endpoint()
    with Runtime(robot_listen=endpoint) as runtime:
        with robot("--connect", endpoint) as process:
            assert runtime.more()
            process.kill()
        with robot("--connect", endpoint):
            assert runtime.more()
        leaps = [b.stamp_ns - a.stamp_ns >= 10**9 for a, b in itertools.pairwise(runtime.observations)]
        assert leaps.count(True) == 1  # from the last of the old one, whenever that came
        assert rising(runtime.observations)
        assert runtime.ups[-1]
        assert False in runtime.ups


def test_runtime_that_is_started_anew_is_obeyed_by_the_robot_that_ran_on() -> None:
    endpoint = free_endpoint()
    with robot("--connect", endpoint):
        with Runtime(robot_listen=endpoint) as runtime:
            assert runtime.more()
        with Runtime(robot_listen=endpoint) as again:
            assert again.more()
    assert again.observations[0].seq >= runtime.observations[-1].seq


def test_robot_that_listens_is_found() -> None:
    endpoint = free_endpoint()
    with Runtime(robot_connect=endpoint) as runtime, robot("--listen", endpoint):
        assert runtime.more()


@pytest.mark.parametrize("option", ["--router", "--connect"])
def test_works_through_a_router_that_comes_late_and_restarts(option: str) -> None:
    endpoint = free_endpoint()
    with Runtime(robot_connect=endpoint) as runtime, robot(option, endpoint):
        for _ in range(2):
            with session("router", listen=endpoint):
                assert runtime.more()
            assert runtime.until(lambda: runtime.ups[-1:] == [False])


def test_lost_command_is_sent_again_when_the_robot_repeats_itself() -> None:
    with ZenohRig() as rig:
        rig.transport.open()
        runtime = Runtime(robot_listen=free_endpoint())
        runtime.transport = rig.transport
        end = time.monotonic() + PATIENCE_S
        while not rig.robot.heard and time.monotonic() < end:
            rig.robot.publish(1, 33_000_000, (0.0, 0.0, 0.0))
            runtime.turn()
        heard, answered = rig.robot.heard[-1], len(runtime.observations)
        rig.robot.heard.clear()
        while not rig.robot.heard and time.monotonic() < end:
            rig.robot.publish(1, 33_000_000, (0.0, 0.0, 0.0))
            runtime.turn()
        assert rig.robot.heard[0] == heard, "the same bytes again"
        assert len(runtime.observations) == answered == 1, "a repeat is no observation"
        assert rig.transport.counters()["resent"] >= 1


def test_robot_that_is_not_answered_waits_and_the_link_stays_up() -> None:
    endpoint = free_endpoint()
    with Runtime(robot_listen=endpoint) as runtime, robot("--connect", endpoint):
        assert runtime.more()
        runtime.answering = False
        runtime.more(1)
        count, ups, begin = len(runtime.observations), list(runtime.ups), time.monotonic()
        while time.monotonic() - begin < 1.2:
            runtime.turn()
        assert len(runtime.observations) == count
        assert (ups[-1], runtime.ups) == (True, ups)
        assert runtime.transport.counters()["repeated"] > 3


def test_robot_that_waits_in_lockstep_is_observed_again_after_the_link_was_lost() -> None:
    """It repeats what it said before the silence: without that observation nobody could ever command it again."""
    with ZenohRig() as rig:
        rig.transport.open()
        runtime = Runtime(robot_listen=free_endpoint())
        runtime.transport = rig.transport
        runtime.answering = False
        end = time.monotonic() + PATIENCE_S
        while not runtime.observations and time.monotonic() < end:
            rig.robot.publish(1, 33_000_000, (0.0, 0.0, 0.0))
            runtime.turn()
        while runtime.ups[-1:] != [False] and time.monotonic() < end:
            runtime.turn()
        seen = len(runtime.observations)
        while (runtime.ups[-1:] != [True] or len(runtime.observations) == seen) and time.monotonic() < end:
            rig.robot.publish(1, 33_000_000, (0.0, 0.0, 0.0))
            runtime.turn()
        assert runtime.ups[:2] == [True, False]
        (again,) = runtime.observations[seen:]
        assert (again.x, again.fault) == ((0.0, 0.0, 0.0), "")
        assert rising(runtime.observations)


def test_endpoint_that_is_taken_is_one_clear_line() -> None:
    endpoint = free_endpoint()
    with session("peer", listen=endpoint), pytest.raises(ConfigError, match=f"robot_listen '{endpoint}'"):
        ZenohTransport({"robot_listen": endpoint}, STATES, INPUTS).open()


PROGRAM = """
import sys
from s2r_zenoh.transport import ZenohTransport
t = ZenohTransport({"robot_listen": sys.argv[1], "controller_listen": sys.argv[2]}, ("x",), ("v",))
try:
    t.open()
    print("open", flush=True)
    if sys.argv[3] == "raise":
        raise SystemExit(3)
finally:
    t.close()
"""


@pytest.mark.parametrize("how", ["return", "raise"])
def test_process_ends_when_it_is_done(how: str) -> None:
    """With a robot linked: a session left open keeps its process from ending."""
    endpoint = free_endpoint()
    with robot("--connect", endpoint):
        done = subprocess.run([sys.executable, "-c", PROGRAM, endpoint, free_endpoint(), how], timeout=PATIENCE_S, check=False)
    assert done.returncode == (3 if how == "raise" else 0)


def test_robot_that_freezes_does_not_hold_up_the_end() -> None:
    endpoint = free_endpoint()
    with robot("--connect", endpoint) as process:
        runtime = Runtime(robot_listen=endpoint)
        with runtime:
            assert runtime.more()
            process.send_signal(signal.SIGSTOP)
            begin = time.monotonic()
        assert time.monotonic() - begin < PATIENCE_S


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "needs robot_listen or robot_connect"),
        ({"robot_listen": "127.0.0.1:7461"}, "robot_listen is '127.0.0.1:7461', must be an endpoint such as tcp/127.0.0.1:7461"),
        ({"robot_listen": 7461}, "robot_listen is 7461, must be text"),
        (
            {"robot_listen": "tcp/127.0.0.1:1", "robot_lisen": "x"},
            "robot_lisen is not an option of the zenoh transport; did you mean 'robot_listen'",
        ),
        ({"robot_listen": "tcp/127.0.0.1:1", "lease": 0.0}, "lease is 0.0, must be > 0 s"),
        ({"robot_listen": "tcp/127.0.0.1:1", "queue": 0}, "queue is 0, must be >= 1"),
        ({"robot_listen": "tcp/127.0.0.1:1", "queue": True}, "queue is True, must be a whole number"),
        ({"robot_listen": "tcp/127.0.0.1:1", "key_prefix": "s2r/**"}, "without wildcards"),
        ({"robot_connect": "tcp/h:1", "controller_connect": "tcp/h:1"}, "robot and controllers share tcp/h:1"),
        ({"robot_listen": "tcp/h:1", "controller_listen": "tcp/h:1"}, "robot and controllers share tcp/h:1"),
    ],
)
def test_bad_option_is_refused_with_what_would_be_right(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says.replace("(", r"\(").replace("*", r"\*")):
        ZenohTransport(options, STATES, INPUTS)


def test_bad_configuration_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    options = {"robot_listen": free_endpoint(), "robot_config": str(path)}
    with pytest.raises(ConfigError, match=r"zenoh\.json5"):
        ZenohTransport(options, STATES, INPUTS).open()
    path.write_text("{mode: ", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"zenoh\.json5"):
        ZenohTransport(options, STATES, INPUTS).open()


def test_the_logs_head_reaches_the_robots_side_and_the_others() -> None:
    rig, head = ZenohRig(), LogHead("run", 1, 12, "ab" * 32, "cd" * 32)
    rig.transport.open()
    with rig, session("client", connect=rig.others) as other:
        heard: dict[str, list[bytes]] = {"robot": [], "others": []}
        other.declare_subscriber("s2r/robot/log_head", lambda sample: heard["others"].append(sample.payload.to_bytes()))
        with session("client", connect=rig.endpoint) as robot_side:
            robot_side.declare_subscriber("s2r/robot/log_head", lambda sample: heard["robot"].append(sample.payload.to_bytes()))
            deadline = time.monotonic() + PATIENCE_S
            while not all(heard.values()) and time.monotonic() < deadline:
                rig.transport.anchor(head)
                time.sleep(0.05)
    assert all(heard.values())
    assert {msgspec.json.decode(data, type=LogHead) for said in heard.values() for data in said} == {head}
