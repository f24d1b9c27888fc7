"""Bounds of what readers take in at once, so that no file, whatever it claims, fills the memory."""

from __future__ import annotations

from pathlib import Path

from s2r_runtime.errors import RecordingError
from s2r_runtime.formats.series import MAX_FILE_BYTES, MAX_VALUES


def check_size(path: Path) -> None:
    """Raises RecordingError for an empty file, and for one that is too large to be read at once."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if size == 0:
        raise RecordingError(f"{path}: is empty")
    if size > MAX_FILE_BYTES:
        raise RecordingError(
            f"{path}: has {size / 1e9:.3g} GB; files of this format are read at once, and must have at most {MAX_FILE_BYTES / 1e9:.3g} GB"
        )


def check_values(path: Path, n: int) -> None:
    """Raises RecordingError if a file claims more numbers than are taken in at once."""
    if n > MAX_VALUES:
        raise RecordingError(f"{path}: claims {n:.3g} numbers; at most {MAX_VALUES:.3g} are read at once")
