"""Unicycle (paper, eq. experimental_systems): Euler with the heading at the start of the step.

x+ = x + dt v cos(theta),  y+ = y + dt v sin(theta),  theta+ = theta + dt w
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Unicycle:
    """x: (n, 3) = x m, y m, theta rad. u: (n, 2) = v m/s, w rad/s."""

    name = "unicycle"
    states = ("x", "y", "theta")
    inputs = ("v", "w")
    angles = ("theta",)
    parameters: dict[str, float] = {}
    uneven = True
    units = {"x": "m", "y": "m", "theta": "rad", "v": "m/s", "w": "rad/s"}
    integration = "euler"

    def step(self, x: Array, u: Array, dt: float | Array, parameters: dict[str, float]) -> Array:
        """One Euler step of dt seconds, (n, 3); theta is not wrapped."""
        after = np.empty_like(x)
        theta = x[:, 2]
        travel = dt * u[:, 0]
        after[:, 0] = x[:, 0] + travel * np.cos(theta)
        after[:, 1] = x[:, 1] + travel * np.sin(theta)
        after[:, 2] = theta + dt * u[:, 1]
        return after


MODEL = Unicycle()
