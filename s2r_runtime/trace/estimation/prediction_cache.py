"""What models say of the same transitions, kept: it does not depend on the noise, and fits ask for it again with another noise.

A refinement ends with the slopes that show that nothing is left to gain, and the next round begins with the same ones; an evaluation asks
where the model leads that the refinement had come to; intervals, cross-validation and the search for structure ask once more.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.input_chains import Key, values_key
from s2r_runtime.trace.estimation.parameters import Free

Array = NDArray[np.float64]

KEPT = 12
"""Models that are known at a time: a fit goes from one to the next, a selection back to the few that it is about."""


@dataclass
class Answers:
    """Of one model: where it leads (n, nx), its F (n, nx, nx), and d(residual)/dp (n, nx, k) of some numbers, as far as asked for."""

    model: ComposedModel
    predicted: Array | None = None
    jacobian: Array | None = None
    slopes: dict[Free, Array] = field(default_factory=dict)


class Known:
    """Answers by model: the same nominal model with the same effects and values."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Key, Answers] = OrderedDict()

    def of(self, model: ComposedModel) -> Answers:
        """What is known of it."""
        key: Key = (id(model.nominal), model.dt, *((id(a.effect), a.channel, values_key(a)) for a in model.effects))
        found = self._kept.pop(key, None) or Answers(model)  # it keeps the model, so that no other object gets its number
        self._kept[key] = found
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return found


def kept(found: Array) -> Array:
    """The same, to be handed out again: not to be changed."""
    found = found.view()
    found.flags.writeable = False
    return found
