"""The interfaces that this package speaks: their fields, their names in DDS, and their type hashes.

A type hash (ROS interface hashing standard, version 1) is `RIHS01_` and the SHA-256 of the type's description and those of all types in
it, the latter sorted by name, as JSON with the separators `, ` and `: `, keys in their order, default values left out:
calculate_type_hash in ros2/rosidl, rosidl_generator_type_description/rosidl_generator_type_description/__init__.py, where the numbers of
field types stand too. Fields: ros2/common_interfaces (geometry_msgs, nav_msgs, std_msgs), ros2/geometry2 (tf2_msgs), ros2/rcl_interfaces
(builtin_interfaces). The tests compare with hashes that `ros2 topic info --verbose` prints; they are the same from Iron on.
"""

from __future__ import annotations

import hashlib
import json
from functools import cache
from typing import Any

ODOMETRY = "nav_msgs/msg/Odometry"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
TF = "tf2_msgs/msg/TFMessage"
TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
BOOL = "std_msgs/msg/Bool"

_HEADER, _VECTOR, _QUATERNION = "std_msgs/msg/Header", "geometry_msgs/msg/Vector3", "geometry_msgs/msg/Quaternion"
FIELDS: dict[str, tuple[tuple[str, str], ...]] = {
    BOOL: (("data", "boolean"),),
    "builtin_interfaces/msg/Time": (("sec", "int32"), ("nanosec", "uint32")),
    _HEADER: (("stamp", "builtin_interfaces/msg/Time"), ("frame_id", "string")),
    _VECTOR: (("x", "double"), ("y", "double"), ("z", "double")),
    "geometry_msgs/msg/Point": (("x", "double"), ("y", "double"), ("z", "double")),
    _QUATERNION: (("x", "double"), ("y", "double"), ("z", "double"), ("w", "double")),
    "geometry_msgs/msg/Pose": (("position", "geometry_msgs/msg/Point"), ("orientation", _QUATERNION)),
    POSE_STAMPED: (("header", _HEADER), ("pose", "geometry_msgs/msg/Pose")),
    TWIST: (("linear", _VECTOR), ("angular", _VECTOR)),
    TWIST_STAMPED: (("header", _HEADER), ("twist", TWIST)),
    "geometry_msgs/msg/PoseWithCovariance": (("pose", "geometry_msgs/msg/Pose"), ("covariance", "double[36]")),
    "geometry_msgs/msg/TwistWithCovariance": (("twist", TWIST), ("covariance", "double[36]")),
    ODOMETRY: (
        ("header", _HEADER),
        ("child_frame_id", "string"),
        ("pose", "geometry_msgs/msg/PoseWithCovariance"),
        ("twist", "geometry_msgs/msg/TwistWithCovariance"),
    ),
    "geometry_msgs/msg/Transform": (("translation", _VECTOR), ("rotation", _QUATERNION)),
    "geometry_msgs/msg/TransformStamped": (
        ("header", _HEADER),
        ("child_frame_id", "string"),
        ("transform", "geometry_msgs/msg/Transform"),
    ),
    TF: (("transforms", "geometry_msgs/msg/TransformStamped[]"),),
}
"""Name -> (field, type), a type being a basic one, another name, with [n] an array, with [] a sequence."""

BASIC = {"int32": 6, "uint32": 7, "double": 11, "boolean": 15, "string": 17}
NESTED, ARRAY, SEQUENCE = 1, 48, 144
"""Numbers of type_description_interfaces/msg/FieldType; the latter two are added to that of the elements."""


def dds_name(name: str) -> str:
    """`geometry_msgs::msg::dds_::Twist_` of `geometry_msgs/msg/Twist`."""
    package, kind, last = name.split("/")
    return f"{package}::{kind}::dds_::{last}_"


def element(kind: str) -> tuple[str, int, int]:
    """A field's type -> its elements' type, what is added to that type's number, and the capacity."""
    if kind.endswith("[]"):
        return kind[:-2], SEQUENCE, 0
    if kind.endswith("]"):
        base, _, count = kind[:-1].partition("[")
        return base, ARRAY, int(count)
    return kind, 0, 0


@cache
def type_hash(name: str) -> str:
    """RIHS01 of an interface."""
    described = {"type_description": _described(name), "referenced_type_descriptions": [_described(n) for n in sorted(_within(name))]}
    return "RIHS01_" + hashlib.sha256(json.dumps(described, separators=(", ", ": ")).encode()).hexdigest()


def _described(name: str) -> dict[str, Any]:
    fields = []
    for field, kind in FIELDS[name]:
        base, added, capacity = element(kind)
        nested = "" if base in BASIC else base
        number = BASIC.get(base, NESTED) + added
        told = {"type_id": number, "capacity": capacity, "string_capacity": 0, "nested_type_name": nested}
        fields.append({"name": field, "type": told})
    return {"type_name": name, "fields": fields}


def _within(name: str) -> set[str]:
    found: set[str] = set()
    for _, kind in FIELDS[name]:
        base = element(kind)[0]
        if base not in BASIC:
            found |= {base} | _within(base)
    return found
