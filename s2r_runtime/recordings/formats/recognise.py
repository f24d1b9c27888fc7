"""What a file is, by its first bytes (a folder: by what is in it); its name decides nothing.

    ULog       55 4c 6f 67 01 12 35                          PX4 ULog file format
    DataFlash  a3 95 80, the message that describes itself (as text: FMT, 128, 89, FMT)   ArduPilot, libraries/AP_Logger/LogStructure.h
    ROS 1 bag  "#ROSBAG V"                                   wiki.ros.org/Bags/Format/2.0
    MF4, MDF   "MDF     ", "UnFinMF "                        ASAM MDF 3 and 4, identification block
    Parquet    "PAR1"                                        parquet.apache.org
    MATLAB     "MATLAB 5.0 MAT-file", "MATLAB 7.3 MAT-file" (which is HDF5, as 7.0 is), or the header of version 4
    rosbag2    an MCAP file of others, or SQLite with the tables `topics` and `messages`; or a folder of them

A file that is not one of these is a table, or a log that a transport's plug-in reads (`robot_logs`).
"""

from __future__ import annotations

import re
import sqlite3
import struct
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from s2r_runtime.errors import RecordingError, UsageError
from s2r_runtime.plugins import registry
from s2r_runtime.recording.origin import other_writer
from s2r_runtime.recordings.formats.isolated import IsolatedFile
from s2r_runtime.recordings.formats.series import Opened

HEAD_BYTES = 512
SQLITE, ZSTD, GZIP, HDF5 = b"SQLite format 3\0", b"\x28\xb5\x2f\xfd", b"\x1f\x8b", b"\x89HDF\r\n\x1a\n"
BAG_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
BAG = "bag"
"""Reader of ROS bags: the plug-in of ROS 2 offers it, and for logs of its robots a recording reader of that suffix."""
MAT4_TYPES = 5000
"""Type words of a version 4 MAT-file are below this: MOPT, four decimal digits."""


class Form(NamedTuple):
    """A kind of file. name: of the reader among the offers of `s2r_formats`; what: in words; install: what its reader needs."""

    name: str
    what: str
    install: str


ULOG = Form("ulog", "a PX4 ULog", "s2r-runtime[formats]")
DATAFLASH = Form("dataflash", "an ArduPilot DataFlash log", "s2r-mavlink")
ROSBAG1 = Form(BAG, "a ROS 1 bag", "s2r-ros2[formats]")
ROSBAG2 = Form(BAG, "a ROS 2 bag", "s2r-ros2[formats]")
MDF = Form("mdf", "an MF4 (ASAM MDF) measurement file", "s2r-runtime[formats]")
PARQUET = Form("parquet", "a Parquet file", "s2r-runtime[formats]")
LEROBOT = Form("parquet", "a folder of Parquet files", "s2r-runtime[formats]")
MATLAB = Form("matlab", "a MATLAB file", "s2r-runtime")

_MAGIC: tuple[tuple[bytes, Form], ...] = (
    (b"ULog\x01\x12\x35", ULOG),
    (b"\xa3\x95\x80", DATAFLASH),
    (b"FMT, 128, 89, FMT,", DATAFLASH),
    (b"#ROSBAG V", ROSBAG1),
    (b"MDF     ", MDF),
    (b"UnFinMF ", MDF),
    (b"PAR1", PARQUET),
    (b"MATLAB 5.0 MAT-file", MATLAB),
    (b"MATLAB 7.", MATLAB),
)

_MARKUP = re.compile(rb"(\xef\xbb\xbf)?\s*<(!doctype|html|head|\?xml)\b", re.IGNORECASE)
_JSON = re.compile(rb"(\xef\xbb\xbf)?\s*(\{\s*[\"}]|\[\s*[\[{\"])")
_UNREAD: tuple[tuple[Callable[[bytes], bool], str], ...] = (
    (lambda head: head.startswith(HDF5), "is an HDF5 file, which is not read; write its series as CSV, Parquet or a MATLAB file (-v7)"),
    (lambda head: head.startswith(SQLITE), "is an SQLite database, and no ROS 2 bag (it lacks the tables topics and messages)"),
    (lambda head: head.startswith(b"PK\x03\x04"), "is a ZIP archive (.xlsx, .npz and .zip are); unpack it, or write its table as CSV"),
    (lambda head: head.startswith(b"\x93NUMPY"), "is a NumPy array, whose columns have no names; write it as CSV with a header row"),
    (lambda head: head.startswith(b"ARROW1"), "is an Arrow IPC (Feather) file, which is not read; write it as Parquet"),
    (lambda head: head.startswith((b"7z\xbc\xaf", b"BZh", b"\xfd7zXZ")), "is compressed; unpack it first"),
    (lambda head: head.startswith(b"%PDF"), "is a PDF document, no recording"),
    (lambda head: head.startswith(b"version https://git-lfs"), "is a pointer of Git LFS, not the file itself; git lfs pull fetches that"),
    (lambda head: _MARKUP.match(head) is not None, "is a web page (or XML), no recording; was the file itself downloaded?"),
    (lambda head: _JSON.match(head) is not None, "is JSON, which is not read; write its series as CSV with a header row"),
    (lambda head: head.startswith((b"\xff\xfe", b"\xfe\xff")) and b"\0" in head, "is text in UTF-16, must be UTF-8; save it as CSV UTF-8"),
)


