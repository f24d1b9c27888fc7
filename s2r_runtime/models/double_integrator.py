"""Planar double integrator (docs/tracing.md), exact for an input that is constant over the step.

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
    units = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "ax": "m/s²", "ay": "m/s²"}

    def step(self, x: Array, u: Array, dt: float | Array, parameters: dict[str, float]) -> Array:
        """One step of dt seconds, (n, 4)."""
        dt = dt[:, None] if isinstance(dt, np.ndarray) else dt
        after = np.empty_like(x)
        after[:, :2] = x[:, :2] + dt * x[:, 2:] + 0.5 * dt * dt * u
        after[:, 2:] = x[:, 2:] + dt * u
        return after


MODEL = DoubleIntegrator()
