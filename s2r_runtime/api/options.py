"""Options of public functions: a wrong type is a TypeError that has the option's name, a number out of range a UsageError."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real

from s2r_runtime.errors import UsageError


def check_numbers(*, above: float = -math.inf, **options: object) -> None:
    """Each option is None or a number. above: it must be finite and greater than this. Raises TypeError, UsageError."""
    for name, value in options.items():
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, Real):
            raise TypeError(f"{name}: is {value!r}, must be a number")
        if above > -math.inf and not above < float(value) < math.inf:
            raise UsageError(f"{name}: is {float(value):g}, must be > {above:g} and finite")


def check_counts(**options: object) -> None:
    """Each option is None or a whole number >= 0. Raises TypeError, UsageError."""
    for name, value in options.items():
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, Integral):
            raise TypeError(f"{name}: is {value!r}, must be a whole number")
        if int(value) < 0:
            raise UsageError(f"{name}: is {value}, must be >= 0")


def check_named_numbers(**options: object) -> None:
    """Each option is None or a dict: name -> finite number. Raises TypeError, UsageError."""
    for name, value in options.items():
        if value is None:
            continue
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            raise TypeError(f"{name}: is {value!r}, must be a dict: name -> number")
        for key, number in value.items():
            if isinstance(number, bool) or not isinstance(number, Real):
                raise TypeError(f"{name}: {key} is {number!r}, must be a number")
            if not math.isfinite(number):
                raise UsageError(f"{name}: {key} is {float(number):g}, must be finite")
