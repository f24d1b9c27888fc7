"""Text logs through python-can's readers: PCAN TRC, Vector ASC, python-can's CSV.

The reader gets the log's header and then its lines, one by one, so that it is known which line made which frame. A line that makes it fail
costs that line only: a new reader gets the header again, and what follows. What python-can does not do is done here:

    TRC   a version that it does not know is read as 1.0, whose columns are others: refused
    ASC   stamps are taken as they stand, whatever the header says of them: relative ones are added up here (each counts from the line
          before, whatever that is); a line with a negative stamp is skipped: it gets the line without the sign; the first line behind a
          header without `internal events logged` is lost: the header that it gets has that; `TxRq` (a request to send) is taken for a frame
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

from s2r_can.kinds import ASC, CSV, TRC
from s2r_can.records import LogFrame, frame_of
from s2r_can.tally import Tally
from s2r_runtime.errors import RecordingError, one_line

TRC_VERSIONS = ("1.1", "1.3", "2.0", "2.1")
_ASC_STAMP = re.compile(r"\s*(-?)(\d{1,12}(?:\.\d{0,12})?)(?=\s)")
_ASC_BASE = re.compile(r"\s*base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.IGNORECASE)
_ASC_FRAME = re.compile(r"\s*-?\d+\.?\d*\s+(?:\d+\s+\w+\s+(?:Tx|Rx)\s|CANFD\s)", re.IGNORECASE)
_REQUEST = re.compile(r"\s+TxRq\b", re.IGNORECASE)
Numbered = tuple[int, str]


class _Lines:
    """A text file for python-can: the header, then the log's lines. `waiting`: the line given last, until it made a frame."""

    def __init__(self, header: list[str], body: Iterator[Numbered], unused: Callable[[int, str], None]) -> None:
        self._header, self._body, self._unused = iter(header), body, unused
        self.waiting: Numbered | None = None
        self.ended = False

    def __iter__(self) -> _Lines:
        return self

    def __next__(self) -> str:
        for line in self._header:
            return line
        self.account()
        self.waiting = next(self._body, None)
        if self.waiting is None:
            self.ended = True
            raise StopIteration
        return self.waiting[1]

    def account(self) -> None:
        """The line given last made no frame."""
        if self.waiting is not None:
            self._unused(*self.waiting)
        self.waiting = None

    def read(self, _size: int = -1) -> str:
        """There for python-can's check of what is a file."""
        return ""

    write = read

    def close(self) -> None:
        """Nothing to do: who opened the log closes it."""


def frames(path: Path, kind: str, lines: Iterator[Numbered], tally: Tally) -> Iterator[LogFrame]:
    """The frames, in the log's order. lines: (number, text with its end). Raises RecordingError."""
    form = {TRC: _Trc, ASC: _Asc, CSV: _Csv}[kind](path, lines, tally)
    while True:
        given = _Lines(form.header, form.body(), form.unused)
        try:
            for message in form.reader(given):
                number, line = given.waiting or (0, "")
                given.waiting = None
                frame = frame_of(message, form.stamp(message))
                if frame is None:
                    tally.unreadable(number, line)
                    continue
                tally.frames += 1
                yield frame
        except Exception as error:  # noqa: BLE001 - python-can's readers raise what they like at a line that is none of theirs
            if given.waiting is None:  # it failed at the header, and so will the next one
                said = one_line(str(error), 120) or type(error).__name__
                raise RecordingError(f"{path}: cannot be read as {kind}: its header is wrong: {said}") from None
            tally.unreadable(*given.waiting)
            given.waiting = None
            if not given.ended:
                continue
        break
    tally.check(path, kind, form.number)


