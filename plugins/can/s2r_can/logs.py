"""CAN logs as others write them: candump, Vector ASC and BLF, PCAN TRC, the CSV of python-can and of SavvyCAN, each also packed with
gzip; python-can's SQLite.

Their content shows which kind it is (`kinds`). A log that ends in the middle of a frame, as where power failed, is read up to there.
A few lines that cannot be read are left out and counted (`tally`); many refuse the log.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from s2r_can import binaries, candump, savvycan, texts
from s2r_can.kinds import BLF, CANDUMP, SAVVYCAN, SQLITE, kind_of
from s2r_can.records import LogFrame
from s2r_can.tally import Tally
from s2r_runtime.errors import RecordingError
from s2r_runtime.recordings.formats.sizes import content_of
from s2r_runtime.recordings.robot_logs import head_of, suffix_of

LINE_MAX = 4096
"""Characters of a line: a CAN FD frame in any of the formats has less than 400."""


def read_frames(path: Path, tally: Tally | None = None) -> Iterator[LogFrame]:
    """The log's frames, in its order. tally: takes what was left out. Raises RecordingError."""
    tally = Tally() if tally is None else tally
    try:
        kind = kind_of(head_of(path), suffix_of(path))
        if kind in {SQLITE, BLF}:
            yield from (binaries.sqlite if kind == SQLITE else binaries.blf)(path, tally)
            return
        with content_of(path) as file:
            if kind == CANDUMP:
                yield from candump.frames(path, _lines(file), tally)
            elif kind == SAVVYCAN:
                yield from savvycan.frames(path, _lines(file), tally)
            else:
                logging.getLogger("can.io").setLevel(logging.CRITICAL)  # what it would print about lines is counted here
                yield from texts.frames(path, kind, _lines(file), tally)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: is not a whole gzip file: {error}") from None


def _lines(file: IO[bytes]) -> Iterator[tuple[int, str]]:
    """(number, text with its end): UTF-8 with or without a mark, or whatever it is; a line that has no end in sight is cut into several."""
    number, first = 0, True
    while raw := file.readline(LINE_MAX):
        number += 1
        if first:
            raw, first = raw.removeprefix(b"\xef\xbb\xbf"), False
        text = raw.decode("latin-1")
        yield number, text if text.endswith("\n") or len(raw) < LINE_MAX else text + "\n"
