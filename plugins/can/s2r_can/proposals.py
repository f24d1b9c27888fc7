"""Command frames of others, read back: proposals on the controllers' side, to be logged and refused, and what a log says was commanded."""

from __future__ import annotations

import math

from s2r_can.bits import Part, reader, selected
from s2r_can.layout import Layout
from s2r_can.records import records
from s2r_runtime.messages import Command, Frame


class CommandReader:
    """Reads inputs out of command frames."""

    def __init__(self, layout: Layout, inputs: tuple[str, ...]) -> None:
        self._nu = len(inputs)
        self._frames = [
            (out, reader(Part((), tuple(s for _, s in out.inputs), tuple(i for i, _ in out.inputs)))) for out in layout.outbound
        ]  # fmt: skip

    def read(self, key: int, payload: bytes) -> tuple[list[float], str]:
        """((nu,) inputs, NaN for those that the frame does not hold; what is wrong with it, or empty)."""
        values = [math.nan] * self._nu
        for out, read in self._frames:
            if out.key != key or len(payload) < out.length:
                continue
            data = payload[: out.length]
            if not selected(out.selectors, data):
                continue
            little, big = int.from_bytes(data, "little"), int.from_bytes(data, "big")
            if out.checksum is not None:
                bits, guard = out.checksum
                if ((big if bits.big else little) >> bits.shift) & bits.mask != guard.expected(data):
                    return values, f"{out.name} has a wrong checksum"
            return values, read(little, big, values)
        return values, "too short, or of no branch that holds an input"


class Proposals:
    """A command may be spread over several frames: each of them makes one proposal, with the newest values of the others."""

    def __init__(self, layout: Layout, inputs: tuple[str, ...]) -> None:
        self._reader = CommandReader(layout, inputs)
        self._values = [0.0] * len(inputs)
        self._count = 0

    def decode(self, frame: Frame, obs_seq: int) -> list[Command]:
        """obs_seq: of the newest observation, as nothing on the bus says what a command answers."""
        found: list[Command] = []
        try:
            for record in records(frame.data):
                values, wrong = self._reader.read(record.key, record.payload)
                self._values = [old if math.isnan(new) else new for old, new in zip(self._values, values, strict=True)]
                found.append(self._said(frame, obs_seq, wrong))
        except ValueError as error:
            found.append(self._said(frame, obs_seq, str(error)))
        return found

    def _said(self, frame: Frame, obs_seq: int, wrong: str) -> Command:
        self._count += 1
        u, fault = ((), f"malformed: {wrong}") if wrong else (tuple(self._values), "")
        return Command(self._count, frame.arrival_ns, "external", u, max(0, obs_seq), 0, fault=fault)
