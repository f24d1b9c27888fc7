"""An input acts on another one too (misaligned axes, one wheel that drags the other): u_act = u + coefficient u_from."""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, replaced
from s2r_runtime.hookspecs import NominalModel, Parameter

SHARE = 0.05
"""Of the changed input's size: what the tracer's first coefficient adds; the response is linear in it."""


class InputCoupling(InputEffect):
    """from: the name of the other input; coefficient in the changed input's unit for one of the other's, 0 is none."""

    name = "input_coupling"
    parameters = (Parameter("from", "", 0.0, 0.0), Parameter("coefficient", "input", -1e6, 1e6, neutral=0.0))
    named = ("from",)

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """Every input of a model that has another one."""
        return tuple(model.inputs) if len(model.inputs) > 1 else ()

    def reads(self, model: NominalModel, channel: str) -> tuple[str, ...]:
        """Any of the others."""
        return tuple(name for name in model.inputs if name != channel)

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """Unit of the changed input for one of the other's; none where they are the same."""
        units: dict[str, str] = getattr(model, "units", {})
        other = {units.get(name, "other input's unit") for name in self.reads(model, channel)}
        mine = units.get(channel, "input's unit")
        if parameter == "from" or other == {mine}:
            return ""
        return f"{_whole(mine)}/{_whole(other.pop() if len(other) == 1 else 'unit of from')}"

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """u (..., nu) -> the channel with its share of the other input."""
        to, other = model.inputs.index(channel), model.inputs.index(p["from"])
        return replaced(u, model, channel, (u[..., to] + float(p["coefficient"]) * u[..., other])[..., None])

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One for each other input that does something."""
        size = dict(zip(model.inputs, np.sqrt(np.mean(u**2, axis=0)).tolist() if len(u) else [0.0] * u.shape[1], strict=True))
        mine = size[channel] or 1.0
        return [{"from": name, "coefficient": SHARE * mine / size[name]} for name in self.reads(model, channel) if size[name]]


def _whole(unit: str) -> str:
    """As a part of a quotient."""
    return f"({unit})" if "/" in unit or " " in unit else unit


EFFECT = InputCoupling()
