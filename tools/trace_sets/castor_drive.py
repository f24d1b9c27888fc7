"""A nominal model for the bench: two driven wheels that reach their speeds at once, arcs, and a castor behind the axle."""

import numpy as np

STATES = ("x", "y", "theta", "wheel_left", "wheel_right")
INPUTS = ("cmd_left", "cmd_right")
ANGLES = ("theta",)
PARAMS = {"wheel_radius": 0.05, "track": 0.3, "castor": 0.15}
UNITS = {"x": "m", "y": "m", "theta": "rad", "wheel_left": "rad/s", "wheel_right": "rad/s", "cmd_left": "rad/s", "cmd_right": "rad/s"}


def step(x, u, dt, params):
    """x (n, 5), u (n, 2) -> (n, 5)"""
    v = 0.5 * params["wheel_radius"] * (u[:, 0] + u[:, 1])
    w = params["wheel_radius"] * (u[:, 1] - u[:, 0]) / params["track"]
    half = 0.5 * dt * w
    chord = dt * v * np.sinc(half / np.pi)
    heading = x[:, 2] + half
    return np.column_stack([x[:, 0] + chord * np.cos(heading), x[:, 1] + chord * np.sin(heading), x[:, 2] + 2.0 * half, u[:, 0], u[:, 1]])
