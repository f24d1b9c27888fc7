"""Dead reckoning: a pose from wheel speeds, where no pose is on the bus.

    v = R (left + right) / 2,  w = R (right - left) / track       wheels (R = 1 where they are given in m/s), or v and w as measured
    over a time h:  v, w are the means of the speeds at its two ends (trapezoid), the pose moves along their arc:
        x' = x + h v s cos(theta + h w / 2),  y' = y + h v s sin(theta + h w / 2),  theta' = theta + h w,  s = sin(h w / 2) / (h w / 2)

Exact for speeds that change evenly and turn evenly. What the wheels do not feel (slip, a kick, a wrong radius) it does not see; and
its error grows with the way: docs/can.md.
"""

from __future__ import annotations

import math


class Odometry:
    """Where the wheels say that the robot is. radius 0: the wheels' speeds are m/s. start: x m, y m, theta rad."""

    def __init__(self, *, track: float, radius: float, start: tuple[float, float, float]) -> None:
        self._track, self._radius = track, radius or 1.0
        self.pose = start
        self._last: tuple[float, float] | None = None

    def wheels(self, left: float, right: float) -> tuple[float, float]:
        """(v, w) in m/s and rad/s; w is 0 without a track."""
        turn = self._radius * (right - left) / self._track if self._track else 0.0
        return 0.5 * self._radius * (left + right), turn

    def move(self, speeds: tuple[float, float], h: float, heading: float | None = None) -> None:
        """h s later the robot has these speeds (m/s, rad/s). heading: as measured, rad, instead of the turn."""
        before = self._last or speeds
        self._last = speeds
        v, w = 0.5 * (before[0] + speeds[0]), 0.5 * (before[1] + speeds[1])
        x, y, theta = self.pose
        turned = h * w if heading is None else math.remainder(heading - theta, 2.0 * math.pi)
        half = 0.5 * turned
        way = h * v * (math.sin(half) / half if abs(half) > 1e-8 else 1.0)
        end = theta + turned if heading is None else heading
        self.pose = (x + way * math.cos(theta + half), y + way * math.sin(theta + half), math.remainder(end, 2.0 * math.pi))

    def rest(self, heading: float | None = None) -> None:
        """Nothing is known of what came before: the pose goes on from where it was."""
        self._last = None
        if heading is not None:
            self.pose = (self.pose[0], self.pose[1], math.remainder(heading, 2.0 * math.pi))
