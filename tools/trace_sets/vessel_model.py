"""Nominal model of a small surface vessel with two thrusters: three degrees of freedom, diagonal mass and damping.

    x' = u cos(theta) - v sin(theta),   y' = u sin(theta) + v cos(theta),   theta' = r
    m_u u' = m_v v r - d_u u - q_u u|u| + T_left + T_right
    m_v v' = -m_u u r - d_v v - q_v v|v|
    I r'   = (m_u - m_v) u v - d_r r - q_r r|r| + b/2 (T_right - T_left)

u: surge, v: sway (m/s, to the left), r: yaw rate (rad/s). Masses include added masses, b is the thrusters' distance.
Source: Do, Jiang, Pan, "Underactuated ship global tracking under relaxed conditions", IEEE TAC 47(9), 2002; Fossen,
"Handbook of Marine Craft Hydrodynamics and Motion Control", 2011, sections 6.5 and 7.1.
"""

import numpy as np

STATES = ("x", "y", "theta", "surge", "sway", "yaw_rate")
INPUTS = ("thrust_left", "thrust_right")
ANGLES = ("theta",)
UNITS = {
    "x": "m",
    "y": "m",
    "theta": "rad",
    "surge": "m/s",
    "sway": "m/s",
    "yaw_rate": "rad/s",
    "thrust_left": "N",
    "thrust_right": "N",
}
PARAMS = {
    "surge_mass": 60.0,
    "sway_mass": 90.0,
    "yaw_inertia": 22.0,
    "surge_drag": 15.0,
    "sway_drag": 60.0,
    "yaw_drag": 12.0,
    "surge_drag_2": 20.0,
    "sway_drag_2": 80.0,
    "yaw_drag_2": 15.0,
    "beam": 0.8,
}
PARTS = 4


def rate(x, u, p):
    """x (n, 6), u (n, 2) -> time derivative (n, 6)."""
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    surge, sway, yaw = x[:, 3], x[:, 4], x[:, 5]
    f_surge = p["sway_mass"] * sway * yaw - (p["surge_drag"] + p["surge_drag_2"] * abs(surge)) * surge + u[:, 0] + u[:, 1]
    f_sway = -p["surge_mass"] * surge * yaw - (p["sway_drag"] + p["sway_drag_2"] * abs(sway)) * sway
    munk = (p["surge_mass"] - p["sway_mass"]) * surge * sway
    f_yaw = munk - (p["yaw_drag"] + p["yaw_drag_2"] * abs(yaw)) * yaw + 0.5 * p["beam"] * (u[:, 1] - u[:, 0])
    accelerations = [f_surge / p["surge_mass"], f_sway / p["sway_mass"], f_yaw / p["yaw_inertia"]]
    return np.column_stack([surge * c - sway * s, surge * s + sway * c, yaw, *accelerations])


def step(x, u, dt, params):
    """x (n, 6), u (n, 2) -> (n, 6): fourth-order Runge-Kutta in PARTS parts."""
    h = np.asarray(dt, dtype=float).reshape(-1, 1) / PARTS
    for _ in range(PARTS):
        k1 = rate(x, u, params)
        k2 = rate(x + 0.5 * h * k1, u, params)
        k3 = rate(x + 0.5 * h * k2, u, params)
        k4 = rate(x + h * k3, u, params)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return x
