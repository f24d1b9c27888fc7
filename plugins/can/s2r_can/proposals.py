"""What others would like the robot to do: command frames on the controllers' side, decoded to be logged and refused."""

from __future__ import annotations

from s2r_can.bits import Part, reader, selected
from s2r_can.layout import Layout
from s2r_can.records import records
from s2r_runtime.messages import Command, Frame


class Proposals:
    """A command may be spread over several frames: each of them makes one proposal, with the newest values of the others."""

    def __init__(self, layout: Layout, inputs: tuple[str, ...]) -> None:
        self._values = [0.0] * len(inputs)
        self._frames = [
            (out, reader(Part((), tuple(s for _, s in out.inputs), tuple(i for i, _ in out.inputs)))) for out in layout.outbound
        ]  # fmt: skip
        self._count = 0

    def decode(self, frame: Frame, obs_seq: int) -> list[Command]:
        """obs_seq: of the newest observation, as nothing on the bus says what a command answers."""
        found: list[Command] = []
        try:
            for record in records(frame.data):
                wrong = self._read(record.key, record.payload)
                self._count += 1
                u = () if wrong else tuple(self._values)
                found.append(Command(self._count, frame.arrival_ns, "external", u, max(0, obs_seq), 0, fault=wrong))
        except ValueError as error:
            found.append(Command(self._count, frame.arrival_ns, "external", (), max(0, obs_seq), 0, fault=f"malformed: {error}"))
        return found

    def _read(self, key: int, payload: bytes) -> str:
        """What is wrong with it, or empty."""
        for out, read in self._frames:
            if out.key == key and len(payload) >= out.length and selected(out.selectors, payload[: out.length]):
                data = payload[: out.length]
                return read(int.from_bytes(data, "little"), int.from_bytes(data, "big"), self._values)
        return "malformed: too short, or of no branch that holds an input"
