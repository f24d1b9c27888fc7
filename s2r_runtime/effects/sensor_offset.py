"""A state is measured with a constant offset: measured = true + offset.

It shows only where the step depends on the state: without walls, a shifted x is another origin and nothing else. Which states those
are is tried out on the nominal step: f(x + b e) - b e is not f(x).
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from s2r_runtime.effects.step_effect import Array, SensorEffect, Values, size_of
from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import NominalModel, Parameter
from s2r_runtime.models.bound import BoundModel

TRIED, TRIED_DT_S, TRIED_OFFSET = 8, 0.1, 0.5
"""States, step and offset on which it is tried; any will do."""

SAME = 1e-9
"""Less than this and the step has moved along with the offset, but for rounding."""


_KNOWN: WeakKeyDictionary[BoundModel, tuple[str, ...]] = WeakKeyDictionary()


class SensorOffset(SensorEffect):
    """offset in the state's unit; 0 is none."""

    name = "sensor_offset"
    parameters = (Parameter("offset", "state", -1e6, 1e6, neutral=0.0),)
    value = "offset"

    def channels(self, model: NominalModel) -> tuple[str, ...]:
        """States on which the step depends otherwise than by moving along; tried out once a model."""
        if not isinstance(model, BoundModel):
            return self._shown(model)
        if model not in _KNOWN:
            _KNOWN[model] = self._shown(model)
        return _KNOWN[model]

    def _shown(self, model: NominalModel) -> tuple[str, ...]:
        rng = np.random.default_rng(0)
        x = rng.uniform(-1.0, 1.0, (TRIED, len(model.states)))
        u = rng.uniform(-1.0, 1.0, (TRIED, len(model.inputs)))
        found = []
        for j, name in enumerate(model.states):
            off = np.zeros(len(model.states))
            off[j] = TRIED_OFFSET
            try:
                here, there = (model.step(at, u, TRIED_DT_S, model.parameters) for at in (x, x + off))
            except ConfigError:  # a user's model that cannot be stepped just anywhere
                return ()
            if np.max(np.abs(there - off - here)) > SAME:
                found.append(name)
        return tuple(found)

    def unit(self, model: NominalModel, channel: str, parameter: str) -> str:
        """The state's."""
        units: dict[str, str] = getattr(model, "units", {})
        return units.get(channel, "rad" if channel in model.angles else "state's unit")

    def to_true(self, x: Array, model: NominalModel, channel: str, p: Values) -> Array:
        """Less the offset."""
        return self._shifted(x, model, channel, -float(p[self.value]))

    def to_measured(self, x: Array, model: NominalModel, channel: str, p: Values) -> Array:
        """With the offset."""
        return self._shifted(x, model, channel, float(p[self.value]))

    def _shifted(self, x: Array, model: NominalModel, channel: str, by: float) -> Array:
        after = x.copy()
        after[:, model.states.index(channel)] += by
        return after

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """One is enough: the response is nearly linear."""
        return [{"offset": 0.05 if channel in model.angles else 0.02 * size_of(u)}]


EFFECT = SensorOffset()
