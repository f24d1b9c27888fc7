"""CAN frames -> observations. Depends on the records and what came before, not on a bus: an audit makes the same of the same bytes.

A frame counts if its length, its checksum and its counter are right and every number in it that is used is finite, in the DBC's range and
not marked invalid; else nothing of it does, and a faulty observation says why (at most 32 a second: a storm must not fill the log).

When the trigger comes and every other group that is needed is fresh, there is an observation: the newest values, stamped with the robot's
clock where it is on the bus, else with the trigger's arrival. Otherwise there is none, and it is counted as incomplete.
"""

from __future__ import annotations

from typing import Literal

from s2r_can.bits import selected
from s2r_can.layout import Group, Inbound, Layout
from s2r_can.odometry import Odometry
from s2r_can.records import BUS_OFF, ERROR, HEADER, PAYLOAD_MAX, REMOTE
from s2r_can.sequence import ACCEPTED, RobotClock, Sequence
from s2r_runtime.messages import Command, LinkChanged, Observation, OverrideChanged

Decoded = Observation | Command | LinkChanged | OverrideChanged
Override = Literal["emergency_stop", "manual_override"]

SECOND_NS = 1_000_000_000
FAULTS_PER_SECOND = 32
AGAIN_NS = SECOND_NS
"""An override that lasts is said again after so long: whoever clears it while the button is held finds it again."""
MAX_STEP_NS = SECOND_NS
"""A pose is not reckoned over longer silences."""
COUNTS = ("malformed", "checksum", "repeated", "old", "jumped", "incomplete", "lost", "foreign", "error_frames", "bus_off", "strangers")


