"""What effects of stage `step` and `sensor` have in common.

`StepEffect` changes the result of the nominal step: override `after_step`. `ForceEffect` acts on an axis (a position and its rate), with
all other forces of the model (`s2r_runtime.models.forces`): override `push`. `SensorEffect` stands between the true and the measured
state: override `to_true` and `to_measured`. Third parties may build on these or on nothing at all: the interface is
`s2r_runtime.hookspecs.Effect`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.force_inputs import force_input
from s2r_runtime.models.forces import (
    POSE,
    Axis,
    Push,
    axes,
    axis_of,
    coupled,
    is_rotary,
    lone_speeds,
    mass_name,
    mass_on,
    pushed,
    torque_inertia,
    turns,
)

Array = NDArray[np.float64]
Values = dict[str, Any]

REMEMBERED_S = 1.0
"""Of the order of what friction and a person who drives back and forth make of it."""


class StepEffect:
    """No hidden state; inputs pass."""

    name = ""
    stage = "step"
    parameters: tuple[Parameter, ...] = ()

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """`*` on planar poses."""
        return ("*",) if has_pose(model) else ()

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """SI unit as declared."""
        return next(p.unit for p in self.parameters if p.name == parameter)

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """None: (n, 0)."""
        return np.zeros((n, 0))

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """Not of stage `input`."""
        return u, z

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """Not of stage `input`."""
        return u

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """Nothing changes."""
        return x_next


class ForceEffect(StepEffect):
    """Acts on axes by a `push`. varies: whether the push depends on the state; besides: whether it also brakes a lone speed that the model
    itself slows down. What is in proportion to speed, that model has in a number of its own.
    """

    varies = False
    besides = False

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """The velocities of all axes, and speeds without a position."""
        return (*(model.states[axis.velocity] for axis in axes(model)), *lone_speeds(model, self.besides))

    def pushes(self, model: NominalModel, channel: str) -> bool:
        """Whether it acts by `push` there."""
        return bool(axes(model)) or channel in lone_speeds(model, self.besides)

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """What it adds on this axis at x (n, nx), accelerations; None where it does not act."""
        return None

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """The step with this force alone."""
        return pushed(x, u, x_next, model, [(self, channel, p)], dt) if self.pushes(model, channel) else x_next


class SensorEffect(StepEffect):
    """measured = true + offset(true)."""

    stage = "sensor"

    def to_true(self, x: Array, model: NominalModel, channel: str, p: Values) -> Array:
        """Measured (n, nx) -> true."""
        return x

    def to_measured(self, x: Array, model: NominalModel, channel: str, p: Values) -> Array:
        """True (n, nx) -> measured."""
        return x


def has_pose(model: NominalModel) -> bool:
    """Whether it has a position in the plane and a heading."""
    return {*model.states} >= POSE


def force_unit(model: NominalModel, channel: str = "") -> str:
    """SI unit of what acts on an axis or a speed: of a force, or of a torque on a rotary axis, where there is a mass or an inertia.

    Otherwise of an acceleration, as on a speed without a position. channel: of the axis; the first one's without it.
    """
    units: dict[str, str] = getattr(model, "units", {})
    if channel in lone_speeds(model, slowed=True):
        return f"{length_unit(model, channel)}/s²"
    if coupled(model):
        return units.get(model.inputs[0], "input's unit")
    axis = axis_of(model, channel) or next(iter(axes(model)), None)
    if axis is not None and is_rotary(model, axis):
        known = "inertia" in model.parameters or ("mass" in model.parameters and torque_inertia(model, axis) > 0.0)
        return "N m" if known else "rad/s²"
    if not mass_name(model):
        return f"{length_unit(model, channel)}/s²"
    usual = "N m" if mass_name(model) == "inertia" else "N"
    force = force_input(model)
    return usual if force is None else units.get(force, usual)


def length_unit(model: NominalModel, channel: str) -> str:
    """Of the position of the axis whose position or velocity the channel is; of a speed that has none, what it goes in a second."""
    units: dict[str, str] = getattr(model, "units", {})
    axis = axis_of(model, channel)
    if axis is None:
        speed = units.get(channel, "rad/s" if turns(channel) else "m/s")
        return speed.removesuffix("/s") if speed.endswith("/s") else f"{speed} s"
    name = model.states[axis.position]
    if coupled(model):
        return units.get(name, f"{name}'s unit")
    return units.get(name, "rad" if is_rotary(model, axis) else "m")


def usual_speed(u: Array, model: NominalModel, dt: float, channel: str = "") -> float:
    """Rms of what u (T, nu) adds to the speed of an axis within REMEMBERED_S, as a guess of the speeds that a recording shows."""
    total = np.cumsum(np.vstack([np.zeros((1, u.shape[1])), u]), axis=0) * dt / mass_on(model, channel)
    ago = np.maximum(np.arange(1, len(total)) - max(1, round(REMEMBERED_S / dt)), 0)
    gained = total[1:] - total[ago]
    return float(np.sqrt(np.mean(gained * gained))) if np.any(u) else 1.0


def size_of(u: Array) -> float:
    """Root mean square of the inputs, (T, nu); 1 if they are zero."""
    return float(np.sqrt(np.mean(u * u))) if np.any(u) else 1.0
