"""Dry friction: a force of constant size against the motion; or another size forward than backward.

v' = a - (force/mass) sign(v); it stops a motion and holds it as long as |a| <= force/mass, and never turns it (`models.forces`).
"""

from __future__ import annotations

from s2r_runtime.effects.step_effect import Array, ForceEffect, Values, force_unit, size_of
from s2r_runtime.effects.viscous_friction import by_direction, either_way, one_or_two
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, mass_on

SHARES = (0.05, 0.3)
"""Of the inputs' size: friction that a motion mostly overcomes, and friction that often holds it."""


class CoulombFriction(ForceEffect):
    """force N (N m; m/s² where there is no mass), or force_positive (while moving forward) and force_negative; 0 is none."""

    name = "coulomb_friction"
    parameters = tuple(Parameter(name, "N", 0.0, 1e6, neutral=0.0) for name in ("force", "force_positive", "force_negative"))
    uneven = True
    besides = True
    optional = ("force", "force_positive", "force_negative")
    additive = True

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of a force."""
        return force_unit(model, channel)

    def wrong(self, p: Values) -> str:
        """What is wrong with the values together."""
        return one_or_two(p, "force")

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its deceleration."""
        return Push(dry=by_direction(p, "force", mass_on(model, channel))) if model.states[axis.velocity] == channel else None

    def simpler(self, p: Values) -> tuple[str, Values]:
        """The same either way."""
        return self.name, either_way(p, "force")

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Two sizes, and one by direction."""
        size = size_of(u)
        both = SHARES[0] * size
        return [*({"force": share * size} for share in SHARES), {"force_positive": both, "force_negative": both}]


EFFECT = CoulombFriction()
