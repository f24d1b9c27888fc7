"""Feeds the CAN transport's decoder with frames that nobody should send, and holds every observation against what the bytes say.

    python tools/fuzz_can.py [--inputs N] [--seed S] [--quick] [--json]

What the bytes say is told by others: the records by struct, the numbers by cantools, the checksums by crccheck. A *lie* is an observation
with a number that no frame of the right length, with the right checksum, inside the DBC's range, has said. A crash is an exception.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import struct
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import cantools
from crccheck.crc import Crc8SaeJ1850
from s2r_can.records import Record, key_of, packed
from s2r_can.testing import CLASSIC, INPUTS, STATES, WIDE, Robot, options_of
from s2r_can.transport import CanTransport

from s2r_runtime.messages import Command, Frame, Observation

ROOT = Path(__file__).parent.parent
HEADER = struct.Struct("<QIBB")
REMEMBERED = 20_000
ANEW = 200
"""Inputs to one decoder: one that has believed a clock from the future waits for it, and tries little until then."""


class Result(NamedTuple):
    """lies: what was accepted and not said, with the input's number."""

    inputs: int
    records: int
    observations: int
    faults: int
    lies: list[str]


class Said:
    """What good frames have said of each state, of late; by cantools and crccheck, not by the transport."""

    def __init__(self, dbc: str, signals: dict[str, str], checksums: dict[str, str]) -> None:
        db: Any = cantools.database.load_string(dbc, database_format="dbc")
        self._messages = {key_of(m.frame_id, extended=m.is_extended_frame): m for m in db.messages}
        self._by_message: dict[str, list[tuple[str, str]]] = {}
        for state, signal in signals.items():
            message, _, name = signal.partition(".")
            self._by_message.setdefault(message, []).append((state, name))
        self._checksums = checksums
        self._order: dict[str, deque[float]] = {state: deque() for state in signals}
        self._values: dict[str, set[float]] = {state: set() for state in signals}

    def take(self, data: bytes) -> int:
        """Remembers what these bytes say. Returns the number of records."""
        at = count = 0
        while len(data) - at >= HEADER.size:
            _, key, _, length = HEADER.unpack_from(data, at)
            at += HEADER.size
            if length > 64 or length > len(data) - at:
                break
            self._frame(key, data[at : at + length])
            at += length
            count += 1
        return count

    def _frame(self, key: int, payload: bytes) -> None:
        message = self._messages.get(key)
        if message is None or message.name not in self._by_message or len(payload) != message.length:
            return
        if message.name in self._checksums and payload[-1] != Crc8SaeJ1850.calc(payload[:-1]):
            return
        values = message.decode(payload, decode_choices=False)
        for state, name in self._by_message[message.name]:
            signal, value = message.get_signal_by_name(name), float(values[name])
            if not math.isfinite(value) or abs(value) > 1e9:
                continue
            if signal.minimum is not None and not signal.minimum - 1e-9 <= value <= signal.maximum + 1e-9:
                continue
            factor = math.pi / 180.0 if signal.unit == "deg" else 1.0
            order, known = self._order[state], self._values[state]
            if value * factor not in known:
                order.append(value * factor)
                known.add(value * factor)
                if len(order) > REMEMBERED:
                    known.discard(order.popleft())

    def knows(self, state: str, value: float) -> bool:
        """Whether that was said of it."""
        return value in self._values[state]


