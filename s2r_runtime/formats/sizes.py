"""Bounds of what readers take in at once, so that no file, whatever it claims, fills the memory (`limits`)."""

from __future__ import annotations

from pathlib import Path

from s2r_runtime.errors import RecordingError
from s2r_runtime.limits import FILE, GB, NUMBERS, RATIO

NUMBER_BYTES = 8
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
