"""A constant is added to an input: u_act = u + bias."""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns
from s2r_runtime.hookspecs import NominalModel, Parameter


class InputBias(InputEffect):
    """bias in the input's unit; 0 is none."""

    name = "input_bias"
    parameters = (Parameter("bias", "input", -1e6, 1e6, neutral=0.0),)
    linear = True

    def act(self, u: Array, p: Values) -> Array:
        """u + bias."""
        return u + float(p["bias"])

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: a twentieth of the input's size."""
        size = float(np.max(np.abs(u[:, columns(model, channel)]), initial=0.0))
        return [{"bias": 0.05 * size or 0.01}]


EFFECT = InputBias()
