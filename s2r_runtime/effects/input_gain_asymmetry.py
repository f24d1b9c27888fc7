"""An input acts by a factor that depends on its sign: u_act = gain_positive u where u > 0, gain_negative u where u < 0."""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns
from s2r_runtime.hookspecs import NominalModel, Parameter

RARE = 0.01
"""An input that has one sign in fewer rows than this share shows one factor only, which is `input_gain`."""


class InputGainAsymmetry(InputEffect):
    """Both 1 is none."""

    name = "input_gain_asymmetry"
    parameters = (Parameter("gain_positive", "", 0.0, 100.0, neutral=1.0), Parameter("gain_negative", "", 0.0, 100.0, neutral=1.0))
    additive = True

    def act(self, u: Array, p: Values) -> Array:
        """gain_positive max(u, 0) + gain_negative min(u, 0)."""
        return float(p["gain_positive"]) * np.maximum(u, 0.0) + float(p["gain_negative"]) * np.minimum(u, 0.0)

    def simpler(self, p: Values) -> tuple[str, Values]:
        """One gain for both."""
        return "input_gain", {"gain": 0.5 * (float(p["gain_positive"]) + float(p["gain_negative"]))}

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough where the input has both signs: the response is linear in both."""
        given = u[:, columns(model, channel)]
        rarer = min(np.count_nonzero(given > 0.0), np.count_nonzero(given < 0.0))
        return [{"gain_positive": 0.9, "gain_negative": 0.9}] if rarer > RARE * given.size else []


EFFECT = InputGainAsymmetry()
