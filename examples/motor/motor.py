"""A brushed motor with what its data sheet says: what one believes before the first recording."""

import numpy as np

STATES = ("speed",)
INPUTS = ("volts",)
UNITS = {"speed": "rad/s", "volts": "V"}
PARAMS = {"torque_constant": 0.05, "resistance": 2.0, "inertia": 4e-4}  # N m/A (and V s/rad), ohm, kg m^2


def step(x, u, dt, params):
    """x (n, 1), u (n, 1) -> (n, 1): supply voltage minus back-EMF drives the current, the current the shaft."""
    speed, volts = x[:, 0], u[:, 0]
    settled = volts / params["torque_constant"]
    rate = params["torque_constant"] ** 2 / params["resistance"] / params["inertia"]
    return (settled + (speed - settled) * np.exp(-rate * dt))[:, None]
