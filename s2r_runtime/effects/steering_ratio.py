"""The road wheels turn by another ratio than the steering command says: angle = ratio * command.

On all data this is `input_gain` of the steering command: a linkage with another ratio and a servo with another gain steer alike.
"""

from __future__ import annotations

from s2r_runtime.effects.input_effect import Array, InputEffect, Values
from s2r_runtime.hookspecs import NominalModel, Parameter


class SteeringRatio(InputEffect):
    """ratio of the road wheels' angle to the command; 1 is neutral."""

    name = "steering_ratio"
    parameters = (Parameter("ratio", "", -100.0, 100.0, neutral=1.0),)
    linear = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Inputs that steer."""
        return steering_inputs(model)

    def act(self, u: Array, p: Values) -> Array:
        """ratio u."""
        return u * float(p["ratio"])

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is linear in it."""
        return [{"ratio": 0.9}]


def steering_inputs(model: NominalModel) -> tuple[str, ...]:
    """Inputs that are steering angles, by their names (`steer_cmd`, `steering`, `delta`) and, where there is one, their unit."""
    units: dict[str, str] = getattr(model, "units", {})
    return tuple(name for name in model.inputs if _steers(name) and units.get(name, "rad") == "rad")


def _steers(name: str) -> bool:
    return any(word.startswith("steer") or word == "delta" for word in name.lower().split("_"))


EFFECT = SteeringRatio()
