"""The link to a rover's process: found, driven, taken over by a person, started anew, cut, frozen, and back; over UDP, TCP and a cable."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink
from s2r_mavlink import dialect
from s2r_mavlink.asking import Asking
from s2r_mavlink.options import checked
from s2r_mavlink.rover_lines import UdpLine
from s2r_mavlink.testing import INPUTS, PATIENCE_S, STATES, Robot, RoverHere, RoverProcess, Runtime, free_port, rover
from s2r_mavlink.wire import Wire as Reading

from s2r_runtime.messages import Command, Decided, GateChanged, Observation

KINDS = ("udp", "tcp", "serial")


class Cable:
    """Two pseudo-terminals, each end's bytes to the other, with a switch."""

    def __init__(self) -> None:
        pairs = [os.openpty() for _ in range(2)]
        self._masters = [master for master, _ in pairs]
        self.ends = [os.ttyname(slave) for _, slave in pairs]
        self._slaves = [slave for _, slave in pairs]
        for master in self._masters:
            os.set_blocking(master, False)
        import tty

        for slave in self._slaves:
            tty.setraw(slave)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        import select

        while not self._over.is_set():
            for ready in select.select(self._masters, [], [], 0.05)[0]:
                with contextlib.suppress(OSError):
                    other = self._masters[1 - self._masters.index(ready)]
                    os.write(other, os.read(ready, 4096))

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        for descriptor in (*self._masters, *self._slaves):
            os.close(descriptor)


@contextlib.contextmanager
def ends(kind: str) -> Iterator[tuple[str, str]]:
    """(the runtime's option, the rover's argument)."""
    if kind == "udp":
        port = free_port()
        yield f"udp:127.0.0.1:{port}", f"udpout:127.0.0.1:{port}"
    elif kind == "tcp":
        port = free_port(socket.SOCK_STREAM)
        yield f"tcp:127.0.0.1:{port}", f"tcpin:127.0.0.1:{port}"
    else:
        cable = Cable()
        try:
            yield f"serial:{cable.ends[0]}:115200", f"serial:{cable.ends[1]}:115200"
        finally:
            cable.close()


@contextlib.contextmanager
def met(kind: str, *arguments: str, process: bool = False, **options: Any) -> Iterator[tuple[Runtime, RoverHere | RoverProcess]]:
    """A rover and a runtime that can reach it. The rover's time runs four times as fast, unless it is said otherwise."""
    with (
        ends(kind) as (ours, theirs),
        rover(theirs, "--speedup", "4", *arguments, process=process) as robot,
        Runtime(ours, **options) as runtime,
    ):
        runtime.beside.append(robot)
        yield runtime, robot


@contextlib.contextmanager
def driven(kind: str = "udp", *arguments: str, process: bool = False, **options: Any) -> Iterator[tuple[Runtime, RoverHere | RoverProcess]]:
    """A rover that was found, taken over, and can be driven."""
    with met(kind, *arguments, process=process, **{"take_over": "arm", "rate": 40.0, **options}) as (runtime, robot):
        assert runtime.more(), (runtime.lines, runtime.faults[-3:], robot.said)
        yield runtime, robot


def rising(observations: list[Observation]) -> bool:
    return all(b.seq > a.seq and b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise(observations))


# ---------------------------------------------------------------- found and driven


@pytest.mark.parametrize("kind", KINDS)
def test_robot_is_found_taken_over_and_driven_forward_and_to_the_left(kind: str) -> None:
    with driven(kind, process=True) as (runtime, robot):
        runtime.command = (0.5, 0.0)
        assert runtime.until(lambda: runtime.good[-1].x[0] > 0.4), runtime.good[-1]
        assert abs(runtime.good[-1].x[1]) < 0.05
        runtime.command = (0.0, 0.8)
        assert runtime.until(lambda: runtime.good[-1].x[2] > 0.5), "a positive w turns it counter-clockwise"
        runtime.command = (-0.5, 0.0)
        x = runtime.good[-1].x[0]
        assert runtime.until(lambda: runtime.good[-1].x[0] < x - 0.2)
        assert rising(runtime.good)
        assert runtime.ups in ([True], [False, True])
        assert {"mode": "GUIDED", "armed": True}.items() <= {k: v for line in robot.said for k, v in line.items()}.items()
        counters = runtime.counters
        assert counters["lost"] + counters["malformed"] + counters["stale"] + counters["old"] == 0
        assert 0 < counters["round_trip_us"] < 500_000


