"""What the payloads mean: JSON objects, one a sample (docs/zenoh.md). Depends on the bytes and what came before, not on Zenoh.

    robot -> runtime     observation  {"seq": 12, "stamp_ns": 396000000, "state": {"x": 0.1, "y": 0.2, "theta": 0.3}, "boot": 7}
                         override     {"kind": "emergency_stop" | "manual_override", "detail": "..."}
    runtime -> robot     command      {"seq", "t_ns", "obs_seq", "ttl_ns", "source", "input": {"v": 0.1, "w": 0.0}}
    runtime -> everybody log_head     {"type", "run", "part", "records", "head", "public_key"}: how far the log is on the disk
    anybody -> runtime   proposal     {"input": {"v": 0.1, "w": 0.0}, "seq": 0, "obs_seq": 0}; logged, never obeyed

Order. A robot's `seq` and `stamp_ns` rise within one boot. The same bytes again are a keep-alive and mean nothing new; an older
`seq` is dropped and counted. An observation without a usable state (NaN, a state that is missing) keeps its place, so that a robot in
lockstep that fell is answered. A robot that started anew says so by another `boot`, or by having been silent for `restart_ns`: its
numbers then go on above the old ones (`stamp_ns` by one second at least), so that nobody downstream ever sees a clock run
backwards, and a link down and up is reported between the two. The first observation of all reports the link up, before itself.

Two robots (`s2r_runtime.twins`). A `boot` number goes on that another one had replaced; or, under one boot number, `seq` goes on in two
tracks, has two contents, or does not rise together with `stamp_ns`, and the robot that is followed goes on as well.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Literal, TypeVar

import msgspec

from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged
from s2r_runtime.twins import Pair, Track

T = TypeVar("T")
Decoded = Observation | ObservationRefused | Command | LinkChanged | OverrideChanged

PAYLOAD_MAX = 65_536
"""Bytes. Longer payloads are malformed; nothing that this software needs comes near."""
NESTING_MAX = 100
"""Objects and lists in a payload. How deep a decoder gets depends on its caller's stack; an audit must get as deep as we did."""
NUMBER_MAX = 1e9
"""Largest magnitude of a state or input: any unit's sane values lie below, and sums of squares of them stay finite."""
COUNT_MAX = 2**53
"""Largest seq and obs_seq: what every JSON library holds exactly."""
STAMP_MAX = 2**62
RESTART_GAP_NS = 1_000_000_000
BOOTS_KEPT = 8
"""Of boot numbers that were replaced."""


class ObservationPayload(msgspec.Struct):
    """As on the wire; keys beyond these are ignored. `boot`: any number that differs from one start of the robot to the next."""

    seq: int
    stamp_ns: int
    state: dict[str, float]
    boot: int = 0


class CommandPayload(msgspec.Struct):
    """As on the wire. obs_seq: the observation that it answers, in the robot's own count."""

    seq: int
    t_ns: int
    obs_seq: int
    ttl_ns: int
    source: str
    input: dict[str, float]


class ProposalPayload(msgspec.Struct):
    """As on the wire."""

    input: dict[str, float]
    seq: int = 0
    obs_seq: int = 0


class OverridePayload(msgspec.Struct):
    """As on the wire."""

    kind: Literal["emergency_stop", "manual_override"]
    detail: str = ""


class Malformed(ValueError):
    """A payload that isn't what the wire format says; the message says why, in a few words of this module's own."""


