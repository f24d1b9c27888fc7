"""What is measured is another point of the body than the one that the model moves: measured = true + R(theta) (x, y)."""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.step_effect import Array, SensorEffect, Values
from s2r_runtime.hookspecs import NominalModel, Parameter

FIRST_M = 0.05
"""Where the tracer begins; the response is linear."""


class SensorLeverArm(SensorEffect):
    """x, y m: where the measured point lies in the body; 0 is none."""

    name = "sensor_lever_arm"
    parameters = (Parameter("x", "m", -1e3, 1e3, neutral=0.0), Parameter("y", "m", -1e3, 1e3, neutral=0.0))
    additive = True

    def to_true(self, x: Array, model: NominalModel, channel: str, p: Values) -> Array:
        """Of the measured point -> of the one that the model moves."""
        return self._moved(x, model, -float(p["x"]), -float(p["y"]))

    def to_measured(self, x: Array, model: NominalModel, channel: str, p: Values) -> Array:
        """Of the one that the model moves -> of the measured point."""
        return self._moved(x, model, float(p["x"]), float(p["y"]))

    def _moved(self, x: Array, model: NominalModel, forward: float, left: float) -> Array:
        theta = x[:, model.states.index("theta")]
        c, s = np.cos(theta), np.sin(theta)
        after = x.copy()
        after[:, model.states.index("x")] += c * forward - s * left
        after[:, model.states.index("y")] += s * forward + c * left
        return after

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough."""
        return [{"x": FIRST_M, "y": FIRST_M}]


EFFECT = SensorLeverArm()
