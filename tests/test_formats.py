"""Other people's formats: recognised by content, read without a mismatch, and nothing but one line for what is damaged or not installed."""

from __future__ import annotations

import random
import resource
import struct
from collections.abc import Callable
from pathlib import Path

import foreign_files as foreign
import numpy as np
import pytest
from foreign_files import DT, Drive

from s2r_runtime.cli.main import main
from s2r_runtime.errors import RecordingError, S2RError, UsageError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recordings.formats import isolated
from s2r_runtime.recordings.formats.guess import guessed
from s2r_runtime.recordings.formats.recognise import open_recording, recognised
from s2r_runtime.recordings.formats.series import Topic
from s2r_runtime.recordings.formats.signals import resolve
from s2r_runtime.recordings.loading import load_transitions
from s2r_runtime.trace.data.readers import load_dataset

MODEL = compose(ModelSpec("unicycle", DT))
UNICYCLE = ["--model", "unicycle", "--dt", str(DT)]
DEGREE_CENT = 0.01 * np.pi / 180.0
"""rad; DataFlash's yaw is a whole number of hundredths of a degree."""
FLOAT32 = 2.0 * np.pi * 2.0**-24
"""rad; rounding of an angle in 32 bits."""

Writer = Callable[[Path, Drive], Path]
KINDS: dict[str, tuple[str, Writer, dict[str, str], float]] = {
    # suffix, writer, signals that no usual name says, error of a state or input that the format allows
    "ulog": ("ulg", foreign.ulog, foreign.ULOG_SIGNALS, FLOAT32),
    "dataflash": ("bin", foreign.dataflash, {}, DEGREE_CENT),
    "mf4": ("mf4", foreign.mdf, {}, 1e-12),
    "mdf3": ("mdf", lambda path, made: foreign.mdf(path, made, "3.30"), {}, 1e-12),
    "parquet": ("parquet", foreign.parquet, {}, 1e-12),
    "matlab": ("mat", foreign.matlab, {}, 1e-12),
    "matlab 4": ("mat", lambda path, made: foreign.matlab(path, made, "4"), {}, 1e-12),
    "matlab structure": ("mat", lambda path, made: foreign.matlab(path, made, nested=True), {}, 1e-12),
}


