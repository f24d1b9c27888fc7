"""Telemetry logs become states and inputs on the robot's clock."""

from __future__ import annotations

import gzip
import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink
from s2r_mavlink.tlog import read as read_log

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recordings.loading import load_transitions
from s2r_runtime.recordings.robot_logs import readers_of
from s2r_runtime.trace.data.readers import load_dataset

STATES, INPUTS = ("x", "y", "theta"), ("v", "w")
SITL = Path("../shared/data/rover_sitl.tlog.gz")
UNIX_S = 1_795_000_000.0


def read(path: Path, states: tuple[str, ...], inputs: tuple[str, ...], options: dict[str, Any]) -> list[Any]:
    return read_log(path, states, inputs, options).stretches


class Log:
    """A log as a ground station writes it. delay(t): of telemetry on its way, s; host: its clock when the robot's is 0."""

    def __init__(self, delay: Callable[[float], float] = lambda _: 0.004, host: float = UNIX_S) -> None:
        self._delay, self._host = delay, host
        self.robot, self.station = mavlink.MAVLink(None, 1, 1), mavlink.MAVLink(None, 255, 190)
        self.records: list[tuple[float, bytes]] = []

    def heard(self, t: float, message: Any) -> None:
        self.records.append((self._host + t + self._delay(t), bytes(message.pack(self.robot))))
        self.robot.seq = (self.robot.seq + 1) % 256

    def sent(self, t: float, v: float, w: float, mask: int = 1479, frame: int = 8, system: int = 1) -> None:
        message = self.station.set_position_target_local_ned_encode(0, system, 1, frame, mask, 0, 0, 0, v, 0, 0, 0, 0, 0, 0, -w)
        self.records.append((self._host + t, bytes(message.pack(self.station))))
        self.station.seq = (self.station.seq + 1) % 256

    def drive(self, begin: float, end: float, *, mode: int = 15, armed: bool = True, uptime: float = 0.0) -> None:
        """A rover that goes round in circles: at t of the host's it is where its angle is 0.5 t. uptime: its clock at `begin`."""
        for k in range(round((end - begin) / 0.02)):
            t = begin + 0.02 * k
            ms = round(1000 * (t - begin + uptime))
            if k % 50 == 0:
                self.heard(t, self.robot.heartbeat_encode(10, 3, 129 if armed else 1, mode, 4))
            yaw = math.remainder(0.5 * t, 2 * math.pi)
            self.heard(t, self.robot.attitude_encode(ms, 0, 0, yaw, 0, 0, 0.5))
            self.heard(t, self.robot.local_position_ned_encode(ms, math.sin(0.5 * t), -math.cos(0.5 * t), 0, 0, 0, 0))

    def bytes(self) -> bytes:
        self.records.sort(key=lambda record: record[0])
        return b"".join(round(1e6 * t).to_bytes(8, "big") + frame for t, frame in self.records)

    def write(self, path: Path) -> Path:
        data = self.bytes()
        path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
        return path


def test_states_are_in_our_frame_on_the_robots_clock(tmp_path: Path) -> None:
    log = Log()
    log.drive(0.0, 10.0, uptime=100.0)
    ((t, x), (t_u, u)) = read(log.write(tmp_path / "a.tlog"), STATES, INPUTS, {})[0]
    assert t[0] == pytest.approx(100.0)
    assert np.diff(t) == pytest.approx(0.02, abs=1e-9)
    since = t - 100.0
    assert x[:, 0] == pytest.approx(np.sin(0.5 * since), abs=1e-6)
    assert x[:, 1] == pytest.approx(np.cos(0.5 * since), abs=1e-6), "y is west"
    assert np.unwrap(x[:, 2]) == pytest.approx(-0.5 * since, abs=1e-6), "theta is counter-clockwise"
    assert len(t_u) == len(u) == 0


