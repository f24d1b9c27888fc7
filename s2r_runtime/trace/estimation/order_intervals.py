"""95 % intervals where these data do not tell which of two effects on an input comes first, or whether one without a number is there.

A coupling c before a gain g does what g c does behind it; a limit before an offset, what a limit moved by that does behind it. Where a
model with the two exchanged, fitted anew, is as likely, the order is one more thing that is not known, and an interval covers the numbers
of both: a profile likelihood over the order, too. Which comes first changes what a number means, not what the robot does. So it is with an
effect that has no number: a robot that slides sideways by k beside a model that moves in straight pieces may slide by k less half a step,
and move on arcs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation.intervals import intervals
from s2r_runtime.trace.estimation.parameters import Slot
from s2r_runtime.trace.estimation.problem import NEXT, Fit, Problem, fitted, foretold, gain, objective
from s2r_runtime.trace.selection.exchange import numberless
from s2r_runtime.trace.selection.scores import limited
from s2r_runtime.trace.selection.ties import CLOSE

ROUNDS = 3
"""Of parameters and noise, from the numbers of the other order."""


def in_either_order(given: Problem, fit: Fit) -> dict[Slot, tuple[float, float]]:
    """(low, high) of every number that was fitted."""
    found = intervals(given, fit)
    for i, j, model in _exchanged(given, fit):
        other = fitted(given, fit, model, ROUNDS)
        if gain(fit, other) > CLOSE or not limited(other):
            continue
        for slot, (low, high) in intervals(given, other).items():
            mine = slot._replace(place={i: j, j: i}.get(slot.place, slot.place))
            found[mine] = min(low, found[mine][0]), max(high, found[mine][1])
    for model in numberless(given, fit):
        other = fitted(given, fit, model, ROUNDS)
        if gain(fit, other) > CLOSE or not limited(other):
            continue
        for slot, (low, high) in intervals(given, other).items():
            found[slot] = min(low, found[slot][0]), max(high, found[slot][1])
    return found


def _exchanged(given: Problem, fit: Fit) -> Iterator[tuple[int, int, ComposedModel]]:
    """The model with two of the effects that were found in each other's place, where that makes a difference to what they do."""
    there = fit.model.effects
    places = [place for place in fit.added if there[place].effect.stage == "input"]
    z = objective(given, fit, fit.model) if len(places) > 1 else fit.z
    for i, j in combinations(places, 2):
        effects = list(there)
        effects[i], effects[j] = there[j], there[i]
        model = replace(fit.model, effects=tuple(effects))
        if foretold(given, model) is not None and np.sum((objective(given, fit, model) - z) ** 2) > NEXT:
            yield i, j, model
