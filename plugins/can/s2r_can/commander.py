"""Commands -> CAN frames. The bytes depend on the command, on what was encoded before, and on the copies that were repeated (which come
back through `decode`), so that an audit makes the same ones.

Every frame that leaves takes the next value of its counter, a repeated copy too; the checksum is made last.
"""

from __future__ import annotations

import math

from s2r_can.layout import Layout, Outbound
from s2r_can.records import FD, FD_LENGTHS, Record, packed
from s2r_runtime.messages import Command


class Commander:
    """inputs: the model's names."""

    def __init__(self, layout: Layout, inputs: tuple[str, ...]) -> None:
        self._outbound, self._inputs = layout.outbound, inputs
        self._counts = {out.key: 0 for out in layout.outbound}
        self._raw: dict[int, tuple[int, int]] | None = None

    def encode(self, command: Command) -> bytes:
        """The frames that make the robot apply the command, as records. Raises ValueError if they can't."""
        if len(command.u) != len(self._inputs):
            raise ValueError(f"command has {len(command.u)} inputs, must have {len(self._inputs)}: {', '.join(self._inputs)}")
        if not all(map(math.isfinite, command.u)):
            raise ValueError(f"command is {command.u}, must be finite")
        raw = {index: self._placed(out, command.u) for index, out in enumerate(self._outbound)}
        self._raw = raw
        data = self._frames()
        self.repeated()
        return data

    def copy(self) -> bytes:
        """The last command once more, with counters that go on. They count only when these bytes come back through `repeated`."""
        return self._frames() if self._raw is not None else b""

    def repeated(self) -> None:
        """A copy left."""
        for out in self._outbound:
            modulus = out.counter.modulus if out.counter is not None else 1
            self._counts[out.key] = (self._counts[out.key] + 1) % modulus

    def _placed(self, out: Outbound, u: tuple[float, ...]) -> tuple[int, int]:
        little, big = out.base
        for index, signal in out.inputs:
            try:
                more = signal.bits.placed(signal.raw_of(u[index]))
            except ValueError as error:
                raise ValueError(f"{self._inputs[index]} is {u[index]:g}: {error}") from None
            little, big = little | more[0], big | more[1]
        return little, big

    def _frames(self) -> bytes:
        assert self._raw is not None  # noqa: S101 - both callers saw to it
        data, counts = [], dict(self._counts)
        for index, out in enumerate(self._outbound):
            little, big = self._raw[index]
            if out.counter is not None:
                more = out.counter.bits.placed(counts[out.key])
                little, big = little | more[0], big | more[1]
                counts[out.key] = (counts[out.key] + 1) % out.counter.modulus
            payload = _payload(out, little, big)
            if out.checksum is not None:
                bits, guard = out.checksum
                more = bits.placed(guard.expected(payload))
                payload = _payload(out, little | more[0], big | more[1])
            if out.fd:
                payload = payload.ljust(next(n for n in FD_LENGTHS if n >= out.length), b"\0")
            data.append(packed(Record(0, out.key, FD if out.fd else 0, payload)))
        return b"".join(data)


def _payload(out: Outbound, little: int, big: int) -> bytes:
    whole = little | int.from_bytes(big.to_bytes(out.length, "big"), "little")
    return whole.to_bytes(out.length, "little")
