"""What depends linearly on where it is: a magnet, a bowl of a floor, a camera's distortion that is taken for a motion.

poses       (x, y)' += M (x, y),  M 1/s.  With the step's own motion d made evenly over it, exactly

            (x, y)+ = (x, y) + d + (F - 1) d + F A (x, y),   A = M dt,  F = (exp(A) - 1)/A = 1 + A/2! + A²/3! + ...

axes x, y   (vx, vy)' += M (x, y),  M 1/s²
"""

from __future__ import annotations

import math

import numpy as np

from s2r_runtime.effects.constant_disturbance import directions
from s2r_runtime.effects.step_effect import Array, ForceEffect, Values
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, axes

FIRST = 0.01
"""1/s, or 1/s², in each entry where the tracer begins; the response is linear."""

TERMS = 16
"""Of the series where A is at most a half: 0.5^16/17! is below 1e-18."""


class PositionField(ForceEffect):
    """matrix: 2 x 2, about the world's origin; 0 is none."""

    name = "position_field"
    parameters = (Parameter("matrix", "1/s", -100.0, 100.0, neutral=0.0, shape=(2, 2)),)
    uneven = True
    varies = True
    additive = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """`*` where there is a position in the plane."""
        return ("*",) if directions(model)[:2] == ("x", "y") else ()

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of a rate, or of an acceleration, over a length."""
        return "1/s²" if axes(model) else "1/s"

    def frame(self, model: NominalModel, channel: str) -> str:
        """Along the world's axes."""
        return "world"

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its acceleration at this position."""
        name = model.states[axis.position]
        if name not in {"x", "y"}:
            return None
        row = p["matrix"][0 if name == "x" else 1]
        return Push(drive=float(row[0]) * x[:, model.states.index("x")] + float(row[1]) * x[:, model.states.index("y")])

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """Rates on a pose, forces on axes."""
        if self.pushes(model, channel):
            return super().after_step(x, u, x_next, model, channel, dt, p)
        place = [model.states.index("x"), model.states.index("y")]
        a = np.multiply.outer(dt, np.array(p["matrix"], dtype=np.float64))
        f = _factor(a)
        after = x_next.copy()
        there, went = x[:, place, None], (x_next[:, place] - x[:, place])[:, :, None]
        after[:, place] += ((f - np.eye(2)) @ went + f @ a @ there)[:, :, 0]
        return after

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough."""
        return [{"matrix": [[FIRST, FIRST], [FIRST, FIRST]]}]


def _factor(a: Array) -> Array:
    """F of the docstring, (..., 2, 2): the series of a halved often enough, then F(2a) = F(a) (exp(a) + 1)/2, exp(a) = 1 + a F(a)."""
    size = float(np.max(np.sum(np.abs(a), axis=-1), initial=0.0))
    halved = max(0, math.ceil(math.log2(2.0 * size))) if size > 0.0 else 0
    a = a / 2.0**halved
    one = np.eye(2)
    f = np.broadcast_to(one, a.shape)
    for k in range(TERMS, 1, -1):
        f = one + a @ f / k
    for _ in range(halved):
        f = 0.5 * f @ (2.0 * one + a @ f)
        a = 2.0 * a
    return f


EFFECT = PositionField()
