"""The world is tilted: what pulls downhill is felt along the body only, the wheels hold against the rest.

poses          forward speed += x cos(theta) + y sin(theta),  (x, y) m/s: at a heading along the world's x, and along its y
axes x, y      (vx, vy)' += (x, y) m/s²: without wheels it is a constant push (`constant_disturbance`)
a single axis  v' += x/mass
"""

from __future__ import annotations

from s2r_runtime.effects.body_motion import mean_of_twice
from s2r_runtime.effects.constant_disturbance import ConstantDisturbance, directions, shifted
from s2r_runtime.effects.step_effect import Array, Values, has_pose
from s2r_runtime.hookspecs import NominalModel
from s2r_runtime.models.forces import axes, pushed


class GravitySlope(ConstantDisturbance):
    """x, y in m/s (poses), m/s² or N (axes); 0 is none. A single axis has x only."""

    name = "gravity_slope"

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """`*` on poses and axes."""
        return ("*",) if directions(model) and (has_pose(model) or axes(model)) else ()

    def frame(self, model: NominalModel, channel: str) -> str:
        """It adds along the headings that the step has had."""
        return "world"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """Rates on a pose, forces on axes."""
        if self.pushes(model, channel):
            return pushed(x, u, x_next, model, [(self, channel, p)], dt)
        px, py = float(p["x"]), float(p["y"])
        c, s = mean_of_twice(x, x_next, model)
        return shifted(x_next, model, 0.5 * dt * (px + px * c + py * s), 0.5 * dt * (py + px * s - py * c))


EFFECT = GravitySlope()
