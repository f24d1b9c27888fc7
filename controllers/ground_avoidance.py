"""Rolls the wings level, pulls out of the dive, then holds the path level."""

import numpy as np

PARAMETERS = {"pull": 5.0, "roll_gain": 2.0, "path_gain": 4.0, "upright": 0.6}


def control(x, theta, parameters):
    """x (n, 5): altitude, speed, gamma, roll, load -> (n, 2): load_cmd, roll_rate."""
    speed, gamma, roll = x[:, 1], x[:, 2], x[:, 3]
    level = np.cos(gamma) / np.maximum(np.cos(roll), 0.3) - parameters["path_gain"] * speed / 9.81 * gamma * 0.25
    load = np.where(np.abs(roll) < parameters["upright"], np.clip(level, -1.0, parameters["pull"]), 1.0)
    return np.column_stack([load, np.clip(-parameters["roll_gain"] * roll, -2.0, 2.0)])
