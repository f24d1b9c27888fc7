"""Dry friction that is larger near standstill (boundary lubrication): a motion that is slow is braked harder than one that is fast.

f(v) = force + (static_force - force) exp(-(v/velocity)²) against the motion; at rest it holds up to static_force  (Stribeck's curve as in
Armstrong-Hélouvry, Dupont, Canudas de Wit, *A survey of models, analysis tools and compensation methods for the control of machines with
friction*, Automatica 30(7), 1994). Viscous friction is an effect of its own.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.step_effect import Array, ForceEffect, Values, force_unit, length_unit, size_of, usual_speed
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, mass_on

FORCE_SHARE = 0.1
STATIC = 2.0
SPEED_SHARES = (0.03, 0.1, 0.3)
"""Of the inputs' size; of force; of the usual speed."""


class StribeckFriction(ForceEffect):
    """force while moving fast, static_force at rest, both N (N m; m/s² where there is no mass); velocity m/s."""

    name = "stribeck_friction"
    parameters = (
        Parameter("force", "N", 0.0, 1e6, neutral=0.0),
        Parameter("static_force", "N", 0.0, 1e6, neutral=0.0),
        Parameter("velocity", "m/s", 1e-9, 1e4),
    )
    uneven = True
    besides = True
    varies = True
    homogeneous = True

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of a force, of a speed."""
        return f"{length_unit(model, channel)}/s" if parameter == "velocity" else force_unit(model, channel)

    def wrong(self, p: Values) -> str:
        """What is wrong with the values together."""
        return "" if p["static_force"] >= p["force"] else f"static_force is {p['static_force']}, must be at least force ({p['force']})"

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its deceleration at this speed, and what it holds."""
        if model.states[axis.velocity] != channel:
            return None
        over = mass_on(model, channel)
        fast, still = float(p["force"]) / over, float(p["static_force"]) / over
        dry = fast + (still - fast) * np.exp(-((x[:, axis.velocity] / float(p["velocity"])) ** 2))
        return Push(dry=(dry, dry), hold=(still, still))

    def simpler(self, p: Values) -> tuple[str, Values]:
        """Dry friction that is no larger at rest."""
        return "coulomb_friction", {"force": p["force"]}

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Curves that fall within a part of the speeds that such inputs lead to."""
        force, speed = FORCE_SHARE * size_of(u), usual_speed(u, model, dt, channel)
        return [{"force": force, "static_force": STATIC * force, "velocity": share * speed} for share in SPEED_SHARES]


EFFECT = StribeckFriction()
