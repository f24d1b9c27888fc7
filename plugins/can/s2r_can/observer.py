"""CAN frames -> observations. Depends on the records and what came before, not on a bus: an audit makes the same of the same bytes.

Frames that are not to be believed (`hearing`) make faulty observations that say why (at most 32 a second: a storm must not fill the log).

When the trigger comes and every other group that is needed is fresh, there is an observation: the newest values, stamped with the robot's
clock where it is on the bus, else with the trigger's arrival. Otherwise there is none, and it is counted as incomplete.
"""

from __future__ import annotations

from typing import Literal

from s2r_can.addresses import Addresses
from s2r_can.hearing import Heard, Hearing, field
from s2r_can.layout import Group, Inbound, Layout
from s2r_can.odometry import Odometry
from s2r_can.reckoning import Reckoning
from s2r_can.records import BUS_OFF, ERROR, HEADER, PAYLOAD_MAX, REMOTE, STOPS
from s2r_can.sequence import RobotClock
from s2r_runtime.messages import Command, LinkChanged, Observation, ObservationRefused, OverrideChanged

Decoded = Observation | ObservationRefused | Command | LinkChanged | OverrideChanged
Override = Literal["emergency_stop", "manual_override"]

SECOND_NS = 1_000_000_000
FAULTS_PER_SECOND = 32
AGAIN_NS = SECOND_NS
"""An override that lasts is said again after so long: whoever clears it while the button is held finds it again."""
LEFT = "bus-off: the CAN controller left the bus"
COUNTS = ("incomplete", "foreign", "error_frames", "bus_off", "strangers")


