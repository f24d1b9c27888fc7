"""What the transport makes of frames: good ones become observations, and nothing else does."""

from __future__ import annotations

import math
import random
from typing import Any

import can
import pytest
from s2r_can.options import checked
from s2r_can.records import ERROR, EXTENDED, Record, key_of, packed
from s2r_can.testing import CLASSIC, INPUTS, STATES, Robot, options_of
from s2r_can.transport import CanTransport

from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged

MS = 1_000_000
STATE_SIGNALS = {"x": "Position.X", "y": "Position.Y", "theta": "Heading.Theta"}


class Bench:
    """A robot's end whose frames are handed to `decode`, without a bus. Classic frames; one observation every 10 ms."""

    def __init__(self, **options: Any) -> None:
        self.robot = Robot({}, CLASSIC)
        self.transport = CanTransport({**options_of(CLASSIC, {"interface": "virtual", "channel": "none"}), **options}, STATES, INPUTS)
        self.now_ns = 10**9
        self.messages: list[Any] = []

    def records(self, seq: int, x: tuple[float, ...] = (1.0, 2.0, 0.5), stop: int = 0) -> list[Record]:
        """As the robot's end would send them."""
        self.robot.stop = stop
        return [self.record(m) for m in self.robot.frames(seq, seq * 10 * MS, x)]

    def record(self, m: can.Message) -> Record:
        return Record(0, key_of(m.arbitration_id, extended=m.is_extended_id), 0, bytes(m.data))

    def hear(self, *given: Record, after_ms: float = 0.1) -> list[Any]:
        """Frames that come one after the other; what they come to."""
        data = b""
        for record in given:
            self.now_ns += round(after_ms * MS)
            data += packed(record._replace(stamp_ns=self.now_ns))
        said = self.transport.decode(Frame(self.now_ns, "robot", data))
        self.messages += said
        return said

    def period(self, seq: int, **more: Any) -> list[Any]:
        """A period of a sound robot."""
        self.now_ns += 9_700_000
        return self.hear(*self.records(seq, **more))

    @property
    def counters(self) -> dict[str, int]:
        return self.transport.counters()


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    for seq in range(100, 105):
        made.period(seq)
    return made


def good(said: list[Any]) -> list[Observation]:
    return [m for m in said if isinstance(m, Observation) and not m.fault]


def faults(said: list[Any]) -> list[str]:
    return [m.fault for m in said if isinstance(m, Observation) and m.fault]


def test_periods_become_observations(bench: Bench) -> None:
    assert [o.seq for o in good(bench.messages)] == [100, 101, 102, 103, 104]
    assert [type(m) for m in bench.messages[:2]] == [LinkChanged, Observation]
    assert good(bench.messages)[-1].x == pytest.approx((1.0, 2.0, 0.5), abs=1e-6)


def test_every_single_bit_that_is_wrong_in_a_guarded_frame_is_noticed(bench: Bench) -> None:
    position, heading, clock = bench.records(105)
    for record in (heading, clock):
        for bit in range(64):
            wrong = (int.from_bytes(record.payload, "little") ^ 1 << bit).to_bytes(8, "little")
            others = [position, heading, clock]
            others[others.index(record)] = record._replace(payload=wrong)
            fresh = Bench()
            fresh.period(104)
            assert good(fresh.hear(*others)) == []
            assert fresh.counters["checksum"] == 1


@pytest.mark.parametrize("length", [0, 1, 7, 12, 64])
def test_frame_of_another_length_is_a_fault(bench: Bench, length: int) -> None:
    position, heading, clock = bench.records(105)
    said = bench.hear(position, heading, clock._replace(payload=(clock.payload * 8)[:length]))
    assert good(said) == []
    assert faults(said) == [f"Clock has {length} bytes, must have 8"]


def test_number_that_is_none_is_a_fault(bench: Bench) -> None:
    said = bench.period(105, x=(math.nan, 2.0, 0.5))
    assert good(said) == []
    assert faults(said) == ["Position.X says 'not available'"]
    assert bench.counters["incomplete"] == 1


