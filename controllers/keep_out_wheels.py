"""The keep-out law (keep_out.py) for a base with two driven wheels: x (n, 5), u (n, 2) = wheel speeds, left and right, rad/s.

    left, right = (v -+ w track / 2) / radius

Both are scaled alike where one would leave its bound, so that the path's curvature stays.
"""

import keep_out
import numpy as np

PARAMETERS = {
    "speed": 0.45,  # m/s
    "turn": 2.0,  # yaw rate per heading error, 1/s
    "max_turn": 1.5,  # rad/s
    "body": 0.3,  # its disc, m
    "margin": 0.15,  # to the disc and to the region's edge, m
    "radius": 0.1,  # of its wheels, m
    "track": 0.4,  # between them, m
    "most": 6.0,  # rad/s at a wheel
}


def control(x, theta, parameters):
    """u (n, 2)."""
    p = parameters
    twist = keep_out.control(x[:, :3], theta, p)
    turn = 0.5 * p["track"] * twist[:, 1]
    wheels = np.stack([twist[:, 0] - turn, twist[:, 0] + turn], axis=1) / p["radius"]
    return wheels / np.maximum(np.abs(wheels).max(axis=1) / p["most"], 1.0)[:, None]
