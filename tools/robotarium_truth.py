"""The Robotarium's robot as its data sheet has it, many at once, and the paper's sampling procedure on it (section V), reading by reading.

    wheels      right, left = v +- w track/2, each clipped to +-0.2 m/s;  the pose moves along the arc of what they then do
    latency     the command that acts in a period is the one before the newest
    noise       of every measured pose: 0.2 mm, 1 mrad

The paper leaves open what still acts when a sample's input begins. `Before`: `random`, the previous sample's input (holds back to
back); `stopped`, nothing (a full stop); `arriving`, the last command of the law that drove to the waypoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from bench_coverage import INPUTS, MARGIN, PATIENCE, REGION, go_to
from numpy.typing import NDArray

from s2r_runtime.models.composed import wrap

Array = NDArray[np.float64]
Before = Literal["random", "stopped", "arriving"]

DT, TRACK, WHEEL_SPEED, ARRIVED, HOLD = 0.033, 0.105, 0.2, 0.1, 50
NOISE = np.array([0.0002, 0.0002, 0.001])


@dataclass(frozen=True)
class Samples:
    """N holds. path: (HOLD + 1, N, 3) measured poses, heading in (-pi, pi]; u: (N, 2), held from path[0] on."""

    path: Array
    u: Array

    def errors(self, step: int = 0) -> Array:
        """(N, 3) measured less foretold by the paper's model, over one period from `step`; heading not wrapped."""
        before, after = self.path[step], self.path[step + 1]
        return after - before - DT * np.column_stack(_rates(before, self.u))

    def held_errors(self) -> Array:
        """(N, 3) as `errors`, over the whole hold."""
        x = self.path[0]
        for _ in range(HOLD):
            x = x + DT * np.column_stack(_rates(x, self.u))
        return self.path[-1] - x


def _rates(x: Array, u: Array) -> tuple[Array, Array, Array]:
    return u[:, 0] * np.cos(x[:, 2]), u[:, 0] * np.sin(x[:, 2]), u[:, 1]


def moved(x: Array, u: Array, *, saturated: bool = True) -> Array:
    """(N, 3) one period later, heading wrapped."""
    v, w = u[:, 0], u[:, 1]
    if saturated:
        right, left = (np.clip(v + side * 0.5 * TRACK * w, -WHEEL_SPEED, WHEEL_SPEED) for side in (1.0, -1.0))
        v, w = 0.5 * (right + left), (right - left) / TRACK
    half = 0.5 * DT * w
    chord = DT * v * np.sinc(half / np.pi)
    return np.column_stack([x[:, 0] + chord * np.cos(x[:, 2] + half), x[:, 1] + chord * np.sin(x[:, 2] + half), wrap(x[:, 2] + 2.0 * half)])


def campaign(
    n: int, before: Before, rng: np.random.Generator, *, latency: bool = True, saturated: bool = True, periods: int = HOLD
) -> Samples:
    """n samples, independent: each robot is sent to a waypoint of its own, and holds one random input from there."""
    x = np.column_stack([rng.uniform(-REGION, REGION, (n, 2)), rng.uniform(-np.pi, np.pi, n)])
    acting = np.zeros((n, 2))
    if before == "random":
        acting = rng.uniform(-INPUTS, INPUTS, (n, 2))
    elif before == "arriving":
        x, acting = _arrived(n, rng)
    u = rng.uniform(-INPUTS, INPUTS, (n, 2))
    path = [x]
    for period in range(periods):
        x = moved(x, acting if latency and period == 0 else u, saturated=saturated)
        path.append(x)
    measured = np.stack(path) + NOISE * rng.standard_normal((periods + 1, n, 3))
    measured[..., 2] = wrap(measured[..., 2])
    return Samples(measured, u)


ARRIVALS = 6_000
"""Robots that are driven to a waypoint once; campaigns draw their poses on arrival from these."""


@lru_cache(maxsize=1)
def _arrivals() -> tuple[Array, Array]:
    """Poses on arrival at a random waypoint, and the command that is then acting."""
    rng = np.random.default_rng(ARRIVALS)
    x = np.column_stack([rng.uniform(-REGION, REGION, (ARRIVALS, 2)), rng.uniform(-np.pi, np.pi, ARRIVALS)])
    target = rng.uniform(-(REGION - MARGIN), REGION - MARGIN, (ARRIVALS, 2))
    acting = np.zeros((ARRIVALS, 2))
    driving = np.arange(ARRIVALS)
    for _ in range(PATIENCE):
        away = target[driving] - x[driving, :2]
        driving = driving[np.hypot(away[:, 0], away[:, 1]) > ARRIVED]
        if not len(driving):
            break
        x[driving], acting[driving] = moved(x[driving], acting[driving]), go_to(x[driving], target[driving])
    return x, acting


def _arrived(n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    x, acting = _arrivals()
    chosen = rng.integers(0, ARRIVALS, n)
    return x[chosen], acting[chosen]
