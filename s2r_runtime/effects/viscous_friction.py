"""Friction in proportion to speed: force = -coefficient v; or another coefficient forward than backward.

On an axis it is one of its forces (over the mass, if there is one): v' = a - (coefficient/mass) v. A car whose model sets its
speed at once is at that speed when the step begins and then loses it, so that over the step

    speed+ = nominal exp(-coefficient dt),      pose moves by the nominal one times (1 - exp(-coefficient dt))/(coefficient dt)

A speed without a position, in somebody's own model (a flying robot's, under tilt and thrust), is lost as an axis' is.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.step_effect import Array, ForceEffect, Values, force_unit, has_pose, length_unit
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, axes, axis_of, coupled, mass_on

START_RATE = 0.5
"""1/s: a slow loss; what it does to a step is in proportion to it."""


class ViscousFriction(ForceEffect):
    """coefficient N s/m (N m s/rad; 1/s where there is no mass), or coefficient_positive and coefficient_negative; 0 is none."""

    name = "viscous_friction"
    parameters = tuple(
        Parameter(name, "N s/m", 0.0, 1e6, neutral=0.0) for name in ("coefficient", "coefficient_positive", "coefficient_negative")
    )
    uneven = True
    optional = ("coefficient", "coefficient_positive", "coefficient_negative")
    additive = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Velocities of axes, and speeds without a position; the speed of a car that is set at once."""
        car = has_pose(model) and "speed" in getattr(model, "reached", {})
        return (*super().channels(model), *(("speed",) if car else ()))

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of force over speed."""
        axis = axis_of(model, channel)
        force = force_unit(model, channel)
        if axis is not None and coupled(model) and not getattr(model, "units", {}):
            return f"{model.inputs[axes(model).index(axis)]}/{channel}"  # one's own units, whatever they are
        return "1/s" if not self.pushes(model, channel) or force.endswith("/s²") else f"{force} s/{length_unit(model, channel)}"

    def wrong(self, p: Values) -> str:
        """What is wrong with the values together."""
        return one_or_two(p, "coefficient")

    def pushes(self, model: NominalModel, channel: str) -> bool:
        """On all but the speed of a car."""
        return channel in super().channels(model)

    def frame(self, model: NominalModel, channel: str) -> str:
        """A car's loss of speed is a matter of its body."""
        return "body"

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its rates, 1/s."""
        return Push(rate=by_direction(p, "coefficient", mass_on(model, channel))) if model.states[axis.velocity] == channel else None

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """The step with this force alone."""
        if self.pushes(model, channel):
            return super().after_step(x, u, x_next, model, channel, dt, p)
        forward, backward = by_direction(p, "coefficient", 1.0)
        speed = model.states.index(channel)
        z = dt * np.where(x_next[:, speed] > 0.0, forward, backward)
        mean = np.where(z < 1e-8, 1.0 - 0.5 * z, -np.expm1(-z) / np.maximum(z, 1e-300))
        after = x_next.copy()
        for j in (model.states.index(name) for name in ("x", "y", "theta")):
            after[:, j] = x[:, j] + mean * (x_next[:, j] - x[:, j])
        after[:, speed] = x_next[:, speed] * np.exp(-z)
        return after

    def simpler(self, p: Values) -> tuple[str, Values]:
        """The same either way."""
        return self.name, either_way(p, "coefficient")

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One each way of saying it: the response is linear."""
        c = START_RATE * (mass_on(model, channel) if self.pushes(model, channel) else 1.0)
        return [{"coefficient": c}, {"coefficient_positive": c, "coefficient_negative": c}]


def by_direction(p: Values, name: str, over: float) -> tuple[float, float]:
    """Forward and backward; the same object twice where it is one number."""
    if name in p:
        one = float(p[name]) / over
        return one, one
    return float(p[f"{name}_positive"]) / over, float(p[f"{name}_negative"]) / over


def either_way(p: Values, name: str) -> Values:
    """One number for both directions, their mean."""
    return p if name in p else {name: 0.5 * (float(p[f"{name}_positive"]) + float(p[f"{name}_negative"]))}


def one_or_two(p: Values, name: str) -> str:
    """What is wrong with a value that is one number, or one each way."""
    both = {f"{name}_positive", f"{name}_negative"}
    if (name in p and not both & set(p)) or (name not in p and both <= set(p)):
        return ""
    return f"has {', '.join(sorted(p)) or 'no value'}, must have either {name} or both {name}_positive and {name}_negative"


EFFECT = ViscousFriction()
