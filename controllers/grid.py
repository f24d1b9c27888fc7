"""Drives the grid task: along the shortest path, close around obstacles, and out of the way of what moves.

Designed on the nominal model, where a margin of under 2 cm is plenty. Stateless and batched: x (n, 3), theta as `GridWorld.view`
gives it, u (n, 2) = v m/s, w rad/s.

1. Where to: of its own cell and the four around it, the one with the least cost: the way that is left, plus a price on coming near a
   moving obstacle, where it is now and where it will be.
2. How: towards the edge that it shares with that cell. Usually it keeps its line, and cuts the corner if a turn comes next; near a
   moving obstacle it keeps to the middle of the cells, so that it can turn back.
3. Steering: it turns towards a point `lookahead` ahead, and drives as far as it faces it.
"""

import numpy as np

PARAMETERS = {
    "speed": 0.15,  # m/s
    "turn": 4.4,  # yaw rate per heading error, 1/s
    "max_turn": 2.5,  # rad/s: with it the wheels still reach 0.07 m/s forward
    "aligned": 0.88,  # cosine of the heading error at which it begins to drive
    "lookahead": 0.43,  # m
    "body": 0.055,  # its disc, m
    "margin": 0.0175,  # to obstacles, m
    "wall": 0.06,  # to the arena's wall, m
    "fade": 0.027,  # this far beside the gap that it aims at, it only goes sideways, m
    "keep": 0.3,  # from a moving obstacle to the middle of a cell that it chooses, m
    "foresight": 2.0,  # s
    "fear": 20.0,  # price of each metre of `keep` that is missing, in metres of way
    "wary": 0.4,  # nearer than this to a moving obstacle it keeps to the middle, m
}


def control(x, theta, parameters):
    """u (n, 2)."""
    p = parameters
    cell, left, bottom = theta["cell"][0], theta["left"][0], theta["bottom"][0]
    rows, width = theta["distance"].shape[1:]
    px, py = x[:, 0], x[:, 1]
    column = np.floor(np.clip((px - left) / cell + 1.0, 1.0, width - 1.5))
    row = np.floor(np.clip((py - bottom) / cell + 1.0, 1.0, rows - 1.5))
    centre_x, centre_y = left + cell * (column - 0.5), bottom + cell * (row - 0.5)
    at = np.arange(len(x)) * (rows * width) + (row * width + column).astype(np.int64)
    distance = theta["distance"].ravel()

    go_x, go_y, wary = _choose(px, py, centre_x, centre_y, at, distance, theta, p)
    stay = (go_x == 0.0) & (go_y == 0.0)
    side = _turn_after(at, go_x, go_y, width, distance)

    # in the frame of the way to the next cell: `along` it, and `across` to the left, from the middle of this cell
    off_x, off_y = px - centre_x, py - centre_y
    across = off_y * go_x - off_x * go_y
    room = np.where(wary, 0.0, cell / 2.0 - p["body"] - p["margin"])
    line = np.where(side == 0.0, np.clip(across, -room, room), side * room)
    # beside the gap it goes sideways first, and ahead only as it comes in front of it
    outside = np.abs(across) - room - np.where(wary, 0.07, 0.0)
    ahead = p["lookahead"] * np.clip(1.0 - outside / np.where(wary, 0.07, p["fade"]), 0.0, 1.0)
    to_x = np.where(stay, -off_x, ahead * go_x - (line - across) * go_y)
    to_y = np.where(stay, -off_y, ahead * go_y + (line - across) * go_x)
    inset = p["body"] + p["wall"]
    to_x = np.clip(px + to_x, left + inset, left + (width - 2) * cell - inset) - px
    to_y = np.clip(py + to_y, bottom + inset, bottom + (rows - 2) * cell - inset) - py

    error = np.arctan2(to_y, to_x) - x[:, 2]
    error -= 2.0 * np.pi * np.rint(error / (2.0 * np.pi))
    effort = np.where(stay, np.minimum(np.sqrt(to_x * to_x + to_y * to_y) / 0.05, 1.0), 1.0)
    u = np.empty((2, len(x))).T
    u[:, 0] = effort * p["speed"] * np.maximum((np.cos(error) - p["aligned"]) / (1.0 - p["aligned"]), 0.0)
    u[:, 1] = effort * np.clip(p["turn"] * error, -p["max_turn"], p["max_turn"])
    return u


