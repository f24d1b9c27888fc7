"""Drives a rover to a goal around two keep-out areas. Stateless and batched: x (n, 3); theta: `goal`, `area_a`, `area_b` (`_x`, `_y`).

It heads for the goal. Where an area, widened by `margin`, is in the way, it heads past that area on the side that costs the smaller turn
and has room inside the region. Between the widened area and the area itself it turns outward, the more so the deeper it is. It slows down
before turns and at the goal: a rover needs 0.2 s until a command acts, and a second to stop. u (n, 2) = v m/s, w rad/s.
"""

import numpy as np

PARAMETERS = {
    "speed": 0.8,  # m/s
    "slow": 0.8,  # of the distance to the goal, 1/s: the speed at most
    "least": 0.4,  # m/s, near the goal
    "turn": 2.0,  # yaw rate per heading error, 1/s
    "max_turn": 0.98,  # rad/s
    "area": 1.2,  # radius of a keep-out area with the rover's own, m; as in the task
    "margin": 1.0,  # m
    "edge": 6.8,  # the rover keeps within this of the origin on each axis, m
    "aligned": 0.6,  # cosine of the heading error below which it turns on the spot
}
BOUNDS = {"speed": [0.4, 1.0], "turn": [0.6, 2.0], "margin": [0.3, 1.2], "aligned": [0.2, 0.9]}


def control(x, theta, parameters):
    """u (n, 2)."""
    p = parameters
    to_goal = np.hypot(theta["goal_x"] - x[:, 0], theta["goal_y"] - x[:, 1])
    bearing = np.arctan2(theta["goal_y"] - x[:, 1], theta["goal_x"] - x[:, 0])
    heading, nearest = bearing.copy(), np.full(len(x), np.inf)
    for name in ("area_a", "area_b"):
        around, distance = _past(x, theta[name + "_x"], theta[name + "_y"], bearing, to_goal, p)
        first = np.isfinite(around) & (distance < nearest)
        heading, nearest = np.where(first, around, heading), np.where(first, distance, nearest)
    error = _wrap(heading - x[:, 2])
    speed = np.minimum(p["speed"], np.maximum(p["slow"] * to_goal, p["least"]))
    u = np.empty((2, len(x))).T
    u[:, 0] = speed * np.clip((np.cos(error) - p["aligned"]) / (1.0 - p["aligned"]), 0.0, 1.0)
    u[:, 1] = np.clip(p["turn"] * error, -p["max_turn"], p["max_turn"])
    return u


def _past(x, area_x, area_y, bearing, to_goal, p):
    """Heading past an area, rad, NaN where it is not in the way; and the distance of its centre, m."""
    wide = p["area"] + p["margin"]
    dx, dy = area_x - x[:, 0], area_y - x[:, 1]
    distance, beside = np.hypot(dx, dy), np.arctan2(dy, dx)
    off = _wrap(bearing - beside)
    half = np.where(distance > wide, np.arcsin(np.minimum(wide / np.maximum(distance, 1e-9), 1.0)), np.pi / 2.0)
    deep = np.clip((wide - distance) / p["margin"], 0.0, 1.0)  # 0 on the widened circle, 1 at the area itself
    half = half + deep * (np.pi / 2.0)
    is_between = (np.abs(off) < half) & (to_goal > distance * np.cos(np.minimum(np.abs(off), np.pi / 2.0)))
    side = np.where(off >= 0.0, 1.0, -1.0)
    left, right = _room(area_x, area_y, beside, side, wide, p), _room(area_x, area_y, beside, -side, wide, p)
    side = np.where(left >= right, side, -side)
    return np.where(is_between, beside + side * half, np.nan), distance


def _room(area_x, area_y, beside, side, wide, p):
    """How far inside the region it would pass there, m, at most 0: enough is enough."""
    past_x, past_y = area_x - side * wide * np.sin(beside), area_y + side * wide * np.cos(beside)
    return np.minimum(p["edge"] - np.maximum(np.abs(past_x), np.abs(past_y)), 0.0)


def _wrap(angle):
    return angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi))
