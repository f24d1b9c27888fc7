"""Effects that no library here has, each with the tokens of `depends_on` that are true of it.

A kind draws its values in proportion to the robot and says on which robots it makes sense.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from trace_sets.plants import Numbers
from trace_sets.scale import PLANTS, Scale, log_uniform
from trace_sets.world import Moment, TruthEffect

Rng = np.random.Generator
Drawn = tuple[TruthEffect, set[str], dict[str, Any]]
POSES = ("unicycle", "bicycle", "differential_drive")
MASSES = ("double_integrator", "joint")


@dataclass(frozen=True)
class Kind:
    """plants: names; draw: (rng, scale, size) -> effect, tokens, values."""

    plants: tuple[str, ...]
    draw: Callable[[Rng, Scale, float], Drawn]


class Turning(TruthEffect):
    """f(s, x, q) changes the twist."""

    def __init__(self, f: Callable[[Moment, Numbers, Numbers], None]) -> None:
        self.f = f

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        self.f(s, x, q)


class Pushing(TruthEffect):
    """f(s, x, q) changes the accelerations."""

    def __init__(self, f: Callable[[Moment, Numbers, Numbers], None]) -> None:
        self.f = f

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        self.f(s, x, q)


class Acting(TruthEffect):
    """f(s, a, m) changes the inputs; memory of some numbers."""

    def __init__(self, f: Callable[[Moment, Numbers, Numbers], None], memory: int = 0) -> None:
        self.f, self.size = f, memory

    def memory(self) -> Numbers:
        return [0.0] * self.size

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        self.f(s, a, m)


def _channel(rng: Rng, s: Scale) -> tuple[int, str, float]:
    """An input: column, name, amplitude."""
    j = int(rng.integers(len(s.plant.inputs)))
    return j, s.plant.inputs[j], s.ranges[j].size


def slip_patch(rng: Rng, s: Scale, size: float) -> Drawn:
    """Wheels slip on a part of the floor."""
    span = s.speed * min(2.0 * s.pace, 0.2 * s.duration)
    angle, loss = float(rng.uniform(-math.pi, math.pi)), min(0.4 * size, 0.8)
    ax, ay, off = math.cos(angle), math.sin(angle), float(rng.uniform(-0.3, 0.3)) * span

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        if ax * x[0] + ay * x[1] > off:
            q[0] *= 1.0 - loss

    return Turning(f), {"position", "x", "y"}, {"loss": loss, "angle": angle, "offset": off}


def heading_drag(rng: Rng, s: Scale, size: float) -> Drawn:
    """A carpet's pile: slower along one direction."""
    pile, loss = float(rng.uniform(-math.pi, math.pi)), min(0.35 * size, 0.9)

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        q[0] *= 1.0 - loss * max(math.cos(x[2] - pile), 0.0)

    return Turning(f), {"heading", "theta"}, {"loss": loss, "direction": pile}


def resonance(rng: Rng, s: Scale, size: float) -> Drawn:
    """A second-order actuator that rings."""
    j, name, _ = _channel(rng, s)
    rate = min(math.tau * log_uniform(rng, 0.6, 5.0), 0.5 / s.dt)
    damping = float(rng.uniform(0.08, 0.35))

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        before = z[0]
        z[1] += m.h * (rate * rate * (a[j] - z[0]) - 2.0 * damping * rate * z[1])
        z[0] += m.h * z[1]
        a[j] = 0.5 * (before + z[0])

    return Acting(f, 2), {f"memory({name})"}, {"rate": rate, "damping": damping, "channel": name}


def cross_square(rng: Rng, s: Scale, size: float) -> Drawn:
    """The gain of one input falls with the square of the other."""
    j, name, _ = _channel(rng, s)
    k = 1 - j
    other, most = s.plant.inputs[k], s.ranges[k].size
    c = min(0.6 * size, 0.95)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        a[j] *= 1.0 - c * (a[k] / most) ** 2

    return Acting(f), {f"{name}*{other}", f"{other}*{name}"}, {"coefficient": c, "channel": name}


def fade(rng: Rng, s: Scale, size: float) -> Drawn:
    """A motor that warms up with what it is asked, fades, and recovers."""
    j, name, most = _channel(rng, s)
    time_constant = s.pace * log_uniform(rng, 1.0, 4.0)
    loss = min(0.9 * size, 3.0)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        z[0] += m.h / time_constant * ((a[j] / most) ** 2 - z[0])
        a[j] /= 1.0 + loss * z[0]

    return Acting(f, 1), {f"memory({name})", f"time*{name}"}, {"time_constant": time_constant, "loss": loss, "channel": name}


def cubic(rng: Rng, s: Scale, size: float) -> Drawn:
    """Hammerstein: a cubic before the robot."""
    j, name, most = _channel(rng, s)
    c = float(rng.choice([-1.0, 1.0])) * min(0.5 * size, 0.9)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        a[j] += c * a[j] * ((a[j] / most) ** 2 - 0.6)

    return Acting(f), {name}, {"coefficient": c, "channel": name}


def rough_place(rng: Rng, s: Scale, size: float) -> Drawn:
    """Friction that depends on where the mass is."""
    n = s.plant.axes
    span = 1.5 * s.speed * s.pace
    c = size * 0.8 * s.ranges[0].size / s.plant.parameters.get("mass", 1.0) / s.speed

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        for j in range(n):
            q[j] -= c * (0.5 + 0.5 * math.tanh(2.0 * x[0] / span)) * x[n + j]

    tokens = {"position", s.plant.states[0], "speed", *s.plant.states[n:]}
    return Pushing(f), tokens, {"coefficient": c, "span": span}


def spring_wave(rng: Rng, s: Scale, size: float) -> Drawn:
    """Cogging: a force that alternates over the way."""
    span = 1.5 * s.speed * s.pace * float(rng.uniform(0.5, 1.2))
    c = size * 0.3 * s.ranges[0].size / s.plant.parameters.get("mass", 1.0)

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        q[0] -= c * math.sin(math.tau * x[0] / span)

    return Pushing(f), {"position", s.plant.states[0]}, {"amplitude": c, "span": span}


KINDS: dict[str, Kind] = {
    "slip_patch": Kind(POSES, slip_patch),
    "heading_drag": Kind(POSES, heading_drag),
    "resonance": Kind(PLANTS, resonance),
    "cross_square": Kind((*POSES, "double_integrator"), cross_square),
    "fade": Kind(PLANTS, fade),
    "cubic": Kind(PLANTS, cubic),
    "rough_place": Kind(MASSES, rough_place),
    "spring_wave": Kind(MASSES, spring_wave),
}
