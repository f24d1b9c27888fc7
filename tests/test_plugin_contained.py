"""A transport that raises, hangs, floods or gives what it may not keeps the gate closed, is named for it, and harms nothing else."""

from __future__ import annotations

import contextlib
import json
import math
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import daemon_rig
import pytest
from daemon_rig import Rig

from s2r_runtime.audit.findings import Findings
from s2r_runtime.audit.frames import Frames
from s2r_runtime.daemon import hang_guard, robot_link
from s2r_runtime.daemon.hang_guard import HangGuard, Hung
from s2r_runtime.daemon.robot_link import RobotLink
from s2r_runtime.daemon.transport_values import FRAMES_AT_ONCE
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, Observed, OverrideChanged, Send

GOOD = Observation(1, 1, (0.0, 0.0, 0.0))
SEND = Send(0, 1, "recovery", (0.0, 0.0), 1, 1)


class Fake:
    """Gives what it is told to give; a callable is called, an exception raised."""

    def __init__(self) -> None:
        self.given: dict[str, Any] = {"poll": [], "encode": Frame(0, "command", b"", inbound=False), "decode": [GOOD], "fileno": 0}
        self.asked: list[str] = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*_: object) -> Any:
            self.asked.append(name)
            value = self.given.get(name, [Frame(time.monotonic_ns(), "o", b"")] if name == "receive" else None)
            if isinstance(value, BaseException):
                raise value
            return value() if callable(value) else value

        return call


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def guard(said: list[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[HangGuard]:
    monkeypatch.setattr(hang_guard, "LOOK_S", 0.05)
    with HangGuard(said.append) as opened:
        yield opened


@pytest.fixture
def fake() -> Fake:
    return Fake()


@pytest.fixture
def link(fake: Fake, guard: HangGuard) -> RobotLink:
    return RobotLink(fake, "transport 'odd' of odd-dist 1.2", 3, lambda frame: None, guard)  # type: ignore[arg-type]


def turn(link: RobotLink) -> list[Any]:
    """What one turn of the daemon's loop hears."""
    heard: list[Any] = [message for _, message in link.receive()]
    return heard + list(link.poll(time.monotonic_ns())) + list(link.send(SEND))


NOW = 10**30
BAD = [
    ("receive", None, "must be a list"),
    ("receive", [None], "must be Frame"),
    ("receive", [GOOD], "must be Frame"),
    ("receive", (frame for frame in ()), "must be a list"),
    ("receive", [Frame(1, "o", "text")], "must be at most"),  # type: ignore[arg-type]
    ("receive", [Frame(1.5, "o", b"")], "not of its type"),  # type: ignore[arg-type]
    ("receive", [Frame(1, "\ud800", b"")], "not of its type"),
    ("receive", [Frame(1 << 62, "o", b"")], "must be the host's monotonic clock"),
    ("receive", [Frame(1, "o", b"", inbound=False)], "not inbound"),
    ("receive", [Frame(1, "o", bytes(1 << 21))], "must be at most"),
    ("receive", RuntimeError("broken"), "raised RuntimeError: broken"),
    ("receive", SystemExit(3), "raised SystemExit: 3"),
    ("receive", KeyboardInterrupt(), "raised KeyboardInterrupt"),
    ("decode", None, "must be a list"),
    ("decode", [GOOD] * 1000, "at most"),
    ("decode", [7], "must be Observation"),
    ("decode", [Observation(1, 1, (0.0, 0.0))], "tuple of 3 finite floats"),
    ("decode", [Observation(1, 1, (0.0, 0.0, math.nan))], "tuple of 3 finite floats"),
    ("decode", [Observation(1, 1, (0.0, 0.0, math.inf), "with a fault")], "tuple of 3 finite floats"),
    ("decode", [Observation(1, 1, [0.0, 0.0, 0.0])], "tuple of 3 finite floats"),  # type: ignore[arg-type]
    ("decode", [Observation(1, 1, (0.0, 0.0, 1))], "tuple of 3 finite floats"),
    ("decode", [Observation(1, 1, ((0.0,), 0.0, 0.0))], "tuple of 3 finite floats"),  # type: ignore[arg-type]
    ("decode", [Observation("1", 1, GOOD.x)], "not of its type"),  # type: ignore[arg-type]
    ("decode", [Observation(1, NOW, GOOD.x)], "not of its type"),
    ("decode", [Observation(1, 1, (), "\ud800")], "not of its type"),
    ("decode", [Command(1, 1, "external", (math.nan,), 1, 1)], "finite floats"),
    ("decode", [Command(1, 1, "external", (0.0,), 1, None)], "not of their types"),  # type: ignore[arg-type]
    ("decode", [LinkChanged(1, up=1)], "not of its type"),  # type: ignore[arg-type]
    ("decode", [OverrideChanged(1, "party", "")], "not what it may be"),  # type: ignore[arg-type]
    ("decode", SystemExit(), "raised SystemExit"),
    ("poll", None, "must be a list"),
    ("poll", [GOOD], "must be LinkChanged"),
    ("poll", [LinkChanged(1, up=False, detail=5)], "not of its type"),  # type: ignore[arg-type]
    ("poll", ZeroDivisionError(), "raised ZeroDivisionError"),
    ("encode", None, "must be Frame"),
    ("encode", Frame(1, "command", b""), "must be inbound=False"),
    ("encode", SystemExit(), "raised SystemExit"),
    ("send", OSError("no such device"), "raised OSError: no such device"),
]


@pytest.mark.parametrize(("call", "given", "words"), BAD, ids=[f"{call}-{i}" for i, (call, _, _) in enumerate(BAD)])
def test_what_a_transport_may_not_give_is_a_lost_link_once_until_it_works_again(
    link: RobotLink, fake: Fake, call: str, given: Any, words: str
) -> None:
    assert turn(link) == [GOOD]
    honest = dict(fake.given)
    fake.given[call] = given
    heard = [message for _ in range(3) for message in turn(link)]
    (told,) = [m for m in heard if isinstance(m, LinkChanged)]
    assert not told.up
    assert told.detail.startswith(f"transport: {call} ")
    assert words in told.detail
    assert words in link.trouble
    (line,) = link.lines()
    assert line.startswith(f"transport 'odd' of odd-dist 1.2: {call} ")
    fake.given = honest
    again = [message for _ in range(2) for message in turn(link)]
    assert [m.up for m in again if isinstance(m, LinkChanged)] == [True]
    assert (link.trouble, link.lines()) == ("", ["transport 'odd' of odd-dist 1.2 works again"])


def test_frames_beyond_the_callers_time_come_with_the_next_call_in_order_and_once(link: RobotLink, fake: Fake) -> None:
    """So that the loop can give others a turn before all of a flood is worked off; what one frame says stays together."""
    frames = [Frame(k, "o", b"") for k in range(1, 6)]
    fake.given["receive"] = lambda: frames
    fake.given["decode"] = [GOOD, GOOD]
    turns = [[at for at, _ in link.receive(until_ns=0)] for _ in range(3)]
    assert turns == [[1, 1], [2, 2], [3, 3]]
    assert link.waits
    fake.given["receive"] = []
    assert [at for at, _ in link.receive()] == [4, 4, 5, 5]
    assert not link.waits
    assert fake.asked.count("receive") == 1
    assert list(link.receive()) == []


def test_a_flood_is_dropped_and_the_link_stays_down_until_it_is_calm(link: RobotLink, fake: Fake, monkeypatch: pytest.MonkeyPatch) -> None:
    turn(link)
    monkeypatch.setattr(robot_link, "CALM_NS", 50_000_000)
    monkeypatch.setattr(robot_link, "TOLD_AGAIN_NS", 10_000_000)
    fake.given["receive"] = [Frame(1, "o", b"")] * (FRAMES_AT_ONCE + 1)
    stop, *heard = [message for _ in range(10) for message in turn(link)]
    said = f"transport: receive gave {FRAMES_AT_ONCE + 1} frames at once, at most 4096 are taken"
    assert (stop.kind, stop.detail) == ("emergency_stop", f"{said}; what was dropped may have been a stop")
    assert [(m.up, m.detail) for m in heard if isinstance(m, LinkChanged)] == [(False, said)]
    assert link.counters() == {"flooded": 10}
    del fake.given["receive"]
    time.sleep(0.01)
    (again,) = link.poll(time.monotonic_ns())
    assert isinstance(again, OverrideChanged), "the newest drop was not told yet: after a person cleared the first, it must stop again"
    monkeypatch.setattr(link, "_calm_ns", time.monotonic_ns() + 50_000_000)
    assert turn(link) == [GOOD], "one quiet turn is not calm"
    fake.given["decode"] = [LinkChanged(1, up=True), GOOD]
    assert [m.up for m in turn(link) if isinstance(m, LinkChanged)] == [True, False], "whatever it says of itself"
    fake.given["decode"] = [GOOD]
    time.sleep(0.06)
    assert [m.up for m in turn(link) if isinstance(m, LinkChanged)] == [True]


@pytest.mark.parametrize(
    "given",
    [
        [OverrideChanged(1, "emergency_stop", "x" * 5000)],
        [OverrideChanged(1, "emergency_stop", "\ud800")],
        [OverrideChanged(1.5, "emergency_stop", None)],  # type: ignore[arg-type]
        [GOOD, OverrideChanged(1, "emergency_stop"), 7],
        [Observation(1, 1, (math.nan,)), OverrideChanged(1, "emergency_stop")],
        [GOOD] * 1000 + [OverrideChanged(1, "emergency_stop")] * 1000,
        (OverrideChanged(1, "emergency_stop"),),
        OverrideChanged(1, "emergency_stop"),
    ],
)
def test_a_stop_is_heard_whatever_comes_with_it(link: RobotLink, fake: Fake, given: Any) -> None:
    turn(link)
    fake.given["decode"] = given
    for _ in range(2):
        (stop,) = [m for m in turn(link) if isinstance(m, OverrideChanged)]
        assert stop.kind == "emergency_stop"
        assert len(stop.detail.encode()) <= 1000


@pytest.mark.parametrize("what", ["counters", "lines", "inform", "close"])
@pytest.mark.parametrize("given", [SystemExit(), None, 7, {1: 2, "a": "b"}, [object()]])
def test_what_is_only_for_people_harms_nobody(link: RobotLink, fake: Fake, what: str, given: Any) -> None:
    fake.given[what] = given
    assert isinstance(link.lines(), list)
    assert all(isinstance(value, int) for value in link.counters().values())
    link.inform(None)  # type: ignore[arg-type]
    link.close()
    assert not link.trouble


@pytest.mark.parametrize("call", ["receive", "decode", "poll", "encode", "send", "counters"])
def test_nothing_more_is_asked_of_a_transport_that_hung(
    link: RobotLink, fake: Fake, call: str, monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    monkeypatch.setattr(robot_link, "CALL_S", 0.2)
    held = threading.Lock()
    held.acquire()
    fake.given[call] = held.acquire if call == "poll" else lambda: time.sleep(60)
    heard = [*turn(link), link.counters(), *link.poll(0)]
    assert [(m.up, m.detail) for m in heard if isinstance(m, LinkChanged)] == [(False, f"transport: {call} did not return within 0.2 s")]
    assert link.out_of_use
    asked = len(fake.asked)
    assert turn(link) == []
    link.close()
    assert (link.counters(), len(fake.asked)) == ({}, asked)
    assert link.lines() == [f"transport 'odd' of odd-dist 1.2: {call} did not return within 0.2 s; out of use until the daemon starts anew"]
    assert said == []


def test_a_transport_that_cannot_be_opened_is_out_of_use_but_a_wrong_option_is_the_users(
    link: RobotLink, fake: Fake, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake.given["open"] = ConfigError("transport.port is 0")
    with pytest.raises(ConfigError, match="port is 0"):
        link.open()
    monkeypatch.setattr(robot_link, "OPEN_S", 0.2)
    fake.given["open"] = lambda: time.sleep(60)
    link.open()
    assert [(m.up, m.detail) for m in link.poll(0)] == [(False, "transport: open did not return within 0.2 s")]
    assert (link.fileno(), turn(link)) == (-1, [])


def test_a_loop_in_python_is_interrupted_and_a_call_in_time_never_is(guard: HangGuard) -> None:
    def circles() -> None:
        while True:
            with contextlib.suppress(Exception):
                math.sqrt(2.0)

    with pytest.raises(Hung, match=r"within 0\.2 s"):
        guard.call("odd", 0.2, circles)
    for _ in range(20):
        assert guard.call("even", 0.2, lambda: time.sleep(0.03) or 5) == 5


PROGRAM = """
import ctypes, sys, time
from s2r_runtime.daemon import hang_guard
hang_guard.GRACE_S, hang_guard.STUCK_S, hang_guard.LOOK_S = 0.3, 1.5, 0.05
def stubborn():
    while True:
        try:
            time.sleep(60)
        except BaseException:
            pass
def keeps_the_interpreter():
    ctypes.PyDLL(None).pause()
with hang_guard.HangGuard(lambda text: print(text, file=sys.stderr, flush=True)) as guard:
    guard.call("transport 'odd': receive", 0.2, globals()[sys.argv[1]])
"""


@pytest.mark.parametrize(
    ("how", "code", "words"),
    [
        ("stubborn", 70, "transport 'odd': receive hangs and cannot be interrupted: the daemon ends, nothing is sent any more"),
        ("keeps_the_interpreter", -signal.SIGALRM, "in keeps_the_interpreter"),
    ],
)
def test_a_hang_that_cannot_be_interrupted_ends_the_process_and_says_where(how: str, code: int, words: str) -> None:
    ended = subprocess.run([sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, words in ended.stderr) == (code, True), ended.stderr


# ---------------------------------------------------------------- in the daemon


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    monkeypatch.setattr(daemon_rig, "PROGRAM", Path(__file__).parent / "rigs" / "odd_robot.py")
    opened = Rig(tmp_path, clock="realtime")
    yield opened
    opened.close()


def odd(rig: Rig, text: str) -> None:
    """From now on."""
    file = rig.folder / "odd"
    if not text:
        file.unlink()
        return
    (rig.folder / "odd.new").write_text(text)
    (rig.folder / "odd.new").replace(file)


@pytest.mark.slow
def test_daemon_outlives_whatever_its_transport_does_and_the_audit_agrees(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    assert rig.deploy()["exit_code"] == 0
    rig.until_status(gate="open", link_trouble="")
    for text, words in (
        ("receive exit", "receive raised SystemExit: 3"),
        ("encode 'what'", "encode raised TypeError: gave str, must be Frame"),
        ("send exit", "send raised SystemExit: 3"),
        ("poll 1", "poll raised TypeError: gave int, must be a list of LinkChanged"),
        ("receive hang", "receive did not return within 2 s"),
    ):
        odd(rig, text)
        found = rig.until(
            lambda words=words: words in (status := rig.status())["link_trouble"] and status["reason"] == "link_down" and status
        )
        assert found["gate"] == "closed", text
        rig.until(lambda words=words: f"s2r: transport 'loop' of tests: {words}" in rig.said())
        odd(rig, "")
        if text != "receive hang":
            rig.until_status(gate="open", link_trouble="")
    recorded = rig.status()["recorded"]
    rig.until(lambda: rig.status()["recorded"] > recorded + 20)
    assert rig.status()["link_trouble"] == "receive did not return within 2 s", "until the daemon starts anew"
    assert rig.stop() == 0
    (log,) = rig.log_files()
    found = json.loads(rig.s2r("audit", str(log), "--key", str(rig.state / "key.pub"), "--json").stdout)
    assert (found["ok"], found["first_difference"], found["chain"]) == (True, None, "intact"), found


def audited(rig: Rig) -> Any:
    """What an audit says of the newest log."""
    return json.loads(rig.s2r("audit", str(rig.log_files()[-1]), "--key", str(rig.state / "key.pub"), "--json").stdout)


@pytest.mark.slow
def test_input_that_was_dropped_latches_a_stop_and_the_audit_agrees(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    for text, words in (
        ("receive [Frame(1 << 62, 'observation', b'')]", "receive raised TypeError: gave a frame with arrival_ns 4611686018427387904"),
        ("receive [Frame(1, 'observation', b'')] * 5000", "receive gave 5000 frames at once, at most 4096 are taken"),
    ):
        answer = rig.deploy()
        assert answer["exit_code"] == 0, answer
        rig.until_status(gate="open", link_trouble="")
        odd(rig, text)
        rig.until_status(gate="closed", reason="emergency_stop")
        rig.until(lambda words=words: words in rig.status()["link_trouble"])
        odd(rig, "")
        rig.until_status(link_trouble="", link=True)
        assert rig.status()["latched"] == ["emergency_stop"]
        time.sleep(0.2)  # by now it stands for the last drop too
        assert rig.ask("clear", text="emergency_stop")["exit_code"] == 0
    assert rig.stop() == 0
    found = audited(rig)
    assert (found["ok"], found["first_difference"], found["chain"]) == (True, None, "intact"), found


@pytest.mark.slow
def test_what_could_not_be_decoded_then_and_can_be_now_is_no_pass(rig: Rig) -> None:
    rig.start_robot()
    rig.start()
    rig.until_status(link_trouble="", link=True)
    odd(rig, "decode [Observation(1, 1, (float('nan'),) * 3)]")
    rig.until(lambda: "gave an Observation with x (nan, nan, nan)" in rig.status()["link_trouble"])
    odd(rig, "")
    rig.until_status(link_trouble="", link=True)
    assert rig.stop() == 0
    assert not audited(rig)["ok"]


class Says:
    """A transport whose frames say what they are called."""

    def decode(self, frame: Frame) -> list[Any]:
        return {b"stop": [OverrideChanged(0, "emergency_stop", "button")], b"good": [GOOD], b"": []}[frame.data]


@pytest.mark.parametrize(("data", "differences", "unchecked"), [(b"stop", 1, 0), (b"good", 0, 1), (b"", 0, 0)])
def test_a_log_cannot_claim_that_a_stop_was_not_to_be_read(data: bytes, differences: int, unchecked: int) -> None:
    findings = Findings()
    frames = Frames(Says(), 3, findings)  # type: ignore[arg-type]
    entry: Any = SimpleNamespace(index=1, channel="frame/in", raw=b"")
    frames.inbound(entry, Frame(1, "o", data))
    frames.event(entry, LinkChanged(1, up=False, detail="transport: decode raised RuntimeError: forged"))
    frames.inbound(entry, Frame(2, "o", b"good"))
    frames.event(entry, Observed(2, GOOD))
    assert (findings.differences, len(findings.unchecked)) == (differences, unchecked)


@pytest.mark.slow
def test_daemon_whose_transport_cannot_be_opened_serves_and_one_whose_send_cannot_be_ended_ends(rig: Rig) -> None:
    odd(rig, "fileno -1")
    rig.start()
    assert "fileno" in rig.until_status(gate="closed", reason="link_down")["link_trouble"]
    assert rig.stop() == 0
    odd(rig, "send stubborn")
    rig.start_robot()
    rig.daemon = rig._spawn("daemon", str(rig.profile), "--log", str(rig.logs))
    assert rig.daemon.wait(daemon_rig.WITHIN_S) == 70
    assert "transport 'loop' of tests: send hangs and cannot be interrupted: the daemon ends, nothing is sent any more" in rig.said()
