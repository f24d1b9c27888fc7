"""Which messages of the robot's bus are listened to, and what of them is read: the inbound half of a `Layout`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from s2r_can.addresses import ANY, keyed
from s2r_can.bits import NUMBER_MAX, Bits, Part, Scaled, bits_of, reader, selectors_of
from s2r_can.database import Database, Named
from s2r_can.layout import Group, Inbound, Layout, complete, scaled
from s2r_can.options import Options, Source
from s2r_can.records import FD_LENGTHS
from s2r_can.sending import outbound, protect
from s2r_can.units import factor_of
from s2r_runtime.errors import ConfigError

if TYPE_CHECKING:
    from cantools.database.can import Message

LATE = 1.5
"""Cycles for which a message is good: one that was lost shows, one that comes late by half a cycle doesn't."""
TIMES = ("s", "sec", "ms", "us", "µs", "ns")
LINEAR = ("m/s", "mm/s", "cm/s", "km/h", "kph", "kmh", "mps", "mph")


def layout_of(options: Options, database: Database, states: tuple[str, ...], inputs: tuple[str, ...]) -> Layout:
    """states, inputs: the model's. Raises ConfigError for whatever the DBC doesn't have."""
    complete("inputs", options.inputs, inputs, inputs)
    sent = outbound(options, database, inputs)
    layout = _Listening(options, database).layout(states)
    layout.outbound += sent
    layout.sources = dict(options.source_addresses)
    for name in options.source_addresses:
        database.message(name, f"transport.source_addresses.{name}")
    for out in sent:
        if layout.sources.get(out.name) == ANY:
            raise ConfigError(f"transport.source_addresses.{out.name}: it is sent by the runtime, from one address")
        if out.key in layout.inbound:
            raise ConfigError(f"transport: message {out.name} is read and sent, but only the runtime may send what the robot obeys")
    protect(layout, options, database)
    return layout


