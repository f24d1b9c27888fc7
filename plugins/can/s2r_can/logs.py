"""CAN logs as others write them: candump (`-l`, `-L`, or what it prints with `-ta`), ASC and BLF; each also packed with gzip.

A log that ends in the middle of a frame is read up to there: that is what a computer leaves that lost its power. A candump line that is
none is skipped if there are few of them.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, BinaryIO, NamedTuple, cast

from s2r_can.records import ERROR, EXTENDED, REMOTE
from s2r_runtime.errors import RecordingError

ODD_SHARE = 0.01
"""Of the lines that may be no frames: a log in which more are is not one, or not only."""
_COMPACT = re.compile(r"\(\s*(\d+(?:\.\d+)?)\s*\)\s+(\S+)\s+([0-9A-Fa-f]{3,8})#(#[0-9A-Fa-f])?([Rr]?)([0-9A-Fa-f.]*)(?:\s+[TR])?\s*$")
_SPELLED = re.compile(r"\(\s*(\d+(?:\.\d+)?)\s*\)\s+(\S+)\s+(?:[TR]X(?:\s+[-BE])*\s+)?([0-9A-Fa-f]{3,8})\s+\[(\d+)\]\s*(.*)$")
_UNSTAMPED = re.compile(r"\s*(\S+)\s+([0-9A-Fa-f]{3,8})(#|\s+\[\d+\])")


class LogFrame(NamedTuple):
    """t: s, as the log counts. channel: as the log calls it. key: identifier with its flags (`records`)."""

    t: float
    channel: str
    key: int
    payload: bytes


def read_frames(path: Path) -> Iterator[LogFrame]:
    """The log's frames, in its order. Raises RecordingError."""
    suffix = Path(path.name.lower().removesuffix(".gz")).suffix
    try:
        with _opened(path) as file:
            if suffix == ".log":
                yield from _candump(path, file)
            else:
                yield from _by_python_can(path, file, suffix)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: is not a whole gzip file: {error}") from None


def _opened(path: Path) -> IO[bytes]:
    if path.name.lower().endswith(".gz"):
        return gzip.open(path)  # type: ignore[return-value]
    return path.open("rb")


def _candump(path: Path, file: IO[bytes]) -> Iterator[LogFrame]:
    odd: list[int] = []
    first, frames, number = "", 0, 0
    for number, raw in enumerate(file, start=1):
        line = raw.decode("ascii", "replace").strip()
        if not line or line.startswith("#"):
            continue
        frame = _compact(line) or _spelled(line)
        if frame is None:
            if raw.endswith(b"\n"):  # else the log ends in the middle of a frame
                first = first or line
                odd.append(number)
            continue
        frames += 1
        yield frame
    if not frames or len(odd) > max(1.0, ODD_SHARE * number):
        raise RecordingError(f"{path}: {_what_is_wrong(odd, first, frames)}")


def _what_is_wrong(odd: list[int], first: str, frames: int) -> str:
    if not odd:
        return "holds no CAN frame"
    if _UNSTAMPED.match(first):
        return f"line {odd[0]} has no time stamp: {first[:60]!r}; record with candump -l or candump -ta"
    many = f"{len(odd)} lines are no candump lines, the first" if frames else "is no candump log: line"
    return f"{many}{'' if not frames else ' is line'} {odd[0]}: {first[:60]!r}"


def _compact(line: str) -> LogFrame | None:
    """`(1436509052.249713) can0 123#DEADBEEF`, `...##1...` for CAN FD."""
    found = _COMPACT.match(line)
    if found is None:
        return None
    stamp, channel, identifier, fd, remote, digits = found.groups()
    digits = digits.replace(".", "")
    if len(digits) % 2 or len(digits) > 128 or (not fd and not remote and len(digits) > 16):
        return None
    key = _key(identifier)
    if key is None:
        return None
    return LogFrame(float(stamp), channel, key | REMOTE if remote else key, b"" if remote else bytes.fromhex(digits))


def _spelled(line: str) -> LogFrame | None:
    """`(1436509052.249713)  can0  123   [4]  DE AD BE EF`, as candump prints it."""
    found = _SPELLED.match(line)
    if found is None:
        return None
    stamp, channel, identifier, length, rest = found.groups()
    key = _key(identifier)
    if key is None:
        return None
    if rest.startswith("remote"):
        return LogFrame(float(stamp), channel, key | REMOTE, b"")
    words = rest.split()[: int(length)]
    try:
        payload = bytes.fromhex("".join(words))
    except ValueError:
        return None
    return LogFrame(float(stamp), channel, key, payload) if len(payload) == int(length) <= 64 else None


def _key(identifier: str) -> int | None:
    """As candump writes them: three digits for a standard identifier, eight for an extended one or an error frame."""
    number = int(identifier, 16)
    if len(identifier) == 3:
        return number if number <= 0x7FF else None
    if len(identifier) != 8:
        return None
    return number & 0x1FFFFFFF | ERROR if number & ERROR else (number & 0x1FFFFFFF) | EXTENDED


def _by_python_can(path: Path, file: IO[bytes], suffix: str) -> Iterator[LogFrame]:
    """ASC and BLF."""
    import io

    import can

    frames = 0
    try:
        for message in (
            can.BLFReader(cast(BinaryIO, file)) if suffix == ".blf" else can.ASCReader(io.TextIOWrapper(file, "utf-8", "replace"))
        ):
            frames += 1
            if message.is_error_frame:
                continue
            key = message.arbitration_id | (EXTENDED if message.is_extended_id else 0) | (REMOTE if message.is_remote_frame else 0)
            yield LogFrame(message.timestamp, str(message.channel), key, bytes(message.data))
    except Exception as error:  # noqa: BLE001 - its readers raise what they like at bytes that are none of theirs
        if not frames or file.read(1):  # what was read last is not the file's end: it is damaged, not cut
            said = " ".join(str(error).split())[:120] or type(error).__name__
            raise RecordingError(f"{path}: cannot be read as {suffix[1:].upper()} after {frames} frames: {said}") from None
    if not frames:
        raise RecordingError(f"{path}: holds no CAN frame")
