"""Bags: read in every form that rosbag2 writes, as far as they hold; what lacks is named; and told apart from this software's own logs.

The files are written by the `mcap` package, which the reader does not use; their payloads are what golden.json holds the encoder to.
"""

from __future__ import annotations

import gzip
import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from s2r_ros2.bags import read
from s2r_ros2.interfaces import ODOMETRY, POSE_STAMPED, TF, TWIST, TWIST_STAMPED
from s2r_ros2.mcap_records import Bag
from s2r_ros2.payloads import encode_twist, encode_twist_stamped
from s2r_ros2.testing import message

from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recording import layout, origin
from s2r_runtime.recording.writer import read as read_log
from s2r_runtime.recordings.loading import load_transitions
from s2r_runtime.recordings.robot_logs import is_robot_log
from s2r_runtime.trace.data.readers import load_dataset

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
DT = 0.05
NAMES = (("x", "y", "theta"), ("v", "w"))
N = 200
Rows = list[tuple[str, str, int, bytes]]


def driven(n: int = N, *, pose: str = "odometry", command: str = "twist", delay: float = 0.002, start: int = START) -> Rows:
    """(topic, type, log ns, payload) of a drive along arcs, a new command every half a second. delay: s from stamp to log."""
    draw = random.Random(1)
    x, y, theta, v, w = 0.0, 0.0, 0.0, 0.0, 0.0
    rows: Rows = []
    topics = {"odometry": ("/odom", ODOMETRY), "pose_stamped": ("/pose", POSE_STAMPED), "tf": ("/tf", TF)}
    for k in range(n):
        stamp = start + round(k * DT * SECOND)
        if k % 10 == 0:
            v, w = draw.uniform(-0.2, 0.2), draw.uniform(-1.0, 1.0)
        rows.append((*topics[pose], stamp + round(delay * SECOND), message(pose, stamp, (x, y, theta))))
        twist = (v, 0.0, 0.0, 0.0, 0.0, w)
        payload = encode_twist(twist) if command == "twist" else encode_twist_stamped(stamp, "base", twist)
        rows.append(("/cmd_vel", TWIST if command == "twist" else TWIST_STAMPED, stamp, payload))
        half = 0.5 * DT * w
        chord = DT * v * math.sin(half) / half
        x, y, theta = x + chord * math.cos(theta + half), y + chord * math.sin(theta + half), theta + DT * w
    return sorted(rows, key=lambda row: row[2])


def write(path: Path, rows: Rows, *, profile: str = "ros2", encoding: str = "cdr", **how: Any) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 20_000, **how})
        writer.start(profile=profile, library="libmcap 1.4.0")
        channels: dict[str, int] = {}
        for topic, kind, log_ns, payload in rows:
            if topic not in channels:
                schema = writer.register_schema(name=kind, encoding="ros2msg", data=b"# as rosbag2 writes it")
                channels[topic] = writer.register_channel(topic=topic, message_encoding=encoding, schema_id=schema)
            writer.add_message(channels[topic], log_time=log_ns, publish_time=log_ns, data=payload)
        writer.finish()
    return path


def model() -> Any:
    return compose(ModelSpec("unicycle", DT, {}, ()), "rig")


FORMS: dict[str, dict[str, Any]] = {
    "plain": {"compression": CompressionType.NONE, "enable_crcs": False},
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "unchunked": {"use_chunking": False},
    "without index": {
        "compression": CompressionType.ZSTD,
        "index_types": IndexType.NONE,
        "use_summary_offsets": False,
        "use_statistics": False,
    },
}


@pytest.mark.parametrize("form", sorted(FORMS))
def test_every_form_says_the_same(tmp_path: Path, form: str) -> None:
    ((t, x), (tu, u)) = read(write(tmp_path / "a.mcap", driven(), **FORMS[form]), *NAMES, {}).stretches[0]
    assert t == pytest.approx(DT * np.arange(N), abs=1e-9)
    assert x[0] == pytest.approx((0.0, 0.0, 0.0))
    assert len(tu) == N + 1, "the last command lapses"
    assert tu[:3] == pytest.approx(DT * np.arange(3), abs=1e-6)
    assert tuple(u[-1]) == (0.0, 0.0)


