"""A cart on a rail: m dv/dt = force - drag v, position and speed in m and m/s, over a step of dt with the force held.

v+ = v + dt (force - drag v) / m,   position+ = position + dt (v + v+) / 2
"""

import numpy as np


class MyThing:
    """x: (n, 2) = position m, speed m/s. u: (n, 1) = force N."""

    name = "my_thing"
    states = ("position", "speed")
    inputs = ("force",)
    angles = ()
    parameters = {"mass": 2.0, "drag": 0.3}  # kg, N s/m: the defaults; a profile may say otherwise
    units = {"position": "m", "speed": "m/s", "force": "N"}

    def step(self, x, u, dt, parameters):
        """x one step later, (n, 2). Many robots at once: no loops, and nothing is remembered."""
        v = x[:, 1]
        later = v + dt * (u[:, 0] - parameters["drag"] * v) / parameters["mass"]
        return np.column_stack([x[:, 0] + dt * 0.5 * (v + later), later])


MODEL = MyThing()
