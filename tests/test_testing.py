"""The kits pass what keeps the contract and fail what doesn't. The transport here is also the smallest example of one."""

from __future__ import annotations

import contextlib
import inspect
import json
import math
import os
import socket
import tempfile
import time
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import pytest

from s2r_runtime.effects.step_effect import ForceEffect
from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import Parameter
from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged
from s2r_runtime.models.forces import Axis, Push
from s2r_runtime.testing import EffectKit, TransportKit, transport_kit
from s2r_runtime.twins import Numbered


class Loop:
    """A transport over Unix datagrams: JSON lists, one a datagram."""

    OPTIONS: ClassVar[dict[str, str]] = {
        "folder": "where the sockets are",
        "timeout": "s until the link is lost",
        "queue": "frames at most",
    }

    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        for name in options:
            if name not in self.OPTIONS:
                raise ConfigError(f"transport.{name} is not an option; there are: {', '.join(self.OPTIONS)}")
        self.options, self.states, self.inputs = options, states, inputs
        self.socket: socket.socket | None = None
        self.numbers = dict.fromkeys(("received", "sent", "dropped_in", "dropped_out", "malformed", "lost"), 0)
        self.last, self.heard_ns, self.up = (-1, -1), 0, None
        self.others = Numbered()

    def open(self) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        path = Path(self.options["folder"], "runtime")
        path.unlink(missing_ok=True)
        self.socket.bind(str(path))
        self.heard_ns = time.monotonic_ns()

    def fileno(self) -> int:
        assert self.socket is not None
        return self.socket.fileno()

    def receive(self) -> list[Frame]:
        frames: list[Frame] = []
        with contextlib.suppress(BlockingIOError):
            while self.socket is not None:
                frames.append(Frame(time.monotonic_ns(), "loop", self.socket.recv(1 << 16)))
        self.numbers["received"] += len(frames)
        if frames:
            self.heard_ns = frames[-1].arrival_ns
        dropped = max(0, len(frames) - self.options["queue"])
        self.numbers["dropped_in"] += dropped
        return frames[dropped:]

    def decode(self, frame: Frame) -> list[Any]:
        try:
            seq, stamp_ns, x = json.loads(frame.data)
            x = tuple(float(value) for value in x)
            good = type(seq) is int and type(stamp_ns) is int and len(x) == len(self.states) and all(map(math.isfinite, x))
        except (ValueError, TypeError, RecursionError):
            good = False
        if not good:
            self.numbers["malformed"] += 1
            return [Observation(*self.last, (), fault="malformed")]
        if seq <= self.last[0] or stamp_ns <= self.last[1]:
            return self.others.dropped(seq, stamp_ns, x, frame.arrival_ns)
        self.numbers["lost"] += seq - self.last[0] - 1 if self.last[0] >= 0 else 0
        self.last = (seq, stamp_ns)
        return [*self.others.taken(seq, stamp_ns, x, frame.arrival_ns), Observation(seq, stamp_ns, x)]

    def poll(self, now_ns: int) -> list[LinkChanged]:
        up = self.last[0] >= 0 and now_ns - self.heard_ns <= self.options["timeout"] * 1e9
        if up == self.up or (self.up is None and now_ns - self.heard_ns <= self.options["timeout"] * 1e9 and not up):
            return []
        self.up = up
        return [LinkChanged(now_ns, up)]

    def encode(self, command: Command) -> Frame:
        if len(command.u) != len(self.inputs) or not all(map(math.isfinite, command.u)):
            raise ValueError(f"{command.u} must be {len(self.inputs)} finite inputs")
        data = json.dumps([command.seq, command.t_ns, command.obs_seq, command.ttl_ns, command.u]).encode()
        return Frame(command.t_ns, "loop", data, inbound=False)

    def send(self, frame: Frame) -> None:
        try:
            assert self.socket is not None
            self.socket.sendto(frame.data, str(Path(self.options["folder"], "robot")))
            self.numbers["sent"] += 1
        except OSError:
            self.numbers["dropped_out"] += 1

    def counters(self) -> dict[str, int]:
        return dict(self.numbers)

    def close(self) -> None:
        if self.socket is not None:
            self.socket.close()
            self.socket = None


