"""Nobody but the runtime commands the robot, from whichever side and in whichever mode they come."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest
import zenoh
from s2r_zenoh import transport
from s2r_zenoh.testing import Robot, ZenohRig, free_endpoint, session
from s2r_zenoh.transport import PROPOSAL_MAX, PROPOSALS_PER_SECOND
from s2r_zenoh.wire import PAYLOAD_MAX

from s2r_runtime.messages import Command, Frame, Observation, OverrideChanged
from s2r_runtime.testing.transport_kit import Line

ATTACK = b'{"seq":999999,"t_ns":9000000000000000000,"obs_seq":0,"ttl_ns":1000000000,"source":"attack","input":{"v":0.2,"w":0.0}}'
COMMAND = "s2r/robot/command"
KEYS = (COMMAND, "s2r/robot/*", "s2r/*/command", "s2r/**", "**", "s2r/robot/comm$*", "*/*/*")
MODES = ("peer", "client")
REPEATS = 5


@contextmanager
def running(beat: Callable[[], object]) -> Iterator[None]:
    """Calls `beat` every 10 ms from a thread of its own."""
    over = threading.Event()

    def run() -> None:
        while not over.wait(0.01):
            beat()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def attack(endpoint: str, mode: str, evidence: str) -> int:
    """Links there, proves it by hearing something on the key `evidence`, and then puts in every way it can. Returns how often."""
    heard = threading.Event()
    with session(mode, connect=endpoint) as attacker:
        attacker.declare_subscriber(evidence, lambda _: heard.set())
        assert heard.wait(10.0), f"{mode}: not linked, so the attack would prove nothing"
        publisher = attacker.declare_publisher(COMMAND)
        time.sleep(0.1)
        for _ in range(REPEATS):
            publisher.put(ATTACK)
            publisher.delete()
            for key in KEYS:
                attacker.put(key, ATTACK, congestion_control=zenoh.CongestionControl.BLOCK)
                attacker.delete(key)
        time.sleep(0.3)
    return REPEATS * (2 + 2 * len(KEYS))


@pytest.fixture
def rig() -> Iterator[ZenohRig]:
    with ZenohRig() as made:
        made.transport.open()
        yield made


@contextmanager
def at_work(rig: ZenohRig) -> Iterator[Line]:
    """Robot and runtime talk all the while."""
    line = Line(rig)
    line.link((0.0, 0.0, 0.0))
    seqs = iter(range(1_000_000, 10_000_000))

    def beat() -> None:
        seq = next(seqs)
        rig.robot.publish(seq, seq * 1_000_000, (0.0, 0.0, 0.0))
        line.turn()
        rig.transport.send(rig.transport.encode(Command(seq, seq, "recovery", (0.0, 0.0), line.good[-1].seq, 10**8)))

    with running(beat):
        yield line


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("side", ["robot", "controller"])
def test_no_put_on_the_command_reaches_the_robot(rig: ZenohRig, mode: str, side: str) -> None:
    endpoint, evidence = (rig.endpoint, COMMAND) if side == "robot" else (rig.others, "s2r/robot/observation")
    with at_work(rig):
        puts = attack(endpoint, mode, evidence)
        heard = rig.robot.heard.copy()
    assert puts > 50
    assert len(heard) > 20
    assert [data for data in heard if not data or b"recovery" not in data] == []


@pytest.mark.parametrize("mode", MODES)
def test_attackers_that_stay_linked_on_both_sides_do_not_find_the_robot(rig: ZenohRig, mode: str) -> None:
    """Long enough for anything that introduces peers to one another, and with the robot's own gossip on."""
    with ExitStack() as stack:
        attackers = [stack.enter_context(session(mode, connect=e, scouting__gossip__enabled=True)) for e in (rig.endpoint, rig.others)]
        with at_work(rig):
            for _ in range(20):
                for attacker in attackers:
                    for key in KEYS:
                        attacker.put(key, ATTACK)
                time.sleep(0.05)
            heard = rig.robot.heard.copy()
    assert [data for data in heard if b"recovery" not in data] == []


def test_the_attack_reaches_a_robot_behind_one_session_for_all() -> None:
    """What the tests above would look like if they could not fail."""
    to_robot, to_others = free_endpoint(), free_endpoint()
    robot = Robot(to_robot)
    with session("peer", listen__endpoints=[to_robot, to_others]) as gate:

        def beat() -> None:
            robot.publish(1, 1, (0.0, 0.0, 0.0))
            gate.put("s2r/robot/observation", b"{}")

        with running(beat):
            attack(to_others, "client", "s2r/robot/observation")
        heard = robot.heard.copy()
        robot.close()
    assert any(b"attack" in data for data in heard)


