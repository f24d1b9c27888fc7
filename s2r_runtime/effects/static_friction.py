"""Static friction: what must be overcome near standstill, beyond the dry friction of a motion: force exp(-(v/velocity)²).

At rest it holds up to `force`. Added to `coulomb_friction` f it is `stribeck_friction` of force f and static_force f + force; the tracer
searches that one.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.step_effect import Array, ForceEffect, Values, force_unit, length_unit, size_of, usual_speed
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, mass_on

FORCE_SHARE, SPEED_SHARE = 0.1, 0.1
"""Where the tracer begins: of the inputs' size; of the usual speed."""


class StaticFriction(ForceEffect):
    """force N at rest (N m; m/s² or rad/s² where there is no mass), 0 is neutral; velocity m/s at which it has fallen to 1/e."""

    name = "static_friction"
    parameters = (Parameter("force", "N", 0.0, 1e6, neutral=0.0), Parameter("velocity", "m/s", 1e-9, 1e4))
    uneven = True
    besides = True
    varies = True

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of a force, of a speed."""
        return f"{length_unit(model, channel)}/s" if parameter == "velocity" else force_unit(model, channel)

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its deceleration at this speed, and what it holds."""
        if model.states[axis.velocity] != channel:
            return None
        still = float(p["force"]) / mass_on(model, channel)
        dry = still * np.exp(-((x[:, axis.velocity] / float(p["velocity"])) ** 2))
        return Push(dry=(dry, dry), hold=(still, still))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One: `stribeck_friction` is searched."""
        return [{"force": FORCE_SHARE * size_of(u), "velocity": SPEED_SHARE * usual_speed(u, model, dt, channel)}]


EFFECT = StaticFriction()
