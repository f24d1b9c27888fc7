"""Attacks on a robot that speaks ROS 2 over Zenoh, by real sessions on the robot's side: what was never true is never an observation.

The truth is at x = 1 mm times its number; every lie says 900 m. After each attack the robot is heard, and a stop is a stop.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh
from s2r_ros2.cdr import LITTLE, PAYLOAD_MAX
from s2r_ros2.inboxes import POSE_MAX
from s2r_ros2.interfaces import BOOL
from s2r_ros2.keys import ATTACHMENT_MAX, Layout, attachment
from s2r_ros2.payloads import TRANSFORM_LEAST, Located, encode_bool, encode_twist
from s2r_ros2.testing import CHILD, FRAME, GID, INPUTS, STATES, Ros2Rig, message
from s2r_ros2.transport import Ros2Transport
from s2r_zenoh.testing import session

from s2r_runtime.messages import Command, LinkChanged, Observation, OverrideChanged
from s2r_runtime.testing.transport_kit import Line

LIE = 900.0
STOP = Command(1, 1, "sampler", (0.125, -0.25), 0, 10**8)
LAYOUTS = ("bridge", "rmw")
POSES = ("odometry", "pose_stamped", "tf")
OTHER_GID = b"somebody else's!"


class House:
    """A robot that sends the truth, and the runtime that listens to it."""

    def __init__(self, rig: Ros2Rig) -> None:
        self.rig, self.k = rig, 0
        rig.transport.open()
        self.line = Line(rig, numbered=False)
        self.line.link((0.0, 0.0, 0.0))
        self.first = self.line.good[-1].stamp_ns
        self._begin_ns = time.monotonic_ns()
        self.sent: list[tuple[int, bytes]] = []

    def now(self) -> int:
        """ns, of the robot's clock: it goes on from the kit's."""
        return self.first + 10**9 + time.monotonic_ns() - self._begin_ns

    def send(self, count: int = 1) -> None:
        """Poses, 10 ms apart."""
        for _ in range(count):
            self.k += 1
            stamp = self.now()
            payload = message(self.rig.options["pose"], stamp, (1e-3 * self.k, 0.0, 0.0))
            self.sent.append((10**6 + self.k, payload))
            self.rig.robot.put(self.rig.robot.pose_key, payload, 10**6 + self.k, stamp)
            self.line.turn()
            time.sleep(0.01)

    def heard(self) -> bool:
        """Whether the newest truth is an observation; it is sent again until then."""

        def came() -> bool:
            self.send()
            return any(abs(o.x[0] - 1e-3 * self.k) < 5e-3 for o in self.line.good[-3:])

        return self.line.until(came)

    def lies(self) -> list[Observation]:
        return [m for m in self.line.messages if isinstance(m, Observation) and m.x and any(abs(v) >= LIE for v in m.x)]

    def faults(self) -> list[str]:
        return [m.fault for m in self.line.messages if isinstance(m, Observation) and m.fault]

    def stops(self) -> list[OverrideChanged]:
        return [m for m in self.line.messages if isinstance(m, OverrideChanged)]


@contextmanager
def house(layout: str, pose: str = "odometry", **more: Any) -> Iterator[House]:
    with Ros2Rig(layout, pose, period=0.0, observation_timeout=2.0, emergency_stop="e_stop", **more) as rig:
        made = House(rig)
        made.send(20)
        assert made.heard()
        yield made


class Attacker:
    """Somebody with a session on the robot's side, who may copy the robot's gid and numbers."""

    def __init__(self, house: House, opened: zenoh.Session) -> None:
        self.house, self.session = house, opened
        self.key, self.rmw = house.rig.robot.pose_key, house.rig.options["layout"] == "rmw"

    def put(self, payload: bytes, extra: bytes | None = None, key: str = "") -> None:
        """With the robot's own attachment under rmw, or this one."""
        own = attachment(10**6 + self.house.k, self.house.now(), GID) if self.rmw else None
        given = own if extra is None else extra or None
        self.session.put(key or self.key, payload, attachment=given, congestion_control=zenoh.CongestionControl.BLOCK)


@contextmanager
def attacker(made: House) -> Iterator[Attacker]:
    with session("client", connect=made.rig.endpoint) as opened:
        yield Attacker(made, opened)


# ---------------------------------------------------------------- malformed payloads


