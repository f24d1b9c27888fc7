"""What these data could have shown: the smallest size of each effect that they would have told from noise.

To first order an effect of size s (its parameter less the neutral value) that is not there yet gains

    s^2 / (2 s0^2) |c - J delta|^2 nats          c: its whitened column at a small size s0; J delta: what the model's own parameters take up

and it is told from noise from `needed` nats on (everything tried paid for). Where the column vanishes, nothing on these data can show
the effect: "none" says nothing about it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.parameters import Slot, bounds_of, slots_of, values_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, foretold, sensitivities
from s2r_runtime.trace.hypotheses.library import Candidate, candidates
from s2r_runtime.trace.selection.scores import STRICT

Array = NDArray[np.float64]

INVISIBLE = 1e-3
"""Nats that the effect, as large as the library would begin to look for it, gains at most when it counts as not to be seen."""


@dataclass(frozen=True)
class Visible:
    """size: of the parameter away from its neutral value, in its unit; None if these data cannot show the effect."""

    name: str
    channel: str
    parameter: str
    size: float | None
    neutral: float
    unit: str


def visible(given: Problem, fit: Fit, tried: int) -> tuple[Visible, ...]:
    """Of every effect with a neutral value that the model does not have yet. tried: starts that were looked at."""
    before = given.predicted(fit.model)
    white = replace(fit, colour=noises.no_colour(fit.z.shape[1]))
    j = sensitivities(given, white, fit.model, fit.free)
    found: dict[tuple[str, str], Visible] = {}
    for candidate, start, slot in _small(fit.model, candidates(fit.model, given.data)):
        key = candidate.name, candidate.channel
        if key in found:
            continue
        there = foretold(given, start)
        if there is None:
            continue
        column = fit.whiten(there - before).ravel()
        if j.shape[1]:
            column = column - j @ np.linalg.lstsq(j, column, rcond=1e-10)[0]
        bounds, neutral = bounds_of(start, slot), bounds_of(start, slot).neutral or 0.0
        gained = 0.5 * float(column @ column)
        size = abs(float(values_of(start, (slot,))[0]) - neutral)
        enough = STRICT.needed(tried, 1, len(given.steps))
        seen = size * math.sqrt(enough / gained) if gained > INVISIBLE else None
        unit = start.effects[slot.place].effect.unit(start.nominal, candidate.channel, slot.name)
        found[key] = Visible(*key, slot.name, None if seen is None or seen > bounds.high - neutral else seen, neutral, unit)
    return tuple(found.values())


def _small(model: ComposedModel, found: list[Candidate]) -> Iterator[tuple[Candidate, ComposedModel, Slot]]:
    """Each candidate at its smallest start, for the number that is farthest from neutral there."""
    for candidate in found:
        if candidate.replaced >= 0:
            continue
        sizes: list[tuple[float, int, ComposedModel, Slot]] = []
        for start in candidate.models(model):
            slots = slots_of(start.effects[candidate.place], candidate.place)
            if slots and all(bounds_of(start, s).neutral is not None for s in slots):
                away = np.abs(values_of(start, tuple(slots)) - [bounds_of(start, s).neutral or 0.0 for s in slots])
                sizes.append((float(np.max(away)), len(sizes), start, slots[int(np.argmax(away))]))
        if sizes:
            _, _, start, slot = min(sizes)
            yield candidate, start, slot
