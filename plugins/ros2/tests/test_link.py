"""The ROS 2 transport in the topologies that robots have: what reaches whom, who is seen, and what can't be walked around."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh
from s2r_ros2.inboxes import COMMANDS_KEPT, PER_SECOND, Ears
from s2r_ros2.interfaces import BOOL
from s2r_ros2.keys import Layout, attached, attachment, envelope
from s2r_ros2.payloads import encode_bool, encode_twist
from s2r_ros2.testing import CHILD, FRAME, INPUTS, STATES, Node, Ros2Rig
from s2r_ros2.transport import Ros2Transport
from s2r_zenoh.sessions import Doorbell
from s2r_zenoh.testing import free_endpoint, session

from s2r_runtime.messages import Command, Observation, OverrideChanged
from s2r_runtime.testing.transport_kit import Line

ATTACK = encode_twist((0.2, 0.0, 0.0, 0.0, 0.0, 2.0))
STOP = Command(1, 1, "sampler", (0.125, -0.25), 0, 10**8)
REPEATS = 5


class Robots:
    """A robot as it is: a bridge that listens as a router, or a node that is a peer of the robot's rmw_zenohd; the runtime connects."""

    states, inputs = STATES, INPUTS

    def __init__(self, kind: str, **more: Any) -> None:
        self.endpoint, self.others = free_endpoint(), free_endpoint()
        self.layout = Layout(kind)
        self.options = {
            "robot_connect": self.endpoint,
            "controller_listen": self.others,
            "layout": kind,
            "frame": FRAME,
            "child_frame": CHILD,
            "observation_timeout": 2.0,
            "max_age": 100.0,
            "emergency_stop": "e_stop",
            **more,
        }
        self.transport = Ros2Transport(self.options, STATES, INPUTS)
        self._stack = ExitStack()
        if kind == "rmw":
            self._stack.enter_context(session("router", listen=self.endpoint))
            self.robot = Node(self.layout, "odometry", "twist", connect=self.endpoint)
        else:
            self.robot = Node(self.layout, "odometry", "twist", listen=self.endpoint, mode="router")

    def __enter__(self) -> Robots:
        assert self.robot.session  # it is there first: nobody has to try again
        self.transport.open()
        self.line = Line(self, numbered=False)  # type: ignore[arg-type]
        self.line.link((0.0, 0.0, 0.0))
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.close()
        self.robot.close()
        self._stack.close()


@pytest.fixture(params=["bridge", "rmw"])
def robots(request: pytest.FixtureRequest) -> Iterator[Robots]:
    with Robots(request.param) as made:
        yield made


@contextmanager
def stranger(robots: Robots) -> Iterator[Node]:
    """Another node on the robot's side."""
    node = Node(robots.layout, "odometry", "twist", connect=robots.endpoint, gid=b"somebody else's!")
    try:
        yield node
    finally:
        node.close()


def overrides(line: Line) -> list[OverrideChanged]:
    return [m for m in line.messages if isinstance(m, OverrideChanged)]


def test_commands_reach_the_robot_and_come_back_to_nobody(robots: Robots) -> None:
    got = robots.line.heard(STOP)
    assert got[-1].u == STOP.u
    for k in range(200):
        robots.transport.send(robots.transport.encode(Command(k, k, "sampler", (0.001 * k, 0.0), 0, 1)))
    for _ in range(30):
        robots.line.turn()
    assert overrides(robots.line) == [], "the runtime's own commands are no stranger's"
    counters = robots.transport.counters()
    assert counters["dropped_in"] == counters["dropped_out"] == 0


def test_command_of_another_node_on_the_robots_side_is_an_override(robots: Robots) -> None:
    robots.line.heard(STOP)
    with stranger(robots) as node:
        assert robots.line.until(lambda: node.put(node.command_key, ATTACK) or bool(overrides(robots.line)))
    assert overrides(robots.line)[0].detail == "another node commands /cmd_vel on the robot's side"


