"""Interfaces that come late, go away, talk nonsense or do not take what is sent; and what passes from one side to the other."""

from __future__ import annotations

import contextlib
import itertools
import os
import pty
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest
from s2r_can.hub import Hub
from s2r_can.port import Port
from s2r_can.records import FD, Record, records
from s2r_can.testing import CLASSIC, INPUTS, STATES, Robot, SocketRig, VirtualRig, options_of
from s2r_can.transport import CanTransport

from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Command, LinkChanged, Observation
from s2r_runtime.testing.transport_kit import Line

PATIENCE_S = 10.0


def until(ready: Callable[[], object]) -> bool:
    end = time.monotonic() + PATIENCE_S
    while not ready():
        if time.monotonic() > end:
            return False
        time.sleep(0.005)
    return True


@contextlib.contextmanager
def port(config: dict[str, Any]) -> Iterator[tuple[Port, list[Record]]]:
    heard: list[Record] = []
    opened = Port("robot", config, heard.append)
    opened.open()
    try:
        yield opened, heard
    finally:
        opened.close()


def socketcand(hub: Hub, channel: str = "can0") -> dict[str, Any]:
    return {"interface": "socketcand", "host": "127.0.0.1", "port": hub.port, "channel": channel, "tcp_tune": True}


def test_interface_that_python_can_does_not_have_is_refused_with_those_that_it_has() -> None:
    with pytest.raises(ConfigError, match=r"robot.interface 'sockeccan' cannot be used.*python-can has: .*socketcan"):
        Port("robot", {"interface": "sockeccan"}, lambda _: None).open()


def test_interface_that_is_not_there_yet_is_opened_when_it_comes() -> None:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        number = s.getsockname()[1]
    config = {"interface": "socketcand", "host": "127.0.0.1", "port": number, "channel": "can0"}
    with port(config) as (opened, heard):
        assert until(lambda: "cannot be opened" in opened.trouble)
        assert opened.send(Record(0, 1, 0, b"x")) is False
        hub = Hub(number).start()
        try:
            assert until(lambda: not opened.trouble)
            with can.Bus(ignore_config=True, **socketcand(hub)) as other:
                assert until(lambda: other.send(can.Message(arbitration_id=5, data=b"hi", is_extended_id=False)) or heard)
        finally:
            hub.close()
    assert (heard[0].key, heard[0].payload) == (5, b"hi")


def test_server_that_hangs_up_is_noticed_and_found_again_ten_times() -> None:
    """python-can alone takes the closed connection for silence, at full speed."""
    hub = Hub().start()
    with port(socketcand(hub)) as (opened, _):
        for _ in range(10):
            assert until(lambda: opened.counts["opened"] and not opened.trouble)
            begin, cpu = time.monotonic(), time.thread_time()
            hub.close()
            assert until(lambda: opened.trouble)
            assert time.monotonic() - begin < 1.5
            assert time.thread_time() - cpu < 1.0
            before = opened.counts["opened"]
            hub = Hub(hub.port).start()
            begin = time.monotonic()
            assert until(lambda n=before: opened.counts["opened"] > n)
            assert time.monotonic() - begin < 1.0
    hub.close()


def test_datagrams_that_are_no_frames_are_counted_and_the_next_one_is_read() -> None:
    class Odd(can.BusABC):
        """A driver that raises at what it can't read."""

        def __init__(self) -> None:
            self.given: list[Any] = [ValueError("no frame"), can.CanOperationError("no frame"), IndexError("no frame"), *[None] * 3]
            self.given.append(can.Message(arbitration_id=9, data=b"ok", is_extended_id=False))
            super().__init__("odd")

        def recv(self, timeout: float | None = None) -> can.Message | None:
            item = self.given.pop(0) if self.given else None
            if isinstance(item, Exception):
                raise item
            if item is None:
                time.sleep(timeout or 0.0)
            return item

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("full")

    heard: list[Record] = []
    opened = Port("robot", {"interface": "virtual"}, heard.append)
    opened._opened = Odd  # type: ignore[method-assign, assignment]
    opened.open()
    assert until(lambda: heard)
    assert opened.counts["errors"] == 3
    assert opened.counts["opened"] == 1
    assert opened.send(Record(0, 1, 0, b"")) is False
    assert opened.counts["dropped"] == 1
    opened.close()


