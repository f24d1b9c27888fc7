"""Does a controller that drives answer as a function of what it is asked? A second process of the same kind is asked the same, at random.

    kept        questions of this drive and their answers: a uniform sample of ROWS (reservoir sampling, Vitter 1985, algorithm R)
    asked       after a share SHARE of the answers, drawn from the operating system's entropy: the newest question, or a kept one
    otherwise   an answer of the second process that differs by more than TOLERANCE of the largest answer: `Inconsistent`

The second process was asked less, at other times and in another order. So a controller that counts its calls, remembers, draws lots, or
changes with the time of day is seen as soon as that changes an answer that is asked again. One that changed before it first drove is not.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.controllers.rehearsal import TOLERANCE
from s2r_runtime.errors import ControllerError
from s2r_runtime.hookspecs import Scenario

Array = NDArray[np.float64]
Control = Callable[[Array, Scenario], Array]

ROWS = 64
SHARE = 0.05
BUSY = 0.25
"""Of the time between two questions: one that takes longer to answer is not asked again, since its next answer would be late."""


class Inconsistent(ControllerError):
    """It answers the same question otherwise."""


class AskedAgain:
    """`control`, of which some questions go to `witness` as well, by `check`, when there is time."""

    def __init__(self, control: Control, witness: Control) -> None:
        self._control, self._witness = control, witness
        self._random = random.SystemRandom()
        self._kept: list[tuple[Array, dict[str, Any], Array]] = []
        self._newest: tuple[Array, dict[str, Any], Array] | None = None
        self._count, self._scale, self._asked_s = 0, 0.0, 0.0
        self._spare = False

    def __call__(self, x: Array, theta: Scenario) -> Array:
        """As `control`."""
        begun = time.monotonic()
        since, self._asked_s = begun - self._asked_s, begun
        u = self._control(x, theta)
        self._spare = time.monotonic() - begun < BUSY * since
        copied = {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in theta.items()}
        self._newest = x.copy(), copied, u
        self._scale = max(self._scale, float(np.max(np.abs(u), initial=0.0)))
        self._count += 1
        if len(self._kept) < ROWS:
            self._kept.append(self._newest)
        elif (place := self._random.randrange(self._count)) < ROWS:
            self._kept[place] = self._newest
        return u

    def check(self) -> None:
        """At random, asks again. Call it when an answer is out. Raises Inconsistent, and what the witness raises."""
        if self._newest is None or not self._spare or self._random.random() >= SHARE:
            return
        x, theta, u = self._newest if self._random.random() < 0.5 else self._random.choice(self._kept)
        again = self._witness(x, theta)
        if not np.all(np.abs(again - u) <= TOLERANCE * self._scale):
            raise Inconsistent(
                f"asked again about a state of this drive, it answers {_short(again)} and not {_short(u)}; "
                "control must be a function of its arguments: no memory, clock or chance"
            )


def _short(u: Array) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in u[0]) + "]"
