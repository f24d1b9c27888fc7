"""Gravity on a link that turns about a horizontal axis and is not in the model: torque = -torque sin(q - angle).

`torque` is m g l, of the mass beyond the axis; `angle` is the position at which the link hangs. v' = a - (torque/inertia) sin(q - angle).
"""

from __future__ import annotations

import math

import numpy as np

from s2r_runtime.effects.step_effect import Array, ForceEffect, Values, force_unit, size_of
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, axes, mass_on, may_turn

SHARE = 0.2
"""Of the inputs' size: where the tracer begins; the response is linear in it."""

ANGLES = (0.0, math.tau / 3.0, -math.tau / 3.0)
"""Where the tracer lets the link hang: one of the three is within a sixth of a turn of the truth."""


class LinkGravity(ForceEffect):
    """torque N m (rad/s² where there is no inertia), 0 is neutral; angle rad at which the link hangs."""

    name = "link_gravity"
    parameters = (Parameter("torque", "N m", 0.0, 1e6, neutral=0.0), Parameter("angle", "rad", -math.tau, math.tau))
    uneven = True
    varies = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Positions of axes that may turn."""
        return tuple(model.states[axis.position] for axis in axes(model) if may_turn(model, axis))

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of what acts on the axis; of an angle."""
        return force_unit(model, channel) if parameter == "torque" else "rad"

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its acceleration at this position."""
        if model.states[axis.position] != channel:
            return None
        return Push(drive=-float(p["torque"]) / mass_on(model, channel) * np.sin(x[:, axis.position] - float(p["angle"])))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One a third of a turn."""
        return [{"torque": SHARE * size_of(u), "angle": angle} for angle in ANGLES]


EFFECT = LinkGravity()
