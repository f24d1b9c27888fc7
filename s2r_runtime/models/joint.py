"""One joint driven by a force (or, with an inertia for the mass, by a torque), exact for an input constant over the step.

a = force / mass,  q+ = q + dt qd + dt²/2 a,  qd+ = qd + dt a   (docs/recordings.md)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Follows

Array = NDArray[np.float64]


class Joint:
    """x: (n, 2) = q m, qd m/s. u: (n, 1) = force N. Parameter: mass kg. For a torque: rad, rad/s, N m, kg m²."""

    name = "joint"
    states = ("q", "qd")
    inputs = ("force",)
    angles = ()
    parameters: dict[str, float] = {"mass": 1.0}
    follows = {"qd": Follows(("q",), lambda x, rates, parameters: rates["q"])}
    uneven = True
    units = {"q": "m", "qd": "m/s", "force": "N"}

    def step(self, x: Array, u: Array, dt: float | Array, parameters: dict[str, float]) -> Array:
        """One step of dt seconds, (n, 2)."""
        acceleration = u[:, 0] / parameters["mass"]
        after = np.empty_like(x)
        after[:, 0] = x[:, 0] + dt * x[:, 1] + 0.5 * dt * dt * acceleration
        after[:, 1] = x[:, 1] + dt * acceleration
        return after


MODEL = Joint()
