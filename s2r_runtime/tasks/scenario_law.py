"""A law of scenarios as a table: how the start and the scenario's other numbers are drawn, name by name. Batched over n scenarios.

    1.5                          this number
    [low, high]                  uniform
    { normal = [mean, sd] }      normal
    { choice = [a, b, c] }       one of these, each as probable
    "(x + goal_x) / 2"           computed from the others

States that are left out start at 0. Everything that is drawn is independent; `given`, a formula on the numbers of the start, makes it
the law given that this holds (by rejection). Numbers are drawn in the order of their names, so that the order in a file means nothing.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.tasks.stl.functions import FUNCTIONS
from s2r_runtime.tasks.stl.robustness import compile_expression, compile_truth
from s2r_runtime.tasks.stl.syntax import Apply, Expression, Name, is_instant
from s2r_runtime.tasks.stl.text import CONSTANTS, parse_expression, parse_truth
from s2r_runtime.tasks.stl.tokens import WORDS

Array = NDArray[np.float64]
Law = float | str | list[float] | dict[str, list[float]]
Draw = Callable[[np.random.Generator, int], Array]

MAX_ROUNDS = 1000
"""Rounds of rejection before the law is given up; each proposes at least 64."""
TAKEN = ("t", "time_left", "start", "step")
"""Names that mean something already."""


class ScenarioLaw:
    """start: by state; scenario: by name. Raises ConfigError `task name: start.x is ..., must be ...`."""

    def __init__(
        self, task: str, start: Mapping[str, Any], scenario: Mapping[str, Any], given: str, states: tuple[str, ...], angles: tuple[str, ...]
    ) -> None:
        self._task, self._states, self._angles = task, states, set(angles)
        self.names = tuple(scenario)
        self._check_names(start, scenario)
        laws = {**dict.fromkeys(states, 0.0), **start, **scenario}
        where = {name: f"task {task}: {'start' if name in states else 'scenario'}.{name}" for name in laws}
        self._ranges = {name: law for name in states if isinstance(law := laws[name], list)}
        self._drawn: dict[str, Draw] = {}
        self._texts: dict[str, Expression] = {}
        for name in sorted(laws):
            law = laws[name]
            if isinstance(law, str):
                self._texts[name] = parse_expression(law, tuple(laws), where[name])
            else:
                self._drawn[name] = _draw_of(law, where[name])
        self._computed = self._in_order(where)
        self._holds: Callable[[Mapping[str, Any]], Any] | None = None
        if given:
            truth = parse_truth(given, tuple(laws), 1.0, f"task {task}: given")
            if not is_instant(truth):
                raise ConfigError(f"task {task}: given says something of times to come; it may only say something of the start")
            self._holds = compile_truth(truth)

    def draw(self, rng: np.random.Generator, n: int) -> dict[str, Array]:
        """n scenarios, independent: name -> (n,), states too. Raises ConfigError if there are none."""
        found = self._accepted(rng, n, {})
        if found is None:
            raise ConfigError(f"task {self._task}: no scenario was found of which `given` holds; is it possible at all?")
        return found

    def draw_at(self, rng: np.random.Generator, x: Array) -> dict[str, Array]:
        """One scenario given that the robot starts at x (nx,). States that are not drawn from a range count as they are.

        Raises NotEnoughEvidence where the law has none.
        """
        here = ", ".join(f"{name} {value:.3f}" for name, value in zip(self._states, x, strict=True))
        for name, value in zip(self._states, x, strict=True):
            if name in self._ranges and not self._inside(name, float(value)):
                low, high = self._ranges[name]
                raise NotEnoughEvidence(f"task {self._task}: the robot is at {here}; scenarios start with {name} in [{low:g}, {high:g}]")
        found = self._accepted(rng, 1, {name: np.array([value]) for name, value in zip(self._states, x, strict=True)})
        if found is None:
            raise NotEnoughEvidence(f"task {self._task}: the robot is at {here}; no scenario starts there of which `given` holds")
        return found

    # ---------------------------------------------------------------- drawing

    def _accepted(self, rng: np.random.Generator, n: int, at: Mapping[str, Array]) -> dict[str, Array] | None:
        kept: list[dict[str, Array]] = []
        missing = n
        for _ in range(MAX_ROUNDS):
            k = missing if self._holds is None else missing + missing // 2 + 64
            proposed = self._proposed(rng, k, at)
            rows = np.arange(k)
            if self._holds is not None:
                with np.errstate(all="ignore"):
                    rows = np.flatnonzero(np.broadcast_to(np.asarray(self._holds(proposed)) >= 0.0, (k,)))[:missing]
            kept.append({name: value[rows] for name, value in proposed.items()})
            missing -= len(rows)
            if missing == 0:
                return {name: np.concatenate([part[name] for part in kept]) for name in kept[0]}
        return None

    def _proposed(self, rng: np.random.Generator, k: int, at: Mapping[str, Array]) -> dict[str, Array]:
        values = {name: np.repeat(value, k) for name, value in at.items()}
        for name, draw in self._drawn.items():
            if name not in values:
                values[name] = draw(rng, k)
        with np.errstate(all="ignore"):
            for name, compute in self._computed:
                if name not in values:
                    values[name] = np.array(np.broadcast_to(compute(values), (k,)), dtype=np.float64)
        for name, value in values.items():
            if not np.all(np.isfinite(value)):
                raise ConfigError(f"task {self._task}: {name} of a scenario is not finite; look at how it is computed")
        return values

    def _inside(self, name: str, value: float) -> bool:
        low, high = self._ranges[name]
        if name in self._angles:
            value = low + (value - low) % (2.0 * math.pi)
        return bool(low <= value <= high)

    # ---------------------------------------------------------------- reading

    def _check_names(self, start: Mapping[str, Any], scenario: Mapping[str, Any]) -> None:
        for name in start:
            if name not in self._states:
                near = difflib.get_close_matches(name, self._states, 1, 0.6)
                hint = f"did you mean {near[0]!r}?" if near else f"it has: {', '.join(self._states)}"
                raise ConfigError(f"task {self._task}: start.{name}: the model has no such state; {hint}")
        for name in scenario:
            if re.fullmatch(r"[A-Za-z_][A-Za-z_0-9]*", name) is None:
                raise ConfigError(f"task {self._task}: scenario.{name}: a name has letters, digits and _, and no digit first")
            if name in self._states or name in TAKEN or name in WORDS or name in FUNCTIONS or name in CONSTANTS:
                raise ConfigError(f"task {self._task}: scenario.{name}: the name means something else already; take another one")

    def _in_order(self, where: Mapping[str, str]) -> list[tuple[str, Callable[[Mapping[str, Any]], Any]]]:
        """The computed ones, each after those that it is computed from."""
        ordered: list[str] = []
        missing = dict(self._texts)
        while missing:
            ready = [name for name, text in missing.items() if not (_names_in(text) & set(missing))]
            if not ready:
                raise ConfigError(f"{where[next(iter(missing))]}: is computed from itself, through {', '.join(missing)}")
            ordered += ready
            for name in ready:
                del missing[name]
        return [(name, compile_expression(self._texts[name])) for name in ordered]


def _names_in(node: Expression) -> set[str]:
    if isinstance(node, Name):
        return {node.name}
    return set().union(*(_names_in(part) for part in node.arguments)) if isinstance(node, Apply) else set()


def _draw_of(law: Any, where: str) -> Draw:
    must = "a number, [low, high], { normal = [mean, sd] }, { choice = [...] } or a text that computes it"
    if isinstance(law, int | float) and not isinstance(law, bool) and math.isfinite(law):
        return lambda _, k: np.full(k, float(law))
    if isinstance(law, list):
        low, high = _pair(law, where, "[low, high]")
        if low > high:
            raise ConfigError(f"{where} is {law}, must be [low, high] with low <= high")
        return lambda rng, k: rng.uniform(low, high, k)
    if isinstance(law, dict) and set(law) == {"normal"}:
        mean, sd = _pair(law["normal"], where, "{ normal = [mean, sd] }")
        if sd < 0.0:
            raise ConfigError(f"{where} is {law}, must have a standard deviation >= 0")
        return lambda rng, k: rng.normal(mean, sd, k)
    if isinstance(law, dict) and set(law) == {"choice"} and isinstance(law["choice"], list) and law["choice"]:
        values = np.array([_finite(value, where) for value in law["choice"]])
        return lambda rng, k: values[rng.integers(0, len(values), k)]
    raise ConfigError(f"{where} is {law!r}, must be {must}")


def _pair(law: Any, where: str, form: str) -> tuple[float, float]:
    if not isinstance(law, list) or len(law) != 2:
        raise ConfigError(f"{where} is {law!r}, must be {form}")
    return _finite(law[0], where), _finite(law[1], where)


def _finite(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{where} has {value!r}, must be finite numbers")
    return float(value)
