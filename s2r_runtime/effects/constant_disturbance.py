"""Something pushes all the time: wind, a current, a slope under a cart, a cable.

poses                 world: (x, y)+ += dt (x, y) m/s;      body: the same along the heading that holds during the step
axes x, y (, z)       (vx, vy, vz)' += (x, y, z) m/s²
a single axis         x: a force, v' += x/mass
speeds vx, vy without a position, in somebody's own model (a flying robot's in the wind)    (vx, vy)' += (x, y) m/s²
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.body_motion import body_motion, moved
from s2r_runtime.effects.step_effect import Array, ForceEffect, Values, force_unit, has_pose, size_of
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, axes, lone_speeds, mass_on

SHARE = 0.05
"""Of the inputs' size: the first look; the response is linear."""


class ConstantDisturbance(ForceEffect):
    """x, y, z: one rate (m/s), acceleration (m/s²) or force (N) an axis; 0 is none. A single axis has x only."""

    name = "constant_disturbance"
    parameters = tuple(Parameter(name, "m/s", -1e6, 1e6, neutral=0.0) for name in ("x", "y", "z"))
    uneven = True
    additive = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """The world's axes, or those of speeds without a position; the body's, where rates act on a pose."""
        if level_speeds(model):
            return ("world",)
        if not directions(model):
            return ()
        return ("world", "body") if has_pose(model) and not axes(model) else ("world",)

    def takes(self, model: NominalModel, channel: str) -> tuple[str, ...]:
        """x, y, and z where it can go up; x alone on a single axis."""
        return directions(model) or tuple("xy" if level_speeds(model) else "")

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """A rate, or what acts on an axis."""
        return force_unit(model) if axes(model) else "m/s²" if level_speeds(model) else "m/s"

    def frame(self, model: NominalModel, channel: str) -> str:
        """In which axes it adds to the motion of a pose."""
        return channel

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its acceleration on this axis; None where nothing of that name pushes."""
        along = direction(model, axis)
        return Push(drive=float(p[along]) / mass_on(model, model.states[axis.velocity])) if along in p else None

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """Rates on a pose, forces on axes."""
        if self.pushes(model, channel):
            return super().after_step(x, u, x_next, model, channel, dt, p)
        if speeds := level_speeds(model):
            after = x_next.copy()
            after[:, speeds] += np.multiply.outer(dt, [float(p[name]) for name in "xy"])
            return after
        if channel == "body":
            motion = body_motion(x, x_next, model)
            return moved(
                x, x_next, model, motion._replace(forward=motion.forward + dt * float(p["x"]), left=motion.left + dt * float(p["y"]))
            )
        return shifted(x_next, model, dt * float(p["x"]), dt * float(p["y"]))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is linear."""
        return [dict.fromkeys(self.takes(model, channel), SHARE * size_of(u))]


def directions(model: NominalModel) -> tuple[str, ...]:
    """In which something can push: x and y of a position in the plane, z above it, x of a single axis; else none."""
    if {"x", "y"} <= {*model.states}:
        moving = {model.states[axis.position] for axis in axes(model)}
        return tuple(name for name in "xyz" if name in (moving or "xy")) if not moving or {"x", "y"} <= moving else ()
    return ("x",) if len(axes(model)) == 1 else ()


def level_speeds(model: NominalModel) -> list[int]:
    """Where, among the states, the speeds along x and y without a position are. Upwards gravity, or a gain of thrust, says the same. None
    beside axes, which are what is pushed then.
    """
    lone = () if axes(model) else lone_speeds(model)
    named = [[name for name in lone if name.lower().endswith(letter)] for letter in "xy"]
    return [model.states.index(one) for (one,) in named] if all(len(n) == 1 for n in named) else []


def direction(model: NominalModel, axis: Axis) -> str:
    """The one that is along this axis."""
    return model.states[axis.position] if "y" in directions(model) else "x"


def shifted(x_next: Array, model: NominalModel, x: Array | float, y: Array | float) -> Array:
    """The position moved along the world's axes, m."""
    after = x_next.copy()
    after[:, model.states.index("x")] += x
    after[:, model.states.index("y")] += y
    return after


EFFECT = ConstantDisturbance()
