"""Which effects does the residual call for? Forward selection, exchange, backward elimination.

Each that is taken is called for beyond chance, and rollouts get better with it (`acceptance`); each is asked again beside those that
came later (`exchange`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import axes
from s2r_runtime.plugins import registry
from s2r_runtime.trace.estimation.change_times import dated
from s2r_runtime.trace.estimation.parameters import Slot, bounds_of, values_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, evaluate, fitted, gain, nearer, plainly, without
from s2r_runtime.trace.selection.acceptance import accepted
from s2r_runtime.trace.selection.change_points import from_the_beginning
from s2r_runtime.trace.selection.exchange import exchanged, overtaken, parted, pruned, unbent
from s2r_runtime.trace.selection.friction_start import KINDS, with_friction
from s2r_runtime.trace.selection.scores import STRICT, Bar, Scored, best_candidates, names, overlooked, rescored
from s2r_runtime.trace.selection.ties import CLOSE, simplified

MOST, MOST_ON_ONE = 5, 3
"""Effects that are looked for at most, and on one input: more are a curve in parts, not so many things that happen."""

EXCHANGED = 3
"""Effects up to which earlier ones are asked again whether another would do better: that takes a round for each."""

IDLE = 1e-9
"""Of its neutral value, or of its unit: a number that is no farther from it does nothing."""

NEAR = 0.4
"""Of what is needed: of an effect that explains less, it is not asked what else it may be that began before the recording, or with the
drive. Among 265 recordings of ten families, none got another name for it.
"""

A_PART = 0.2
"""Of what something without a name explains: the least that an effect must do of it, where all of it is looked for: five are looked for at
most. Two that say little alone are looked for together (`pairs`). No answer changed by it on 204 made recordings of four families.
"""

CLOSE_BY, SHORT = 3, 0.5
"""Effects that fall short which what was not fitted is asked about, and the share of what is needed that they must have."""


@dataclass(frozen=True)
class Selection:
    """fit: the model chosen; nominal: as given. tried: columns paid for; ranking: best score of each (effect, channel) on the nominal
    model; rivals: models that replace one effect and explain as much. risky: if one of these is
    true, what was chosen does more harm than good elsewhere.
    """

    nominal: Fit
    fit: Fit
    tried: int
    ranking: tuple[Scored, ...]
    rivals: tuple[Scored, ...]
    risky: bool = False


def select(given: Problem, model: ComposedModel, horizon: int, progress: Callable[[float], None], most: int = MOST) -> Selection:
    """The effects that the transitions call for, `most` of them at most, and their rivals."""
    return against_rivals(given, called_for(given, model, horizon, progress, most=most), STRICT)


def called_for(
    given: Problem,
    model: ComposedModel,
    horizon: int,
    progress: Callable[[float], None],
    bar: Bar = STRICT,
    before: Selection | None = None,
    most: int = MOST,
    lacks: float = 0.0,
) -> Selection:
    """The effects alone, by any bar, `most` at most. before: what was selected with another one, from which it goes on. lacks: nats that
    something without a name explains beyond that: an effect that makes next to nothing of it is not gone on from.
    """
    nominal = evaluate(given, model) if before is None else before.nominal
    fit, tried = (nominal, 0) if before is None else (before.fit, before.tried)
    begun = fit
    ranking = [] if before is None else list(before.ranking)
    for step in range(most - len(fit.added)):
        short = A_PART * (lacks - gain(fit, begun)) if lacks else -math.inf
        if ranking and not fit.added:
            found, columns = rescored(ranking, nominal, len(given.steps), bar), tried
        else:
            needed = bar.needed(tried, 1, len(given.steps)) if fit.added else 0.0  # of the model as given, all are told
            found, columns = best_candidates(given, fit, bar=bar, against=max(needed, short))
        tried = max(tried, columns)
        ranking = ranking or found
        progress(0.1 + 0.6 * (step + 1) / (MOST + 1))
        chosen = _first_of(found, given, fit, tried, horizon, bar)
        if chosen is None:  # they may have hidden others, by how much they seemed to explain
            others = overlooked(given, fit, found, bar, max(bar.needed(tried, 1, len(given.steps)), short))
            chosen = _first_of(others, given, fit, tried, horizon, bar)
        chosen = chosen if fit.added else _of_all_axes(given, nominal, chosen, tried, horizon, bar)
        if chosen is None or gain(chosen, fit) < short:
            break
        chosen = parted(given, fitted(given, chosen, chosen.model), ranking, bar)
        fit = exchanged(given, chosen, bar) if 1 < len(chosen.added) <= EXCHANGED else chosen
        if crowded(fit):
            break
    fit = unbent(given, simplified(given, pruned(given, fit, tried, horizon, bar)), tried, bar)
    progress(0.8)
    return Selection(nominal, plainly(given, fit), tried, tuple(ranking), ())


def _first_of(found: Sequence[Scored], given: Problem, base: Fit, tried: int, horizon: int, bar: Bar) -> Fit | None:
    """The best of these that is called for beside the base."""
    n = len(given.steps)
    fits = (s.fit for s in found if s.fit is not None)
    near = (fit for fit in fits if gain(fit, base) > NEAR * bar.needed(tried, fit.k - base.k, n))
    offered = (from_the_beginning(given, fit, bar) for fit in near)
    return next((other for other in offered if accepted(given, other, base, tried, horizon, bar)), None)


def _of_all_axes(given: Problem, nominal: Fit, chosen: Fit | None, tried: int, horizon: int, bar: Bar) -> Fit | None:
    """What was chosen first, or friction of all axes where that explains more. Of one axis, friction that was chosen leads to the rest."""
    found = [name for name, _ in names(chosen.model)] if chosen is not None else []
    one = len(axes(nominal.model.nominal)) < 2
    both = None if one and {*found} & {*KINDS} else with_friction(given, nominal)
    if both is None:
        return chosen
    base = nominal if chosen is None else chosen
    more = gain(both, base) - bar.price(both.k - base.k, len(given.steps))
    return both if more > CLOSE and accepted(given, both, nominal, tried, horizon, bar) else chosen


def against_rivals(given: Problem, chosen: Selection, bar: Bar) -> Selection:
    """With its rivals, one of which may take its place. A crowd is not believed, whatever its rivals."""
    if crowded(chosen.fit):
        return chosen
    fit, found = overtaken(given, doing_something(given, chosen.fit), bar)
    return replace(chosen, fit=fit, rivals=tuple(found))


def one_more(given: Problem, chosen: Selection, horizon: int, foretells: Callable[[Fit, Fit], float]) -> Selection:
    """With an effect besides that falls short of what is needed on what was fitted, but not on all of the recording. foretells: nats by
    which one model foretells what was not fitted better than another one does: the probability of both parts is that of one times that
    of the other, given the first, so they add. It counts for no more than the fit does, which is asked about where the robot was, but of
    what changes an input: that is known without noise.
    """
    fit = chosen.fit
    if len(fit.added) >= MOST or crowded(fit):
        return chosen
    for s in best_candidates(given, fit)[0][:CLOSE_BY]:
        if s.fit is None or crowded(s.fit):
            continue
        needed, reached = STRICT.needed(chosen.tried, s.fit.k - fit.k, len(given.steps)), gain(s.fit, fit)
        if not _on_inputs(s, fit) and s.fit.white - fit.white >= SHORT * needed:
            reached += nearer(given, s.fit, fit)
        if reached < SHORT * needed:
            continue
        told = foretells(s.fit, fit)
        ahead = reached - gain(s.fit, fit) + min(told, reached)
        if told > 0.0 and accepted(given, s.fit, fit, chosen.tried, horizon, ahead=ahead):
            more, found = overtaken(given, plainly(given, doing_something(given, fitted(given, s.fit, s.fit.model))), STRICT)
            return replace(chosen, fit=more, rivals=tuple(found))
    return chosen


def _on_inputs(s: Scored, fit: Fit) -> bool:
    """Whether a candidate changes what acts. A drag may be on an input, or on a speed that was measured."""
    return registry().get("effects", s.name).stage == "input" and s.channel in {"*", *fit.model.inputs}


def doing_something(given: Problem, fit: Fit) -> Fit:
    """Less the effects that came to do nothing beside a later one: a delay of 0 s that a lag took over from."""
    for place in fit.added:
        ends = [(bounds_of(fit.model, slot).neutral, value) for slot, value in _numbers(fit, place)]
        if ends and all(neutral is not None and abs(value - neutral) <= IDLE * max(abs(neutral), 1.0) for neutral, value in ends):
            return doing_something(given, fitted(given, fit, without(fit.model, place)))
    return fit


def _numbers(fit: Fit, place: int) -> list[tuple[Slot, float]]:
    """What was fitted of the effect at this place."""
    return [(slot, value) for slot, value in zip(fit.free, values_of(fit.model, fit.free).tolist(), strict=True) if slot.place == place]


def all_dated(given: Problem, everything: Problem, chosen: Selection) -> Selection:
    """With what was chosen and its rivals `dated` alike: a time that was chosen with what was held out in view foretells that better."""
    rivals = tuple(s if s.fit is None else replace(s, fit=dated(given, everything, s.fit)) for s in chosen.rivals)
    return replace(chosen, fit=dated(given, everything, chosen.fit), rivals=rivals)


def crowded(fit: Fit) -> bool:
    """Whether more effects were found on some input than are believed."""
    channels = [fit.model.effects[i].channel for i in fit.added if fit.model.effects[i].effect.stage == "input"]
    return any(channels.count(c) + channels.count("*") * (c != "*") > MOST_ON_ONE for c in channels)
