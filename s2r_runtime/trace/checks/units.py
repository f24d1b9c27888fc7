"""Other units or another zero of states that belong together, each with how it is said: y = times * x + zero.

A file of one's own says no units, so that degrees, cm or another sign show only in what the model foretells (`columns`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from s2r_runtime.models.composed import ComposedModel


@dataclass(frozen=True)
class Scale:
    """by_number: nobody's mass, gain, inertia or surroundings are just that far off; where an input or the model's own numbers could say
    the same, that tells.
    """

    times: float
    hint: str
    by_number: bool = False
    zero: float = 0.0

    def said(self, names: list[str]) -> str:
        """In words, of these states."""
        together = ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else names[0]
        seem = "seem" if len(names) > 1 else "seems"
        if self.zero:
            return f"{together} {seem} to be in {self.hint}"
        if self.times < 0.0:
            return f"{together} {seem} to have the other sign"
        return f"{together} {seem} to be {self.times:.4g} times what the model takes {'them' if len(names) > 1 else 'it'} for ({self.hint})"


DEGREES, KELVIN = 180.0 / math.pi, 273.15

SCALES = (
    Scale(DEGREES, "degrees for radians", by_number=True),
    Scale(1.0 / DEGREES, "radians for degrees", by_number=True),
    Scale(100.0, "cm for m"),
    Scale(0.01, "m for cm"),
    Scale(10.0, "mm for cm"),
    Scale(0.1, "cm for mm"),
    Scale(1000.0, "mm for m"),
    Scale(0.001, "m for mm"),
    Scale(-1.0, "the other sign"),
    Scale(1.0, "kelvin, the model in degrees Celsius", by_number=True, zero=KELVIN),
    Scale(1.0, "degrees Celsius, the model in kelvin", by_number=True, zero=-KELVIN),
    Scale(1.8, "degrees Fahrenheit, the model in degrees Celsius", by_number=True, zero=32.0),
)


def axis_pairs(model: ComposedModel) -> list[tuple[int, int]]:
    """Columns of each position and its rate."""
    return [
        (model.states.index(follows.of[0]), model.states.index(rate))
        for rate, follows in model.nominal.follows.items()
        if len(follows.of) == 1 and rate in model.states and follows.of[0] in model.states
    ]


def groups(model: ComposedModel) -> list[tuple[int, ...]]:
    """Columns of states that come from one sensor, or in one unit: a position with its rate, all of these, every state, each by itself."""
    pairs = axis_pairs(model)
    every = tuple(range(len(model.states)))
    axes = tuple(sorted({j for pair in pairs for j in pair}))
    return list(dict.fromkeys(group for group in (every, axes, *pairs, *((j,) for j in every)) if group))
