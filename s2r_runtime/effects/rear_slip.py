"""A car's rear tyres give way in curves: sideways speed of the rear axle = -C v² omega, to the left.

They carry m a l_f/L across, with a = v omega and l_f from the centre of mass to the front axle, and give way by an angle of that over their
stiffness C_r (N/rad): speed across = -v (m l_f/(L C_r)) v omega. `lateral_slip` has v in the place of v², as wheels that drag have it.
"""

from __future__ import annotations

from s2r_runtime.effects.body_motion import body_motion, moved
from s2r_runtime.effects.step_effect import Array, StepEffect, Values, has_pose, size_of
from s2r_runtime.hookspecs import NominalModel, Parameter

SHARE = 0.2
"""Of the wheel base: C v² where the tracer begins. The response is linear."""


class RearSlip(StepEffect):
    """coefficient C s²/m; 0 is none, above it slides outwards."""

    name = "rear_slip"
    parameters = (Parameter("coefficient", "s²/m", -1e3, 1e3, neutral=0.0),)
    uneven = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """What has a wheel base."""
        return ("*",) if has_pose(model) and "wheel_base" in model.parameters else ()

    def frame(self, model: NominalModel, channel: str) -> str:
        """After all that changes how fast it turns: tyres know the yaw rate that there is."""
        return "sliding"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """left -= coefficient (forward/dt)² turn."""
        motion = body_motion(x, x_next, model)
        v = motion.forward / dt
        return moved(x, x_next, model, motion._replace(left=motion.left - float(p["coefficient"]) * v * v * motion.turn))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is linear."""
        speeds = [j for j, name in enumerate(model.inputs) if getattr(model, "units", {}).get(name, "m/s") == "m/s"]
        return [{"coefficient": SHARE * model.parameters["wheel_base"] / size_of(u[:, speeds]) ** 2}]


EFFECT = RearSlip()
