"""Which signals a model's states and inputs are, by usual names; always said to the user, who may say otherwise (--state, --input).

    a column, or a field of one topic, of the very name in the model      tables, MATLAB structures, measurement files
    types that say it: nav_msgs/msg/Odometry, geometry_msgs/msg/Twist     bags; `odom` and `cmd_vel` before others of the type
    messages of an autopilot                                              PX4: vehicle_local_position, ...; ArduPilot: XKF1, THR, STER

What comes from one topic is taken from one topic: a position of one estimator and a heading of another are not of one moment.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.recordings.formats.series import Topic
from s2r_runtime.recordings.formats.signals import full_name, paths_of

ALIASES: dict[str, tuple[str, ...]] = {
    "x": ("x", "pos_x", "pose_x", "position_x", "px", "x_m"),
    "y": ("y", "pos_y", "pose_y", "position_y", "py", "y_m"),
    "theta": ("theta", "yaw", "heading", "psi", "orientation", "pose_theta", "pose_yaw", "yaw_rad"),
    "v": ("v", "cmd_v", "v_cmd", "linear_x", "speed_cmd"),
    "w": ("w", "omega", "cmd_w", "w_cmd", "angular_z", "yaw_rate_cmd"),
    "speed": ("speed", "velocity"),
    "q": ("q", "position", "angle"),
    "qd": ("qd", "dq", "velocity", "speed"),
    "force": ("force", "torque", "effort", "tau", "u"),
}
"""Name in a model -> names of columns, the likelier first; other names of a model stand for themselves."""


class Source(NamedTuple):
    """Topics of a type, or of a name, and what of theirs is what. names: ends of topic names, the likelier first (bags). only_named: topics
    of other names are something else.
    """

    match: str
    paths: Mapping[str, str]
    names: tuple[str, ...] = ()
    only_named: bool = False


_POSE = {"x": "position.x", "y": "position.y", "theta": "orientation"}


def _under(prefix: str, paths: Mapping[str, str]) -> dict[str, str]:
    return {name: f"{prefix}.{path}" for name, path in paths.items()}


STATES: tuple[Source, ...] = (
    Source(
        "nav_msgs/msg/Odometry",
        {**_under("pose.pose", _POSE), "speed": "twist.twist.linear.x"},
        ("odom", "odometry/filtered", "odometry", "ground_truth"),
    ),
    Source("geometry_msgs/msg/PoseStamped", _under("pose", _POSE), ("pose", "mocap", "vrpn")),
    Source("geometry_msgs/msg/PoseWithCovarianceStamped", _under("pose.pose", _POSE), ("amcl_pose", "pose")),
    Source(
        "geometry_msgs/msg/TransformStamped",
        {"x": "transform.translation.x", "y": "transform.translation.y", "theta": "transform.rotation"},
        ("vicon",),
    ),
    Source(
        "tf2_msgs/msg/TFMessage",
        {"x": "translation.x", "y": "translation.y", "theta": "rotation"},
        tuple(f"tf[{frame}->{child}]" for frame in ("odom", "map") for child in ("base_footprint", "base_link", "base")),
        only_named=True,
    ),
    Source("turtlesim/msg/Pose", {"x": "x", "y": "y", "theta": "theta"}),
    Source("sensor_msgs/msg/JointState", {"q": "position[0]", "qd": "velocity[0]"}, ("joint_states",)),
    Source("#vehicle_local_position", {"x": "x", "y": "y", "theta": "heading", "vx": "vx", "vy": "vy"}),
    Source("#vehicle_local_position_groundtruth", {"x": "x", "y": "y", "theta": "heading", "vx": "vx", "vy": "vy"}),
    Source("#vehicle_odometry", {"x": "position[0]", "y": "position[1]", "theta": "q"}),
    Source("#XKF1[0]", {"x": "PN", "y": "PE", "theta": "Yaw", "vx": "VN", "vy": "VE"}),
    Source("#XKF1", {"x": "PN", "y": "PE", "theta": "Yaw", "vx": "VN", "vy": "VE"}),
    Source("#NKF1", {"x": "PN", "y": "PE", "theta": "Yaw", "vx": "VN", "vy": "VE"}),
)
"""`#NAME`: topics of this name; else of this type."""

_TWIST = {"v": "linear.x", "w": "angular.z", "vx": "linear.x", "vy": "linear.y"}
INPUTS: tuple[Source, ...] = (
    Source("geometry_msgs/msg/Twist", _TWIST, ("cmd_vel", "commands/velocity", "command/velocity", "cmd")),
    Source("geometry_msgs/msg/TwistStamped", _under("twist", _TWIST), ("cmd_vel", "reference", "cmd")),
    Source(
        "ackermann_msgs/msg/AckermannDriveStamped",
        {"speed_cmd": "drive.speed", "steer_cmd": "drive.steering_angle"},
        ("drive", "ackermann_cmd"),
    ),
    Source("ackermann_msgs/msg/AckermannDrive", {"speed_cmd": "speed", "steer_cmd": "steering_angle"}, ("ackermann_cmd", "drive")),
    Source("sensor_msgs/msg/JointState", {"force": "effort[0]"}, ("joint_states",)),
    Source("#rover_velocity_setpoint", {"v": "speed"}),
    Source("#rover_speed_setpoint", {"v": "speed_body_x"}),
    Source("#rover_rate_setpoint", {"w": "yaw_rate_setpoint"}),
    Source("#vehicle_local_position_setpoint", {"ax": "acceleration[0]", "ay": "acceleration[1]"}),
    Source("#trajectory_setpoint", {"ax": "acceleration[0]", "ay": "acceleration[1]"}),
    Source("#THR", {"v": "DesSpeed"}),
    Source("#STER", {"w": "DesTurnRate"}),
)
NOT_A_COMMAND = re.compile(r"joy|teleop|raw|smoother|recovery|nav|key", re.IGNORECASE)
"""Of several topics of a command's type: who wants the robot to move, and is not what it was commanded in the end."""


