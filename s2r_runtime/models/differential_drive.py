"""Differential drive (docs/recordings.md): wheels reach their command at once, pose by Euler with the new wheel speeds.

left+ = cmd_left,  right+ = cmd_right,  v = R (left+ + right+) / 2,  w = R (right+ - left+) / track
x+ = x + dt v cos(theta),  y+ = y + dt v sin(theta),  theta+ = theta + dt w
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Follows

Array = NDArray[np.float64]


def _wheel(side: float, x: dict[str, Array], rates: dict[str, Array], parameters: dict[str, float]) -> Array:
    """Speed of a wheel that does not slip, (n,) rad/s; side: its place across the robot over the track."""
    forward = np.cos(x["theta"]) * rates["x"] + np.sin(x["theta"]) * rates["y"]
    return np.asarray((forward + side * parameters["track"] * rates["theta"]) / parameters["wheel_radius"])


class DifferentialDrive:
    """x: (n, 5) = x m, y m, theta rad, wheel_left rad/s, wheel_right rad/s. u: (n, 2) = cmd_left, cmd_right rad/s.

    Parameters: wheel_radius R m, track (distance between the wheels) m.
    """

    name = "differential_drive"
    states = ("x", "y", "theta", "wheel_left", "wheel_right")
    inputs = ("cmd_left", "cmd_right")
    angles = ("theta",)
    parameters: dict[str, float] = {"wheel_radius": 0.1, "track": 0.5}
    follows = {
        "wheel_left": Follows(("x", "y", "theta"), partial(_wheel, -0.5)),
        "wheel_right": Follows(("x", "y", "theta"), partial(_wheel, 0.5)),
    }
    uneven = True
    units = {"x": "m", "y": "m", "theta": "rad", "wheel_left": "rad/s", "wheel_right": "rad/s", "cmd_left": "rad/s", "cmd_right": "rad/s"}
    integration = "euler"
    reached = {"wheel_left": "cmd_left", "wheel_right": "cmd_right"}

    def step(self, x: Array, u: Array, dt: float | Array, parameters: dict[str, float]) -> Array:
        """One step of dt seconds, (n, 5); theta is not wrapped."""
        radius, track = parameters["wheel_radius"], parameters["track"]
        theta = x[:, 2]
        travel = dt * radius * (u[:, 0] + u[:, 1]) / 2.0
        after = np.empty_like(x)
        after[:, 0] = x[:, 0] + travel * np.cos(theta)
        after[:, 1] = x[:, 1] + travel * np.sin(theta)
        after[:, 2] = theta + dt * radius * (u[:, 1] - u[:, 0]) / track
        after[:, 3:] = u
        return after


MODEL = DifferentialDrive()
