"""A parameter of the model is another one than it says: a valve that is worn, a time constant from the data sheet.

For models of one's own. What the built-in models have (`NAMED`) belongs to effects that say what such a change means for a robot.
"""

from __future__ import annotations

from typing import Any

from s2r_runtime.effects.step_effect import Array, StepEffect, Values
from s2r_runtime.hookspecs import NominalModel, Parameter

NAMED = frozenset({"mass", "inertia", "wheel_base", "wheel_radius", "track", "castor"})
"""`mass_change`, `input_gain`, `wheel_radius_scale` and `track_scale` speak of these."""


class ParameterChange(StepEffect):
    """ratio to the model's value; 1 is none. A parameter that is 0 in the model has a value instead; 0 is none."""

    name = "parameter_change"
    parameters = (Parameter("ratio", "", 1e-2, 1e2, neutral=1.0), Parameter("value", "", -1e9, 1e9, neutral=0.0))
    uneven = True
    optional = ("ratio", "value")

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """The model's parameters by name."""
        return tuple(name for name in model.parameters if name not in NAMED)

    def takes(self, model: NominalModel, channel: str) -> tuple[str, ...]:
        """A ratio of what is not zero."""
        return ("ratio",) if model.parameters[channel] else ("value",)

    def wrong(self, p: Values) -> str:
        """What is wrong with the values together."""
        return "" if p else "lacks the parameter ratio (value, where the model's is 0)"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: Any, p: Values) -> Array:
        """The difference that the other value makes to the nominal step."""
        return x_next + (model.step(x, u, dt, self.rebound(model, channel, p)) - model.step(x, u, dt, model.parameters))

    def rebound(self, model: NominalModel, channel: str, p: Values) -> dict[str, float]:
        """The model's parameters with this one, beside which the next one is asked: what two change together is more than both alone do."""
        usual = model.parameters[channel]
        return {**model.parameters, channel: float(p["ratio"]) * usual if usual else float(p["value"])}

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """A little to either side: a parameter may act in any way."""
        return [{"ratio": 1.1}, {"ratio": 0.8}, {"ratio": 2.0}] if model.parameters[channel] else [{"value": 0.01}, {"value": 1.0}]


EFFECT = ParameterChange()
