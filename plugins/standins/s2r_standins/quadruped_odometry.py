"""How fast the quadruped believes that it walks: from its joint angles and its gyro, as a robot has to that cannot see the floor.

A stance foot's ball rolls and, so the robot believes, doesn't slip. p: the ball's centre in the trunk's axes, o: the trunk's turning rates
(gyro), R: the ball's radius, a and s: turning rates of the shank about x and y. Each stance leg says

    trunk velocity = -dp/dt - o x p + R (s, -a)

and the legs' answers are averaged by their shares of the load. What slips, or a floor that moves, it gets wrong.
"""

from __future__ import annotations

import math

from s2r_standins.quadruped_leg import ENDS, HIP_X, HIP_Y, LINK, OFFSET, SIDES

BALL = 0.022
"""m, as in quadruped.xml."""

Known = tuple[float, float, float, float, float, float]
"""A ball's centre, and the angles of abduction, hip and knee."""


class Odometry:
    """`known`: each stance leg's last place and angles; None of a leg that swings."""

    __slots__ = ("forward", "known", "sideways")

    def __init__(self) -> None:
        self.known: list[Known | None] = [None] * 4
        self.forward = self.sideways = 0.0

    def update(self, dt: float, angles: list[float], gyro: tuple[float, float, float], shares: list[float]) -> None:
        """One step of dt s. angles: (12,) rad; gyro: rad/s; shares: of the load, by leg."""
        ox, oy, oz = gyro
        total = forward = sideways = 0.0
        for i, share in enumerate(shares):
            before = self.known[i]
            if share <= 0.0:
                self.known[i] = None
                continue
            side = SIDES[i]
            q0, q1, q2 = angles[3 * i : 3 * i + 3]
            depth, s, c = -LINK * (math.cos(q1) + math.cos(q1 + q2)), math.sin(q0), math.cos(q0)
            x = ENDS[i] * HIP_X - LINK * (math.sin(q1) + math.sin(q1 + q2))
            y = side * HIP_Y + c * side * OFFSET - s * depth
            z = s * side * OFFSET + c * depth
            self.known[i] = (x, y, z, q0, q1, q2)
            if before is None:
                continue
            roll, pitch = ox + (q0 - before[3]) / dt, oy + (q1 + q2 - before[4] - before[5]) / dt
            forward += share * (BALL * pitch - (x - before[0]) / dt - oy * z + oz * y)
            sideways += share * (-BALL * roll - (y - before[1]) / dt - oz * x + ox * z)
            total += share
        if total > 0.0:
            self.forward, self.sideways = forward / total, sideways / total
