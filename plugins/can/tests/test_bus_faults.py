"""A bus at fault: bus-off, storms of error frames, nobody who acknowledges, remote frames, other lengths, drivers that give nonsense.

Each ends in a closed gate with a reason or in a count, on a real bus of python-can; nothing hangs, and the good frame after it is read.
"""

from __future__ import annotations

import contextlib
import errno
import math
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest
from s2r_can.inbox import Bell, Inbox
from s2r_can.records import BUS_OFF, ERROR, FD_LENGTHS, STOPS, Record, records
from s2r_can.testing import SocketRig, VirtualRig
from s2r_can.transport import ERRORS_PER_SECOND, CanTransport

from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, OverrideChanged
from s2r_runtime.testing.transport_kit import Line

X = (0.5, 0.0, 0.0)
WARNING = "< error 20000004 >"
"""CAN_ERR_CRTL, as a controller says it that gets no acknowledgement."""
LEFT = "< error 20000040 >"


def linked(rig: Any) -> tuple[Line, int]:
    rig.transport.open()
    line = Line(rig)
    return line, line.link(X)


def goes_on(rig: Any, line: Line, seq: int) -> int:
    """The next good observation is heard."""
    rig.robot.publish(seq + 1, (seq + 1) * 10_000_000, X)
    assert line.until(lambda: line.reached(seq + 1))
    return seq + 1


def faults(line: Line) -> list[str]:
    return [m.fault for m in line.messages if isinstance(m, Observation) and m.fault]


def stops(line: Line) -> list[OverrideChanged]:
    return [m for m in line.messages if isinstance(m, OverrideChanged)]


@contextlib.contextmanager
def errors(rig: SocketRig) -> Iterator[Callable[[str], None]]:
    """Says what a controller on the bus reports."""
    with socket.create_connection(("127.0.0.1", rig.hub.port)) as raw:
        for word in (b"< open can0 >", b"< rawmode >"):
            raw.recv(64)
            raw.sendall(word)
        raw.recv(64)
        yield lambda text: raw.sendall(text.encode())


# ---------------------------------------------------------------- bus-off


def test_bus_off_behind_a_storm_of_errors_stops_everything_and_a_bus_that_is_back_does_not_undo_it() -> None:
    """The kernel restarts a controller by itself (restart-ms): what follows are good observations, and no release of the stop."""
    with SocketRig() as rig:
        line, seq = linked(rig)
        with errors(rig) as say:
            say(WARNING * 500 + LEFT + WARNING * 500)
            assert line.until(lambda: bool(stops(line)))
            (stop,) = stops(line)
            assert (stop.kind, stop.detail.startswith("bus-off: the CAN controller left the bus")) == ("emergency_stop", True)
            assert line.links[-1] is False
            seq = goes_on(rig, line, seq)
            assert line.links[-1] is True
            say(LEFT)
            assert line.until(lambda: line.links[-1] is False)
            time.sleep(1.1)  # said again at most once a second
            say(LEFT * 100)
            assert line.until(lambda: len(stops(line)) == 2)
        goes_on(rig, line, seq)
        counts = rig.transport.counters()
        assert counts["bus_off"] == 2
        assert counts["error_frames"] <= 4 * ERRORS_PER_SECOND + 4
        again = CanTransport(rig.options, rig.states, rig.inputs)
        heard = [m for frame in line.frames for m in again.decode(frame)]
        assert [m for m in heard if isinstance(m, OverrideChanged)] == stops(line), "an audit finds the same"


def test_bus_off_in_a_log_of_before_is_a_lost_link_as_it_was_then() -> None:
    transport = VirtualRig().transport
    (said,) = transport.decode(Frame(1, "robot", bytes.fromhex("0100000000000000400000200000")))
    assert isinstance(said, LinkChanged)
    assert not said.up


def test_bus_off_does_not_give_way_to_a_flood_and_a_flood_of_them_is_one() -> None:
    inbox = Inbox(Bell(), 4)
    left = Record(5, BUS_OFF | ERROR, STOPS, b"")
    for k in range(3):
        inbox.put(Record(k, 7, 0, b""), ring=False)
    taken = [inbox.put(left, ring=True, vital=True) for _ in range(100)]
    for k in range(10, 50):
        inbox.put(Record(k, 7, 0, b""), ring=False)
    assert taken == [True] + [False] * 99
    found = inbox.take()
    assert [record.stamp_ns for record in found] == [5, 47, 48, 49]
    assert inbox.dropped == 99 + 3 + 40 - 3
    assert inbox.put(left, ring=True, vital=True)


# ---------------------------------------------------------------- nobody acknowledges


