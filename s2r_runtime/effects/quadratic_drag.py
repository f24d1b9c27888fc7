"""Loss in proportion to the square of speed: air, water.

on an input that is a speed    u_act = u - coefficient u |u|
on the velocity of an axis     v' = a - (coefficient/mass) v |v|
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import replaced
from s2r_runtime.effects.step_effect import Array, ForceEffect, Values, force_unit, length_unit, size_of, usual_speed
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, is_speed, mass_on

SPEEDS = {"m/s", "rad/s"}
"""Units of inputs that are speeds. An input without a unit, in somebody's own model, may be one: the tracer asks if its name says so."""

INPUT_SHARE = 0.1
RATE = 0.3
"""Where the tracer begins: share of an input of the usual size that is lost; 1/s at the usual speed."""


class QuadraticDrag(ForceEffect):
    """coefficient: s/m on an input, N s²/m² on an axis (1/m where there is no mass); 0 is none."""

    name = "quadratic_drag"
    stage = "input"
    parameters = (Parameter("coefficient", "s/m", 0.0, 1e6, neutral=0.0),)
    uneven = True
    besides = True
    varies = True
    side_by_side = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Inputs that are speeds, then the velocities of axes, and speeds without a position."""
        units: dict[str, str] = getattr(model, "units", {})
        inputs = [name for name in model.inputs if units.get(name, "m/s") in SPEEDS]
        return (*inputs, *(name for name in super().channels(model) if name not in inputs))

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """One over a speed; of force over speed squared."""
        units: dict[str, str] = getattr(model, "units", {})
        if channel in model.inputs:
            return "s/rad" if units.get(channel) == "rad/s" else "s/m"
        force, length = force_unit(model, channel), length_unit(model, channel)
        return f"1/{length}" if force.endswith("/s²") else f"{force} s²/{length}²"

    def pushes(self, model: NominalModel, channel: str) -> bool:
        """On axes; on inputs it changes what acts."""
        return channel not in model.inputs

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its rate at this speed, 1/s."""
        if model.states[axis.velocity] != channel:
            return None
        rate = float(p["coefficient"]) / mass_on(model, channel) * np.abs(x[:, axis.velocity])
        return Push(rate=(rate, rate))

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """Static."""
        return self.input_sequence(u, model, channel, dt, p), z

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """u (..., nu) with the channel's loss; as it is where the channel is a state."""
        if self.pushes(model, channel):
            return u
        given = u[..., [model.inputs.index(channel)]]
        return replaced(u, model, channel, given - float(p["coefficient"]) * given * np.abs(given))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is linear. None on an input that nothing says is a speed."""
        if channel in model.inputs:
            if channel not in getattr(model, "units", {}) and not is_speed(channel):
                return []  # nothing drags at a steering angle, a voltage or a valve
            return [{"coefficient": INPUT_SHARE / size_of(u[:, [model.inputs.index(channel)]])}]
        return [{"coefficient": RATE * mass_on(model, channel) / usual_speed(u, model, dt, channel)}]


EFFECT = QuadraticDrag()