def written(kind: str, folder: Path, made: Drive) -> Path:
    suffix, write, _, _ = KINDS[kind]
    return write(folder / f"a.{suffix}", made)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_25_files_of_a_kind_are_read_without_a_mismatch(kind: str, tmp_path: Path) -> None:
    _, _, signals, error = KINDS[kind]
    for seed in range(25):
        made = foreign.drive(seed, n=20 + 3 * seed, start=float(seed))
        found = load_transitions(written(kind, tmp_path, made), MODEL, signals=signals)
        n = len(made.t) - 1
        assert (len(found.x0), found.independent) == (n, False)
        want = np.column_stack([made.columns[name] for name in MODEL.states])
        assert np.max(np.abs(MODEL.difference(found.x0, want[:-1]))) <= error
        assert np.max(np.abs(MODEL.difference(found.x1, want[1:]))) <= error
        assert np.max(np.abs(found.u - np.column_stack([made.columns["v"], made.columns["w"]])[:-1])) <= max(error, 1e-9)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_the_name_of_a_file_decides_nothing(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = foreign.drive(1)
    path = written(kind, tmp_path, made)
    other = path if kind == "matlab 4" else path.rename(tmp_path / "drive.csv")  # version 4 has no magic, so its suffix counts
    options = [option for name, signal in KINDS[kind][2].items() for option in ("--input", f"{name}={signal}")]
    assert main(["gap", str(other), *UNICYCLE, *options]) == 3, "ordinary driving"
    said = capsys.readouterr()
    assert "gap radius" in said.out
    assert "taken by their names: x=" in said.err
    assert main(["topics", str(other), "--model", "unicycle"]) == 0
    assert "unicycle: --state x=" in capsys.readouterr().out


def test_instances_of_a_message_are_topics_of_their_own(tmp_path: Path) -> None:
    made = foreign.drive(2)
    for path, name in (
        (foreign.ulog(tmp_path / "a", made, 2), "vehicle_local_position[1].x"),
        (foreign.dataflash(tmp_path / "b", made, 2), "XKF1[1].PN"),
    ):
        signals = {**(foreign.ULOG_SIGNALS if name.startswith("v") else {}), "x": name}
        assert np.allclose(load_transitions(path, MODEL, signals=signals).x0[:, 0], made.columns["x"][:-1] + 1.0)


def test_dataflash_says_what_pymavlinks_own_messages_say(tmp_path: Path) -> None:
    from pymavlink import DFReader

    path = foreign.dataflash(tmp_path / "a.bin", foreign.drive(3), 2)
    ours = open_recording(path).read({"XKF1[0]": ["Yaw", "PN", "PE"], "STER": ["DesTurnRate"]})[0].samples
    theirs = DFReader.DFReader_binary(str(path))
    rows: dict[str, list[tuple[float, ...]]] = {"XKF1[0]": [], "STER": []}
    while (message := theirs.recv_match(type=["XKF1", "STER"])) is not None:
        if message.get_type() == "STER":
            rows["STER"].append((message.TimeUS * 1e-6, message.DesTurnRate))
        elif message.C == 0:
            rows["XKF1[0]"].append((message.TimeUS * 1e-6, message.Yaw, message.PN, message.PE))
    theirs.data_map.close()
    theirs.filehandle.close()
    for name, found in rows.items():
        assert np.array_equal(np.array(found), np.column_stack([ours[name].t, *ours[name].values.values()]))


def test_ulog_that_pyulog_wrote_says_the_same(tmp_path: Path) -> None:
    import pyulog

    path = foreign.ulog(tmp_path / "a.ulg", foreign.drive(4), 2)
    pyulog.ULog(str(path)).write_ulog(str(tmp_path / "b.ulg"))
    one, other = (load_transitions(tmp_path / name, MODEL, signals=foreign.ULOG_SIGNALS) for name in ("a.ulg", "b.ulg"))
    assert np.array_equal(one.x0, other.x0)
    assert one.content_digest == other.content_digest


# ---------------------------------------------------------------- data sets


@pytest.mark.parametrize("files", [1, 3])
def test_each_episode_of_a_data_set_is_a_run(files: int, tmp_path: Path) -> None:
    drives = [foreign.drive(seed, n=30 + seed) for seed in range(5)]
    folder = foreign.lerobot(tmp_path / "set", drives, files=files)
    found = load_transitions(folder, MODEL)
    assert len(found.x0) == sum(len(one.t) - 1 for one in drives), "no transition from one episode to the next"
    assert not found.independent
    data = load_dataset(folder, MODEL)
    assert len(data.runs) == len(drives)
    assert data.called == tuple(f"episode {k}" for k in range(5))
    bare = foreign.lerobot(tmp_path / "bare", drives, files=files, names=False)
    signals = {name: f"observation.state[{k}]" for k, name in enumerate(MODEL.states)} | {"v": "action[0]", "w": "action[1]"}
    assert np.array_equal(load_transitions(bare, MODEL, signals=signals).x1, found.x1)
    with pytest.raises(UsageError, match="which signals are x, y, theta, v, w"):
        load_transitions(bare, MODEL)


def test_segments_of_a_parquet_table_are_samples_as_in_a_csv(tmp_path: Path) -> None:
    made, segment = foreign.drive(6), np.repeat(np.arange(30), 2).astype(str)
    path = foreign.parquet(tmp_path / "a.parquet", made, segment=segment)
    rows = np.column_stack([made.t, *made.columns.values(), segment.astype(float)])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="t,x,y,theta,v,w,segment", comments="", fmt="%.17g")
    ours, table = load_transitions(path, MODEL), load_transitions(tmp_path / "a.csv", MODEL)
    assert ours.independent
    assert np.array_equal(ours.x1, table.x1)
    assert len(ours.x0) == 30


def test_stamps_of_another_name(tmp_path: Path) -> None:
    made = foreign.drive(7)
    path = foreign.parquet(tmp_path / "a.parquet", made, clock=made.t * 2.0)
    slow = compose(ModelSpec("unicycle", 2.0 * DT))
    assert np.allclose(load_transitions(path, slow, {"t": "clock"}).t0_s, 2.0 * made.t[:-1])


# ---------------------------------------------------------------- several at once


