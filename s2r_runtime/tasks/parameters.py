"""A task's parameters: every one has a default, and a bad one is named with what it must be."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Any

from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import NominalModel


def known_name(task: str, name: str, known: Iterable[str]) -> None:
    """Raises ConfigError for an unknown parameter, with the nearest."""
    known = list(known)
    if name not in known:
        near = difflib.get_close_matches(name, known, 1, 0.6)
        hint = f"did you mean {near[0]!r}?" if near else f"it has: {', '.join(known)}"
        raise ConfigError(f"task {task}: has no parameter {name!r}; {hint}")


def filled_in(task: str, given: Mapping[str, Any], known: dict[str, tuple[float, str]]) -> dict[str, float]:
    """Every parameter's value. Raises ConfigError for an unknown name or a value that is not a finite number."""
    for name, value in given.items():
        known_name(task, name, known)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ConfigError(f"task {task}: {name} is {value!r}, must be a finite number")
    return {name: float(given.get(name, default)) for name, (default, _) in known.items()}


def whole(task: str, p: dict[str, float], low: int, names: Iterable[str]) -> None:
    """Raises ConfigError unless these are whole numbers >= low."""
    for name in names:
        require(task, p, name, p[name] >= low and p[name] == int(p[name]), f"a whole number >= {low}")


def require(task: str, p: dict[str, float], name: str, ok: bool, must: str) -> None:
    """Raises ConfigError `task t: name is value, must be ...` unless ok."""
    if not ok:
        raise ConfigError(f"task {task}: {name} is {p[name]:g}, must be {must}")


def columns_of(task: str, model: NominalModel, states: tuple[str, ...]) -> tuple[int, ...]:
    """Columns of these states in the model's. Raises ConfigError if it lacks one."""
    if missing := [name for name in states if name not in model.states]:
        raise ConfigError(f"task {task}: needs a model with the states {', '.join(states)}; {model.name!r} lacks {', '.join(missing)}")
    return tuple(model.states.index(name) for name in states)