def test_sending_to_a_server_that_does_not_read_does_not_wait() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        connections = []

        def serve() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                connections.append(connection)
                with contextlib.suppress(OSError):  # who only looks whether somebody is there
                    for answer in (b"< hi >", b"< ok >", b"< ok >"):
                        connection.sendall(answer)
                        connection.recv(64)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        config = {"interface": "socketcand", "host": "127.0.0.1", "port": server.getsockname()[1], "channel": "can0"}
        with port(config) as (opened, _):
            assert until(lambda: opened.counts["opened"])
            begin = time.monotonic()
            for k in range(1, 20_001):
                opened.send(Record(0, k & 0x7FF, 0, bytes(8)))
                counts = opened.counts
                assert counts["sent"] + counts["dropped"] == k, "a frame that waits or is in hand is missing from the sum"
            assert time.monotonic() - begin < 5.0, "a fraction of a millisecond a frame"
            assert until(lambda: opened.counts["dropped"] > 0)
        counts = opened.counts
        assert counts["sent"] + counts["dropped"] == 20_000, "what waited when the port was closed was not sent"
    for connection in connections:
        connection.close()


def test_slcan_adapter_on_a_pseudo_terminal_carries_frames_both_ways() -> None:
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    try:
        config = {"interface": "slcan", "channel": os.ttyname(slave), "sleep_after_open": 0.0, "bitrate": 500_000}
        with port(config) as (opened, heard):
            assert until(lambda: opened.counts["opened"])
            os.write(master, b"t1232AABB\rT18FEF1001CC\r")
            assert until(lambda: len(heard) == 2)
            assert (heard[0].key, heard[0].payload) == (0x123, b"\xaa\xbb")
            assert (heard[1].key, heard[1].payload) == (0x18FEF100 | 1 << 31, b"\xcc")
            opened.send(Record(0, 0x201, 0, b"\x01\x02"))
            said = b""
            while b"t20120102\r" not in said and select.select([master], [], [], PATIENCE_S)[0]:
                said += os.read(master, 4096)
            assert said.endswith(b"t20120102\r")
    finally:
        os.close(master)
        os.close(slave)


# ---------------------------------------------------------------- two sides


@contextlib.contextmanager
def two_sides(**options: Any) -> Iterator[tuple[CanTransport, Robot, can.BusABC]]:
    """A transport between a robot and somebody on the controllers' side."""
    with contextlib.ExitStack() as stack:
        hub = Hub().start()
        stack.callback(hub.close)
        given = {**options_of(CLASSIC, socketcand(hub)), "controller": socketcand(hub, "can1"), **options}
        transport = CanTransport(given, STATES, INPUTS)
        transport.open()
        stack.callback(transport.close)
        robot = Robot(socketcand(hub), CLASSIC)
        stack.callback(robot.close)
        outsider = stack.enter_context(can.Bus(ignore_config=True, **socketcand(hub, "can1")))
        time.sleep(0.1)
        yield transport, robot, outsider


def drained(bus: can.BusABC, seconds: float = 0.3) -> list[can.Message]:
    found, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        message = bus.recv(0.05)
        if message is not None:
            found.append(message)
    return found


@pytest.mark.parametrize(("forward", "seen"), [("all", {272, 273, 274, 0x700}), ("named", {272, 273, 274}), ("none", set())])
def test_controllers_side_hears_what_the_profile_says_and_never_a_command(forward: str, seen: set[int]) -> None:
    with two_sides(forward=forward) as (transport, robot, outsider):
        for seq in range(5):
            robot.publish(seq, seq * 10_000_000, (0.0, 0.0, 0.0))
            robot.bus.send(can.Message(arbitration_id=0x700, data=b"else", is_extended_id=False))
            transport.send(transport.encode(Command(seq, 0, "sampler", (0.1, 0.0), seq, 10**8)))
        heard = drained(outsider)
    assert {m.arbitration_id for m in heard} == seen