def test_several_recordings_are_runs_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drives = [foreign.drive(seed) for seed in (1, 2, 3)]
    paths = [foreign.parquet(tmp_path / f"{k}.parquet", made) for k, made in enumerate(drives)]
    found = load_transitions(paths, MODEL)
    assert len(found.x0) == sum(len(one.t) - 1 for one in drives)
    assert len(load_dataset(paths, MODEL).runs) == 3
    assert main(["gap", *map(str, paths), *UNICYCLE]) == 3
    assert main(["trace", *map(str, paths), *UNICYCLE]) == 0
    capsys.readouterr()
    fitted = compose(ModelSpec("unicycle", DT, fitted_on=(load_transitions(paths[1], MODEL).content_digest,)))
    from s2r_runtime.evidence.gap import refuse_fitted

    with pytest.raises(S2RError, match="was fitted on this recording"):
        refuse_fitted(fitted, found)


@pytest.mark.parametrize("verb", ["gap", "trace"])
def test_the_same_recording_twice_is_refused(verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = foreign.drive(1)
    one = foreign.parquet(tmp_path / "a.parquet", made)
    other = foreign.parquet(tmp_path / "b.parquet", made, more=made.t)
    for twin in (one, other):
        assert main([verb, str(one), str(twin), *UNICYCLE]) == 2
        assert "once more (the same values)" in capsys.readouterr().err


def test_samples_and_driving_do_not_count_together(tmp_path: Path) -> None:
    made = foreign.drive(1)
    drawn = foreign.parquet(tmp_path / "a.parquet", made, segment=np.repeat(np.arange(30), 2))
    with pytest.raises(UsageError, match=r"a\.parquet has segments, which count as samples, .*b\.parquet is ordinary driving"):
        load_transitions([drawn, foreign.parquet(tmp_path / "b.parquet", foreign.drive(2))], MODEL)


# ---------------------------------------------------------------- what cannot be read


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_damaged_files_are_one_line_or_read_as_far_as_they_hold(kind: str, tmp_path: Path) -> None:
    suffix, _, signals, _ = KINDS[kind]
    whole = written(kind, tmp_path, foreign.drive(8)).read_bytes()
    draw, path = random.Random(kind), tmp_path / f"bad.{suffix}"
    refused: list[S2RError] = []
    tries = 16 if kind.startswith("m") else 36
    for k in range(tries):
        data = bytearray(whole)
        if k % 2:
            del data[draw.randrange(1, len(data)) :]
        for _ in range(draw.randint(1, 8) if k % 3 else 0):
            data[draw.randrange(min(16, len(data) - 1), len(data))] = draw.randrange(256)
        path.write_bytes(data)
        try:
            found = load_transitions(path, MODEL, signals=signals)
        except S2RError as error:
            refused.append(error)
        else:
            assert np.isfinite(found.x0).all()
            assert np.isfinite(found.x1).all()
    assert {error.exit_code for error in refused} <= {2, 3}
    assert all("\n" not in str(error) and str(path) in str(error) for error in refused)
    assert len(refused) < tries or kind in ("mf4", "mdf3", "matlab", "matlab structure"), "an intact beginning is read"
    isolated.stop()  # what it took counts once it has ended
    most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    assert most < 1500, f"{most} MB"


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "empty"),
        (
            b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(600),
            r"version 7.3 \(HDF5\), which is not read; in MATLAB: save\(FILE, '-v7'\)",
        ),
        (b"MATLAB 7.0 MAT-file, HDF5 schema 0.05" + bytes(600), "is a MATLAB file of version 7.3"),
        (b"\x89HDF\r\n\x1a\n" + bytes(600), "is an HDF5 file, which is not read"),
        (b"SQLite format 3\0" + bytes(600), "is an SQLite database, and no ROS 2 bag"),
        (b"PK\x03\x04" + bytes(600), "is a ZIP archive"),
        (b"\x93NUMPY\x01\x00" + bytes(600), "is a NumPy array"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "is a pointer of Git LFS"),
        (b"\n<!DOCTYPE html>\n<html>sign in</html>", "is a web page"),
        (b'{"t": [0, 1],\n "x": [0, 1]}\n', "is JSON, which is not read"),
        ("t,x\n0,1\n".encode("utf-16"), "is text in UTF-16"),
        (b"ULog\x01\x12\x35" + bytes(9), "this PX4 ULog holds no logged message"),
        (b"\xa3\x95\x80\x80\x59FMT\0BBnNZ\0", "this ArduPilot DataFlash log"),
        (b"PAR1" + bytes(20), "this Parquet file cannot be read"),
        (b"MDF     4.10    own", r"this MF4 \(ASAM MDF\) file cannot be read"),
        (b"MATLAB 5.0 MAT-file" + bytes(109), "this MATLAB file"),
    ],
)
def test_what_is_known_and_not_read_is_said_by_its_name(content: bytes, why: str, tmp_path: Path) -> None:
    path = tmp_path / "a.log.bin"
    path.write_bytes(content)
    for load in (load_transitions, load_dataset):
        with pytest.raises(UsageError, match=why) as caught:
            load(path, MODEL)
        assert "\n" not in str(caught.value)


