"""What the runtime relies on in a transport (hookspecs.Transport), checked against a real robot's end of the author's."""

from __future__ import annotations

import math
import random
import select
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import pytest

from s2r_runtime.daemon import transport_values
from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import Transport
from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged

PATIENCE_S = 10.0
"""How long anything may take that takes milliseconds on an idle machine."""
PERIOD_NS = 10_000_000
"""Between two observations of the kit's robot, by its own clock."""
CALL_S = 0.005
"""Half of a 100 Hz robot's period."""
COUNTERS = ("received", "sent", "dropped_in", "dropped_out", "malformed", "lost")


class RobotEnd(Protocol):
    """The robot's side of the protocol, as simple as can be. It speaks to the rig's transport."""

    def publish(self, seq: int, stamp_ns: int, x: tuple[float, ...]) -> None:
        """Sends one observation."""

    def publish_raw(self, data: bytes) -> None:
        """Sends these bytes where an observation would go (the largest frame that fits, if they don't)."""

    def received(self) -> list[Command]:
        """Commands that came since the last call, as the robot understood them; never blocks."""


class Rig(Protocol):
    """A transport, not yet opened, and a robot's end that reaches it once it is. Leaving the rig frees both.

    It should also have `twin() -> RobotEnd`: another robot under the same name, with an identity of its own (session, publisher, address,
    node), which is freed with the rig. Without it, nothing shows what the transport makes of two.
    """

    transport: Transport
    robot: RobotEnd
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    options: dict[str, Any]
    """What the transport was made with."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class Line:
    """An open transport with what came over it."""

    def __init__(self, rig: Rig, *, numbered: bool = True) -> None:
        """numbered: as in TransportKit."""
        self.transport, self.robot = rig.transport, rig.robot
        self._numbered = numbered
        self.frames: list[Frame] = []
        self.messages: list[Observation | ObservationRefused | Command | LinkChanged | OverrideChanged] = []
        self._seq = 100

    @property
    def good(self) -> list[Observation]:
        """Observations without a fault."""
        return [m for m in self.messages if isinstance(m, Observation) and not m.fault]

    @property
    def links(self) -> list[bool]:
        """Link changes so far: up or not."""
        return [m.up for m in self.messages if isinstance(m, LinkChanged)]

    @property
    def twins(self) -> list[str]:
        """What was said of a second robot."""
        return [m.detail for m in self.messages if isinstance(m, OverrideChanged) and m.kind == "robot_twin"]

    @property
    def last(self) -> int:
        """The number that the robot gave to the newest of them."""
        newest = self.good[-1]
        return newest.seq if self._numbered else newest.stamp_ns // PERIOD_NS

    def reached(self, seq: int) -> bool:
        """Whether that observation is here."""
        return bool(self.good) and self.last >= seq

    def turn(self) -> None:
        """One turn of a loop like the daemon's."""
        select.select([self.transport.fileno()], [], [], 0.02)
        for frame in self.transport.receive():
            self.frames.append(frame)
            self.messages += self.transport.decode(frame)
        self.messages += self.transport.poll(time.monotonic_ns())

    def until(self, ready: Callable[[], bool]) -> bool:
        """Turns until it is so; False when patience ends."""
        end = time.monotonic() + PATIENCE_S
        while not ready():
            if time.monotonic() > end:
                return False
            self.turn()
        return True

    def link(self, x: tuple[float, ...]) -> int:
        """Observations until one gets through, as a robot would send them: links take a moment. Returns the newest's seq.

        None is on its way any more then: a slow link may have many of them when the first arrives.
        """
        before = len(self.good)
        end = time.monotonic() + PATIENCE_S
        while len(self.good) == before or not self.reached(self._seq):
            assert time.monotonic() < end, "no observation got through"
            self._seq += 1
            self.robot.publish(self._seq, self._seq * PERIOD_NS, x)
            arrives_by = time.monotonic() + (0.5 if len(self.good) > before else 0.0)
            self.turn()
            while time.monotonic() < arrives_by and not self.reached(self._seq):
                self.turn()
        for _ in range(5):
            self.turn()
        return self._seq

    def heard(self, command: Command) -> list[Command]:
        """What the robot understood when this was sent, repeated until it heard anything (a link may drop)."""
        end = time.monotonic() + PATIENCE_S
        got: list[Command] = []
        while not got and time.monotonic() < end:
            self.transport.send(self.transport.encode(command))
            self.turn()
            got = self.robot.received()
        return got


