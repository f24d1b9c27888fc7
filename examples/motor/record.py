"""Makes the two recordings: the motor as it is, which its data sheet does not tell, simulated in 100 substeps a sample.

python record.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np

DT, PARTS = 0.02, 100
TORQUE, RESISTANCE, INERTIA = 0.05, 2.0, 4e-4
FRICTION = 0.02  # N m, dry: nobody told the model
DELAY = 0.06  # s, until the driver does what it is told: nor that
NOISE = 0.4  # rad/s


def drive(rng: np.random.Generator, seconds: float) -> np.ndarray:
    """(K,) V: held for 0.1 to 0.8 s each, of both signs, with rests."""
    volts: list[float] = []
    while len(volts) < seconds / DT:
        level = 0.0 if rng.random() < 0.15 else rng.uniform(-12.0, 12.0)
        volts += [round(level, 2)] * int(rng.integers(5, 40))
    return np.array(volts[: int(seconds / DT)])


def recorded(rng: np.random.Generator, volts: np.ndarray) -> str:
    """The table: t, speed as the encoder tells it, volts as they were commanded."""
    rows, speed, part = ["t,speed,volts"], 0.0, DT / PARTS
    late = round(DELAY / part)
    commands = np.concatenate([np.zeros(late), np.repeat(volts, PARTS)])
    for k, told in enumerate(volts):
        rows.append(f"{k * DT:.2f},{speed + NOISE * rng.normal():.3f},{told:.2f}")
        for now in commands[k * PARTS : (k + 1) * PARTS]:
            torque = TORQUE * (now - TORQUE * speed) / RESISTANCE
            free = speed + part * torque / INERTIA
            brake = part * FRICTION / INERTIA
            speed = np.sign(free) * max(abs(free) - brake, 0.0)
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        sys.exit("record.py: needs the folder to write to, which exists: python record.py FOLDER")
    folder = Path(sys.argv[1])
    for name, seed, seconds in (("drive.csv", 1, 30.0), ("another.csv", 2, 10.0)):
        rng = np.random.default_rng(seed)
        (folder / name).write_text(recorded(rng, drive(rng, seconds)), encoding="utf-8")