@pytest.mark.parametrize("suffix", [".tlog", ".tlog.gz"])
def test_commands_are_brought_to_the_robots_clock(tmp_path: Path, suffix: str) -> None:
    """Whatever the radio does to telemetry: 4 ms at best, and up to half a second now and then."""
    draw = random.Random(1)
    log = Log(lambda _: 0.004 + (0.0 if draw.random() < 0.5 else draw.uniform(0.0, 0.5)))
    log.drive(0.0, 30.0, uptime=50.0)
    given = [(0.5 * k, draw.uniform(-1.0, 1.0), draw.uniform(-1.0, 1.0)) for k in range(1, 50)]
    for t, v, w in given:
        log.sent(t, v, w)
    ((_, _), (t_u, u)) = read(log.write(tmp_path / f"a{suffix}"), STATES, INPUTS, {})[0]
    assert len(t_u) == len(given) + 1, "and the zero after the last one's lapse"
    assert t_u[:-1] == pytest.approx([50.0 + t for t, _, _ in given], abs=0.006)
    assert u[:-1] == pytest.approx(np.array([[v, w] for _, v, w in given]), abs=1e-6)
    assert (t_u[-1] - t_u[-2], *u[-1]) == pytest.approx((3.0, 0.0, 0.0))


def test_log_of_a_simulator_at_another_pace_is_read_on_its_own_clock(tmp_path: Path) -> None:
    log = Log()
    for k in range(1500):
        t, ms = 0.004 * k, 1000 + 20 * k  # five times as fast
        if k % 50 == 0:
            log.heard(t, log.robot.heartbeat_encode(10, 3, 129, 15, 4))
        log.heard(t, log.robot.attitude_encode(ms, 0, 0, 0.0, 0, 0, 0.0))
        log.heard(t, log.robot.local_position_ned_encode(ms, 0.0, 0.0, 0, 0, 0, 0))
    log.sent(2.0, 0.5, 0.0)
    ((_, _), (t_u, _)) = read(log.write(tmp_path / "a.tlog"), STATES, INPUTS, {})[0]
    assert t_u[0] == pytest.approx(1.0 + 5.0 * 2.0, abs=0.05)


def test_lapse_of_three_seconds_is_a_stop(tmp_path: Path) -> None:
    log = Log()
    log.drive(0.0, 20.0)
    for t in (1.0, 2.0, 10.0, 10.5):
        log.sent(t, 0.5, 0.1)
    ((_, _), (t_u, u)) = read(log.write(tmp_path / "a.tlog"), STATES, INPUTS, {})[0]
    assert t_u == pytest.approx([1.0, 2.0, 5.0, 10.0, 10.5, 13.5], abs=0.01)
    assert u[:, 0] == pytest.approx([0.5, 0.5, 0.0, 0.5, 0.5, 0.0])


def test_only_what_a_rover_obeys_is_an_input(tmp_path: Path) -> None:
    log = Log()
    log.drive(0.0, 10.0)
    log.sent(1.0, 0.5, 0.1)
    log.sent(1.5, 0.6, 0.1, mask=1479 | 32)
    log.sent(2.0, 0.7, 0.1, mask=1479 | 2048)
    log.sent(2.5, 0.8, 0.1, frame=20)
    log.sent(3.0, 0.9, 0.1, system=7)
    log.sent(3.5, math.nan, 0.1)
    ((_, _), (t_u, _)) = read(log.write(tmp_path / "a.tlog"), STATES, INPUTS, {})[0]
    assert t_u == pytest.approx([1.0, 4.0], abs=0.01)


def test_driving_by_hand_and_standing_disarmed_are_left_out(tmp_path: Path) -> None:
    log = Log()
    for begin, mode, armed in ((0.0, 4, False), (10.0, 15, True), (20.0, 0, True), (30.0, 15, True)):
        log.drive(begin, begin + 10.0, mode=mode, armed=armed, uptime=begin)
    found = read(log.write(tmp_path / "a.tlog"), STATES, INPUTS, {})
    assert [(round(t[0]), round(t[-1])) for (t, _), _ in found] == [(10, 19), (30, 40)]
    assert len(read(tmp_path / "a.tlog", STATES, INPUTS, {"mode": ""})) == 1, "a profile may say that it has no modes"


