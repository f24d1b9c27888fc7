"""Sizes: which robot, how large and fast it is, how often it is seen, for how long. All other draws are in proportion to these."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trace_sets import plants
from trace_sets.excitation import Range
from trace_sets.plants import Plant

Rng = np.random.Generator

RATES = (10.0, 20.0, 25.0, 30.303, 50.0, 100.0, 200.0, 250.0, 500.0, 1000.0)
"""Hz, of the model's step."""

SHARES = (0.1, 0.15, 0.1, 0.2, 0.15, 0.13, 0.06, 0.04, 0.04, 0.03)
"""How often each is drawn."""

PLANTS = ("unicycle", "bicycle", "differential_drive", "double_integrator", "joint")


@dataclass(frozen=True)
class Scale:
    """speed: typical, m/s; yaw: rad/s; pace: s for which a command stands; n: steps of dt; parts: of a step."""

    plant: Plant
    dt: float
    parts: int
    n: int
    ranges: tuple[Range, ...]
    speed: float
    yaw: float
    pace: float

    @property
    def duration(self) -> float:
        """Of all runs together, s."""
        return self.n * self.dt

    def amplitude(self, channel: str) -> float:
        """Greatest command on an input."""
        return self.ranges[self.plant.inputs.index(channel)].size


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """Between low and high, alike for each decade."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def draw_scale(rng: Rng, names: tuple[str, ...] = PLANTS, *, n: int | None = None, rate: float | None = None) -> Scale:
    """A robot and a recording's size."""
    name = str(rng.choice(names))
    hz = rate or float(rng.choice(RATES, p=SHARES))
    dt = round(1.0 / hz, 6)
    parts = int(rng.choice([10, 12, 16])) if hz >= 100.0 else int(rng.choice([10, 15, 20]))
    steps = n or int(log_uniform(rng, 300, 3000))
    duration = steps * dt
    fastest = min(max(6.0 * dt, 0.12), duration / 15.0)
    pace = log_uniform(rng, fastest, max(min(2.5, duration / 12.0), 1.5 * fastest))
    speed = log_uniform(rng, 0.15, 3.0)
    forward = rng.random() < 0.35
    ahead = Range(0.0, speed) if forward else Range(-speed, speed)
    yaw = log_uniform(rng, 0.5, 3.5)
    turns = Range(-yaw, yaw)
    if name == "unicycle":
        return Scale(plants.unicycle(), dt, parts, steps, (ahead, turns), speed, yaw, pace)
    if name == "differential_drive":
        plant = plants.differential_drive(round(log_uniform(rng, 0.03, 0.3), 4), round(log_uniform(rng, 0.15, 1.0), 3))
        wheel = speed / plant.parameters["wheel_radius"]
        both = Range(-wheel, wheel) if not forward else Range(0.0, wheel)
        return Scale(plant, dt, parts, steps, (both, both), speed, 2.0 * speed / plant.parameters["track"], pace)
    if name == "bicycle":
        base = round(log_uniform(rng, 0.2, 3.0), 3)
        fast = speed * (3.0 if base > 1.0 else 1.0)
        steer = float(rng.uniform(0.25, 0.55))
        span = Range(0.0, fast) if rng.random() < 0.7 else Range(-fast, fast)
        return Scale(plants.bicycle(base), dt, parts, steps, (Range(-steer, steer), span), fast, fast * math.tan(steer) / base, pace)
    if name == "double_integrator":
        most = Range(-speed / pace, speed / pace)
        return Scale(plants.double_integrator(), dt, parts, steps, (most, most), speed, 0.0, pace)
    mass = round(log_uniform(rng, 0.1, 50.0), 3)
    push = mass * speed / pace
    return Scale(plants.joint(mass), dt, parts, steps, (Range(-push, push),), speed, 0.0, pace)