def test_button_on_the_robots_side_stops_it(robots: Robots) -> None:
    key = robots.layout.key("e_stop", BOOL)
    robots.robot.put(key, encode_bool(False))
    robots.robot.put(key, encode_bool(True))
    assert robots.line.until(lambda: bool(overrides(robots.line)))
    assert [o.kind for o in overrides(robots.line)] == ["emergency_stop"]


def test_journal_says_whether_the_robot_takes_commands(robots: Robots) -> None:
    said: list[str] = []
    assert robots.line.until(lambda: said.extend(robots.transport.lines()) or any("robot subscribes to" in line for line in said))


@pytest.mark.parametrize("side", ["robot", "controllers"])
def test_runtime_is_seen_in_the_graph_of_rmw_zenoh(side: str) -> None:
    with Robots("rmw", node="gate_keeper") as robots, session("client", connect=robots.others) as onlooker:
        seen: set[str] = set()
        asking = robots.robot.session if side == "robot" else onlooker
        end = time.monotonic() + 10.0
        while len(seen) < 3 and time.monotonic() < end:
            seen |= {str(reply.ok.key_expr) for reply in asking.liveliness().get("@ros2_lv/0/**") if reply.ok}
        told = {token.split("/")[5]: token for token in seen}
        assert sorted(told) == ["MP", "MS", "NN"]
        assert all("/%/%/gate_keeper" in token for token in seen)
        assert ("%cmd_vel/geometry_msgs::msg::dds_::Twist_" in told["MP"]) == (side == "robot")
        assert ("%cmd_vel/geometry_msgs::msg::dds_::Twist_" in told["MS"]) == (side == "controllers")


def test_attachment_counts_commands_for_a_node_of_rmw_zenoh() -> None:
    with Robots("rmw") as robots:
        robots.line.heard(STOP)
        for _ in range(3):
            robots.line.heard(STOP)
    # heard() empties what it reads: the counts are read from frames
    fresh = Ros2Transport(robots.options, STATES, INPUTS)
    counts = [attached(fresh.encode(STOP).data[2:35]).sequence for _ in range(3)]
    assert counts == [1, 2, 3]


# ---------------------------------------------------------------- nobody walks around the gate


def attack(layout: Layout, endpoint: str, mode: str, heard_on: str) -> int:
    """Links there, proves it by hearing something on that key, and then puts in every way it can. Returns how often."""
    heard = threading.Event()
    command = layout.key("cmd_vel", "geometry_msgs/msg/Twist")
    keys = (command, command.rpartition("cmd_vel")[0] + "*" + command.partition("cmd_vel")[2], "**", "*", "*/*/*/*", "*/cmd_vel/**")
    extra = attachment(10**6, 1, b"attacker's gid!!")
    with session(mode, connect=endpoint) as attacker:
        attacker.declare_subscriber(heard_on, lambda _: heard.set())
        assert heard.wait(10.0), f"{mode}: not linked, so the attack would prove nothing"
        time.sleep(0.1)
        for _ in range(REPEATS):
            for key in keys:
                attacker.put(key, ATTACK, attachment=extra, congestion_control=zenoh.CongestionControl.BLOCK)
                attacker.delete(key)
        time.sleep(0.3)
    return REPEATS * len(keys)


