"""An input's gain drifts (a battery that empties, a motor that warms): u_act = (1 + rate t) u, t since the start.

u is constant over each step, so the mean over [t, t + dt] is that at the mean time; with times below 0 as 0 that is
(max(t + dt, 0)² - max(t, 0)²) / (2 dt).
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, Values
from s2r_runtime.effects.timed_input import TimedInputEffect
from s2r_runtime.hookspecs import NominalModel, Parameter

WHOLE = 0.1
"""The tracer begins with a gain that changes by this over the recording; the response is linear in the rate."""


class InputGainDrift(TimedInputEffect):
    """rate in 1/s, 0 is none; on one input, or on all alike (`*`)."""

    name = "input_gain_drift"
    parameters = (Parameter("rate", "1/s", -10.0, 10.0, neutral=0.0),)
    all_alike = True
    uneven = True

    def within_step(self, dt: float, p: Values) -> bool:
        """The gain goes on drifting over the step."""
        return bool(p["rate"] != 0.0)

    def act_at(self, u: Array, t: Array, dt: float | Array, p: Values) -> Array:
        """(1 + rate t) u."""
        mean = t + 0.5 * dt
        if t.min(initial=0.0) < 0.0:
            mean = (np.maximum(t + dt, 0.0) ** 2 - np.maximum(t, 0.0) ** 2) / (2.0 * dt)
        return u * (1.0 + float(p["rate"]) * mean)

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float, t: Array) -> list[Values]:
        """One is enough."""
        return [{"rate": WHOLE / max(float(np.ptp(t)), dt)}] if len(t) else []


EFFECT = InputGainDrift()
