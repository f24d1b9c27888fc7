"""What a fit leaves, as the effects may see it that find their starting values there: a sine's frequency, the time of a change."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Effect
from s2r_runtime.trace.fitting import Fit, Problem
from s2r_runtime.trace.residual import Acting, acting, advanced

Array = NDArray[np.float64]

NUDGE = 1e-4
"""Of an input's size, for differences: small against what bends, large against rounding."""


@dataclass(frozen=True)
class Leftover:
    """Whitened residual of a fit."""

    given: Problem
    fit: Fit

    def starts(self, effect: Effect, channel: str) -> list[dict[str, Any]]:
        """Further values to begin from, of an effect that asks for the residual; none of another one's."""
        model, steps = self.fit.model, self.given.steps
        if not hasattr(effect, "starts_from_residual") or channel not in {*model.inputs, "*"}:  # a state has no input that pushes
            return []
        pushes = self.fit.whiten(self._pushes(channel, proportional=bool(getattr(effect, "proportional", False))))
        return list(effect.starts_from_residual(self.fit.z, steps.t, pushes, model.nominal, channel, model.dt))

    def _pushes(self, channel: str, *, proportional: bool) -> Array:
        """(n, nx): by how much a unit more of the input, or the input's own value more, moves the state over each step."""
        model, steps = self.fit.model, self.given.steps
        here = self._act
        more = np.zeros_like(here.mean)
        columns = slice(None) if channel == "*" else slice(model.inputs.index(channel), model.inputs.index(channel) + 1)
        more[:, columns] = here.mean[:, columns] if proportional else 1.0
        h = NUDGE * max(float(np.max(np.abs(here.mean), initial=0.0)), NUDGE) / max(float(np.max(np.abs(more), initial=0.0)), NUDGE)
        nudged = here.moved(h * more)
        return (advanced(model, steps.y0, nudged, steps.place) - advanced(model, steps.y0, here, steps.place)) / h

    @cached_property
    def _act(self) -> Acting:
        return acting(self.fit.model, self.given.data)