def test_objects_of_a_matlab_class_cost_no_other_variable(tmp_path: Path) -> None:
    """As MATLAB writes a string or a table: class 17 (opaque), its name, MCOS, the class, and a matrix of references."""
    from scipy.io import savemat

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    path, other = tmp_path / "a.mat", tmp_path / "b.mat"
    savemat(path, {"t": np.arange(9.0), "x": np.arange(9.0) ** 2})
    savemat(other, {"s": np.arange(6, dtype=np.uint32)})
    texts = b"".join(element(1, text) for text in (b"label", b"MCOS", b"string"))
    opaque = element(6, struct.pack("<II", 17, 0)) + texts + other.read_bytes()[128:]
    path.write_bytes(path.read_bytes() + element(14, opaque))
    opened = open_recording(path)
    assert [topic.fields for topic in opened.topics()] == [{"x": ""}]
    assert any("objects of MATLAB classes" in note for note in opened.notes)
    assert opened.read({"": ["x"]})[0].samples[""].values["x"].tolist() == [k * k for k in range(9)]


def test_topics_of_a_table_know_its_stamps_by_their_usual_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.csv"
    path.write_text("%time_ms,x\n0,1\n500,2\n")
    assert main(["topics", str(path)]) == 0
    assert "n 2  2 Hz" in capsys.readouterr().out
    for text in ("some notes\nof a day\n", "timestamp x y\n0 1 2\n"):
        path.write_text(text)
        assert main(["topics", str(path)]) == 2
        assert "is no table" in capsys.readouterr().err


def test_dataflash_that_describes_a_message_without_a_length_is_refused(tmp_path: Path) -> None:
    data = bytearray(foreign.dataflash(tmp_path / "a.bin", foreign.drive(1)).read_bytes())
    at = data.index(b"\xa3\x95\x80", 3 * 89)
    data[at + 4] = 0
    (tmp_path / "a.bin").write_bytes(data)
    with pytest.raises(RecordingError, match="it describes a message of 0 bytes"):
        load_transitions(tmp_path / "a.bin", MODEL)


def test_matlab_file_that_claims_too_much_is_refused_before_it_is_read(tmp_path: Path) -> None:
    data = bytearray(foreign.matlab(tmp_path / "a.mat", foreign.drive(1)).read_bytes())
    at = data.index(struct.pack("<ii", 1, 60))
    data[at : at + 8] = struct.pack("<ii", 40_000, 40_000)
    (tmp_path / "a.mat").write_bytes(data)
    with pytest.raises(RecordingError, match=r"claims 1\.6e\+09 numbers"):
        load_transitions(tmp_path / "a.mat", MODEL)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "module", "command"),
    [
        ("ulog", "pyulog", "this is a PX4 ULog; pip install 's2r-runtime[formats]'"),
        ("mf4", "asammdf", "this is an MF4 (ASAM MDF) measurement file; pip install 's2r-runtime[formats]'"),
        ("parquet", "pyarrow", "this is a Parquet file; pip install 's2r-runtime[formats]'"),
    ],
)
def test_what_is_not_installed_is_said_with_the_command_that_helps(
    kind: str, module: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(kind, tmp_path, foreign.drive(1))
    (tmp_path / "lacking" / module).mkdir(parents=True)
    (tmp_path / "lacking" / module / "__init__.py").write_text(f"raise ModuleNotFoundError(name={module!r})")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "lacking"))
    isolated.stop()
    try:
        for verb in ("gap", "trace", "topics"):
            assert main([verb, str(path), *(UNICYCLE if verb != "topics" else [])]) == 2
            assert command in capsys.readouterr().err
    finally:
        isolated.stop()


