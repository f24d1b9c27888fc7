"""Wheels of a differential drive turn farther than they roll, each side by its own share: one on ice, one under more load.

A wheel's displacement is (1 - ratio) of the ideal one; its measured speed does not change. On all data this is `wheel_radius_scale` with
left, right = 1 - ratio: a wheel that always slips by 4 % and one that is 4 % too small move a robot alike. Only a look at the wheel, or
another floor, separates the two.
"""

from __future__ import annotations

from s2r_runtime.effects.step_effect import Array, Values
from s2r_runtime.effects.wheel_radius_scale import TRACK_M, WheelRadiusScale
from s2r_runtime.hookspecs import NominalModel, Parameter


def _lost(p: Values) -> Values:
    """left, right: shares that are lost as factors of the displacement, and back."""
    return {**p, "left": 1.0 - float(p["left"]), "right": 1.0 - float(p["right"])}


class WheelSlip(WheelRadiusScale):
    """left, right: share of the displacement that is lost, 0 is neutral, 1 spins on the spot; track m, where the model has none."""

    name = "wheel_slip"
    parameters = (
        Parameter("left", "", -99.0, 101.0, neutral=0.0),
        Parameter("right", "", -99.0, 101.0, neutral=0.0),
        Parameter("track", "m", *TRACK_M),
    )

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """Both wheels' displacements less what is lost."""
        return super().after_step(x, u, x_next, model, channel, dt, _lost(p))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Those of the radii."""
        return [_lost(p) for p in super().starts(u, model, channel, dt)]


EFFECT = WheelSlip()
