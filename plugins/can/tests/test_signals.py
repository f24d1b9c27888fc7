"""A CAN log's signals are named by a DBC: every number as cantools reads it, and usable without a profile."""

from __future__ import annotations

import importlib.util
import json
import math
import random
from pathlib import Path

import cantools
import pytest
from s2r_can.signals import open_log

from s2r_runtime.cli.main import main
from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recordings.loading import load_transitions

SPEC = importlib.util.spec_from_file_location("random_dbc", Path(__file__).with_name("random_dbc.py"))
assert SPEC is not None
assert SPEC.loader is not None
random_dbc = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(random_dbc)

JOINT = """VERSION ""

BS_:

BU_: A

BO_ 256 State: 8 A
 SG_ Pos : 0|32@1- (1e-06,0) [-100|100] "m" A
 SG_ Speed : 32|16@1- (0.1,0) [0|0] "mm/s" A
 SG_ Mode : 48|8@1+ (1,0) [0|0] "" A

BO_ 257 Cmd: 2 A
 SG_ Force : 0|16@1- (0.001,0) [0|0] "N" A

BO_ 2364540158 EEC1: 8 A
 SG_ EngSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" A

BO_ 258 Torn: 8 A
 SG_ Bad : 0|16@1+ (1,0 [0|0] "" A

VAL_ 256 Mode 0 "init" 1 "drive" 255 "not available" ;
"""


def write(path: Path, frames: list[tuple[float, str, int, bool, bytes]]) -> Path:
    """As candump -l does. frames: (t, channel, identifier, extended, payload)."""
    path.write_text(
        "".join(
            f"({1.7e9 + t:.6f}) {channel} {number:0{8 if extended else 3}X}{'##0' if len(data) > 8 else '#'}{data.hex().upper()}\n"
            for t, channel, number, extended, data in frames
        )
    )
    return path


@pytest.mark.parametrize("seed", range(8))
def test_signals_are_what_cantools_decodes(seed: int, tmp_path: Path) -> None:
    dbc, draw = tmp_path / "a.dbc", random.Random(seed)
    dbc.write_text(random_dbc.Dbc(seed).text)
    messages = cantools.database.load_file(dbc, strict=False).messages
    sent = {message.name: [draw.randbytes(message.length) for _ in range(30)] for message in messages}
    at = {message.name: (message.frame_id, message.is_extended_frame) for message in messages}
    frames = [(0.01 * k, "can0", *at[name], data) for name, payloads in sent.items() for k, data in enumerate(payloads)]
    opened = open_log(write(tmp_path / "a.log", sorted(frames, key=lambda frame: frame[0])), str(dbc))
    topics = {topic.name: topic for topic in opened.topics()}
    assert set(topics) == set(sent)
    (run,) = opened.read({name: list(topic.fields) for name, topic in topics.items()})
    compared = 0
    for message in messages:
        for k, data in enumerate(sent[message.name]):
            try:
                decoded = message.decode(data, decode_choices=False)
            except cantools.database.DecodeError:  # a multiplexer that selects nothing
                continue
            assert isinstance(decoded, dict)
            for field, values in run.samples[message.name].values.items():
                value = values[k]
                signal = message.get_signal_by_name(field)
                if math.isnan(value):  # not selected, or no measurement
                    low, high = (float(one) if one is not None else None for one in (signal.minimum, signal.maximum))
                    wanted = float(decoded.get(field, math.nan))
                    assert not abs(wanted) <= 1e9 or (low is not None and wanted < low) or (high is not None and wanted > high)
                else:
                    assert math.isclose(value, float(decoded[field]), rel_tol=1e-12)
                    compared += 1
    assert compared > 50


def joint_log(path: Path) -> Path:
    frames, q, qd, force, draw = [], 0.0, 0.0, 0.0, random.Random(5)
    for k in range(2000):
        t = 0.01 * k
        if k % 20 == 0:
            force = draw.uniform(-1.0, 1.0)
            frames.append((t, "can0", 0x101, False, round(1000 * force).to_bytes(2, "little", signed=True)))
        state = round(q * 1e6).to_bytes(4, "little", signed=True) + round(qd * 1e4).to_bytes(2, "little", signed=True) + b"\1\0"
        frames.append((t, "can0", 0x100, False, state))
        q, qd = q + 0.01 * qd + 0.5e-4 * force, qd + 0.01 * force
        if k % 100 == 0:
            frames += [(t, "can0", 0x0CF00400 + source, True, bytes(8)) for source in (0, 3)] + [(t, "can1", 0x7F0, False, b"\1")]
            frames += [(t, "can0", 0x102, False, bytes(8))]
    return write(path, frames)