def test_number_out_of_the_dbcs_range_is_a_fault(bench: Bench) -> None:
    said = bench.period(105, x=(1001.0, 2.0, 0.5))
    assert faults(said) == ["Position.X is 1001 m, must be in -1000 to 1000"]
    assert good(said) == []


def test_replayed_reordered_and_duplicated_frames_make_no_observation(bench: Bench) -> None:
    old = [bench.records(seq) for seq in range(100, 105)]
    for records in (*old, old[0], old[3], old[4]):
        assert good(bench.hear(*records)) == []
    assert bench.counters["repeated"] + bench.counters["old"] == 16
    assert [o.seq for o in good(bench.period(105))] == [105]
    assert [o.seq for o in good(bench.hear(*bench.records(106), *bench.records(106), *bench.records(107)))] == [106, 107]


def test_lost_frames_are_counted_and_make_no_old_mixture(bench: Bench) -> None:
    position, heading, clock = bench.records(105, (9.0, 9.0, 0.1))
    bench.now_ns += 200 * MS  # longer than message_timeout
    assert good(bench.hear(position, clock)) == [], "the heading is of long ago"
    assert bench.counters["incomplete"] == 1
    said = bench.hear(heading, *bench.records(109, (9.5, 9.0, 0.2)))
    assert [o.x[0] for o in good(said)] == pytest.approx([9.5])
    assert bench.counters["lost"] == 3 + 3, "of Heading and of Clock"


def test_counter_that_jumps_is_not_believed_until_it_goes_on(bench: Bench) -> None:
    for seq in (40_000, 30_000):
        said = bench.period(seq)
        assert good(said) == []
        assert "the counter of Clock jumped" in faults(said)
    assert [o.seq for o in good(bench.period(105))] == [105]


def test_robot_that_starts_anew_goes_on_above_its_numbers_with_the_link_down_and_up_between(bench: Bench) -> None:
    last = good(bench.messages)[-1]
    said = [m for seq in range(5) for m in bench.period(seq)]
    observations = good(said)
    assert len(observations) == 3
    assert observations[0].seq > last.seq
    assert observations[0].stamp_ns >= last.stamp_ns + 10**9
    where = said.index(observations[0])
    assert [m.up for m in said[where - 2 : where]] == [False, True]


def test_robot_that_starts_anew_while_a_message_is_missing_is_told_with_the_next_observation(bench: Bench) -> None:
    said = []
    for seq in range(6):
        position, heading, clock = bench.records(seq)
        bench.now_ns += 9_700_000 + (250 * MS if seq == 0 else 0)  # the last heading is too old by then
        said += bench.hear(position, clock) if seq < 4 else bench.hear(position, heading, clock)
    first = next(m for m in said if isinstance(m, LinkChanged))
    assert (first.up, first.detail) == (False, "the robot started anew")
    assert said.index(good(said)[0]) > said.index(first)


def test_state_that_was_never_said_is_not_zero_however_long_it_would_be_good() -> None:
    bench = Bench(timeouts={"Position": math.inf})
    for seq in range(100, 105):
        _, heading, clock = bench.records(seq)
        bench.now_ns += 9_700_000
        assert good(bench.hear(heading, clock)) == []
    assert bench.counters["incomplete"] == 5
    assert len(good(bench.period(105))) == 1


def test_foreign_frames_are_counted_and_mean_nothing(bench: Bench) -> None:
    draw = random.Random(1)
    for _ in range(200):
        key = draw.choice((draw.randrange(0x300, 0x7FF), draw.randrange(1 << 29) | EXTENDED, 272 | EXTENDED))
        assert bench.hear(Record(0, key, 0, draw.randbytes(draw.randrange(9)))) == []
    assert bench.counters["foreign"] == 200


def test_storm_of_bad_frames_is_cut_to_a_trickle(bench: Bench) -> None:
    clock = bench.records(105)[2]
    said = [m for _ in range(1000) for m in bench.hear(clock._replace(payload=b"\xff" * 8))]
    assert 1 <= len(said) <= 64
    assert bench.counters["checksum"] == 1000


