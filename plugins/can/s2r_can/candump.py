"""What candump writes (`-l`, `-L`) and prints (`-ta`, `-tA`, `-tz`; with `-x`, `-a`, `-c`, `-i`, `-S`, `-8`, `-e`).

python-can's reader knows the first form only, takes most error frames for data frames, and fails at CAN FD flags beyond 9:
so these are read here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from s2r_can.records import ERROR, EXTENDED, PAYLOAD_MAX, REMOTE, LogFrame
from s2r_can.tally import SHOWN, Tally
from s2r_runtime.errors import RecordingError

_STAMP = r"\(\s*(\d+(?:\.\d+)?|\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(?:\.\d+)?)\s*\)"
_COMPACT = re.compile(_STAMP + r"\s+(\S+)\s+([0-9A-Fa-f]{3,8})#(#[0-9A-Fa-f])?([Rr]?)([0-9A-Fa-f._]*)(?:\s+[TR])?\s*$")
_SPELLED = re.compile(_STAMP + r"\s+(\S+)\s+(?:[TR]X(?:\s+[-BE])*\s+)?([0-9A-Fa-f]{3,8})\s+([\[{])(\w+)[\]}]\s*(.*)$")
_UNSTAMPED = re.compile(r"\s*(\S+)\s+(?:[TR]X(?:\s+[-BE])*\s+)?([0-9A-Fa-f]{3,8})(#|\s+[\[{]\w+[\]}])")
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_BITS = re.compile(r"[01]{8}")
_BYTE = re.compile(r"[0-9A-Fa-f]{2}")


def frames(path: Path, lines: Iterator[tuple[int, str]], tally: Tally) -> Iterator[LogFrame]:
    """The frames, in the log's order. lines: (number, text with its end). Raises RecordingError."""
    number, after_error, unstamped = 0, False, ""
    for number, text in lines:
        line = _COLOUR.sub("", text).strip()
        if not line or line.startswith("#"):
            continue
        frame = _compact(line) or _spelled(line)
        if frame is not None:
            tally.frames += 1
            after_error = bool(frame.key & ERROR)
            yield frame
        elif after_error and text[0].isspace():
            continue  # candump -e explains an error frame on lines of their own
        elif text.endswith("\n"):
            if not tally.odd and _UNSTAMPED.match(line):
                unstamped = f"line {number} has no time stamp: {line[:SHOWN]!r}; record with candump -l or candump -ta"
            tally.unreadable(number, line)
        else:
            tally.left_out["line that was cut at the log's end"] += 1
    if unstamped and tally.odd > tally.frames:
        raise RecordingError(f"{path}: {unstamped}")
    tally.check(path, "candump", number)


def _compact(line: str) -> LogFrame | None:
    """`(1436509052.249713) can0 123#DEADBEEF`, `...##1...` for CAN FD, `_B` behind a data length code above 8."""
    found = _COMPACT.match(line)
    if found is None:
        return None
    stamp, channel, identifier, fd, remote, digits = found.groups()
    digits = digits.partition("_")[0].replace(".", "")
    if len(digits) % 2 or len(digits) > 128 or (not fd and not remote and len(digits) > 16):
        return None
    t, key = _seconds(stamp), _key(identifier)
    if key is None or t is None:
        return None
    return LogFrame(t, channel, key | REMOTE if remote else key, b"" if remote else bytes.fromhex(digits))


def _spelled(line: str) -> LogFrame | None:
    """`(1436509052.249713)  can0  123   [4]  DE AD BE EF`, as candump prints it; `[04]` for CAN FD."""
    found = _SPELLED.match(line)
    if found is None:
        return None
    stamp, channel, identifier, bracket, length, rest = found.groups()
    t, key = _seconds(stamp), _key(identifier)
    if key is None or t is None:
        return None
    if rest.startswith("remote"):
        return LogFrame(t, channel, key | REMOTE, b"")
    if bracket == "{":  # a data length code of 9 to F, which means 8 bytes (candump -8)
        size = 8 if length in "9ABCDEF" else -1
    else:
        size = int(length) if length.isdecimal() and int(length) <= PAYLOAD_MAX else -1
    payload = _payload(rest, size)
    return LogFrame(t, channel, key, payload) if payload is not None else None


def _payload(text: str, size: int) -> bytes | None:
    """Bytes in hexadecimal or as bits; with grave accents between them the last byte comes first (`candump -S`)."""
    if size < 0:
        return None
    swapped = "`" in text.split("'", 1)[0]
    words = (text.replace("`", " ") if swapped else text).split()[:size]
    if len(words) != size:
        return None
    if words and all(_BITS.fullmatch(word) for word in words):
        payload = bytes(int(word, 2) for word in words)
    elif all(_BYTE.fullmatch(word) for word in words):
        payload = bytes.fromhex("".join(words))
    else:
        return None
    return payload[::-1] if swapped else payload


def _seconds(stamp: str) -> float | None:
    """A stamp, s; a date counts as UTC, since a log does not hold its time zone."""
    if "-" not in stamp:
        return float(stamp) if len(stamp) < 32 else None
    try:
        return datetime.fromisoformat(stamp).replace(tzinfo=UTC).timestamp()
    except ValueError:
        return None


def _key(identifier: str) -> int | None:
    """As candump writes them: three digits for a standard identifier, eight for an extended one or an error frame."""
    number = int(identifier, 16)
    if len(identifier) == 3:
        return number if number <= 0x7FF else None
    if len(identifier) != 8:
        return None
    return number & 0x1FFFFFFF | ERROR if number & ERROR else (number & 0x1FFFFFFF) | EXTENDED
