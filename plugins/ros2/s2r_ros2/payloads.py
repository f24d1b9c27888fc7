"""Messages of the interfaces in `interfaces`, out of CDR payloads and into them.

    Header        stamp (sec int32, nanosec uint32), frame_id string
    Odometry      Header, child_frame_id, position 3, orientation 4 (x, y, z, w), covariance 36, linear 3, angular 3, covariance 36
    PoseStamped   Header, position 3, orientation 4
    TFMessage     count, then of each: Header, child_frame_id, translation 3, rotation 4
    Twist         linear 3, angular 3;   TwistStamped: Header before it
    Bool          one byte

All numbers but the header's are float64. `decode_*` raises Malformed for whatever is not exactly that; they let NaN and infinity through:
which numbers count is decided where they are used. Covariances are not looked at (drivers fill them with what they like).
"""

from __future__ import annotations

from typing import NamedTuple

from s2r_ros2.cdr import Malformed, Reader, Writer

TRANSFORM_LEAST = 72
"""Bytes of the smallest TransformStamped."""

Vector = tuple[float, ...]


class Located(NamedTuple):
    """Where `child` is in `frame`, at `stamp_ns` of the sender's clock. position (3,) m, orientation (4,) x y z w.

    twist: linear and angular velocity in the child's own frame, (6,) m/s and rad/s; empty where the message has none.
    """

    stamp_ns: int
    frame: str
    child: str
    position: Vector
    orientation: Vector
    twist: Vector = ()


def decode_odometry(data: bytes) -> Located:
    """nav_msgs/msg/Odometry."""
    reader = Reader(data)
    stamp, frame, child = reader.stamp(), reader.text(), reader.text()
    numbers = reader.doubles(85)
    reader.end()
    return Located(stamp, frame, child, numbers[:3], numbers[3:7], numbers[43:49])


def decode_pose_stamped(data: bytes) -> Located:
    """geometry_msgs/msg/PoseStamped."""
    reader = Reader(data)
    stamp, frame = reader.stamp(), reader.text()
    numbers = reader.doubles(7)
    reader.end()
    return Located(stamp, frame, "", numbers[:3], numbers[3:])


def decode_transforms(data: bytes) -> list[Located]:
    """tf2_msgs/msg/TFMessage."""
    reader = Reader(data)
    count = reader.uint32()
    if count * TRANSFORM_LEAST > reader.left:
        raise Malformed(f"{count} transforms in {reader.left} bytes")
    found = []
    for _ in range(count):
        stamp, frame, child = reader.stamp(), reader.text(), reader.text()
        numbers = reader.doubles(7)
        found.append(Located(stamp, frame, child, numbers[:3], numbers[3:]))
    reader.end()
    return found


def decode_twist(data: bytes) -> Vector:
    """geometry_msgs/msg/Twist: (6,)."""
    reader = Reader(data)
    numbers = reader.doubles(6)
    reader.end()
    return numbers


def decode_twist_stamped(data: bytes) -> Vector:
    """geometry_msgs/msg/TwistStamped: (6,)."""
    reader = Reader(data)
    reader.stamp()
    reader.text()
    numbers = reader.doubles(6)
    reader.end()
    return numbers


def decode_bool(data: bytes) -> bool:
    """std_msgs/msg/Bool."""
    reader = Reader(data)
    value = reader.boolean()
    reader.end()
    return value


def encode_odometry(at: Located, *, big: bool = False) -> bytes:
    """nav_msgs/msg/Odometry, covariances zero."""
    numbers = (*at.position, *at.orientation, *(0.0,) * 36, *(at.twist or (0.0,) * 6), *(0.0,) * 36)
    return Writer(big=big).stamp(at.stamp_ns).text(at.frame).text(at.child).doubles(*numbers).done()


def encode_pose_stamped(at: Located, *, big: bool = False) -> bytes:
    """geometry_msgs/msg/PoseStamped."""
    return Writer(big=big).stamp(at.stamp_ns).text(at.frame).doubles(*at.position, *at.orientation).done()


def encode_transforms(transforms: list[Located], *, big: bool = False) -> bytes:
    """tf2_msgs/msg/TFMessage."""
    writer = Writer(big=big).numbers("I", 4, len(transforms))
    for at in transforms:
        writer.stamp(at.stamp_ns).text(at.frame).text(at.child).doubles(*at.position, *at.orientation)
    return writer.done()


def encode_twist(twist: Vector, *, big: bool = False) -> bytes:
    """geometry_msgs/msg/Twist of (6,)."""
    return Writer(big=big).doubles(*twist).done()


def encode_twist_stamped(stamp_ns: int, frame: str, twist: Vector, *, big: bool = False) -> bytes:
    """geometry_msgs/msg/TwistStamped of (6,)."""
    return Writer(big=big).stamp(stamp_ns).text(frame).doubles(*twist).done()


def encode_bool(value: bool, *, big: bool = False) -> bytes:
    """std_msgs/msg/Bool."""
    return Writer(big=big).numbers("B", 1, value).done()
