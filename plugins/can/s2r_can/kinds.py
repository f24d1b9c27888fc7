"""Which kind of CAN log a file is, by its first bytes: what `Offer.recognises` names. Names of files decide nothing here.

candump   most of the first lines are frames as candump writes or prints them, with a time stamp or without
ASC       a line `base hex` or `base dec`, or the beginning of a trigger block (Vector)
BLF       "LOGG" (Vector)
TRC       comments with `;`, among them the file's version, its start time or its ruler (PCAN)
CSV       the header row of python-can's writer
SavvyCAN  a header row with the columns that SavvyCAN and GVRET loggers write
SQLite    a database whose schema has python-can's table
"""

from __future__ import annotations

import re

from s2r_can import savvycan

CANDUMP, ASC, BLF, TRC, CSV, SAVVYCAN, SQLITE = "candump", "ASC", "BLF", "TRC", "CSV", "SavvyCAN", "SQLite"
LINES = 40
"""So many lines of a text are looked at."""
SHARE = 0.5
HEADER = b"timestamp,arbitration_id,extended,remote,error,dlc,data"

_ANSI = re.compile(rb"\x1b\[[0-9;]*m")
_FRAME = re.compile(
    rb"\s*(?:\([^()]{1,40}\)\s+)?\S{1,16}\s+(?:[TR]X(?:\s+[-BE])*\s+)?(?:[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})(?:#|\s+[\[{]\s*\w+[\]}])"
)
_BASE = re.compile(rb"^\s*(?:base\s+(?:hex|dec)\b|begin\s+triggerblock\b)", re.IGNORECASE | re.MULTILINE)
_RULER = re.compile(rb"^;(?:\$FILEVERSION\s*=|\s+Start time\b|-+\+[-+ ]+)", re.MULTILINE)
_SCHEMA = re.compile(rb"CREATE TABLE\s+\"?messages\"?\s*\([^)]*arbitration_id", re.IGNORECASE | re.DOTALL)


def is_candump(head: bytes) -> bool:
    """Whether most of its first lines are frames."""
    if b"\0" in head:
        return False
    lines = [line for line in _ANSI.sub(b"", head).splitlines()[:LINES] if line.strip() and not line.startswith(b"#")]
    return bool(lines) and sum(_FRAME.match(line) is not None for line in lines) > SHARE * len(lines)


def is_asc(head: bytes) -> bool:
    """Whether its first lines are those of a Vector ASC."""
    return b"\0" not in head and _BASE.search(b"\n".join(head.splitlines()[:LINES])) is not None


def is_blf(head: bytes) -> bool:
    """Whether it is a Vector BLF."""
    return head.startswith(b"LOGG")


def is_trc(head: bytes) -> bool:
    """Whether it is a PCAN trace."""
    head = head.removeprefix(b"\xef\xbb\xbf")
    return head.startswith(b";") and b"\0" not in head and _RULER.search(head.replace(b"\r", b"")) is not None


def is_csv(head: bytes) -> bool:
    """Whether it is a table of frames by python-can."""
    first = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0]
    return first.strip().lower() == HEADER


def is_savvycan(head: bytes) -> bool:
    """Whether it is a table of frames by SavvyCAN."""
    return savvycan.is_header(head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0].decode("latin-1"))


def is_sqlite(head: bytes) -> bool:
    """Whether it is a database of frames by python-can."""
    return head.startswith(b"SQLite format 3\0") and _SCHEMA.search(head) is not None


KINDS = {CANDUMP: is_candump, ASC: is_asc, BLF: is_blf, TRC: is_trc, CSV: is_csv, SAVVYCAN: is_savvycan, SQLITE: is_sqlite}
SUFFIXES = {".log": CANDUMP, ".asc": ASC, ".blf": BLF, ".trc": TRC, ".csv": CSV, ".db": SQLITE}


def kind_of(head: bytes, suffix: str) -> str:
    """The kind of a log; where the content shows none, the one of its suffix (its reader reports what is wrong), else candump."""
    return next((kind for kind, fits in KINDS.items() if fits(head)), SUFFIXES.get(suffix, CANDUMP))
