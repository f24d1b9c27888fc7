"""Bad input, as real bytes on a real line: what was never true is never an observation, and the real robot is still heard.

The truth is at x = k mm for its k-th observation; every lie says that it is at 900 m or beyond.
"""

from __future__ import annotations

import contextlib
import math
import random
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink
from s2r_mavlink.dialect import MESSAGES
from s2r_mavlink.endpoints import ROBOT_MOST, SHOWN_MOST
from s2r_mavlink.frames import DATAGRAM as DATAGRAM_MOST
from s2r_mavlink.frames import LONGEST, build, header, is_frame
from s2r_mavlink.rover_lines import TcpServerLine, UdpLine
from s2r_mavlink.signing import stamp_of
from s2r_mavlink.testing import HOLD, INPUTS, STATES, Robot, Runtime, free_port, fuzzed
from s2r_mavlink.transport import MavlinkTransport
from s2r_mavlink.udp import DATAGRAM

from s2r_runtime.messages import Command, Frame, LinkChanged, Observation

LIE = 900.0
MS = 1_000_000
KEY, OTHER_KEY = bytes(range(32)), bytes(range(100, 132))


class Truth:
    """A real robot at its line, with a clock that runs with the host's, and the runtime that listens to it."""

    def __init__(self, runtime: Runtime, line: Any, key: bytes | None = None) -> None:
        self.runtime, self.robot, self._begin, self.k = runtime, Robot(line), time.monotonic_ns(), 0
        self.sent: list[bytes] = []
        if key is not None:
            self.robot.mav.signing.secret_key, self.robot.mav.signing.sign_outgoing = key, True
            self.robot.mav.signing.timestamp = stamp_of(time.time()) + 1000

    def tell(self, count: int = 1, *, heartbeat: bool = False) -> None:
        """So many observations, about 20 ms apart, each heard at once."""
        for _ in range(count):
            self.k += 1
            stamp_ns = 10_000 * MS + time.monotonic_ns() - self._begin
            messages = self.robot.messages(stamp_ns, (1e-3 * self.k, 0.0, 0.0))
            if heartbeat or self.k % 10 == 1:
                messages.insert(0, self.robot.heartbeat())
            for message in messages:
                self.sent.append(self.robot.pack(message))
                self.robot.line.write(self.sent[-1])
            end = time.monotonic() + 0.012
            while time.monotonic() < end:
                self.runtime.turn()

    def heard(self) -> bool:
        """Whether the newest observation came through."""
        return self.runtime.until(
            lambda: bool(self.runtime.good) and self.runtime.good[-1].x[0] == pytest.approx(1e-3 * self.k, abs=1e-6), 2.0
        )

    def lies(self) -> list[Observation]:
        """Observations that were never true."""
        return [o for o in self.runtime.observations if o.x and (abs(o.x[0]) >= LIE or abs(o.x[1]) >= LIE)]


@pytest.fixture
def truth() -> Iterator[Truth]:
    """Over UDP, unsigned, and known for long enough that its clock is too."""
    port = free_port()
    with Runtime(f"udp:127.0.0.1:{port}") as runtime:
        made = Truth(runtime, UdpLine("127.0.0.1", port))
        made.tell(100)
        assert made.heard()
        yield made
        made.robot.line.close()


@pytest.fixture
def signed(tmp_path: Path) -> Iterator[Truth]:
    """The same, signed."""
    port, path = free_port(), tmp_path / "key"
    path.write_text(KEY.hex())
    path.chmod(0o600)
    with Runtime(f"udp:127.0.0.1:{port}", signing_key_file=str(path), signing_state=str(tmp_path / "state.json")) as runtime:
        made = Truth(runtime, UdpLine("127.0.0.1", port), KEY)
        made.tell(100)
        assert made.heard()
        yield made
        made.robot.line.close()


@pytest.fixture
def stranger(truth: Truth) -> Iterator[Robot]:
    """Somebody else who can send to the same port."""
    line = UdpLine("127.0.0.1", int(truth.runtime.options["robot"].rpartition(":")[2]))
    yield Robot(line)
    line.close()


