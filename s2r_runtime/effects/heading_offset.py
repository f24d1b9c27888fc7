"""The heading that is measured is off by a constant (a camera or an IMU that is mounted askew): measured = true + angle."""

from __future__ import annotations

from s2r_runtime.effects.sensor_offset import SensorOffset
from s2r_runtime.effects.step_effect import Array, Values, has_pose
from s2r_runtime.hookspecs import NominalModel, Parameter

FIRST_RAD = (0.05, 0.8, -0.8, 1.6, -1.6, 2.4, -2.4, 3.1)
"""Where the tracer begins. What a small angle changes points across the way, what a large one does points along it, too: from a small one
no scale leads to a sensor that is mounted a quarter of a turn askew, or the wrong way round.
"""


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
        """All round, near enough to one another for a fit to find its way."""
        return [{"angle": angle} for angle in FIRST_RAD]


EFFECT = HeadingOffset()
