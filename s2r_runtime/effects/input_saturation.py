"""An input is clipped: u_act = min(max(u, low), high). A limit that is left out is not there."""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns
from s2r_runtime.hookspecs import NominalModel, Parameter

BOTH = (0.97, 0.9, 0.7, 0.5, 0.3)
ONE = (0.97, 0.85, 0.5)
ALONE = (0.97, 0.85, 0.7, 0.5, 0.3)
"""Of what was asked for in that direction: limits from which the tracer begins. Two at once; one of two; the only one that can be met."""


class InputSaturation(InputEffect):
    """low, high in the input's unit; one of them may be left out: an input that never meets a limit says nothing of it."""

    name = "input_saturation"
    parameters = (Parameter("low", "input", -1e6, 1e6, kink=True), Parameter("high", "input", -1e6, 1e6, kink=True))
    optional = ("low", "high")

    def wrong(self, p: Values) -> str:
        """What is wrong with the values together."""
        if "low" not in p and "high" not in p:
            return "has neither low nor high, must have at least one"
        low, high = p.get("low", -np.inf), p.get("high", np.inf)
        return "" if low < high else f"low is {low}, must be below high ({high})"

    def act(self, u: Array, p: Values) -> Array:
        """Clipped."""
        above = np.maximum(u, p["low"]) if "low" in p else u
        return np.asarray(np.minimum(above, p["high"]) if "high" in p else above)

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Limits inside what was asked for, on the sides to which it was asked."""
        given = u[:, columns(model, channel)]
        low, high = min(float(np.min(given, initial=0.0)), 0.0), max(float(np.max(given, initial=0.0)), 0.0)
        if low < 0.0 < high:
            both = [{"low": share * low, "high": share * high} for share in BOTH]
            return [*both, *({name: share * limit} for share in ONE for name, limit in (("low", low), ("high", high)))]
        return [{name: share * limit} for share in ALONE for name, limit in (("low", low), ("high", high)) if limit]


EFFECT = InputSaturation()