class LoopRig:
    """The transport and a robot's end, in a folder of their own."""

    states, inputs = ("x", "y"), ("v",)
    kind: ClassVar[type[Loop]] = Loop

    def __enter__(self) -> Self:
        self._folder = tempfile.TemporaryDirectory()
        self.options: dict[str, Any] = {"folder": self._folder.name, "timeout": 0.15, "queue": 8}
        self.transport = self.kind(self.options, self.states, self.inputs)
        self.robot = self
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._socket.bind(f"{self._folder.name}/robot")
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.close()
        self._socket.close()
        self._folder.cleanup()

    def twin(self) -> Self:
        return self

    def publish(self, seq: int, stamp_ns: int, x: tuple[float, ...]) -> None:
        self.publish_raw(json.dumps([seq, stamp_ns, x]).encode())

    def publish_raw(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody listens, or not fast enough
            self._socket.sendto(data, f"{self._folder.name}/runtime")

    def received(self) -> list[Command]:
        commands = []
        with contextlib.suppress(BlockingIOError):
            while True:
                seq, t_ns, obs_seq, ttl_ns, u = json.loads(self._socket.recv(1 << 16))
                commands.append(Command(seq, t_ns, "sampler", tuple(u), obs_seq, ttl_ns))
        return commands


class TestLoop(TransportKit):
    rig = LoopRig


# ---------------------------------------------------------------- what the transport kit finds


class ForgetsTtl(Loop):
    def encode(self, command: Command) -> Frame:
        frame = super().encode(command)
        return Frame(frame.arrival_ns, frame.channel, frame.data.replace(str(command.ttl_ns).encode(), b"7"), inbound=False)


class SwapsNothingButRounds(Loop):
    def decode(self, frame: Frame) -> list[Any]:
        return [Observation(m.seq, m.stamp_ns, tuple(round(v, 3) for v in m.x), m.fault) for m in super().decode(frame)]


class DropsSilently(Loop):
    def decode(self, frame: Frame) -> list[Any]:
        return [m for m in super().decode(frame) if not isinstance(m, ObservationRefused)]


class SeesNoTwin(Loop):
    def decode(self, frame: Frame) -> list[Any]:
        return [m for m in super().decode(frame) if not isinstance(m, OverrideChanged)]


class LetsNanOut(Loop):
    def encode(self, command: Command) -> Frame:
        return Frame(command.t_ns, "loop", json.dumps([1, 2, 3, 4, command.u]).encode(), inbound=False)


class Raises(Loop):
    def decode(self, frame: Frame) -> list[Any]:
        json.loads(frame.data)
        return super().decode(frame)


class BelievesNan(Loop):
    def decode(self, frame: Frame) -> list[Any]:
        seq, stamp_ns, x = json.loads(frame.data)
        return [Observation(seq, stamp_ns, tuple(x))]


class GoesBack(Loop):
    def decode(self, frame: Frame) -> list[Any]:
        self.last = (-1, -1)
        return super().decode(frame)


class NeverLost(Loop):
    def poll(self, now_ns: int) -> list[LinkChanged]:
        return []


class AlwaysReports(Loop):
    def poll(self, now_ns: int) -> list[LinkChanged]:
        return [LinkChanged(now_ns, up=now_ns - self.heard_ns < 1.5e8)]


class Hoards(Loop):
    def receive(self) -> list[Frame]:
        self.options = {**self.options, "queue": 10**9}
        return super().receive()


class ClosesOnce(Loop):
    def close(self) -> None:
        assert self.socket is not None
        super().close()


LEAKED: list[int] = []


class Leaks(Loop):
    def close(self) -> None:
        if self.socket is not None:
            LEAKED.append(os.dup(self.socket.fileno()))
        super().close()


class OpensEarly(Loop):
    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        super().__init__(options, states, inputs)
        LEAKED.extend(os.pipe())


class Stateful(Loop):
    def decode(self, frame: Frame) -> list[Any]:
        return [] if self.socket is None else super().decode(frame)


class Counts(Loop):
    def counters(self) -> dict[str, int]:
        return {"received": 1}


class TakesAnything(Loop):
    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        super().__init__({k: v for k, v in options.items() if k in self.OPTIONS}, states, inputs)


class Foretells(Loop):
    def receive(self) -> list[Frame]:
        return [Frame(frame.arrival_ns + 10**12, frame.channel, frame.data) for frame in super().receive()]


class Dawdles(Loop):
    def poll(self, now_ns: int) -> list[LinkChanged]:
        time.sleep(0.02)
        return super().poll(now_ns)


BROKEN = {
    Foretells: "test_what_it_gives_is_what_the_daemon_takes",
    Dawdles: "test_no_call_waits",
    ForgetsTtl: "test_command_carries_its_time_to_live",
    SwapsNothingButRounds: "test_every_field_of_an_observation_arrives",
    DropsSilently: "test_echoes_are_refused_and_no_second_robot",
    SeesNoTwin: "test_two_robots_under_one_name_are_told",
    LetsNanOut: "test_command_that_is_not_finite_is_refused",
    Raises: "test_garbage_becomes_a_fault_or_nothing_and_never_an_exception",
    BelievesNan: "test_numbers_that_are_not_finite_never_come_through",
    GoesBack: "test_stamps_only_rise_whatever_order_observations_come_in",
    NeverLost: "test_lost_robot_is_reported_and_its_return_too",
    AlwaysReports: "test_lost_robot_is_reported_and_its_return_too",
    Hoards: "test_queue_is_bounded_and_what_it_drops_is_counted",
    ClosesOnce: "test_close_twice_and_close_unopened",
    Leaks: "test_close_frees_its_descriptors",
    OpensEarly: "test_construction_opens_nothing",
    Stateful: "test_decoding_depends_on_frames_only",
    Counts: "test_counters_are_there",
    TakesAnything: "test_unknown_option_is_refused",
}


@pytest.mark.parametrize(("broken", "test"), BROKEN.items(), ids=[b.__name__ for b in BROKEN])
def test_transport_kit_fails_a_transport_that_breaks_the_contract(broken: type[Loop], test: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport_kit, "PATIENCE_S", 1.0)
    with LoopRig() as rig:
        rig.transport = broken(rig.options, rig.states, rig.inputs)
        with pytest.raises((AssertionError, pytest.fail.Exception, ValueError, TypeError)):
            run(test, rig)
        rig.transport = Loop(rig.options, rig.states, rig.inputs)
    while LEAKED:
        os.close(LEAKED.pop())


def run(test: str, rig: LoopRig) -> None:
    """One test of the kit, with the fixtures that it asks for."""
    function = getattr(TransportKit(), test)
    wanted = inspect.signature(function).parameters
    given: dict[str, Any] = {"bench": rig, "value": math.nan}
    try:
        if "line" in wanted:
            rig.transport.open()
            given["line"] = transport_kit.Line(rig)
            given["line"].link((0.0, 0.0))
        function(**{name: given[name] for name in wanted})
    finally:
        with contextlib.suppress(AssertionError):
            rig.transport.close()


# ---------------------------------------------------------------- effects


class WornOut:
    """An input acts the less, the larger it has ever been: something wears out."""

    name, stage = "worn_out", "input"
    parameters = (Parameter("share", "-", 0.0, 1.0, neutral=0.0),)

    def channels(self, model: Any) -> tuple[str, ...]:
        return tuple(model.inputs)

    def unit(self, model: Any, channel: str, parameter: str) -> str:
        return "-"

    def hidden(self, n: int, model: Any, channel: str, dt: float, p: dict[str, Any]) -> Any:
        return np.zeros((n, 1))

    def input_step(self, u: Any, z: Any, model: Any, channel: str, dt: float, p: dict[str, Any]) -> Any:
        column, acting = model.inputs.index(channel), u.copy()
        largest = np.maximum(z, np.abs(u[:, [column]]))
        acting[:, column] *= 1.0 - p["share"] * largest[:, 0]
        return acting, largest

    def input_sequence(self, u: Any, model: Any, channel: str, dt: float, p: dict[str, Any]) -> Any:
        column, acting = model.inputs.index(channel), u.copy()
        acting[:, column] *= 1.0 - p["share"] * np.maximum.accumulate(np.abs(u[:, column]))
        return acting

    def after_step(self, x: Any, u: Any, x_next: Any, model: Any, channel: str, dt: float, p: dict[str, Any]) -> Any:
        return x_next


class TestWornOut(EffectKit):
    effect, parameters = WornOut(), {"share": 0.3}


class StartsElsewhere(WornOut):
    def input_sequence(self, u: Any, model: Any, channel: str, dt: float, p: dict[str, Any]) -> Any:
        later = super().input_sequence(u, model, channel, dt, p)
        later[0] = u[0]
        return later


class Scribbles(WornOut):
    def input_step(self, u: Any, z: Any, model: Any, channel: str, dt: float, p: dict[str, Any]) -> Any:
        u *= 1.0 - p["share"]
        return u, z


class MixesRows(WornOut):
    def input_step(self, u: Any, z: Any, model: Any, channel: str, dt: float, p: dict[str, Any]) -> Any:
        return u - p["share"] * u.mean(axis=0), z


class NotNeutral(WornOut):
    parameters = (Parameter("share", "-", 0.0, 1.0, neutral=0.5),)


@pytest.mark.parametrize(
    ("broken", "test"),
    [
        (StartsElsewhere, "test_over_time_at_once_is_the_same_as_step_by_step"),
        (Scribbles, "test_arguments_are_not_changed"),
        (MixesRows, "test_rows_do_not_mix_and_shapes_stay"),
        (NotNeutral, "test_neutral_parameters_are_no_effect"),
    ],
)
def test_effect_kit_fails_an_effect_that_breaks_the_contract(broken: type[WornOut], test: str) -> None:
    from s2r_runtime.plugins import registry

    kit = EffectKit()
    kit.effect, kit.parameters = broken(), {"share": 0.3}  # type: ignore[misc]
    model = registry().get("models", "unicycle")
    with pytest.raises(AssertionError):
        getattr(kit, test)([(model, "v")])


class PushesOneAxis(ForceEffect):
    """Has a channel for either axis, and acts on the first whichever is asked for."""

    name = "pushes_one_axis"
    parameters = (Parameter("force", "N", 0.0, 10.0, neutral=0.0),)

    def push(self, x: Any, axis: Axis, model: Any, channel: str, p: dict[str, Any]) -> Push | None:
        return Push(drive=p["force"]) if channel == model.states[axis.velocity] == "vx" else None


def test_effect_kit_fails_a_force_that_no_axis_feels() -> None:
    from s2r_runtime.plugins import registry

    kit = EffectKit()
    kit.effect, kit.parameters = PushesOneAxis(), {"force": 0.3}  # type: ignore[misc]
    model = registry().get("models", "double_integrator")
    kit.test_it_does_something_on_each_of_its_channels([(model, "vx")])
    with pytest.raises(AssertionError, match="it does nothing on vy of double_integrator"):
        kit.test_it_does_something_on_each_of_its_channels([(model, "vx"), (model, "vy")])
