"""A car turns less the faster it goes: omega = v tan(delta)/(L + K v²), L the wheel base (K: the understeer gradient over gravity).

The ideal car turns by v tan(delta)/L, so this is its turn times L/(L + K v²), with v the speed along the body over the step.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.body_motion import body_motion, moved
from s2r_runtime.effects.step_effect import Array, StepEffect, Values, has_pose, size_of
from s2r_runtime.hookspecs import NominalModel, Parameter

SHARPEST = 20.0
"""Times the ideal turn. A car that oversteers (K < 0) has no steady turn at all above sqrt(-L/K); numbers stay finite."""

SHARES = (0.05, 0.7)
"""Of the wheel base: K v² where the tracer begins; a strong one no longer acts in proportion."""


class Understeer(StepEffect):
    """coefficient K s²/m; 0 is none, negative oversteers."""

    name = "understeer"
    parameters = (Parameter("coefficient", "s²/m", -1e3, 1e3, neutral=0.0),)
    uneven = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """The heading of what has a wheel base."""
        return ("theta",) if has_pose(model) and "wheel_base" in model.parameters else ()

    def frame(self, model: NominalModel, channel: str) -> str:
        """Of the body's motion."""
        return "body"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """turn *= L/(L + K v²)."""
        motion = body_motion(x, x_next, model)
        base, v = model.parameters["wheel_base"], motion.forward / dt
        factor = base / np.maximum(base + float(p["coefficient"]) * v * v, base / SHARPEST)
        return moved(x, x_next, model, motion._replace(turn=factor * motion.turn))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """A weak one and a strong one."""
        speeds = [j for j, name in enumerate(model.inputs) if getattr(model, "units", {}).get(name, "m/s") == "m/s"]
        square = size_of(u[:, speeds]) ** 2
        return [{"coefficient": share * model.parameters["wheel_base"] / square} for share in SHARES]


EFFECT = Understeer()
