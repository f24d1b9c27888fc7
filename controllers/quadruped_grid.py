"""Walks the grid task: as `grid` drives, with a walker's measures, towards whichever of its two ends faces the way better. It is slow to
turn (0.3 rad/s) and as good backward as forward, so from any heading it makes a quarter turn at most.

Where both ends face the way alike the answer flips, and either drives away from there. Stateless and batched: x (n, 3), u (n, 2) = v m/s,
w rad/s.
"""

import grid
import numpy as np

PARAMETERS = {
    "speed": 0.13,  # m/s
    "turn": 1.0,  # yaw rate per heading error, 1/s: one step of 0.1 s makes a tenth of the error good, so that it doesn't chase its sway
    "max_turn": 0.28,  # rad/s
    "aligned": 0.85,  # cosine of the heading error at which it begins to walk
    "lookahead": 0.8,  # m
    "body": 0.3,  # its disc, m
    "margin": 0.13,  # to obstacles, m
    "wall": 0.13,  # to the arena's wall, m
    "fade": 0.08,  # this far beside the gap that it aims at, it only goes sideways, m
    "keep": 0.0,  # nothing moves here
    "foresight": 0.0,
    "fear": 0.0,
    "wary": 0.0,
}


def control(x, theta, parameters):
    """u (n, 2)."""
    p = {**parameters, "max_turn": np.inf}
    turned = x.copy()
    turned[:, 2] += np.pi
    ahead, back = grid.control(x, theta, p), grid.control(turned, theta, p)
    backward = np.abs(back[:, 1]) < np.abs(ahead[:, 1])
    most = parameters["max_turn"]
    v = np.where(backward, -back[:, 0], ahead[:, 0])
    w = np.clip(np.where(backward, back[:, 1], ahead[:, 1]), -most, most)
    return np.stack([v, w], axis=1)
