"""Drives a unicycle to the goal of the task keep_out, around its disc. Stateless and batched.

x: (n, 3) = x m, y m, theta rad. theta: what the task lets a controller see (`view` of the task). u: (n, 2) = v m/s, w rad/s.
"""

import numpy as np

PARAMETERS = {"speed": 0.12, "turn": 3.0, "margin": 0.15}  # m/s; 1/s; m from the disc


def control(x, theta, parameters):
    """u (n, 2). It sees nothing but its arguments, and runs in a process of its own."""
    p = parameters
    to_goal, to_disc = theta["goal"] - x[:, :2], theta["disc"] - x[:, :2]
    far, near = np.hypot(*to_goal.T), np.hypot(*to_disc.T)
    wide = theta["disc_radius"] + p["margin"]
    bearing, beside = np.arctan2(to_goal[:, 1], to_goal[:, 0]), np.arctan2(to_disc[:, 1], to_disc[:, 0])
    half = np.where(near > wide, np.arcsin(np.minimum(wide / np.maximum(near, 1e-9), 1.0)), np.pi)
    off = wrapped(bearing - beside)
    blocked = (np.abs(off) < half) & (far > near * np.cos(np.minimum(np.abs(off), np.pi / 2.0)))
    heading = np.where(blocked, beside + np.where(off >= 0.0, half, -half), bearing)
    error = wrapped(heading - x[:, 2])
    return np.stack([p["speed"] * np.maximum(np.cos(error), 0.0) ** 4, np.clip(p["turn"] * error, -2.0, 2.0)], axis=1)


def wrapped(angle):
    return angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi))