class Observer:
    """One robot's bus. names: the model's states. silence_ns: without frames for so long, a sender may have started anew."""

    def __init__(self, layout: Layout, names: tuple[str, ...], odometry: Odometry | None, silence_ns: int) -> None:
        self._layout, self._names, self._silence_ns = layout, names, silence_ns
        self._hearing = Hearing(layout, silence_ns)
        self.counts = self._hearing.counts
        self.counts.update(dict.fromkeys(COUNTS, 0))
        self.newest: tuple[int, int] = (-1, -1)
        """seq and stamp of the newest good observation; -1 before the first."""
        self.bus_off = False
        self._values = self._hearing.values
        self.times: list[int | None] = [None] * len(layout.groups)
        """Arrival of what is good in each group, ns; None where nothing is."""
        stamp = layout.stamp
        self._clock = RobotClock(stamp[0].length, stamp[1]) if stamp else None
        self._now_ns, self._seq = 0, -1
        self._second = self._in_second = 0
        self._triggered_ns: int | None = None
        self._said_ns: dict[str, int] = {}
        self._up = False
        self._anew, self._clean = False, True
        self._commands = layout.commands
        self._addresses = Addresses(layout.inbound, layout.sources, silence_ns)
        self._addressed = self._addresses.used
        vital = {index for index in (*layout.states, *layout.reckoning.values()) if index is not None}
        self._vital = {group.index for group in layout.groups if vital & set(group.into)}
        self._reckoning = Reckoning(layout, odometry, self._values)

    # ------------------------------------------------------------------ frames

    def decode(self, data: bytes) -> list[Decoded]:
        """What a frame of records means. Never raises for bad bytes."""
        said: list[Decoded] = []
        at, end, unpack, inbound = 0, len(data), HEADER.unpack_from, self._layout.inbound
        while at < end:
            if end - at < 14:
                self._malformed(said, f"{end - at} bytes are no CAN frame")
                break
            stamp_ns, key, flags, length = unpack(data, at)
            at += 14
            if length > end - at or length > PAYLOAD_MAX:
                self._malformed(said, f"a CAN frame claims {length} bytes of payload, {end - at} are there")
                break
            payload = data[at : at + length]
            at += length
            if stamp_ns < self._now_ns:
                self._malformed(said, "a CAN frame came before the one before it")
                continue
            self._now_ns = stamp_ns
            message = inbound.get(self._addresses.message(key) if self._addressed else key)
            if message is not None and self._addressed and (twin := self._addresses.twin(key, stamp_ns)):
                self._malformed(said, twin)
            elif message is not None:
                self._heard(said, message, payload)
            else:
                self._other(said, key, flags)
        return said

    def _heard(self, said: list[Decoded], message: Inbound, payload: bytes) -> None:
        """A frame of a message that is listened to."""
        heard, trigger = self._hearing.frame(message, payload, self._now_ns), self._layout.trigger
        self._reckoning.forget(heard.bad)
        if heard.twin:
            said.append(OverrideChanged(self._now_ns, "robot_twin", heard.twin))
        if heard.refused and self._clean:  # once after each observation: a storm must not fill the log
            self._clean = False
            said.append(ObservationRefused(self._now_ns, heard.refused))
        for group in heard.bad:
            self.times[group.index] = None
            if group is trigger and heard.believed:
                self._seq += 1 + heard.lost
        if heard.wrong:
            self._fault(said, heard.wrong)
        for group in heard.groups:
            self.times[group.index] = self._now_ns
            if group is not trigger:
                self._reckoning.came(group, self._now_ns)
            if self._layout.overrides:
                self._overrides(said, group)
            if group is trigger:
                self._observe(said, message, heard)

    def _other(self, said: list[Decoded], key: int, flags: int) -> None:
        """A frame of nothing that is listened to: an error frame, a command that is not ours, or somebody else's business."""
        if key & ERROR:
            self.counts["error_frames"] += 1
            if key & BUS_OFF and not self.bus_off:
                self.counts["bus_off"] += 1
                self.bus_off, self._up = True, False
                said.append(LinkChanged(self._now_ns, up=False, detail=LEFT))
            if key & BUS_OFF and flags & STOPS:  # logs of earlier versions have no such flag
                self._override(said, "emergency_stop", f"{LEFT}: a fault of the wiring, or another node that sends the same identifiers")
        elif key in self._commands:
            self.counts["strangers"] += 1
            self._override(said, "manual_override", f"another node sends {self._commands[key]} on the robot's bus")
        elif not key & REMOTE:
            self.counts["foreign"] += 1

    # ------------------------------------------------------------------ what is wrong

    def _malformed(self, said: list[Decoded], why: str) -> None:
        self.counts["malformed"] += 1
        self._fault(said, why)

    def _fault(self, said: list[Decoded], why: str) -> None:
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

    def _observe(self, said: list[Decoded], message: Inbound, heard: Heard) -> None:
        """The trigger came."""
        now_ns, layout, kind = self._now_ns, self._layout, heard.kind
        silent = self._triggered_ns is not None and now_ns - self._triggered_ns > self._silence_ns
        self._triggered_ns = now_ns
        if kind == "first" and self._seq < 0 and message.counter is not None:
            self._seq = field(message.counter.bits, heard.little, heard.big)
        else:
            self._seq += 1 + heard.lost + (kind in ("resumed", "restarted"))
        stamp_ns = now_ns
        if self._clock is not None and layout.stamp is not None:
            believed = silent or kind == "restarted"
            tock, stamp_ns = self._clock.judge(field(layout.stamp[0], heard.little, heard.big), silent=believed)
            if tock in ("repeated", "old"):
                self._malformed(said, "the robot's clock does not rise")
                return
            kind = "restarted" if tock == "restarted" and not silent else kind
        elif stamp_ns <= self.newest[1]:
            stamp_ns = self.newest[1] + 1
        if kind == "restarted":
            self._anew = True
            self._reckoning.rest()
        self._reckoning.came(layout.trigger, stamp_ns)
        if not self._complete(now_ns):
            self.counts["incomplete"] += 1
            return
        x = tuple(self._value(i, name) for i, name in zip(layout.states, self._names, strict=True))
        if self._anew:
            said.append(LinkChanged(now_ns, up=False, detail="the robot started anew"))
            self._anew = self._up = False
        if not self._up:
            said.append(LinkChanged(now_ns, up=True))
            self._up, self.bus_off = True, False
        self.newest, self._clean = (self._seq, stamp_ns), True
        said.append(Observation(self._seq, stamp_ns, x))

    def _complete(self, now_ns: int) -> bool:
        """Whether all that is needed was said, and lately. What is sent only when it changes may be missing yet, unless it is a state."""
        for group in self._layout.groups:
            at_ns = self.times[group.index]
            if at_ns is None:
                if group.max_age_ns is not None or group.index in self._vital:
                    return False
            elif group.max_age_ns is not None and now_ns - at_ns > group.max_age_ns:
                return False
        return True

    def _value(self, index: int | None, name: str) -> float:
        return self._values[index] if index is not None else self._reckoning.pose[("x", "y", "theta").index(name)]
