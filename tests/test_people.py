"""A person who stops a command, or is gone, stops the robot: real processes and signals, the built-in robot over Zenoh on loopback."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from zenoh_rig import ZenohRig

pytest.importorskip("s2r_zenoh")
pytest.importorskip("s2r_standins")

STOPPED_WITHIN_S = 0.5
"""From the moment that a person is gone to the stop, as docs/operating.md says; on an idle machine it is some 10 ms."""
LEADS_A_TERMINAL = "import fcntl, os, sys, termios; os.setsid(); fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
"""What a shell is to its terminal, then the command: so the kernel tells it when the terminal closes."""
LOADED_S = 5.0
"""Added on a machine that is busy with other things."""


class PeopleRig(ZenohRig):
    """As `ZenohRig`, in real time, with a robot that notes what reaches it, and commands of a person beside it."""

    def start_robot(self, *options: str) -> None:
        told = {"kind": "zenoh", "endpoint": self.endpoint}
        argv = [sys.executable, str(Path(__file__).parent / "rigs" / "link_robot.py"), str(self.folder), json.dumps(told), *options]
        with (self.folder / "robot.txt").open("ab") as sink:
            self.robot = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=sink, stderr=sink)

    def command(self, *verb: str, **options: Any) -> subprocess.Popen[bytes]:
        """A verb of the command line, under way."""
        argv = [sys.executable, "-m", "s2r_runtime.cli.main", *verb, "--socket", str(self.socket)]
        return subprocess.Popen(argv, **{"stdin": subprocess.DEVNULL, "env": self.environment, "cwd": self.folder, **options})

    def sampling(self, least: int = 1) -> None:
        """Waits until the campaign has samples, and the robot is driven."""
        begin = time.monotonic()
        self.until(lambda: (self.status()["campaign"] or {}).get("taken", 0) >= least)
        self.until(lambda: any(self.applied()[-1]["u"]) and self.applied()[-1]["at"] > begin)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PeopleRig]:
    """One daemon for all of them: a campaign that was stopped goes on in the next test."""
    opened = PeopleRig(tmp_path_factory.mktemp("people"))
    text = opened.profile.read_text().replace("epsilon = 0.3\nbeta = 0.5", "epsilon = 0.01\nbeta = 0.05", 1)
    text = text.replace("observation_timeout = 0.5", "observation_timeout = 10.0")  # a busy machine is no reason to refuse a campaign
    opened.profile.write_text(text.replace('clock = "lockstep"', 'clock = "realtime"'))
    opened.start()
    opened.start_robot()
    opened.until(lambda: opened.status()["observation"])
    opened.ask("permit", duration_s=3600.0)
    yield opened
    opened.close()
    if opened.robot is not None and opened.robot.stdin is not None:
        opened.robot.stdin.close()


def stopped(rig: PeopleRig, gone: float) -> dict[str, Any]:
    """The status once the campaign is stopped and kept. gone: when its person was gone, by the monotonic clock, s."""
    found = rig.until_status(campaign=None, unfinished_epoch=1, driving="recovery")
    rig.until(lambda: not any(rig.applied()[-1]["u"]) and rig.applied()[-1]["at"] > gone)
    last = max((one["at"] for one in rig.applied() if any(one["u"])), default=gone)
    assert last - gone <= STOPPED_WITHIN_S + LOADED_S * (os.getloadavg()[0] > (os.cpu_count() or 1)), (
        f"it was driven for {last - gone:.3f} s"
    )
    assert (found["epoch"], found["permit_left_s"] > 0.0) == (1, True)
    print(f"last moving command {1e3 * (last - gone):.0f} ms after its person was gone")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP])
def test_a_signal_to_the_command_stops_the_robot_keeps_the_campaign_and_says_how_it_goes_on(rig: PeopleRig, number: signal.Signals) -> None:
    command = rig.command("sample", str(rig.profile), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    rig.sampling()
    gone = time.monotonic()
    command.send_signal(number)
    out, err = command.communicate(timeout=10.0)
    assert (command.returncode, out) == (128 + number, b"")
    assert b"interrupted: campaign of epoch 1 stopped after" in err
    assert f"({number.name})" in err.decode() or number.name in err.decode()
    assert b"s2r sample goes on with it" in err
    stopped(rig, gone)


@pytest.mark.slow
def test_a_command_that_is_killed_stops_the_robot(rig: PeopleRig) -> None:
    command = rig.command("sample", str(rig.profile))
    rig.sampling()
    gone = time.monotonic()
    command.kill()
    command.wait()
    stopped(rig, gone)


@pytest.mark.slow
def test_a_terminal_that_closes_stops_the_robot(rig: PeopleRig) -> None:
    terminal, side = os.openpty()
    argv = [
        sys.executable,
        "-c",
        LEADS_A_TERMINAL,
        sys.executable,
        "-m",
        "s2r_runtime.cli.main",
        "sample",
        str(rig.profile),
        "--socket",
        str(rig.socket),
    ]
    command = subprocess.Popen(argv, stdin=side, stdout=side, stderr=side, env=rig.environment)
    os.close(side)
    rig.sampling()
    gone = time.monotonic()
    os.close(terminal)
    stopped(rig, gone)
    assert command.wait(10.0) == 128 + signal.SIGHUP


def _reader_gone(rig: PeopleRig) -> float:
    """As `| tee` that is killed."""
    reading, writing = os.pipe()
    command = rig.command("sample", str(rig.profile), stdout=writing)
    os.close(writing)
    rig.sampling()
    gone = time.monotonic()
    os.close(reading)
    assert command.wait(10.0) == 128 + signal.SIGHUP
    return gone


def _ssh_without_terminal(rig: PeopleRig) -> float:
    """sshd gives a command without a terminal the ends of socket pairs, and closes its own when the connection drops."""
    import socket

    ours, theirs = socket.socketpair()
    with ours, theirs, (rig.folder / "daemon.txt").open("ab") as sink:
        command = rig.command("sample", str(rig.profile), stdin=theirs, stdout=subprocess.DEVNULL, stderr=sink)
        theirs.close()
        rig.sampling()
        ours.shutdown(socket.SHUT_WR)  # the end of its input is no reason
        time.sleep(0.2)
        assert command.poll() is None
        gone = time.monotonic()
    assert command.wait(10.0) == 128 + signal.SIGHUP
    return gone


@pytest.mark.slow
@pytest.mark.parametrize("leave", [_reader_gone, _ssh_without_terminal])
def test_streams_that_nobody_is_at_stop_the_robot(rig: PeopleRig, leave: Callable[[PeopleRig], float]) -> None:
    stopped(rig, leave(rig))


@pytest.mark.slow
def test_a_detached_campaign_goes_on_until_it_is_paused_and_under_nohup_too(rig: PeopleRig) -> None:
    done = rig.s2r("sample", str(rig.profile), "--detach")
    assert done.returncode == 0
    assert "campaign of epoch 1 runs" in done.stdout
    assert "s2r sample PROFILE --pause" in done.stdout
    rig.sampling()
    done = rig.s2r("sample", str(rig.profile), "--pause")
    assert (done.returncode, "s2r sample goes on with it" in done.stdout) == (0, True), done.stderr
    rig.until_status(campaign=None, unfinished_epoch=1, driving="recovery")
    command = subprocess.Popen(
        ["nohup", sys.executable, "-m", "s2r_runtime.cli.main", "sample", str(rig.profile), "--socket", str(rig.socket)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=rig.environment,
    )
    rig.sampling()
    command.send_signal(signal.SIGHUP)
    rig.sampling()
    assert command.poll() is None
    gone = time.monotonic()
    command.terminate()
    assert command.wait(10.0) == 128 + signal.SIGTERM
    stopped(rig, gone)


@pytest.mark.slow
def test_whoever_leaves_before_the_controller_drives_withdraws_it(rig: PeopleRig) -> None:
    """Its file is being read: a pipe that nobody writes to."""
    pipe = rig.folder / "controller.py"
    os.mkfifo(pipe)
    command = rig.command("deploy", str(pipe), stderr=subprocess.PIPE)
    rig.until(lambda: rig.children("s2r_runtime.daemon.worker"))
    command.send_signal(signal.SIGINT)
    _, err = command.communicate(timeout=10.0)
    assert command.returncode == 128 + signal.SIGINT
    assert b"interrupted: withdrawn before anything moved: Ctrl-C (SIGINT)" in err
    assert rig.status()["controller"] is None
