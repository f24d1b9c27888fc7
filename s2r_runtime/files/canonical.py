"""Canonical bytes and digests. Two values have the same digest iff they are the same value.

Keys sorted, no white space, floats in shortest round-trip form, NaN and inf refused (JSON has no word for them, and
msgspec would write `null`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

_ENCODER = msgspec.json.Encoder(order="deterministic")


def canonical(value: Any) -> bytes:
    """The canonical JSON bytes of a struct or of plain data. Raises ValueError on a number that is not finite."""
    plain = msgspec.to_builtins(value)
    _refuse_non_finite(plain, "$")
    return _ENCODER.encode(plain)


def digest(data: bytes) -> str:
    """`sha256:` and 64 hex digits."""
    return "sha256:" + hashlib.sha256(data).hexdigest()


def digest_of_path(path: Path) -> str:
    """Digest of a file's bytes, read piece by piece; of a folder, that of the names and digests of its files. Raises OSError."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        return digest_of([[file.relative_to(path).as_posix(), digest_of_path(file)] for file in files])
    with path.open("rb") as file:
        return "sha256:" + hashlib.file_digest(file, "sha256").hexdigest()


def digest_of(value: Any) -> str:
    """Digest of a value's canonical bytes."""
    return digest(canonical(value))


def digest_of_all(digests: Sequence[str]) -> str:
    """One digest of several, whatever their order; of one, itself."""
    return digests[0] if len(digests) == 1 else digest_of(sorted(digests))


def _refuse_non_finite(value: Any, where: str) -> None:
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{where} is {value}, must be finite")
    elif isinstance(value, dict):
        for key, item in value.items():
            _refuse_non_finite(item, f"{where}.{key}")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _refuse_non_finite(item, f"{where}[{index}]")