@pytest.mark.parametrize("rule", ["none", "deny_the_key"])
def test_the_attack_reaches_a_robot_whose_side_is_not_closed_to_all_but_named_keys(rule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sessions alone leave the robot's own side open; a rule that denies the command's key is passed on a wildcard."""
    closed = transport.session_config

    def open_config(*args: Any, **settings: Any) -> zenoh.Config:
        config = closed(*args, **settings)
        deny = {"id": "d", "permission": "deny", "flows": ["ingress"], "messages": ["put", "delete"], "key_exprs": [COMMAND]}
        access = {
            "enabled": rule != "none",
            "default_permission": "allow",
            "rules": [deny],
            "subjects": [{"id": "all"}],
            "policies": [{"rules": ["d"], "subjects": ["all"]}],
        }
        config.insert_json5("access_control", json.dumps(access))
        return config

    monkeypatch.setattr(transport, "session_config", open_config)
    with ZenohRig() as rig:
        rig.transport.open()
        with at_work(rig):
            attack(rig.endpoint, "client", COMMAND)
            heard = rig.robot.heard.copy()
    assert any(b"attack" in data for data in heard)


def test_proposals_of_others_are_seen_and_have_no_way_on(rig: ZenohRig) -> None:
    with at_work(rig) as line, session("client", connect=rig.others) as controller:
        deadline = time.monotonic() + 10.0
        while time.monotonic() < deadline and not any(isinstance(m, Command) for m in line.messages):
            controller.put("s2r/robot/proposal", b'{"input":{"v":0.1,"w":-0.5},"seq":7,"obs_seq":3}')
            time.sleep(0.02)
        proposals = [m for m in line.messages if isinstance(m, Command)]
        heard = rig.robot.heard.copy()
    assert proposals[0].source == "external"
    assert (proposals[0].u, proposals[0].seq, proposals[0].obs_seq) == ((0.1, -0.5), 7, 3)
    assert all(b"recovery" in data for data in heard)


@pytest.mark.slow
def test_flood_of_proposals_is_cut_at_the_door_and_observations_still_come(rig: ZenohRig) -> None:
    with at_work(rig) as line, session("client", connect=rig.others) as controller:
        begin = time.monotonic()
        before = len(line.good)
        while time.monotonic() - begin < 2.0:
            for _ in range(100):
                controller.put("s2r/robot/proposal", b'{"input":{"v":0.1,"w":-0.5}}')
            time.sleep(0.005)
        seconds = time.monotonic() - begin
        proposals = sum(isinstance(m, Command) for m in line.messages)
        fresh = len(line.good) - before
    assert 0 < proposals <= PROPOSALS_PER_SECOND * (seconds + 2)
    assert rig.transport.counters()["proposals_dropped"] > 0
    assert fresh > 10


@pytest.mark.parametrize("size", [PROPOSAL_MAX, 70_000, 3_000_000])
def test_oversized_proposals_fill_no_log_and_are_no_fault_of_the_link(rig: ZenohRig, size: int) -> None:
    """A daemon stops the robot for a frame of more than a megabyte: whoever only looks on must not be able to send one."""
    with at_work(rig) as line, session("client", connect=rig.others) as controller:
        begin, before = time.monotonic(), rig.transport.counters()["malformed"]
        while time.monotonic() - begin < 10.0 and rig.transport.counters()["malformed"] < before + 3:
            controller.put("s2r/robot/proposal", b'{"input":{"v":0.1,"w":-0.5},"pad":"%s"}' % (b"A" * size))
            time.sleep(0.05)
        fresh = len(line.good)
        assert rig.transport.counters()["malformed"] >= before + 3
    assert all(m.fault and not m.u for m in line.messages if isinstance(m, Command)), "malformed, so refused"
    assert fresh > 0


@pytest.mark.parametrize("key", ["observation", "override"])
def test_what_is_kept_of_an_oversized_payload_is_bounded_and_counts_as_none(rig: ZenohRig, key: str) -> None:
    """Also from the robot itself: in the place of a stop it stops."""
    with at_work(rig) as line:
        kept: list[int] = []
        receive = rig.transport.receive

        def noted() -> list[Frame]:
            frames = receive()
            kept.extend(len(frame.data) for frame in frames)
            return frames

        rig.transport.receive = noted  # type: ignore[method-assign]
        deadline = time.monotonic() + 10.0
        while time.monotonic() < deadline and max(kept, default=0) <= PAYLOAD_MAX:
            rig.robot._put(key, b"{" + b" " * 3_000_000 + b"}")
            time.sleep(0.05)
        time.sleep(0.2)
        stops = [m for m in line.messages if isinstance(m, OverrideChanged)]
    assert max(kept) == PAYLOAD_MAX + 1
    assert bool(stops) is (key == "override")


def test_observation_of_somebody_on_the_controllers_side_is_not_heard(rig: ZenohRig) -> None:
    with at_work(rig) as line:
        for mode in MODES:
            with session(mode, connect=rig.others) as liar:
                time.sleep(0.2)
                for key in ("s2r/robot/observation", "s2r/robot/override", "**"):
                    liar.put(key, b'{"seq":500000000,"stamp_ns":1,"state":{"x":9,"y":9,"theta":9},"kind":"emergency_stop"}')
                time.sleep(0.2)
    assert all(isinstance(m, Observation) and m.x == (0.0, 0.0, 0.0) for m in line.messages if not hasattr(m, "up"))


def test_onlookers_see_observations(rig: ZenohRig) -> None:
    seen = threading.Event()
    with at_work(rig), session("client", connect=rig.others) as onlooker:
        onlooker.declare_subscriber("s2r/**", lambda sample: seen.set() if b'"state"' in sample.payload.to_bytes() else None)
        assert seen.wait(10.0)