def guessed(model: ComposedModel, topics: Sequence[Topic], known: Mapping[str, str] | None = None) -> dict[str, str]:
    """Name in the model -> signal, as far as usual names say. known: what the user said, which is taken as it is."""
    found = dict(known or {})
    usable = [topic for topic in topics if topic.fields]
    for names, sources in ((model.states, STATES), (model.inputs, INPUTS)):
        lacks = [name for name in names if name not in found]
        found |= _by_column(lacks, usable)
        lacks = [name for name in names if name not in found]
        best: dict[str, str] = {}
        for source in sources:
            offer = _by_source(source, lacks, usable)
            if source.match.startswith("#") and names is model.inputs:
                best = {**offer, **best}  # an autopilot has a message for each
            elif len(offer) > len(best):
                best = offer
        found |= best
    return found


def _by_column(lacks: Sequence[str], topics: Sequence[Topic]) -> dict[str, str]:
    """From the one topic that has the most of these by name; of a table, or where it has at least two, or all."""
    best: dict[str, str] = {}
    for topic in topics:
        if topic.kind.count("/"):  # a ROS type says what it is by itself
            continue
        paths = paths_of(topic)
        short = {path.rpartition(".")[2].lower(): path for path in reversed(list(paths))} | {
            path.lower(): path for path in reversed(list(paths))
        }
        offer: dict[str, str] = {}
        for name in lacks:
            if path := next(
                (short[alias] for alias in (name, *ALIASES.get(name, ())) if alias.lower() in short and short[alias] not in offer.values()),
                None,
            ):
                offer[name] = path
        enough = not topic.name or len(offer) >= min(2, len(lacks))
        if enough and len(offer) > len(best):
            best = {name: full_name(topic.name, path) for name, path in offer.items()}
    return best


def _by_source(source: Source, lacks: Sequence[str], topics: Sequence[Topic]) -> dict[str, str]:
    if source.match.startswith("#"):
        there = [topic for topic in topics if topic.name == source.match[1:]]
    else:
        there = [topic for topic in topics if topic.kind == source.match]
    if source.only_named:
        there = [topic for topic in there if topic.name.strip("/").endswith(source.names)]
    if not there:
        return {}
    topic = min(there, key=lambda one: _rank(one, source))
    paths = paths_of(topic)
    return {name: full_name(topic.name, source.paths[name]) for name in lacks if source.paths.get(name) in paths}


def _rank(topic: Topic, source: Source) -> tuple[bool, int, bool, int, int, str]:
    """The usual name as a whole first, then as the end of a longer one, then by how much there is."""
    bare = topic.name.strip("/")
    exact = next((k for k, name in enumerate(source.names) if bare == name), len(source.names))
    ends = next((k for k, name in enumerate(source.names) if bare.endswith(name)), len(source.names))
    return (topic.n == 0, min(2 * exact, 2 * ends + 1), bool(NOT_A_COMMAND.search(bare)), -topic.n, len(bare), bare)
