"""Records of an earlier version: the same messages, without the fields that came later.

A field that is added to a message has a default that means *as it was before*, so what lacks it says the same. Nothing else is forgiven:
the keys must be in the recorder's order, each once, and the bytes those that a recorder writes.
"""

from __future__ import annotations

from typing import Any

import msgspec

_ENCODE = msgspec.json.Encoder().encode


def as_recorded(encoded: bytes, raw: bytes) -> bool:
    """Whether raw is the message `encoded`, as this version writes it, but for later fields that are at their defaults there."""
    if encoded == raw:
        return True
    try:
        plain = msgspec.json.decode(raw)
    except ValueError:
        return False
    return _ENCODE(plain) == raw and _lacks_only(plain, msgspec.json.decode(encoded))


def _lacks_only(plain: Any, whole: Any) -> bool:
    """Whether plain is whole without some keys of its tables, in the same order. (What a reader makes of a missing key is its default.)"""
    if isinstance(plain, dict) and isinstance(whole, dict):
        kept = [key for key in whole if key in plain]
        return kept == list(plain) and all(_lacks_only(plain[key], whole[key]) for key in kept)
    if isinstance(plain, list) and isinstance(whole, list):
        return len(plain) == len(whole) and all(map(_lacks_only, plain, whole))
    return type(plain) is type(whole) and bool(plain == whole)