def test_bus_on_which_nobody_acknowledges_is_a_lost_link_until_a_frame_is_taken_again() -> None:
    """The controller repeats the first frame without end, and SocketCAN's queue is full: ENOBUFS at every send, error frames meanwhile."""
    with VirtualRig() as rig:
        line, seq = linked(rig)
        port = rig.transport._robot
        assert port is not None
        assert port._bus is not None
        send, calls = port._bus.send, 0

        def full(message: can.Message, timeout: float | None = None) -> None:
            nonlocal calls
            calls += 1
            raise can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS)

        port._bus.send = full  # type: ignore[method-assign]
        slowest, begin = 0.0, time.monotonic()
        while line.links[-1] and time.monotonic() < begin + 10.0:
            seq += 1
            rig.robot.publish(seq, seq * 10_000_000, X)
            rig.robot.bus.send(can.Message(is_error_frame=True, arbitration_id=0x20, data=bytes(8)))
            began = time.thread_time()
            line.transport.send(line.transport.encode(Command(seq, 0, "controller", (0.1, 0.0), seq, 10**8)))
            slowest = max(slowest, time.thread_time() - began)
            line.turn()
            time.sleep(0.01)
        (change,) = [m for m in line.messages if isinstance(m, LinkChanged) and not m.up]
        assert "takes no frames: Failed to transmit: No buffer space available" in change.detail
        assert time.monotonic() - begin < 3.0
        assert slowest < 0.02
        for _ in range(60):  # observations alone do not bring it back
            seq += 1
            rig.robot.publish(seq, seq * 10_000_000, X)
            line.transport.send(line.transport.encode(Command(seq, 0, "recovery", (0.0, 0.0), seq, 10**8)))
            line.turn()
            time.sleep(0.01)
        assert line.links[-1] is False
        port._bus.send = send  # type: ignore[method-assign]
        line.transport.send(line.transport.encode(Command(seq, 0, "recovery", (0.0, 0.0), seq, 10**8)))
        goes_on(rig, line, seq)
        assert line.until(lambda: line.links[-1] is True)
        assert rig.transport.counters()["dropped_out"] == calls
        assert stops(line) == []


# ---------------------------------------------------------------- remote frames and other lengths


def test_remote_frames_mean_nothing_on_either_side_and_are_counted() -> None:
    """Not even under the identifier of a command or of the message that makes an observation."""
    others = {"interface": "virtual", "channel": "remote-others"}
    with VirtualRig(controller=others) as rig, can.Bus(ignore_config=True, **others) as outsider:
        line, seq = linked(rig)
        before = rig.transport.counters()
        ids = [2566849552 & 0x1FFFFFFF, 2566849808 & 0x1FFFFFFF]
        for identifier in ids * 10:
            for length in (0, 8):
                message = can.Message(arbitration_id=identifier, is_remote_frame=True, dlc=length)
                rig.robot.bus.send(message)
                outsider.send(message)
        seq = goes_on(rig, line, seq)
        assert line.until(lambda: rig.transport.counters()["ignored"] == before["ignored"] + 40)
        after = rig.transport.counters()
    assert after["foreign"] == before["foreign"] + 40
    assert (after["strangers"], after["proposals"], after["malformed"]) == (0, 0, before["malformed"])
    assert faults(line) == []
    assert stops(line) == []


@pytest.mark.parametrize("kind", [SocketRig, VirtualRig])
def test_frame_of_any_other_length_is_a_fault_and_the_next_good_one_is_read(kind: Any) -> None:
    with kind() as rig:
        line, seq = linked(rig)
        good = rig.robot.frames(seq + 1, (seq + 1) * 10_000_000, (900.0, 900.0, 0.0))[-1]
        lengths = [n for n in (FD_LENGTHS if good.is_fd else range(8)) if n != len(good.data)]
        for length in lengths:
            payload = bytes(good.data).ljust(64, b"\0")[:length]
            rig.robot.bus.send(
                can.Message(arbitration_id=good.arbitration_id, is_extended_id=good.is_extended_id, is_fd=good.is_fd, data=payload)
            )
        seq = goes_on(rig, line, seq)
        assert rig.transport.counters()["malformed"] == len(lengths)
        assert len(faults(line)) == min(len(lengths), 32)
        assert all("bytes, must have" in fault for fault in faults(line))
        assert not [m for m in line.messages if isinstance(m, Observation) and m.x and m.x[0] > 100.0]


# ---------------------------------------------------------------- drivers


class Odd(can.Message):
    """What a driver made that checked nothing."""

    def __init__(self, **changed: Any) -> None:
        super().__init__(arbitration_id=5, data=b"x", check=False)
        for name, value in changed.items():
            setattr(self, name, value)


def test_messages_that_are_no_can_frames_are_counted_whatever_driver_made_them() -> None:
    with VirtualRig() as rig:
        line, seq = linked(rig)
        pose = 2566849552 & 0x1FFFFFFF
        port = rig.transport._robot
        assert port is not None
        assert port._bus is not None
        odd: list[dict[str, Any]] = [
            {"data": bytearray(65)},
            {"data": bytearray(300), "arbitration_id": pose},
            {"data": bytearray(100_000), "is_error_frame": True},
            {"data": None},
            {"data": "text"},
            {"arbitration_id": "5"},
            {"arbitration_id": None},
            {"timestamp": None},
            {"timestamp": "now"},
        ]
        for changed in odd:
            port._bus.queue.put(Odd(**changed))  # type: ignore[attr-defined]
        seq = goes_on(rig, line, seq)
        for stamp in (math.nan, math.inf, -math.inf, -1.0, 1e300):
            port._bus.queue.put(Odd(timestamp=stamp))  # type: ignore[attr-defined]
        for identifier in (-1, 1 << 29, 1 << 70):
            port._bus.queue.put(Odd(arbitration_id=identifier))  # type: ignore[attr-defined]
        goes_on(rig, line, seq)
        counts = rig.transport.counters()
    assert counts["interface_errors"] == len(odd)
    assert counts["opened"] == 1
    assert line.links == [True]
    assert faults(line) == []
    assert all(list(records(frame.data)) for frame in line.frames)