def recognised(path: Path) -> Form | None:
    """What the file or folder is; None for a table, a log of this software, and what a transport's plug-in reads. Raises RecordingError
    for a folder that holds no recording, and for what is known and not read.
    """
    if path.is_dir():
        return _folder(path)
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    for magic, form in _MAGIC:
        if head.startswith(magic):
            return form
    if head.startswith(SQLITE) and _is_bag_database(path):
        return ROSBAG2
    if other_writer(path) or (head.startswith(ZSTD) and path.name.lower().endswith((".mcap.zstd", ".db3.zstd", ".zstd"))):
        return ROSBAG2
    if head.startswith(GZIP) and path.name.lower().endswith((".mcap.gz", ".db3.gz")):
        return ROSBAG2
    if _is_mat4(head, path):
        return MATLAB
    for matches, why in _UNREAD:
        if matches(head):
            raise RecordingError(f"{path}: {why}")
    return None


def open_recording(path: Path, form: Form | None = None, options: Mapping[str, Any] | None = None) -> Opened:
    """The file, opened by its reader. options: of the reader, such as the file that describes the messages (`Offer.files`).

    Raises UsageError with the command that helps where the reader or its library is missing.
    """
    form = form or recognised(path)
    if form is None:
        raise UsageError(f"{path}: is not one of the formats that have named signals; a table and a robot's own log are read as they are")
    if form.name not in registry().names("formats"):
        raise not_installed(path, form)
    try:
        found: Opened = (
            registry().get("formats", form.name)(path) if form.name == BAG else IsolatedFile(path, form.name, form.what, options)
        )
    except ImportError as error:
        raise not_installed(path, form, error) from None
    return found


def not_installed(path: Path, form: Form, error: ImportError | None = None) -> UsageError:
    """What the file is, and the command that installs its reader. error: what its import raised, if it is there and lacks a library."""
    lacks = "" if error is None else f" ({error.name or error} is missing)"
    return UsageError(f"{path}: this is {form.what}; pip install '{form.install}'{lacks}")


def _folder(path: Path) -> Form:
    try:
        names = sorted(entry.name.lower() for entry in path.iterdir())
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if "metadata.yaml" in names or any(name.endswith(BAG_SUFFIXES) for name in names):
        return ROSBAG2
    if any(name.endswith(".parquet") for name in names) or next(path.glob("data/**/*.parquet"), None) is not None:
        return LEROBOT
    raise RecordingError(
        f"{path}: is a folder; it must be a ROS 2 bag (metadata.yaml and .mcap or .db3 files) or a LeRobot data set (data/.../*.parquet)"
    )


def _is_bag_database(path: Path) -> bool:
    """Whether an SQLite file has a bag's two tables (tables: a view could run for ever)."""
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            found = database.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages')").fetchall()
    except sqlite3.Error:
        return path.name.lower().endswith(".db3")  # damaged: its reader says how
    return len(found) == 2


def _is_mat4(head: bytes, path: Path) -> bool:
    """Version 4 has no magic: five words (type, rows, columns, imaginary, length of the name) and the name, which ends with a zero."""
    if len(head) < 21 or not path.name.lower().endswith(".mat"):
        return False
    for order in "<>":
        kind, rows, columns, imaginary, length = struct.unpack_from(f"{order}5i", head)
        if 0 <= kind < MAT4_TYPES and rows >= 0 and columns >= 0 and imaginary in (0, 1) and 0 < length < 64:
            return head[20 + length - 1 : 20 + length] == b"\0"
    return False
