"""On which keys a ROS 2 topic is found over Zenoh, and what comes with its payloads, in two layouts.

`bridge`, zenoh-bridge-ros2dds: the topic's name without its first slash, behind the bridge's namespace if it has one (absolute names too).
  The payload is the DDS sample as it is, encapsulation and all; nothing comes with it. A publisher's data flow as soon as somebody
  subscribes to the key; whatever is put on the key is written to DDS where a node of the robot's subscribes to the topic, and does not come
  back (a bridge's readers ignore its own writers).
  eclipse-zenoh/zenoh-plugin-ros2dds, zenoh-plugin-ros2dds/src: ros2_name_to_key_expr in ros2_utils.rs, route_publisher.rs,
  route_subscriber.rs, qos_helpers.rs (ignore_local); DEFAULT_CONFIG.json5 (namespace).

`rmw`, rmw_zenoh: DOMAIN/TOPIC/TYPE/HASH, with the type's name in DDS and its type hash (`TypeHashNotSupported` in Humble). With every
  payload comes an attachment of 33 bytes: sequence number (int64, from 1), source time stamp (int64, ns since 1970), both little endian,
  16 (the length of what follows), the publisher's gid (16 bytes). A subscription takes what comes on its key with such an attachment,
  whoever put it, and drops what has none; liveliness tokens are for the graph (`ros2 topic info`), no data hang on them. ros2/rmw_zenoh,
  rmw_zenoh_cpp/src/detail: TopicInfo, Entity, qos_to_keyexpr in liveliness_utils.cpp, qos.cpp, attachment_helpers.cpp,
  rmw_subscription_data.cpp (init, add_new_message), rmw_publisher_data.cpp; the length byte: eclipse-zenoh/zenoh-cpp,
  include/zenoh/api/ext/serialization.hxx. Before rmw_zenoh 0.2.4 (April 2025) the attachment named its fields; that form is not spoken
  here. (Humble's word stands here as others that speak to it have it: jerry73204/nano-ros, ZettaScaleLabs/ros-z.)

A token is @ros2_lv/DOMAIN/ZENOH_ID/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME, for a publisher (MP) or subscription (MS) followed by
/TOPIC/TYPE/HASH/QOS; slashes within a part become %, and QoS is empty where it is the default.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from s2r_ros2.cdr import Malformed
from s2r_ros2.interfaces import dds_name, type_hash

LAYOUTS = ("bridge", "rmw")
HASHES = ("RIHS01", "TypeHashNotSupported")
GID = 16
ATTACHMENT = struct.Struct(f"<qqB{GID}s")
LENGTH = struct.Struct("<H")
ATTACHMENT_MAX = 1024
"""Bytes; what is longer is cut, so that the log doesn't fill, and malformed all the same."""


class Attached(NamedTuple):
    """What rmw_zenoh attaches. source_ns: the publisher's system time, ns since 1970."""

    sequence: int
    source_ns: int
    gid: bytes


class Layout(NamedTuple):
    """kind: bridge or rmw. namespace: without slashes at its ends. hashes: RIHS01, or TypeHashNotSupported (Humble)."""

    kind: str
    domain: int = 0
    namespace: str = ""
    hashes: str = "RIHS01"

    def key(self, topic: str, interface: str) -> str:
        """The key of a topic."""
        if self.kind == "bridge":
            return "/".join(part for part in (self.namespace, topic.strip("/")) if part)
        return f"{self.domain}/{self.name(topic).strip('/')}/{dds_name(interface)}/{self.hash(interface)}"

    def name(self, topic: str) -> str:
        """The topic's full name in the robot's graph, as far as it is known here: a bridge's namespace is none of the graph's."""
        inside = self.namespace if self.kind == "rmw" and not topic.startswith("/") else ""
        return "/" + "/".join(part for part in (inside, topic.strip("/")) if part)

    def hash(self, interface: str) -> str:
        """An interface's hash as keys have it."""
        return type_hash(interface) if self.hashes == "RIHS01" else self.hashes

    def node_token(self, zenoh_id: str, node: str) -> str:
        """Says that there is a node of this name."""
        return f"@ros2_lv/{self.domain}/{zenoh_id}/0/0/NN/%/%/{node}"

    def token(self, zenoh_id: str, node: str, number: int, kind: str, topic: str, interface: str, depth: int) -> str:
        """Says that the node has a publisher (kind MP) or a subscription (MS), reliable, volatile, of this depth."""
        parts = (self.name(topic).replace("/", "%"), dds_name(interface), self.hash(interface), f"::,{depth}:,:,:,,")
        return f"@ros2_lv/{self.domain}/{zenoh_id}/0/{number}/{kind}/%/%/{node}/{'/'.join(parts)}"


def attachment(sequence: int, source_ns: int, gid: bytes) -> bytes:
    """What goes out with a payload under rmw."""
    return ATTACHMENT.pack(sequence, source_ns, GID, gid)


def attached(data: bytes) -> Attached:
    """What came with a payload under rmw. Raises Malformed."""
    if len(data) != ATTACHMENT.size or data[16] != GID:
        raise Malformed("the attachment is not that of rmw_zenoh since 0.2.4" if data else "no attachment")
    sequence, source_ns, _, gid = ATTACHMENT.unpack(data)
    if sequence < 0:
        raise Malformed(f"its sequence number is {sequence}")
    return Attached(sequence, source_ns, gid)


def envelope(extra: bytes, payload: bytes) -> bytes:
    """Attachment and payload as one frame: the attachment's length (uint16, little endian), both."""
    extra = extra[:ATTACHMENT_MAX]
    return LENGTH.pack(len(extra)) + extra + payload


def opened(data: bytes) -> tuple[bytes, bytes]:
    """(attachment, payload) of a frame. Raises Malformed."""
    if len(data) < LENGTH.size or len(data) < LENGTH.size + LENGTH.unpack_from(data)[0]:
        raise Malformed("it ends too early")
    end = LENGTH.size + LENGTH.unpack_from(data)[0]
    return data[LENGTH.size : end], data[end:]