def test_nothing_from_the_controllers_side_reaches_the_robot() -> None:
    with two_sides() as (transport, robot, outsider):
        robot.publish(1, 10_000_000, (0.0, 0.0, 0.0))
        genuine = next(records(transport.encode(Command(1, 0, "sampler", (0.3, 0.1), 1, 10**8)).data))
        for identifier in [*range(0x7FF), 528]:
            outsider.send(can.Message(arbitration_id=identifier, data=genuine.payload, is_extended_id=False))
        assert until(lambda: transport.counters()["proposals"] == 2)
        heard = drained(robot.bus)
        proposals = [m for frame in transport.receive() for m in transport.decode(frame) if isinstance(m, Command)]
    assert heard == []
    assert [(c.source, c.u, c.fault) for c in proposals] == [("external", pytest.approx((0.3, 0.1), abs=1e-6), "")] * 2


def test_flood_of_proposals_is_cut_at_the_door() -> None:
    with two_sides() as (transport, _, outsider):
        for _ in range(1000):
            outsider.send(can.Message(arbitration_id=528, data=bytes(8), is_extended_id=False))
        assert until(lambda: transport.counters()["proposals"] == 1000)
        proposals = [m for frame in transport.receive() for m in transport.decode(frame)]
        assert 1 <= len(proposals) <= 32
        assert transport.counters()["proposals_dropped"] >= 1000 - 64
        assert all(isinstance(m, Command) and m.fault for m in proposals), "its checksum is wrong"


# ---------------------------------------------------------------- cyclic commands


def test_command_is_repeated_until_its_time_to_live_is_over_with_counters_that_go_on() -> None:
    with SocketRig(command_cycle=0.02) as rig:
        rig.transport.open()
        line = Line(rig)
        line.link((0.0, 0.0, 0.0))
        line.heard(Command(1, 0, "sampler", (0.0, 0.0), 1, 1))
        counts = []
        for k in range(3):
            line.transport.send(line.transport.encode(Command(2 + k, 0, "sampler", (0.25, 0.0), 1, 110_000_000)))
            end = time.monotonic() + 0.3
            while time.monotonic() < end:
                line.turn()
            heard = [c for c in rig.robot.received() if c.u[0]]
            counts += [c.seq for c in heard]
            assert 3 <= len(heard) <= 6, "at 0, 20, 40, 60, 80, 100 ms, or a little late"
            assert {c.u for c in heard} == {(0.25, 0.0)}
        assert all((b - a) % 16 == 1 for a, b in itertools.pairwise(counts))
        again = CanTransport(rig.options, STATES, INPUTS)
        for frame in line.frames:  # an audit: copies come back through decode, and the next command counts on from them
            again.decode(frame)
        copies = [frame for frame in line.frames if frame.channel == "copy"]
        assert len(copies) == line.transport.counters()["copies"] >= 6


def test_command_that_no_signal_can_hold_is_refused_by_name() -> None:
    with VirtualRig() as rig, pytest.raises(ValueError, match=r"v is 1e\+300"):
        rig.transport.encode(Command(1, 0, "sampler", (1e300, 0.0), 0, 1))
    transport = CanTransport(options_of(CLASSIC, {"interface": "virtual"}), STATES, INPUTS)
    with pytest.raises(ValueError, match=r"w is 8\.5: Drive\.W would be 8\.5 rad/s, the DBC says -8 to 8"):
        transport.encode(Command(1, 0, "sampler", (0.0, 8.5), 0, 1))


def test_wide_command_is_sent_as_a_can_fd_frame() -> None:
    with VirtualRig() as rig:
        (record,) = records(rig.transport.encode(Command(1, 0, "sampler", (0.1, 0.2), 0, 1)).data)
        assert record.flags & FD
        assert len(record.payload) == 20


# ---------------------------------------------------------------- the link


def test_link_that_is_cut_and_comes_back_is_reported_each_time() -> None:
    with SocketRig() as rig:
        rig.transport.open()
        line = Line(rig)
        seq = line.link((0.0, 0.0, 0.0))
        for _ in range(5):
            rig.hub.close()
            assert line.until(lambda: line.links[-1] is False)
            rig.robot.close()
            rig.hub = Hub(rig.hub.port).start()
            end = time.monotonic() + PATIENCE_S
            while not line.links[-1] and time.monotonic() < end:
                seq += 1
                with contextlib.suppress(can.CanError, OSError):
                    rig.robot.publish(seq, seq * 10_000_000, (0.0, 0.0, 0.0))
                line.turn()
            assert line.links[-1]
        downs = [m.detail for m in line.messages if isinstance(m, LinkChanged) and not m.up]
        assert any("robot side: socketcand can0" in detail for detail in downs), downs
        stamps = [m.stamp_ns for m in line.messages if isinstance(m, Observation) and not m.fault]
        assert stamps == sorted(set(stamps))


