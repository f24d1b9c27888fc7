"""Shapes that what goes with a state can have, and that no effect has a name for; as `input_dynamics` are of an input.

    a power     of a speed v: drag  v' = a - rate v |v / most|^(power - 1).  Viscous at power 1, quadratic at 2; there is more between and
                beyond
    a limit     of a state: it goes no farther than `at` times `most` (a tank that overflows, a governor, a heater that boils)

`most` is the largest size of the state that was measured. They act on the speeds of axes, and limits on what has no axis and no heading.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.effects.step_effect import ForceEffect, StepEffect, Values, has_pose
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, axes

Array = NDArray[np.float64]

RATE = 0.3
"""1/s, at the largest speed: where a fit begins; the response is linear in it."""

POWERS = (0.4, 1.5, 3.0, 5.0)
"""Where it begins, between and beyond those that have names."""

SMALLEST = 1e-3
"""Of the largest speed: below that a root's rate would have no end."""

HIGH, LOW = (0.8, 0.9, 0.95, 0.98), (0.2, 0.1, 0.05, 0.02)
"""Shares of what was measured below which a limit is looked for, from above and from below."""


class Power(ForceEffect):
    """A drag with its own power of a speed."""

    name = "a power of the speed"
    memory = False
    uneven = True
    varies = True
    parameters = (
        Parameter("loss", "1/s", 0.0, 1e6, neutral=0.0),
        Parameter("power", "", 0.1, 10.0),
    )

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its rate at this speed, 1/s."""
        if model.states[axis.velocity] != channel:
            return None
        size = np.maximum(np.abs(x[:, axis.velocity]) / p["most"], SMALLEST)
        rate = p["loss"] * size ** (p["power"] - 1.0)
        return Push(rate=(rate, rate))

    def values(self, y: Array) -> list[Values]:
        """From which a fit begins. y: (n,) the state."""
        return [{"loss": RATE, "power": k} for k in POWERS]


class Limit(StepEffect):
    """A state that goes no farther. side: 1 from above, -1 from below."""

    memory = False
    uneven = True
    parameters = (Parameter("at", "", -2.0, 2.0, kink=True),)

    def __init__(self, side: float) -> None:
        self.name = "a limit above" if side > 0.0 else "a limit below"
        self._side = side

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Speeds of axes, and what has neither an axis nor a heading; nothing of a robot that moves about in the plane."""
        if has_pose(model):
            return ()
        places = {model.states[axis.position] for axis in axes(model)}
        return tuple(s for s in model.states if s not in places and s not in {*model.angles, *getattr(model, "reached", {})})

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """x_next (n, nx), cut."""
        i = model.states.index(channel)
        cut = x_next.copy()
        cut[:, i] = self._side * np.minimum(self._side * x_next[:, i], self._side * p["at"] * p["most"])
        return cut

    def values(self, y: Array) -> list[Values]:
        """From which a fit begins. y: (n,) the state."""
        shares = HIGH if self._side > 0.0 else LOW
        return [{"at": float(at)} for at in np.unique(np.quantile(y, shares)) / np.max(np.abs(y))]


StateShape = Power | Limit

STATE_SHAPES: tuple[StateShape, ...] = (Power(), Limit(1.0), Limit(-1.0))


def starts(shape: StateShape, y: Array) -> Sequence[Values]:
    """Values from which a fit of a shape begins, with its scale. y: (n,) what was measured of the state."""
    y = y[np.isfinite(y)]
    most = float(np.max(np.abs(y), initial=0.0))
    return [{**p, "most": most} for p in shape.values(y)] if most > 0.0 else []
