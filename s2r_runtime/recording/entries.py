"""The messages of a log, one by one, out of blocks that were checked."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from s2r_runtime.errors import RecordingError
from s2r_runtime.messages import Struct
from s2r_runtime.recording.blocks import Part
from s2r_runtime.recording.channels import CHANNELS, decoder


class Entry(msgspec.Struct, frozen=True, gc=False):
    """One message. `index`: its number in the run (over all parts); raw: its bytes as recorded."""

    index: int
    channel: str
    log_time_ns: int
    raw: bytes

    @property
    def message(self) -> Struct:
        """The message, decoded each time it is asked for. Raises RecordingError if it is of another version, or no message at all."""
        try:
            return decoder(self.channel).decode(self.raw)
        except (ValueError, RecursionError) as error:  # msgspec's and Unicode's are ValueErrors
            raise RecordingError(f"message {self.index} ({self.channel}) is of another version of s2r: {error}") from None


class Checked(NamedTuple):
    """What is left of a block once it was checked. first: its first message's number in the run; end: where it ends in the file."""

    first: int
    end: int
    content: bytes
    messages: Sequence[Part]


def entries(block: Checked, topics: Mapping[int, str], wanted: Collection[str], counts: dict[str, int], path: Path) -> Iterator[Entry]:
    """A block's messages on the wanted channels. counts: all of them are added to it, by channel. Raises RecordingError."""
    content = block.content
    for number, (channel, _, log_time_ns, start, stop) in enumerate(block.messages, block.first):
        name = topics.get(channel, "")
        counts[name] = counts.get(name, 0) + 1
        if name in wanted:
            yield Entry(number, name, log_time_ns, content[start:stop])
        elif name not in CHANNELS:
            raise RecordingError(f"{path}: message {number} is on channel {name!r}, which this version does not know")
