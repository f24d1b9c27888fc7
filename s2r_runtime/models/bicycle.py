"""Kinematic bicycle about the rear axle (docs/recordings.md): speed reaches its command at once, pose by Euler with the new speed.

speed+ = speed_cmd,  x+ = x + dt speed+ cos(theta),  y+ = y + dt speed+ sin(theta),  theta+ = theta + dt speed+ tan(steer_cmd) / L
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Follows

Array = NDArray[np.float64]


def _speed(x: dict[str, Array], rates: dict[str, Array], parameters: dict[str, float]) -> Array:
    """Of the rear axle along the heading, (n,): what it does not say is how fast it slides."""
    return np.asarray(np.cos(x["theta"]) * rates["x"] + np.sin(x["theta"]) * rates["y"])


class Bicycle:
    """x: (n, 4) = x m, y m, theta rad, speed m/s. u: (n, 2) = steer_cmd rad, speed_cmd m/s. Parameter: wheel_base L m."""

    name = "bicycle"
    states = ("x", "y", "theta", "speed")
    inputs = ("steer_cmd", "speed_cmd")
    angles = ("theta",)
    parameters: dict[str, float] = {"wheel_base": 0.33}
    follows = {"speed": Follows(("x", "y", "theta"), _speed)}
    uneven = True
    units = {"x": "m", "y": "m", "theta": "rad", "speed": "m/s", "steer_cmd": "rad", "speed_cmd": "m/s"}
    integration = "euler"
    reached = {"speed": "speed_cmd"}
    within = {"steer_cmd": math.pi / 2.0}
    """Below which an input means something: tan."""

    def step(self, x: Array, u: Array, dt: float | Array, parameters: dict[str, float]) -> Array:
        """One step of dt seconds, (n, 4); theta is not wrapped."""
        theta = x[:, 2]
        travel = dt * u[:, 1]
        after = np.empty_like(x)
        after[:, 0] = x[:, 0] + travel * np.cos(theta)
        after[:, 1] = x[:, 1] + travel * np.sin(theta)
        after[:, 2] = theta + travel * np.tan(u[:, 0]) / parameters["wheel_base"]
        after[:, 3] = u[:, 1]
        return after


MODEL = Bicycle()
