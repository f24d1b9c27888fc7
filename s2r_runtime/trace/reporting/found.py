"""Identified effect: name, channel, and parameters with 95 % intervals and units."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from s2r_runtime.trace.reporting.wording import degrees, in_words

Limit = float | list[list[float | None]] | None
Value = tuple[Any, Limit, Limit, str]
"""Value, low and high end of its 95 % interval (in the shape of the value; None if it has no interval), unit."""

UNLIMITED = 1e5
"""Ends of intervals beyond it are bounds of the parameter, not estimates."""

DIGITS = 1
"""Significant digits of an interval's half width."""


@dataclass(frozen=True)
class Found:
    """Identified effect. parameters: name -> (value, low, high, unit); low and high: 95 % interval, or None. instead_of: (effect, channel)
    of the effects that it may replace: as a competing hypothesis, or as an equivalent (same_thing).
    """

    name: str
    channel: str
    parameters: dict[str, Value]
    instead_of: tuple[tuple[str, str], ...] = ()
    same_thing: bool = False

    @property
    def values(self) -> dict[str, Any]:
        """Parameter -> value."""
        return {name: value[0] for name, value in self.parameters.items()}

    def to_json(self) -> dict[str, Any]:
        """The form of docs/json.md."""
        values = {n: {"value": v, "low": low, "high": high, "unit": unit} for n, (v, low, high, unit) in self.parameters.items()}
        return {"name": self.name, "channel": self.channel, "parameters": values}

    def text(self) -> str:
        """One line: effect, channel and parameters."""
        values = ", ".join(f"{name} = {text}" for name, text in self.value_texts())
        return f"{self.name} on {self.channel}{': ' if values else ''}{values}"

    def value_texts(self) -> Iterator[tuple[str, str]]:
        """(parameter, value with its unit and interval)."""
        for name, (value, low, high, unit) in self.parameters.items():
            if isinstance(value, float):
                yield name, interval_text(value, low, high, unit)
            elif isinstance(value, list):
                yield name, "[" + ", ".join("[" + ", ".join(f"{v:.4g}" for v in row) + "]" for row in value) + f"] {unit}".rstrip()
            else:
                yield name, str(value)

    def words(self) -> str:
        """Meaning for the robot, one clause."""
        return in_words(self.name, self.channel, self.values)


def each_once(found: Iterable[Found]) -> tuple[Found, ...]:
    """The first of each effect and channel: other parameter values are not another explanation."""
    kept: dict[tuple[str, str], Found] = {}
    for e in found:
        kept.setdefault((e.name, e.channel), e)
    return tuple(kept.values())


def interval_text(value: float, low: Limit, high: Limit, unit: str) -> str:
    """`0.1000 rad/s (5.730 deg/s) (95 %: 0.0980 to 0.1020)`; an end at a parameter's bound is not limited by the data."""
    plain = "" if unit == "-" else unit
    ends = (low, high) if isinstance(low, float) and isinstance(high, float) else None
    known = [_limits(end, value) for end in ends or ()]
    within = all(known) and ends is not None
    width = 0.5 * (ends[1] - ends[0]) if ends is not None and within else 0.0
    turned = degrees(plain)
    seen = max(min(width, 2.0 * abs(value)), 0.01 * width)  # of an uncertain parameter its first digit, not a zero
    text = _rounded(value, seen) + (f" {plain}" if plain else "")
    text += f" ({_rounded(math.degrees(value), math.degrees(seen))} {turned})" if turned else ""
    if ends is None:
        return text
    if within:
        return f"{text} (95 %: {_rounded(ends[0], width)} to {_rounded(ends[1], width)})"
    said = [f"at least {ends[0]:.4g}" if known[0] else "", f"at most {ends[1]:.4g}" if known[1] else ""]
    return f"{text} ({', '.join(s for s in said if s) or 'not limited by these data'})"


def _limits(end: float, value: float) -> bool:
    """Whether the data limit this end of an interval: not if it is at a distant bound, or at a bound next to 0."""
    return abs(end) < UNLIMITED and not 0.0 < abs(end) < abs(value) / UNLIMITED


def _rounded(value: float, width: float) -> str:
    """Rounded to DIGITS digits of the half width; to four digits without one."""
    if not 0.0 < width < math.inf or not math.isfinite(value):
        return f"{value:.4g}"
    decimals = DIGITS - 1 - math.floor(math.log10(width))
    if not 0 <= decimals <= 9:
        return f"{value:.4g}"
    return f"{value:.{decimals}f}"
