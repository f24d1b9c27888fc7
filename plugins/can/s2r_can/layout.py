"""What a profile reads from and writes to the bus: its options, looked up in the DBC, compiled.

*Group*: signals of one message that are there together: all of it, or one branch of a multiplexed message. Each is good for its own
time. *Value*: one SI number that a group delivers, by its index in one list.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from s2r_can.bits import NUMBER_MAX, ROUNDING, Bits, Scaled, Selector, bits_of
from s2r_can.checksums import Guarded
from s2r_can.database import Named
from s2r_can.options import Source
from s2r_can.units import factor_of
from s2r_runtime.errors import ConfigError

INVALID = re.compile(
    r"\b(sna|na|n/a|invalid|not ?(avail|valid|init)\w*|unavail\w*|undefined|unknown|err(or)?|fault\w*|fail\w*|reserved|no ?signal)\b",
    re.IGNORECASE,
)
"""Names of values that are no measurements, as DBC files write them."""


@dataclass
class Group:
    """index: its number. label: how messages call it. max_age_ns: for so long what it said is good; None: for ever."""

    index: int
    label: str
    selectors: tuple[Selector, ...]
    max_age_ns: int | None
    signals: list[Scaled] = field(default_factory=list)
    into: list[int] = field(default_factory=list)
    read: Callable[[int, int, list[float]], str] | None = None


@dataclass
class Counter:
    """A rolling counter of a message; jump 0: by rule; cycle_ns 0: not known."""

    bits: Bits
    modulus: int
    jump: int
    cycle_ns: int


@dataclass
class Inbound:
    """A message that is listened to. lengths: of payload that a frame of it may have. cycle_ns: 0 if it does not come in a known cycle."""

    name: str
    key: int
    length: int
    lengths: frozenset[int]
    groups: list[Group] = field(default_factory=list)
    counter: Counter | None = None
    checksum: tuple[Bits, Guarded] | None = None
    cycle_ns: int = 0


@dataclass
class Outbound:
    """A command frame: a message, or a branch of it. base: payload with all that is constant, as (little, big) integers. inputs: (index in
    u, its signal).
    """

    name: str
    key: int
    length: int
    fd: bool
    selectors: tuple[Selector, ...]
    inputs: list[tuple[int, Scaled]]
    base: tuple[int, int]
    counter: Counter | None = None
    checksum: tuple[Bits, Guarded] | None = None


@dataclass
class Layout:
    """inbound: by key. states: value of each state, None: dead reckoned. overrides: (kind, value). reckoning: value of each speed that
    the pose is reckoned from. stamp: (bits, ns per unit) of the robot's clock, which is in the trigger's message.
    """

    inbound: dict[int, Inbound]
    outbound: list[Outbound]
    groups: list[Group]
    values: int
    states: tuple[int | None, ...]
    overrides: tuple[tuple[Literal["emergency_stop", "manual_override"], int], ...]
    trigger: Group
    stamp: tuple[Bits, float] | None
    reckoning: dict[str, int]
    sources: dict[str, int] = field(default_factory=dict)
    """J1939 messages whose source address counts otherwise than the DBC has it (`addresses`)."""

    @property
    def commands(self) -> dict[int, str]:
        """Key -> name of what only the runtime may send."""
        return {out.key: out.name for out in self.outbound}


def scaled(named: Named, source: Source, where: str) -> Scaled:
    """A signal as the profile takes it. Raises ConfigError."""
    signal = named.signal
    bits = bits_of(named.message, signal, where)
    scale, offset, unit = float(signal.scale), float(signal.offset), signal.unit or ""
    factor = source.scale if source.scale is not None else factor_of(unit)
    if factor is None:
        raise ConfigError(
            f"{where}: {named} has the unit {unit!r}, which is not known here: give its scale, "
            f"{{ signal = {str(named)!r}, scale = SI units per {unit} }}"
        )
    if not scale or not math.isfinite(scale) or not math.isfinite(offset):
        raise ConfigError(f"{where}: {named} has the scale {scale:g} and the offset {offset:g} in the DBC, which make no number")
    slack = ROUNDING * abs(scale) if bits.real is None else 0.0
    most = NUMBER_MAX / abs(factor)
    low = max(-most, float(signal.minimum) - slack) if signal.minimum is not None else -most
    high = min(most, float(signal.maximum) + slack) if signal.maximum is not None else most
    if not low <= high:
        raise ConfigError(f"{where}: {named} has the range {signal.minimum:g} to {signal.maximum:g} in the DBC, which holds nothing")
    invalid = {
        int(raw): str(name) for raw, name in (signal.conversion.choices or {}).items() if INVALID.search(str(name).replace("_", " "))
    }
    return Scaled(bits, scale, offset, factor, source.offset, low, high, invalid, f" {unit}" if unit else "")


def complete(table: str, given: dict[str, Source], wanted: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Whether every wanted name of the model is there, and nothing that it doesn't know. Raises ConfigError."""
    for name in given:
        if name not in known:
            raise ConfigError(f"transport.{table}.{name}: the model has no such name; it has: {', '.join(known)}")
    if missing := [name for name in wanted if name not in given]:
        more = (
            " (a pose can be dead reckoned: transport.dead_reckoning)" if table == "states" and set(missing) & {"x", "y", "theta"} else ""
        )
        raise ConfigError(f"transport.{table} lacks {', '.join(missing)}: which signal is it?{more}")
