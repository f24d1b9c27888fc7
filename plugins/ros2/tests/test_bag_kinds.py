"""Bags of every kind, written by `rosbags`: ROS 1, SQLite, MCAP, folders, split, compressed; read without a mismatch."""

from __future__ import annotations

import random
import shutil
import sqlite3
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from s2r_ros2.bag_files import open_bag
from s2r_ros2.records import unpacked
from s2r_ros2.typed import Types

from s2r_runtime.cli.main import main
from s2r_runtime.errors import RecordingError, S2RError, UsageError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recordings.formats.recognise import open_recording
from s2r_runtime.recordings.loading import load_transitions
from s2r_runtime.trace.data.readers import load_dataset

DT = 0.05
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
MODEL = compose(ModelSpec("unicycle", DT))
UNICYCLE = ["--model", "unicycle", "--dt", str(DT)]
CUSTOM = "std_msgs/Header header\nfloat64[3] pose\nuint8[] blob\nstring name\n"
ROS2, ROS1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
for _store in (ROS2, ROS1):
    _store.register(get_types_from_msg(CUSTOM, "lab_msgs/msg/Tracked"))
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))


class Row:
    """A moment of a drive."""

    def __init__(self, k: int, pose: tuple[float, float, float], twist: tuple[float, float]) -> None:
        self.t_ns = START + round(k * DT * SECOND)
        self.pose, self.twist = pose, twist


def driven(seed: int, n: int = 60) -> list[Row]:
    """Steps of the model, a new command every half a second."""
    draw = random.Random(seed)
    x, y, theta, v, w = 0.0, 0.0, 0.2, 0.0, 0.0
    rows = []
    for k in range(n):
        if k % 10 == 0:
            v, w = draw.uniform(-1.0, 1.0), draw.uniform(-1.0, 1.0)
        rows.append(Row(k, (x, y, theta), (v, w)))
        x, y, theta = x + DT * v * np.cos(theta), y + DT * v * np.sin(theta), theta + DT * w
    return rows


