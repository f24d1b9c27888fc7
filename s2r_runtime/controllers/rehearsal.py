"""Does a controller answer on the robot as it answered when it was verified? A few scenarios are asked again, as the robot would ask.

In a verification it is asked about all scenarios at once; on the robot about one state after the other, in a process of its own. If it is
a function of its arguments, as it must be, the answers are the same but for the last digits. One that keeps something between calls,
draws random numbers, or looks at how many rows it is asked about, was verified as something else than what would drive.

    what is kept      of ROWS scenarios, evenly spread, (x, theta, u) of the first CALLS calls
    what is asked     the same x and theta, one scenario after the other, one row a call, of a new process
    what may differ   TOLERANCE of the largest answer: sums of many numbers round differently in batches

It is no proof: one that counts its calls, or looks at the clock, can wait until nobody compares.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ControllerError
from s2r_runtime.hookspecs import Scenario

Array = NDArray[np.float64]
Control = Callable[[Array, Scenario], Array]

ROWS = 4
CALLS = 400
"""More than the longest of the built-in tasks' horizons."""
TOLERANCE = 1e-6


class Kept:
    """`control`, and what it answered in a few rows. Only whole batches of the same size are one run of scenarios."""

    def __init__(self, control: Control) -> None:
        self._control = control
        self._n = 0
        self._calls: list[tuple[Array, dict[str, Any], Array]] = []

    def __call__(self, x: Array, theta: Scenario) -> Array:
        """As `control`."""
        u = self._control(x, theta)
        self._n = self._n or len(x)
        if len(self._calls) < CALLS and len(x) == self._n:
            rows = self._rows()
            kept = {name: value[rows].copy() if _batched(value, len(x)) else value for name, value in theta.items()}
            self._calls.append((x[rows].copy(), kept, u[rows].copy()))
        return u

    def compare(self, again: Control) -> None:
        """Asks the same of `again`, one row a call. Raises ControllerError where it answers otherwise."""
        if not self._calls:
            return
        scale = max(float(np.max(np.abs(u), initial=0.0)) for _, _, u in self._calls)
        for number, row in enumerate(self._rows()):
            for k, (x, theta, u) in enumerate(self._calls):
                one = slice(number, number + 1)
                alone = {name: value[one] if _batched(value, len(x)) else value for name, value in theta.items()}
                answer = again(x[one], alone)
                if not np.all(np.abs(answer - u[one]) <= TOLERANCE * scale):
                    raise ControllerError(
                        f"it answers otherwise when it is asked about one state at a time, as on the robot: in step {k} of scenario {row} "
                        f"{_short(answer)} and not {_short(u[one])}; control must be a function of its arguments, row by row"
                    )

    def _rows(self) -> list[int]:
        return sorted({round(i * (self._n - 1) / (ROWS - 1)) for i in range(ROWS)})


def _batched(value: Any, n: int) -> bool:
    return isinstance(value, np.ndarray) and value.ndim >= 1 and len(value) == n


def _short(u: Array) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in u[0]) + "]"
