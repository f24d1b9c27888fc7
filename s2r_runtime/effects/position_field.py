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

ROUNDING = 1e-18
"""Terms of the series below it change nothing in double precision."""


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
        matrix = np.array(p["matrix"], dtype=np.float64)
        each = np.asarray(dt, dtype=np.float64).reshape(-1, 1)
        one, of_matrix = _factor(matrix, each)
        went, there = x_next[:, place] - x[:, place], each * (x[:, place] @ matrix.T)
        after = x_next.copy()
        after[:, place] += one * went + (1.0 + one) * there + of_matrix * ((went + there) @ matrix.T)
        return after

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough."""
        return [{"matrix": [[FIRST, FIRST], [FIRST, FIRST]]}]


def _factor(matrix: Array, dt: Array) -> tuple[Array, Array]:
    """F - 1 of the docstring as p + q M, each of the shape of dt: the square of M is tr(M) M - det(M) 1, so every power of it is of
    that form.

    The series of A halved often enough, then F(2A) = F(A) (exp(A) + 1)/2, exp(A) = 1 + A F(A).
    """
    trace, det = float(matrix[0, 0] + matrix[1, 1]), float(matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0])
    size = float(np.nanmax(np.abs(dt), initial=0.0)) * float(np.max(np.sum(np.abs(matrix), axis=-1)))
    halved = max(0, math.ceil(math.log2(2.0 * size))) if size > 0.0 else 0
    step, size = dt / 2.0**halved, size / 2.0**halved
    p, q = np.zeros_like(dt), np.zeros_like(dt)
    for k in range(_terms(size), 1, -1):  # F - 1 = A/2 (1 + A/3 (1 + ...))
        p, q = -step * q * det / k, step * (1.0 + p + q * trace) / k
    for _ in range(halved):
        # with g = F - 1: F(2A) - 1 = g + A/2 (1 + g)^2
        one = 1.0 + p
        of_one, of_matrix = one * one - q * q * det, 2.0 * one * q + q * q * trace
        p, q = p - 0.5 * step * of_matrix * det, q + 0.5 * step * (of_one + of_matrix * trace)
        step = 2.0 * step
    return p, q


def _terms(size: float) -> int:
    """After which those that are left are below rounding of the sum, where A is so large, at most a half."""
    k, last = 1, 0.5 * size
    while last > ROUNDING:
        k += 1
        last *= size / (k + 1)
    return k


EFFECT = PositionField()
