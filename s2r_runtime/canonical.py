"""Canonical bytes and digests. Two values have the same digest iff they are the same value.

Keys sorted, no white space, floats in shortest round-trip form, NaN and inf refused (JSON has no word for them, and
msgspec would write `null`).
"""

from __future__ import annotations

import hashlib
import math
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


def digest_of(value: Any) -> str:
    """Digest of a value's canonical bytes."""
    return digest(canonical(value))


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
