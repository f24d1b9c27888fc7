"""Small inputs do nothing: u_act = 0 within ± width, u - sign(u) width outside (no jump at the edge)."""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns
from s2r_runtime.hookspecs import NominalModel, Parameter

SHARES = (0.02, 0.05, 0.1, 0.2, 0.35, 0.6)
"""Of the input's size: the widths from which the tracer begins."""


class InputDeadband(InputEffect):
    """width in the input's unit, to either side; 0 is none."""

    name = "input_deadband"
    parameters = (Parameter("width", "input", 0.0, 1e6, neutral=0.0, kink=True),)

    def act(self, u: Array, p: Values) -> Array:
        """u less its part within ± width."""
        width = float(p["width"])
        return u - np.minimum(np.maximum(u, -width), width)

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Shares of the input's size."""
        size = float(np.quantile(np.abs(u[:, columns(model, channel)]), 0.98)) if len(u) else 0.0
        return [{"width": share * size} for share in SHARES] if size else []


EFFECT = InputDeadband()