def test_robot_that_started_anew_begins_another_stretch(tmp_path: Path) -> None:
    log = Log()
    log.drive(0.0, 10.0, uptime=500.0)
    log.drive(12.0, 22.0, uptime=1.0)
    log.sent(3.0, 0.1, 0.0)
    log.sent(15.0, 0.2, 0.0)
    found = read(log.write(tmp_path / "a.tlog"), STATES, INPUTS, {})
    assert [round(t[0]) for (t, _), _ in found] == [500, 1]
    assert found[1][1][0][0] == pytest.approx(4.0, abs=0.01)
    assert found[1][1][1][0][0] == pytest.approx(0.2)


def test_junk_and_a_cut_end_cost_what_they_hit(tmp_path: Path) -> None:
    log = Log()
    log.drive(0.0, 10.0)
    data, draw = log.bytes(), random.Random(2)
    whole = len(read(log.write(tmp_path / "a.tlog"), STATES, INPUTS, {})[0][0][0])
    spoilt = bytearray(data)
    for _ in range(20):
        spoilt[draw.randrange(len(spoilt))] ^= 0x55
    at = len(data) // 2
    (tmp_path / "b.tlog").write_bytes(bytes(spoilt[:at]) + bytes(draw.randrange(256) for _ in range(100)) + bytes(spoilt[at:-7]))
    left = len(read(tmp_path / "b.tlog", STATES, INPUTS, {})[0][0][0])
    assert whole - 60 <= left < whole


def test_sources_and_states_that_the_log_has_are_found(tmp_path: Path) -> None:
    log = Log()
    q = [math.cos(0.1), 0.0, 0.0, math.sin(0.1)]
    for k in range(100):
        log.heard(0.02 * k, log.robot.odometry_encode(20_000 * k, 1, 12, 1.0, 2.0, 0.0, q, 0.5, 0, 0, 0, 0, 0.1, [0.0] * 21, [0.0] * 21))
    ((_, x), _) = read(log.write(tmp_path / "a.tlog"), ("x", "y", "theta", "speed", "w"), INPUTS, {})[0]
    assert x[-1] == pytest.approx([1.0, -2.0, -0.2, 0.5, -0.1], abs=1e-6)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "holds no MAVLink frame"),
        (b"t,x,y\n0,1,2\n" * 50, "holds no MAVLink frame"),
        (b"\x1f\x8b\x08\x00broken", "is not a whole gzip file"),
    ],
)
def test_file_that_is_no_log_is_one_line(tmp_path: Path, data: bytes, says: str) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=says):
        read(path, STATES, INPUTS, {})


def test_log_without_what_is_asked_for_is_one_line(tmp_path: Path) -> None:
    log = Log()
    log.drive(0.0, 5.0, armed=False)
    path = log.write(tmp_path / "a.tlog")
    for states, inputs, options, says in (
        (STATES, INPUTS, {}, "tells no pose while it obeys"),
        (STATES, INPUTS, {"system": 9}, "holds no LOCAL_POSITION_NED of system 9"),
        (STATES, INPUTS, {"pose": "odometry"}, "holds no ODOMETRY"),
        ((*STATES, "q"), INPUTS, {"mode": ""}, "the model also has q"),
        (STATES, ("force",), {"mode": ""}, "the model also has force"),
    ):
        with pytest.raises(RecordingError, match=says):
            read(path, states, inputs, options)


def test_verbs_read_it_by_its_suffix(tmp_path: Path) -> None:
    log, draw = Log(), random.Random(3)
    log.drive(0.0, 60.0)
    for k in range(300):
        log.sent(0.2 * k, draw.uniform(-1.0, 1.0), draw.uniform(-1.0, 1.0))
    path = log.write(tmp_path / "a.tlog.gz")
    model = compose(ModelSpec("unicycle", 0.1))
    data = load_dataset(path, model)
    assert len(data.runs) == 1
    assert len(data.runs[0].y) >= 600
    found = load_transitions(path, model)
    assert len(found.x0) > 500
    assert not found.independent


