"""A robot on a plane, out of a pose in space.

    q = (x, y, z, w), |q| = 1           yaw = atan2(2 (w z + x y), 1 - 2 (y² + z²)), counter-clockwise from the frame's x axis
    tilt = acos(1 - 2 (x² + y²))        between the body's z axis and the frame's

    x, y (m), theta (rad, in [-pi, pi]), speed (m/s along the heading), w (rad/s), vx, vy (m/s along the frame's x and y)

The twist of an Odometry message is in the child's frame (nav_msgs/msg/Odometry.msg), so vx = linear.x cos theta - linear.y sin theta, and
vy likewise. What can't be a pose is Malformed: a number that is used and not finite, a quaternion whose length is off by more than 0.01
(tf2's own limit: QUATERNION_NORMALIZATION_TOLERANCE in ros2/geometry2, tf2/src/buffer_core.cpp), a tilt beyond the profile's.
"""

from __future__ import annotations

import math
from operator import itemgetter
from typing import Any

from s2r_ros2.cdr import Malformed
from s2r_ros2.payloads import Located

POSE_ONLY = ("x", "y", "theta")
QUANTITIES = (*POSE_ONLY, "speed", "vx", "vy", "w")
NUMBER_MAX = 1e7
"""Largest magnitude of anything, SI units: no vehicle comes near, and sums of squares of such numbers stay finite."""
LENGTH_TOLERANCE = 0.01
_POSITION, _ORIENTATION = ("x", "y", "z"), ("x", "y", "z", "w")
_TWIST = ("linear.x", "linear.y", "linear.z", "angular.x", "angular.y", "angular.z")
_USED = {"speed": ("linear.x",), "w": ("angular.z",), "vx": ("linear.x", "linear.y"), "vy": ("linear.x", "linear.y")}


class Planar:
    """Picks a model's states out of poses. quantities: of each state, one of QUANTITIES; max_tilt in rad."""

    def __init__(self, quantities: tuple[str, ...], max_tilt: float) -> None:
        columns = [QUANTITIES.index(name) for name in quantities]
        self._pick: Any = itemgetter(*columns) if len(columns) > 1 else lambda values: (values[columns[0]],)
        self._speeds = sorted({_TWIST.index(name) for q in quantities for name in _USED.get(q, ())})
        self._max_tilt = max_tilt

    def states(self, at: Located) -> tuple[float, ...]:
        """The states, in order. Raises Malformed."""
        _within(at.position, _POSITION, "position")
        x, y, theta = *at.position[:2], self._yaw(at.orientation)
        if not self._speeds:
            return tuple(self._pick((x, y, theta)))
        for i in self._speeds:
            _within(at.twist[i : i + 1], _TWIST[i : i + 1], "twist")
        ahead, left, turn = at.twist[0], at.twist[1], at.twist[5]
        cos, sin = math.cos(theta), math.sin(theta)
        return tuple(self._pick((x, y, theta, ahead, ahead * cos - left * sin, ahead * sin + left * cos, turn)))

    def _yaw(self, orientation: tuple[float, ...]) -> float:
        _within(orientation, _ORIENTATION, "orientation")
        length = math.hypot(*orientation)
        if abs(length - 1.0) > LENGTH_TOLERANCE:
            raise Malformed(f"its orientation has length {length:.3g}, must be 1")
        x, y, z, w = (value / length for value in orientation)
        tilt = math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))
        if tilt > self._max_tilt:
            raise Malformed(f"it is tilted by {tilt:.2f} rad, at most {self._max_tilt:g} is taken for a plane")
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _within(values: tuple[float, ...], names: tuple[str, ...], what: str) -> None:
    for value, name in zip(values, names, strict=True):
        if not -NUMBER_MAX <= value <= NUMBER_MAX:  # also false for NaN
            raise Malformed(f"{what}.{name} is {value:g}")
