"""An aircraft as a point mass that pulls and rolls: enough to ask whether it recovers from a dive. Metres, seconds, radians.

altitude' = speed sin(gamma)              gamma' = g (load cos(roll) - cos(gamma)) / speed
speed'    = -g sin(gamma)                 roll'  = roll_rate
load'     = (load_cmd - load) / lag       (thrust and drag cancel)
"""

import numpy as np

STATES = ("altitude", "speed", "gamma", "roll", "load")
INPUTS = ("load_cmd", "roll_rate")
ANGLES = ("roll",)
PARAMS = {"lag": 0.3, "g": 9.81}
PARTS = 4  # a step in so many Euler steps: the errors are then far below the gap


def step(x, u, dt, params):
    """(n, 5) one step later."""
    altitude, speed, gamma, roll, load = x.T
    for _ in range(PARTS):
        h = dt / PARTS
        altitude, speed, gamma, roll, load = (
            altitude + h * speed * np.sin(gamma),
            np.maximum(speed - h * params["g"] * np.sin(gamma), 1.0),
            gamma + h * params["g"] * (load * np.cos(roll) - np.cos(gamma)) / np.maximum(speed, 1.0),
            roll + h * u[:, 1],
            load + h * (u[:, 0] - load) / params["lag"],
        )
    return np.column_stack([altitude, speed, gamma, roll, load])
