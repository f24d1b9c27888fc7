"""Hostile values: any struct of the messages with one or several of its fields, however deep, replaced by something of the same type."""

from __future__ import annotations

import math
import random
from typing import Any

import msgspec

MAX = 1.7976931348623157e308
WORDS = ("", "another", "controller", "model", "c1", "-", "\x00", "x" * 300)
NUMBERS = (math.nan, math.inf, -math.inf, MAX, -MAX, 0.0, -0.0, -1.0, 1.0, 5e-324, 1e-9, 1e9)
COUNTS = (0, -1, 1, 2, 3, 10**6, 2**31, 2**53 + 1, 2**63 - 1, -(2**63))


def spoiled(rng: random.Random, value: Any, *, keep: tuple[str, ...] = ()) -> Any:
    """The same with one place in it changed; `keep`: fields of the outermost struct that stay."""
    match value:
        case msgspec.Struct():
            names = [name for name in value.__struct_fields__ if name not in keep]
            name = rng.choice(names)
            return msgspec.structs.replace(value, **{name: spoiled(rng, getattr(value, name))})
        case bool():
            return not value
        case int():
            near = value + rng.choice([-1, 1, -10, 10, -(10**8), 10**8, 10**10, 10**12, -(10**12)])
            return rng.choice([near, near, rng.choice(COUNTS)])
        case float():
            near = value * rng.choice([1.0 + 1e-12, 1.0 - 1e-12, 0.5, 2.0, -1.0, 1e3, 1e-3])
            return rng.choice([near, rng.choice(NUMBERS)])
        case str():
            return rng.choice([value + "x", value[:-1], rng.choice(WORDS)])
        case tuple():
            return _tuple(rng, value)
        case dict():
            return {} if value else {"another": 1}
        case None:
            return None
    raise AssertionError(f"no idea how to spoil {value!r}")


def _tuple(rng: random.Random, value: tuple[Any, ...]) -> tuple[Any, ...]:
    choice = rng.randrange(6)
    if not value or choice == 0:
        return () if value else (0.0,)
    if choice == 1:
        return value[:-1]
    if choice == 2:
        return (*value, value[0])
    if choice == 3:
        return value[::-1]
    index = rng.randrange(len(value))
    return (*value[:index], spoiled(rng, value[index]), *value[index + 1 :])
