"""What can be wrong with the quadruped, its load or its floor: `NAME PARAMETER=VALUE...`, one line of text each."""

from __future__ import annotations

import math
from typing import NamedTuple

from s2r_runtime.errors import ConfigError

LEGS = ("front_left", "front_right", "rear_left", "rear_right")


class Range(NamedTuple):
    """Bounds of a number with its unit; `default` if it may be left out."""

    low: float
    high: float
    unit: str
    default: float | None = None


KNOWN: dict[str, dict[str, Range]] = {
    "payload": {"mass": Range(0.0, 10.0, "kg"), "x": Range(-0.2, 0.2, "m", 0.0), "y": Range(-0.1, 0.1, "m", 0.0)},
    "floor": {"friction": Range(0.0, 2.0, "")},
    "slope": {"angle": Range(0.0, 0.5, "rad"), "direction": Range(-10.0, 10.0, "rad", 0.0)},
    "weak_leg": {"strength": Range(0.0, 1.0, "")},
    "latency": {"delay": Range(0.0, 2.0, "s")},
    "shoves": {"force": Range(0.0, 500.0, "N"), "rate": Range(0.0, 5.0, "1/s")},
}
"""Beside `leg` of weak_leg, which is a word."""


class Fault(NamedTuple):
    """`key`: one of a key replaces the one before. `leg` only of a weak leg."""

    key: str
    name: str
    values: dict[str, float]
    leg: int = 0


def parse_fault(text: str) -> Fault:
    """Raises ConfigError, naming what it must look like."""
    name, *words = text.split() or [""]
    if name not in KNOWN:
        raise ConfigError(f"effect {text!r}: unknown effect {name!r}; the quadruped has: {', '.join(KNOWN)}")
    ranges, given = KNOWN[name], {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or key in given or not (key in ranges or (name == "weak_leg" and key == "leg")):
            raise ConfigError(f"effect {text!r}: {word!r} must be PARAMETER=VALUE, once each, with {', '.join(_names(name))}")
        given[key] = value
    values = {key: _number(text, key, given.get(key), bounds) for key, bounds in ranges.items()}
    if name != "weak_leg":
        return Fault(name, name, values)
    if given.get("leg") not in LEGS:
        raise ConfigError(f"effect {text!r}: leg must be one of {', '.join(LEGS)}")
    return Fault(f"{name}:{given['leg']}", name, values, LEGS.index(given["leg"]))


def _names(name: str) -> list[str]:
    return (["leg"] if name == "weak_leg" else []) + list(KNOWN[name])


def _number(text: str, key: str, value: str | None, bounds: Range) -> float:
    if value is None and bounds.default is not None:
        return bounds.default
    try:
        number = float(value or "")
    except ValueError:
        number = math.nan
    if not bounds.low <= number <= bounds.high:  # also false for NaN
        raise ConfigError(f"effect {text!r}: {key} must be a number from {bounds.low:g} to {bounds.high:g} {bounds.unit}".rstrip())
    return number
