"""A castor behind the axle of a differential drive drags over the floor, with a dry force F against its motion.

The castor stands `arm` behind the axle and moves at c = (v, -arm w), s = |c|. Its drag loads both wheels by F v/s, and turns the body
by -F arm² w/s. A wheel creeps, or its motor gives way, in proportion to its load (kappa m/s per N). With loss = kappa F/2:

    v' = v (1 - loss/s),      w' = w (1 - 4 (arm/track)² loss/s),      neither changes its sign

The wheels' measured speeds do not change. The force and kappa act as a product only, so that `loss` is what the castor takes off the
speed ahead when it runs straight. Any point that drags over the floor there does the same, such as wheels that skid. What a castor does
while it swivels after a reversal is not in it.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.body_motion import body_motion, moved
from s2r_runtime.effects.step_effect import Array, StepEffect, Values
from s2r_runtime.effects.wheel_radius_scale import has_two_wheels
from s2r_runtime.hookspecs import NominalModel, Parameter

SHARE = 0.05
"""Where the tracer begins: share of the usual speed that is lost."""

STILL = 1e-12
"""m/s: nothing moves, and nothing drags."""


class CastorDrag(StepEffect):
    """loss m/s, 0 is neutral; arm m, from the axle back to the castor's contact."""

    name = "castor_drag"
    parameters = (Parameter("loss", "m/s", 0.0, 1e3, neutral=0.0), Parameter("arm", "m", 1e-3, 1e2))
    uneven = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """`*` on a pose that two wheels move, whose track is known."""
        return ("*",) if has_two_wheels(model) and "track" in model.parameters else ()

    def frame(self, model: NominalModel, channel: str) -> str:
        """Of the body's motion."""
        return "body"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """Both speeds with what the castor takes off."""
        motion = body_motion(x, x_next, model)
        arm, loss = float(p["arm"]), float(p["loss"])
        share = loss / np.maximum(np.hypot(motion.forward, arm * motion.turn) / dt, STILL)
        ahead = np.maximum(1.0 - share, 0.0)
        turning = np.maximum(1.0 - 4.0 * (arm / model.parameters["track"]) ** 2 * share, 0.0)
        return moved(x, x_next, model, motion._replace(forward=ahead * motion.forward, turn=turning * motion.turn))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """At the model's own `castor` (m behind the axle). Without one it is not searched: wheels that skid lose speed much alike."""
        arm = float(model.parameters.get("castor", 0.0))
        if not arm > 0.0 or not len(u):
            return []
        rest = np.zeros((len(u), len(model.states)))
        v = body_motion(rest, model.step(rest, u, dt, model.parameters), model).forward / dt
        loss = SHARE * float(np.sqrt(np.mean(v * v)))
        return [{"loss": loss, "arm": arm}] if loss > 0.0 else []


EFFECT = CastorDrag()