def test_the_small_cases_are_said_by_their_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for content, what in ((b"#ROSBAG V2.0\nE\0\0\0\7\0\0\0op=\3\xc7\xff", "this ROS 1 bag"), (b"MDF     4.10    own\0\0\0\x9b\1", "MF4")):
        path = tmp_path / "head"
        path.write_bytes(content)
        assert main(["gap", str(path), *UNICYCLE]) == 2
        said = capsys.readouterr().err
        assert what in said
        assert said.count("\n") == 1


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"is a folder; it must be a ROS 2 bag .* or a LeRobot data set"):
        recognised(tmp_path)


# ---------------------------------------------------------------- names of signals

TOPICS = [
    Topic(
        "/odom",
        "nav_msgs/msg/Odometry",
        9,
        0,
        1,
        dict.fromkeys([f"pose.pose.{a}.{b}" for a in ("position", "orientation") for b in "xyzw"], ""),
    ),
    Topic("/cmd_vel", "geometry_msgs/msg/Twist", 9, 0, 1, {"linear.x": "", "angular.z": ""}),
    Topic("/joy/cmd_vel", "geometry_msgs/msg/Twist", 99, 0, 1, {"linear.x": "", "angular.z": ""}),
    Topic("ATT", "message", 9, 0, 1, {"Yaw": "deg", "t": "s"}),
]


@pytest.mark.parametrize(
    ("text", "name", "factor"),
    [
        ("/cmd_vel.linear.x", "/cmd_vel.linear.x", 1.0),
        ("cmd_vel.twist.linear.x", "/cmd_vel.linear.x", 1.0),
        ("/odom.position.y*-2", "/odom.pose.pose.position.y", -2.0),
        ("/odom.pose.pose.orientation", "/odom.pose.pose.orientation", 1.0),
        ("Yaw", "ATT.Yaw", np.pi / 180.0),
        ("ATT.Yaw * 1e-2", "ATT.Yaw", 0.01 * np.pi / 180.0),
    ],
)
def test_signals_are_found_by_their_names(text: str, name: str, factor: float) -> None:
    found = resolve(text, TOPICS, "f")
    assert (found.name, found.factor) == (name, pytest.approx(factor))


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("/cmd_vel.linear.y", "there is no signal '/cmd_vel.linear.y'; nearest: /cmd_vel.linear.x"),
        ("/cmd_vel", "that is a topic; its signals: /cmd_vel.linear.x, /cmd_vel.angular.z"),
        ("linear.x", "'linear.x' may be /cmd_vel.linear.x, /joy/cmd_vel.linear.x; write the topic before it"),
        ("Yaw*0", "must be a finite number other than 0"),
    ],
)
def test_signals_that_are_not_there_name_the_nearest(text: str, why: str) -> None:
    with pytest.raises(UsageError) as caught:
        resolve(text, TOPICS, "f")
    assert why in str(caught.value)


def test_yaw_of_a_quaternion_and_none_of_zeros() -> None:
    angle = np.array([-3.0, -1.0, 0.5, 2.0])
    found = resolve("/odom.pose.pose.orientation", TOPICS, "f")
    q = dict.fromkeys(found.fields, np.zeros(5)) | {
        found.fields[2]: np.append(np.sin(angle / 2), 0.0),
        found.fields[3]: np.append(np.cos(angle / 2), 0.0),
    }
    assert np.allclose(found.values(q)[:4], angle)
    assert np.isnan(found.values(q)[4]), "a driver that knows no orientation"


def test_usual_names_are_taken_and_a_joystick_is_not() -> None:
    assert guessed(MODEL, TOPICS) == {
        "x": "/odom.pose.pose.position.x",
        "y": "/odom.pose.pose.position.y",
        "theta": "/odom.pose.pose.orientation",
        "v": "/cmd_vel.linear.x",
        "w": "/cmd_vel.angular.z",
    }


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--state", "z=x"], "the model has no state 'z'; it has: x, y, theta"),
        (["--state", "v=x"], "it is an input: --input v=x"),
        (["--input", "v"], "must be NAME=SIGNAL"),
        (["--input", "v=a", "--input", "v=b"], "v is a already"),
        (["--input", "v=nothing"], "there is no signal 'nothing'"),
    ],
)
def test_options_that_name_no_signal_are_refused(options: list[str], why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = foreign.parquet(tmp_path / "a.parquet", foreign.drive(1))
    assert main(["gap", str(path), *UNICYCLE, *options]) == 2
    assert why in capsys.readouterr().err