def lie(robot: Robot, stamp_ns: int, *, sequence: int | None = None) -> None:
    """The robot is said to be far away."""
    for place, message in enumerate(robot.messages(stamp_ns, (LIE + 100.0, LIE + 100.0, 1.0))):
        robot.line.write(robot.pack(message, None if sequence is None else sequence + place))


# ---------------------------------------------------------------- somebody else on the network


def test_somebody_at_another_address_is_not_the_robot_while_it_is_there(truth: Truth, stranger: Robot) -> None:
    for k in range(30):
        lie(stranger, 10_000 * MS + time.monotonic_ns() - truth._begin, sequence=truth.robot.mav.seq)
        stranger.line.write(stranger.pack(stranger.heartbeat(HOLD, 1), truth.robot.mav.seq))
        truth.tell()
        assert k >= 0
    assert truth.lies() == []
    assert {stop.kind for stop in truth.runtime.overrides} == {"robot_twin"}, "two robots, and a forged heartbeat is no person's hand"
    assert truth.runtime.overrides[0].detail == "two robots answer to this system id, from two addresses"
    assert truth.runtime.counters["rejected_other_address"] >= 60
    assert truth.heard()
    assert truth.runtime.faults == []
    truth.runtime.command = (0.1, 0.0)
    truth.tell(5)
    assert stranger.received() == [], "commands go to the robot"
    assert truth.robot.received()
    assert any(frame.channel == "door" and b"other_address" in frame.data for frame in truth.runtime.frames), "the log says it"


def test_copy_of_the_robots_frames_by_another_way_is_no_second_robot(truth: Truth, stranger: Robot) -> None:
    for k in range(40):
        heartbeat = [truth.robot.heartbeat()] if k % 5 == 0 else []
        stamp_ns = 10_000 * MS + time.monotonic_ns() - truth._begin
        frames = [truth.robot.pack(message) for message in [*heartbeat, *truth.robot.messages(stamp_ns, (0.001, 0.0, 0.0))]]
        ways = [truth.robot.line, stranger.line]
        for line in ways if k % 2 else reversed(ways):  # now the one is faster, now the other
            for data in frames:
                line.write(data)
        truth.runtime.run(0.02)
    assert truth.runtime.counters["rejected_other_address"] >= 60
    assert truth.runtime.overrides == []
    truth.tell()
    assert truth.heard()


def test_robot_that_comes_back_from_another_port_is_the_robot(truth: Truth, stranger: Robot) -> None:
    time.sleep(0.6)
    begin = time.monotonic()
    count = len(truth.runtime.good)
    stamp_ns = 10_000 * MS + time.monotonic_ns() - truth._begin
    for k in range(20):
        stranger.line.write(stranger.pack(stranger.heartbeat()))
        for message in stranger.messages(stamp_ns + 20 * MS * k, (0.001, 0.0, 0.0)):
            stranger.line.write(stranger.pack(message))
        truth.runtime.turn()
    assert truth.runtime.until(lambda: len(truth.runtime.good) > count)
    assert time.monotonic() - begin < 1.0
    assert truth.runtime.counters["rejected_other_address"] == 0


def test_frames_of_other_systems_mean_nothing_here(truth: Truth) -> None:
    for system, component in ((2, 1), (255, 190), (1, 191), (1, 2), (0, 0)):
        other = Robot(truth.robot.line, system, component)
        for _ in range(20):
            lie(other, 10_000 * MS + time.monotonic_ns() - truth._begin)
            other.line.write(other.pack(other.heartbeat(HOLD, 1)))
        truth.tell(3)
    assert truth.lies() == []
    assert truth.runtime.overrides == []
    assert truth.heard()
    assert truth.runtime.counters["rejected_foreign"] >= 5 * 60
    assert not any(frame.channel == "door" for frame in truth.runtime.frames), "others on the line are no incident"


def test_flood_from_another_address_holds_no_call_up(truth: Truth, stranger: Robot) -> None:
    """What waits in the kernel is taken in shares, also where a datagram is full of frames, or empty."""
    frame = stranger.pack(stranger.heartbeat())
    for data in (b"", frame, frame * 400):
        for _ in range(2000):
            stranger.line.write(data)
        most = 0
        for _ in range(20):
            before = truth.runtime.counters["received"]
            truth.runtime.transport.receive()
            most = max(most, truth.runtime.counters["received"] - before)
        assert most <= (ROBOT_MOST + DATAGRAM) // len(frame) + 1
    while truth.runtime.transport.receive() or truth.runtime.counters["received"] != before:
        before = truth.runtime.counters["received"]
    time.sleep(0.6)  # the robot was silent meanwhile, and the stranger was taken for it: until it is silent
    truth.tell(5)
    assert truth.heard()