@pytest.mark.parametrize("first", ["robot", "runtime"])
@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_robot_and_runtime_find_each_other_whoever_comes_first(kind: str, first: str) -> None:
    with ends(kind) as (ours, theirs), contextlib.ExitStack() as stack:
        if first == "robot":
            robot = stack.enter_context(rover(theirs, "--mode", "GUIDED", "--armed"))
            for _ in range(20):
                robot.advance()
                time.sleep(0.02)
            runtime = stack.enter_context(Runtime(ours))
        else:
            runtime = stack.enter_context(Runtime(ours))
            runtime.run(0.7)
            assert runtime.ups == [False], "a robot that isn't there is reported"
            robot = stack.enter_context(rover(theirs, "--mode", "GUIDED", "--armed"))
        runtime.beside.append(robot)
        assert runtime.more()
        assert runtime.ups[-1]


def test_rates_are_asked_for_and_what_was_granted_is_reported() -> None:
    """A loop of 50 Hz grants 40 Hz at the most: 100 is denied, and the next slower ones, until 25 ms."""
    with driven("udp", "--speedup", "1", rate=100.0) as (runtime, robot):
        assert runtime.until(lambda: runtime.counters["interval_us_HEARTBEAT"] > 0)
        assert runtime.counters["interval_us_LOCAL_POSITION_NED"] == 25_000
        assert runtime.counters["interval_us_ATTITUDE"] == 25_000
        assert "LOCAL_POSITION_NED every 25 ms, asked for 10 ms" in runtime.lines
        count, begin = len(runtime.good), time.monotonic()
        runtime.run(2.0)
        seconds = time.monotonic() - begin
        assert (len(runtime.good) - count) / seconds == pytest.approx(40.0, rel=0.25)
        assert any(line.get("ms") == 25 for line in robot.said)


def test_robot_with_a_faster_loop_grants_what_is_asked_for() -> None:
    with driven("udp", "--loop-rate", "400", rate=100.0) as (runtime, _):
        assert runtime.until(lambda: runtime.counters["interval_us_LOCAL_POSITION_NED"] == 10_000)


def test_ground_station_that_lowers_the_rates_is_noticed_and_they_are_asked_for_again() -> None:
    """On a line of its own, as MAVProxy does every 15 s; the stand-in has one line, so it comes from the same side here."""
    with driven("tcp") as (runtime, robot):
        assert runtime.until(lambda: runtime.counters["interval_us_HEARTBEAT"] > 0)
        count = len([line for line in robot.said if line.get("interval") == 32])
        runtime.transport._line.write(mavlink.MAVLink_request_data_stream_message(1, 1, 0, 2, 1).pack(mavlink.MAVLink(None, 255, 190)))
        assert runtime.until(lambda: len([line for line in robot.said if line.get("interval") == 32]) > count, 30.0)
        assert runtime.until(
            lambda: runtime.counters["interval_us_ATTITUDE"] == runtime.counters["interval_us_LOCAL_POSITION_NED"] == 25_000
        )
        assert runtime.ups[-1]
        stamps = [o.stamp_ns for o in runtime.good]
        longest_s = max(b - a for a, b in itertools.pairwise(stamps)) * 1e-9 / 4.0  # the rover's time runs four times as fast
        assert longest_s < 0.35, "the gate needn't have closed"


def test_sped_up_robot_is_followed() -> None:
    with driven("udp", "--speedup", "8") as (runtime, _):
        runtime.run(3.0)
        span_s = (runtime.good[-1].stamp_ns - runtime.good[0].stamp_ns) * 1e-9
        assert span_s > 12.0
        assert runtime.counters["stale"] + runtime.counters["ahead"] == 0
        assert rising(runtime.good)


# ---------------------------------------------------------------- what the robot may be made to do


def test_robot_that_may_not_be_taken_over_is_left_alone_and_its_observations_are_faulty() -> None:
    """A robot that doesn't obey would be measured as one whose model is wrong."""
    with met("udp") as (runtime, robot):
        assert runtime.until(lambda: len(runtime.faults) > 60)
        assert not runtime.good
        assert "the robot can't be driven: HOLD, disarmed" in runtime.faults
        assert not any("mode" in line or "armed" in line for line in robot.said)
        robot.tell("mode GUIDED")
        robot.tell("arm")
        assert runtime.more(), "a person has done it"


def test_robot_that_refuses_to_arm_says_why() -> None:
    with met("udp", "--prearm-fails", take_over="arm") as (runtime, _):
        assert runtime.until(lambda: any("Bad fix" in line for line in runtime.lines))
        assert runtime.until(lambda: any("won't arm: failed" in line for line in runtime.lines))
        assert not runtime.good


