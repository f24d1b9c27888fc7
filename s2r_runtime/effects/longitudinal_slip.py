"""Wheels turn farther than the robot moves: forward speed = (1 - ratio) of the ideal one.

Yaw, and the speeds of the wheels themselves, are as they are.
"""

from __future__ import annotations

from s2r_runtime.effects.body_motion import body_motion, moved
from s2r_runtime.effects.step_effect import Array, StepEffect, Values
from s2r_runtime.hookspecs import NominalModel, Parameter


class LongitudinalSlip(StepEffect):
    """ratio 0 is none, 1 stands still; below 0 the robot moves farther than its wheels say."""

    name = "longitudinal_slip"
    parameters = (Parameter("ratio", "", -99.0, 101.0, neutral=0.0),)
    uneven = True

    def frame(self, model: NominalModel, channel: str) -> str:
        """Of the body's motion."""
        return "body"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """forward *= 1 - ratio."""
        motion = body_motion(x, x_next, model)
        return moved(x, x_next, model, motion._replace(forward=(1.0 - float(p["ratio"])) * motion.forward))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is linear."""
        return [{"ratio": 0.05}]


EFFECT = LongitudinalSlip()