class Wire:
    """Decodes and encodes for one robot. states, inputs: the model's names in order. `malformed`, `old`, `lost`: counts.

    `too_old`: the last payload that was dropped as behind a newer one. Who repeats it may be a robot that started anew.
    restart_ns: a robot without `boot` that was silent for so long may begin its count anew.
    """

    def __init__(self, states: tuple[str, ...], inputs: tuple[str, ...], restart_ns: int) -> None:
        self._states, self._inputs, self._restart_ns = states, inputs, restart_ns
        self._observation = msgspec.json.Decoder(ObservationPayload)
        self._proposal = msgspec.json.Decoder(ProposalPayload)
        self._override = msgspec.json.Decoder(OverridePayload)
        self._encoder = msgspec.json.Encoder()
        self.malformed = self.old = self.lost = 0
        self.too_old = b""
        self._last: ObservationPayload | None = None
        self._arrival_ns = 0
        self._seq_offset = self._stamp_offset = 0
        self._track, self._boots = Track(), dict[int, ObservationPayload]()
        self._counts, self._named = Pair(signs=2), Pair()

    @property
    def newest(self) -> int:
        """`seq` of the newest good observation, as its receivers see it; -1 before the first."""
        return self._last.seq + self._seq_offset if self._last else -1

    def decode(self, frame: Frame) -> list[Decoded]:
        """What an inbound frame means; see `hookspecs.Transport.decode`."""
        if frame.channel == "observation":
            return self._decode_observation(frame)
        if frame.channel == "proposal":
            return [self._decode_proposal(frame)]
        if frame.channel == "override":
            return self._decode_override(frame)
        return []

    def encode(self, command: Command) -> bytes:
        """Payload of a command. Raises ValueError if it is not finite or not of shape (nu,)."""
        if len(command.u) != len(self._inputs):
            raise ValueError(f"command has {len(command.u)} inputs, must have {len(self._inputs)}: {', '.join(self._inputs)}")
        if not all(map(math.isfinite, command.u)):
            raise ValueError(f"command is {command.u}, must be finite")
        named = dict(zip(self._inputs, command.u, strict=True))
        obs_seq = command.obs_seq - self._seq_offset
        return self._encoder.encode(CommandPayload(command.seq, command.t_ns, obs_seq, command.ttl_ns, command.source, named))

    # ------------------------------------------------------------------ observations

    def _decode_observation(self, frame: Frame) -> list[Decoded]:
        last = self._last
        try:
            payload: ObservationPayload = _parsed(self._observation, frame.data)
            _within(payload.seq, COUNT_MAX, "seq")
            _within(payload.stamp_ns, STAMP_MAX, "stamp_ns")
            x = _ordered(payload.state, self._states, "state")
            if last is None:
                self._accept(payload, frame)
                return [LinkChanged(frame.arrival_ns, up=True), Observation(payload.seq, payload.stamp_ns, x)]
            if payload.boot != last.boot or (payload.seq <= last.seq and frame.arrival_ns - self._arrival_ns >= self._restart_ns):
                twin = self._replaced(last, payload, frame.arrival_ns)
                return [*twin, *self._restart(payload, frame), self._numbered(payload, x)]
            if payload.seq == last.seq and payload == last:
                self._arrival_ns = frame.arrival_ns
                return []
            if payload.seq < last.seq:
                self.old, self.too_old = self.old + 1, frame.data
                return [self._behind(payload, frame.arrival_ns)]
            if payload.seq == last.seq:
                self._counts.other()
                raise Malformed("seq was used before, for other content")
            if payload.stamp_ns <= last.stamp_ns:
                self._counts.other()
                raise Malformed("stamp_ns does not rise with seq")
        except Malformed as error:
            self.malformed += 1
            return [self._unusable(frame, f"malformed observation: {error}")]
        self.lost += payload.seq - last.seq - 1
        self._accept(payload, frame)
        two = self._counts.goes_on(frame.arrival_ns)
        told = [_twin(frame.arrival_ns, "observations go on in two tracks of seq and stamp_ns")] if two else []
        return [*told, self._numbered(payload, x)]

    def _replaced(self, last: ObservationPayload, payload: ObservationPayload, now_ns: int) -> list[Decoded]:
        """A robot that started anew; or one that never stopped, beside another."""
        self._boots.pop(last.boot, None)
        while len(self._boots) >= BOOTS_KEPT:
            del self._boots[next(iter(self._boots))]
        self._boots[last.boot] = last
        before = self._boots.get(payload.boot)
        if payload.boot == last.boot or before is None or payload.seq <= before.seq or payload.stamp_ns <= before.stamp_ns:
            return []
        self._named.other()
        went_on = f"the robot with boot {payload.boot} goes on at seq {payload.seq} after one with boot {last.boot} was heard"
        return [_twin(now_ns, went_on)] if self._named.goes_on(now_ns) else []

    def _behind(self, payload: ObservationPayload, now_ns: int) -> ObservationRefused:
        """A number below the newest."""
        kind = self._track.judge(payload.seq, tuple(payload.state.items()), payload.stamp_ns)
        if kind == "other":
            self._counts.other()
        why = {"echo": "an echo of", "late": "it came late:", "other": "not the robot's, or replayed:"}[kind]
        return ObservationRefused(now_ns, f"{why} observation {payload.seq}")

    def _unusable(self, frame: Frame, fault: str) -> Observation:
        """No state, and its own place in the count where that can be read and comes next; else the place of the one before."""
        last, place = self._last, _place(frame.data)
        if last is None:
            return Observation(0, 0, (), fault)
        if (
            place is not None
            and place.boot == last.boot
            and last.seq < place.seq <= COUNT_MAX
            and last.stamp_ns < place.stamp_ns <= STAMP_MAX
        ):
            self.lost += place.seq - last.seq - 1
            self._accept(place, frame)
            last = place
        return Observation(last.seq + self._seq_offset, last.stamp_ns + self._stamp_offset, (), fault)

    def _accept(self, payload: ObservationPayload, frame: Frame) -> None:
        self._last, self._arrival_ns, self.too_old = payload, frame.arrival_ns, b""
        self._track.accept(payload.seq, tuple(payload.state.items()), payload.stamp_ns)

    def _numbered(self, payload: ObservationPayload, x: tuple[float, ...]) -> Observation:
        return Observation(payload.seq + self._seq_offset, payload.stamp_ns + self._stamp_offset, x)

    def _restart(self, payload: ObservationPayload, frame: Frame) -> list[Decoded]:
        """The robot began to count anew, or repeats itself after a silence: go on above its old numbers, with a hole that nobody takes for
        one period.
        """
        assert self._last is not None  # noqa: S101 - a restart follows something
        why = "the robot was silent, and waits where it was" if payload == self._last else "the robot started anew"
        seq = self._last.seq + self._seq_offset + 2
        stamp = self._last.stamp_ns + self._stamp_offset + RESTART_GAP_NS
        self._seq_offset, self._stamp_offset = seq - payload.seq, stamp - payload.stamp_ns
        self._track.forget()
        self._counts.forget()
        self._accept(payload, frame)
        t_ns = frame.arrival_ns
        return [LinkChanged(t_ns, up=False, detail=why), LinkChanged(t_ns, up=True)]

    # ------------------------------------------------------------------ what others send

    def _decode_proposal(self, frame: Frame) -> Command:
        try:
            payload: ProposalPayload = _parsed(self._proposal, frame.data)
            _within(payload.seq, COUNT_MAX, "seq")
            _within(payload.obs_seq, COUNT_MAX, "obs_seq")
            u = _ordered(payload.input, self._inputs, "input")
        except Malformed as error:
            self.malformed += 1
            return Command(0, frame.arrival_ns, "external", (), 0, 0, fault=f"malformed proposal: {error}")
        return Command(payload.seq, frame.arrival_ns, "external", u, payload.obs_seq, 0)

    def _decode_override(self, frame: Frame) -> list[Decoded]:
        """Garbage on the channel that stops the robot stops the robot: that is the side to err on."""
        try:
            payload: OverridePayload = _parsed(self._override, frame.data)
        except Malformed as error:
            self.malformed += 1
            return [OverrideChanged(frame.arrival_ns, "emergency_stop", f"malformed override: {error}")]
        return [OverrideChanged(frame.arrival_ns, payload.kind, payload.detail[:200])]


