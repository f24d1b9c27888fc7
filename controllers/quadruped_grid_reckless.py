"""Walks the grid task without looking: straight to the goal, as `grid_reckless` drives, at a walker's speeds. x (n, 3), u (n, 2)."""

import grid_reckless

PARAMETERS = {
    "speed": 0.15,  # m/s
    "turn": 1.0,  # yaw rate per heading error, 1/s
    "max_turn": 0.3,  # rad/s
}


def control(x, theta, parameters):
    """u (n, 2)."""
    return grid_reckless.control(x, theta, parameters)