@pytest.mark.parametrize(("act", "said"), [("mode MANUAL", "MANUAL, armed"), ("disarm", "GUIDED, disarmed")])
def test_person_takes_over_and_gives_back(act: str, said: str) -> None:
    with driven() as (runtime, robot):
        robot.tell(act)
        assert runtime.until(lambda: runtime.overrides)
        assert (runtime.overrides[0].kind, runtime.overrides[0].detail) == ("manual_override", f"the robot was taken over: {said}")
        runtime.transport.inform(GateChanged(0, open=False, reason="manual_override"))
        happened = len(robot.said)
        runtime.run(2.5)
        assert len(robot.said) == happened, "it is not taken back"
        assert runtime.faults[-1] == f"the robot can't be driven: {said}"
        runtime.transport.inform(GateChanged(0, open=False, reason="no_controller"))
        assert runtime.more(), "a person cleared the stop"


def test_emergency_stop_changes_the_mode_and_is_nobodys_override() -> None:
    with driven(stop_mode="HOLD") as (runtime, robot):
        runtime.transport.inform(GateChanged(0, open=False, reason="emergency_stop"))
        assert runtime.until(lambda: "the robot can't be driven: HOLD, armed" in runtime.faults)
        assert runtime.overrides == []
        runtime.run(2.0)
        assert [line["mode"] for line in robot.said if "mode" in line] == ["GUIDED", "HOLD"]
        runtime.transport.inform(GateChanged(0, open=False, reason="no_controller"))
        assert runtime.more()


def test_gate_that_closes_sets_the_robot_aside_until_nothing_else_stands_in_the_way() -> None:
    with driven(stop_mode="HOLD", stop_when="closed") as (runtime, robot):

        def gate(reason: str) -> None:
            runtime.transport.inform(GateChanged(0, open=not reason, reason=reason or "allowed"))

        def modes() -> list[str]:
            return [str(line["mode"]) for line in robot.said if "mode" in line]

        gate("no_certificate")  # it never was open
        runtime.run(0.5)
        assert modes() == ["GUIDED"]
        for reason in ("radius_above_verified", "latched:controller_fault"):
            gate("")
            gate("outside_region")
            runtime.run(0.3)
            assert modes()[-1] == "GUIDED", "zero velocity is enough, and it must be able to come back"
            gate(reason)
            assert runtime.until(lambda: modes()[-1] == "HOLD" and runtime.observations[-1].fault)
            gate("observation_invalid")
            assert runtime.more()
        assert modes() == ["GUIDED", "HOLD", "GUIDED", "HOLD", "GUIDED"]
        assert runtime.overrides == []


def test_end_of_the_runtime_puts_the_robot_aside() -> None:
    with driven(stop_mode="HOLD") as (runtime, robot):
        runtime.transport.close()
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end and [line["mode"] for line in robot.said if "mode" in line][-1] != "HOLD":
            robot.advance()
        assert [line["mode"] for line in robot.said if "mode" in line][-1] == "HOLD"


def test_fail_safe_of_the_robot_is_an_emergency_stop() -> None:
    with driven() as (runtime, robot):
        robot.tell("state critical")
        assert runtime.until(lambda: runtime.overrides)
        assert (runtime.overrides[0].kind, runtime.overrides[0].detail) == ("emergency_stop", "the robot says that it is critical")


def test_robot_that_starts_anew_while_driven_is_not_driven_on_unasked() -> None:
    with driven() as (runtime, robot):
        before = runtime.good[-1]
        robot.tell("reboot")
        assert runtime.until(lambda: runtime.overrides)
        assert runtime.overrides[0].kind == "manual_override"
        runtime.transport.inform(GateChanged(0, open=False, reason="manual_override"))
        runtime.run(2.0)
        assert runtime.observations[-1].fault
        assert runtime.observations[-1].stamp_ns > before.stamp_ns
        runtime.transport.inform(GateChanged(0, open=False, reason="no_controller"))
        assert runtime.more()
        assert rising(runtime.good)
        assert runtime.counters["restarts"] == 1
        assert runtime.counters["interval_us_LOCAL_POSITION_NED"] == 25_000, "rates are asked for again"