def malformed(pose: str, stamp_ns: int) -> Iterator[bytes]:
    """A lie, spoilt in every way that must be noticed."""
    lie = message(pose, stamp_ns, (LIE, LIE, 0.0))
    body = lie[4:]
    yield from (lie[:n] for n in range(0, len(lie) - 4, 37))
    yield from (head + body for head in (b"\0\2\0\0", b"\0\3\0\0", b"\0\6\0\0", b"\0\7\0\0", b"\0\x0a\0\0", b"\xff\xff\0\0", b""))
    yield lie + bytes(8)
    yield lie + bytes(PAYLOAD_MAX)
    for count in (0x7FFFFFFF, 0xFFFFFFFF, 1 << 24, PAYLOAD_MAX // TRANSFORM_LEAST + 1):
        yield LITTLE + struct.pack("<I", count) + body[4:] if pose == "tf" else LITTLE + body[:8] + struct.pack("<I", count) + body[12:]
    for value in (math.nan, math.inf, -math.inf, 1e300):
        for x in ((value, 0.0, 0.0), (0.0, value, 0.0)):
            yield message(pose, stamp_ns, x)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_malformed_payloads_are_faults_or_nothing_and_the_robot_is_heard_after_each_burst(layout: str, pose: str) -> None:
    with house(layout, pose) as made, attacker(made) as liar:
        for n, payload in enumerate(malformed(pose, made.now())):
            liar.put(payload)
            if n % 8 == 0:
                made.send()
        assert made.heard()
        assert made.lies() == []
        assert made.faults()
        assert made.line.until(lambda: made.rig.transport.counters()["malformed"] + made.rig.transport.counters()["foreign"] > 10)
        assert all(math.isfinite(value) for o in made.line.good for value in o.x)
        assert not [m for m in made.line.messages if isinstance(m, LinkChanged) and not m.up]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_messages_of_foreign_types_and_keys_are_no_poses(layout: str) -> None:
    """A twist, a bool and the other kinds of poses on the pose's key; poses under other types, hashes, domains and wildcards."""
    with house(layout) as made, attacker(made) as liar:
        stamp = made.now()
        for payload in (
            encode_twist((LIE,) * 6),
            encode_bool(True),
            *(message(pose, stamp, (LIE, LIE, 0.0)) for pose in POSES if pose != "odometry"),
            b'{"seq":1,"stamp_ns":1,"state":{"x":900}}',
        ):
            liar.put(payload)
            made.send()
        lie = message("odometry", made.now() + 10**6, (LIE, LIE, 0.0))
        for key in (liar.key + "/x", liar.key.replace("odom", "other"), "1/" + liar.key, liar.key.replace("RIHS01_", "RIHS02_") + "_"):
            liar.put(lie, key=key)
            made.send()
        assert made.heard()
        assert made.lies() == []
        assert made.stops() == []


@pytest.mark.parametrize("pose", POSES)
def test_attachment_that_is_cut_missing_or_too_long_is_a_fault_under_rmw(pose: str) -> None:
    with house("rmw", pose) as made, attacker(made) as liar:
        whole = attachment(10**7, made.now(), GID)
        for extra in (b"", *(whole[:n] for n in range(1, len(whole), 4)), whole + b"\0", whole * 100, attachment(-1, 0, GID)):
            before = made.rig.transport.counters()["malformed"]
            liar.put(message(pose, made.now(), (LIE, LIE, 0.0)), extra)
            assert made.line.until(lambda n=before: made.rig.transport.counters()["malformed"] > n)
            made.send()
        assert made.heard()
        assert made.lies() == []
        assert all(len(frame.data) <= 2 + ATTACHMENT_MAX + PAYLOAD_MAX + 1 for frame in made.line.frames)


# ---------------------------------------------------------------- replays and floods


@pytest.mark.parametrize("layout", LAYOUTS)
def test_replayed_poses_never_move_the_robot_back(layout: str) -> None:
    """Exactly as they were, attachment and all, in order and backwards."""
    with house(layout) as made, attacker(made) as liar:
        old = list(made.sent[:20])
        for sequence, payload in [*old, *reversed(old)]:
            liar.put(payload, attachment(sequence, 0, GID) if liar.rmw else b"")
            made.send()
        assert made.heard()
        xs = [o.x[0] for o in made.line.good if o.stamp_ns > made.first]
        assert xs == sorted(xs)
        stamps = [o.stamp_ns for o in made.line.good]
        assert stamps == sorted(set(stamps))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_replayed_commands_of_the_runtime_are_noticed(layout: str) -> None:
    """Byte for byte what the runtime sent a moment ago: it knows how often."""
    from s2r_zenoh.testing import free_endpoint

    endpoint = free_endpoint()
    kind = Layout(layout)
    options = {"robot_connect": endpoint, "layout": layout, "frame": FRAME, "child_frame": CHILD, "observation_timeout": 2.0}
    command = kind.key("cmd_vel", "geometry_msgs/msg/Twist")
    taken: list[tuple[bytes, bytes]] = []
    with session("router", listen=endpoint), session("client", connect=endpoint) as spy:
        spy.declare_subscriber(
            command, lambda s: taken.append((b"" if s.attachment is None else s.attachment.to_bytes(), s.payload.to_bytes()))
        )
        transport = Ros2Transport({**options, "max_age": 100.0}, STATES, INPUTS)
        transport.open()
        try:
            said: list[Any] = []

            def turn() -> None:
                time.sleep(0.02)
                said.extend(m for frame in transport.receive() for m in transport.decode(frame))

            end = time.monotonic() + 10.0
            while len(taken) < 40 and time.monotonic() < end:
                transport.send(transport.encode(STOP))
                turn()
            assert len(taken) >= 40
            for _ in range(10):
                turn()
            assert not [m for m in said if isinstance(m, OverrideChanged)], "its own are no stranger's"
            end = time.monotonic() + 10.0
            sent = 0
            while not [m for m in said if isinstance(m, OverrideChanged)] and time.monotonic() < end:
                extra, payload = taken[sent % 10]
                spy.put(command, payload, attachment=extra or None)
                sent += 1
                turn()
            (stop, *_) = [m for m in said if isinstance(m, OverrideChanged)]
        finally:
            transport.close()
    assert (stop.kind, stop.detail) == ("manual_override", "another node commands /cmd_vel on the robot's side")
    if layout == "rmw":
        assert sent <= 20, "each has its own number"


@pytest.mark.parametrize("size", [0, 4096, 1_000_000])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_flood_on_the_poses_key_takes_bounded_memory_and_log_and_the_robot_is_heard_after_it(layout: str, size: int) -> None:
    with house(layout) as made, attacker(made) as liar:
        payload = message("odometry", made.now(), (math.nan, 0.0, 0.0)) + bytes(size)
        begin, calls = time.monotonic(), 0
        slowest, most = 0.0, 0
        while time.monotonic() - begin < 1.5:
            for _ in range(50 if size < 100_000 else 2):
                liar.session.put(liar.key, payload, attachment=attachment(1, 1, OTHER_GID) if liar.rmw else None)
            began = time.thread_time()
            frames = made.rig.transport.receive()
            slowest, most, calls = max(slowest, time.thread_time() - began), max(most, len(frames)), calls + 1
            assert all(len(frame.data) <= 2 + ATTACHMENT_MAX + POSE_MAX + 1 for frame in frames)
            made.line.messages += [m for frame in frames for m in made.rig.transport.decode(frame)]
        assert most <= made.rig.options["queue"]
        assert slowest < 0.02
        assert calls > 5
        assert made.heard()
        assert made.lies() == []
        assert made.faults()


# ---------------------------------------------------------------- the graph, and stops


def test_liveliness_tokens_that_lie_change_nothing() -> None:
    """Publishers that are not there, the robot's own tokens withdrawn, names of any length: no data hang on them."""
    with house("rmw") as made, attacker(made) as liar:
        kind = Layout("rmw")
        zid = str(liar.session.zid())
        tokens = [kind.node_token(zid, "n" * n) for n in (1, 1000, 30_000)]
        tokens += [kind.token(zid, "robot", n, what, "odom", "nav_msgs/msg/Odometry", 10) for n in range(50) for what in ("MP", "MS")]
        tokens += [f"@ros2_lv/0/{zid}/0/0/XX/%/%/x", "@ros2_lv/0", f"@ros2_lv/999/{zid}/0/1/MP/%/%/a/b/c/d/e/f/g"]
        held = [liar.session.liveliness().declare_token(token) for token in tokens]
        made.send(20)
        for token in held:
            token.undeclare()
        made.send(20)
        assert made.heard()
        assert made.faults() == []
        assert made.stops() == []
        assert made.line.links == [True]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_garbage_on_the_stops_topic_stops_and_a_flood_of_releases_hides_no_stop(layout: str) -> None:
    with house(layout) as made, attacker(made) as liar:
        key = Layout(layout).key("e_stop", BOOL)
        for payload in (b"", b"\0\1\0\0", b"\0\1\0\0\2", b"\0\1\0\0\0" + bytes(100), bytes(PAYLOAD_MAX + 10)):
            before = len(made.stops())
            liar.put(payload, key=key)
            assert made.line.until(lambda n=before: len(made.stops()) > n)
        before = len(made.stops())
        made.rig.robot.put(key, encode_bool(True))
        for _ in range(200):
            liar.put(encode_bool(False), key=key)
        time.sleep(0.2)
        assert made.line.until(lambda: len(made.stops()) > before)
        assert {stop.kind for stop in made.stops()} == {"emergency_stop"}


def test_pose_messages_that_a_robot_sends_fit_what_is_taken_in() -> None:
    """The longest names that are read, at both ends of the frames."""
    at = Located(1, "f" * 255, "c" * 255, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (0.0,) * 6)
    from s2r_ros2.payloads import encode_odometry, encode_pose_stamped

    assert max(len(encode_odometry(at)), len(encode_pose_stamped(at))) < POSE_MAX