def _choose(px, py, centre_x, centre_y, at, distance, theta, p):
    """Direction to the cell of least cost, -1, 0 or 1 by axis (n,) each, and whether something that moves is near (n,)."""
    width, none = theta["distance"].shape[2], np.zeros(len(px))
    away = _Away(px, py, centre_x, centre_y, theta, p) if theta["mover_x"].shape[1] else None
    best, go_x, go_y = distance.take(at), none, none
    if away:
        best = best + p["fear"] * np.maximum(p["keep"] - away.here, 0.0)
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        cost = distance.take(at + (dy * width + dx))
        if away:
            cost += p["fear"] * np.maximum(p["keep"] - away.there(dx, dy), 0.0)
        better = cost < best
        best = np.minimum(cost, best)
        go_x, go_y = np.where(better, float(dx), go_x), np.where(better, float(dy), go_y)
    return go_x, go_y, away.near_robot < p["wary"] if away else none > 0.0


class _Away:
    """Distances from the nearest moving obstacle, m, (n,). All squared distances are |m - d c|^2 = |m|^2 - 2 c m.d + c^2 to a point c
    along the direction d, with m measured from the middle of the cell, or from half way between that and the robot.
    """

    def __init__(self, px, py, centre_x, centre_y, theta, p):
        cell = theta["cell"][0]
        now_x, now_y = theta["mover_x"] - centre_x[:, None], theta["mover_y"] - centre_y[:, None]
        ahead = np.minimum(p["foresight"], theta["time_left"])[:, None]
        later_x, later_y = now_x + ahead * theta["mover_vx"], now_y + ahead * theta["mover_vy"]
        off_x, off_y = (px - centre_x)[:, None], (py - centre_y)[:, None]
        half_x, half_y = now_x - 0.5 * off_x, now_y - 0.5 * off_y
        now, later, half = now_x * now_x + now_y * now_y, later_x * later_x + later_y * later_y, half_x * half_x + half_y * half_y
        self.here = np.sqrt(np.minimum(now, later).min(axis=1))
        self.near_robot = np.sqrt(((now_x - off_x) ** 2 + (now_y - off_y) ** 2).min(axis=1))
        # of the middle of the next cell, now and later; of the edge before it, and half way from the robot to that edge, now
        edge, between = (now_x, now_y, now, cell / 2.0), (half_x, half_y, half, cell / 4.0)
        points = ((now_x, now_y, now, cell), (later_x, later_y, later, cell), edge, between)
        self.points = [((2.0 * c) * x, (2.0 * c) * y, square + c * c) for x, y, square, c in points]

    def there(self, dx, dy):
        """Of the way to the next cell in that direction."""
        near = None
        for x, y, square in self.points:
            along = x if dx else y
            apart = square - along if dx + dy > 0 else square + along
            near = apart if near is None else np.minimum(near, apart, out=near)
        return np.sqrt(np.maximum(near.min(axis=1), 0.0))


def _turn_after(at, go_x, go_y, width, distance):
    """The turn that the shortest path takes in the next cell: 1 left, -1 right, 0 none, (n,)."""
    step = (go_x + go_y * width).astype(np.int64)
    to_left = (go_x * width - go_y).astype(np.int64)
    after = at + step
    on, left, right = (distance.take(after + way, mode="clip") for way in (step, to_left, -to_left))
    turns = np.minimum(left, right) < np.minimum(distance.take(after), on)
    return np.where(turns, np.where(left < right, 1.0, -1.0), 0.0)
