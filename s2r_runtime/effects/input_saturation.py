"""An input is clipped: u_act = min(max(u, low), high)."""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns
from s2r_runtime.hookspecs import NominalModel, Parameter


class InputSaturation(InputEffect):
    """low, high in the input's unit."""

    name = "input_saturation"
    parameters = (Parameter("low", "input", -1e6, 1e6, kink=True), Parameter("high", "input", -1e6, 1e6, kink=True))

    def wrong(self, p: Values) -> str:
        """What is wrong with the values together."""
        return "" if p["low"] < p["high"] else f"low is {p['low']}, must be below high ({p['high']})"

    def act(self, u: Array, p: Values) -> Array:
        """Clipped."""
        return np.minimum(np.maximum(u, p["low"]), p["high"])

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Limits inside what was asked for: symmetric, and on one side alone with the other one out of reach."""
        size = float(np.max(np.abs(u[:, columns(model, channel)]), initial=0.0))
        both = [{"low": -share * size, "high": share * size} for share in (0.95, 0.85, 0.7, 0.55, 0.4, 0.25)]
        one = [side for share in (0.8, 0.5, 0.3) for side in ({"low": -size, "high": share * size}, {"low": -share * size, "high": size})]
        return [*both, *one] if size else []


EFFECT = InputSaturation()
