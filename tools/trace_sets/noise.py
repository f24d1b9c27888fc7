"""Laws of noise: on what is measured, and on what the robot does.

measured   y = x + e,   e white Gaussian, Student-t, or Gaussian with outliers on a share of the rows; y may be rounded
motion     a push a step of dt on the speeds (pose plants) or accelerations (force plants), white or AR(1) with a time constant
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rng = np.random.Generator


@dataclass(frozen=True)
class Noise:
    """sigma (nx,): of measurements. freedom: of Student's t (0: Gaussian). outliers: share of rows, by `far` sigmas. quantum (nx,).

    push (2,) or (axes,): rms of what pushes the motion; memory: its time constant, s (0: white).
    """

    law: str
    sigma: Array
    freedom: float = 0.0
    outliers: float = 0.0
    far: float = 0.0
    quantum: Array = field(default_factory=lambda: np.zeros(0))
    push: Array = field(default_factory=lambda: np.zeros(0))
    memory: float = 0.0

    def errors(self, rng: Rng, n: int) -> Array:
        """(n, nx)."""
        e = rng.standard_normal((n, len(self.sigma)))
        if self.freedom:
            e = rng.standard_t(self.freedom, (n, len(self.sigma)))
            e *= math.sqrt((self.freedom - 2.0) / self.freedom) if self.freedom > 2.2 else 0.3
        if self.outliers:
            rows = rng.random(n) < self.outliers
            alone = rng.random((n, len(self.sigma))) < 0.6
            size = self.far * np.exp(rng.uniform(-0.7, 0.7, (n, len(self.sigma)))) * rng.choice([-1.0, 1.0], (n, len(self.sigma)))
            e += rows[:, None] * alone * size
        return np.asarray(e * self.sigma)

    def pushes(self, rng: Rng, steps: int, dt: float) -> list[list[float]] | None:
        """(steps, .) for a run, or nothing."""
        if not len(self.push):
            return None
        white = rng.standard_normal((steps, len(self.push)))
        if self.memory > 0.0:
            keep = math.exp(-dt / self.memory)
            drive = white * math.sqrt(1.0 - keep * keep)
            drive[0] = white[0]
            for k in range(1, steps):
                drive[k] += keep * drive[k - 1]
            white = drive
        rows: list[list[float]] = (white * self.push).tolist()
        return rows

    def rounded(self, y: list[float]) -> list[float]:
        """To the quantum."""
        if not len(self.quantum):
            return y
        return [round(v / q) * q if q > 0.0 else v for v, q in zip(y, self.quantum.tolist(), strict=True)]