def test_what_a_flooding_robot_sends_is_shown_to_the_others_in_a_bounded_share() -> None:
    """Each write to somebody else costs more than a frame: eight listeners must not multiply a flood."""
    port, companion = free_port(), free_port(socket.SOCK_STREAM)
    with Runtime(f"udp:127.0.0.1:{port}", companion=f"tcpin:127.0.0.1:{companion}") as runtime, contextlib.ExitStack() as stack:
        for _ in range(8):
            stack.enter_context(socket.create_connection(("127.0.0.1", companion)))
        runtime.turn()
        robot = Robot(UdpLine("127.0.0.1", port))
        stack.callback(robot.line.close)
        written: list[bytes] = []
        line = runtime.transport._relays[0].line
        line.write = lambda data, source=None: bool(written.append(data)) or True  # type: ignore[assignment, method-assign]
        for _ in range(20):
            robot.line.write(b"".join(robot.pack(robot.heartbeat()) for _ in range(400)))
        runtime.transport.receive()
    assert 0 < len(written) <= SHOWN_MOST // (DATAGRAM_MOST - LONGEST) + 1
    assert sum(map(len, written)) <= SHOWN_MOST


# ---------------------------------------------------------------- the robot's own line


def test_replayed_frames_change_nothing(truth: Truth) -> None:
    """What was true is over: replayed positions are old, replayed heartbeats are out of order."""
    old = list(truth.sent)
    for k in range(7):
        for frame in old[60 + 20 * k : 66 + 20 * k]:
            truth.robot.line.write(frame)
        truth.tell(5)
    assert truth.heard()
    xs = [o.x[0] for o in truth.runtime.good]
    assert xs == sorted(xs)
    assert truth.runtime.overrides == []


def test_flood_of_replayed_frames_closes_the_gate_and_never_moves_the_robot_back(truth: Truth) -> None:
    """Without signatures nobody can tell it from a second robot."""
    draw, old = random.Random(1), list(truth.sent)
    for _ in range(40):
        for frame in draw.sample(old, 4):
            truth.robot.line.write(frame)
        truth.tell()
    xs = [o.x[0] for o in truth.runtime.good]
    assert xs == sorted(xs)
    assert "two robots answer to this system id" in truth.runtime.faults


def test_reordered_and_duplicated_frames_are_taken_in_order_once(truth: Truth) -> None:
    draw, held = random.Random(2), []
    write = truth.robot.line.write

    def shuffled(data: bytes) -> bool:
        held.append(data)
        if len(held) >= 6:
            draw.shuffle(held)
            for frame in held:
                write(frame)
                if draw.random() < 0.3:
                    write(frame)
            held.clear()
        return True

    truth.robot.line.write = shuffled  # type: ignore[method-assign]
    before = len(truth.runtime.good)
    truth.tell(120)
    good = truth.runtime.good
    assert len(good) - before > 40
    assert [o.stamp_ns for o in good] == sorted({o.stamp_ns for o in good})
    assert [o.x[0] for o in good] == sorted({o.x[0] for o in good})
    assert truth.lies() == []


@pytest.mark.parametrize("ahead_s", [5.0, 3600.0, 4_200_000.0])
def test_far_future_stamps_are_dropped_and_lock_nobody_out(truth: Truth, ahead_s: float) -> None:
    """On the robot's own line, with its own number: only the stamp shows that it is made up."""
    for _ in range(5):
        lie(truth.robot, int(min(10.0 + ahead_s, 4_294_967.0) * 1e9))
        truth.tell(4)
    assert truth.lies() == []
    assert truth.heard()
    assert truth.runtime.counters["ahead"] >= 5
    assert truth.runtime.ups == [True]