@pytest.mark.parametrize("form", sorted(FORMS))
def test_bag_that_a_crash_cut_is_read_as_far_as_it_holds(tmp_path: Path, form: str) -> None:
    rows = driven(60)
    whole = write(tmp_path / "a.mcap", rows, **{"chunk_size": 4000, **FORMS[form]}).read_bytes()
    path = tmp_path / "cut.mcap"
    most, payloads = 0, [row[3] for row in rows]
    for length in [*range(8, len(whole), max(1, len(whole) // 60)), len(whole)]:
        path.write_bytes(whole[:length])
        bag = Bag(path)
        found = [one.data for one in bag.messages()]
        assert found == payloads[: len(found)]
        assert bag.cut == (length < len(whole)) or len(found) == len(payloads)
        assert len(found) >= most, "more bytes say no less"
        most = len(found)
    assert most == len(payloads)


def test_file_compressed_as_a_whole_is_unpacked(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mcap", driven()).read_bytes()
    (tmp_path / "b.mcap.gz").write_bytes(gzip.compress(whole))
    (tmp_path / "c.mcap.zstd").write_bytes(zstandard.compress(whole))
    for name in ("b.mcap.gz", "c.mcap.zstd"):
        assert is_robot_log(tmp_path / name)
        assert len(load_transitions(tmp_path / name, model()).x0) == N - 1


def test_damaged_chunk_is_left_out_and_the_rest_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", driven(), compression=CompressionType.ZSTD, chunk_size=4000)
    data = bytearray(path.read_bytes())
    at = len(data) // 3
    data[at : at + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(data)
    bag = Bag(path)
    found = sum(1 for _ in bag.messages())
    assert bag.broken == 1
    assert N < found < 2 * N


@pytest.mark.parametrize(("pose", "options"), [("pose_stamped", {}), ("tf", {"frame": "odom", "child_frame": "base_footprint"})])
def test_other_poses_and_stamped_commands(tmp_path: Path, pose: str, options: dict[str, Any]) -> None:
    path = write(tmp_path / "a.mcap", driven(pose=pose, command="twist_stamped"))
    ((t, x), (_, u)) = read(path, *NAMES, {"pose": pose, **options}).stretches[0]
    assert (len(t), x.shape[1], u.shape[1]) == (N, 3, 2)


@pytest.mark.parametrize("offset", [-1000.0, 7.0, 0.3, 0.0])
def test_commands_are_brought_to_the_clock_of_the_stamps(tmp_path: Path, offset: float) -> None:
    """offset: s by which the recorder's clock is ahead of the robot's; below half a second it can't be told from a delay, and is none."""
    rows = [(topic, kind, log_ns + round(offset * SECOND), payload) for topic, kind, log_ns, payload in driven()]
    ((_, _), (tu, _)) = read(write(tmp_path / "a.mcap", rows), *NAMES, {}).stretches[0]
    known = abs(offset) > 0.5
    assert tu[:N] == pytest.approx(DT * np.arange(N) + (-0.002 if known else offset), abs=1e-6)


def test_clock_that_was_set_makes_another_stretch(tmp_path: Path) -> None:
    rows = driven(100)
    back = [
        (topic, kind, log_ns + 10 * SECOND, payload)
        for (topic, kind, log_ns, _), (_, _, _, payload) in zip(rows, driven(100, start=START - 3600 * SECOND), strict=True)
    ]
    stretches = read(write(tmp_path / "a.mcap", [*rows, *back]), *NAMES, {}).stretches
    assert [len(x) for (_, x), _ in stretches] == [100, 100]
    assert [len(u) for _, (_, u) in stretches] == [101, 101]


def test_robot_stops_on_its_own_where_commands_end(tmp_path: Path) -> None:
    rows = [row for row in driven() if row[0] != "/cmd_vel" or not 2.0 < (row[2] - START) / SECOND < 4.0]
    path = write(tmp_path / "a.mcap", rows)
    ((_, _), (tu, u)) = read(path, *NAMES, {"command_timeout": 0.5}).stretches[0]
    silent = np.flatnonzero(np.diff(tu) > 1.0)
    assert tuple(u[silent[0]]) == (0.0, 0.0)
    assert tu[silent[0]] == pytest.approx(2.5)
    endless = read(path, *NAMES, {"command_timeout": math.inf}).stretches[0]
    assert len(endless[1][0]) == len(tu) - 2


def test_bad_messages_are_left_out(tmp_path: Path) -> None:
    rows = driven()
    bad = [("/odom", ODOMETRY, START + SECOND, payload) for payload in (b"", message("odometry", START, (math.nan, 0.0, 0.0)))]
    assert len(read(write(tmp_path / "a.mcap", [*rows, *bad]), *NAMES, {}).stretches[0][0][0]) == N


@pytest.mark.parametrize(
    ("rows", "options", "why"),
    [
        (
            driven(5),
            {"pose_topic": "amcl"},
            r"holds no nav_msgs/msg/Odometry on /amcl; it has: /cmd_vel \(geometry_msgs/msg/Twist, 5\), /odom",
        ),
        (driven(5), {"pose": "pose_stamped", "pose_topic": "odom"}, "holds no geometry_msgs/msg/PoseStamped on /odom"),
        (driven(5), {"command_topic": "cmd"}, r"holds no geometry_msgs/msg/Twist or .* on /cmd; it has"),
        (driven(5), {"frame": "map"}, "5 of them: it is of base_footprint in 'odom', not of base_footprint in 'map'"),
        (driven(5), {"namespace": "bot", "pose_topic": "odometry"}, "on /bot/odometry or /odometry"),
        (
            driven(5, pose="tf"),
            {"pose": "tf", "frame": "map", "child_frame": "odom"},
            "no transform map -> odom; it has: base_footprint -> wheel_left_link, odom -> base_footprint",
        ),
        ([], {}, "holds no topic"),
    ],
)
def test_bag_that_lacks_what_is_needed_says_what_it_has(tmp_path: Path, rows: Rows, options: dict[str, Any], why: str) -> None:
    with pytest.raises(RecordingError, match=why):
        read(write(tmp_path / "a.mcap", rows), *NAMES, options)


def test_payloads_in_another_encoding_are_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"/odom \(nav_msgs/msg/Odometry, json, 5\)"):
        read(write(tmp_path / "a.mcap", driven(5), encoding="json"), *NAMES, {})


def test_bad_option_is_refused_and_an_endpoint_is_not_needed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="layuot"):
        read(write(tmp_path / "a.mcap", driven(5)), *NAMES, {"layuot": "rmw"})


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"nothing of the kind", b"\x1f\x8bnot gzip", b"\x28\xb5\x2f\xfdnot zstd"])
def test_what_is_no_bag_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(RecordingError):
        read(tmp_path / "a.mcap", *NAMES, {})


# ---------------------------------------------------------------- beside this software's own logs


def test_own_logs_and_bags_are_told_apart_by_what_they_begin_with(tmp_path: Path) -> None:
    assert layout.LIBRARY.startswith(origin.OURS)
    bag = write(tmp_path / "bag.mcap", driven())
    assert is_robot_log(bag)
    assert len(load_transitions(bag, model()).x0) == N - 1
    assert load_dataset(bag, model()).runs
    with pytest.raises(RecordingError, match=r"is an MCAP file of others \(profile 'ros2', written by 'libmcap 1.4.0'\), not a log of s2r"):
        read_log(bag)
    own = tmp_path / "own.mcap"
    own.write_bytes(layout.MAGIC + layout.pack(_header(layout.LIBRARY)))
    assert not is_robot_log(own)
    assert origin.other_writer(own) == ""
    assert origin.other_writer(tmp_path / "nowhere.mcap") == ""


def _header(library: str) -> Any:
    from mcap.records import Header

    return Header("", library)


def test_transitions_of_a_bag_follow_the_model(tmp_path: Path) -> None:
    found = load_transitions(write(tmp_path / "a.mcap", driven()), model())
    assert not found.independent, "ordinary driving is no campaign"
    turned = np.abs(found.x1[:, 2] - found.x0[:, 2] - DT * found.u[:, 1])
    assert np.max(np.abs(np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi)) < 1e-6


@pytest.mark.parametrize("form", ["plain", "zstd", "lz4", "unchunked"])
def test_spoilt_bags_are_read_in_part_or_refused_and_nothing_else(tmp_path: Path, form: str) -> None:
    draw = random.Random(11)
    whole = write(tmp_path / "a.mcap", driven(30), **{"chunk_size": 3000, **FORMS[form]}).read_bytes()
    path, refused = tmp_path / "b.mcap", 0
    for _ in range(120):
        data = bytearray(whole)
        for _ in range(draw.randint(1, 6)):
            data[draw.randrange(8, len(data))] = draw.randrange(256)
        if draw.random() < 0.3:
            del data[draw.randrange(8, len(data)) :]
        path.write_bytes(data)
        try:
            stretches = read(path, *NAMES, {}).stretches
        except RecordingError:
            refused += 1
            continue
        for (t, x), (tu, u) in stretches:
            assert np.all(np.diff(t) > 0.0)
            assert np.all(np.diff(tu) >= 0.0)
            assert np.all(np.isfinite(x))
            assert np.all(np.isfinite(u))
    assert refused < 120
