"""Whose MCAP file it is, by its first record. Logs of this software and robots' own recordings (rosbag2) have the same suffix.

magic 8 | opcode 1 (header) | its length u64 | length u32, profile | length u32, library | ...      little endian; https://mcap.dev/spec
"""

from __future__ import annotations

import struct
from pathlib import Path

MAGIC = b"\x89MCAP0\r\n"
OURS = "s2r-runtime log"
"""What the library of every version of this software's logs begins with."""
_HEAD = struct.Struct("<BQI")
_TEXT_MAX = 256


def other_writer(path: Path) -> str:
    """Who wrote an MCAP file that is no log of this software, in words; empty for a log, for what is no MCAP file, and for one that can't
    be read.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC) + _HEAD.size + 2 * _TEXT_MAX)
    except OSError:
        return ""
    if not start.startswith(MAGIC) or len(start) < len(MAGIC) + _HEAD.size:
        return ""
    opcode, _, length = _HEAD.unpack_from(start, len(MAGIC))
    at = len(MAGIC) + _HEAD.size
    profile, rest = start[at : at + length], start[at + length :]
    if opcode != 1 or length > _TEXT_MAX or len(rest) < 4:
        return ""
    library = rest[4 : 4 + min(int.from_bytes(rest[:4], "little"), _TEXT_MAX)].decode("utf-8", "replace")
    if library.startswith(OURS):
        return ""
    kind = profile.decode("utf-8", "replace")
    return f"{'profile ' + repr(kind) if kind else 'no profile'}, written by {library or 'nobody knows what'!r}"
