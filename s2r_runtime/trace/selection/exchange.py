"""What was chosen first is asked again beside what was chosen later: another effect in its place, itself on fewer inputs, or none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.parameters import Added, slots_of, values_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, fitted, foretold, gain, objective, plainly, sensitivities, without
from s2r_runtime.trace.hypotheses.library import candidates
from s2r_runtime.trace.selection.acceptance import accepted, significant
from s2r_runtime.trace.selection.change_points import from_the_beginning, happens, rivals_that_happen
from s2r_runtime.trace.selection.scores import Bar, Name, Scored, at_first_look, best_candidates, name_of, unlimited
from s2r_runtime.trace.selection.ties import CLOSE

Array = NDArray[np.float64]

BENT = 3.0
"""Standard deviations by which a number must change to have been bent by what the model lacks beside."""


def exchanged(given: Problem, fit: Fit, bar: Bar) -> Fit:
    """Replaces an earlier effect where another one does better beside the later ones: the first choice was made without them."""
    for who in [name_of(fit.model.effects[place]) for place in fit.added[:-1]]:
        place = next((place for place in fit.added if name_of(fit.model.effects[place]) == who), None)
        if place is None:  # its place is another one after every exchange, and one of the user's own may stand there
            continue
        base = fitted(given, fit, without(fit.model, place), 1)
        found, _ = best_candidates(given, base, 4, bar, at_first_look(given, fit, base))
        offered = (from_the_beginning(given, s.fit, bar) for s in found if s.fit is not None)
        best = next((other for other in offered if happens(given, other)), None)
        if best is None:
            continue
        margin = CLOSE if best.k >= fit.k else 0.0  # a simpler one that does as well needs no more than that
        if gain(best, fit) > bar.price(best.k - fit.k, len(given.steps)) + margin:
            fit = fitted(given, best, best.model)
    return fit


def parted(given: Problem, fit: Fit, ranking: Sequence[Scored], bar: Bar) -> Fit:
    """With another effect on one input, and what was found on all of them on the others only, where that explains more: a delay of all is
    much like a delay of one and a lag of the other. ranking: on the model as given; it must have something on that input that does better
    there than what was found on all.
    """
    for place in fit.added:
        a = fit.model.effects[place]
        each = set(fit.model.inputs) <= set(a.effect.channels(fit.model.nominal))
        for name in fit.model.inputs if a.channel == "*" and each else ():
            own = max((s.score for s in ranking if (s.name, s.channel) == (a.effect.name, name)), default=0.0)
            best = next((s for s in ranking if s.channel == name), None)  # the ranking has the best one first
            if best is None or best.fit is None or best.name == a.effect.name or best.score <= own + CLOSE:
                continue
            instead = [b for b in best.fit.model.effects if isinstance(b, Added) and name_of(b) == (best.name, name)]
            apart = [*(Added(a.effect, other, a.p) for other in fit.model.inputs if other != name), *instead]
            there = fit.model.effects
            model = replace(fit.model, effects=(*there[:place], *apart, *there[place + 1 :]))
            if foretold(given, model) is None:  # a user's own model may not go where both take it
                continue
            other = fitted(given, fit, model)
            if gain(other, fit) > bar.price(other.k - fit.k, len(given.steps)) + CLOSE:
                return other
    return _lagging(given, fit, bar)


def _lagging(given: Problem, fit: Fit, bar: Bar) -> Fit:
    """With a lag of each input, as long as the delay of all that was found, where that explains more: they are late by as much, and one
    delay is found before two lags.
    """
    lag = registry().get("effects", "input_lag")
    for place in fit.added if len(fit.model.inputs) > 1 else ():
        a = fit.model.effects[place]
        if name_of(a) != ("input_delay", "*"):
            continue
        there = fit.model.effects
        inputs = [name for name in fit.model.inputs if all(name_of(b) != (lag.name, name) for b in there)]
        lags = [Added(lag, name, {"time_constant": a.p["delay"]}) for name in inputs]
        model = replace(fit.model, effects=(*there[:place], *lags, *there[place + 1 :]))
        if lags and foretold(given, model) is not None:
            other = fitted(given, fit, model)
            if gain(other, fit) > bar.price(other.k - fit.k, len(given.steps)) + CLOSE:
                return other
    return fit


def overtaken(given: Problem, fit: Fit, bar: Bar) -> tuple[Fit, list[Scored]]:
    """The fit with its rivals. One that does better beside all that was found takes its place at once, which earlier rounds could not know;
    then all others are asked again, from the effect that is now there on.
    """
    found: dict[Name, list[Scored]] = {}
    waiting, left = _names(fit), len(fit.added)
    while waiting:
        who = waiting.pop(0)
        place = next(place for place in fit.added if name_of(fit.model.effects[place]) == who)
        found[who] = rivals_that_happen(given, fit, [place])
        better = [(gain(s.fit, fit) - bar.price(s.fit.k - fit.k, len(given.steps)), s.fit) for s in found[who] if s.fit is not None]
        more, best = max(better, key=lambda pair: pair[0], default=(0.0, fit))
        if more <= CLOSE or not left:
            continue
        there = [name for name in _names(fit) if name != who]
        fit = plainly(given, from_the_beginning(given, fitted(given, best, best.model), bar))
        now = _names(fit)
        first = next((i for i, name in enumerate(now) if name not in there), 0)
        waiting, found, left = now[first:] + now[:first], {}, left - 1
    return fit, [s for who in _names(fit) for s in found[who]]


def _names(fit: Fit) -> list[Name]:
    """(effect, channel) of what was added, in its order."""
    return [name_of(fit.model.effects[place]) for place in fit.added]


def pruned(given: Problem, fit: Fit, tried: int, horizon: int, bar: Bar) -> Fit:
    """Drops every effect that the others make superfluous; first of all one that is not what it is called."""
    again = True
    while again and fit.added:
        again = False
        for place in sorted(fit.added, key=lambda place, fit=fit: not unlimited(fit, place)):  # type: ignore[misc]
            less = fitted(given, fit, without(fit.model, place), 1)
            if not accepted(given, fit, less, tried, horizon, bar):
                fit, again = less, True
                break
    return fit


def unbent(given: Problem, fit: Fit, tried: int, bar: Bar) -> Fit:
    """With an effect that has no number, where the data call for it and numbers took up what it does: a car that moves on arcs slides less
    by half a step times its speed than a model that moves in straight pieces says. Rollouts need not get better by it; the numbers do.
    """
    for other in sorted((fitted(given, fit, m, 1) for m in numberless(given, fit)), key=lambda other: -gain(other, fit)):
        if significant(given, other, fit, tried, bar):
            apart = np.abs(values_of(other.model, other.free) - values_of(fit.model, fit.free))
            return other if np.any(apart > BENT * _deviations(given, other)) else fit
    return fit


def numberless(given: Problem, fit: Fit) -> list[ComposedModel]:
    """The model with one more effect that has no number each, where what was found changes the motion of a body, as such a one may, too."""
    if not any(_of_body(fit.model, place) for place in fit.added):
        return []
    plain = [c for c in candidates(fit.model, given.data) if c.replaced < 0 and not any(slots_of(start, 0) for start in c.starts)]
    return [m for c in plain for m in c.models(fit.model) if foretold(given, m) is not None]


def _of_body(model: ComposedModel, place: int) -> bool:
    """Whether an effect changes how a pose moves, or where on it somebody measures."""
    a = model.effects[place]
    frame = a.effect.frame(model.nominal, a.channel) if hasattr(a.effect, "frame") else ""
    return a.effect.stage == "sensor" or (a.effect.stage == "step" and frame in {"wheels", "body", "sliding"})


def _deviations(given: Problem, fit: Fit) -> Array:
    """(k,) standard deviations of what was fitted."""
    j = sensitivities(given, fit, fit.model, fit.free)
    w = noises.weight(objective(given, fit, fit.model)).ravel()
    return np.asarray(np.sqrt(np.abs(np.diag(np.linalg.pinv(j.T @ (j * w[:, None]), rcond=1e-12, hermitian=True)))))
