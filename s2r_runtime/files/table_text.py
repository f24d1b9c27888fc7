"""Lines of a text file, plain or packed with gzip, read in constant memory and refused where it cannot be a recording.

A recording is a regular file: it is read more than once, so a pipe or a device is refused before it is opened. Bytes are counted and
hashed as they are read. Each limit is stated in the error that it raises, with the option that moves it.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import stat
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from s2r_runtime.errors import RecordingError

Progress = Callable[[float, float], None]
"""(bytes read, bytes of the file)."""

GB = 1e9
CHUNK_BYTES = 1 << 20
MAX_LINE_BYTES = 1 << 20
"""A table of a thousand columns has lines of some 20 kB."""
MAX_RATIO, WINDOW_BYTES = 100.0, 8 << 20
"""Text to packed size beyond which a gzip file is no recording, in any window of so much text: stamps and noisy numbers pack 2 to 20
times. At most that much is parsed before a file of another kind is refused."""


@dataclass(frozen=True)
class Limits:
    """text_bytes: largest text, unpacked; `max_ratio`: of text to packed size, None where the person set `text_bytes` on purpose."""

    text_bytes: float = 4.0 * GB
    max_ratio: float | None = MAX_RATIO


def limits_of(max_gb: float | None) -> Limits:
    """The limits that `--max-gb` sets; the defaults for None."""
    return Limits() if max_gb is None else Limits(max_gb * GB, None)


def refuse_special(path: Path) -> None:
    """Raises RecordingError for a pipe or a device, which may block or never end when it is opened."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):  # who opens it says so
        return
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        return
    kind = "a pipe" if stat.S_ISFIFO(mode) else "a device" if stat.S_ISCHR(mode) or stat.S_ISBLK(mode) else "no regular file"
    raise RecordingError(f"{path}: is {kind}, must be a regular file (write the recording to one first)")


def check_regular(path: Path) -> int:
    """Size of a regular file, bytes. Raises RecordingError for what is missing, a folder, a pipe or a device."""
    refuse_special(path)
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if stat.S_ISDIR(status.st_mode):
        raise RecordingError(f"{path}: is a folder, must be a file")
    return status.st_size


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, `sha256:` and 64 hex digits (guarantee G6). Raises RecordingError."""
    check_regular(path)
    try:
        with path.open("rb") as file:
            return "sha256:" + hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None


class TextLines:
    """Iterates over the lines of a file, with their ends. Raises RecordingError, one line, as the module says.

    `has_odd`: whether an underscore or a character beyond ASCII was in the text so far. `digest`: SHA-256 of the file's bytes, once all
    lines were read.
    """

    def __init__(self, path: Path, limits: Limits | None = None, progress: Progress | None = None) -> None:
        self.path = path
        self.has_odd = False
        self._limits = limits or Limits()
        self._progress = progress
        self._size = check_regular(path)
        self._hash = hashlib.sha256()
        self._packed_bytes = self._text_bytes = self._newlines = 0
        self._window = (0, 0)
        """Bytes of text and packed bytes where the window begins whose ratio is checked next."""

    @property
    def digest(self) -> str:
        """`sha256:` and 64 hex digits."""
        return "sha256:" + self._hash.hexdigest()

    def __iter__(self) -> Iterator[str]:
        encoding = "utf-8-sig"
        for block in self._blocks():
            if (place := block.find(b"\0")) >= 0:
                line = self._newlines + block.count(b"\n", 0, place) + 1
                raise RecordingError(f"{self.path}: line {line}: holds a zero byte, is no table, and of no format that is known here")
            try:
                text = block.decode(encoding)
            except UnicodeDecodeError as error:
                line = self._newlines + block.count(b"\n", 0, error.start) + 1
                raise RecordingError(f"{self.path}: line {line}: not UTF-8 text (byte {block[error.start]:#04x})") from None
            encoding = "utf-8"
            self.has_odd = self.has_odd or "_" in text or not text.isascii()
            yield from io.StringIO(text, newline="")
            self._newlines += block.count(b"\n")

    def _blocks(self) -> Iterator[bytes]:
        """Blocks of whole lines."""
        rest = b""
        for chunk in self._chunks():
            rest += chunk
            cut = rest.rfind(b"\n") + 1 or rest.rfind(b"\r", 0, -1) + 1  # a file of an old Mac has no \n; a last \r may be half of \r\n
            if cut:
                yield rest[:cut]
                rest = rest[cut:]
            if len(rest) > MAX_LINE_BYTES or b"\0" in rest:
                if b"\0" not in rest:
                    raise RecordingError(
                        f"{self.path}: line {self._newlines + 1}: is longer than {MAX_LINE_BYTES >> 20} MB, so this is no table of rows"
                    )
                yield rest
        if rest:
            yield rest

    def _chunks(self) -> Iterator[bytes]:
        """The text's bytes."""
        try:
            with self.path.open("rb") as file:
                packed = file.read(2) == b"\x1f\x8b" or self.path.suffix == ".gz"
                file.seek(0)
                if not packed and self._size > self._limits.text_bytes:
                    raise self._too_large(self._size)
                source = _Counted(file, self._size, self._count)
                yield from self._unpacked(source) if packed else iter(lambda: source.read(CHUNK_BYTES), b"")
                while source.read(CHUNK_BYTES):  # what gzip leaves at the end belongs to the digest, too
                    pass
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be read: {error.strerror or error}") from None

    def _unpacked(self, source: _Counted) -> Iterator[bytes]:
        """Unpacked chunks, as long as they are within the limits."""
        try:
            with gzip.GzipFile(fileobj=source) as file:  # type: ignore[call-overload]
                while chunk := file.read(CHUNK_BYTES):
                    self._text_bytes += len(chunk)
                    if self._text_bytes > self._limits.text_bytes:
                        raise self._too_large()
                    self._check_ratio()
                    yield chunk
        except (OSError, EOFError, zlib.error) as error:
            raise RecordingError(f"{self.path}: is not a whole gzip file: {error}") from None

    def _check_ratio(self) -> None:
        """Raises RecordingError if the last window was made of too few packed bytes."""
        text, packed = self._text_bytes - self._window[0], self._packed_bytes - self._window[1]
        if text < WINDOW_BYTES or self._limits.max_ratio is None:
            return
        self._window = self._text_bytes, self._packed_bytes
        if text > self._limits.max_ratio * packed:
            raise RecordingError(
                f"{self.path}: unpacks to more than {self._limits.max_ratio:g} times its size, as no recording does; "
                "if it is one, state how large it may be: --max-gb GB"
            )

    def _too_large(self, size: float | None = None) -> RecordingError:
        """size: of the text, where it is known."""
        most = f"{self._limits.text_bytes / GB:g} GB"
        has = f"unpacks to more than {most}" if size is None else f"has {size / GB:.4g} GB"
        return RecordingError(f"{self.path}: {has} of text, at most {most} are read; to read more: --max-gb GB")

    def _count(self, data: bytes) -> None:
        self._hash.update(data)
        self._packed_bytes += len(data)
        if self._progress is not None:
            self._progress(float(self._packed_bytes), float(self._size))


class _Counted:
    """A file's first `size` bytes, counted as they are read: one that grows meanwhile ends where it ended at first."""

    def __init__(self, file: BinaryIO, size: int, count: Callable[[bytes], None]) -> None:
        self._file, self._left, self._count = file, size, count

    def read(self, size: int = -1) -> bytes:
        """The next bytes."""
        data = self._file.read(self._left if size < 0 else min(size, self._left))
        self._left -= len(data)
        self._count(data)
        return data