class Observer:
    """One robot's bus. names: the model's states. silence_ns: without frames for so long, a sender may have started anew."""

    def __init__(self, layout: Layout, names: tuple[str, ...], odometry: Odometry | None, silence_ns: int) -> None:
        self._layout, self._names, self._odometry, self._silence_ns = layout, names, odometry, silence_ns
        self.counts = dict.fromkeys(COUNTS, 0)
        self.newest: tuple[int, int] = (-1, -1)
        """seq and stamp of the newest good observation; -1 before the first."""
        self.bus_off = False
        self._values = [0.0] * layout.values
        self.times: list[int | None] = [None] * len(layout.groups)
        """Arrival of what is good in each group, ns; None where nothing is."""
        self._sequences = {
            m.key: Sequence(m.counter.modulus, cycle_ns=m.counter.cycle_ns, jump=m.counter.jump, silence_ns=silence_ns)
            for m in layout.inbound.values()
            if m.counter is not None
        }
        stamp = layout.stamp
        self._clock = RobotClock(stamp[0].length, stamp[1]) if stamp else None
        self._now_ns, self._seq = 0, -1
        self._second = self._in_second = 0
        self._triggered_ns: int | None = None
        self._reckoned_ns: int | None = None
        self._said_ns: dict[str, int] = {}
        self._up = False
        self._commands = layout.commands
        used = set(layout.reckoning.values())
        self._wheels = next((g for g in reversed(layout.groups) if used & set(g.into)), None)

    # ------------------------------------------------------------------ frames

    def decode(self, data: bytes) -> list[Decoded]:
        """What a frame of records means. Never raises for bad bytes."""
        said: list[Decoded] = []
        at, end, unpack, inbound = 0, len(data), HEADER.unpack_from, self._layout.inbound
        while at < end:
            if end - at < 14:
                self._fault(said, f"{end - at} bytes are no CAN frame", "malformed")
                break
            stamp_ns, key, _, length = unpack(data, at)
            at += 14
            if length > end - at or length > PAYLOAD_MAX:
                self._fault(said, f"a CAN frame claims {length} bytes of payload, {end - at} are there", "malformed")
                break
            payload = data[at : at + length]
            at += length
            if stamp_ns < self._now_ns:
                self._fault(said, "a CAN frame came before the one before it", "malformed")
                continue
            self._now_ns = stamp_ns
            message = inbound.get(key)
            if message is not None:
                self._heard(said, message, payload)
            else:
                self._other(said, key)
        return said

    def _heard(self, said: list[Decoded], message: Inbound, payload: bytes) -> None:
        """A frame of a message that is listened to."""
        if len(payload) != message.length:
            if len(payload) not in message.lengths:
                self._refuse(said, message, f"{message.name} has {len(payload)} bytes, must have {message.length}", "malformed")
                return
            payload = payload[: message.length]
        little, big = int.from_bytes(payload, "little"), int.from_bytes(payload, "big")
        if message.checksum is not None:
            bits, guard = message.checksum
            if ((big if bits.big else little) >> bits.shift) & bits.mask != guard.expected(payload):
                self._refuse(said, message, f"{message.name} has a wrong checksum", "checksum")
                return
        lost, kind = 0, "next"
        if message.counter is not None:
            bits = message.counter.bits
            kind, lost = self._sequences[message.key].judge(((big if bits.big else little) >> bits.shift) & bits.mask, self._now_ns)
            if kind not in ACCEPTED:
                self.counts[kind] += 1
                if kind == "jumped":
                    self._refuse(said, message, f"the counter of {message.name} jumped", "")
                return
            self.counts["lost"] += lost
        for group in message.groups:
            if group.selectors and not selected(group.selectors, payload):
                continue
            wrong = group.read(little, big, self._values) if group.read is not None else ""
            if wrong:
                self.times[group.index] = None
                self._fault(said, wrong, "malformed")
                if group is self._layout.trigger:
                    self._seq += 1 + lost
                continue
            self.times[group.index] = self._now_ns
            if group is self._wheels and group is not self._layout.trigger:
                self._reckon(self._now_ns)
            if self._layout.overrides:
                self._overrides(said, group)
            if group is self._layout.trigger:
                ticks = self._ticks(little, big)
                self._observe(said, kind, lost, ticks, self._counter(message, little, big) if kind == "first" else -1)

    def _other(self, said: list[Decoded], key: int) -> None:
        """A frame of nothing that is listened to: an error frame, a command that is not ours, or somebody else's business."""
        if key & ERROR:
            self.counts["error_frames"] += 1
            if key & BUS_OFF and not self.bus_off:
                self.counts["bus_off"] += 1
                self.bus_off, self._up = True, False
                said.append(LinkChanged(self._now_ns, up=False, detail="bus-off: the CAN controller left the bus"))
        elif key in self._commands:
            self.counts["strangers"] += 1
            self._override(said, "manual_override", f"another node sends {self._commands[key]} on the robot's bus")
        elif not key & REMOTE:
            self.counts["foreign"] += 1

    # ------------------------------------------------------------------ what is wrong

    def _refuse(self, said: list[Decoded], message: Inbound, why: str, count: str) -> None:
        """Nothing that this message said is good any more."""
        for group in message.groups:
            self.times[group.index] = None
        self._fault(said, why, count)

    def _fault(self, said: list[Decoded], why: str, count: str) -> None:
        if count:
            self.counts[count] += 1
        second = self._now_ns // SECOND_NS
        if second != self._second:
            self._second, self._in_second = second, 0
        self._in_second += 1
        if self._in_second <= FAULTS_PER_SECOND:
            seq, stamp_ns = self.newest
            said.append(Observation(max(0, seq), max(0, stamp_ns), (), fault=why))

    # ------------------------------------------------------------------ overrides

    def _overrides(self, said: list[Decoded], group: Group) -> None:
        for kind, value in self._layout.overrides:
            if value in group.into:
                if self._values[value]:
                    self._override(said, kind, f"{group.label} says so")
                else:
                    self._said_ns.pop(kind, None)

    def _override(self, said: list[Decoded], kind: Override, detail: str) -> None:
        if self._now_ns - self._said_ns.get(kind, -AGAIN_NS) >= AGAIN_NS:
            self._said_ns[kind] = self._now_ns
            said.append(OverrideChanged(self._now_ns, kind, detail))

    # ------------------------------------------------------------------ observations

    def _reckon(self, now_ns: int) -> None:
        """The wheels' speeds came; the pose moves on to now."""
        odometry, values, at = self._odometry, self._values, self._layout.reckoning
        if odometry is None or any(self.times[g.index] is None for g in self._layout.groups if set(g.into) & set(at.values())):
            return
        last_ns, self._reckoned_ns = self._reckoned_ns, now_ns
        heading = values[at["heading"]] if "heading" in at else None
        v, w = (values[at["speed"]], 0.0) if "speed" in at else odometry.wheels(values[at["left"]], values[at["right"]])
        if "yaw_rate" in at:
            w = values[at["yaw_rate"]]
        if last_ns is None or not 0 <= now_ns - last_ns <= MAX_STEP_NS:
            odometry.rest(heading)
            last_ns = now_ns
        odometry.move((v, w), (now_ns - last_ns) * 1e-9, heading)

    def _ticks(self, little: int, big: int) -> int:
        if self._layout.stamp is None:
            return 0
        bits = self._layout.stamp[0]
        return ((big if bits.big else little) >> bits.shift) & bits.mask

    def _counter(self, message: Inbound, little: int, big: int) -> int:
        if message.counter is None:
            return 0
        bits = message.counter.bits
        return ((big if bits.big else little) >> bits.shift) & bits.mask

    def _observe(self, said: list[Decoded], kind: str, lost: int, ticks: int, first: int) -> None:
        """The trigger came."""
        now_ns, layout = self._now_ns, self._layout
        silent = self._triggered_ns is not None and now_ns - self._triggered_ns > self._silence_ns
        self._triggered_ns = now_ns
        self._seq = first if self._seq < 0 <= first else self._seq + 1 + lost + (kind in ("resumed", "restarted"))
        stamp_ns = now_ns
        if self._clock is not None:
            tock, stamp_ns = self._clock.judge(ticks, silent=silent)
            if tock in ("repeated", "old"):
                self._fault(said, "the robot's clock does not rise", "malformed")
                return
            kind = "restarted" if tock == "restarted" and not silent else kind
        elif stamp_ns <= self.newest[1]:
            stamp_ns = self.newest[1] + 1
        if layout.trigger is self._wheels:
            if kind == "restarted":
                self._reckoned_ns = None
            self._reckon(stamp_ns)
        for group in layout.groups:
            at_ns = self.times[group.index]
            if group.max_age_ns is not None and (at_ns is None or now_ns - at_ns > group.max_age_ns):
                self.counts["incomplete"] += 1
                return
        x = tuple(self._value(i, name) for i, name in zip(layout.states, self._names, strict=True))
        if kind == "restarted":
            said.append(LinkChanged(now_ns, up=False, detail="the robot started anew"))
            self._up = False
        if not self._up:
            said.append(LinkChanged(now_ns, up=True))
            self._up, self.bus_off = True, False
        self.newest = self._seq, stamp_ns
        said.append(Observation(self._seq, stamp_ns, x))

    def _value(self, index: int | None, name: str) -> float:
        if index is not None:
            return self._values[index]
        assert self._odometry is not None  # noqa: S101 - the layout leaves out what is reckoned
        return self._odometry.pose[("x", "y", "theta").index(name)]
