"""Logs of a bus become the same states and inputs whatever format they are in, and what is wrong with a foreign one is said on one line."""

from __future__ import annotations

import gzip
import json
import math
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from s2r_can.base import Base, Sheet
from s2r_can.checksums import Covered, crc8_j1850
from s2r_can.recordings import read
from s2r_can.standin import DBC

from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import load_profile
from s2r_runtime.recordings.formats.routes import read_recording

ROOT = Path(__file__).parents[3]
STATES, INPUTS = ("x", "y", "theta", "wheel_left", "wheel_right"), ("cmd_left", "cmd_right")
EPOCH_S = 1_700_000_000.0
S2R = [sys.executable, "-m", "s2r_runtime.cli.main"]


@pytest.fixture(scope="module")
def options() -> dict[str, Any]:
    """The profile's transport."""
    table = load_profile(ROOT / "profiles" / "amr-can.toml").transport
    return {name: value for name, value in table.items() if name != "name"}


def drive(seconds: float, seed: int = 1, effect: str = "") -> Iterator[can.Message]:
    """What is on the bus while somebody drives the stand-in base by held random commands, as cantools makes it."""
    db: Any = cantools.database.load_file(DBC)
    base, draw = Base(Sheet(), (0.0, 0.0, 0.0), seed), random.Random(seed)
    if effect:
        base.switch_on(effect)
    u = (0.0, 0.0)
    for k in range(round(seconds / 0.02)):
        t, m = EPOCH_S + 0.02 * k, base.observe()
        if k % 25 == 0:
            u = (draw.uniform(-6.0, 6.0), draw.uniform(-6.0, 6.0))
        for at, name, prefix, values in (
            (0.0, "WheelSpeeds", "Wheel", {"Left": m.left, "Right": m.right}),
            (0.0003, "Position", "Position", {"X": m.x, "Y": m.y}),
            (0.0006, "Heading", "Heading", {"Angle": math.degrees(m.theta), "Stamp": 20_000 * k % 167_772_160}),
            (0.0012, "WheelCommand", "Command", {"LeftTarget": u[0], "RightTarget": u[1], "Enable": 1}),
        ):
            message = db.get_message_by_name(name)
            modulus = 16 if prefix == "Command" else 256
            data = message.encode({**values, f"{prefix}Counter": k % modulus, f"{prefix}Checksum": 0}, strict=False)
            data = data[:-1] + bytes([crc8_j1850(Covered(data[:-1], data, 0, -1))])
            yield can.Message(timestamp=t + at, arbitration_id=message.frame_id, data=data, is_extended_id=False, channel=0)
        yield can.Message(timestamp=t + 0.002, arbitration_id=0x18FEF100, data=b"foreign!", is_extended_id=True, channel=0)
        base.move(u)


def written(path: Path, messages: list[can.Message]) -> Path:
    """A log in the format of its suffix, by python-can; `.txt.log` as candump prints it."""
    if path.name.endswith(".txt.log"):
        lines = []
        for m in messages:
            identifier = f"{m.arbitration_id:08X}" if m.is_extended_id else f"{m.arbitration_id:03X}"
            lines.append(f" ({m.timestamp:.6f})  can0  {identifier:>8}   [{m.dlc}]  {m.data.hex(' ').upper()}\n")
        path.write_text("".join(lines))
        return path
    writer = {
        ".log": can.CanutilsLogWriter,
        ".asc": can.ASCWriter,
        ".blf": can.BLFWriter,
        ".trc": can.TRCWriter,
        ".csv": can.CSVWriter,
        ".db": can.SqliteWriter,
    }[path.suffix]
    with writer(path) as log:
        for message in messages:
            log.on_message_received(message)
    return path


def moved(m: can.Message, later: float, data: bytes | None = None, channel: int = 0) -> can.Message:
    """The same, later, with other data or on another interface."""
    return can.Message(
        timestamp=m.timestamp + later,
        arbitration_id=m.arbitration_id,
        data=m.data if data is None else data,
        is_extended_id=m.is_extended_id,
        channel=channel,
    )


@pytest.fixture(scope="module")
def messages() -> list[can.Message]:
    return list(drive(20.0))


