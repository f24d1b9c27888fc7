"""The two wheels of a differential drive have other radii than the model: worn, soft or unequal tyres.

    left, right displacement of the wheels over the step:   s_l = d - turn track/2,   s_r = d + turn track/2
    with the wheels as they are:                            d' = (left s_l + right s_r)/2,   turn' = (right s_r - left s_l)/track

d m: displacement of the body ahead; turn rad: change of its heading. The wheels' measured speeds do not change: the encoder counts turns.
With a = (left + right)/2 and b = (right - left)/2 this is

    v' = a v + (b track/2) w,      w' = a w + (2 b/track) v

so two wheels of the same wrong radius are a gain of both, and unequal wheels turn a robot that is commanded straight ahead (E_d in
J. Borenstein, L. Feng, Measurement and correction of systematic odometry errors in mobile robots, IEEE Trans. Robotics and Automation 12,
1996). The track is the model's parameter. A unicycle has none: it is then a parameter of the effect.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.body_motion import body_motion, moved
from s2r_runtime.effects.step_effect import Array, StepEffect, Values, has_pose
from s2r_runtime.hookspecs import NominalModel, Parameter

START = 0.98
"""Where the tracer begins. The response is linear."""

TRACK_M = (0.01, 10.0)
"""Distance between the wheels, from that of a toy to that of a mining truck."""


class WheelRadiusScale(StepEffect):
    """left, right: radius over the model's, 1 is neutral; track m, where the model has none."""

    name = "wheel_radius_scale"
    parameters = (
        Parameter("left", "", -100.0, 100.0, neutral=1.0),
        Parameter("right", "", -100.0, 100.0, neutral=1.0),
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
        """Both wheels' displacements by their factors."""
        return scaled(x, x_next, model, float(p["left"]), float(p["right"]), float(p.get("track", model.parameters.get("track", 0.0))))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough; the track is that at which v and w load the wheels alike."""
        both: Values = {"left": START, "right": START}
        return [both] if "track" in model.parameters else [{**both, "track": usual_track(u)}]


def has_two_wheels(model: NominalModel) -> bool:
    """Whether it is a pose that two wheels side by side move: it has a track, or its inputs are v and w."""
    if not has_pose(model) or "wheel_base" in model.parameters:
        return False
    return model.parameters.get("track", 0.0) > 0.0 or tuple(model.inputs) == ("v", "w")


def usual_track(u: Array) -> float:
    """Track at which v and w (T, 2) load the wheels alike, m, within TRACK_M; 0.3 where one of them is zero."""
    v, w = np.sqrt(np.mean(u * u, axis=0)) if len(u) else (0.0, 0.0)
    return float(np.clip(2.0 * v / w, *TRACK_M)) if v > 0.0 and w > 0.0 else 0.3


def scaled(x: Array, x_next: Array, model: NominalModel, left: float, right: float, track: float) -> Array:
    """x_next (n, nx) with the wheels' displacements times left and right."""
    motion = body_motion(x, x_next, model)
    half = 0.5 * track * motion.turn
    by_left, by_right = left * (motion.forward - half), right * (motion.forward + half)
    return moved(x, x_next, model, motion._replace(forward=0.5 * (by_left + by_right), turn=(by_right - by_left) / track))


EFFECT = WheelRadiusScale()
