"""Go-to laws: drive a model's position to a point from anywhere. Pure, standard library only.

Unicycle, in polar coordinates of the goal (rho the distance, alpha the angle from the heading to the goal, taken in
[-pi/2, pi/2] by driving backward where that is nearer; d = +1 forward, -1 backward):

    speed = sat(k_p rho) cos(alpha),   v = d speed,   w = k_h alpha + speed sin(alpha) / rho
    V = rho^2/2 + alpha^2/2   =>   V' = -rho speed cos(alpha) - k_h alpha^2 < 0

`sat` keeps the speed inside its bound; where w leaves its bound both are scaled by the same positive factor, which bends no
path and keeps V falling. Clipping w alone would let the robot orbit its goal.

A differential drive applies the same law through its wheels, again scaled jointly. A double integrator is pulled by a
critically damped PD law, each axis clipped on its own: a chain of two integrators under saturated linear feedback is
globally stable. The goal's heading and velocity are not part of any of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from s2r_runtime.errors import ConfigError

Bounds = Sequence[tuple[float, float]]


class Gains(NamedTuple):
    """position, heading: gains in 1/s. wheel_radius, track: a differential drive's, in m; other models do not read them.

    The law is stable for every track from a quarter of the true one upward: it needn't be known well.
    """

    position: float = 1.0
    heading: float = 3.0
    wheel_radius: float = 0.1
    track: float = 0.5


def supported(model_name: str) -> bool:
    """Whether there is a go-to law for this model."""
    return model_name in _LAWS


def go_to(model_name: str, x: Sequence[float], target: Sequence[float], bounds: Bounds, gains: Gains) -> tuple[float, ...]:
    """Input, (nu,), inside `bounds` (lower, upper a input), that drives x (nx,) toward the position target[:2].

    At the target it is zero. Raises ConfigError for a model without a go-to law.
    """
    return _law(model_name)[0](x, target, bounds, gains)


def distance(model_name: str, x: Sequence[float], target: Sequence[float]) -> float:
    """How far x is from where `go_to` drives it, in m. On a double integrator what is left of the speed (m/s, counted over
    one second) stands in for distance where it is larger, so that passing by is not arriving.

    Raises ConfigError for a model without a go-to law.
    """
    return _law(model_name)[1](x, target)


def reach(model_name: str, x: Sequence[float], u: Sequence[float], duration: float, gains: Gains) -> float:
    """Distance, in m, beyond which no path of the model leads from x in `duration` s under the held input u."""
    if model_name == "unicycle":
        return abs(u[0]) * duration
    if model_name == "differential_drive":
        return 0.5 * gains.wheel_radius * abs(u[0] + u[1]) * duration
    _law(model_name)
    return math.hypot(x[2], x[3]) * duration + 0.5 * math.hypot(u[0], u[1]) * duration * duration


def confined(model_name: str, x: Sequence[float], u: tuple[float, ...], fence: Bounds, guard: float) -> tuple[float, ...]:
    """u, or only the turn in it where its translation would carry the robot outward within `guard` (m) of the fence.

    fence: bounds of the two position axes, convex, so that the straight way that is left leads to any goal in it. A double
    integrator cannot turn on the spot: its input is returned as it is.
    """
    if model_name == "unicycle":
        ahead = u[0]
        turn: tuple[float, ...] = (0.0, u[1])
    elif model_name == "differential_drive":
        ahead = u[0] + u[1]
        turn = (0.5 * (u[0] - u[1]), 0.5 * (u[1] - u[0]))
    else:
        return u
    for axis, direction in ((0, math.cos(x[2])), (1, math.sin(x[2]))):
        low, high = fence[axis]
        if (x[axis] > high - guard and ahead * direction > 0.0) or (x[axis] < low + guard and ahead * direction < 0.0):
            return turn
    return u


def _law(model_name: str) -> tuple[Callable[..., tuple[float, ...]], Callable[..., float]]:
    law = _LAWS.get(model_name)
    if law is None:
        raise ConfigError(f"model {model_name!r} has no go-to law; there is one for: {', '.join(sorted(_LAWS))}")
    return law


def _polar(x: Sequence[float], target: Sequence[float], bounds: tuple[float, float], gains: Gains) -> tuple[float, float]:
    """(v, w) of the law above, v within `bounds`, w not yet."""
    dx, dy = target[0] - x[0], target[1] - x[1]
    rho = math.hypot(dx, dy)
    if rho < 1e-9:  # the bearing of a point one stands on is noise
        return 0.0, 0.0
    alpha = math.remainder(math.atan2(dy, dx) - x[2], 2.0 * math.pi)
    direction, limit = 1.0, bounds[1]
    if abs(alpha) > 0.5 * math.pi and bounds[0] < 0.0:
        direction, limit = -1.0, -bounds[0]
        alpha -= math.copysign(math.pi, alpha)
    speed = max(0.0, min(gains.position * rho, limit) * math.cos(alpha))
    return direction * speed, gains.heading * alpha + speed * math.sin(alpha) / rho


def _scaled(u: tuple[float, float], bounds: Bounds) -> tuple[float, float]:
    """u times the largest factor <= 1 that brings both inside their bounds (which contain 0)."""
    factor = 1.0
    for value, (low, high) in zip(u, bounds, strict=True):
        if value > high or value < low:
            factor = min(factor, (high if value > 0.0 else low) / value)
    first, second = (min(max(value * factor, low), high) for value, (low, high) in zip(u, bounds, strict=True))
    return first, second


def _unicycle(x: Sequence[float], target: Sequence[float], bounds: Bounds, gains: Gains) -> tuple[float, ...]:
    return _scaled(_polar(x, target, bounds[0], gains), bounds)


def _differential_drive(x: Sequence[float], target: Sequence[float], bounds: Bounds, gains: Gains) -> tuple[float, ...]:
    radius = gains.wheel_radius
    speeds = (radius * max(low for low, _ in bounds), radius * min(high for _, high in bounds))
    v, w = _polar(x, target, speeds, gains)
    turn = 0.5 * gains.track * w
    return _scaled(((v - turn) / radius, (v + turn) / radius), bounds)


def _double_integrator(x: Sequence[float], target: Sequence[float], bounds: Bounds, gains: Gains) -> tuple[float, ...]:
    k = gains.position
    return tuple(min(max(k * k * (target[axis] - x[axis]) - 2.0 * k * x[axis + 2], low), high) for axis, (low, high) in enumerate(bounds))


def _planar_distance(x: Sequence[float], target: Sequence[float]) -> float:
    return math.hypot(target[0] - x[0], target[1] - x[1])


def _distance_and_speed(x: Sequence[float], target: Sequence[float]) -> float:
    return max(_planar_distance(x, target), math.hypot(x[2], x[3]))


_LAWS: dict[str, tuple[Callable[..., tuple[float, ...]], Callable[..., float]]] = {
    "unicycle": (_unicycle, _planar_distance),
    "differential_drive": (_differential_drive, _planar_distance),
    "double_integrator": (_double_integrator, _distance_and_speed),
}
