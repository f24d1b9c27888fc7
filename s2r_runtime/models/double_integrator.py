"""Planar double integrator (docs/recordings.md), exact for an input that is constant over the step.

p+ = p + dt v + dt²/2 a,  v+ = v + dt a,  for each axis
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Follows

Array = NDArray[np.float64]


class DoubleIntegrator:
    """x: (n, 4) = x m, y m, vx m/s, vy m/s. u: (n, 2) = ax, ay m/s²."""

    name = "double_integrator"
    states = ("x", "y", "vx", "vy")
    inputs = ("ax", "ay")
    angles = ()
    parameters: dict[str, float] = {}
    follows = {
        "vx": Follows(("x",), lambda x, rates, parameters: rates["x"]),
        "vy": Follows(("y",), lambda x, rates, parameters: rates["y"]),
    }
    uneven = True
    linear = True
    units = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "ax": "m/s²", "ay": "m/s²"}

    def step(self, x: Array, u: Array, dt: float | Array, parameters: dict[str, float]) -> Array:
        """One step of dt seconds, (n, 4)."""
        after = np.empty_like(x)
        for axis in (0, 1):  # a column at a time: numpy runs along many rows faster than along two columns
            after[:, axis] = x[:, axis] + dt * x[:, 2 + axis] + 0.5 * dt * dt * u[:, axis]
            after[:, 2 + axis] = x[:, 2 + axis] + dt * u[:, axis]
        return after


MODEL = DoubleIntegrator()