class _Form:
    """A kind of text log: its header, as python-can is to get it, and its lines."""

    def __init__(self, path: Path, lines: Iterator[Numbered], tally: Tally) -> None:
        self.header: list[str] = []
        self.number = 0
        self._path, self._lines, self._tally = path, lines, tally

    def body(self) -> Iterator[Numbered]:
        """The lines behind the header that are not empty. One that was cut at the log's end is none."""
        for number, line in self._lines:
            self.number = number
            if not line.endswith("\n"):
                self._tally.left_out["line that was cut at the log's end"] += 1
            elif line.strip():
                yield number, line

    def reader(self, given: _Lines) -> Any:
        """python-can's, of these lines."""
        raise NotImplementedError

    def unused(self, number: int, line: str) -> None:
        """A line that made no frame."""
        self._tally.unreadable(number, line)

    def stamp(self, message: Any) -> float:
        """When the frame came, s."""
        return float(message.timestamp)


class _Trc(_Form):
    def __init__(self, path: Path, lines: Iterator[Numbered], tally: Tally) -> None:
        super().__init__(path, lines, tally)
        for number, line in lines:
            if line.strip() and not line.lstrip().startswith(";"):
                self._lines = chain([(number, line)], lines)
                break
            self.header.append(line)
        version = next((line.partition("=")[2].strip() for line in self.header if line.startswith(";$FILEVERSION")), "")
        if version and version not in TRC_VERSIONS:
            known = ", ".join(TRC_VERSIONS)
            raise RecordingError(
                f"{path}: is a PCAN trace of version {version}; 1.0, {known} are read (PCAN-View and PEAK-Converter write them)"
            )

    def reader(self, given: _Lines) -> Any:
        import can

        return can.TRCReader(given)  # type: ignore[arg-type]

    def unused(self, number: int, line: str) -> None:
        words = line.split()
        if line.lstrip().startswith(";"):
            return
        if any(word in ("ST", "EC", "ER", "EV", "Error", "Warng", "Event", "FFFFFFFF") for word in words[1:5]):
            self._tally.left_out["events of the bus or the adapter"] += 1
        else:
            self._tally.unreadable(number, line)


class _Csv(_Form):
    def __init__(self, path: Path, lines: Iterator[Numbered], tally: Tally) -> None:
        super().__init__(path, lines, tally)
        self.header = [line for _, line in [next(lines, (0, ""))]]

    def reader(self, given: _Lines) -> Any:
        import can

        return can.CSVReader(given)  # type: ignore[arg-type]


class _Asc(_Form):
    def __init__(self, path: Path, lines: Iterator[Numbered], tally: Tally) -> None:
        super().__init__(path, lines, tally)
        base, self._relative, self._t = "hex", False, 0.0
        for number, line in lines:
            found = _ASC_BASE.match(line)
            if found is not None:
                base, self._relative = found[1].lower(), (found[2] or "").lower() == "relative"
            elif _ASC_STAMP.match(line):
                self._lines = chain([(number, line)], lines)
                break
        self.header = [f"base {base}  timestamps absolute\n", "internal events logged\n"]
        if self._relative:
            tally.said.append("its time stamps are relative: each counts from the line before it")

    def reader(self, given: _Lines) -> Any:
        import can

        return can.ASCReader(given)  # type: ignore[arg-type]

    def body(self) -> Iterator[Numbered]:
        """As above; without signs, the stamps being noted."""
        for number, line in super().body():
            found = _ASC_STAMP.match(line)
            if found is None:
                self.unused(number, line)
                continue
            stamp = float(found[1] + found[2])
            self._t = self._t + stamp if self._relative else stamp
            if _REQUEST.search(line):
                self._tally.left_out["requests to send"] += 1
                continue
            yield number, line[found.end(1) :]

    def unused(self, number: int, line: str) -> None:
        if _ASC_FRAME.match(line):
            self._tally.unreadable(number, line)
        elif _ASC_STAMP.match(line) and "start of measurement" not in line.lower():
            self._tally.left_out["events that are no CAN frame"] += 1

    def stamp(self, message: Any) -> float:
        return self._t if math.isfinite(message.timestamp) else message.timestamp