def test_identifiers_without_a_dbc_and_messages_with_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, dbc = joint_log(tmp_path / "drive.txt"), tmp_path / "joint.dbc"
    dbc.write_text(JOINT)
    assert main(["topics", str(log), "--json"]) == 3
    found = {topic["name"]: topic for topic in json.loads(capsys.readouterr().out)["topics"]}
    assert (found["can0:100"]["n"], found["can0:100"]["rate_hz"]) == (2000, pytest.approx(100.0, rel=1e-4))
    assert set(found) == {"can0:100", "can0:101", "can0:102", "can0:0CF00400", "can0:0CF00403", "can1:7F0"}
    assert main(["topics", str(log), "--dbc", str(dbc), "--json"]) == 0
    found = {topic["name"]: topic for topic in json.loads(capsys.readouterr().out)["topics"]}
    assert found["State"]["signals"] == {"Pos": "m", "Speed": "mm/s", "Mode": ""}
    assert found["EEC1[00]"]["n"] == found["EEC1[03]"]["n"] == 20  # J1939: whatever address, whatever priority
    assert "cannot be read" in found["can0:102"]["note"]
    assert found["can1:7F0"]["note"] == "not in the DBC"


@pytest.mark.slow
def test_gap_takes_signals_of_a_can_log_without_a_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, dbc = joint_log(tmp_path / "drive.log"), tmp_path / "joint.dbc"
    dbc.write_text(JOINT)
    model = ["--model", "joint", "--dt", "0.01"]
    signals = ["--state", "q=State.Pos", "--state", "qd=State.Speed", "--input", "force=Cmd.Force"]
    assert main(["gap", str(log), *model, *signals, "--dbc", str(dbc), "--json"]) == 3
    heard = capsys.readouterr()
    found = json.loads(heard.out)
    assert found["n"] > 1900
    assert found["radius"] < 3e-4  # rounding of the bus: 0.1 mm/s, 1 mN
    assert "State.Speed is in mm/s" in heard.err
    assert main(["trace", str(log), *model, *signals, "--dbc", str(dbc), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["effects"] == []
    assert main(["gap", str(log), *model, *signals]) == 2
    assert "--dbc" in capsys.readouterr().err
    assert main(["gap", str(log), *model, "--dbc", str(dbc), "--state", "q=State.Position"]) == 2
    assert "nearest: State.Pos" in capsys.readouterr().err


def test_signals_that_are_named_go_before_a_profile_whose_dbc_names_them(tmp_path: Path) -> None:
    log = joint_log(tmp_path / "drive.log")
    transport = {"name": "can", "dbc": {"file": "joint.dbc", "text": JOINT}, "states": {"q": "State.Pos"}, "trigger": "State"}
    named = {"q": "State.Pos", "qd": "State.Speed", "force": "Cmd.Force"}
    assert len(load_transitions(log, compose(ModelSpec("joint", 0.01)), transport=transport, signals=named).x0) > 1900


def test_values_that_are_no_measurement_are_missing_and_counted(tmp_path: Path) -> None:
    dbc = tmp_path / "joint.dbc"
    dbc.write_text(JOINT)
    frames = [(0.01 * k, "can0", 0x100, False, bytes(6) + (b"\xff\0" if k % 4 == 0 else b"\1\0")) for k in range(40)]
    frames += [(1.0, "can0", 0x100, False, b"\0\0")]
    opened = open_log(write(tmp_path / "a.log", frames), str(dbc))
    (run,) = opened.read({"State": ["Mode"]})
    assert [math.isnan(value) for value in run.samples["State"].values["Mode"]] == [k % 4 == 0 for k in range(40)]
    assert any("1 frames of State are shorter" in note for note in opened.notes)
    assert any("10 values of State.Mode" in note for note in opened.notes)


def test_drives_that_were_put_together_are_runs_and_differences_are_refused(tmp_path: Path) -> None:
    dbc = tmp_path / "joint.dbc"
    dbc.write_text(JOINT)
    once = [(0.01 * k, "can0", 0x100, False, bytes(8)) for k in range(300)]
    opened = open_log(write(tmp_path / "a.log", once + once), str(dbc))
    assert [len(run.samples["State"].t) for run in opened.read({"State": ["Pos"]})] == [300, 300]
    (topic,) = opened.topics()
    assert topic.rate == pytest.approx(100.0, rel=0.01)
    apart = [(0.01 if k % 2 else 0.012, "can0", 0x100, False, bytes(8)) for k in range(300)]
    with pytest.raises(RecordingError, match="candump -td"):
        open_log(write(tmp_path / "b.log", apart), str(dbc))


def test_database_that_is_none_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = joint_log(tmp_path / "drive.log")
    (tmp_path / "a.dbc").write_text("nothing\n")
    assert main(["topics", str(log), "--dbc", str(tmp_path / "a.dbc")]) == 2
    assert "has no messages" in capsys.readouterr().err
    assert main(["topics", str(log), "--dbc", str(tmp_path / "lacks.dbc")]) == 2
    assert "cannot be read: No such file" in capsys.readouterr().err