def test_bus_off_is_a_lost_link_until_an_observation_comes(bench: Bench) -> None:
    assert [(m.up, m.detail) for m in bench.hear(Record(0, 0x40 | ERROR, 0, bytes(8)))] == [
        (False, "bus-off: the CAN controller left the bus")
    ]
    assert bench.hear(Record(0, 0x40 | ERROR, 0, bytes(8))) == []
    assert bench.hear(Record(0, 0x04 | ERROR, 0, bytes(8))) == []
    said = bench.period(105)
    assert [m.up for m in said if isinstance(m, LinkChanged)] == [True]
    assert len(good(said)) == 1
    assert (bench.counters["error_frames"], bench.counters["bus_off"]) == (3, 1)


def test_pressed_button_is_told_at_once_and_again_while_it_is_held(bench: Bench) -> None:
    said = [m for seq in range(105, 405) for m in bench.period(seq, stop=1)]
    told = [m for m in said if isinstance(m, OverrideChanged)]
    assert [m.kind for m in told] == ["emergency_stop"] * 3, "at once, after one second, after two"
    assert told[0].detail == "Clock says so"
    assert isinstance(said[0], OverrideChanged)
    bench.period(405)
    assert [m for m in bench.period(406, stop=1) if isinstance(m, OverrideChanged)] != []


def test_command_of_another_node_on_the_robots_bus_is_a_manual_override(bench: Bench) -> None:
    frame = bench.transport.encode(Command(1, 0, "sampler", (0.5, 0.0), 104, 10**8))
    (told,) = bench.hear(Record(0, 528, 0, frame.data[14:22]))
    assert (told.kind, told.detail) == ("manual_override", "another node sends Drive on the robot's bus")
    assert bench.hear(Record(0, 528, 0, b"")) == [], "once a second is enough"
    assert bench.counters["strangers"] == 2


def test_bytes_that_are_no_frames_are_one_fault(bench: Bench) -> None:
    for data in (b"\0", b"\xff" * 13, b"[" * 60_000, packed(bench.records(105)[0])[:-1]):
        said = bench.transport.decode(Frame(bench.now_ns, "robot", data))
        assert len(faults(said)) == 1
        assert good(said) == []
    assert [o.seq for o in good(bench.period(105))] == [105]


def test_time_that_runs_back_is_a_fault(bench: Bench) -> None:
    bench.now_ns -= 10**8
    said = bench.hear(*bench.records(105))
    assert good(said) == []
    assert set(faults(said)) == {"a CAN frame came before the one before it"}


