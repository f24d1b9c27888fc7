"""Typical parameters of every built-in effect."""

from __future__ import annotations

ON_STEERING = {"steering_ratio": ({"ratio": 0.8}, {"ratio": -2.0}), "steering_offset": ({"angle": 0.05},)}
"""On steering angles only."""

ON_JOINTS = {"gear_backlash": ({"width": 0.02}, {"width": 1e-4}, {"width": 9.0})}
"""On the forces of joints only."""

VALUES = {
    "input_gain": ({"gain": 0.8}, {"gain": -2.0}),
    "input_gain_asymmetry": ({"gain_positive": 0.8, "gain_negative": 1.3},),
    "input_bias": ({"bias": 0.2},),
    "input_delay": ({"delay": 0.066}, {"delay": 0.01}, {"delay": 0.15}),
    "input_lag": ({"time_constant": 0.1}, {"time_constant": 0.005}, {"time_constant": 0.0}),
    "input_rate_limit": ({"rate": 2.0}, {"rate": 1e4}, {"rate": 1.0, "rate_down": 9.0}),
    "input_saturation": ({"low": -0.4, "high": 0.5}, {"low": -0.4}, {"high": 0.5}, {"low": 0.1, "high": 0.2}),
    "input_deadband": ({"width": 0.2}, {"width": 3.0}),
    "input_backlash": ({"width": 0.3}, {"width": 3.0}),
    "input_coupling": ({"from": "", "coefficient": 0.3},),
    "input_gain_drift": ({"rate": 0.2}, {"rate": -0.05}),
    "regime_change": ({"time": 1.0, "gain": 0.6}, {"time": 0.0, "gain": 0.6}, {"time": 33 * 0.033, "gain": 2.0}),
    "periodic_disturbance": (
        {"frequency": 0.7, "amplitude": 0.2, "phase": 1.1},
        {"frequency": 20.0, "amplitude": 0.2, "phase": -3.0},
        {"frequency": 0.7, "amplitude": 0.0, "phase": 0.0},
    ),
    "quadratic_drag": ({"coefficient": 0.3},),
    "wheel_saturation": ({"speed": 0.5, "track": 0.7},),
}