def test_robot_that_hears_nothing_more_stops_by_itself_after_three_seconds() -> None:
    """The protocol has no time to live; docs/mavlink.md says so."""
    with driven() as (runtime, _):
        runtime.command = (0.5, 0.0)
        assert runtime.until(lambda: runtime.good[-1].x[0] > 0.5)
        runtime.command, since = None, runtime.good[-1]
        assert runtime.until(lambda: runtime.good[-1].x[0] - runtime.good[-20].x[0] < 0.005)
        assert 2.5 < (runtime.good[-1].stamp_ns - since.stamp_ns) * 1e-9 < 6.0
        assert runtime.good[-1].x[0] > since.x[0] + 1.0, "until then it drove on"


# ---------------------------------------------------------------- a well-behaved component


def test_heartbeat_comes_once_a_second_from_its_own_component_and_only_while_the_daemon_turns() -> None:
    port = free_port()
    robot = Robot(UdpLine("127.0.0.1", port))
    with Runtime(f"udp:127.0.0.1:{port}") as runtime:
        heard: list[tuple[float, Any]] = []

        def beats(seconds: float, *, turning: bool) -> int:
            before, end = len(heard), time.monotonic() + seconds
            while time.monotonic() < end:
                robot.publish(1 + int(100 * time.monotonic()) % 50_000, time.monotonic_ns(), (0.0, 0.0, 0.0))
                if turning:
                    runtime.turn()
                else:
                    time.sleep(0.01)
                heard.extend((time.monotonic(), m) for m in robot.listen() if m.get_type() == "HEARTBEAT")
            return len(heard) - before

        assert 2 <= beats(2.6, turning=True) <= 4
        assert beats(1.6, turning=False) == 0, "a daemon that hangs is silent"
        assert beats(1.2, turning=True) >= 1
        beat = heard[0][1]
        assert (beat.get_srcSystem(), beat.get_srcComponent(), beat.type, beat.autopilot) == (1, 191, 18, 8)
        states = {m.system_status for _, m in heard}
        assert states == {3}, "standby while nobody drives"
        runtime.command = (0.1, 0.0)
        beats(1.3, turning=True)
        assert heard[-1][1].system_status == 4
    robot.line.close()


def test_refusals_are_told_on_the_robots_side_but_not_all_day() -> None:
    port = free_port()
    robot = Robot(UdpLine("127.0.0.1", port))
    with Runtime(f"udp:127.0.0.1:{port}") as runtime:
        for k in range(30):
            robot.publish(k + 1, (k + 1) * 10_000_000, (0.0, 0.0, 0.0))
            runtime.turn()
        for _ in range(200):
            runtime.transport.inform(Decided(0, "external", 0, 0, allow=False, reason="source_not_allowed", margin=-1.0))
        runtime.transport.inform(Decided(0, "controller", 0, 0, allow=True, reason="allowed", margin=1.0))
        time.sleep(1.1)
        runtime.transport.inform(GateChanged(0, open=False, reason="observation_stale"))
        texts = [m.text for m in robot.listen() if m.get_type() == "STATUSTEXT"]
        assert texts == ["s2r: refused external: source_not_allowed", "s2r: gate closed: observation_stale"]
    robot.line.close()


def test_robots_question_about_the_time_is_answered() -> None:
    port = free_port()
    robot = Robot(UdpLine("127.0.0.1", port))
    with Runtime(f"udp:127.0.0.1:{port}") as runtime:
        robot.publish(1, 10_000_000, (0.0, 0.0, 0.0))
        runtime.turn()
        robot.line.write(robot.pack(robot.mav.timesync_encode(0, 123_456_789)))
        runtime.run(0.1)
        answers = [m for m in robot.listen() if m.get_type() == "TIMESYNC" and m.tc1 != 0]
        assert [m.ts1 for m in answers] == [123_456_789]
        assert not any(b"\x15\xcd\x5b\x07" in frame.data for frame in runtime.frames), "a question means nothing for the log"
    robot.line.close()


# ---------------------------------------------------------------- cut, frozen, back


class Wire:
    """A UDP hop between rover and runtime with a switch."""

    def __init__(self, to: int) -> None:
        self.port, self._to = free_port(), to
        self._near, self._far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._near.bind(("127.0.0.1", self.port))
        self._near.settimeout(0.02)
        self._far.connect(("127.0.0.1", to))
        self._far.setblocking(False)
        self.closed = threading.Event()
        self._over = threading.Event()
        self._robot: Any = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._over.is_set():
            with contextlib.suppress(OSError):
                data, self._robot = self._near.recvfrom(65_536)
                if not self.closed.is_set():
                    self._far.send(data)
            with contextlib.suppress(OSError):
                while True:
                    data = self._far.recv(65_536)
                    if not self.closed.is_set() and self._robot is not None:
                        self._near.sendto(data, self._robot)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._near.close()
        self._far.close()


