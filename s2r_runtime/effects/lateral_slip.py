"""A turning robot slides outwards (or inwards): sideways speed = coefficient v omega, to the left."""

from __future__ import annotations

from s2r_runtime.effects.body_motion import body_motion, moved
from s2r_runtime.effects.step_effect import Array, StepEffect, Values
from s2r_runtime.hookspecs import NominalModel, Parameter


class LateralSlip(StepEffect):
    """coefficient s; 0 is none, negative slides outwards."""

    name = "lateral_slip"
    parameters = (Parameter("coefficient", "s", -1e3, 1e3, neutral=0.0),)
    uneven = True

    def frame(self, model: NominalModel, channel: str) -> str:
        """Of the body's motion."""
        return "body"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """left += coefficient (forward/dt) (turn/dt) dt."""
        motion = body_motion(x, x_next, model)
        return moved(x, x_next, model, motion._replace(left=motion.left + float(p["coefficient"]) / dt * motion.forward * motion.turn))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is linear."""
        return [{"coefficient": -0.05}]


EFFECT = LateralSlip()
