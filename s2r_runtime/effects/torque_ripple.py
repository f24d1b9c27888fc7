"""Torque ripple: a force that repeats with the position, as a motor's slots and magnets or an eccentric gear make it.

    v' = a + (amplitude/mass) sin(2 pi q/period + phase)

`period` is the displacement of the axis between two pulls: a turn over the number of pole pairs and the gear ratio. At a steady speed v it
is a `periodic_disturbance` of frequency v/period. The tracer finds the period in the residual's periodogram over the position
(`periodogram`), which needs positions over one and a half periods at least.
"""

from __future__ import annotations

import math

import numpy as np

from s2r_runtime.effects.periodogram import peaks
from s2r_runtime.effects.projection import along
from s2r_runtime.effects.step_effect import Array, ForceEffect, Values, force_unit, length_unit
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.forces import Axis, Push, axes, axis_of, mass_on, may_turn

BEST = 2
"""Peaks that are offered."""

STEPS_A_PERIOD, FINEST = 4.0, 2000
"""Usual displacements within a step that the shortest period holds; shortest periods that the whole range of positions holds."""


class TorqueRipple(ForceEffect):
    """amplitude N m (N, rad/s²), 0 is neutral; period rad (m), phase rad at q = 0."""

    name = "torque_ripple"
    parameters = (
        Parameter("amplitude", "N m", 0.0, 1e6, neutral=0.0),
        Parameter("period", "rad", 1e-6, 1e4),
        Parameter("phase", "rad", -math.tau, math.tau),
    )
    uneven = True
    varies = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Positions of axes that a motor may turn."""
        return tuple(model.states[axis.position] for axis in axes(model) if may_turn(model, axis))

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Of what acts on the axis; of its position; of an angle."""
        return {"amplitude": force_unit(model, channel), "period": length_unit(model, channel), "phase": "rad"}[parameter]

    def push(self, x: Array, axis: Axis, model: NominalModel, channel: str, p: Values) -> Push | None:
        """Its acceleration at this position."""
        if model.states[axis.position] != channel:
            return None
        angle = math.tau / float(p["period"]) * x[:, axis.position] + float(p["phase"])
        return Push(drive=float(p["amplitude"]) / mass_on(model, channel) * np.sin(angle))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """None: the input does not show it."""
        return []

    def starts_from_states(self, x: Array, residual: Array, pushes: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """The highest peaks of the periodogram over the position of the residual along the axis."""
        axis = axis_of(model, channel)
        if axis is None or len(x) < 2:
            return []
        order = np.argsort(x[:, axis.position])
        q = x[order, axis.position]
        moves = dt * float(np.sqrt(np.mean(x[:, axis.velocity] ** 2)))
        spacing = max(0.5 * STEPS_A_PERIOD * moves, float(q[-1] - q[0]) / (2.0 * FINEST))  # periods of two spacings and more are sought
        if not spacing > 0.0:
            return []
        d, w = along(residual[order], pushes[order])
        found = peaks(q, d, w, spacing, BEST)
        return [
            {"amplitude": math.hypot(one.sine, one.cosine), "period": 1.0 / one.frequency, "phase": math.atan2(one.cosine, one.sine)}
            for one in found
        ]


EFFECT = TorqueRipple()