def _twin(t_ns: int, why: str) -> OverrideChanged:
    return OverrideChanged(t_ns, "robot_twin", why)


def _parsed(decoder: msgspec.json.Decoder[T], data: bytes) -> T:
    if len(data) > PAYLOAD_MAX:
        raise Malformed(f"{len(data)} bytes, must be at most {PAYLOAD_MAX}")
    if data.count(b"[") + data.count(b"{") > NESTING_MAX:
        raise Malformed(f"more than {NESTING_MAX} objects and lists")
    try:
        return decoder.decode(data)
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise Malformed(str(error)[:120]) from None


def _place(data: bytes) -> ObservationPayload | None:
    """seq, stamp_ns and boot of a payload whose state is no state, NaN among it: a robot that fell waits for its answer like any other."""
    if len(data) > PAYLOAD_MAX or data.count(b"[") + data.count(b"{") > NESTING_MAX:
        return None
    try:
        found = json.loads(data)  # takes NaN, which no JSON has and some robots write
        return msgspec.convert({**found, "state": {}}, ObservationPayload)
    except (ValueError, TypeError, msgspec.MsgspecError):
        return None


def _within(value: int, most: int, name: str) -> None:
    if not 0 <= value <= most:
        raise Malformed(f"{name} must be in 0 to {most}")


def _ordered(values: dict[str, float], names: Sequence[str], what: str) -> tuple[float, ...]:
    """The named values in the model's order."""
    try:
        ordered = tuple(map(values.__getitem__, names))
    except KeyError as error:
        raise Malformed(f"{what} lacks {error.args[0]!r}") from None
    for name, value in zip(names, ordered, strict=True):
        if not -NUMBER_MAX <= value <= NUMBER_MAX:  # also false for NaN
            raise Malformed(f"{what}.{name} is beyond {NUMBER_MAX:g}")
    return ordered
