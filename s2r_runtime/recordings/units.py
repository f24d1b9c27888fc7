"""Units as DBC files, flight logs and measurement files write them -> SI.

A unit that is not here is not guessed: the user gives the scale.
"""

from __future__ import annotations

import math

_DEGREE, _TURN, _G = math.pi / 180.0, 2.0 * math.pi, 9.80665

FACTORS: dict[str, float] = {
    "": 1.0, "-": 1.0, "1": 1.0, "%": 0.01,
    "m": 1.0, "meter": 1.0, "metre": 1.0, "km": 1000.0, "cm": 0.01, "mm": 0.001, "um": 1e-6,
    "m/s": 1.0, "mps": 1.0, "cm/s": 0.01, "mm/s": 0.001, "km/h": 1.0 / 3.6, "kph": 1.0 / 3.6, "kmh": 1.0 / 3.6, "mph": 0.44704,
    "m/s^2": 1.0, "m/s2": 1.0, "m/s/s": 1.0, "mm/s^2": 0.001, "mm/s2": 0.001, "g": _G,
    "rad": 1.0, "mrad": 0.001, "deg": _DEGREE, "degree": _DEGREE, "degrees": _DEGREE, "°": _DEGREE, "grad": _DEGREE,
    "degheading": _DEGREE, "cdeg": 0.01 * _DEGREE, "cdeg/s": 0.01 * _DEGREE, "mdeg": 0.001 * _DEGREE,
    "rad/s": 1.0, "mrad/s": 0.001, "deg/s": _DEGREE, "degree/s": _DEGREE, "degrees/s": _DEGREE, "°/s": _DEGREE, "dps": _DEGREE,
    "rpm": _TURN / 60.0, "1/min": _TURN / 60.0, "rev/min": _TURN / 60.0, "r/min": _TURN / 60.0, "u/min": _TURN / 60.0, "rps": _TURN,
    "rad/s^2": 1.0, "rad/s2": 1.0, "deg/s^2": _DEGREE, "deg/s2": _DEGREE, "°/s^2": _DEGREE, "°/s2": _DEGREE,
    "n": 1.0, "kn": 1000.0, "nm": 1.0, "n*m": 1.0, "n.m": 1.0,
    "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9,
    "a": 1.0, "v": 1.0, "w": 1.0, "kw": 1000.0, "hz": 1.0,
}  # fmt: skip
"""SI units per unit, by its lower-case name without blanks."""


def number_of(text: str) -> float:
    """The number that a text writes. Raises ValueError, also for `1_0` and for digits of other scripts, which Python alone would read."""
    if "_" in text or not text.isascii():
        raise ValueError(f"{text!r} is not a number")
    return float(text)


def factor_of(unit: str) -> float | None:
    """SI units per unit; None for one that is not known. `mA` and `MA` differ by more than letters' case, so neither is here."""
    return FACTORS.get(unit.replace(" ", "").replace("²", "2").replace("μ", "µ").lower())
