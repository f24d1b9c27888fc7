"""Checksums that protect a payload from end to end. Built in: `crc8_j1850`, `xor8`, `sum8`; others through the hook below.

    crc8_j1850   CRC-8/SAE-J1850: polynomial 0x1D, start 0xFF, final XOR 0xFF (of the ASCII digits 123456789: 0x4B)
    xor8         all bytes, XORed
    sum8         all bytes, added, modulo 256

each over the data id, if there is one (one byte, or two where it is above 255, the low one first), and then the payload without the
bytes that the checksum fills (where it fills no whole byte: with its bits at zero).

The hook: a package with an entry point in the group `s2r_can.checksums`, whose name is the scheme's and which leads to a function
`scheme(covered: Covered) -> int`; the signal takes as many low bits of it as it has. Only what is installed can be named: a log
that comes from elsewhere must not choose code. Built-in names are taken first.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from functools import reduce
from importlib import metadata
from operator import xor
from typing import NamedTuple

from s2r_runtime.errors import ConfigError

GROUP = "s2r_can.checksums"


class Covered(NamedTuple):
    """What a checksum is made of. cut: the data id and the payload without the checksum's bytes; zeroed: the payload with its bits at
    zero; data_id: -1 if there is none.
    """

    cut: bytes
    zeroed: bytes
    arbitration_id: int
    data_id: int


Scheme = Callable[[Covered], int]


def _table(polynomial: int) -> bytes:
    """What each byte makes of an 8-bit CRC."""
    table = bytearray()
    for value in range(256):
        for _ in range(8):
            value = (value << 1 ^ polynomial) & 0xFF if value & 0x80 else value << 1
        table.append(value)
    return bytes(table)


_J1850 = _table(0x1D)


def crc8_j1850(covered: Covered) -> int:
    """CRC-8/SAE-J1850."""
    crc, table = 0xFF, _J1850
    for byte in covered.cut:
        crc = table[crc ^ byte]
    return crc ^ 0xFF


def xor8(covered: Covered) -> int:
    """All bytes, XORed."""
    return reduce(xor, covered.cut, 0)


def sum8(covered: Covered) -> int:
    """All bytes, added."""
    return sum(covered.cut) & 0xFF


BUILT_IN: dict[str, Scheme] = {"crc8_j1850": crc8_j1850, "xor8": xor8, "sum8": sum8}
_CUT = frozenset(BUILT_IN.values())
"""Schemes that look at `cut` only."""


def scheme_of(name: str, where: str) -> Scheme:
    """The scheme of that name. Raises ConfigError with the nearest name."""
    if name in BUILT_IN:
        return BUILT_IN[name]
    points = {point.name: point for point in metadata.entry_points(group=GROUP)}
    if name not in points:
        known = [*BUILT_IN, *points]
        near = difflib.get_close_matches(name, known, 1, 0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(known)} (more through the entry-point group {GROUP})"
        raise ConfigError(f"{where}: unknown checksum scheme {name!r}; {hint}")
    try:
        scheme: Scheme = points[name].load()
    except Exception as error:  # noqa: BLE001 - a third party's module
        raise ConfigError(f"{where}: checksum scheme {name!r} cannot be loaded: {type(error).__name__}: {error}") from None
    return scheme


class Guarded(NamedTuple):
    """A checksum in a payload: where, and of what. first, last: bytes that it fills wholly (first > last: none); mask: its bits, little
    endian over the payload.
    """

    scheme: Scheme
    first: int
    last: int
    mask: int
    bits_mask: int
    prefix: bytes
    arbitration_id: int
    data_id: int

    def expected(self, payload: bytes) -> int:
        """The checksum that this payload should have; its own bits in it don't matter."""
        if self.first <= self.last:
            cut = self.prefix + payload[: self.first] + payload[self.last + 1 :]
            if self.scheme in _CUT:
                return self.scheme(Covered(cut, payload, self.arbitration_id, self.data_id)) & self.bits_mask
        zeroed = (int.from_bytes(payload, "little") & ~self.mask).to_bytes(len(payload), "little")
        if self.first > self.last:
            cut = self.prefix + zeroed
        return self.scheme(Covered(cut, zeroed, self.arbitration_id, self.data_id)) & self.bits_mask


def guarded(scheme: Scheme, mask: int, length: int, arbitration_id: int, data_id: int) -> Guarded:
    """mask: the checksum's bits, as an integer over the payload, little endian. length: how many."""
    whole = [k for k in range(64) if mask >> (8 * k) & 0xFF == 0xFF]
    filled = length % 8 == 0 and len(whole) == length // 8
    first, last = (whole[0], whole[-1]) if filled else (1, 0)
    prefix = b"" if data_id < 0 else data_id.to_bytes(1 if data_id < 256 else 2, "little")
    return Guarded(scheme, first, last, mask, (1 << length) - 1, prefix, arbitration_id, data_id)
