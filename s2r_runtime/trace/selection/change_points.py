"""What depends on the time: whether it does, and what it is if it does not.

A change that explains no more than one that began before the recording is none. Of one input that is a gain, which is looked for by itself.
Of all inputs alike (both wheels smaller than said, a thrust that is weaker) it is a gain of each, two effects, of which the search takes
one at a time: a change of all at the first moment explains more than either, and a drift of all comes near to it. So it is with a sine
where the drive is one: at its frequency any gain and any delay are a sine, and one sine explains as much as both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.parameters import Added, Slot, bounds_of, values_of, with_values
from s2r_runtime.trace.estimation.problem import Fit, Problem, evaluate, fitted, foretold, gain, sought, under_noise, without
from s2r_runtime.trace.selection.scores import ONWARD, Bar, Scored, name_of
from s2r_runtime.trace.selection.ties import CLOSE, rivals_of

EDGE = 0.02
"""Share of the steps on either side of a change that makes it one."""

OF_ALL = {("regime_change", "*"): "gain", ("input_gain_drift", "*"): ""}
"""What may stand for a gain of each input, and the number in which it says how large that is."""


def happens(given: Problem, fit: Fit) -> bool:
    """False for what changes at one time, if hardly any steps lie before it, or after it, or if it may as well have been so from the
    beginning: that is no change. A robot that stands at first has a gain, and not another one from when it begins to move.
    """
    for slot, value in zip(fit.free, values_of(fit.model, fit.free).tolist(), strict=True):
        if sought(fit.model, slot) and bounds_of(fit.model, slot).unit == "s":
            before = float(np.mean(given.steps.t < value))
            if not EDGE < before < 1.0 - EDGE or _always(given, fit, slot):
                return False
    return True


def _always(given: Problem, fit: Fit, slot: Slot) -> bool:
    """Whether something explains as much that begins before the recording does. slot: of its time."""
    begin = max(bounds_of(fit.model, slot).low, float(given.steps.t[0]) - given.data.dt)
    model = with_values(fit.model, (slot,), np.array([begin]))
    if model is None or foretold(given, model) is None:
        return False
    return under_noise(given, model, fit.noise).white > float(np.sum(noises.log_density(fit.z))) - fit.whiten.logdet - CLOSE


def rivals_that_happen(given: Problem, fit: Fit, places: Sequence[int] | None = None) -> list[Scored]:
    """Rivals of all effects, or of those at these places, less those that say of a change that it happens where it does not: what was
    found says so better.
    """
    found = [s for place in (fit.added if places is None else places) for s in rivals_of(given, fit, place)]
    return [s for s in found if s.fit is None or happens(given, s.fit)] if found and happens(given, fit) else found


def from_the_beginning(given: Problem, fit: Fit, bar: Bar) -> Fit:
    """With a gain of each input in the place of a change of all that does not happen, and of a drift of all that explains less; and with
    what the input itself makes of an input in the place of a sine that explains no more: of a drive that is a sine, one at its frequency
    is any gain and any delay.
    """
    for place in fit.added:
        name = fit.model.effects[place].effect.name
        drifts, sine = name == "input_gain_drift", name == "periodic_disturbance"
        if not (drifts or sine or not happens(given, fit)):
            continue
        behind = _behind(given, fit, place) if sine and not given.floor.axes else math.inf
        for models in _of_the_drive(fit.model, place, 1 if given.bends else 2) if sine else [_of_each(fit.model, place)]:
            others = [_instead(given, fit, model, behind) for model in models if foretold(given, model) is not None]
            more, best = max(
                ((_ahead(given, other, fit, bar), other) for other in others), key=lambda pair: pair[0], default=(-math.inf, fit)
            )
            if more > (CLOSE if drifts else -CLOSE):
                return best
    return fit


def _behind(given: Problem, fit: Fit, place: int) -> float:
    """Nats by which something else may be behind a sine after a round of parameters and noise and still come up to it in another: as much
    as a candidate may be behind the best one (ONWARD). Where speeds were not measured, one round says little.
    """
    return (1.0 - ONWARD) * gain(fit, evaluate(given, without(fit.model, place), fit.noise))


def _instead(given: Problem, fit: Fit, model: ComposedModel, behind: float) -> Fit:
    """A model in the place of what was found, fitted as far as it may come up to that. behind: nats, after a round."""
    return fitted(given, fit, model, hopeless=lambda other: gain(other, fit) < -behind)


def _ahead(given: Problem, other: Fit, fit: Fit, bar: Bar) -> float:
    """Nats of another model more than a fit has, numbers paid for."""
    return gain(other, fit) - bar.price(other.k - fit.k, len(given.steps))


def _of_the_drive(model: ComposedModel, place: int, most: int) -> list[list[ComposedModel]]:
    """The model with a gain, a delay or a lag of its input, as far as it has none, in the place of a sine on it; then with two of them, if
    `most` are two.
    """
    there, channel = model.effects, model.effects[place].channel
    if channel not in model.inputs:
        return []
    others = {name_of(a) for i, a in enumerate(there) if i != place}
    offered = [
        Added(registry().get("effects", name), channel, {number: start})
        for name, number, start in (
            ("input_gain", "gain", 1.0),
            ("input_delay", "delay", model.dt),
            ("input_lag", "time_constant", model.dt),
        )
    ]
    new = [a for a in offered if not {name_of(a), (a.effect.name, "*")} & others and channel in a.effect.channels(model.nominal)]
    return [
        [replace(model, effects=(*there[:place], *some, *there[place + 1 :])) for some in combinations(new, many)]
        for many in range(1, most + 1)
    ]


def _of_each(model: ComposedModel, place: int) -> list[ComposedModel]:
    """The model with a gain of each input that has none, in the place of what acts on all of them, if something does there."""
    a = model.effects[place]
    number = OF_ALL.get(name_of(a))
    effect = registry().get("effects", "input_gain")
    there = model.effects
    inputs = [name for name in model.inputs if all(name_of(b) != (effect.name, name) for b in there)]
    if number is None or not {*inputs} <= {*effect.channels(model.nominal)} or not inputs:
        return []
    gains = [Added(effect, name, {"gain": a.p.get(number, 1.0)}) for name in inputs]
    return [replace(model, effects=(*there[:place], *gains, *there[place + 1 :]))]
