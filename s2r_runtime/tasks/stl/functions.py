"""The functions that expressions may use, elementwise over arrays. Outside of its domain a function gives no number, which counts as a
violation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class Function(NamedTuple):
    """`arity`: least and most arguments."""

    apply: Callable[..., Any]
    arity: tuple[int, int]


MANY = 64


def _least(*values: Any) -> Any:
    least = values[0]
    for value in values[1:]:
        least = np.minimum(least, value)
    return least


def _most(*values: Any) -> Any:
    most = values[0]
    for value in values[1:]:
        most = np.maximum(most, value)
    return most


def _hypot(*values: Any) -> Any:
    total = values[0] * values[0]
    for value in values[1:]:
        total = total + value * value
    return np.sqrt(total)


def _wrap(angle: Any) -> Any:
    """To [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


FUNCTIONS: dict[str, Function] = {
    "abs": Function(np.abs, (1, 1)),
    "sqrt": Function(np.sqrt, (1, 1)),
    "exp": Function(np.exp, (1, 1)),
    "log": Function(np.log, (1, 1)),
    "sin": Function(np.sin, (1, 1)),
    "cos": Function(np.cos, (1, 1)),
    "tan": Function(np.tan, (1, 1)),
    "asin": Function(np.arcsin, (1, 1)),
    "acos": Function(np.arccos, (1, 1)),
    "atan": Function(np.arctan, (1, 1)),
    "atan2": Function(np.arctan2, (2, 2)),
    "sign": Function(np.sign, (1, 1)),
    "floor": Function(np.floor, (1, 1)),
    "wrap": Function(_wrap, (1, 1)),
    "hypot": Function(_hypot, (1, MANY)),
    "min": Function(_least, (1, MANY)),
    "max": Function(_most, (1, MANY)),
}

OPERATORS: dict[str, Callable[..., Any]] = {
    "+": np.add,
    "*": np.multiply,
    "/": np.divide,
    "^": np.power,
}
