"""DBC files at random: little and big endian, signed, floats, scaled, CAN FD, multiplexed once and twice, extended identifiers."""

from __future__ import annotations

import random
from typing import NamedTuple

FD = (12, 16, 20, 24, 32, 48, 64)


class Placed(NamedTuple):
    """A signal as a line of DBC. bits: those of the payload that it takes, numbered byte * 8 + bit."""

    name: str
    line: str
    bits: frozenset[int]


def taken_by(start: int, length: int, *, big: bool) -> list[int]:
    """Bits of a signal, as DBC numbers them."""
    found = []
    bit = start
    for _ in range(length):
        found.append(bit)
        bit = bit + 1 if not big else (bit - 1 if bit % 8 else bit + 15)
    return found


class Dbc:
    """`text`, and the names of its messages. seed names it."""

    def __init__(self, seed: int, messages: int = 4) -> None:
        self._draw = random.Random(seed)
        self._floats: list[str] = []
        self._ranges: list[str] = []
        body = [self._message(number) for number in range(messages)]
        head = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A B\n'
        self.text = "\n\n".join([head, *body, "\n".join(self._ranges), "\n".join(self._floats)]) + "\n"

    def _message(self, number: int) -> str:
        draw = self._draw
        size = draw.choice((1, 2, 4, 8, 8, 8, draw.choice(FD)))
        identifier = 0x100 + number if draw.random() < 0.7 else 0x80000000 + 0x18F00000 + number
        used: set[int] = set()
        kind = draw.choice(("plain", "plain", "multiplexed", "nested")) if size >= 4 else "plain"
        if kind == "plain":
            lines = self._signals(identifier, size, used, draw.randint(1, 6), "")
        elif kind == "multiplexed":
            lines = self._branches(identifier, size, used, "M", "M", 0)
        else:
            lines = self._branches(identifier, size, used, "M", "M", 1)
            lines += self._signals(identifier, size, used, 1, "")
        return "\n".join([f"BO_ {identifier} Message{number}: {size} A", *lines])

    def _branches(self, identifier: int, size: int, used: set[int], name: str, mark: str, depth: int) -> list[str]:
        """A multiplexer and its branches; the bits that all of them take are taken for good."""
        draw = self._draw
        selector = self._place(name, size, used, mark, length=draw.choice((2, 3, 4)), integer=True)
        if selector is None:
            return self._signals(identifier, size, used, 1, "" if mark == "M" else mark.rstrip("M"))
        used |= selector.bits
        lines, everything = [selector.line], set(used)
        for value in draw.sample(range(4), 3):
            here = set(used)
            if depth and draw.random() < 0.6:
                nested = self._branches(identifier, size, here, f"{name}{value}", f"m{value}M", 0)
                self._ranges.append(f"SG_MUL_VAL_ {identifier} {name}{value} {name} {value}-{value};")
                lines += nested
            else:
                lines += self._signals(identifier, size, here, draw.randint(1, 3), f"m{value}", of=name if depth or name != "M" else "")
            everything |= here
        used |= everything
        return lines

    def _signals(self, identifier: int, size: int, used: set[int], count: int, mark: str, of: str = "") -> list[str]:
        lines = []
        for _ in range(count):
            placed = self._place(f"S{self._draw.randrange(10**9)}", size, used, mark)
            if placed is None:
                continue
            used |= placed.bits
            lines.append(placed.line)
            if "@FLOAT" in placed.line:
                lines[-1] = placed.line.replace("@FLOAT", "")
                self._floats.append(f"SIG_VALTYPE_ {identifier} {placed.name} : {1 if len(placed.bits) == 32 else 2};")
            if of:
                value = mark.strip("mM")
                self._ranges.append(f"SG_MUL_VAL_ {identifier} {placed.name} {of} {value}-{value};")
        return lines

    def _place(self, name: str, size: int, used: set[int], mark: str, *, length: int = 0, integer: bool = False) -> Placed | None:
        """A signal where nothing is yet, or None if none was found."""
        draw = self._draw
        for _ in range(30):
            real = not integer and draw.random() < 0.25
            bits = length or (draw.choice((32, 64)) if real else draw.choice((1, 3, 7, 8, 10, 12, 16, 17, 24, 31, 32, 40)))
            big = draw.random() < 0.5
            start = draw.randrange(8 * size)
            found = taken_by(start, bits, big=big)
            if max(found) >= 8 * size or used & set(found):
                continue
            signed = not integer and draw.random() < 0.5
            scale = 1 if integer else draw.choice((1, 0.1, 0.01, 2, -0.5, 1e-6, 0.0625, 1 / 3))
            offset = 0 if integer else draw.choice((0, 0, -40, 0.5, 1000))
            text = f' SG_ {name} {mark} : {start}|{bits}@{0 if big else 1}{"-" if signed or real else "+"} ({scale},{offset}) [0|0] "" B'
            return Placed(name, text + ("@FLOAT" if real else ""), frozenset(found))
        return None
