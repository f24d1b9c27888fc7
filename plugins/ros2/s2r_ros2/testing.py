"""A robot's end of the ROS 2 transport, for tests: a node in either layout over real Zenoh on loopback, each on ports of its own.

from s2r_runtime.testing import TransportKit
from s2r_ros2.testing import Ros2Rig

class TestRos2(TransportKit):
    rig = Ros2Rig
    carries = ()
    numbered = False
"""

from __future__ import annotations

import math
from collections import deque
from contextlib import ExitStack
from typing import Any, Self

import zenoh
from s2r_zenoh.testing import free_endpoint, session

from s2r_ros2.cdr import Malformed
from s2r_ros2.keys import Layout, attached, attachment
from s2r_ros2.options import COMMANDS, POSES
from s2r_ros2.payloads import (
    Located,
    decode_twist,
    decode_twist_stamped,
    encode_odometry,
    encode_pose_stamped,
    encode_transforms,
)
from s2r_ros2.transport import Ros2Transport
from s2r_runtime.messages import Command

STATES, INPUTS = ("x", "y", "theta"), ("v", "w")
FRAME, CHILD = "odom", "base_footprint"
GID = bytes(range(16))


def message(pose: str, stamp_ns: int, x: tuple[float, ...], twist: tuple[float, ...] = ()) -> bytes:
    """A payload of this kind for a robot on the plane at x = (x, y, theta)."""
    half = 0.5 * x[2]
    at = Located(stamp_ns, FRAME, CHILD, (x[0], x[1], 0.0), (0.0, 0.0, _sin(half), _cos(half)), twist)
    if pose == "odometry":
        return encode_odometry(at)
    if pose == "pose_stamped":
        return encode_pose_stamped(at)
    wheel = at._replace(frame=CHILD, child="wheel_left_link")
    return encode_transforms([wheel, at])


def _sin(angle: float) -> float:
    """NaN for what has none: a careless robot's."""
    return math.sin(angle) if math.isfinite(angle) else math.nan


def _cos(angle: float) -> float:
    return math.cos(angle) if math.isfinite(angle) else math.nan


class Node:
    """A robot's node: publishes poses, and keeps the commands that it hears. Opens its session when it first publishes.

    mode, connect, listen: of its session. gid: under rmw, its publisher's.
    """

    def __init__(
        self,
        layout: Layout,
        pose: str,
        command: str,
        *,
        connect: str = "",
        listen: str = "",
        mode: str = "peer",
        topics: tuple[str, str] = ("", "cmd_vel"),
        gid: bytes = GID,
    ) -> None:
        self.heard: deque[tuple[bytes, bytes]] = deque(maxlen=10_000)
        self._layout, self._pose, self._command, self._gid = layout, pose, command, gid
        self._where: dict[str, Any] = {"mode": mode, "connect": connect, "listen": listen}
        interface, usual = POSES[pose]
        self.pose_key = layout.key(topics[0] or usual, interface)
        self.command_key = layout.key(topics[1], COMMANDS[command])
        self._stack = ExitStack()
        self._session: zenoh.Session | None = None
        self._sequence = 0

    @property
    def session(self) -> zenoh.Session:
        """Opened when it is first used."""
        if self._session is None:
            opened = self._stack.enter_context(session(**self._where))
            opened.declare_subscriber(self.command_key, self._take)
            self._session = opened
        return self._session

    def close(self) -> None:
        """Ends the session, as a robot does that is switched off; it opens another when it publishes again."""
        self._session = None
        self._stack.close()

    def _take(self, sample: zenoh.Sample) -> None:
        extra = sample.attachment
        self.heard.append((b"" if extra is None else extra.to_bytes(), sample.payload.to_bytes()))

    def put(self, key: str, payload: bytes, sequence: int | None = None, stamp_ns: int = 0) -> None:
        """A payload, with an attachment under rmw."""
        self._sequence = self._sequence + 1 if sequence is None else sequence
        extra = attachment(self._sequence, stamp_ns, self._gid) if self._layout.kind == "rmw" else None
        self.session.put(key, payload, attachment=extra, express=True, congestion_control=zenoh.CongestionControl.BLOCK)

    def publish(self, seq: int, stamp_ns: int, x: tuple[float, ...]) -> None:
        """One pose."""
        self.put(self.pose_key, message(self._pose, stamp_ns, x), seq, stamp_ns)

    def publish_raw(self, data: bytes) -> None:
        """These bytes, on the pose's key."""
        self.put(self.pose_key, data, self._sequence)

    def received(self) -> list[Command]:
        """Commands since the last call; under rmw only those that a node there would take."""
        taken = []
        for _ in range(len(self.heard)):
            extra, payload = self.heard.popleft()
            try:
                seq = attached(extra).sequence if self._layout.kind == "rmw" else 0
                twist = decode_twist(payload) if self._command == "twist" else decode_twist_stamped(payload)
            except Malformed:
                continue
            taken.append(Command(seq, 0, "recovery", (twist[0], twist[5]), 0, 0))
        return taken


class Ros2Rig:
    """Transport and a robot's node on loopback. layout: bridge or rmw. pose, command: as the options."""

    states, inputs = STATES, INPUTS

    def __init__(self, layout: str = "bridge", pose: str = "odometry", command: str = "twist", **more: Any) -> None:
        self.endpoint, self.others = free_endpoint(), free_endpoint()
        self.options: dict[str, Any] = {
            "robot_listen": self.endpoint,
            "controller_listen": self.others,
            "layout": layout,
            "pose": pose,
            "command": command,
            "frame": FRAME,
            "child_frame": "" if pose == "pose_stamped" else CHILD,
            "period": 0.01,
            "observation_timeout": 0.3,
            "max_age": 100.0,  # the kit's robot has no clock: its stamps run as fast as it is asked
            "queue": 16,
            **more,
        }
        self.transport = Ros2Transport(self.options, STATES, INPUTS)
        self._of: tuple[Any, ...] = (Layout(layout), pose, command)
        self.robot = Node(*self._of, connect=self.endpoint)
        self._twins: list[Node] = []

    def twin(self) -> Node:
        """Another robot's node on the same topics, with a session and a publisher of its own."""
        self._twins.append(Node(*self._of, connect=self.endpoint, gid=GID[::-1]))
        return self._twins[-1]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.close()
        for node in (self.robot, *self._twins):
            node.close()
