"""CDR as ROS 2 has it on the wire: XCDR version 1, plain (OMG DDS-XTypes 1.3, 7.4; DDSI-RTPS 2.5, 10).

    encapsulation   2 bytes: 00 00 big endian, 00 01 little endian; 2 bytes of options, then the body
    number          of n bytes at a multiple of n from the body's start; what lies between is not looked at
    string          uint32 length with the terminating zero, the bytes, the zero (length 0: empty, as some writers have it)
    sequence        uint32 count, the elements;  array: its elements

The body ends where the message does, or up to three bytes later at a multiple of four (CycloneDDS pads to that). Anything else is
`Malformed`: other encapsulations (parameter lists, XCDR version 2), lengths beyond the payload, what is left over.
"""

from __future__ import annotations

import struct

ENCAPSULATION = 4
PAYLOAD_MAX = 262_144
"""Bytes. A transform message of a robot with a thousand frames stays below."""
TEXT_MAX = 256
"""Bytes of a frame's name."""
ORDERS = {b"\0\0": ">", b"\0\1": "<"}
BIG, LITTLE = b"\0\0\0\0", b"\0\1\0\0"


class Malformed(ValueError):
    """A payload that isn't what it should be; the message says why, in a few words of this package's own."""


class Reader:
    """Takes a payload apart, from its start. Raises Malformed."""

    def __init__(self, data: bytes) -> None:
        if len(data) > PAYLOAD_MAX:
            raise Malformed(f"{len(data)} bytes, must be at most {PAYLOAD_MAX}")
        order = ORDERS.get(data[:2])
        if len(data) < ENCAPSULATION or order is None:
            raise Malformed(f"encapsulation {data[:4].hex() or 'missing'}, must be plain CDR (0000 or 0001)")
        self._data, self._order, self._at = data, order, ENCAPSULATION

    @property
    def left(self) -> int:
        """Bytes that were not taken yet."""
        return len(self._data) - self._at

    def numbers(self, kinds: str, size: int) -> tuple[float, ...]:
        """Numbers of `size` bytes each, as struct names them (`6d`)."""
        layout = struct.Struct(self._order + kinds)
        at = self._at + (ENCAPSULATION - self._at) % size
        if layout.size > len(self._data) - at:
            raise Malformed("it ends too early")
        self._at = at + layout.size
        return layout.unpack_from(self._data, at)

    def doubles(self, count: int) -> tuple[float, ...]:
        """So many float64."""
        return self.numbers(f"{count}d", 8)

    def uint32(self) -> int:
        """One uint32."""
        return int(self.numbers("I", 4)[0])

    def boolean(self) -> bool:
        """One bool."""
        (value,) = self.numbers("B", 1)
        if value not in (0, 1):
            raise Malformed(f"a bool is {value}, must be 0 or 1")
        return value == 1

    def text(self) -> str:
        """One string."""
        length = self.uint32()
        if length > self.left:
            raise Malformed(f"a string of {length} bytes, of which {self.left} are there")
        if length > TEXT_MAX:
            raise Malformed(f"a string of {length} bytes, must be at most {TEXT_MAX}")
        raw = self._data[self._at : self._at + length]
        self._at += length
        if length and raw.find(0) != length - 1:
            raise Malformed("a string that does not end with its only zero")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError:
            raise Malformed("a string that is not UTF-8") from None

    def stamp(self) -> int:
        """builtin_interfaces/Time as ns."""
        sec, nanosec = self.numbers("iI", 4)
        if sec < 0 or nanosec >= 1_000_000_000:
            raise Malformed(f"a stamp of {sec} s and {nanosec} ns")
        return int(sec) * 1_000_000_000 + int(nanosec)

    def end(self) -> None:
        """Checks that the payload ends here."""
        if self.left not in (0, (ENCAPSULATION - self._at) % 4):
            raise Malformed(f"{self.left} bytes are left over")


class Writer:
    """Puts a payload together; `big`: big endian."""

    def __init__(self, *, big: bool = False) -> None:
        self._order = ">" if big else "<"
        self._data = bytearray(BIG if big else LITTLE)

    def numbers(self, kinds: str, size: int, *values: float) -> Writer:
        """Numbers of `size` bytes each, as struct names them."""
        self._data += bytes((ENCAPSULATION - len(self._data)) % size) + struct.pack(self._order + kinds, *values)
        return self

    def doubles(self, *values: float) -> Writer:
        """float64."""
        return self.numbers(f"{len(values)}d", 8, *values)

    def text(self, value: str) -> Writer:
        """One string."""
        raw = value.encode() + b"\0"
        self.numbers("I", 4, len(raw))
        self._data += raw
        return self

    def stamp(self, t_ns: int) -> Writer:
        """builtin_interfaces/Time."""
        return self.numbers("iI", 4, t_ns // 1_000_000_000, t_ns % 1_000_000_000)

    def done(self) -> bytes:
        """The payload."""
        return bytes(self._data)
