"""What a pose does over one step, seen from the body: d = (forward, left) m, and turn rad.

    (x, y)+ = (x, y) + R d,     theta+ = theta + turn

R: the rotation by the heading that the step's move is made along. A model that says that it integrates by Euler's rule moves along the
heading at the start, and `integration_scheme`, which comes after all changes of the body's motion, makes an arc of that. A model that
does not say is taken to move on an arc: the rotation, averaged over the turn, is sin(turn/2)/(turn/2) R(theta + turn/2).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import NominalModel

Array = NDArray[np.float64]


class BodyMotion(NamedTuple):
    """(n,) each. heading: mean of (cos, sin) that the move was made along."""

    forward: Array
    left: Array
    turn: Array
    heading: tuple[Array, Array]


def body_motion(x: Array, x_next: Array, model: NominalModel) -> BodyMotion:
    """Of the step from x to x_next (n, nx)."""
    px, py, theta = _columns(model)
    arc = not getattr(model, "integration", "")
    turn = x_next[:, theta] - x[:, theta]
    c, s = heading = _mean_direction(x[:, theta], turn, arc=arc)
    dx, dy = x_next[:, px] - x[:, px], x_next[:, py] - x[:, py]
    forward, left = c * dx + s * dy, c * dy - s * dx
    if arc:
        scale = c * c + s * s
        forward, left = forward / scale, left / scale
    return BodyMotion(forward, left, turn, heading)


def moved(x: Array, x_next: Array, model: NominalModel, motion: BodyMotion) -> Array:
    """x_next with this motion of the body instead of its own."""
    px, py, theta = _columns(model)
    arc = not getattr(model, "integration", "")
    c, s = _mean_direction(x[:, theta], motion.turn, arc=True) if arc else motion.heading
    after = x_next.copy()
    after[:, px] = x[:, px] + c * motion.forward - s * motion.left
    after[:, py] = x[:, py] + s * motion.forward + c * motion.left
    after[:, theta] = x[:, theta] + motion.turn
    return after


def mean_of_twice(x: Array, x_next: Array, model: NominalModel) -> tuple[Array, Array]:
    """Mean of (cos, sin) of twice the heading over the step, (n,) each: at its start by Euler's rule, along the arc otherwise."""
    theta = model.states.index("theta")
    turn = x_next[:, theta] - x[:, theta]
    return _mean_direction(2.0 * x[:, theta], 2.0 * turn, arc=getattr(model, "integration", "") != "euler")


def _mean_direction(theta: Array, turn: Array, *, arc: bool) -> tuple[Array, Array]:
    if not arc:
        return np.cos(theta), np.sin(theta)
    half = 0.5 * turn
    shorter = np.sinc(half / np.pi)
    return shorter * np.cos(theta + half), shorter * np.sin(theta + half)


def _columns(model: NominalModel) -> tuple[int, int, int]:
    return model.states.index("x"), model.states.index("y"), model.states.index("theta")
