"""Logs are read, decompressed and checked in a process of its own, ahead of what is done with their messages.

It reads the files one after the other, and sends the blocks that it found sound; attachments and metadata that stand before a block come
with it. It is ahead by what a pipe holds, so memory does not grow with the log. Whoever asks gets the very entries that the reading
would have given, and after the last one the reading is as if it had been iterated here.
"""

from __future__ import annotations

import multiprocessing
import pickle
import traceback
from array import array
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain
from multiprocessing.connection import Connection
from typing import Any

from s2r_runtime.errors import S2RError
from s2r_runtime.recording.entries import Checked, Entry, entries
from s2r_runtime.recording.layout import Attached
from s2r_runtime.recording.reading import Reading

WORTH_BYTES = 4_000_000
"""Of all files together: less is read sooner than a process begins and ends."""
SENT_BYTES = 200_000
"""Of messages, sent at once: some 800 of them. Fewer cost more turns, more only memory."""
FIELDS = 5
"""Numbers that say where a message is (`blocks.Part`)."""


class Ahead:
    """The process, for all readings, which are asked for in the order given. Without one, where that is not worth it, the same."""

    def __init__(self, readings: Sequence[Reading]) -> None:
        self._pipe: Connection | None = None
        if sum(reading.size for reading in readings) < WORTH_BYTES:
            return
        forking = multiprocessing.get_context("fork")  # what is loaded here need not be loaded again
        self._pipe, theirs = forking.Pipe(duplex=False)
        self._process = forking.Process(target=_read, args=(theirs, self._pipe, readings), daemon=True)
        self._process.start()
        theirs.close()

    def entries(self, reading: Reading) -> Iterator[Entry]:
        """All of the next reading. Raises what reading it raised."""
        if self._pipe is None:
            return iter(reading)
        return self._received(reading, self._pipe)

    def close(self) -> None:
        """Ends it, whatever it is doing."""
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
            self._process.kill()
            self._process.join()

    def _received(self, reading: Reading, pipe: Connection) -> Iterator[Entry]:
        while True:
            try:
                kind, told = pickle.loads(pipe.recv_bytes())  # noqa: S301 - from the process that was forked here
            except (EOFError, OSError):
                kind, told = "failed", "the process died"
            match kind:
                case "blocks":
                    for first, end, content, places, topics, attachments in told:
                        reading.follow(end, topics, attachments)
                        numbers = iter(array("Q", places))
                        block = Checked(first, end, content, list(zip(*[numbers] * FIELDS, strict=True)))
                        yield from entries(block, reading.topics, reading.wanted, reading.counts, reading.path)
                case "over":
                    reading.adopt(told)
                    return
                case "raised":
                    raise told
                case _:
                    raise RuntimeError(f"{reading.path} could not be read: {told}")


def _read(pipe: Connection, mains: Connection, readings: Sequence[Reading]) -> None:
    mains.close()  # or this process would not see that the other one is gone
    try:
        for reading in readings:
            _read_one(pipe, reading)
    except (OSError, S2RError) as error:
        with suppress(OSError):  # it was the other process that went
            _tell(pipe, "raised", error)
    except BaseException:  # noqa: BLE001 - told to the other process, which fails with it
        _tell(pipe, "failed", traceback.format_exc())


def _read_one(pipe: Connection, reading: Reading) -> None:
    blocks: list[tuple[int, int, bytes, bytes, dict[int, str], list[Attached]]] = []
    size = attached = declared = 0
    for block in reading.blocks():
        topics = {} if len(reading.topics) == declared else dict(reading.topics)
        places = array("Q", chain.from_iterable(block.messages)).tobytes()
        blocks.append((block.first, block.end, block.content, places, topics, reading.attachments[attached:]))
        attached, declared = len(reading.attachments), len(reading.topics)
        size += len(block.content)
        if size >= SENT_BYTES:
            _tell(pipe, "blocks", blocks)
            blocks, size = [], 0
    _tell(pipe, "blocks", blocks)
    _tell(pipe, "over", reading.found())


def _tell(pipe: Connection, kind: str, told: Any) -> None:
    pipe.send_bytes(pickle.dumps((kind, told), pickle.HIGHEST_PROTOCOL))