def test_pose_is_dead_reckoned_along_arcs() -> None:
    dbc = CLASSIC.replace('SG_ X : 0|32@1- (1E-006,0) [-1000|1000] "m"', 'SG_ X : 0|32@1- (1E-006,0) [-1000|1000] "rad/s"').replace(
        'SG_ Y : 32|32@1- (1E-006,0) [-1000|1000] "m"', 'SG_ Y : 32|32@1- (1E-006,0) [-1000|1000] "rad/s"'
    )
    bench = Bench(
        dbc={"file": "wheels.dbc", "text": dbc},
        states={},
        counters={},
        checksums={},
        overrides={},
        stamp="",
        dead_reckoning={"left": "Position.X", "right": "Position.Y", "wheel_radius": 0.1, "track": 0.4, "start": [1.0, 0.0, 0.0]},
    )
    radius, rate = 0.5, 0.1 * (8.0 - 3.428571) / 0.4
    for _ in range(201):
        bench.now_ns += 9_900_000
        bench.hear(Record(0, 272, 0, round(3.428571e6).to_bytes(4, "little") + round(8e6).to_bytes(4, "little")))
    turned = rate * 2.0
    x, y, theta = good(bench.messages)[-1].x
    assert theta == pytest.approx(math.remainder(turned, 2 * math.pi), abs=1e-6)
    assert (x, y) == pytest.approx((1.0 + radius * math.sin(turned), radius * (1.0 - math.cos(turned))), abs=1e-4)
    before = good(bench.messages)[-1].x
    bench.now_ns += 2 * 10**9
    bench.hear(Record(0, 272, 0, bytes(8)))
    assert good(bench.messages)[-1].x == before, "what happened in a silence is not made up"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"states": {"x": "Position.X", "y": "Position.Y"}}, "states lacks theta: which signal is it? (a pose can be dead reckoned"),
        ({"states": {"x": "Position.Xx", "y": "Position.Y", "theta": "Heading.Theta"}}, "has no signal 'Xx'; nearest: X"),
        ({"states": {"x": "Positoin.X", "y": "Position.Y", "theta": "Heading.Theta"}}, "has no signal 'Positoin.X'; nearest: Position.X"),
        ({"states": {"x": "pose", "y": "Position.Y", "theta": "Heading.Theta"}}, "rig.dbc has no signal 'pose'"),
        ({"states": {"x": 7, "y": "Position.Y", "theta": "Heading.Theta"}}, "transport.states.x is 7, must be a signal, as Message.Signal"),
        ({"states": {**STATE_SIGNALS, "z": "Heading.Theta"}}, "states.z: the model has no such name"),
        ({"inputs": {"v": "Drive.V"}}, "transport.inputs lacks w"),
        ({"trigger": "Clok"}, "rig.dbc has no message 'Clok'; nearest: Clock"),
        ({"stamp": "Heading.Theta"}, "transport.stamp: Heading.Theta has the unit 'rad', must be one of: s"),
        ({"trigger": "Heading"}, "the robot's clock must be in the trigger's message, Heading, not in Clock"),
        ({"counters": {"Clock": "Counter"}}, "message Clock of rig.dbc has no signal 'Counter'; nearest: ClockCounter"),
        ({"counters": {"Clock": {"signal": "ClockCounter", "modulus": 99_999}}}, "modulus is 99999, must be in 2 to 65536"),
        ({"checksums": {"Clock": {"signal": "ClockChecksum", "scheme": "crc8_j1851"}}}, "did you mean 'crc8_j1850'?"),
        ({"checksums": {"Clock": {"signal": "ClockChecksum", "data_id": 1 << 20}}}, "data_id is 1048576, must be at most 65535"),
        ({"overrides": {"red_button": "Clock.Stop"}}, "red_button is not a kind of override; there are: emergency_stop, manual_override"),
        ({"constants": {"Clock.Stop": 1}}, "Clock holds no input; constants belong to commands (Drive)"),
        ({"constants": {"Drive.Enable": 7}}, "Drive.Enable: raw value 7 is outside 0 to 1"),
        ({"timeouts": {"Clock": 0}}, "transport.timeouts.Clock is 0, must be > 0 s"),
        ({"observation_timeout": -1}, "transport.observation_timeout is -1, must be > 0 s"),
        ({"command_cycle": 5}, "transport.command_cycle is 5, must be 0 or in 0.001 to 1 s"),
        ({"forward": "some"}, "transport.forward is 'some', must be one of: all, named, none"),
        ({"queue": 1}, "transport.queue is 1, must be a whole number >= 2"),
        ({"dbc": ""}, "transport.dbc is missing"),
        ({"dbc": "/no/such.dbc"}, "/no/such.dbc: cannot be read: No such file"),
        ({"dbc": {"file": "a.dbc", "text": "BO_ nonsense"}}, "a.dbc: has no messages"),
        ({"dbc": {"file": "a.dbc", "text": 'VERSION ""\n'}}, "a.dbc: has no messages"),
        ({"robot": {"channel": "can0"}}, "transport.robot.interface is missing"),
        ({"robot": {}}, "transport.robot is missing"),
        ({"robot": "can0"}, "transport.robot is 'can0', must be a table"),
        ({"controller": {"interface": "virtual", "channel": "none"}}, "robot and controller share virtual 'none'"),
        ({"robot": {"interface": "virtual", "receive_own_messages": True}}, "receive_own_messages must not be set"),
        ({"robott": {}}, "transport.robott is not an option of the can transport; did you mean 'robot'?"),
        ({"dead_reckoning": {"left": "Position.X"}, "states": {}}, "needs left and right (and track), or speed with yaw_rate or heading"),
    ],
)  # fmt: skip
def test_bad_option_is_one_clear_line(change: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError) as raised:
        Bench(**change)
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)


def test_two_multicast_groups_on_one_port_are_refused_because_both_would_hear_both() -> None:
    sides = {side: {"interface": "udp_multicast", "channel": f"239.74.163.{n}"} for side, n in (("robot", 1), ("controller", 2))}
    with pytest.raises(ConfigError, match="share a port of udp_multicast"):
        checked({"dbc": "x", **sides})