class _Listening:
    def __init__(self, options: Options, database: Database) -> None:
        self._options, self._database = options, database
        self._inbound: dict[int, Inbound] = {}
        self._groups: list[Group] = []
        self._values = 0

    def layout(self, states: tuple[str, ...]) -> Layout:
        """All but what is sent."""
        o = self._options
        for name in o.cycles:
            self._database.message(name, f"transport.cycles.{name}")
        reckoned = tuple(s for s in ("x", "y", "theta") if s in states and s not in o.states) if o.dead_reckoning else ()
        complete("states", o.states, tuple(s for s in states if s not in reckoned), states)
        at = tuple(None if s in reckoned else self._value(o.states[s], f"transport.states.{s}")[0] for s in states)
        overrides = tuple((kind, self._flag(signal, f"transport.overrides.{kind}")) for kind, signal in o.overrides.items())
        reckoning = self._reckoning() if reckoned else {}
        stamp, clock = self._stamp()
        trigger = self._trigger(at, reckoning, clock)
        if clock is not None and trigger is not clock:
            raise ConfigError(f"transport.stamp: the robot's clock must be in the trigger's message, {trigger.label}, not in {clock.label}")
        for group in self._groups:
            group.read = reader(Part(group.selectors, tuple(group.signals), tuple(group.into)))
        return Layout(self._inbound, [], self._groups, self._values, at, overrides, trigger, stamp, reckoning)

    def _group(self, named: Named, where: str) -> Group:
        """The group of a signal; makes it, and its message."""
        message, o = named.message, self._options
        inbound = self._message(message)
        selectors = selectors_of(message, named.signal, where)
        for group in inbound.groups:
            if group.selectors == selectors:
                return group
        chosen = ", ".join(f"{bits.name.partition('.')[2]} {'/'.join(map(str, sorted(ids)))}" for bits, ids in selectors)
        if message.name in o.timeouts:
            age = o.timeouts[message.name]
        elif message.cycle_time and not selectors:
            age = LATE * message.cycle_time * 1e-3
        else:
            age = o.message_timeout
        label = f"{message.name} [{chosen}]" if chosen else message.name
        return self._new_group(inbound, Group(len(self._groups), label, selectors, None if math.isinf(age) else round(age * 1e9)))

    def _new_group(self, inbound: Inbound, group: Group) -> Group:
        inbound.groups.append(group)
        self._groups.append(group)
        return group

    def _message(self, message: Message) -> Inbound:
        key = keyed(message, self._options)
        found = self._inbound.get(key)
        if found is None:
            padded = next((n for n in FD_LENGTHS if n >= message.length), message.length)
            found = self._inbound[key] = Inbound(message.name, key, message.length, frozenset({message.length, padded}))
            found.cycle_ns = self._cycle_ns(message)
        return found

    def _cycle_ns(self, message: Message) -> int:
        cycle = self._options.cycles.get(message.name)
        if cycle is None:
            return _cycle_ns(message)
        return 0 if math.isinf(cycle) else round(1e9 * cycle)

    def _value(self, source: Source, where: str) -> tuple[int, Scaled]:
        """(index of the value, its signal)."""
        named = self._database.signal(source.signal, where)
        return self._add(named, scaled(named, source, where), where)

    def _flag(self, signal: str, where: str) -> int:
        """A signal that counts as set unless it is zero: whatever else it says, the robot is to stop."""
        named = self._database.signal(signal, where)
        plain = Scaled(bits_of(named.message, named.signal, where), 1.0, 0.0, 1.0, 0.0, -NUMBER_MAX, 1e20, {}, "")
        return self._add(named, plain, where)[0]

    def _add(self, named: Named, signal: Scaled, where: str) -> tuple[int, Scaled]:
        group = self._group(named, where)
        group.signals.append(signal)
        group.into.append(self._values)
        self._values += 1
        return self._values - 1, signal

    def _stamp(self) -> tuple[tuple[Bits, float] | None, Group | None]:
        """The robot's clock, ns a unit, and the group that it is in."""
        if not self._options.stamp:
            return None, None
        where = "transport.stamp"
        named = self._database.signal(self._options.stamp, where)
        unit = (named.signal.unit or "s").lower()
        bits, factor = bits_of(named.message, named.signal, where), factor_of(unit)
        if factor is None or unit not in TIMES:
            raise ConfigError(f"{where}: {named} has the unit {named.signal.unit!r}, must be one of: {', '.join(TIMES)}")
        if bits.real is not None or bits.sign or bits.length < 16:
            raise ConfigError(f"{where}: {named} must be an unsigned integer of at least 16 bits")
        return (bits, abs(float(named.signal.scale)) * factor * 1e9), self._group(named, where)

    def _reckoning(self) -> dict[str, int]:
        """Value of each speed that the pose is reckoned from."""
        o = self._options.dead_reckoning
        found: dict[str, int] = {}
        for name in ("left", "right", "speed", "yaw_rate", "heading"):
            if name in o:
                where = f"transport.dead_reckoning.{name}"
                found[name], signal = self._value(o[name], where)
                if name in ("left", "right") and signal.unit.strip().lower() in LINEAR and "wheel_radius" in o:
                    raise ConfigError(f"{where}: {signal.bits.name} is in{signal.unit}, so wheel_radius must be left out")
        return found

    def _trigger(self, at: tuple[int | None, ...], reckoning: dict[str, int], clock: Group | None) -> Group:
        name, where = self._options.trigger, "transport.trigger"
        if not name:
            if clock is not None:
                return clock
            index = max(reckoning.values()) if reckoning else next(i for i in at if i is not None)
            return next(group for group in self._groups if index in group.into)
        if "." in name:
            return self._group(self._database.signal(name, where), where)
        message = self._database.message(name, where)
        inbound = self._message(message)
        if not inbound.groups:  # one of which nothing else is read, such as a synchronisation
            return self._new_group(inbound, Group(len(self._groups), message.name, (), None))
        if len(inbound.groups) > 1 or inbound.groups[0].selectors:
            raise ConfigError(f"{where}: message {name} is multiplexed; name a signal of the branch that is to count, as {name}.Signal")
        return inbound.groups[0]


def _cycle_ns(message: Message) -> int:
    """Between two frames of a message that is sent in a cycle and at no other time, as far as the DBC says; else 0."""
    kind = (message.send_type or "cyclic").lower()
    at_other_times = not kind.startswith("cyclic") or any(word in kind for word in ("active", "and", "spontan", "event", "change", "write"))
    return 0 if at_other_times or message.is_multiplexed() else round(1e6 * (message.cycle_time or 0))
