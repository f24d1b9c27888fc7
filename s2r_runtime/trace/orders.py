"""95 % intervals where these data do not tell which of two effects on an input comes first.

A coupling c before a gain g does what g c does behind it; a limit before an offset, what a limit moved by that does behind it. Where a
model with the two exchanged, fitted anew, is as likely, the order is one more thing that is not known, and an interval covers the numbers
of both: a profile likelihood over the order, too. Which comes first changes what a number means, not what the robot does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.candidates import commute
from s2r_runtime.trace.fitting import Fit, Problem, fitted, gain
from s2r_runtime.trace.intervals import intervals
from s2r_runtime.trace.rivals import CLOSE
from s2r_runtime.trace.scores import limited
from s2r_runtime.trace.slots import Slot

ROUNDS = 3
"""Of parameters and noise, from the numbers of the other order."""


def in_either_order(given: Problem, fit: Fit) -> dict[Slot, tuple[float, float]]:
    """(low, high) of every number that was fitted."""
    found = intervals(given, fit)
    for i, j, model in _exchanged(fit):
        other = fitted(given, fit, model, ROUNDS)
        if gain(fit, other) > CLOSE or not limited(other):
            continue
        for slot, (low, high) in intervals(given, other).items():
            mine = slot._replace(place={i: j, j: i}.get(slot.place, slot.place))
            found[mine] = min(low, found[mine][0]), max(high, found[mine][1])
    return found


def _exchanged(fit: Fit) -> Iterator[tuple[int, int, ComposedModel]]:
    """The model with two of the effects that were found in each other's place, where that makes a difference."""
    there = fit.model.effects
    for i, j in combinations([place for place in fit.added if there[place].effect.stage == "input"], 2):
        if not commute(there[i].effect, there[i].channel, there[j], fit.model):
            effects = list(there)
            effects[i], effects[j] = there[j], there[i]
            yield i, j, replace(fit.model, effects=tuple(effects))
