"""What most effects of stage `input` have in common: no hidden state, one input as the channel, its unit.

An effect is then its mathematics: `parameters`, `act` (static effects) or `hidden` + `input_step` + `input_sequence` (dynamic ones),
and `starts`, from where the tracer begins. Third parties may build on this class or on nothing at all: the interface is
`s2r_runtime.hookspecs.Effect`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import NominalModel, Parameter

Array = NDArray[np.float64]
Values = dict[str, Any]


class InputEffect:
    """A static effect on one input; override `act`. `all_alike`: also offered on the channel `*`, all inputs."""

    name = ""
    stage = "input"
    parameters: tuple[Parameter, ...] = ()
    optional: tuple[str, ...] = ()
    all_alike = False
    linear = False
    side_by_side = True

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Every input; `*` first where it is offered."""
        return ("*", *model.inputs) if self.all_alike else tuple(model.inputs)

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """SI unit; `input` in a Parameter stands for the channel's own."""
        given = next(p.unit for p in self.parameters if p.name == parameter)
        units: dict[str, str] = getattr(model, "units", {})
        return given.replace("input", units.get(channel, "input's unit")).replace("/s/s", "/s²")

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """None: (n, 0)."""
        return np.zeros((n, 0))

    def act(self, u: Array, p: Values) -> Array:
        """The channel's input (..., c) -> as it acts, (..., c)."""
        return u

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """u (n, nu) -> as it acts over the step; no hidden state."""
        return self.input_sequence(u, model, channel, dt, p), z

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """u (T, nu) -> as it acts, (T, nu); or (T, runs, nu)."""
        return replaced(u, model, channel, self.act(u[..., columns(model, channel)], p))

    def after_step(self, x: Array, u: Array, x_next: Array, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """Not of stage `step`: nothing changes."""
        return x_next


def columns(model: NominalModel, channel: str) -> list[int]:
    """Columns of u that belong to the channel."""
    return list(range(len(model.inputs))) if channel == "*" else [model.inputs.index(channel)]


def replaced(u: Array, model: NominalModel, channel: str, acting: Array) -> Array:
    """u (..., nu) with the channel's columns set to acting (..., c)."""
    after = u.copy()
    after[..., columns(model, channel)] = acting
    return after
