"""The mass (or inertia) is another one than the model says: a load. What the nominal step does with the one is what it does with the other.

Friction and other forces stay in proportion to the model's own mass, so that a heavier joint is a joint with a smaller input gain
whatever else acts on it.
"""

from __future__ import annotations

from typing import Any

from s2r_runtime.effects.step_effect import Array, StepEffect, Values
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import mass_name


class MassChange(StepEffect):
    """mass kg (or inertia kg m²), or ratio of it to the model's; ratio 1 is none."""

    name = "mass_change"
    parameters = (Parameter("mass", "kg", 1e-9, 1e9), Parameter("ratio", "", 1e-3, 1e3, neutral=1.0))
    uneven = True
    optional = ("mass", "ratio")

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """`*` where the model has a mass."""
        return ("*",) if mass_name(model) else ()

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of a mass or an inertia."""
        return "" if parameter == "ratio" else "kg m²" if mass_name(model) == "inertia" else "kg"

    def wrong(self, p: Values) -> str:
        """What is wrong with the values together."""
        return "" if ("mass" in p) != ("ratio" in p) else f"has {', '.join(sorted(p)) or 'no value'}, must have either mass or ratio"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: Any, p: Values) -> Array:
        """The difference that another mass makes to the nominal step."""
        name = mass_name(model)
        usual = model.parameters[name]
        other = {**model.parameters, name: float(p["mass"]) if "mass" in p else float(p["ratio"]) * usual}
        return x_next + (model.step(x, u, dt, other) - model.step(x, u, dt, model.parameters))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is nearly linear."""
        return [{"ratio": 1.1}]


EFFECT = MassChange()