@contextmanager
def at_work(rig: Any, line: Line) -> Iterator[None]:
    """Robot and runtime talk all the while."""
    over = threading.Event()

    def beat() -> None:
        while not over.wait(0.01):
            now = time.monotonic_ns()
            rig.robot.put(rig.robot.pose_key, _pose(now), stamp_ns=now)

    def run() -> None:
        while not over.is_set():
            line.turn()
            rig.transport.send(rig.transport.encode(STOP))

    threads = [threading.Thread(target=beat), threading.Thread(target=run)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def _pose(stamp_ns: int) -> bytes:
    from s2r_ros2.testing import message

    return message("odometry", stamp_ns, (0.0, 0.0, 0.0))


@pytest.mark.parametrize("mode", ["peer", "client"])
@pytest.mark.parametrize("kind", ["bridge", "rmw"])
def test_nobody_on_the_controllers_side_reaches_the_robot(kind: str, mode: str) -> None:
    with Robots(kind) as robots:
        with at_work(robots, robots.line):
            tried = attack(robots.layout, robots.others, mode, robots.robot.pose_key)
        heard = [command.u for command in robots.robot.received()]
        theirs = [m for m in robots.line.messages if isinstance(m, Command)]
        assert tried
        assert heard
        assert set(heard) == {STOP.u}
        assert theirs, "what they want is logged"
        assert len(theirs) <= 2 * PER_SECOND
        assert all(c.source == "external" for c in theirs)
        assert overrides(robots.line) == []


@pytest.mark.parametrize("mode", ["peer", "client"])
@pytest.mark.parametrize("kind", ["bridge", "rmw"])
def test_runtime_passes_no_command_on_between_those_who_link_with_it(kind: str, mode: str) -> None:
    """robot_listen: robot and attacker are linked with the runtime, and only through it with each other."""
    with Ros2Rig(kind, observation_timeout=2.0) as rig:
        rig.transport.open()
        line = Line(rig, numbered=False)
        line.link((0.0, 0.0, 0.0))
        with at_work(rig, line):
            attack_on_robots_side(rig, mode)
        heard = [command.u for command in rig.robot.received()]
        assert set(heard) == {STOP.u}


def attack_on_robots_side(rig: Ros2Rig, mode: str) -> None:
    """Nothing is heard there but commands: those prove the link."""
    attack(Layout(rig.options["layout"]), rig.endpoint, mode, rig.robot.command_key)


def test_onlookers_see_the_pose_as_the_robot_sent_it(robots: Robots) -> None:
    seen: list[tuple[bytes, bool]] = []
    with session("client", connect=robots.others) as onlooker:
        onlooker.declare_subscriber(
            robots.robot.pose_key, lambda sample: seen.append((sample.payload.to_bytes(), sample.attachment is not None))
        )
        k = iter(range(10**6, 10**7))

        def publish() -> bool:
            n = next(k)
            robots.robot.publish(n, n * 1000, (1.0, 2.0, 0.5))
            return bool(seen)

        assert robots.line.until(publish)
    assert seen[0][1] == (robots.layout.kind == "rmw")


def test_two_robots_on_one_topic_are_a_fault_under_rmw() -> None:
    with Robots("rmw") as robots, stranger(robots) as node:
        faults: list[str] = []

        def both() -> bool:
            now = time.monotonic_ns()
            robots.robot.put(robots.robot.pose_key, _pose(now))
            node.put(node.pose_key, _pose(now + 1000))
            faults.extend(m.fault for m in robots.line.messages if isinstance(m, Observation) and m.fault)
            return bool(faults)

        assert robots.line.until(both)
        assert faults[0] == "malformed pose: another publisher is on the topic"


def test_closing_twice_and_opening_again_works(robots: Robots) -> None:
    for _ in range(2):
        robots.transport.close()
        robots.transport.close()
        robots.transport.open()
    robots.line.link((0.0, 0.0, 0.0))
    assert partial(robots.line.heard, STOP)()


def test_own_commands_are_known_again_and_forgotten_after_thousands() -> None:
    ears = Ears(Doorbell())

    def heard(data: bytes) -> bool:
        before = ears.received
        ears.put(cast("Any", SimpleNamespace(attachment=None, payload=SimpleNamespace(to_bytes=lambda: data))))
        return ears.received > before

    for k in range(COMMANDS_KEPT):
        ears.sent(envelope(b"", b"%d" % (k % 10)))
    assert not heard(b"3")
    assert heard(b"somebody else's")
    for k in range(COMMANDS_KEPT):
        ears.sent(envelope(b"", b"other %d" % k))
    assert heard(b"3"), "long ago"