def test_silence_names_the_messages_that_are_missing() -> None:
    with VirtualRig() as rig:
        rig.transport.open()
        line = Line(rig)
        assert line.until(lambda: line.links == [False])
        (change,) = [m for m in line.messages if isinstance(m, LinkChanged)]
        assert change.detail == "no observation yet; missing: Pose (no good frame)"


def test_interface_that_takes_no_commands_is_a_lost_link() -> None:
    """Such as one that was not opened for CAN FD while the command needs it: the robot is heard, and hears nobody."""
    with VirtualRig() as rig:
        rig.transport.open()
        line = Line(rig)
        seq = line.link((0.0, 0.0, 0.0))
        port_ = rig.transport._robot
        assert port_ is not None
        assert port_._bus is not None

        def refuse(message: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("cannot send FD message over bus with CAN FD disabled")

        port_._bus.send = refuse  # type: ignore[method-assign]
        end = time.monotonic() + PATIENCE_S
        while line.links[-1] and time.monotonic() < end:
            seq += 1
            rig.robot.publish(seq, seq * 10_000_000, (0.0, 0.0, 0.0))
            line.transport.send(line.transport.encode(Command(seq, 0, "sampler", (0.1, 0.0), seq, 10**8)))
            line.turn()
            time.sleep(0.005)
        (change,) = [m for m in line.messages if isinstance(m, LinkChanged) and not m.up]
        assert "takes no frames: cannot send FD message over bus with CAN FD disabled" in change.detail


def test_error_frames_of_a_bus_are_told_in_their_place_and_a_storm_of_them_is_cut_at_the_door() -> None:
    with SocketRig() as rig:
        rig.transport.open()
        line = Line(rig)
        seq = line.link((0.0, 0.0, 0.0))
        raw = socket.create_connection(("127.0.0.1", rig.hub.port))
        for word in (b"< open can0 >", b"< rawmode >"):
            raw.recv(64)
            raw.sendall(word)
        raw.recv(64)
        raw.sendall(b"< error 20000040 >")
        assert line.until(lambda: line.links[-1] is False)
        assert line.until(lambda: "bus-off" in [m.detail for m in line.messages if isinstance(m, LinkChanged)][-1])
        rig.robot.publish(seq + 1, (seq + 1) * 10_000_000, (0.0, 0.0, 0.0))
        assert line.until(lambda: line.links[-1])
        raw.sendall(b"< error 20000004 >" * 2000)
        assert line.until(lambda: line.transport.counters()["dropped_in"] > 1900)
        rig.robot.publish(seq + 2, (seq + 2) * 10_000_000, (0.0, 0.0, 0.0))
        assert line.until(lambda: line.reached(seq + 2))
        assert not [m for m in line.messages if isinstance(m, Observation) and m.fault]
        assert line.transport.counters()["error_frames"] <= 1 + 64
        raw.close()


def test_hub_outlives_a_client_that_hangs_up_while_another_sends() -> None:
    """Both are in one look at the sockets: what is sent to the one that is gone drops it before its own turn comes."""
    hub = Hub().start()
    try:
        for _ in range(30):
            sender, gone = (socket.create_connection(("127.0.0.1", hub.port)) for _ in range(2))
            for one in (sender, gone):
                one.sendall(b"< open can0 >< rawmode >")
                until(lambda one=one: one.recv(4096).endswith(b"< ok >"))
            time.sleep(0.06)
            sender.sendall(b"< send 5 1 aa >" * 200)
            gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")  # hangs up with a reset
            gone.close()
            sender.close()
        with socket.create_connection(("127.0.0.1", hub.port), timeout=PATIENCE_S) as last:
            assert last.recv(64) == b"< hi >"
    finally:
        hub.close()
