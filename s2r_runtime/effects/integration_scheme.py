"""How a planar pose is integrated over the step, replacing the nominal model's Euler (heading at the start of the step).

The nominal step turns by phi and moves by d along the first heading. With a constant body twist the pose moves by S d instead, where
S = [[s, -c], [c, s]] (it commutes with the turn into the world's axes, so the heading itself is not needed):

    euler   s = 1,                               c = 0
    exact   s = sin(phi)/phi,                    c = (1 - cos(phi))/phi                      (an arc)
    rk4     s = (1 + 4 cos(phi/2) + cos(phi))/6, c = (4 sin(phi/2) + sin(phi))/6             (Simpson's rule, constant twist)

A model of one's own that says nothing of a pose, and that two half steps take elsewhere than one, is integrated by some rule. Under `exact`
its own step is taken in parts (`models.bound`): an Euler step of seconds on a tank of minutes looks like wrong valves and a weak pump.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from s2r_runtime.effects.input_effect import Array, Values
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.bound import BoundModel, steps_coarsely


class IntegrationScheme:
    """scheme: euler, exact or rk4. Acts on what the input effects left, wherever it stands in the list."""

    name = "integration_scheme"
    stage = "step"
    parameters = (Parameter("scheme", "", 0.0, 0.0),)
    uneven = True
    choices = {"scheme": ("euler", "exact", "rk4")}
    once = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Models that say that they move a pose by Euler, and those that do not say how they integrate, if that is seen."""
        rule = getattr(model, "integration", "")
        return ("*",) if rule == "euler" or (not rule and steps_coarsely(model)) else ()

    def integrates(self, p: Values) -> str:
        """The scheme."""
        return str(p["scheme"])

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """None."""
        return ""

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """None: (n, 0)."""
        return np.zeros((n, 0))

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """Not of stage `input`."""
        return u, z

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """Not of stage `input`."""
        return u

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """The pose's move (n, 2) turned and shortened by S; of a model of one's own, as its step in parts makes it."""
        if isinstance(model, BoundModel) and model.finer:
            step: Any = dt  # (n,), if the model takes steps of any length
            return np.asarray(x_next + (model.step(x, u, step, model.parameters) - model.shared.step(x, u, step, model.parameters)))
        if not getattr(model, "integration", ""):
            return x_next
        px, py, theta = (model.states.index(name) for name in ("x", "y", "theta"))
        along, across = _factors(x_next[:, theta] - x[:, theta], p["scheme"])
        dx, dy = x_next[:, px] - x[:, px], x_next[:, py] - x[:, py]
        after = x_next.copy()
        after[:, px] = x[:, px] + along * dx - across * dy
        after[:, py] = x[:, py] + across * dx + along * dy
        return after

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """`rk4` is left out: within a step it cannot be told from `exact`."""
        return [{"scheme": "exact"}, {"scheme": "euler"}]


def _factors(phi: Array, scheme: str) -> tuple[Array, Array]:
    if scheme == "euler":
        return np.ones_like(phi), np.zeros_like(phi)
    if scheme == "rk4":
        return (1.0 + 4.0 * np.cos(phi / 2.0) + np.cos(phi)) / 6.0, (4.0 * np.sin(phi / 2.0) + np.sin(phi)) / 6.0
    phi = np.where(phi == 0.0, 1e-300, phi)
    half = np.sin(0.5 * phi)
    return 2.0 * half * np.cos(0.5 * phi) / phi, 2.0 * half * half / phi


EFFECT = IntegrationScheme()