def test_link_that_is_cut_again_and_again_is_noticed_and_heals_within_a_second() -> None:
    """Ten times here, a hundred in tools/bench_mavlink.py."""
    port = free_port()
    wire = Wire(port)
    try:
        with (
            rover(f"udpout:127.0.0.1:{wire.port}", "--mode", "GUIDED", "--armed") as robot,
            Runtime(f"udp:127.0.0.1:{port}", rate=40.0, observation_timeout=0.4) as runtime,
        ):
            runtime.beside.append(robot)
            assert runtime.more(100)
            for _ in range(10):
                wire.closed.set()
                cut = time.monotonic()
                assert runtime.until(lambda: not runtime.ups[-1], 2.0)
                assert time.monotonic() - cut < 0.4 + 0.3
                wire.closed.clear()
                back, count = time.monotonic(), len(runtime.good)
                assert runtime.until(lambda: runtime.ups[-1] and len(runtime.good) > count + 2, 3.0)  # noqa: B023
                assert time.monotonic() - back < 1.0
            assert all(a != b for a, b in itertools.pairwise(runtime.ups))
            assert rising(runtime.good)
            assert runtime.overrides == []
    finally:
        wire.close()


def test_tcp_connection_that_ends_is_made_again() -> None:
    with ends("tcp") as (ours, theirs), Runtime(ours) as runtime:
        for _ in range(3):
            with rover(theirs, "--mode", "GUIDED", "--armed") as robot:
                runtime.beside = [robot]
                assert runtime.more()
            runtime.beside = []
            assert runtime.until(lambda: not runtime.ups[-1])
        assert runtime.counters["reconnected"] >= 2


def test_serial_device_that_is_pulled_out_is_opened_again(tmp_path: Path) -> None:
    link = tmp_path / "ttyACM0"
    with Runtime(f"serial:{link}:115200") as runtime:
        runtime.run(0.7)
        assert runtime.ups == [False], "it isn't plugged in yet, which is no error"
        for _ in range(2):
            cable = Cable()
            link.unlink(missing_ok=True)
            link.symlink_to(cable.ends[0])
            with rover(f"serial:{cable.ends[1]}:115200", "--mode", "GUIDED", "--armed") as robot:
                runtime.beside = [robot]
                assert runtime.more()
            runtime.beside = []
            cable.close()
            assert runtime.until(lambda: not runtime.ups[-1])


@pytest.mark.parametrize("kind", KINDS)
def test_frozen_robot_is_noticed_and_when_it_thaws_the_link_heals(kind: str) -> None:
    with driven(kind, process=True) as (runtime, robot):
        assert isinstance(robot, RoverProcess)
        robot.process.send_signal(signal.SIGSTOP)
        assert runtime.until(lambda: not runtime.ups[-1])
        command, begin = Command(1, 0, "recovery", (0.0, 0.0), 0, 10**8), time.monotonic()
        for _ in range(2000):
            runtime.transport.send(runtime.transport.encode(command))
        assert time.monotonic() - begin < 2.0, "nobody waits for a frozen robot"
        robot.process.send_signal(signal.SIGCONT)
        assert runtime.until(lambda: runtime.ups[-1])
        assert runtime.more()


def test_commands_do_not_queue_up_before_a_frozen_robot() -> None:
    """Old commands are worse than none: at most a moment's worth is on its way when it thaws."""
    with driven("tcp") as (runtime, robot):
        assert isinstance(robot, RoverHere)
        robot.frozen = True
        sent = runtime.counters["sent"]
        for k in range(5000):
            runtime.transport.send(runtime.transport.encode(Command(k, 0, "recovery", (0.0, 0.0), 0, 10**8)))
        counters = runtime.counters
        assert counters["dropped_out"] > 0
        assert counters["sent"] - sent < 5000


# ---------------------------------------------------------------- signed


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "key"
    path.write_text("5a" * 32)
    path.chmod(0o600)
    return path


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lag_s", [0.0, 40.0])
def test_signed_link_is_driven_also_with_a_robot_whose_signing_clock_lags(kind: str, lag_s: float, key: Path, tmp_path: Path) -> None:
    signing = {"signing_key_file": str(key), "signing_state": str(tmp_path / "state.json")}
    with driven(kind, "--key-file", str(key), "--signing-lag", str(lag_s), **signing) as (runtime, _):
        runtime.command = (0.5, 0.0)
        assert runtime.until(lambda: runtime.good[-1].x[0] > 0.3)
        assert runtime.counters["rejected_bad_signature"] + runtime.counters["rejected_unsigned"] == 0
        if kind == "udp" and lag_s:  # there the robot speaks first
            assert runtime.counters["rejected_old_stamp"] > 0