def messages(store: Any, rows: list[Row], names: dict[str, str]) -> Iterator[tuple[str, str, int, Any]]:
    """(topic, type, ns, message)."""
    t = store.types
    for k, row in enumerate(rows):
        stamp = t["builtin_interfaces/msg/Time"](row.t_ns // SECOND, row.t_ns % SECOND)
        header = t["std_msgs/msg/Header"](*((k,) if store is ROS1 else ()), stamp, "odom")
        (x, y, theta), (v, w) = row.pose, row.twist
        vector = t["geometry_msgs/msg/Vector3"]
        turned = t["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2))
        twist = t["geometry_msgs/msg/Twist"](vector(v, 0.0, 0.0), vector(0.0, 0.0, w))
        pose = t["geometry_msgs/msg/PoseWithCovariance"](
            t["geometry_msgs/msg/Pose"](t["geometry_msgs/msg/Point"](x, y, 0.0), turned), np.zeros(36)
        )
        odometry = t["nav_msgs/msg/Odometry"](header, "base", pose, t["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)))
        moved = t["geometry_msgs/msg/TransformStamped"](header, "base", t["geometry_msgs/msg/Transform"](vector(x, y, 0.0), turned))
        tracked = t["lab_msgs/msg/Tracked"](header, np.array([x, y, theta]), np.zeros(4, np.uint8), "it")
        yield names.get("cmd_vel", "/cmd_vel"), "geometry_msgs/msg/Twist", row.t_ns, twist
        yield names.get("odom", "/odom"), "nav_msgs/msg/Odometry", row.t_ns, odometry
        yield "/tf", "tf2_msgs/msg/TFMessage", row.t_ns, t["tf2_msgs/msg/TFMessage"]([moved])
        yield "/lab/tracked", "lab_msgs/msg/Tracked", row.t_ns, tracked


def rosbag2(
    path: Path, rows: list[Row], plugin: StoragePlugin, mode: CompressionMode | None = None, names: dict[str, str] | None = None
) -> Path:
    writer = Writer2(path, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        known: dict[str, Any] = {}
        for topic, kind, t_ns, message in messages(ROS2, rows, names or {}):
            known.setdefault(topic, None)
            if known[topic] is None:
                known[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(known[topic], t_ns, ROS2.serialize_cdr(message, kind))
    return path


def rosbag1(path: Path, rows: list[Row], how: Writer1.CompressionFormat | None = None, names: dict[str, str] | None = None) -> Path:
    writer = Writer1(path)
    if how is not None:
        writer.set_compression(how)
    with writer:
        known: dict[str, Any] = {}
        for topic, kind, t_ns, message in messages(ROS1, rows, names or {}):
            known.setdefault(topic, None)
            if known[topic] is None:
                known[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(known[topic], t_ns, ROS1.serialize_ros1(message, kind))
    return path


KINDS: dict[str, Any] = {
    "ros1": rosbag1,
    "ros1 bz2": lambda path, rows, **more: rosbag1(path, rows, Writer1.CompressionFormat.BZ2, **more),
    "ros1 lz4": lambda path, rows, **more: rosbag1(path, rows, Writer1.CompressionFormat.LZ4, **more),
}
for _plugin in (StoragePlugin.SQLITE3, StoragePlugin.MCAP):
    for _mode in (None, CompressionMode.MESSAGE, *((CompressionMode.FILE,) if _plugin is StoragePlugin.SQLITE3 else ())):
        KINDS[f"{_plugin.name}{f' {_mode.name}' if _mode else ''}".lower()] = lambda path, rows, p=_plugin, m=_mode, **more: rosbag2(
            path, rows, p, m, **more
        )


def truth(rows: list[Row]) -> tuple[Any, Any]:
    return np.array([row.pose for row in rows]), np.array([row.twist for row in rows])


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_bags_of_a_kind_are_read_without_a_mismatch(kind: str, tmp_path: Path) -> None:
    for seed in range(9):
        rows = driven(seed, 12 + 7 * seed)
        path = KINDS[kind](tmp_path / f"{seed}.bag", rows)
        x, u = truth(rows)
        tracked = {name: f"/lab/tracked.pose[{k}]" for k, name in enumerate(MODEL.states)} | {
            "v": "/cmd_vel.linear.x",
            "w": "/cmd_vel.angular.z",
        }
        frames = {"x": "/tf[odom->base].translation.x", "y": "/tf[odom->base].translation.y", "theta": "/tf[odom->base].rotation"}
        signals = (None, tracked, frames)[seed % 3]
        found = load_transitions(path, MODEL, signals=signals)
        assert len(found.x0) == len(rows) - 1, signals
        assert np.max(np.abs(MODEL.difference(found.x0, x[:-1]))) < 1e-6
        assert np.max(np.abs(MODEL.difference(found.x1, x[1:]))) < 1e-6
        assert np.max(np.abs(found.u - u[:-1])) < 1e-5, "stamps since 1970 are told to 0.24 µs"


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap message"])
def test_other_names_are_guessed_and_said(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = KINDS[kind](tmp_path / "a", driven(1), names={"odom": "/robot/base/odom", "cmd_vel": "/robot/base/cmd_vel"})
    assert main(["gap", str(path), *UNICYCLE]) == 3
    said = capsys.readouterr()
    assert "taken by their names: x=/robot/base/odom.pose.pose.position.x" in said.err
    assert "transitions     59" in said.out
    assert main(["topics", str(path), "--model", "unicycle"]) == 0
    said = capsys.readouterr()
    assert "/lab/tracked  lab_msgs/msg/Tracked  n 60  20 Hz  0.000 to 2.950 s" in said.out
    assert "--input v=/robot/base/cmd_vel.linear.x" in said.out
    assert said.out.index("/robot/base/odom") < said.out.index("/lab/tracked"), "usable types first"
    with pytest.raises(UsageError, match=r"there is no signal '/odom\.x'"):
        load_transitions(path, MODEL, signals={"x": "/odom.x"})


def test_parts_of_a_split_bag_are_read_in_order_and_a_missing_one_is_said(tmp_path: Path) -> None:
    rows = driven(3, 90)
    folder = tmp_path / "split"
    folder.mkdir()
    names = []
    for part, (plugin, suffix) in enumerate([(StoragePlugin.MCAP, "mcap"), (StoragePlugin.SQLITE3, "db3"), (StoragePlugin.MCAP, "mcap")]):
        one = rosbag2(tmp_path / f"part{part}", rows[30 * part : 30 * part + 30], plugin)
        source = next(file for file in one.iterdir() if file.suffix == f".{suffix}")
        names.append(f"split_{10 - part}.{suffix}")
        shutil.copy(source, folder / names[-1])
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths:\n" + "".join(f"    - {name}\n" for name in names)
    )
    whole = load_transitions(folder, MODEL)
    assert len(whole.x0) == 89
    assert len(load_dataset(folder, MODEL).runs) == 1
    (folder / names[1]).unlink()
    assert any(f"parts that metadata.yaml names are missing: {names[1]}" in line for line in load_transitions(folder, MODEL).notes)
    (folder / "metadata.yaml").unlink()
    assert len(load_transitions(folder, MODEL).x0) == 58, "a recorder that died writes no metadata.yaml"


def test_certify_reads_the_folder_of_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = Path(__file__).parents[3]
    bags = [str(rosbag2(tmp_path / f"bag{seed}", driven(seed), StoragePlugin.MCAP)) for seed in (1, 2)]
    key, cert = str(tmp_path / "key.pem"), str(tmp_path / "a.cert")
    assert main(["keys", "new", key]) == 0
    profile = ["--profile", str(root / "profiles" / "robotarium.toml")]
    given = [
        "certify",
        str(root / "controllers" / "grid.py"),
        *profile,
        "--recording",
        bags[0],
        "--recording",
        bags[1],
        "--key",
        key,
        "-o",
        cert,
    ]
    assert main(given) == 3
    assert f"{bags[0]}, {bags[1]}: is ordinary driving" in capsys.readouterr().err.replace(f"{bags[1]}, {bags[0]}", f"{bags[0]}, {bags[1]}")


def test_decoding_agrees_with_an_independent_reader(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    for path in (
        rosbag1(tmp_path / "a.bag", driven(5)),
        rosbag2(tmp_path / "b", driven(5), StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    ):
        with AnyReader([path]) as reader:
            theirs = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages() if c.topic == "/odom"]
        bag = open_bag(path)
        ours = [(m.channel.topic, m.log_ns, Types(bag.definitions).decode(m.channel, m.data)) for m in bag.messages({"/odom"})]
        assert [one[:2] for one in ours] == [one[:2] for one in theirs]
        for (_, _, one), (_, _, other) in zip(ours, theirs, strict=True):
            assert one.pose.pose.position.x == other.pose.pose.position.x
            assert one.pose.pose.orientation.z == other.pose.pose.orientation.z
        assert open_recording(path).topics() == sorted(open_recording(path).topics())


def test_payloads_that_cyclonedds_serialized(tmp_path: Path) -> None:
    """CDR of the middleware that ROS 2 itself may use, in a database that is written here by rosbag2's schema."""
    pytest.importorskip("cyclonedds")
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import array, float64, int32, uint32

    def struct_of(name: str, **fields: Any) -> Any:
        return make_idl_struct(name, name, fields)

    time, vector = struct_of("Time", sec=int32, nanosec=uint32), struct_of("Vector3", x=float64, y=float64, z=float64)
    header = struct_of("Header", stamp=time, frame_id=str)
    turn = struct_of("Quaternion", x=float64, y=float64, z=float64, w=float64)
    pose = struct_of("Pose", position=vector, orientation=turn)
    twist = struct_of("Twist", linear=vector, angular=vector)
    poses = struct_of("PoseWithCovariance", pose=pose, covariance=array[float64, 36])
    twists = struct_of("TwistWithCovariance", twist=twist, covariance=array[float64, 36])
    odometry = struct_of("Odometry", header=header, child_frame_id=str, pose=poses, twist=twists)
    rows = driven(7)
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute(
            "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT)"
        )
        database.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        for place, (name, kind) in enumerate([("/odom", "nav_msgs/msg/Odometry"), ("/cmd_vel", "geometry_msgs/msg/Twist")], start=1):
            database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (place, name, kind))
        for row in rows:
            (x, y, theta), (v, w) = row.pose, row.twist
            given = twist(vector(v, 0.0, 0.0), vector(0.0, 0.0, w))
            at = pose(vector(x, y, 0.0), turn(0.0, 0.0, float(np.sin(theta / 2)), float(np.cos(theta / 2))))
            stamp = header(time(row.t_ns // SECOND, row.t_ns % SECOND), "odom")
            seen = odometry(stamp, "base", poses(at, [0.0] * 36), twists(given, [0.0] * 36))
            for topic, message in ((2, given), (1, seen)):
                payload = message.serialize(use_version_2=False)
                database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", (topic, row.t_ns, payload))
    database.close()
    x, u = truth(rows)
    signals = {"x": "/odom.pose.pose.position.x", "v": "/cmd_vel.linear.x"}
    for found in (load_transitions(tmp_path / "a.db3", MODEL), load_transitions(tmp_path / "a.db3", MODEL, signals=signals)):
        assert len(found.x0) == len(rows) - 1
        assert np.max(np.abs(MODEL.difference(found.x1, x[1:]))) < 1e-6
        assert np.max(np.abs(found.u - u[:-1])) < 1e-5


@pytest.mark.parametrize("kind", ["ros1", "ros1 bz2", "sqlite3", "sqlite3 message", "mcap message"])
def test_spoilt_bags_are_one_line_or_read_as_far_as_they_hold(kind: str, tmp_path: Path) -> None:
    path = KINDS[kind](tmp_path / "whole", driven(6, 30))
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix != ".yaml")
    whole, draw = file.read_bytes(), random.Random(kind)
    target = tmp_path / f"bad{file.suffix}"
    refused: list[S2RError] = []
    for k in range(30):
        data = bytearray(whole)
        if k % 2:
            del data[draw.randrange(20, len(data)) :]
        for _ in range(draw.randint(1, 5) if k % 3 else 0):
            data[draw.randrange(20, len(data))] = draw.randrange(256)
        target.write_bytes(data)
        for signals in (None, {"x": "/lab/tracked.pose[0]"}):
            try:
                found = load_transitions(target, MODEL, signals=signals)
            except S2RError as error:
                refused.append(error)
            else:
                assert np.isfinite(found.x0).all()
    assert {error.exit_code for error in refused} <= {2, 3}
    assert all("\n" not in str(error) for error in refused)
    assert len(refused) < 60, "some of them hold"


def test_hostile_payloads_and_databases_end(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="more than"):
        unpacked(zstandard.compress(bytes(1 << 27)))
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        endless = (
            "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT 1 AS topic_id, k AS timestamp, x'00' AS data FROM n"
        )
        database.execute(f"CREATE VIEW messages AS {endless}")
    database.close()
    with pytest.raises(RecordingError, match="no ROS 2 bag"):
        load_transitions(path, MODEL)


def test_a_bag_of_a_topic_that_is_not_driving_says_what_there_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.bag"
    with Writer1(path) as writer:
        connection = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=ROS1)
        writer.write(connection, START, struct.pack("<I", 2) + b"hi")
    assert main(["gap", str(path), *UNICYCLE]) == 2
    said = capsys.readouterr().err
    assert "/chatter (std_msgs/msg/String" in said
    assert "Give --state x=SIGNAL" in said
    assert main(["topics", str(path)]) == 3


def test_without_its_library_a_ros1_bag_is_said_with_the_command_that_helps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rosbag1(tmp_path / "a.bag", driven(1, 12))
    for module in ("rosbags.rosbag1", "rosbags.typesys"):
        monkeypatch.setitem(sys.modules, module, None)
    for verb in ("gap", "trace", "topics"):
        assert main([verb, str(path), *(UNICYCLE if verb != "topics" else [])]) == 2
        assert "this is a ROS 1 bag; pip install 's2r-ros2[formats]'" in capsys.readouterr().err