# ---------------------------------------------------------------- two nodes with one identifier, echoes, order


def twins(said: list[Any]) -> list[str]:
    return [m.detail for m in said if isinstance(m, OverrideChanged) and m.kind == "robot_twin"]


def refusals(said: list[Any]) -> list[str]:
    return [m.detail for m in said if isinstance(m, ObservationRefused)]


@pytest.mark.parametrize("ahead", [0, 1, 3, 9, 200, 30_000])
def test_two_robots_on_one_bus_are_noticed_within_a_few_periods(ahead: int) -> None:
    bench = Bench()
    for k in range(100):
        bench.period(k)
    first = 0
    for k in range(100, 160):
        bench.period(k, x=(1.0 + 0.001 * k, 2.0, 0.5))
        bench.hear(*bench.records(k + ahead, (9.0, 9.0, 0.1)), after_ms=0.1)
        first = first or (k if twins(bench.messages) else 0)
    assert 0 < first <= 115
    assert "its counter goes on in two tracks" in twins(bench.messages)[0]


def test_twin_that_lasts_is_said_about_once_a_second() -> None:
    bench = Bench()
    for k in range(500):  # five seconds
        bench.period(k)
        bench.hear(*bench.records(k + 7, (9.0, 9.0, 0.1)))
    assert 4 <= len(twins(bench.messages)) <= 2 * 6, "by each of two messages"


@pytest.mark.parametrize("silent_ms", [0.0, 2000.0])
def test_robot_that_starts_anew_is_no_twin(silent_ms: float) -> None:
    bench = Bench()
    for k in range(300, 400):
        bench.period(k)
    bench.now_ns += round(silent_ms * MS)
    for k in range(100):
        bench.period(k)
    assert not twins(bench.messages)


@pytest.mark.parametrize("behind", [1, 3, 7])
def test_echoes_are_refused_once_an_observation_and_no_twin(behind: int) -> None:
    bench = Bench()
    sent: list[list[Record]] = []
    for k in range(200):
        sent.append(bench.records(k, (1.0 + 0.001 * k, 2.0, 0.5)))
        bench.now_ns += 9_000_000
        bench.hear(*sent[k])
        if k >= behind:
            bench.hear(*sent[k - behind])
    assert not twins(bench.messages)
    assert len(refusals(bench.messages)) == 200 - behind
    assert all(text.startswith("Heading") and text.endswith("an echo") for text in refusals(bench.messages))


def test_frame_that_comes_late_is_refused_and_no_twin() -> None:
    bench = Bench()
    for k in range(40):
        bench.period(k + (1, -1)[k % 2])
    assert not twins(bench.messages)
    assert {text.partition(": ")[2] for text in refusals(bench.messages)} == {"it came late"}


CYCLES = {"cycles": {"Position": 0.01}, "counters": {}}


def test_identifier_that_comes_twice_in_its_cycle_has_two_senders() -> None:
    bench = Bench(**CYCLES)
    for k in range(600):
        bench.period(k)
    assert not twins(bench.messages)
    begun_ns = bench.now_ns
    while not twins(bench.messages):
        k += 1
        bench.period(k)
        bench.hear(*bench.records(k, (9.0, 9.0, 0.1))[:1])
    assert bench.now_ns - begun_ns < 2_500 * MS
    assert "two nodes send Position: it comes every 6" in twins(bench.messages)[0]


def test_busy_machine_that_hands_frames_over_in_bursts_is_no_twin() -> None:
    bench = Bench(**CYCLES)
    for second in range(20):
        for k in range(100):
            if k == 0:
                bench.now_ns += 250 * MS  # nothing was taken in for a quarter of a second, and then all of it
            bench.hear(*bench.records(100 * second + k), after_ms=0.01 if k < 25 else 3.33)
    assert not twins(bench.messages)


def test_cycle_is_of_a_message_that_is_there() -> None:
    with pytest.raises(ConfigError, match=r"transport\.cycles\.Positron"):
        Bench(cycles={"Positron": 0.01})
