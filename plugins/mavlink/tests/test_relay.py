"""A ground station and somebody else's controller that reach the robot through the runtime: what passes, and what doesn't."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink
from s2r_mavlink import tcp
from s2r_mavlink.endpoints import OTHERS_MOST
from s2r_mavlink.relay import BYTES_PER_SECOND
from s2r_mavlink.rover_lines import TcpServerLine, UdpLine
from s2r_mavlink.testing import Robot, Runtime, free_port

from s2r_runtime.messages import Command, Decided

BODY, WAYS = 8, ("ground", "companion")


class Guest:
    """Somebody who connects to the runtime as if it were the autopilot."""

    def __init__(self, port: int, system: int, component: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setblocking(False)
        self.mav = mavlink.MAVLink(None, system, component)
        self.mav.robust_parsing = True

    def send(self, *messages: Any) -> None:
        for message in messages:
            self._socket.sendall(message.pack(self.mav))
            self.mav.seq = (self.mav.seq + 1) % 256

    def listen(self) -> list[Any]:
        try:
            return list(self.mav.parse_buffer(self._socket.recv(1 << 20)) or [])
        except BlockingIOError:
            return []

    def close(self) -> None:
        self._socket.close()


class House:
    """A robot, the runtime, and a guest on each side."""

    def __init__(self) -> None:
        self.ports = {side: free_port(socket.SOCK_STREAM) for side in WAYS}
        port = free_port()
        self.robot = Robot(UdpLine("127.0.0.1", port))
        self.runtime = Runtime(f"udp:127.0.0.1:{port}", **{side: f"tcpin:127.0.0.1:{p}" for side, p in self.ports.items()})
        self.reached: list[Any] = []
        self._k = 0

    def turn(self, count: int = 1) -> None:
        for _ in range(count):
            self._k += 1
            time.sleep(0.002)  # a stamp of its own
            self.robot.publish(self._k, time.monotonic_ns(), (0.001 * self._k, 0.0, 0.0))
            self.runtime.turn()
            self.reached += self.robot.listen()

    def of(self, *systems: int) -> list[str]:
        """Types of what reached the robot from these."""
        return [m.get_type() for m in self.reached if m.get_srcSystem() in systems]


@pytest.fixture
def house() -> Iterator[House]:
    made = House()
    with made.runtime:
        made.turn(20)
        yield made
    made.robot.line.close()


@contextlib.contextmanager
def guest(house: House, side: str) -> Iterator[Guest]:
    made = Guest(house.ports[side], *((255, 190) if side == "ground" else (1, 195)))
    try:
        house.turn(3)
        yield made
    finally:
        made.close()


def velocity(mav: Any, vx: float = 0.4, yaw_rate: float = 0.2, mask: int = 1479, frame: int = BODY) -> Any:
    return mav.set_position_target_local_ned_encode(0, 1, 1, frame, mask, 0, 0, 0, vx, 0, 0, 0, 0, 0, 0, yaw_rate)


@pytest.mark.parametrize("side", WAYS)
def test_everybody_hears_the_robot_as_it_spoke(house: House, side: str) -> None:
    with guest(house, side) as somebody:
        house.turn(20)
        heard = somebody.listen()
        assert {"ATTITUDE", "LOCAL_POSITION_NED"} <= {m.get_type() for m in heard}
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m in heard} <= {(1, 1), (1, 191)}
        positions = [m.x for m in heard if m.get_type() == "LOCAL_POSITION_NED"]
        assert positions == sorted(positions)


@pytest.mark.parametrize("side", WAYS)
def test_velocity_of_somebody_else_is_logged_and_refused_and_never_reaches_the_robot(house: House, side: str) -> None:
    with guest(house, side) as somebody:
        for _ in range(5):
            somebody.send(velocity(somebody.mav))
            house.turn(2)
        assert house.of(255) == []
        assert [m for m in house.reached if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"] == []
        commands = [m for m in house.runtime.messages if isinstance(m, Command)]
        assert len(commands) == 5
        assert {(c.source, c.fault) for c in commands} == {("external", "")}
        assert all(c.u == pytest.approx((0.4, -0.2)) for c in commands)
        assert house.runtime.counters[f"{side}_refused"] == 5
        assert [frame.channel for frame in house.runtime.frames if frame.channel in WAYS] == [side] * 5


def moves(mav: Any) -> dict[str, Any]:
    """Every way in which GUIDED is told to go somewhere."""
    return {
        "local": velocity(mav, mask=0, frame=1),
        "global": mav.set_position_target_global_int_encode(0, 1, 1, 6, 0, 1, 2, 3, 0, 0, 0, 0, 0, 0, 0, 0),
        "attitude": mav.set_attitude_target_encode(0, 1, 1, 0, [1, 0, 0, 0], 0, 0, 0, 0.5),
        "actuators": mav.set_actuator_control_target_encode(0, 0, 1, 1, [0.5] * 8),
        "fly here": mav.mission_item_int_encode(1, 1, 0, 3, 16, 2, 1, 0, 0, 0, 0, 10, 20, 0),
        "fly here, old": mav.mission_item_encode(1, 1, 0, 3, 16, 2, 1, 0, 0, 0, 0, 10, 20, 0),
        "reposition": mav.command_int_encode(1, 1, 3, 192, 0, 0, -1, 0, 0, 0, 10, 20, 0),
        "reposition, long": mav.command_long_encode(1, 1, 192, 0, -1, 0, 0, 0, 10, 20, 0),
        "yaw and speed": mav.command_long_encode(1, 1, 213, 0, 90, 1, 0, 0, 0, 0, 0),
    }


@pytest.mark.parametrize("side", WAYS)
def test_no_other_way_to_move_it_in_guided_passes(house: House, side: str) -> None:
    with guest(house, side) as somebody:
        for message in moves(somebody.mav).values():
            somebody.send(message)
            house.turn(2)
        assert house.of(255) == []
        assert [m for m in house.reached if m.get_srcComponent() == 195] == []
        commands = [m for m in house.runtime.messages if isinstance(m, Command)]
        assert len(commands) == len(moves(somebody.mav))
        assert all(c.fault and c.u == () for c in commands)


def test_ground_station_keeps_working(house: House) -> None:
    """Modes, arming, parameters, missions, sticks: a person's business."""
    with guest(house, "ground") as station:
        mav = station.mav
        station.send(
            mav.heartbeat_encode(6, 8, 0, 0, 4),
            mav.param_request_list_encode(1, 1),
            mav.param_set_encode(1, 1, b"WP_SPEED", 2.0, 9),
            mav.command_long_encode(1, 1, 176, 0, 1, 4, 0, 0, 0, 0, 0),
            mav.command_long_encode(1, 1, 400, 0, 0, 0, 0, 0, 0, 0, 0),
            mav.set_mode_encode(1, 1, 0),
            mav.mission_count_encode(1, 1, 1),
            mav.mission_item_int_encode(1, 1, 0, 3, 16, 0, 1, 0, 0, 0, 0, 10, 20, 0),
            mav.manual_control_encode(1, 0, 0, 500, 0, 0),
            mav.rc_channels_override_encode(1, 1, *[1500] * 8),
        )
        house.turn(5)
        sent = ["HEARTBEAT", "PARAM_REQUEST_LIST", "PARAM_SET", "COMMAND_LONG", "COMMAND_LONG", "SET_MODE", "MISSION_COUNT"]
        assert house.of(255) == [*sent, "MISSION_ITEM_INT", "MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"]
        assert house.runtime.counters["ground_passed"] == 10


