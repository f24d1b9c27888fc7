"""A leg of the quadruped: from where its foot should be, and what the ground should press it with, to three motor commands.

In the trunk's axes (x ahead, y left, z up) from the abduction joint, side s = +1 on the left and -1 on the right, thigh and shank L,
hip offset D sideways; r = sqrt(y^2 + z^2 - D^2), how far the foot is below the hip in the leg's plane; l^2 = x^2 + r^2:

    knee       q2 = -acos((l^2 - 2 L^2) / (2 L^2))                     shank forward: the knee points back
    hip        q1 = atan2(-x, r) - q2/2                                thigh and shank are of the same length
    abduction  q0 = atan2(z, y) - atan2(-r, s D)

A ground force F on the foot is balanced by the torques -J' F. The servos are tau = K (command - q) - B dq/dt, so that the command is
q + (-J' F + B dq_wanted/dt)/K: position control with the load and the speed known beforehand.
"""

from __future__ import annotations

import math

SIDES = (1.0, -1.0, 1.0, -1.0)
ENDS = (1.0, 1.0, -1.0, -1.0)
"""Front left, front right, rear left, rear right: left or right, front or rear."""
HIP_X, HIP_Y = 0.19, 0.05
"""The abduction joints from the trunk's middle, m."""
LINK = 0.2
"""Thigh and shank, m, as in quadruped.xml."""
OFFSET = 0.07
"""From the abduction axis to the leg's plane, m."""
STIFFNESS, DAMPING = 80.0, 2.0
"""The servos', N m/rad and N m s/rad. At 30 N m/rad the legs give way by centimetres, which is felt as slow walking."""
REACH = 0.39
"""m; a straight knee has no inverse."""


def joints(x: float, y: float, z: float, side: float) -> tuple[float, float, float]:
    """Angles of abduction, hip and knee in rad with the foot at (x, y, z) m from the abduction joint; out of reach is pulled in."""
    depth = math.sqrt(max(y * y + z * z - OFFSET * OFFSET, 1e-4))
    length = math.sqrt(x * x + depth * depth)
    if length > REACH:
        x, depth, length = x * REACH / length, depth * REACH / length, REACH
    knee = -2.0 * math.acos(min(length / (2.0 * LINK), 1.0))
    return math.atan2(z, y) - math.atan2(-depth, side * OFFSET), math.atan2(-x, depth) - 0.5 * knee, knee


def torques(q: tuple[float, float, float], side: float, fx: float, fy: float, fz: float) -> tuple[float, float, float]:
    """Motor torques in N m that hold the ground force (fx, fy, fz) N on the foot, at the angles q."""
    q0, q1, q2 = q
    thigh_x, thigh_z = -LINK * math.sin(q1), -LINK * math.cos(q1)
    shank_x, shank_z = -LINK * math.sin(q1 + q2), -LINK * math.cos(q1 + q2)
    x, depth = thigh_x + shank_x, thigh_z + shank_z
    c, s = math.cos(q0), math.sin(q0)
    plane_y, plane_z = c * fy + s * fz, c * fz - s * fy
    return depth * plane_y - side * OFFSET * plane_z, x * plane_z - depth * fx, shank_x * plane_z - shank_z * fx
