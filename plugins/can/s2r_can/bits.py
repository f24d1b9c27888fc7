"""Where a signal's bits are in a payload, and what number they mean: the part of cantools that is needed a thousand times a second.

A payload of L bytes is one integer, read little endian or big endian as the signal's byte order says; a signal is a run of bits in it:

    raw = (integer >> shift) & mask          two's complement if signed, IEEE 754 (16, 32, 64 bit) if a float
    physical = raw scale + offset            the DBC's
    value = physical factor + shift_si       in SI units (`units`)

Little endian: shift = the DBC's start bit. Big endian: the start bit is the most significant, in byte start // 8 at bit start % 8
(7 the highest), so shift = 8 (L - 1 - start // 8) + start % 8 - (length - 1).

A signal of a multiplexed message is there only if its selectors, from the outermost on, hold one of the values that the DBC names.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from s2r_runtime.errors import ConfigError

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

FLOATS = {16: struct.Struct("<e"), 32: struct.Struct("<f"), 64: struct.Struct("<d")}
NUMBER_MAX = 1e9
"""Largest magnitude of a state or an input, SI: sane values of any unit lie below, and sums of squares of them stay finite."""
ROUNDING = 1e-6
"""Of a signal's step: by so much a value may miss the DBC's range, which is printed in decimals."""


class Bits(NamedTuple):
    """A signal's place. `sign`: the sign's bit within `mask`, 0 for what has none. `real`: for IEEE 754, else None."""

    name: str
    big: bool
    shift: int
    mask: int
    sign: int
    length: int
    real: struct.Struct | None

    def raw(self, payload: bytes) -> float:
        """The number that the bits are, unscaled. payload: of the message's length."""
        whole = int.from_bytes(payload, "big" if self.big else "little")
        number = (whole >> self.shift) & self.mask
        if self.real is not None:
            return float(self.real.unpack(number.to_bytes(self.real.size, "little"))[0])
        return number - self.mask - 1 if number & self.sign else number

    def limits(self) -> tuple[int, int]:
        """Least and largest raw integer."""
        return (-self.sign, self.sign - 1) if self.sign else (0, self.mask)

    def placed(self, raw: float) -> tuple[int, int]:
        """(little-endian, big-endian) integer of a payload in which nothing but this raw value is; or it into others with |.

        Raises ValueError if it does not fit.
        """
        if self.real is not None:
            try:
                number = int.from_bytes(self.real.pack(raw), "little")
            except OverflowError:
                raise ValueError(f"{raw:g} does not fit {self.length} bits") from None
        else:
            low, high = self.limits()
            if not low <= raw <= high:
                raise ValueError(f"raw value {raw:g} is outside {low} to {high}")
            number = int(raw) & self.mask
        return (0, number << self.shift) if self.big else (number << self.shift, 0)


class Scaled(NamedTuple):
    """Physical values of a signal and their SI values. low, high: what counts as sane, physical; invalid: raw values that are no number.

    unit: of the physical value.
    """

    bits: Bits
    scale: float
    offset: float
    factor: float
    shift_si: float
    low: float
    high: float
    invalid: dict[int, str]
    unit: str

    def raw_of(self, value: float) -> float:
        """The raw value nearest to an SI value. Raises ValueError if the signal's range does not hold it."""
        physical = (value - self.shift_si) / self.factor
        if not self.low <= physical <= self.high:
            raise ValueError(f"{self.bits.name} would be {physical:g}{self.unit}, the DBC says {self.low:g} to {self.high:g}")
        raw = (physical - self.offset) / self.scale
        return raw if self.bits.real is not None else round(raw)


Selector = tuple[Bits, frozenset[int]]
"""A multiplexer and the values of it with which a signal is there."""


def bits_of(message: Message, signal: Signal, where: str) -> Bits:
    """The place of a signal in its message. Raises ConfigError for one that does not fit (a DBC that was not checked)."""
    length, size = int(signal.length), 8 * int(message.length)
    real = None
    if signal.conversion.is_float:
        real = FLOATS.get(length)
        if real is None:
            raise ConfigError(f"{where}: {signal.name} is a float of {length} bits, must have 16, 32 or 64")
    big = signal.byte_order == "big_endian"
    start = int(signal.start)
    shift = size - 8 * (start // 8) - 8 + start % 8 - (length - 1) if big else start
    if length < 1 or shift < 0 or shift + length > size:
        raise ConfigError(
            f"{where}: {signal.name} (start bit {start}, {length} bits) does not fit the {message.length} bytes of its message"
        )
    sign = 1 << (length - 1) if signal.is_signed and real is None else 0
    return Bits(f"{message.name}.{signal.name}", big, shift, (1 << length) - 1, sign, length, real)


def selectors_of(message: Message, signal: Signal, where: str) -> tuple[Selector, ...]:
    """What must be selected for the signal to be there, outermost first; empty for one that always is."""
    found: list[Selector] = []
    by_name = {s.name: s for s in message.signals}
    while signal.multiplexer_signal is not None and signal.multiplexer_ids:
        chosen = frozenset(int(i) for i in signal.multiplexer_ids)
        signal = by_name[signal.multiplexer_signal]
        found.append((bits_of(message, signal, where), chosen))
    return tuple(reversed(found))


def selected(selectors: tuple[Selector, ...], payload: bytes) -> bool:
    """Whether a payload has what these select."""
    return all(bits.raw(payload) in chosen for bits, chosen in selectors)


class Part(NamedTuple):
    """Signals of one message that are there together. into: index of each into the list of values that `reader` fills."""

    selectors: tuple[Selector, ...]
    signals: tuple[Scaled, ...]
    into: tuple[int, ...]


def reader(part: Part) -> Callable[[int, int, list[float]], str]:
    """Compiled: read(little, big, values) fills in the SI values of a payload given as two integers, and returns "".

    If one of them is no good none is filled in, and what is wrong is returned. Multiplexers are not looked at.
    """
    plan = []
    for index, s in zip(part.into, part.signals, strict=True):
        b = s.bits
        # bounds on raw values, which are exact, would be another statement where scale or offset round: so physical ones
        plan.append((index, b.big, b.shift, b.mask, b.sign, b.real, s.scale, s.offset, s.low, s.high, s.factor, s.shift_si, s.invalid))
    signals = part.signals

    def read(little: int, big: int, values: list[float]) -> str:
        found = []
        for k, (index, is_big, shift, mask, sign, real, scale, offset, low, high, factor, more, invalid) in enumerate(plan):
            raw = ((big if is_big else little) >> shift) & mask
            if real is not None:
                raw = real.unpack(raw.to_bytes(real.size, "little"))[0]
            elif raw & sign:
                raw -= mask + 1
            physical = raw * scale + offset
            if not low <= physical <= high or (invalid and raw in invalid):
                return _wrong(signals[k], raw, physical)
            found.append((index, physical * factor + more))
        for index, value in found:
            values[index] = value
        return ""

    return read


def _wrong(signal: Scaled, raw: float, physical: float) -> str:
    if signal.invalid and raw in signal.invalid:
        return f"{signal.bits.name} says {signal.invalid[int(raw)]!r}"
    if not math.isfinite(physical):
        return f"{signal.bits.name} is not a finite number"
    return f"{signal.bits.name} is {physical:g}{signal.unit}, must be in {signal.low:g} to {signal.high:g}"