def test_companion_may_tell_and_ask_but_not_change_anything(house: House) -> None:
    with guest(house, "companion") as companion:
        mav = companion.mav
        companion.send(
            mav.heartbeat_encode(18, 8, 0, 0, 4),
            mav.vision_position_estimate_encode(0, 1, 2, 3, 0, 0, 0),
            mav.command_long_encode(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0),
        )
        house.turn(3)
        told = [m.get_type() for m in house.reached if m.get_srcComponent() == 195]
        assert told == ["HEARTBEAT", "VISION_POSITION_ESTIMATE", "COMMAND_LONG"]
        house.reached.clear()
        companion.send(
            mav.command_long_encode(1, 1, 400, 0, 1, 21196, 0, 0, 0, 0, 0),
            mav.command_long_encode(1, 1, 176, 0, 1, 0, 0, 0, 0, 0, 0),
            mav.command_long_encode(1, 1, 209, 0, 1, 0, 50, 2, 0, 0, 0),
            mav.command_long_encode(1, 1, 511, 0, 32, 1e6, 0, 0, 0, 0, 0),
            mav.set_mode_encode(1, 1, 0),
            mav.param_set_encode(1, 1, b"FS_ACTION", 0.0, 2),
            mav.rc_channels_override_encode(1, 1, *[1900] * 8),
            mav.manual_control_encode(1, 0, 0, 500, 0, 0),
            mav.mission_clear_all_encode(1, 1),
            mav.setup_signing_encode(1, 1, [0] * 32, 0),
            mav.file_transfer_protocol_encode(0, 1, 1, [0] * 251),
            mav.serial_control_encode(0, 0, 0, 0, 1, [0] * 70),
        )
        house.turn(5)
        assert [m.get_type() for m in house.reached if m.get_srcComponent() == 195] == []
        counters = house.runtime.counters
        assert counters["companion_refused"] + counters["companion_blocked"] == 12


