"""A spring that hardens (or softens), about the position zero: v' = a - (coefficient/mass) q³.

Far out it goes on as a linear spring, where a cubic one would swing faster than a part of a step resolves, or push away ever faster.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.step_effect import Array, ForceEffect, Values, force_unit, length_unit, size_of, usual_speed
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import PART_S, Axis, Push, axes, mass_on

STIFFEST = 1.0 / PART_S**2
"""1/s²: it swings by a radian within the longest part of a step; twice that would be unstable."""

SOFTEST = -100.0
"""1/s²: what is pushed away grows by e^10 in a second at most."""

SHARE = 0.1
SPAN_S = 1.0
"""Where the tracer begins: a force of that share of the inputs' at the position reached in that time; the response is linear."""


class CubicStiffness(ForceEffect):
    """coefficient N/m³ (N m/rad³; 1/(m² s²) where there is no mass); 0 is none."""

    name = "cubic_stiffness"
    parameters = (Parameter("coefficient", "N/m³", -1e9, 1e9, neutral=0.0),)
    uneven = True
    varies = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """The positions of all axes."""
        return tuple(model.states[axis.position] for axis in axes(model))

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of force over length cubed."""
        force, length = force_unit(model, channel), length_unit(model, channel)
        return f"1/({length}² s²)" if force.endswith("/s²") else f"{force}/{length}³"

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its acceleration at this position."""
        if model.states[axis.position] != channel:
            return None
        q = x[:, axis.position]
        return Push(drive=-np.clip(float(p["coefficient"]) / mass_on(model, channel) * q * q, SOFTEST, STIFFEST) * q)

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough."""
        return [{"coefficient": SHARE * size_of(u) / (SPAN_S * usual_speed(u, model, dt, channel)) ** 3}]


EFFECT = CubicStiffness()