@pytest.mark.parametrize("name", ["a.log", "a.txt.log", "a.asc", "a.blf", "a.log.gz", "a.blf.gz", "a.trc", "a.csv", "a.csv.gz"])
def test_every_format_says_the_same(tmp_path: Path, options: dict[str, Any], messages: list[can.Message], name: str) -> None:
    path = written(tmp_path / name.removesuffix(".gz"), messages)
    if name.endswith(".gz"):
        (tmp_path / name).write_bytes(gzip.compress(path.read_bytes()))
    (((t, x), (tu, u)),) = read(tmp_path / name, STATES, INPUTS, options).stretches
    recorded = read_recording(tmp_path / name, compose(ModelSpec("differential_drive", 0.02)), transport={"name": "can", **options})
    assert recorded is not None, "it is no table, whatever its name"
    assert len(recorded.stretches[0].states.t) == 1000
    assert x.shape == (1000, 5)
    assert np.isfinite(x).all(), "what comes together makes one row"
    assert u.shape == (1000, 2)
    np.testing.assert_allclose(np.diff(t), 0.02, atol=2e-5)
    np.testing.assert_allclose(t - tu, -0.0006, atol=2e-5)
    db: Any = cantools.database.load_file(DBC)
    at = {
        name: [db.decode_message(i, m.data) for m in messages if m.arbitration_id == i] for i, name in ((386, "p"), (387, "h"), (513, "c"))
    }
    np.testing.assert_allclose(x[:, 0], [v["X"] for v in at["p"]], atol=1e-12)
    np.testing.assert_allclose(np.degrees(x[:, 2]), [v["Angle"] for v in at["h"]], atol=1e-10)
    np.testing.assert_allclose(u[:, 0], [v["LeftTarget"] for v in at["c"]], atol=1e-12)


def test_database_of_frames_is_read_although_other_databases_are_no_recordings(tmp_path: Path, options: dict[str, Any]) -> None:
    path = written(tmp_path / "a.db", list(drive(1.9)))  # python-can's writer loses what is beyond 500 frames when it ends at once
    recorded = read_recording(path, compose(ModelSpec("differential_drive", 0.02)), transport={"name": "can", **options})
    assert recorded is not None
    assert len(recorded.stretches[0].states.t) == 95


def test_messages_that_do_not_come_together_make_rows_with_blanks(tmp_path: Path, options: dict[str, Any]) -> None:
    shifted = [m for m in drive(2.0) if m.arbitration_id != 386]
    late = [moved(m, 0.01) for m in drive(2.0) if m.arbitration_id == 386]
    path = written(tmp_path / "late.log", sorted([*shifted, *late], key=lambda m: m.timestamp))
    (((_, x), _),) = read(path, STATES, INPUTS, options).stretches
    assert len(x) == 200
    assert np.array_equal(np.isnan(x).sum(axis=1), [2, 3] * 100)


def test_pose_is_reckoned_where_the_log_has_none(tmp_path: Path, options: dict[str, Any]) -> None:
    reckoned = {
        **{k: v for k, v in options.items() if k != "stamp"},
        "trigger": "WheelSpeeds",
        "states": {k: v for k, v in options["states"].items() if k.startswith("wheel")},
        "counters": {k: v for k, v in options["counters"].items() if k not in ("Position", "Heading")},
        "checksums": {k: v for k, v in options["checksums"].items() if k not in ("Position", "Heading")},
        "dead_reckoning": {"left": "WheelSpeeds.Left", "right": "WheelSpeeds.Right", "wheel_radius": 0.1, "track": 0.4},
    }
    messages = list(drive(20.0))
    path = written(tmp_path / "wheels.log", messages)
    (((_, x), _),) = read(path, STATES, INPUTS, reckoned).stretches
    (((_, truth), _),) = read(path, STATES, INPUTS, options).stretches
    way = float(np.sum(np.hypot(np.diff(truth[:, 0]), np.diff(truth[:, 1]))))
    # the trapezoid knows the speeds at both ends of a period and not how they changed within (time constant 60 ms, period 20 ms)
    assert np.hypot(*(x[-1, :2] - truth[-1, :2])) < 0.02 * way
    assert np.isfinite(x).all()


def test_frames_that_are_wrong_repeated_or_of_another_interface_leave_no_row(tmp_path: Path, options: dict[str, Any]) -> None:
    clean = list(drive(4.0))
    draw, spoilt = random.Random(3), []
    for m in clean:
        if draw.random() < 0.05:
            data = bytearray(m.data)
            data[draw.randrange(8)] ^= 1 << draw.randrange(8)
            spoilt.append(moved(m, 0.0, data=bytes(data)))
            continue
        spoilt.append(m)
        if draw.random() < 0.05:
            spoilt.append(moved(m, 5e-4))
        spoilt.append(moved(m, 2e-4, data=b"\x01" * 8, channel=1))
    (((t, x), _),) = read(written(tmp_path / "spoilt.log", spoilt), STATES, INPUTS, options).stretches
    (((t_clean, x_clean), _),) = read(written(tmp_path / "clean.log", clean), STATES, INPUTS, options).stretches
    assert len(t) < len(t_clean) + 20
    for column in range(5):
        there = np.isfinite(x[:, column])
        row = np.round((t[there] - t_clean[0]) / 0.02).astype(int)
        np.testing.assert_array_equal(x[there, column], x_clean[row, column])


