import numpy as np

PARAMETERS = {"speed": 0.18, "turn": 4.0, "max_turn": 2.5}


def control(x, theta, parameters):
    p = parameters
    dx = theta["goals"][:, :, 0] - x[:, :1]
    dy = theta["goals"][:, :, 1] - x[:, 1:2]
    nearest = np.argmin(dx * dx + dy * dy, axis=1)
    rows = np.arange(len(x))
    error = np.arctan2(dy[rows, nearest], dx[rows, nearest]) - x[:, 2]
    error -= 2 * np.pi * np.rint(error / (2 * np.pi))
    return np.stack([p["speed"] * np.maximum(np.cos(error), 0.0), np.clip(p["turn"] * error, -p["max_turn"], p["max_turn"])], axis=1)
