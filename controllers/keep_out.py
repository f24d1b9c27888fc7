"""Drives a unicycle to a goal around one keep-out disc. Stateless and batched: x (n, 3), theta as `KeepOut.view` gives it.

It heads for the goal while the straight way passes the disc with `margin` to spare, otherwise for the nearer tangent of that wider
disc, on whichever side there is room;
inside of it, straight out. u (n, 2) = v m/s, w rad/s.
"""

import numpy as np

PARAMETERS = {
    "speed": 0.15,  # m/s
    "turn": 3.0,  # yaw rate per heading error, 1/s
    "max_turn": 2.0,  # rad/s
    "body": 0.055,  # its disc, m
    "margin": 0.05,  # to the disc and to the region's edge, m
}


def control(x, theta, parameters):
    """u (n, 2)."""
    p = parameters
    wide = theta["disc_radius"] + p["body"] + p["margin"]
    goal_x, goal_y = theta["goal"][:, 0] - x[:, 0], theta["goal"][:, 1] - x[:, 1]
    disc_x, disc_y = theta["disc"][:, 0] - x[:, 0], theta["disc"][:, 1] - x[:, 1]
    to_goal, to_disc = np.sqrt(goal_x * goal_x + goal_y * goal_y), np.sqrt(disc_x * disc_x + disc_y * disc_y)
    bearing, beside = np.arctan2(goal_y, goal_x), np.arctan2(disc_y, disc_x)
    off = _wrap(bearing - beside)
    # half the angle that the wider disc takes up; more than a right angle inside of it
    half = np.where(to_disc > wide, np.arcsin(np.minimum(wide / np.maximum(to_disc, 1e-9), 1.0)), np.pi)
    in_the_way = (np.abs(off) < half) & (to_goal > to_disc * np.cos(np.minimum(np.abs(off), np.pi / 2.0)))
    in_the_way |= to_disc <= wide
    side = np.where(off >= 0.0, 1.0, -1.0)
    side *= np.where(_room(x, theta, beside, side, wide, p) >= _room(x, theta, beside, -side, wide, p), 1.0, -1.0)
    around = beside + side * half
    error = _wrap(np.where(in_the_way, around, bearing) - x[:, 2])
    u = np.empty((2, len(x))).T
    u[:, 0] = p["speed"] * np.maximum((np.cos(error) - 0.8) / 0.2, 0.0)
    u[:, 1] = np.clip(p["turn"] * error, -p["max_turn"], p["max_turn"])
    return u


def _room(x, theta, beside, side, wide, p):
    """How far inside the region its disc would pass the keep-out disc on that side, m, at most 0: enough is enough, (n,)."""
    past = theta["disc"] + (side * wide)[:, None] * np.stack([-np.sin(beside), np.cos(beside)], axis=1)
    inside = np.minimum(past - theta["low"], theta["high"] - past).min(axis=1) - p["body"] - p["margin"]
    return np.minimum(inside, 0.0)


def _wrap(angle):
    return angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi))