def test_robot_that_started_anew_begins_another_stretch(tmp_path: Path, options: dict[str, Any]) -> None:
    first = list(drive(2.0))[:-40]  # its counters end at 92, and begin at 0 without a silence: nothing that a loss explains
    again = [moved(m, 1.85) for m in drive(2.0)]
    found = read(written(tmp_path / "twice.log", [*first, *again]), STATES, INPUTS, options).stretches
    assert len(found) >= 2


def bad_logs(messages: list[can.Message]) -> list[tuple[str, bytes, str]]:
    """(name, content, what must be said)."""
    line = "(1436509052.249713) can0 123#DEADBEEF\n"
    zeros = "".join(f"({k}.0) can0 182#{'00' * 7}01\n" for k in range(50)).encode()
    return [
        ("empty.log", b"", "holds no CAN frame"),
        ("other.log", line.encode() * 5, "holds none of the messages that the profile reads (BaseStatus, Heading, Position, WheelSpeeds)"),
        ("bare.log", b"  can0  123   [4]  DE AD BE EF\n" * 3, "line 1 has no time stamp"),
        ("text.log", b"hello world\n" * 3, "is no candump log: line 1: 'hello world'"),
        ("mixed.log", (line * 50 + "what?\n" * 10).encode(), "10 of 60 lines are no candump lines, the first is line 51: 'what?'"),
        ("not.blf", b"no BLF at all, and long enough to look at" * 20, "cannot be read as BLF: its header is not whole"),
        ("not.asc", b"no ASC at all\n" * 20, "holds no CAN frame"),
        ("bad.log.gz", b"\x1f\x8b\x08garbage", "gzip"),
        ("delta.log", "".join(f"(0.{k * 7919 % 1000:03d}) can0 182#{'00' * 8}\n" for k in range(200)).encode(), "time runs backwards"),
        ("zero.log", zeros, "none of 50 frames with states can be believed (checksum 50)"),
    ]  # fmt: skip


@pytest.mark.parametrize("index", range(10))
def test_log_that_is_none_is_one_clear_line(tmp_path: Path, options: dict[str, Any], messages: list[can.Message], index: int) -> None:
    name, content, says = bad_logs(messages)[index]
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(RecordingError) as raised:
        read(path, STATES, INPUTS, options)
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["cut.log", "cut.asc", "cut.blf"])
def test_log_that_ends_in_the_middle_of_a_frame_is_read_up_to_there(
    tmp_path: Path, options: dict[str, Any], messages: list[can.Message], name: str
) -> None:
    path = written(tmp_path / name, messages)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.9) - 7])
    (((t, _), _),) = read(path, STATES, INPUTS, options).stretches
    assert 100 < len(t) < 1000


def test_log_without_a_profile_says_what_it_needs(tmp_path: Path, messages: list[can.Message]) -> None:
    with pytest.raises(ConfigError):
        read(written(tmp_path / "a.log", messages[:100]), STATES, INPUTS, {})
    done = subprocess.run(
        [*S2R, "gap", str(tmp_path / "a.log"), "--model", "differential_drive", "--dt", "0.02"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "--profile" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_gap_reads_a_log_of_a_bus_as_ordinary_driving(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.blf", list(drive(20.0)))
    profile = str(ROOT / "profiles" / "amr-can.toml")
    gap = subprocess.run([*S2R, "gap", str(path), "--profile", profile, "--json"], capture_output=True, text=True, check=False)
    assert gap.returncode == 3, gap.stderr
    told = json.loads(gap.stdout)
    assert told["independent"] is False
    assert told["n"] > 950


@pytest.mark.slow
def test_trace_names_what_the_model_lacks_from_a_log_of_a_bus(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.log", list(drive(40.0, effect="input_gain:cmd_left gain=0.8")))
    profile = str(ROOT / "profiles" / "amr-can.toml")
    trace = subprocess.run([*S2R, "trace", str(path), "--profile", profile, "--json"], capture_output=True, text=True, check=False)
    assert trace.returncode == 0, trace.stderr
    found = json.loads(trace.stdout)
    assert found["verdict"] == "traced", found
    (effect,) = found["effects"]
    assert (effect["name"], effect["channel"]) == ("input_gain", "cmd_left")
    assert effect["parameters"]["gain"]["value"] == pytest.approx(0.8, abs=0.01)
