"""Dry friction of a gear or a screw that grows with the load which it transmits: force = coefficient |u| against the motion.

u is the input force of the axis. v' = a - (coefficient |u|/mass) sign(v), as dry friction (`models.forces`). Friction that is there
without a load is a `coulomb_friction` (P. Hamon, M. Gautier, P. Garrec, Dynamic identification of robots with a dry friction
model depending on load and velocity, IROS 2010). While the force always drives the motion it is an `input_gain` of 1 - coefficient.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.step_effect import Array, ForceEffect, Values
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.force_inputs import input_on
from s2r_runtime.models.forces import Axis, Push, axes, mass_on

START = 0.1
"""Where the tracer begins: a gear that loses a tenth. The response is linear."""


class LoadFriction(ForceEffect):
    """coefficient of the transmitted force, 0 is neutral; from 1 on no force moves the axis."""

    name = "load_friction"
    parameters = (Parameter("coefficient", "", 0.0, 10.0, neutral=0.0),)
    uneven = True
    additive = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Velocities of axes that an input pushes."""
        return tuple(model.states[axis.velocity] for axis in axes(model) if input_on(model, axis) is not None)

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """As without a load."""
        return Push() if model.states[axis.velocity] == channel else None

    def push_under(self, x: Array, u: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its deceleration under u (n, nu)."""
        force = input_on(model, axis)
        if model.states[axis.velocity] != channel or force is None:
            return None
        dry = float(p["coefficient"]) / mass_on(model, channel) * np.abs(u[:, model.inputs.index(force)])
        return Push(dry=(dry, dry))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough."""
        return [{"coefficient": START}]


EFFECT = LoadFriction()