def test_the_signed_profile_drives_a_robot_with_its_key_and_no_other(key: Path, tmp_path: Path) -> None:
    profile = Path(__file__).parents[3] / "profiles" / "rover-mavlink-signed.toml"
    options = tomllib.loads(profile.read_text())["transport"]
    for name in ("name", "robot", "take_over"):  # the line is the test's own, and its robot is armed
        del options[name]
    assert options["signing_key_file"] == "/etc/s2r/mavlink.key"
    options |= {"signing_key_file": str(key), "signing_state": str(tmp_path / "state.json")}
    with driven("udp", "--key-file", str(key), **options) as (runtime, _):
        runtime.command = (0.5, 0.0)
        assert runtime.until(lambda: runtime.good[-1].x[0] > 0.3)
    with met("udp", "--mode", "GUIDED", "--armed", **(options | {"signing_state": str(tmp_path / "other.json")})) as (runtime, _):
        runtime.run(1.0)
        assert runtime.observations == []


@pytest.mark.parametrize("theirs", ["none", "another"])
def test_robot_that_does_not_hold_the_key_is_not_believed(theirs: str, key: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_text("5b" * 32)
    arguments = () if theirs == "none" else ("--key-file", str(other))
    signing = {"signing_key_file": str(key), "signing_state": str(tmp_path / "state.json")}
    with met("udp", "--mode", "GUIDED", "--armed", *arguments, **signing) as (runtime, _):
        runtime.run(1.5)
        assert runtime.observations == []
        assert runtime.counters["rejected_unsigned" if theirs == "none" else "rejected_bad_signature"] > 10
        assert any(frame.channel == "door" and b"rejected" in frame.data for frame in runtime.frames), "the log says it"


def test_robot_that_signs_is_not_believed_without_a_key(key: Path) -> None:
    """Nobody here can tell whether it is the robot."""
    with met("udp", "--mode", "GUIDED", "--armed", "--key-file", str(key)) as (runtime, _):
        runtime.run(1.0)
        assert runtime.observations == []
        assert runtime.counters["rejected_signed_without_key"] > 10


# ---------------------------------------------------------------- the end

PROGRAM = """
import sys
from s2r_mavlink.transport import MavlinkTransport
t = MavlinkTransport({"robot": sys.argv[1], "signing_key_file": sys.argv[2], "signing_state": sys.argv[3]}, ("x",), ("v",))
t.open()
t.poll(1)
raise SystemExit(3)
"""


def test_process_that_forgets_to_close_ends_all_the_same(key: Path, tmp_path: Path) -> None:
    arguments = [f"udp:127.0.0.1:{free_port()}", str(key), str(tmp_path / "state.json")]
    done = subprocess.run([sys.executable, "-c", PROGRAM, *arguments], timeout=PATIENCE_S, check=False)
    assert done.returncode == 3


def test_headings_wrap() -> None:
    with driven("udp", "--start", "0", "0", "3.1") as (runtime, _):
        runtime.command = (0.0, -0.8)  # clockwise: past south
        assert runtime.until(lambda: runtime.good[-1].x[2] > 2.5)
        assert all(-math.pi <= o.x[2] <= math.pi for o in runtime.good)


def test_stop_that_was_cleared_before_the_loop_came_round_is_not_remembered_after_it() -> None:
    """On a busy machine a person's clear can come in the same turn as the robot's news."""
    options = checked({"robot": "udp:127.0.0.1:14551", "take_over": "arm"}, STATES, INPUTS)
    wire, ordered, now_ns = Reading(options, STATES, INPUTS), [], 10 * 10**9

    def send(number: int, content: bytes) -> bool:
        if number == dialect.COMMAND_LONG:
            ordered.append(dialect.MESSAGES[number].unpack(content)[7])
        return True

    asking = Asking(options, wire, {}, send)
    wire.robot.mode, wire.robot.armed, wire.robot.heard_ns, wire.robot.overrides = 0, True, now_ns, 1
    asking.gate("manual_override")
    asking.gate("no_controller")
    asking.tick(now_ns)
    assert dialect.DO_SET_MODE in ordered
