"""What a kind of the families `unopened` is, and how a state of two numbers moves over a part of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trace_sets.plants import Numbers
from trace_sets.scale import Scale
from trace_sets.world import TruthEffect

Rng = np.random.Generator


@dataclass(frozen=True)
class Drawn:
    """One draw of a kind. words: what is true; depends_on: tokens on which the missing effect depends; values: its parameters, SI units.

    excitation, where the kind needs a certain one.
    """

    effect: TruthEffect
    words: str
    depends_on: tuple[str, ...]
    values: dict[str, float]
    law: str = ""


@dataclass(frozen=True)
class Kind:
    """robots: names of those that have it; draw: (rng, scale) -> Drawn; size: more arguments for `draw_scale`."""

    robots: tuple[str, ...]
    draw: Callable[[Rng, Scale], Drawn]
    size: dict[str, Any] = field(default_factory=dict)


def runge_kutta(rate: Callable[[Numbers], Numbers], x: Numbers, h: float) -> Numbers:
    """The state after h seconds, fourth order, inputs held."""
    k1 = rate(x)
    k2 = rate([v + 0.5 * h * k for v, k in zip(x, k1, strict=True)])
    k3 = rate([v + 0.5 * h * k for v, k in zip(x, k2, strict=True)])
    k4 = rate([v + h * k for v, k in zip(x, k3, strict=True)])
    return [v + h / 6.0 * (a + 2.0 * b + 2.0 * c + d) for v, a, b, c, d in zip(x, k1, k2, k3, k4, strict=True)]


def per_input(scale: Scale, *patterns: str) -> tuple[str, ...]:
    """Tokens of every input: `{c}` stands for its name."""
    return tuple(p.format(c=c) for c in scale.plant.inputs for p in patterns)