@pytest.mark.slow
@pytest.mark.skipif(not SITL.exists(), reason="a recording that is not part of the project")
def test_recording_of_ardupilots_rover_shows_its_ramp_and_its_turn_rate() -> None:
    """Figures found independently: v a 1 m/s^2 ramp with .20 s delay, rmse .045 m/s; w 2.09 rad/s^2 with .06 s, rmse .008 rad/s."""
    (((t, x), (t_u, u)),) = read(SITL, ("x", "y", "theta", "speed", "w"), INPUTS, {})
    assert len(t) == 21_001
    assert np.corrcoef(np.diff(np.unwrap(x[:, 2])) / np.diff(t), x[1:, 4])[0, 1] > 0.99, "the turn rate's sign is the heading's"

    def ramp(column: int, delay: float, rate: float) -> Any:
        at = np.searchsorted(t_u, t - delay, side="right") - 1
        target, y, found = np.where(at >= 0, u[np.maximum(at, 0), column], 0.0), 0.0, []
        for k, h in enumerate(np.diff(t, prepend=t[0] - 0.02)):
            y += float(np.clip(target[k] - y, -rate * h, rate * h))
            found.append(y)
        return np.array(found)

    assert np.sqrt(np.mean((ramp(0, 0.20, 1.0) - x[:, 3]) ** 2)) < 0.05
    assert np.sqrt(np.mean((ramp(1, 0.05, 2.09) - x[:, 4]) ** 2)) < 0.02


# ---------------------------------------------------------------- commands of every kind


def turning(frame: int, encode: Any = None, seconds: float = 8.0) -> Log:
    """A rover that turns while a velocity along north and east is commanded; other kinds are added by the caller."""
    log = Log()
    log.drive(0.0, seconds)
    for k in range(8):
        t, north, east, w = 0.5 + 0.9 * k, 0.3 + 0.05 * k, -0.2 + 0.1 * k, 0.1 * k - 0.3
        fields = (0, 0, 0, north, east, 0, 0, 0, 0, 0, -w)
        encode = encode or log.station.set_position_target_local_ned_encode
        message = encode(0, 1, 1, frame, 1479, *fields)
        log.records.append((UNIX_S + t, bytes(message.pack(log.station))))
    return log


@pytest.mark.parametrize(("frame", "name"), [(1, "local_ned"), (7, "local_ned"), (5, "global_int"), (6, "global_int"), (11, "global_int")])
def test_velocity_along_north_and_east_is_turned_by_the_heading_at_each_moment(tmp_path: Path, frame: int, name: str) -> None:
    station = mavlink.MAVLink(None, 255, 190)
    log = turning(frame, getattr(station, f"set_position_target_{name}_encode"))
    ((_, _), (t, u)) = read(log.write(tmp_path / "a.tlog"), STATES, INPUTS, {})[0]
    k = np.clip(np.floor((t + 0.004 - 0.5) / 0.9 + 1e-3), 0, 7)
    north, east, yaw = 0.3 + 0.05 * k, -0.2 + 0.1 * k, 0.5 * t
    assert len(t) > 300, "a row at each pose"
    assert u[:-1, 0] == pytest.approx((north * np.cos(yaw) + east * np.sin(yaw))[:-1], abs=1e-5)
    assert u[:-1, 1] == pytest.approx((0.1 * k - 0.3)[:-1], abs=1e-6)


@pytest.mark.parametrize("frame", [8, 9, 12])
def test_velocity_in_the_bodys_frames_is_the_bodys(tmp_path: Path, frame: int) -> None:
    ((_, _), (_, u)) = read(turning(frame).write(tmp_path / "a.tlog"), STATES, INPUTS, {})[0]
    assert u[:-1, 0] == pytest.approx(0.3 + 0.05 * np.arange(8), abs=1e-6)