@pytest.mark.parametrize("side", WAYS)
@pytest.mark.parametrize("ids", [(1, 1), (1, 191)])
def test_nobody_passes_with_the_robots_or_the_runtimes_own_ids(house: House, side: str, ids: tuple[int, int]) -> None:
    with guest(house, side) as impostor:
        impostor.mav.srcSystem, impostor.mav.srcComponent = ids
        impostor.send(velocity(impostor.mav), impostor.mav.heartbeat_encode(10, 3, 1, 4, 4), impostor.mav.param_request_list_encode(1, 1))
        before = len(house.runtime.good)
        house.turn(5)
        assert not any(m.get_type() in ("SET_POSITION_TARGET_LOCAL_NED", "PARAM_REQUEST_LIST") for m in house.reached)
        assert house.runtime.overrides == []
        assert len(house.runtime.good) > before
        assert house.runtime.counters[f"{side}_blocked"] == 3


def test_flood_of_commands_does_not_fill_the_log(house: House) -> None:
    with guest(house, "companion") as companion:
        begin = time.monotonic()
        for _ in range(60):
            companion.send(*[velocity(companion.mav) for _ in range(20)])
            house.turn()
        house.turn(3)
        seconds = time.monotonic() - begin
        logged = [frame for frame in house.runtime.frames if frame.channel == "companion"]
        assert 0 < len(logged) <= 32 * (seconds + 2)
        counters = house.runtime.counters
        assert counters["companion_refused"] == 1200
        assert counters["companion_unlogged"] == 1200 - len(logged)
        assert house.of(195) == []