def _descriptors() -> int:
    """How many files, sockets and the like this process has open."""
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


class TransportKit:
    """Subclass with `rig`. carries: fields of a command, beside u, that the protocol conveys. tolerance: of numbers, relative (a
    protocol with single precision: 1e-6). numbered: whether it conveys the robot's own count of observations; if not, theirs is the
    transport's. resolution_ns: of its stamps.
    """

    rig: ClassVar[Callable[[], Any]]
    """Makes a `Rig`."""
    carries: ClassVar[tuple[str, ...]] = ("seq", "obs_seq", "ttl_ns")
    tolerance: ClassVar[float] = 0.0
    numbered: ClassVar[bool] = True
    resolution_ns: ClassVar[int] = 1

    @pytest.fixture
    def bench(self) -> Any:
        """The rig, transport not opened."""
        with type(self).rig() as rig:
            yield rig
            rig.transport.close()

    @pytest.fixture
    def line(self, bench: Rig) -> Line:
        """The transport open and linked."""
        bench.transport.open()
        line = Line(bench, numbered=self.numbered)
        line.link((0.0,) * len(bench.states))
        return line

    def _same(self, a: tuple[float, ...], b: tuple[float, ...]) -> bool:
        return len(a) == len(b) and all(
            math.isclose(x, y, rel_tol=self.tolerance, abs_tol=self.tolerance) for x, y in zip(a, b, strict=True)
        )

    # ------------------------------------------------------------------ fields

    def test_every_field_of_an_observation_arrives(self, bench: Rig, line: Line) -> None:
        draw = random.Random(1)
        last = line.last
        for k in range(1, 6):
            x = tuple(draw.uniform(-3.0, 3.0) for _ in bench.states)
            stamp_ns = (last + k) * PERIOD_NS + 2_345_000
            line.robot.publish(last + k, stamp_ns, x)
            assert line.until(partial(line.reached, last + k)), "an observation was lost on an idle link"
            got = line.good[-1]
            assert line.last == last + k
            assert got.stamp_ns == stamp_ns - stamp_ns % self.resolution_ns
            assert self._same(got.x, x)

    def test_every_field_of_a_command_arrives(self, bench: Rig, line: Line) -> None:
        draw = random.Random(2)
        for k in range(1, 6):
            u = tuple(draw.uniform(-1.0, 1.0) for _ in bench.inputs)
            sent = Command(k, line.good[-1].stamp_ns + k, "sampler", u, line.good[-1].seq, 80_000_000)
            got = line.heard(sent)
            assert got, "no command reached the robot"
            assert self._same(got[-1].u, u)
            for field in self.carries:
                assert getattr(got[-1], field) == getattr(sent, field), field

    def test_command_carries_its_time_to_live(self, line: Line, bench: Rig) -> None:
        """A robot that hears nothing more must be able to know when to stop."""
        if "ttl_ns" not in self.carries:
            pytest.skip("the protocol has no time to live; the robot must have a time-out of its own, and the docs say which")
        for ttl_ns in (20_000_000, 100_000_000, 1_000_000_000):
            got = line.heard(Command(1, line.good[-1].stamp_ns + ttl_ns, "recovery", (0.0,) * len(bench.inputs), line.good[-1].seq, ttl_ns))
            assert got[-1].ttl_ns == ttl_ns

    # ------------------------------------------------------------------ refusals

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_command_that_is_not_finite_is_refused(self, bench: Rig, value: float) -> None:
        for i in range(len(bench.inputs)):
            u = tuple(value if j == i else 0.0 for j in range(len(bench.inputs)))
            with pytest.raises(ValueError, match="finite"):
                bench.transport.encode(Command(1, 0, "sampler", u, 0, 1))

    def test_command_of_the_wrong_shape_is_refused(self, bench: Rig) -> None:
        for n in (0, len(bench.inputs) - 1, len(bench.inputs) + 1):
            with pytest.raises(ValueError, match="inputs"):
                bench.transport.encode(Command(1, 0, "sampler", (0.0,) * n, 0, 1))

    def test_garbage_becomes_a_fault_or_nothing_and_never_an_exception(self, bench: Rig, line: Line) -> None:
        draw = random.Random(3)
        good = line.frames[-1].data
        garbage = [b"", b"\x00", b"\xff" * 200, b"[" * 60_000, good[: len(good) // 2], good + good, bytes(reversed(good))]
        for _ in range(300):
            cut = bytearray(good)
            for _ in range(draw.randint(1, 4)):
                cut[draw.randrange(len(cut))] = draw.randrange(256)
            garbage.append(bytes(cut))
        make: Any = type(bench.transport)
        victim = make(bench.options, bench.states, bench.inputs)
        for data in [good, *garbage]:
            for message in victim.decode(Frame(time.monotonic_ns(), line.frames[-1].channel, data)):
                if isinstance(message, Observation | Command) and not message.fault:
                    values = message.x if isinstance(message, Observation) else message.u
                    assert all(map(math.isfinite, values))
        for data in garbage[:4]:
            line.robot.publish_raw(data)
        line.link((0.0,) * len(bench.states))

    def test_numbers_that_are_not_finite_never_come_through(self, bench: Rig, line: Line) -> None:
        before = line.last
        for k, value in enumerate((math.nan, math.inf, -math.inf), start=1):
            line.robot.publish(before + k, (before + k) * PERIOD_NS, (value,) * len(bench.states))
        for _ in range(20):
            line.turn()
        assert all(math.isfinite(value) for m in line.messages if isinstance(m, Observation) for value in m.x)
        assert line.last == before

    def test_unknown_option_is_refused(self, bench: Rig) -> None:
        make: Any = type(bench.transport)
        with pytest.raises(ConfigError, match="no_such_option"):
            make({**bench.options, "no_such_option": 1}, bench.states, bench.inputs)

    def test_every_option_is_explained(self, bench: Rig) -> None:
        assert set(bench.options) <= set(bench.transport.OPTIONS)
        assert all(bench.transport.OPTIONS.values())

    # ------------------------------------------------------------------ time and order

    def test_stamps_only_rise_whatever_order_observations_come_in(self, bench: Rig, line: Line) -> None:
        base = line.last
        x = (0.0,) * len(bench.states)
        for k in (5, 3, 5, 4, 6, 1, 6, 7):
            line.robot.publish(base + k, (base + k) * PERIOD_NS, x)
        assert line.until(lambda: line.last >= base + 7)
        stamps = [o.stamp_ns for o in line.good]
        assert stamps == sorted(set(stamps))
        assert line.transport.counters()["lost"] >= 4

    def test_decoding_depends_on_frames_only(self, bench: Rig, line: Line) -> None:
        """An audit decodes the logged frames again, without a link and long after."""
        base = line.last
        for k in range(1, 6):
            line.robot.publish(base + k, (base + k) * PERIOD_NS, (0.1 * k,) * len(bench.states))
        line.robot.publish_raw(b"garbage")
        assert line.until(lambda: line.last == base + 5)
        line.turn()
        make: Any = type(bench.transport)
        again = make(bench.options, bench.states, bench.inputs)
        replayed = [m for frame in line.frames for m in again.decode(frame)]
        live = [m for m in line.messages if not isinstance(m, LinkChanged)]
        assert [m for m in replayed if not isinstance(m, LinkChanged)] == live

    # ------------------------------------------------------------------ whose they are

    def test_two_robots_under_one_name_are_told(self, bench: Rig, line: Line) -> None:
        """Both would obey every command, and the gate would see only one of them."""
        if not hasattr(bench, "twin"):
            pytest.skip("the rig has no twin(): nothing shows what the transport makes of two robots under one name")
        other: RobotEnd = bench.twin()
        base, nx = line.last, len(bench.states)
        for k in range(1, 150):
            line.robot.publish(base + k, (base + k) * PERIOD_NS, (0.001 * k,) * nx)
            other.publish(base // 2 + k, (base // 2 + k) * PERIOD_NS, (2.0 - 0.001 * k,) * nx)
            begin = time.monotonic()
            while time.monotonic() - begin < 0.01:
                line.turn()
            if line.twins:
                break
        assert line.twins, "two robots published for 1.5 s and nobody was told"

    def test_robot_that_starts_anew_after_a_silence_is_no_second_one(self, bench: Rig, line: Line) -> None:
        """Longer than the time after which its link counts as lost. Its numbers and its clock begin anew."""
        assert line.until(lambda: bool(line.links) and not line.links[-1]), "its silence was not noticed"
        nx = len(bench.states)
        for k in range(1, 40):
            line.robot.publish(k, k * PERIOD_NS, (0.001 * k,) * nx)
            begin = time.monotonic()
            while time.monotonic() - begin < 0.01:
                line.turn()
        assert line.twins == []

    def test_echoes_are_refused_and_no_second_robot(self, bench: Rig, line: Line) -> None:
        base, nx = line.last, len(bench.states)
        for k in range(1, 40):
            for seq in (base + k, base + max(1, k - 3)):
                line.robot.publish(seq, seq * PERIOD_NS, (0.001 * (seq - base),) * nx)
            begin = time.monotonic()
            while time.monotonic() - begin < 0.01:
                line.turn()
        assert line.until(lambda: line.reached(base + 39))
        assert line.twins == []
        assert any(isinstance(m, ObservationRefused) for m in line.messages), "what is dropped must count (`ObservationRefused`)"

    # ------------------------------------------------------------------ the link

    def test_lost_robot_is_reported_and_its_return_too(self, bench: Rig, line: Line) -> None:
        assert line.until(lambda: bool(line.links) and line.links[-1]), "the link was never reported up"
        assert line.until(lambda: not line.links[-1]), "a silent robot was not noticed"
        line.link((0.0,) * len(bench.states))
        assert line.until(lambda: line.links[-1]), "the robot's return was not noticed"
        assert all(a != b for a, b in zip(line.links, line.links[1:], strict=False)), "the same link state was reported twice"

    def test_robot_that_never_answers_is_reported(self, bench: Rig) -> None:
        bench.transport.open()
        line = Line(bench)
        assert line.until(lambda: line.links == [False])

    def test_receive_never_blocks_and_says_by_its_descriptor_when_to_come(self, bench: Rig, line: Line) -> None:
        assert line.transport.receive() == []
        assert select.select([line.transport.fileno()], [], [], 0.0)[0] == []
        base = line.last
        line.robot.publish(base + 1, (base + 1) * PERIOD_NS, (0.0,) * len(bench.states))
        assert select.select([line.transport.fileno()], [], [], PATIENCE_S)[0]
        assert line.transport.receive()

    def test_sending_to_nobody_neither_blocks_nor_raises(self, bench: Rig) -> None:
        bench.transport.open()
        begin = time.monotonic()
        for k in range(200):
            bench.transport.send(bench.transport.encode(Command(k, k, "recovery", (0.0,) * len(bench.inputs), 0, 1)))
        assert time.monotonic() - begin < PATIENCE_S
        counters = bench.transport.counters()
        assert counters["sent"] + counters["dropped_out"] == 200

    def test_queue_is_bounded_and_what_it_drops_is_counted(self, bench: Rig, line: Line) -> None:
        base, count, x = line.last, 5000, (0.0,) * len(bench.states)
        before, frames = line.transport.counters(), len(line.frames)
        for k in range(1, count + 1):
            line.robot.publish(base + k, (base + k) * PERIOD_NS, x)
            if k % 200 == 0:
                time.sleep(0.005)  # the link's own buffers must drain, or it drops what nobody can count
        end = time.monotonic() + PATIENCE_S
        waiting: list[Frame] = []
        while time.monotonic() < end and not (waiting and line.last == base + count):
            line.robot.publish(base + count, (base + count) * PERIOD_NS, x)
            time.sleep(0.05)
            waiting = line.transport.receive()
            line.frames += waiting
            line.messages += [m for frame in waiting for m in line.transport.decode(frame)]
        after = line.transport.counters()
        assert line.last == base + count, "the newest must survive"
        assert len(line.frames) - frames < count, "nothing was dropped: the queue has no bound"
        assert after["dropped_in"] > before["dropped_in"]

    def test_counters_are_there(self, bench: Rig) -> None:
        counters = bench.transport.counters()
        assert set(COUNTERS) <= set(counters)
        assert all(isinstance(value, int) and value >= 0 for value in counters.values())

    # ------------------------------------------------------------------ the daemon's door

    def test_what_it_gives_is_what_the_daemon_takes(self, bench: Rig, line: Line) -> None:
        """Of the right types, not stamped in the future: anything else closes the gate and names the plug-in."""
        transport_values.descriptor(line.transport.fileno())
        transport_values.frames(line.frames, time.monotonic_ns())
        transport_values.link_changes(line.transport.poll(time.monotonic_ns()))
        make: Any = type(bench.transport)
        again = make(bench.options, bench.states, bench.inputs)
        decoded = [transport_values.decoded(again, frame, len(bench.states)) for frame in line.frames]
        assert [said.fault for said in decoded if said.fault is not None] == []
        assert any(said.messages for said in decoded)
        command = Command(1, line.good[-1].stamp_ns, "recovery", (0.0,) * len(bench.inputs), line.good[-1].seq, 80_000_000)
        transport_values.outbound(line.transport.encode(command))
        assert transport_values.counters(line.transport.counters()) == line.transport.counters()

    def test_no_call_waits(self, bench: Rig, line: Line) -> None:
        """They are called from the loop that runs the gate. The median, as this machine may be busy."""
        command = Command(1, line.good[-1].stamp_ns, "recovery", (0.0,) * len(bench.inputs), line.good[-1].seq, 80_000_000)
        took: dict[str, list[float]] = {"receive": [], "poll": [], "send": []}
        for _ in range(50):
            begin = time.monotonic()
            line.transport.receive()
            received = time.monotonic()
            line.transport.poll(time.monotonic_ns())
            polled = time.monotonic()
            line.transport.send(line.transport.encode(command))
            sent = time.monotonic()
            for name, seconds in zip(took, (received - begin, polled - received, sent - polled), strict=True):
                took[name].append(seconds)
        assert {name: sorted(all_)[25] for name, all_ in took.items() if sorted(all_)[25] > CALL_S} == {}

    # ------------------------------------------------------------------ the end

    def test_close_twice_and_close_unopened(self, bench: Rig) -> None:
        bench.transport.close()
        bench.transport.open()
        bench.transport.close()
        bench.transport.close()

    def test_close_frees_its_descriptors(self, bench: Rig) -> None:
        bench.transport.open()
        bench.transport.close()
        before = _descriptors()
        for _ in range(5):
            bench.transport.open()
            bench.transport.close()
        end = time.monotonic() + PATIENCE_S
        while _descriptors() > before + 2 and time.monotonic() < end:
            time.sleep(0.05)  # threads of a library may take a moment
        assert _descriptors() <= before + 2

    def test_construction_opens_nothing(self, bench: Rig) -> None:
        make: Any = type(bench.transport)
        before = _descriptors()
        kept = [make(bench.options, bench.states, bench.inputs) for _ in range(20)]
        assert _descriptors() <= before  # what an earlier test closed may go only now
        assert len(kept) == 20
