"""Yaw rate = gain times the ideal one: wheels that must skid to turn act as if the track were wider (gain below 1)."""

from __future__ import annotations

from s2r_runtime.effects.body_motion import body_motion, moved
from s2r_runtime.effects.step_effect import Array, StepEffect, Values, has_pose
from s2r_runtime.hookspecs import NominalModel, Parameter


class TrackScale(StepEffect):
    """gain 1 is none."""

    name = "track_scale"
    parameters = (Parameter("gain", "", -100.0, 100.0, neutral=1.0),)
    uneven = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """The heading."""
        return ("theta",) if has_pose(model) else ()

    def frame(self, model: NominalModel, channel: str) -> str:
        """Of the body's motion."""
        return "body"

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """turn *= gain."""
        motion = body_motion(x, x_next, model)
        return moved(x, x_next, model, motion._replace(turn=float(p["gain"]) * motion.turn))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is linear."""
        return [{"gain": 0.95}]


EFFECT = TrackScale()
