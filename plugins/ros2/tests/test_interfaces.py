"""Type hashes, names and keys are those that ROS 2 and its Zenoh middlewares use."""

from __future__ import annotations

import pytest
import zenoh
from s2r_ros2.cdr import Malformed
from s2r_ros2.interfaces import BOOL, ODOMETRY, POSE_STAMPED, TF, TWIST, TWIST_STAMPED, dds_name, type_hash
from s2r_ros2.keys import Layout, attached, attachment, envelope, opened
from zenoh.ext import Int64, z_deserialize, z_serialize

PUBLISHED = {
    "builtin_interfaces/msg/Time": "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "std_msgs/msg/Header": "f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01",
    BOOL: "feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9",
    "geometry_msgs/msg/Vector3": "cc12fe83e4c02719f1ce8070bfd14aecd40f75a96696a67a2a1f37f7dbb0765d",
    TWIST: "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    TWIST_STAMPED: "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    POSE_STAMPED: "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    ODOMETRY: "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "geometry_msgs/msg/Transform": "beb83fbe698636351461f6f35d1abb20010c43d55374d81bd041f1ba2581fddc",
    TF: "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
"""As `ros2 topic info --verbose` prints them, Iron to Lyrical."""


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_type_hash_is_the_published_one(name: str) -> None:
    assert type_hash(name) == "RIHS01_" + PUBLISHED[name]


def test_name_in_dds() -> None:
    assert dds_name(TWIST) == "geometry_msgs::msg::dds_::Twist_"


@pytest.mark.parametrize(
    ("layout", "topic", "interface", "key"),
    [
        (Layout("bridge"), "/cmd_vel", TWIST, "cmd_vel"),
        (Layout("bridge"), "cmd_vel", TWIST, "cmd_vel"),
        (Layout("bridge", namespace="bot1"), "/tf", TF, "bot1/tf"),
        (Layout("bridge", namespace="fleet/bot1"), "odom", ODOMETRY, "fleet/bot1/odom"),
        (Layout("rmw"), "/cmd_vel", TWIST, f"0/cmd_vel/geometry_msgs::msg::dds_::Twist_/RIHS01_{PUBLISHED[TWIST]}"),
        (Layout("rmw", 0, "robot1"), "odom", ODOMETRY, f"0/robot1/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_{PUBLISHED[ODOMETRY]}"),
        (Layout("rmw", 7, "robot1"), "/tf", TF, f"7/tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_{PUBLISHED[TF]}"),
        (
            Layout("rmw", 0, "", "TypeHashNotSupported"),
            "/cmd_vel",
            TWIST,
            "0/cmd_vel/geometry_msgs::msg::dds_::Twist_/TypeHashNotSupported",
        ),
    ],
)
def test_key_of_a_topic(layout: Layout, topic: str, interface: str, key: str) -> None:
    assert layout.key(topic, interface) == key
    zenoh.KeyExpr(key)  # or raises


def test_tokens_are_those_of_a_node_of_rmw_zenoh() -> None:
    layout = Layout("rmw", 0)
    zid = "100f0e0d0c0b0a090807060504030201"
    assert layout.node_token(zid, "talker") == f"@ros2_lv/0/{zid}/0/0/NN/%/%/talker"
    token = layout.token(zid, "static_tf", 11, "MS", "/tf", TF, 100)
    assert token == f"@ros2_lv/0/{zid}/0/11/MS/%/%/static_tf/%tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_{PUBLISHED[TF]}/::,100:,:,:,,"
    assert zenoh.KeyExpr("@ros2_lv/0/**").includes(zenoh.KeyExpr(token))


def test_attachment_is_what_zenohs_own_serializer_makes() -> None:
    """int64, int64, sequence of 16 bytes, one after the other."""
    gid = bytes(range(100, 116))
    theirs = b"".join(z_serialize(value).to_bytes() for value in (Int64(7), Int64(1_700_000_000_123_456_789), gid))
    assert attachment(7, 1_700_000_000_123_456_789, gid) == theirs
    assert len(theirs) == 33
    assert z_deserialize(tuple[Int64, Int64, bytes], zenoh.ZBytes(theirs)) == (7, 1_700_000_000_123_456_789, gid)
    assert attached(theirs) == (7, 1_700_000_000_123_456_789, gid)


@pytest.mark.parametrize("data", [b"", b"x", bytes(33), bytes(32), attachment(1, 2, bytes(16)) + b"\0", attachment(-1, 2, bytes(16))])
def test_other_attachments_are_refused(data: bytes) -> None:
    with pytest.raises(Malformed):
        attached(data)


def test_envelope_gives_back_what_was_put_in() -> None:
    assert opened(envelope(b"extra", b"payload")) == (b"extra", b"payload")
    assert opened(envelope(b"", b"")) == (b"", b"")
    for data in (b"", b"\1", b"\5\0abc"):
        with pytest.raises(Malformed):
            opened(data)