class Source:
    """Inputs: a robot's own frames, and what becomes of them."""

    def __init__(self, dbc: str, draw: random.Random) -> None:
        self._robot, self._draw, self._wide = Robot({}, dbc), draw, dbc is WIDE
        self._seq, self._now_ns = 0, 10**9
        self._pool: list[Record] = []

    def true_period(self) -> list[Record]:
        """The next observation as a sound robot sends it."""
        self._seq += 1
        x = tuple(self._draw.uniform(-3.0, 3.0) for _ in STATES)
        found = [
            Record(0, key_of(m.arbitration_id, extended=m.is_extended_id), 0, bytes(m.data))
            for m in self._robot.frames(self._seq, self._seq * 10_000_000, x)
        ]
        self._pool = [*self._pool[-200:], *found]
        return found

    def input(self) -> bytes:
        """One input: a period of frames with anything done to it, or none of that."""
        draw = self._draw
        period = self.true_period() if draw.random() < 0.6 or not self._pool else draw.sample(self._pool, min(3, len(self._pool)))
        if draw.random() < 0.5:
            period = [frame for record in period for frame in (self._spoilt(record) if draw.random() < 0.5 else [record])]
        if draw.random() < 0.1:
            draw.shuffle(period)
        data = b""
        for record in period:
            self._now_ns += draw.choice((0, 1000, 100_000, 3_000_000, 10_000_000))
            stamp = self._now_ns if draw.random() < 0.99 else draw.randrange(self._now_ns + 10**6)
            data += packed(record._replace(stamp_ns=stamp))
        roll = draw.random()
        if roll < 0.03:
            return data[: draw.randrange(len(data) + 1)]
        if roll < 0.06:
            cut = bytearray(data or b"\0")
            for _ in range(draw.randint(1, 4)):
                cut[draw.randrange(len(cut))] = draw.randrange(256)
            return self._in_time(bytes(cut))
        if roll < 0.07:
            return draw.randbytes(draw.randrange(80))
        return data

    def _in_time(self, data: bytes) -> bytes:
        """As it is, unless its stamp would be years ahead: from then on everything else would be late, and nothing more would be tried."""
        if len(data) >= 8 and struct.unpack_from("<Q", data)[0] > self._now_ns + 10**9:
            return struct.pack("<Q", self._now_ns) + data[8:]
        return data

    def _spoilt(self, record: Record) -> list[Record]:
        draw, payload = self._draw, record.payload
        match draw.randrange(9):
            case 0:
                bits = int.from_bytes(payload, "little")
                for _ in range(draw.randint(1, 5)):
                    bits ^= 1 << draw.randrange(8 * len(payload))
                return [record._replace(payload=bits.to_bytes(len(payload), "little"))]
            case 1:
                return [record._replace(payload=draw.randbytes(draw.choice((0, 1, 7, 8, 12, 48, 64))))]
            case 2:
                return [record, record]
            case 3:
                return []
            case 4:
                return [record, draw.choice(self._pool)]
            case 5:  # a well-formed lie of the robot's own: random content under a right checksum
                body = draw.randbytes(len(payload) - 1)
                return [record._replace(payload=body + bytes([Crc8SaeJ1850.calc(body)]))]
            case 6:
                return [record._replace(key=draw.choice((record.key ^ 1 << draw.randrange(32), draw.randrange(1 << 32))))]
            case 7 if self._wide:
                special = struct.pack("<d", draw.choice((math.nan, math.inf, -math.inf, 1e300, -1e10, 5e-324)))
                body = special + payload[8:-1]
                return [record._replace(payload=body + bytes([Crc8SaeJ1850.calc(body)]))]
            case _:
                return [record]


def fuzz(inputs: int, seed: int, dbc: str = CLASSIC) -> Result:
    """Feeds so many inputs to decoders, a fresh one now and then."""
    draw = random.Random(seed)
    options = options_of(dbc, {"interface": "virtual"})
    said = Said(dbc, options["states"], options["checksums"])
    records_ = observations = faults = 0
    lies: list[str] = []
    transport, source = CanTransport(options, STATES, INPUTS), Source(dbc, draw)
    for number in range(inputs):
        if number % ANEW == 0:
            transport, source = CanTransport(options, STATES, INPUTS), Source(dbc, draw)
        data = source.input()
        records_ += said.take(data)
        channel = "robot" if draw.random() < 0.97 else draw.choice(("controllers", "copy", "robot ", ""))
        for message in transport.decode(Frame(0, channel, data)):
            if isinstance(message, Observation) and not message.fault:
                observations += 1
                lies += [
                    f"input {number}: {name} is {value!r}"
                    for name, value in zip(STATES, message.x, strict=True)
                    if not said.knows(name, value)
                ]  # fmt: skip
            elif isinstance(message, Observation):
                faults += 1
            elif isinstance(message, Command) and not message.fault and not all(map(math.isfinite, message.u)):
                lies.append(f"input {number}: a command of {message.u}")
    return Result(inputs, records_, observations, faults, lies)


def main() -> int:
    """Exit 1 if anything was accepted that nobody said."""
    parser = argparse.ArgumentParser(description="fuzzes the CAN transport's decoder")
    parser.add_argument("--inputs", type=int, default=1_000_000, help="(default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a smoke run: 20 000 inputs")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    told, lies = {}, []
    for name, dbc in (("classic", CLASSIC), ("fd", WIDE)):
        begin = time.process_time()
        found = fuzz((20_000 if args.quick else args.inputs) // 2, args.seed, dbc)
        told[name] = {**found._asdict(), "lies": len(found.lies), "crashes": 0, "cpu_s": round(time.process_time() - begin, 1)}
        lies += found.lies[:5]
        if not args.json:
            print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in told[name].items()), flush=True)
    if args.json:
        print(json.dumps(told))
    for lie in lies:
        print(lie, file=sys.stderr)
    return 1 if lies else 0


if __name__ == "__main__":
    sys.exit(main())