@pytest.mark.parametrize("side", WAYS)
def test_flood_from_all_connections_holds_no_call_up_and_crowds_nobody_out(house: House, side: str) -> None:
    """Eight at once: each call takes a bounded share of each, and the robot gets no more than its line can carry."""
    guests = [Guest(house.ports[side], 255, 100 + k) for k in range(tcp.OTHERS)]
    house.turn(3)
    data = b"".join(g.mav.heartbeat_encode(6, 8, 0, 0, 4).pack(g.mav) for g in guests for _ in range(50))
    begin, most, calls = time.monotonic(), 0, 0
    while time.monotonic() - begin < 1.0:
        for one in guests:
            with contextlib.suppress(BlockingIOError):
                one._socket.send(data)
        before = house.runtime.counters
        house.turn()
        after = house.runtime.counters
        most = max(most, sum(after[f"{side}_{name}"] - before[f"{side}_{name}"] for name in ("passed", "refused", "blocked")))
        calls += 1
    assert 0 < most <= 2 * (OTHERS_MOST // 21 + tcp.OTHERS)  # `turn` receives twice at most; such a frame has 21 bytes
    assert 21 * house.runtime.counters[f"{side}_passed"] <= 3 * BYTES_PER_SECOND
    good = len(house.runtime.good)
    house.turn(10)
    assert len(house.runtime.good) >= good + 8
    assert calls > 20
    for one in guests:
        one.close()


@pytest.mark.parametrize("side", WAYS)
def test_connections_that_say_nothing_lock_nobody_out(house: House, side: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """No whole frame ever comes from them: one is never begun, one never finished."""
    monkeypatch.setattr(tcp, "SILENT_NS", 300_000_000)
    idle = [Guest(house.ports[side], 255, 100 + k) for k in range(tcp.OTHERS)]
    house.turn(3)
    deadline = time.monotonic() + 0.4
    while time.monotonic() < deadline:
        for one in idle[1::2]:
            with contextlib.suppress(OSError):
                one._socket.send(b"\xfd")
        house.turn()
    with guest(house, side) as somebody:
        somebody.send(somebody.mav.heartbeat_encode(6, 8, 0, 0, 4))
        house.turn(10)
        assert "LOCAL_POSITION_NED" in {m.get_type() for m in somebody.listen()}
        assert house.of(255 if side == "ground" else 1)
        late = Guest(house.ports[side], 255, 99)
        house.turn(3)
        somebody.send(somebody.mav.heartbeat_encode(6, 8, 0, 0, 4))
        house.turn(3)
        assert somebody.listen(), "who speaks is not sent away"
        late.close()
    for one in idle:
        one.close()


def test_nobody_but_the_robot_is_shown_as_the_robot(house: House) -> None:
    """Whoever reaches the runtime's port for the robot does not reach the ground station's screen by that."""
    stranger = Robot(UdpLine("127.0.0.1", int(house.runtime.options["robot"].rpartition(":")[2])))
    with guest(house, "ground") as station:
        for _ in range(20):
            stranger.line.write(stranger.pack(stranger.mav.statustext_encode(0, b"drop the load")))
            house.turn()
        kinds = {m.get_type() for m in station.listen()}
        assert "LOCAL_POSITION_NED" in kinds
        assert "STATUSTEXT" not in kinds
    stranger.line.close()


def test_refusal_is_told_to_whoever_was_refused(house: House) -> None:
    with guest(house, "companion") as companion:
        companion.listen()
        house.runtime.transport.inform(Decided(0, "external", 0, 0, allow=False, reason="source_not_allowed", margin=-1.0))
        house.turn(2)
        assert "s2r: refused external: source_not_allowed" in [m.text for m in companion.listen() if m.get_type() == "STATUSTEXT"]


def test_ground_station_that_asks_for_rates_gets_them_and_the_runtime_asks_for_its_own_again(house: House) -> None:
    house.turn(60)
    with guest(house, "ground") as station:
        house.reached.clear()
        station.send(station.mav.request_data_stream_encode(1, 1, 0, 2, 1))
        house.turn(40)
        kinds = [(m.get_type(), m.get_srcComponent()) for m in house.reached]
        assert kinds.index(("REQUEST_DATA_STREAM", 190)) < kinds.index(("COMMAND_LONG", 191))


def test_two_ground_stations_at_once_over_udp() -> None:
    port, door = free_port(), free_port()
    robot = Robot(UdpLine("127.0.0.1", port))
    lines = [UdpLine("127.0.0.1", door) for _ in range(2)]
    stations = [Robot(line, 255, 190 + k) for k, line in enumerate(lines)]
    with Runtime(f"udp:127.0.0.1:{port}", ground=f"udp:127.0.0.1:{door}") as runtime:
        for k in range(30):
            robot.publish(k + 1, time.monotonic_ns(), (0.0, 0.0, 0.0))
            for station in stations:
                station.line.write(station.pack(station.mav.heartbeat_encode(6, 8, 0, 0, 4)))
            runtime.turn()
        assert all("LOCAL_POSITION_NED" in {m.get_type() for m in station.listen()} for station in stations)
        assert {m.get_srcComponent() for m in robot.listen() if m.get_srcSystem() == 255} == {190, 191}
    for line in (robot.line, *lines):
        line.close()


def test_runtime_can_stand_between_two_serial_devices_and_a_server() -> None:
    """A companion that waits for an autopilot to call: the runtime calls it."""
    port, theirs = free_port(), free_port(socket.SOCK_STREAM)
    robot, server = Robot(UdpLine("127.0.0.1", port)), TcpServerLine("127.0.0.1", theirs)
    companion = Robot(server, 1, 195)
    with Runtime(f"udp:127.0.0.1:{port}", companion=f"tcp:127.0.0.1:{theirs}") as runtime:
        heard: list[Any] = []
        for k in range(60):
            robot.publish(k + 1, time.monotonic_ns(), (0.0, 0.0, 0.0))
            runtime.turn()
            heard += companion.listen()
        companion.line.write(companion.pack(velocity(companion.mav)))
        for _ in range(20):
            runtime.turn()
        assert "ATTITUDE" in {m.get_type() for m in heard}
        assert runtime.counters["companion_refused"] == 1
    robot.line.close()
    server.close()
