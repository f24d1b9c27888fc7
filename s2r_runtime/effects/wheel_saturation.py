"""Both wheels of a robot with inputs v, w are clipped at `speed`, which couples v and w:

left, right = v -/+ w track/2, each clipped to ± speed;   v_act = (left + right)/2,   w_act = (right - left)/track
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, replaced
from s2r_runtime.hookspecs import NominalModel, Parameter

SHARES = (0.97, 0.85, 0.6, 0.35)
"""Of the largest load of a wheel."""


class WheelSaturation(InputEffect):
    """speed at the wheel m/s, track (distance between the wheels) m."""

    name = "wheel_saturation"
    parameters = (Parameter("speed", "m/s", 0.0, 1e3, kink=True), Parameter("track", "m", 1e-3, 1e2, kink=True))
    all_alike = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Models whose inputs are v and w."""
        return ("*",) if tuple(model.inputs) == ("v", "w") else ()

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """Clips both wheels."""
        half = p["track"] / 2.0
        left = np.clip(u[..., 0] - half * u[..., 1], -p["speed"], p["speed"])
        right = np.clip(u[..., 0] + half * u[..., 1], -p["speed"], p["speed"])
        return replaced(u, model, channel, np.stack([(left + right) / 2.0, (right - left) / p["track"]], axis=-1))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Tracks around the one at which both inputs load the wheels alike, limits inside what was asked for; the first just inside:
        by a quiet sensor, one that takes off too much is worse than none, and leads nowhere.
        """
        v, w = (float(np.quantile(np.abs(u[:, j]), 0.98)) for j in (0, 1))
        if v == 0.0 or w == 0.0:
            return []
        tracks = [2.0 * v / w * ratio for ratio in (0.3, 0.6, 1.0, 1.7, 3.0)]
        load = np.abs(u[:, :1]) + np.abs(u[:, 1:]) * np.array(tracks) / 2.0
        sizes = np.quantile(load, 0.98, axis=0)
        return [{"speed": float(share * s), "track": t} for t, s in zip(tracks, sizes, strict=True) for share in SHARES]


EFFECT = WheelSaturation()
