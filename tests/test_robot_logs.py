"""Robots' own logs through plug-ins: which reader is asked, and what it gives is not taken on trust."""

from __future__ import annotations

import gzip
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2r_runtime.cli.main import main
from s2r_runtime.errors import ConfigError, RecordingError, UsageError
from s2r_runtime.hookspecs import Offer, ReadLog, hookimpl
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.plugins import Registry
from s2r_runtime.recordings import robot_logs
from s2r_runtime.recordings.loading import load_transitions
from s2r_runtime.recordings.robot_logs import content_digest, is_robot_log, is_table, read_robot_log, readers_of
from s2r_runtime.trace.data.readers import load_dataset

MODEL = compose(ModelSpec("unicycle", 0.1))
GIVEN: list[Any] = []
ASKED: list[dict[str, Any]] = []
NOTES: list[str] = []


def read(path: Path, states: tuple[str, ...], inputs: tuple[str, ...], options: dict[str, Any]) -> list[Any] | ReadLog:
    """A reader that gives what the test wants."""
    assert (states, inputs) == (MODEL.states, MODEL.inputs)
    ASKED.append(options)
    if options.get("bad"):
        raise ConfigError("transport.bad: is bad")
    if not options and GIVEN == ["needs options"]:
        raise ConfigError("transport.map is missing")
    return ReadLog(GIVEN, tuple(NOTES)) if NOTES else GIVEN


def recognises(head: bytes) -> bool:
    """Its files begin so, whatever they are called."""
    return head.startswith(b"#own log")


@hookimpl
def s2r_recordings() -> list[Offer]:
    plain = [Offer(name, f"{__name__}:read") for name in ("one.rec", "two.rec", "one.own", "one.csv")]
    return [*plain, Offer("two.known", f"{__name__}:read", recognises=f"{__name__}:recognises")]


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    found = Registry()
    found.add("tests", "tests", "0", sys.modules[__name__])
    sys.modules.setdefault(read.__module__, sys.modules[__name__])
    monkeypatch.setattr(robot_logs, "registry", lambda: found)
    GIVEN.clear()
    ASKED.clear()
    NOTES.clear()
    path = tmp_path / "a.own.gz"
    path.write_bytes(b"anything")
    return path


def drive(n: int = 200) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Straight on at 0.5 m/s; states and inputs on stamps of their own, the heading half as often."""
    t = 100.0 + 0.05 * np.arange(n)
    x = np.column_stack([0.025 * np.arange(n), np.zeros(n), np.where(np.arange(n) % 2, np.nan, 0.0)])
    return (t, x), (t[::2] - 0.01, np.tile([0.5, 0.0], (n // 2, 1)))


def test_log_becomes_ordinary_driving_for_gap_and_trace_alike(registered: Path) -> None:
    GIVEN.append(drive())
    transitions = load_transitions(registered, MODEL)
    assert not transitions.independent
    assert len(transitions.x0) > 90
    np.testing.assert_allclose(transitions.x1[:, 0] - transitions.x0[:, 0], 0.05, atol=1e-9)
    data = load_dataset(registered, MODEL)
    assert data.rows >= 90
    assert set(data.digests) & {transitions.content_digest}, "the two know it again by what it says"


def test_reader_of_the_profiles_transport_gets_its_options_and_another_one_none(registered: Path, tmp_path: Path) -> None:
    GIVEN.append(drive())
    read_robot_log(registered, MODEL, {"name": "one", "map": 1})
    read_robot_log(registered, MODEL, {"name": "zenoh", "map": 1})
    read_robot_log(registered, MODEL, None)
    assert ASKED == [{"map": 1}, {}, {}]
    assert is_robot_log(tmp_path / "b.REC")
    assert not is_robot_log(tmp_path / "b.csv.gz")
    with pytest.raises(UsageError, match=r"b\.rec: could be of one\.rec or two\.rec; a profile says whose it is"):
        read_robot_log(tmp_path / "b.rec", MODEL, None)


def test_reader_that_needs_a_profile_says_so(registered: Path) -> None:
    GIVEN.append("needs options")
    with pytest.raises(UsageError, match=r"is read with a profile that says what is in it \(--profile P\): transport\.map is missing"):
        read_robot_log(registered, MODEL, None)
    with pytest.raises(ConfigError, match="is bad"):
        read_robot_log(registered, MODEL, {"name": "one", "bad": True})


@pytest.mark.parametrize("what", ["backwards", "infinite", "the largest float", "lengths", "stamps", "nothing"])
def test_rows_that_are_none_are_refused(registered: Path, what: str) -> None:
    (t, x), (tu, u) = drive()
    if what == "backwards":
        t[5] = 0.0
    elif what == "infinite":
        x[5, 0] = np.inf
    elif what == "the largest float":
        u[5, 0] = np.finfo(np.float32).max
    elif what == "lengths":
        t = t[:-1]
    elif what == "stamps":
        tu[3] = np.nan
    else:
        x[:] = np.nan
    GIVEN.append(((t, x), (tu, u)))
    with pytest.raises(RecordingError, match=r"are not in order, or not finite|holds no state"):
        read_robot_log(registered, MODEL, None)


def test_digest_is_of_what_the_log_says(registered: Path) -> None:
    GIVEN.append(drive())
    first = content_digest(read_robot_log(registered, MODEL, None).stretches, MODEL)
    GIVEN[0] = drive()
    assert content_digest(read_robot_log(registered, MODEL, None).stretches, MODEL) == first
    (t, x), inputs = drive()
    x[3, 0] += 1e-3
    GIVEN[0] = (t, x), inputs
    assert content_digest(read_robot_log(registered, MODEL, None).stretches, MODEL) != first


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz", "a.rec", "a"])
def test_content_decides_whatever_the_name(tmp_path: Path, name: str) -> None:
    data = b"#own log" + bytes(range(256)) * 300
    path = tmp_path / name
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    assert readers_of(path) == ["two.known"]
    assert not is_table(path)
    GIVEN.append(drive())
    assert len(read_robot_log(path, MODEL, {"name": "zenoh", "map": 1}).stretches) == 1
    assert ASKED == [{}], "it is of another transport than the profile's"


def test_table_is_no_log_whatever_a_plug_in_offers(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,x,y,theta,v,w\n0,0,0,0,0,0\n")
    assert is_table(path)
    assert not is_robot_log(path)


def test_notes_of_a_reader_reach_the_person(registered: Path, capsys: pytest.CaptureFixture[str]) -> None:
    GIVEN.append(drive())
    NOTES.extend(["3 frames cannot be read", "stamps are relative"])
    assert load_dataset(registered, MODEL).notes == load_transitions(registered, MODEL).notes == tuple(NOTES)
    assert main(["gap", str(registered), "--model", "unicycle", "--dt", "0.1"]) == 3
    said = capsys.readouterr().err.splitlines()
    assert [f"s2r: {registered}: {note}" for note in NOTES] == [line for line in said if str(registered) in line][:2]
