"""Bounds of what readers take in at once, so that no file, whatever it claims, fills the memory (`limits`)."""

from __future__ import annotations

import gzip
import io
from pathlib import Path
from typing import IO, Any, BinaryIO

import zstandard

from s2r_runtime.errors import RecordingError
from s2r_runtime.files.limits import FILE, GB, NUMBERS, RATIO

NUMBER_BYTES = 8
WINDOW_BYTES = 8 << 20
"""Of what is unpacked: the ratio is checked whenever so much has come."""
GZIP, ZSTD = b"\x1f\x8b", b"\x28\xb5\x2f\xfd"
HARMLESS = 8_000_000
"""Numbers that any file may hold, however well it is packed: 64 MB."""


def check_size(path: Path) -> None:
    """Raises RecordingError for an empty file, and for one that is too large to be read at once."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if size == 0:
        raise RecordingError(f"{path}: is empty")
    if size > FILE.value():
        raise RecordingError(
            f"{path}: has {size / GB:.3g} GB; files of this format are read at once, and must have at most {FILE.value() / GB:.3g} GB; "
            f"{FILE.more()}"
        )


def check_values(path: Path, n: int) -> None:
    """Raises RecordingError if a file claims more numbers than are taken in at once, or than its size can hold. path: or a folder."""
    if n > NUMBERS.value():
        raise RecordingError(f"{path}: claims {n:.3g} numbers; at most {NUMBERS.value():.3g} are read at once; {NUMBERS.more()}")
    if n > HARMLESS:
        check_packed(path, n * NUMBER_BYTES)


def check_packed(path: Path, claimed: int) -> None:
    """Raises RecordingError if this many bytes are claimed to be packed into a file that is too small for them."""
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    packed = sum(file.stat().st_size for file in files)
    if claimed > HARMLESS * NUMBER_BYTES and claimed > RATIO.value() * packed:
        raise RecordingError(
            f"{path}: unpacks from {packed / 1e6:.3g} MB to {claimed / 1e6:.3g} MB, more than {RATIO.value():g} times as much, as no "
            f"recording does; {RATIO.more()}"
        )


def content_of(path: Path) -> BinaryIO:
    """The file, to be read from its beginning to its end; the content of one that gzip or zstd packed. Reading raises RecordingError where
    that is more than `limits.RATIO` times its size in any window of WINDOW_BYTES. Raises OSError.
    """
    file = path.open("rb")
    start = file.read(len(ZSTD))
    file.seek(0)
    if start.startswith(GZIP):
        return io.BufferedReader(_Unpacked(path, file, gzip.GzipFile(fileobj=file)), WINDOW_BYTES >> 3)
    if start == ZSTD:
        return io.BufferedReader(_Unpacked(path, file, zstandard.ZstdDecompressor().stream_reader(file)), WINDOW_BYTES >> 3)
    return file


class _Unpacked(io.RawIOBase):
    """source: unpacks `file`."""

    def __init__(self, path: Path, file: IO[bytes], source: Any) -> None:
        self._path, self._file, self._source = path, file, source
        self._unpacked, self._window = 0, (0, 0)

    def readable(self) -> bool:
        """It is."""
        return True

    def tell(self) -> int:
        """Bytes of content read so far."""
        return self._unpacked

    def readinto(self, buffer: Any) -> int:
        """As of any file."""
        n = int(self._source.readinto(buffer))
        self._unpacked += n
        content, packed = self._unpacked - self._window[0], self._file.tell() - self._window[1]
        if content >= WINDOW_BYTES:
            if content > RATIO.value() * packed:
                raise RecordingError(
                    f"{self._path}: unpacks to more than {RATIO.value():g} times its size, as no recording does; {RATIO.more()}"
                )
            self._window = self._unpacked, self._file.tell()
        return n

    def close(self) -> None:
        """Closes the file, too."""
        if not self.closed:
            self._source.close()
            self._file.close()
        super().close()
