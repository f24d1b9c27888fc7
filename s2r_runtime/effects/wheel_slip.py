"""Wheels of a differential drive turn farther than they roll, each side by its own share: one on ice, one under more load.

A wheel's displacement is (1 - ratio) of the ideal one; its measured speed does not change. On all data this is `wheel_radius_scale` with
left, right = 1 - ratio: a wheel that always slips by 4 % and one that is 4 % too small move a robot alike. Only a look at the wheel, or
another floor, separates the two.
"""

from __future__ import annotations

from s2r_runtime.effects.step_effect import Array, StepEffect, Values
from s2r_runtime.effects.wheel_radius_scale import TRACK_M, has_two_wheels, scaled, usual_track
from s2r_runtime.hookspecs import NominalModel, Parameter


class WheelSlip(StepEffect):
    """left, right: share of the displacement that is lost, 0 is neutral, 1 spins on the spot; track m, where the model has none."""

    name = "wheel_slip"
    parameters = (
        Parameter("left", "", -99.0, 101.0, neutral=0.0),
        Parameter("right", "", -99.0, 101.0, neutral=0.0),
        Parameter("track", "m", *TRACK_M),
    )
    uneven = True
    additive = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """`*` on a pose that two wheels move."""
        return ("*",) if has_two_wheels(model) else ()

    def takes(self, model: NominalModel, channel: str) -> tuple[str, ...]:
        """The track where the model does not have it."""
        return ("left", "right") if "track" in model.parameters else ("left", "right", "track")

    def frame(self, model: NominalModel, channel: str) -> str:
        """Of the wheels, before all that changes what the body makes of them."""
        return "wheels"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """Both wheels' displacements less what is lost."""
        track = float(p.get("track", model.parameters.get("track", 0.0)))
        return scaled(x, x_next, model, 1.0 - float(p["left"]), 1.0 - float(p["right"]), track)

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is linear."""
        both: Values = {"left": 0.02, "right": 0.02}
        return [both] if "track" in model.parameters else [{**both, "track": usual_track(u)}]


EFFECT = WheelSlip()
