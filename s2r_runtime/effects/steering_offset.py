"""The road wheels are not straight at a steering command of zero: angle = command + offset, a linkage that is out of adjustment.

On all data this is `input_bias` of the steering command.
"""

from __future__ import annotations

from s2r_runtime.effects.input_effect import Array, InputEffect, Values
from s2r_runtime.effects.steering_ratio import steering_inputs
from s2r_runtime.hookspecs import NominalModel, Parameter

START_RAD = 0.01
"""Where the tracer begins. The response is nearly linear."""


class SteeringOffset(InputEffect):
    """angle rad of the road wheels at a command of zero, to the left; 0 is neutral."""

    name = "steering_offset"
    parameters = (Parameter("angle", "rad", -1.5, 1.5, neutral=0.0),)
    linear = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Inputs that steer."""
        return steering_inputs(model)

    def act(self, u: Array, p: Values) -> Array:
        """u + angle."""
        return u + float(p["angle"])

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough."""
        return [{"angle": START_RAD}]


EFFECT = SteeringOffset()
