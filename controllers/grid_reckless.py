"""Drives the grid task without looking: straight to the nearest goal. What verification is there to refuse.

x (n, 3), theta as `GridWorld.view` gives it, u (n, 2) = v m/s, w rad/s.
"""

import numpy as np

PARAMETERS = {
    "speed": 0.18,  # m/s
    "turn": 4.0,  # yaw rate per heading error, 1/s
    "max_turn": 2.5,  # rad/s
}


def control(x, theta, parameters):
    """u (n, 2)."""
    p = parameters
    to_x, to_y = theta["goals"][:, :, 0] - x[:, :1], theta["goals"][:, :, 1] - x[:, 1:2]
    nearest = np.argmin(to_x * to_x + to_y * to_y, axis=1)[:, None]
    bearing = np.arctan2(np.take_along_axis(to_y, nearest, axis=1), np.take_along_axis(to_x, nearest, axis=1))[:, 0]
    error = bearing - x[:, 2]
    error -= 2.0 * np.pi * np.rint(error / (2.0 * np.pi))
    forward = p["speed"] * np.maximum(np.cos(error), 0.0)
    return np.stack([forward, np.clip(p["turn"] * error, -p["max_turn"], p["max_turn"])], axis=1)