def test_numbers_that_are_none_are_faults(truth: Truth) -> None:
    for bad in (math.nan, math.inf, -math.inf, 1e30):
        for x in ((bad, 0.0, 0.0), (0.0, bad, 0.0), (0.0, 0.0, bad)):
            stamp_ns = 10_000 * MS + time.monotonic_ns() - truth._begin
            for message in truth.robot.messages(stamp_ns, x):
                truth.robot.line.write(truth.robot.pack(message))
            time.sleep(0.002)  # the next observation has a stamp of its own
            truth.tell(1)
    assert all(math.isfinite(value) for o in truth.runtime.observations for value in o.x)
    assert len([fault for fault in truth.runtime.faults if "is no number" in fault]) == 12
    assert truth.lies() == []
    assert truth.heard()


def test_truncated_and_corrupted_frames_are_dropped_and_counted(truth: Truth) -> None:
    """Up to three flipped bits: the checksum finds them all."""
    draw = random.Random(3)
    for _ in range(300):
        stamp_ns = 10_000 * MS + time.monotonic_ns() - truth._begin
        frame = bytearray(truth.robot.pack(truth.robot.messages(stamp_ns, (LIE + 100.0, 0.0, 0.0))[1]))
        if draw.random() < 0.3:
            frame = frame[: draw.randrange(1, len(frame))]
        else:
            for _ in range(draw.randint(1, 3)):
                frame[draw.choice([i for i in range(len(frame)) if i not in (7, 8, 9)])] ^= 1 << draw.randrange(8)
        truth.robot.line.write(bytes(frame))
        if draw.random() < 0.1:
            truth.tell(1)
    truth.tell(3)
    assert truth.lies() == []
    assert truth.heard()
    assert truth.runtime.counters["malformed"] >= 250


def test_time_that_somebody_makes_up_is_no_age(truth: Truth) -> None:
    """Answers about the time that were never asked for, from now, the past and the future."""
    now = time.monotonic_ns()
    for tc1, ts1 in ((1, now + 10**12), (2**62, now), (10_000 * MS, 1), (1, -5), (-1, now)):
        truth.robot.line.write(truth.robot.pack(truth.robot.mav.timesync_encode(tc1, ts1)))
        truth.tell(3)
    assert truth.heard()
    assert truth.runtime.counters["stale"] == 0


def test_two_robots_on_one_stream_are_noticed() -> None:
    """Behind a router they have one address; their numbers and clocks give them away."""
    port = free_port(socket.SOCK_STREAM)
    line = TcpServerLine("127.0.0.1", port)
    with Runtime(f"tcp:127.0.0.1:{port}") as runtime:
        one = Truth(runtime, line)
        one.tell(100)
        assert one.heard()
        two = Robot(line)
        two.mav.seq = 150
        for k in range(40):
            two.line.write(two.pack(two.heartbeat()))
            lie(two, 3_000 * MS + 20 * MS * k)
            one.tell()
        assert one.lies() == []
        assert runtime.faults[-1] == "two robots answer to this system id"
        assert {stop.kind for stop in runtime.overrides} >= {"robot_twin"}
    line.close()


# ---------------------------------------------------------------- signed


def forged(truth: Truth, key: bytes | None, **changes: int) -> bytes:
    """A lie in the robot's own numbers, signed with that key."""
    liar = Robot(truth.robot.line)
    if key is not None:
        liar.mav.signing.secret_key, liar.mav.signing.sign_outgoing = key, True
        liar.mav.signing.timestamp = changes.get("stamp", truth.robot.mav.signing.timestamp + 1000)
    stamp_ns = 10_000 * MS + time.monotonic_ns() - truth._begin
    return liar.pack(liar.messages(stamp_ns, (LIE + 100.0, 0.0, 0.0))[1], truth.robot.mav.seq)


@pytest.mark.parametrize("key", [None, OTHER_KEY])
def test_forged_frame_on_a_signed_line_is_not_believed_and_locks_nobody_out(signed: Truth, key: bytes | None) -> None:
    for stamp in (0, signed.robot.mav.signing.timestamp + 5, 1 << 45, (1 << 48) - 1):
        for _ in range(20):
            signed.robot.line.write(forged(signed, key, stamp=stamp))
        signed.tell(3)
        assert signed.heard()
    assert signed.lies() == []
    assert signed.runtime.faults == []
    assert signed.runtime.counters["rejected_unsigned" if key is None else "rejected_bad_signature"] == 80


