"""An input acts by a constant factor: u_act = gain u."""

from __future__ import annotations

from s2r_runtime.effects.input_effect import Array, InputEffect, Values
from s2r_runtime.hookspecs import NominalModel, Parameter


class InputGain(InputEffect):
    """gain 1 is none."""

    name = "input_gain"
    parameters = (Parameter("gain", "", -100.0, 100.0, neutral=1.0),)
    linear = True

    def act(self, u: Array, p: Values) -> Array:
        """gain u."""
        return u * float(p["gain"])

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is linear in it."""
        return [{"gain": 0.9}]


EFFECT = InputGain()
