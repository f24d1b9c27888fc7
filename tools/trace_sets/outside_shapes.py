"""Effects as plain functions, and the draws that kinds without a name share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from trace_sets.plants import Numbers, Plant
from trace_sets.scale import Scale
from trace_sets.world import Moment, TruthEffect

Rng = np.random.Generator
Drawn = tuple[TruthEffect, set[str], dict[str, Any]]
"""The effect, the tokens of `depends_on` that are true of it, and its values."""

POSES = ("unicycle", "bicycle", "differential_drive")
MASSES = ("double_integrator", "joint")


@dataclass(frozen=True)
class Kind:
    """plants: names of robots on which it makes sense; draw: (rng, scale, size) -> effect, tokens, values."""

    plants: tuple[str, ...]
    draw: Callable[[Rng, Scale, float], Drawn]


class Turning(TruthEffect):
    """f(moment, x, twist) changes the twist [v, w, side, east, north]."""

    def __init__(self, f: Callable[[Moment, Numbers, Numbers], None]) -> None:
        self.f = f

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        self.f(s, x, q)


class Pushing(TruthEffect):
    """f(moment, x, accelerations) changes the accelerations."""

    def __init__(self, f: Callable[[Moment, Numbers, Numbers], None]) -> None:
        self.f = f

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        self.f(s, x, q)


class Acting(TruthEffect):
    """f(moment, a, memory) changes what acts; `size` numbers of memory."""

    def __init__(self, f: Callable[[Moment, Numbers, Numbers], None], size: int = 0) -> None:
        self.f, self.size = f, size

    def memory(self) -> Numbers:
        return [0.0] * self.size

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        self.f(s, a, m)


@dataclass(frozen=True)
class Chosen:
    """An input: column, name, greatest command."""

    j: int
    name: str
    most: float


def an_input(rng: Rng, s: Scale) -> Chosen:
    """One at random."""
    j = int(rng.integers(len(s.plant.inputs)))
    return Chosen(j, s.plant.inputs[j], s.ranges[j].size)


def another(s: Scale, chosen: Chosen) -> Chosen:
    """The other one of two."""
    k = 1 - chosen.j
    return Chosen(k, s.plant.inputs[k], s.ranges[k].size)


def memory_of(plant: Plant, name: str) -> set[str]:
    """Tokens for what an input was: its memory, or the measured state that follows it, which holds that memory."""
    column = plant.inputs.index(name)
    return {f"memory({name})", *(plant.states[i] for i, j in plant.reached.items() if j == column)}


def product(first: str, second: str) -> set[str]:
    """Either order."""
    return {f"{first}*{second}", f"{second}*{first}"}


def usual_acceleration(s: Scale) -> float:
    """One that is felt among the commanded ones."""
    return s.ranges[0].size / s.plant.parameters.get("mass", 1.0)


def usual_way(s: Scale) -> float:
    """How far the robot goes before it turns, m."""
    return s.speed * min(2.0 * s.pace, 0.25 * s.duration)


def either(rng: Rng) -> float:
    """1 or -1."""
    return float(rng.choice([-1.0, 1.0]))
