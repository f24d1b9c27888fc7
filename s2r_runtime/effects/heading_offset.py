"""The heading that is measured is off by a constant (a camera or an IMU that is mounted askew): measured = true + angle."""

from __future__ import annotations

from s2r_runtime.effects.sensor_offset import SensorOffset
from s2r_runtime.effects.step_effect import Array, Values, has_pose
from s2r_runtime.hookspecs import NominalModel, Parameter


class HeadingOffset(SensorOffset):
    """angle rad; 0 is none."""

    name = "heading_offset"
    parameters = (Parameter("angle", "rad", -3.2, 3.2, neutral=0.0),)
    value = "angle"

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """The heading of a pose."""
        return ("theta",) if has_pose(model) else ()

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """rad."""
        return "rad"

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is nearly linear."""
        return [{"angle": 0.05}]


EFFECT = HeadingOffset()
