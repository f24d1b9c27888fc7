"""Walks the grid task with a robot that is slow to turn (0.3 rad/s), as good backward as forward, and may be pushed while it does either.

Designed on the nominal model. Stateless and batched: x (n, 3), theta as `GridWorld.view` gives it, u (n, 2) = v m/s, w rad/s.

1. Where to: of the four cells around its own, the one from which the way is shortest.
2. How: along the line through the middle of its own cell and that one. Beside it, it goes sideways first, ahead only as it nears it.
3. Steering: with whichever of its two ends faces the way better, from any heading at most a quarter turn. It walks as far as it faces
   the way; while it turns, it goes back and forth towards the line, so that what pushes it takes it no farther than it must.
"""

import numpy as np

PARAMETERS = {
    "speed": 0.115,  # m/s
    "turn": 0.7,  # yaw rate per heading error, 1/s: more than 1 would turn too far in a step of a second
    "max_turn": 0.3,  # rad/s
    "aligned": 0.69,  # cosine of the heading error at which it begins to walk
    "lookahead": 0.41,  # m: what pushes it sideways at 1 cm/s holds it 4 cm off the line
    "body": 0.3,  # its disc, m
    "margin": 0.195,  # to obstacles, m
    "fade": 0.65,  # this far beside the line it only goes sideways, m
    "hold": 0.16,  # speed towards the line per distance from it, 1/s
}


def control(x, theta, parameters):
    """u (n, 2)."""
    p = parameters
    cell, left, bottom = theta["cell"][0], theta["left"][0], theta["bottom"][0]
    rows, width = theta["distance"].shape[1:]
    column = np.floor(np.clip((x[:, 0] - left) / cell + 1.0, 1.0, width - 1.5))
    row = np.floor(np.clip((x[:, 1] - bottom) / cell + 1.0, 1.0, rows - 1.5))
    off_x, off_y = x[:, 0] - left - cell * (column - 0.5), x[:, 1] - bottom - cell * (row - 0.5)
    at = np.arange(len(x)) * (rows * width) + (row * width + column).astype(np.int64)
    go_x, go_y = _choose(at, theta["distance"].ravel(), width)

    # in the frame of the way to the next cell: `across` to its left, `side` how far the line is to the left of the robot
    across = off_y * go_x - off_x * go_y
    room = max(cell / 2.0 - p["body"] - p["margin"], 0.0)
    side = np.clip(across, -room, room) - across
    ahead = p["lookahead"] * np.clip(1.0 - np.abs(side) / p["fade"], 0.0, 1.0)
    stay = (go_x == 0.0) & (go_y == 0.0)
    to_x = np.where(stay, -off_x, ahead * go_x - side * go_y)
    to_y = np.where(stay, -off_y, ahead * go_y + side * go_x)

    error = np.arctan2(to_y, to_x) - x[:, 2]
    error -= np.pi * np.rint(error / np.pi)  # of the end that faces the way better
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    end = np.where(to_x * c + to_y * s >= 0.0, 1.0, -1.0)
    facing = np.maximum((np.cos(error) - p["aligned"]) / (1.0 - p["aligned"]), 0.0)
    walking = np.where(stay, 0.0, end * p["speed"] * facing)
    sideways = np.where(stay, 0.0, go_x * s - go_y * c)  # of its heading: what is left of that is no way to the line
    holding = p["hold"] * side * sideways * np.maximum((np.abs(sideways) - p["aligned"]) / (1.0 - p["aligned"]), 0.0)
    v = np.clip(walking + (1.0 - facing) * holding, -p["speed"], p["speed"])
    w = np.where(stay, 0.0, np.clip(p["turn"] * error, -p["max_turn"], p["max_turn"]))
    return np.stack([v, w], axis=1)


def _choose(at, distance, width):
    """Direction to the nearest of the four neighbours, -1, 0 or 1 by axis (n,) each; 0 where none is nearer than its own cell."""
    best, go_x, go_y = distance.take(at), np.zeros(len(at)), np.zeros(len(at))
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        there = distance.take(at + (dy * width + dx))
        better = there < best
        best = np.minimum(there, best)
        go_x, go_y = np.where(better, float(dx), go_x), np.where(better, float(dy), go_y)
    return go_x, go_y
