"""Backlash of a gear on the output side: while the motor crosses it after a reversal, no force reaches the link.

The motor's share s of the inertia moves freely within the backlash w, the link coasts. With z the motor's position within it times s, of
which the whole width is W = s w, and the force F on the whole mass m:

    in contact, pushed against that side    u_act = F
    on the way                              z' = r,  r' = F/m,  u_act = 0
    at the other side                       the motor hits the link: u_act has the impulse m r, all that F did on the way; then r = 0

(inelastic; the momentum is that of the bodies together, so the link's speed after it is that without backlash). Only the product W of
backlash and share shows in the link's motion: `width` is W. What friction does to the link meanwhile does not move the contact here. F
that is constant over the step is solved for exactly. Hidden state: z, r; zero, the middle, at rest. Positions are those of the link.
"""

from __future__ import annotations

import math

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns, replaced
from s2r_runtime.effects.step_effect import length_unit
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.force_inputs import input_on
from s2r_runtime.models.forces import axes, mass_on, may_turn

STARTS, LONGEST = 18, 40.0
"""Widths from which the tracer begins: those that the usual force crosses in 1 to LONGEST steps, evenly on a scale of logarithms. A motor
that arrives a step too early fits no better than none, so they are close.
"""

TOUCHING = 1e-12
"""Of the width: nearer than that to a side it is in contact."""


class GearBacklash(InputEffect):
    """width rad (m): the backlash times the motor's share of the inertia; 0 is neutral."""

    name = "gear_backlash"
    parameters = (Parameter("width", "rad", 0.0, 1e3, neutral=0.0, kink=True),)

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Inputs that are the forces on axes that a motor may turn."""
        return tuple(driven_axes(model))

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of the axis' position."""
        return length_unit(model, driven_axes(model)[channel])

    def within_step(self, dt: float, p: Values) -> bool:
        """The motor may arrive within the step."""
        return float(p["width"]) > 0.0

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """(n, 2): z and r, zero."""
        return np.zeros((n, 2))

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """One step, row by row where a motor is on its way."""
        column, half = model.inputs.index(channel), 0.5 * float(p["width"])
        mass = mass_on(model, driven_axes(model)[channel])
        force = u[:, column]
        acting, after = force.copy(), z.copy()
        on_the_way = np.flatnonzero((z[:, 1] != 0.0) | (force * z[:, 0] < 0.0) | (np.abs(z[:, 0]) < half * (1.0 - TOUCHING)))
        for i in on_the_way if half > 0.0 else ():
            acting[i], *after[i] = _crossed(float(force[i]), float(z[i, 0]), float(z[i, 1]), half, mass, dt)
        return replaced(u, model, channel, acting[:, None]), after

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """u (T, nu) or (T, runs, nu), from rest."""
        half = 0.5 * float(p["width"])
        if half <= 0.0:
            return u.copy()
        mass = mass_on(model, driven_axes(model)[channel])
        given = u[..., columns(model, channel)]
        runs = [_over_time(run, half, mass, dt) for run in given.reshape(len(u), -1).T.tolist()]
        return replaced(u, model, channel, np.array(runs).T.reshape(given.shape))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Widths that the usual force crosses in some times."""
        size = float(np.sqrt(np.mean(u[:, columns(model, channel)] ** 2))) if len(u) else 0.0
        if not size:
            return []
        a = size / mass_on(model, driven_axes(model)[channel])
        return [{"width": float(0.5 * a * t * t)} for t in dt * np.geomspace(1.0, LONGEST, STARTS)]


def driven_axes(model: NominalModel) -> dict[str, str]:
    """Inputs that are forces on axes that may turn, each with its axis' velocity."""
    found = {}
    for axis in axes(model):
        force = input_on(model, axis) if may_turn(model, axis) else None
        if force is not None:
            found[force] = model.states[axis.velocity]
    return found


def _over_time(force: list[float], half: float, mass: float, dt: float) -> list[float]:
    """Means of what acts over each of these steps, from rest."""
    side = half * (1.0 - TOUCHING)
    z = r = 0.0
    for k, f in enumerate(force):
        if r == 0.0 and ((z >= side and f >= 0.0) or (z <= -side and f <= 0.0)):
            continue  # it stays in contact
        force[k], z, r = _crossed(f, z, r, half, mass, dt)
    return force


def _crossed(force: float, z: float, r: float, half: float, mass: float, dt: float) -> tuple[float, float, float]:
    """(mean of what acts over dt, z, r at its end). Within a step it meets a side twice at most: then the force holds it there."""
    a, left, impulse = force / mass, dt, 0.0
    while left > 0.0:
        if r == 0.0 and abs(z) >= half * (1.0 - TOUCHING) and force * z >= 0.0:
            return (impulse + force * left) / dt, math.copysign(half, z), 0.0
        until, side = min(((_arrives(z, r, a, half, s), s) for s in (1.0, -1.0)), key=lambda one: one[0])
        if until >= left:
            return impulse / dt, z + left * (r + 0.5 * a * left), r + a * left
        impulse += mass * (r + a * until)
        z, r, left = side * half, 0.0, left - until
    return impulse / dt, z, r


def _arrives(z: float, r: float, a: float, half: float, side: float) -> float:
    """Time until z reaches side * half, moving towards that side; infinite if it never does."""
    way, speed, pull = half - side * z, side * r, side * a
    if way <= half * TOUCHING:  # it is there; it leaves, or comes back
        if speed > 0.0:
            return 0.0
        return -2.0 * speed / pull if pull > 0.0 and speed < 0.0 else math.inf
    root = speed * speed + 2.0 * pull * way
    if root < 0.0 or (speed <= 0.0 and pull <= 0.0):
        return math.inf
    divisor = speed + math.sqrt(root)
    return 2.0 * way / divisor if divisor > 0.0 else math.inf


EFFECT = GearBacklash()
