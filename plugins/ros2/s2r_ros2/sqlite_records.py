"""The messages of a bag in SQLite (`.db3`), in the order of recording: ros2/rosbag2, rosbag2_storage_sqlite3.

    topics    id, name, type, serialization_format, ...        messages  id, topic_id, timestamp (ns), data
    message_definitions (from Iron on)  topic_type, encoding, encoded_message_definition

SQLite reads page by page, so memory does not grow with the file. Compressed as a file (`.db3.zstd`, `.db3.gz`) it is unpacked beside the
temporary files first. A file that was cut is read as far as its pages are there; the rest is counted as broken.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Container, Iterator
from contextlib import closing
from pathlib import Path

import zstandard

from s2r_ros2.records import PAYLOAD_BYTES, ZSTD, Channel, Definition, Message, kind_of, unpacked
from s2r_runtime.errors import RecordingError, one_line
from s2r_runtime.recordings.formats.sizes import content_of

SQLITE = b"SQLite format 3\0"
GZIP = b"\x1f\x8b"
UNPACKED_BYTES = 1 << 36
"""Of a file that is unpacked, at most."""
_ROWS = "SELECT topic_id, timestamp, data FROM messages WHERE length(data) <= ? {} ORDER BY timestamp"


class SqliteBag:
    """A bag in one SQLite file (`records.Messages`)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: dict[Channel, int] = {}
        self.definitions: dict[str, Definition] = {}
        self.broken = 0
        self.cut = False

    def messages(self, only: Container[str] | None = None) -> Iterator[Message]:
        """Messages of these topics (None: of all), in the order of their recording. Raises RecordingError for what is no such bag."""
        try:
            with _plain(self.path) as plain, closing(_connected(plain)) as database:
                channels = self._described(database)
                yield from self._rows(database, channels, only)
        except sqlite3.Error as error:
            if not any(self.counts.values()):
                raise RecordingError(f"{self.path}: this ROS 2 bag (SQLite) cannot be read: {one_line(str(error))}") from None
            self.cut = True
        except (OSError, EOFError, zstandard.ZstdError) as error:
            why = getattr(error, "strerror", None) or one_line(str(error))
            raise RecordingError(f"{self.path}: cannot be read: {why}") from None

    def _described(self, database: sqlite3.Connection) -> dict[int, Channel]:
        tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise RecordingError(f"{self.path}: is an SQLite database, and no ROS 2 bag (it lacks the tables topics and messages)")
        if "message_definitions" in tables:
            for kind, language, text in database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                self.definitions[kind_of(str(kind))] = Definition(str(language), str(text))
        found = {}
        for number, name, kind, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
            found[int(number)] = Channel(str(name), kind_of(str(kind)), str(encoding))
            self.counts.setdefault(found[int(number)], 0)
        return found

    def _rows(self, database: sqlite3.Connection, channels: dict[int, Channel], only: Container[str] | None) -> Iterator[Message]:
        chosen = [number for number, channel in channels.items() if only is None or channel.topic in only]
        for number, channel in channels.items():
            if number not in chosen:
                self.counts[channel] += database.execute("SELECT count(*) FROM messages WHERE topic_id = ?", (number,)).fetchone()[0]
        which = "" if len(chosen) == len(channels) else f"AND topic_id IN ({','.join(map(str, chosen))})"
        for number, t_ns, data in database.execute(_ROWS.format(which), (PAYLOAD_BYTES,)):
            of = channels.get(number) if isinstance(number, int) else None
            if of is None or not isinstance(t_ns, int) or not isinstance(data, bytes):
                self.broken += 1
                continue
            self.counts[of] += 1
            try:
                yield Message(of, t_ns, unpacked(data))
            except ValueError:
                self.broken += 1


def _connected(path: Path) -> sqlite3.Connection:
    """Read only; a recorder's journal beside the file (`-wal`) is looked at where the folder allows it."""
    where = path.absolute().as_uri()
    wal = path.with_name(path.name + "-wal").exists()
    try:
        found = sqlite3.connect(f"{where}?mode=ro" + ("" if wal else "&immutable=1"), uri=True)
        found.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError:
        found = sqlite3.connect(f"{where}?mode=ro&immutable=1", uri=True)
    found.execute("PRAGMA trusted_schema = OFF")
    return found


class _plain:  # noqa: N801 - a context manager
    """The file itself, or, where it is compressed as a whole, an unpacked copy for as long as it is read."""

    def __init__(self, path: Path) -> None:
        self._path, self._folder = path, None if not self._packed(path) else tempfile.TemporaryDirectory(prefix="s2r-bag-")

    @staticmethod
    def _packed(path: Path) -> bool:
        with path.open("rb") as file:
            return file.read(4).startswith((GZIP, ZSTD))

    def __enter__(self) -> Path:
        if self._folder is None:
            return self._path
        target = Path(self._folder.name) / "bag.db3"
        with content_of(self._path) as packed, target.open("wb") as out:
            room = min(UNPACKED_BYTES, shutil.disk_usage(self._folder.name).free // 2)
            while block := packed.read(1 << 20):
                room -= len(block)
                if room < 0:
                    raise RecordingError(f"{self._path}: its unpacked content does not fit among the temporary files")
                out.write(block)
        return target

    def __exit__(self, *_: object) -> None:
        if self._folder is not None:
            self._folder.cleanup()
