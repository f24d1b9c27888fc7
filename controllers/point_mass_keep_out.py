"""Drives a point mass (`double_integrator`) to a goal around one keep-out disc, by linear feedback. Batched: x (n, 4), theta as
`KeepOut.view` gives it, u (n, 2) = ax, ay m/s².

The reference is next to the disc at first, and the goal afterwards, as the time says. It never sees the state, and `control` has the form
that `s2r_runtime.controllers.linear_feedback` recognises. So every scenario can be enclosed: no disturbance in the gap set leaves its tube.
"""

import numpy as np

PARAMETERS = {
    "horizon": 300.0,  # steps of the task, for the time since its start
    "step": 0.1,  # s
    "around": 6.0,  # s; until then it makes for the point next to the disc
    "body": 0.055,  # its disc, m
    "room": 0.3,  # beyond the disc and the body, m
}
GAIN = [[1.0, 0.0, 2.0, 0.0], [0.0, 1.0, 0.0, 2.0]]  # 1/s², 1/s


def reference(theta, parameters):
    """Target (n, 4) and feedforward (n, 2)."""
    p = parameters
    goal, disc = theta["goal"], theta["disc"]
    way = goal - disc
    way = way / np.maximum(np.sqrt((way * way).sum(axis=1, keepdims=True)), 1e-9)
    across = np.stack([-way[:, 1], way[:, 0]], axis=1)
    off = theta["disc_radius"][0] + p["body"] + p["room"]
    sides = [disc + side * off * across for side in (1.0, -1.0)]
    rooms = [np.minimum(point - theta["low"], theta["high"] - point).min(axis=1) for point in sides]
    next_to = np.where((rooms[0] >= rooms[1])[:, None], sides[0], sides[1])
    passed = p["horizon"] * p["step"] - theta["time_left"]
    target = np.zeros((len(goal), 4))
    target[:, :2] = np.where((passed < p["around"])[:, None], next_to, goal)
    return target, np.zeros((len(goal), 2))


def control(x, theta, parameters):
    """u (n, 2)."""
    target, feedforward = reference(theta, parameters)
    return feedforward - (x - target) @ np.array(GAIN).T