def test_flood_of_replayed_signed_frames_changes_nothing(signed: Truth) -> None:
    draw, old = random.Random(4), list(signed.sent)
    before = len(signed.runtime.good)
    for _ in range(40):
        for frame in draw.sample(old, 10):
            signed.robot.line.write(frame)
        signed.tell()
    assert signed.runtime.until(lambda: len(signed.runtime.good) >= before + 40)
    assert signed.runtime.faults == []
    assert signed.runtime.counters["rejected_old_stamp"] == 400


def test_restarted_runtime_is_not_fooled_by_a_recording(signed: Truth) -> None:
    """Made a moment ago, with a good key, and played to one that has just begun."""
    old = list(signed.sent)
    options = signed.runtime.options
    signed.runtime.transport.close()
    with Runtime(options["robot"], **{k: v for k, v in options.items() if k != "robot"}) as again:
        for frame in old:
            signed.robot.line.write(frame)
            again.turn()
        assert again.observations == []
        assert again.overrides == []
        assert again.counters["rejected_old_stamp"] == len(old)


def test_everything_that_is_sent_is_signed_and_the_log_holds_no_signature(signed: Truth) -> None:
    signed.runtime.command = (0.2, -0.1)
    heard: list[bytes] = []
    read = signed.robot.line.read
    signed.tell(20)
    while data := read():
        heard.append(data)
    assert len(heard) > 20
    assert all(header(data).signed for data in heard)
    kinds = [m.get_type() for data in heard for m in signed.robot.mav.parse_buffer(data)]
    assert set(kinds) <= {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "SET_POSITION_TARGET_LOCAL_NED"}
    frame = signed.runtime.transport.encode(Command(1, 0, "sampler", (0.1, 0.0), 1, 10**8))
    assert not header(frame.data).signed
    again = MavlinkTransport(signed.runtime.options, STATES, INPUTS)
    for _ in range(20):
        again.encode(Command(1, 0, "sampler", (0.1, 0.0), 1, 10**8))
    assert is_frame(again.encode(Command(1, 0, "sampler", (0.1, 0.0), 1, 10**8)).data), "an audit needs no key"


# ---------------------------------------------------------------- any bytes at all


def test_any_bytes_end_in_a_fault_or_nothing_and_never_in_an_exception() -> None:
    """A share of the million that tools/bench_mavlink.py tries. Decoded as an audit would, from frames that never saw the door."""
    draw = random.Random(5)
    robot = Robot(UdpLine("127.0.0.1", free_port()))
    corpus = [robot.pack(m) for k in range(50) for m in robot.messages(k * 20 * MS, (0.1, 0.2, 0.3))]
    corpus += [robot.pack(robot.heartbeat()), robot.pack(robot.mav.timesync_encode(5, 6)), robot.pack(robot.mav.command_ack_encode(176, 0))]
    corpus += [robot.pack(mavlink.MAVLink_statustext_message(2, b"PreArm: x")), build(84, MESSAGES[84].pack(*(0,) * 16), 1, 255, 190)]
    robot.line.close()
    transport = MavlinkTransport({"robot": "udp:127.0.0.1:1"}, STATES, INPUTS)
    for k in range(20_000):
        channel = draw.choice(("robot", "robot", "robot", "ground", "companion", "door", "nonsense"))
        for message in transport.decode(Frame(k * MS, channel, fuzzed(draw, corpus))):
            if isinstance(message, Observation | Command) and not message.fault:
                values = message.x if isinstance(message, Observation) else message.u
                assert all(map(math.isfinite, values))
            assert not (isinstance(message, Command) and message.source != "external")
            assert isinstance(message, LinkChanged) or message is not None


def test_junk_on_the_line_does_not_keep_the_robot_out(truth: Truth) -> None:
    draw = random.Random(6)
    for _ in range(60):
        for _ in range(5):
            truth.robot.line.write(fuzzed(draw, truth.sent[:50]))
        truth.tell()
    truth.tell(20)
    assert truth.lies() == []
    assert truth.runtime.until(lambda: truth.runtime.good[-1].x[0] > 1e-3 * (truth.k - 3), 2.0) or truth.runtime.faults[-1].startswith(
        "two"
    )
