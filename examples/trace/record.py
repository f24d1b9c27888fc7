"""Simulates a wheeled robot in 50 substeps per sample and writes recordings of it.

python record.py lag FILE                     speed follows its command with a time constant of 0.3 s
python record.py weak FILE                    the robot achieves 80 % of the commanded yaw rate, and turns at 0 or 1 rad/s only
python record.py weak FILE --inputs CSV       the same robot, driven with the inputs of a table
python record.py floor FILE                   the floor is wavy: the robot slows and accelerates with its position
"""

import argparse
import csv
from pathlib import Path

import numpy as np

DT, PARTS = 0.05, 50
NOISE = np.array([0.001, 0.001, 0.002])  # m, m, rad: standard deviation of a measurement
TIME_CONSTANT = 0.3  # s
DECAY = float(np.exp(-DT / PARTS / TIME_CONSTANT))  # of the speed's error in one substep
YAW_GAIN = 0.8
WAVES, HEIGHT = 0.9, 0.15  # m, share of the speed


def commands(rng: np.random.Generator, seconds: float) -> np.ndarray:
    """(K, 2) m/s and rad/s: each level is held for 0.2 to 2 s, in both directions, with rests."""
    rows: list[list[float]] = []
    while len(rows) < seconds / DT:
        level = [0.0, 0.0] if rng.random() < 0.1 else [rng.uniform(-0.4, 0.6), rng.uniform(-1.2, 1.2)]
        rows += [level] * int(rng.integers(4, 40))
    return np.round(rows[: int(seconds / DT)], 3)


def one_turn_rate(rng: np.random.Generator, seconds: float) -> np.ndarray:
    """(K, 2): constant speed, and a yaw rate that is either 0 or 1 rad/s."""
    on = np.repeat(rng.integers(0, 2, int(seconds / 1.5) + 1), int(1.5 / DT))[: int(seconds / DT)]
    return np.column_stack([np.full(len(on), 0.2), on.astype(float)])


def inputs_of(path: Path) -> np.ndarray:
    """(K, 2) inputs of a table with the columns v and w."""
    with path.open(encoding="utf-8", newline="") as file:
        return np.array([[float(row["v"]), float(row["w"])] for row in csv.DictReader(file)])


def recorded(kind: str, rng: np.random.Generator, inputs: np.ndarray) -> str:
    """The table: t, the measured pose, and the commanded inputs."""
    lines, pose, speed, part = ["t,x,y,theta,v,w"], np.zeros(3), 0.0, DT / PARTS
    for k, (v, w) in enumerate(inputs):
        x, y, theta = pose + NOISE * rng.normal(size=3)
        lines.append(f"{k * DT:.2f},{x:.4f},{y:.4f},{theta:.4f},{v:.3f},{w:.3f}")
        for _ in range(PARTS):
            before, speed = speed, v + (speed - v) * DECAY if kind == "lag" else v
            slower = HEIGHT * np.sin(2.0 * np.pi * pose[0] / WAVES) if kind == "floor" else 0.0
            moves = (1.0 - slower) * (0.5 * (before + speed) if kind == "lag" else v)
            turns = YAW_GAIN * w if kind == "weak" else w
            heading = pose[2] + 0.5 * part * turns  # in the middle of the substep
            pose = pose + part * np.array([moves * np.cos(heading), moves * np.sin(heading), turns])
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("lag", "weak", "floor"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--inputs", type=Path, help="table of inputs to drive (default: drawn with a fixed seed)")
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    drawn = one_turn_rate(rng, 45.0) if options.kind == "weak" else commands(rng, 60.0)
    inputs = inputs_of(options.inputs) if options.inputs else drawn
    options.file.write_text(recorded(options.kind, rng, inputs), encoding="utf-8")
