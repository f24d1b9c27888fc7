"""An input acts through a play (gear, linkage): what acts stays where it is until the input has crossed the play and pushes it on.

y+ = min(max(y, u - width/2), u + width/2),   u_act = y+          (width: the whole play; the play operator, Prandtl-Ishlinskii)

u is constant over the step, so what acts is too. Hidden state: y, zero (the middle) at rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from s2r_runtime.effects.follower import Follower
from s2r_runtime.effects.input_effect import Array, Values, columns
from s2r_runtime.hookspecs import NominalModel, Parameter

SHARES = (0.04, 0.1, 0.2, 0.4, 0.8)
"""Of the input's size: the plays from which the tracer begins."""


class InputBacklash(Follower):
    """width in the input's unit, the whole play; 0 is none."""

    name = "input_backlash"
    parameters = (Parameter("width", "input", 0.0, 1e6, neutral=0.0, kink=True),)

    def after(self, y: Array, u: Array, steps: Array | float, dt: float, p: Values) -> Array:
        """Pushed at once; a second step of the same input changes nothing."""
        half = 0.5 * float(p["width"])
        return np.where(np.asarray(steps) > 0, np.minimum(np.maximum(y, u - half), u + half), y)

    def mean(self, y: Array, u: Array, dt: float | Array, p: Values) -> Array:
        """The same over all of the step."""
        return self.after(y, u, 1, 1.0, p)

    def begins(self, held: list[float], steps: Sequence[float], dt: float, p: Values) -> list[float]:
        """One push a stretch."""
        half = 0.5 * float(p["width"])
        y, found = 0.0, []
        for u in held:
            found.append(y)
            if u - half > y:
                y = u - half
            elif u + half < y:
                y = u + half
        return found

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Shares of the input's size."""
        size = float(np.quantile(np.abs(u[:, columns(model, channel)]), 0.98)) if len(u) else 0.0
        return [{"width": share * size} for share in SHARES] if size else []


EFFECT = InputBacklash()