@pytest.mark.parametrize("seed", range(25))
def test_sticks_and_actuators_are_inputs_as_pymavlink_encodes_them(tmp_path: Path, seed: int) -> None:
    draw, log = random.Random(seed), Log()
    log.drive(0.0, 6.0, mode=0)
    wanted: dict[str, list[float]] = {name: [] for name in ("manual_x", "manual_r", "rc1", "rc18", "servo3", "actuator1", "control16")}
    for k in range(10):
        t = 0.3 + 0.5 * k
        x, r = draw.randrange(-1000, 1001), draw.randrange(-1000, 1001)
        rc, servo = [draw.randrange(1000, 2001) for _ in range(18)], [draw.randrange(900, 2101) for _ in range(16)]
        outputs, controls = [draw.uniform(-1, 1) for _ in range(32)], [draw.uniform(-1, 1) for _ in range(16)]
        for later, message, sender in (
            (0.00, log.station.manual_control_encode(1, x, 0, 0, r, 0), log.station),
            (0.01, log.station.rc_channels_override_encode(1, 1, *rc), log.station),
            (0.02, log.robot.servo_output_raw_encode(0, 0, *servo), log.robot),
            (0.03, log.robot.actuator_output_status_encode(0, 32, outputs), log.robot),
            (0.04, log.robot.hil_actuator_controls_encode(0, controls, 0, 0), log.robot),
            (0.05, log.station.manual_control_encode(9, 1, 1, 1, 1, 0), log.station),
        ):
            log.records.append((UNIX_S + t + later, bytes(message.pack(sender))))
        values = (x / 1000, r / 1000, (rc[0] - 1500) / 500, (rc[17] - 1500) / 500, (servo[2] - 1500) / 500, outputs[0], controls[15])
        for name, value in zip(wanted, values, strict=True):
            wanted[name].append(value)
    path = log.write(tmp_path / "a.tlog")
    found = read_log(path, STATES, (*wanted, "v"), {"log_inputs": {"v": {"signal": "servo3", "scale": 2.0, "offset": 1.0}}})
    (((_, _), (_, u)),) = found.stretches
    for column, name in enumerate(wanted):
        assert u[~np.isnan(u[:, column]), column] == pytest.approx(wanted[name], abs=1e-6), name
    assert u[~np.isnan(u[:, -1]), -1] == pytest.approx(2.0 * np.array(wanted["servo3"]) + 1.0, abs=1e-6)
    assert found.notes == ("commands that do not count: 10 MANUAL_CONTROL (for another system)",)


def test_log_in_which_no_command_counts_says_which_there_are_and_why(tmp_path: Path) -> None:
    log = Log()
    log.drive(0.0, 8.0)
    log.sent(1.0, 0.5, 0.1, mask=1479 | 2048)
    log.sent(2.0, 0.5, 0.1, frame=20)
    log.records.append((UNIX_S + 3.0, bytes(log.station.manual_control_encode(1, 0, 0, 0, 0, 0).pack(log.station))))
    with pytest.raises(RecordingError) as raised:
        read(log.write(tmp_path / "a.tlog"), STATES, INPUTS, {})
    assert str(raised.value).endswith(
        "no command in it counts: 1 MANUAL_CONTROL (no input of the model has the name of its signals (manual_x, manual_r, ...; "
        "transport.log_inputs maps them)), "
        "1 SET_POSITION_TARGET_LOCAL_NED (in frame 20, which is neither the body's nor along north and east), "
        "1 SET_POSITION_TARGET_LOCAL_NED (their type mask ignores the yaw rate, which w is)"
    )


def test_telemetry_log_is_known_by_its_content(tmp_path: Path) -> None:
    log = Log()
    log.drive(0.0, 8.0)
    log.sent(1.0, 0.5, 0.1)
    path = log.write(tmp_path / "a.csv")
    assert readers_of(path) == ["mavlink.tlog"]
    assert load_dataset(path, compose(ModelSpec("unicycle", 0.1))).rows > 300
