"""A telemetry log's messages are named signals: every number as pymavlink reads it, and usable without a profile."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from s2r_mavlink.telemetry import open_tlog

from s2r_runtime.cli.main import main
from s2r_runtime.errors import RecordingError

START_S = 1_795_000_000.0


class Station:
    """A log as a ground station writes it, and what each of its messages holds."""

    def __init__(self) -> None:
        self.vehicle, self.other, self.ground = (mavlink.MAVLink(None, *node) for node in ((1, 1), (2, 1), (255, 190)))
        self.data = b""
        self.wrote: list[tuple[float, Any]] = []

    def take(self, node: Any, t: float, message: Any) -> None:
        frame = bytes(message.pack(node))
        node.seq = (node.seq + 1) % 256
        self.data += round((START_S + t) * 1e6).to_bytes(8, "big") + frame
        self.wrote.append((START_S + t, message))


def drive(seconds: float) -> Station:
    """A joint under a force that changes, told by another system than the robot's autopilot; and what else a link carries."""
    log, q, qd, force, draw = Station(), 0.0, 0.0, 0.0, random.Random(7)
    for k in range(round(seconds / 0.01)):
        t = 0.01 * k
        if k % 20 == 0:
            force = draw.uniform(-1.0, 1.0)
            log.take(log.ground, t, log.ground.manual_control_encode(1, round(1000 * force), 0, 0, 0, 0))
        q, qd = q + 0.01 * qd + 0.5e-4 * force, qd + 0.01 * force
        log.take(log.vehicle, t, log.vehicle.local_position_ned_encode(1000 + 10 * k, q, 0.0, 0.0, qd, 0.0, 0.0))
        if k % 10 == 0:
            log.take(log.vehicle, t, log.vehicle.heartbeat_encode(10, 3, 129, 15, 4))
            log.take(log.other, t, log.other.heartbeat_encode(10, 3, 129, 15, 4))
            log.take(log.vehicle, t, log.vehicle.named_value_float_encode(1000 + 10 * k, b"volts", 12.0 + q))
            log.take(log.vehicle, t, log.vehicle.named_value_float_encode(1000 + 10 * k, b"amps", qd))
            log.take(log.vehicle, t, log.vehicle.wind_encode(draw.uniform(0, 360), draw.uniform(0, 9), 0.0))
            log.take(log.vehicle, t, log.vehicle.statustext_encode(6, b"all is well"))
    return log


def test_every_number_is_what_pymavlink_packed(tmp_path: Path) -> None:
    log = drive(2.0)
    path = tmp_path / "a.tlog"
    path.write_bytes(log.data)
    opened = open_tlog(path)
    topics = {topic.name: topic for topic in opened.topics()}
    assert sum(topic.n for topic in topics.values()) == len(log.wrote)
    assert {"HEARTBEAT[1:1]", "HEARTBEAT[2:1]", "NAMED_VALUE_FLOAT[volts]", "NAMED_VALUE_FLOAT[amps]", "WIND"} <= set(topics)
    assert topics["LOCAL_POSITION_NED"].fields["vx"] == "m/s"
    assert math.isclose(topics["LOCAL_POSITION_NED"].rate, 100.0, rel_tol=1e-6)
    assert "text" not in topics["STATUSTEXT"].fields
    (run,) = opened.read({name: list(topic.fields) for name, topic in topics.items()})
    for message in ("LOCAL_POSITION_NED", "WIND", "MANUAL_CONTROL"):
        wrote = [(t, one) for t, one in log.wrote if one.get_type() == message]
        samples = run.samples[message]
        assert np.allclose(samples.t, [t for t, _ in wrote], rtol=0.0, atol=1e-6)
        for field, values in samples.values.items():
            assert np.array_equal(values, np.float32([getattr(one, field) for _, one in wrote]).astype(float)), field


def test_what_means_that_there_is_none_is_missing(tmp_path: Path) -> None:
    log = Station()
    for k in range(4):
        heading = 65535 if k % 2 else 9000
        log.take(log.vehicle, 0.1 * k, log.vehicle.global_position_int_encode(100 * k, 0, 0, 0, 0, 0, 0, 0, heading))
    path = tmp_path / "a.tlog"
    path.write_bytes(log.data)
    (run,) = open_tlog(path).read({"GLOBAL_POSITION_INT": ["hdg", "vx"]})
    values = run.samples["GLOBAL_POSITION_INT"].values
    assert [math.isnan(one) for one in values["hdg"]] == [False, True, False, True]
    assert values["vx"].tolist() == [0.0] * 4


def test_what_is_no_record_is_counted_and_costs_no_other(tmp_path: Path) -> None:
    log = drive(1.0)
    path = tmp_path / "a.tlog"
    broken = bytearray(log.data + random.Random(1).randbytes(500) + log.data)
    broken[40] ^= 0xFF  # within the first message
    path.write_bytes(broken)
    opened = open_tlog(path)
    assert sum(topic.n for topic in opened.topics()) >= 2 * len(log.wrote) - 2
    assert any("no record" in note for note in opened.notes)
    path.write_bytes(b"version https://example.org\n" * 9)
    with pytest.raises(RecordingError, match="must be a telemetry log"):
        open_tlog(path)


def test_gap_takes_signals_of_a_telemetry_log_without_a_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.log"  # its content counts, not its name
    path.write_bytes(drive(20.0).data)
    assert main(["topics", str(path), "--json"]) == 0
    listed = {topic["name"]: topic for topic in json.loads(capsys.readouterr().out)["topics"]}
    assert listed["MANUAL_CONTROL"]["n"] == 100
    signals = ["--state", "q=LOCAL_POSITION_NED.x", "--state", "qd=LOCAL_POSITION_NED.vx", "--input", "force=MANUAL_CONTROL.x*0.001"]
    assert main(["gap", str(path), "--model", "joint", "--dt", "0.01", *signals, "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert found["n"] > 1500
    assert found["radius"] < 2.5e-2  # a force that is a period late, of at most 2 N: 0.01 s * 2 m/s2
    assert main(["gap", str(path), "--model", "joint", "--dt", "0.01"]) == 2
    assert "--state NAME=SIGNAL" in capsys.readouterr().err
    assert main(["gap", str(path), "--model", "joint", "--dt", "0.01", "--dbc", "a.dbc", *signals]) == 2
    assert "no log of a CAN bus" in capsys.readouterr().err
