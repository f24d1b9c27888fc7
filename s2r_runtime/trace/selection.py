"""Which effects does the residual call for? Forward selection, exchange, backward elimination.

gain          of a model over the one without the effect, the smaller of white and coloured (`scores`): "just more noise" and
              "coloured noise" are rivals
significant   gain > log(tried / alpha) + price                   (everything tried is paid for; `scores.Bar`)
relevant      some rollout's rms error falls by the bar's share, on blocks that the parameters (all but those blocks) never saw
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import axes
from s2r_runtime.plugins import registry
from s2r_runtime.trace import residual_noise as noises
from s2r_runtime.trace.begun import begun, uncertain
from s2r_runtime.trace.candidates import candidates
from s2r_runtime.trace.changes import from_the_beginning, happens, rivals_that_happen
from s2r_runtime.trace.fitting import (
    SCORE_BLOCKS,
    WIDEST,
    Fit,
    Problem,
    evaluate,
    fitted,
    foretold,
    gain,
    objective,
    plainly,
    refine,
    scatter,
    sensitivities,
    under_noise,
    without,
)
from s2r_runtime.trace.friction import KINDS, with_friction
from s2r_runtime.trace.residual import acting, rms, rollout, rollout_starts
from s2r_runtime.trace.rivals import CLOSE, simplified
from s2r_runtime.trace.scores import STRICT, Bar, Scored, at_first_look, best_candidates, limited, name_of, names, rescored, unlimited
from s2r_runtime.trace.slots import Added, Slot, bounds_of, slots_of, values_of, with_values

Array = NDArray[np.float64]

WITHIN = 0.4
"""Of a step: what stamps off the grid can look like."""

SAME = 1e-3
"""Of the step in which a sensor reads: what moves all values by the same to so much is an offset."""

MOST, MOST_ON_ONE = 5, 3
"""Effects that are looked for at most, and on one input: more are a curve in parts, not so many things that happen."""

EXCHANGED = 3
"""Effects up to which earlier ones are asked again whether another would do better: that takes a round for each."""

BENT = 3.0
"""Standard deviations by which a number must change to have been bent by what the model lacks beside."""

IDLE = 1e-9
"""Of its neutral value, or of its unit: a number that is no farther from it does nothing."""

CLOSE_BY, SHORT = 3, 0.5
"""Effects that fall short which what was not fitted is asked about, and the share of what is needed that they must have."""

BLOCKS = 5
"""Of the cross-validation."""

SOME = 4
"""Rounds of parameters under another law of noise."""

BY_CHANCE = 0.05
"""Chance of white noise to scatter as much between blocks of time, from which on it is taken to be white."""

ALONE_TELLS = 0.95
"""Share of what tells a number from which on a block alone tells it: the others know it four times as poorly, or worse."""

BLIND = 4
"""Fits of which it is known how they foretell what they did not see.
"""

STARTS = 1200
"""Rollouts that relevance is judged on at most."""


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


def select(given: Problem, model: ComposedModel, horizon: int, progress: Callable[[float], None]) -> Selection:
    """The effects that the transitions call for, and their rivals."""
    return against_rivals(given, called_for(given, model, horizon, progress), STRICT)


def called_for(
    given: Problem,
    model: ComposedModel,
    horizon: int,
    progress: Callable[[float], None],
    bar: Bar = STRICT,
    before: Selection | None = None,
) -> Selection:
    """The effects alone, by any bar. before: what was selected with another one, from which it goes on."""
    nominal = evaluate(given, model) if before is None else before.nominal
    fit, tried = (nominal, 0) if before is None else (before.fit, before.tried)
    ranking = [] if before is None else list(before.ranking)
    for step in range(MOST - len(fit.added)):
        if ranking and not fit.added:
            found, columns = rescored(ranking, nominal, len(given.steps), bar), tried
        else:
            needed = bar.needed(tried, 1, len(given.steps)) if fit.added else 0.0  # of the model as given, all are told
            found, columns = best_candidates(given, fit, bar=bar, against=needed)
        tried = max(tried, columns)
        ranking = ranking or found
        progress(0.1 + 0.6 * (step + 1) / (MOST + 1))
        offered = (from_the_beginning(given, s.fit, bar) for s in found if s.fit is not None)
        chosen = next((other for other in offered if accepted(given, other, fit, tried, horizon, bar)), None)
        chosen = chosen if fit.added else _of_all_axes(given, nominal, chosen, tried, horizon, bar)
        if chosen is None:
            break
        chosen = parted(given, fitted(given, chosen, chosen.model), ranking, bar)
        fit = exchanged(given, chosen, bar) if 1 < len(chosen.added) <= EXCHANGED else chosen
        if crowded(fit):
            break
    fit = unbent(given, simplified(given, pruned(given, fit, tried, horizon, bar)), tried, bar)
    progress(0.8)
    return Selection(nominal, plainly(given, fit), tried, tuple(ranking), ())


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
    fit, found = overtaken(given, chosen.fit, bar)
    return replace(chosen, fit=fit, rivals=tuple(found))


def one_more(given: Problem, chosen: Selection, horizon: int, foretells: Callable[[Fit, Fit], float]) -> Selection:
    """With an effect besides that falls short of what is needed on what was fitted, but not on all of the recording. foretells: nats by
    which one model foretells what was not fitted better than another one does: the probability of both parts is that of one times that
    of the other, given the first, so they add. It counts for no more than the fit does.
    """
    fit = chosen.fit
    if len(fit.added) >= MOST or crowded(fit):
        return chosen
    for s in best_candidates(given, fit)[0][:CLOSE_BY]:
        if s.fit is None or crowded(s.fit) or gain(s.fit, fit) < SHORT * STRICT.needed(chosen.tried, s.fit.k - fit.k, len(given.steps)):
            continue
        ahead = min(foretells(s.fit, fit), gain(s.fit, fit))
        if ahead > 0.0 and accepted(given, s.fit, fit, chosen.tried, horizon, ahead=ahead):
            more, found = overtaken(given, plainly(given, _doing_something(given, fitted(given, s.fit, s.fit.model))), STRICT)
            return replace(chosen, fit=more, rivals=tuple(found))
    return chosen


def _doing_something(given: Problem, fit: Fit) -> Fit:
    """Less the effects that came to do nothing beside a later one: a delay of 0 s that a lag took over from."""
    for place in fit.added:
        ends = [(bounds_of(fit.model, slot).neutral, value) for slot, value in _numbers(fit, place)]
        if ends and all(neutral is not None and abs(value - neutral) <= IDLE * max(abs(neutral), 1.0) for neutral, value in ends):
            return _doing_something(given, fitted(given, fit, without(fit.model, place)))
    return fit


def _numbers(fit: Fit, place: int) -> list[tuple[Slot, float]]:
    """What was fitted of the effect at this place."""
    return [(slot, value) for slot, value in zip(fit.free, values_of(fit.model, fit.free).tolist(), strict=True) if slot.place == place]


def crowded(fit: Fit) -> bool:
    """Whether more effects were found on some input than are believed."""
    channels = [fit.model.effects[i].channel for i in fit.added if fit.model.effects[i].effect.stage == "input"]
    return any(channels.count(c) + channels.count("*") * (c != "*") > MOST_ON_ONE for c in channels)


def accepted(given: Problem, fit: Fit, base: Fit, tried: int, horizon: int, bar: Bar = STRICT, ahead: float = 0.0) -> bool:
    """Significant and relevant. ahead: nats by which it foretells better what was not fitted."""
    return (
        limited(fit)
        and significant(given, fit, base, tried, bar, ahead)
        and _told_by_stamps(given, fit, base)
        and _beyond_rounding(given, fit, base)
        and happens(given, fit)
        and relevant(given, fit, base, horizon, bar)
    )


def _told_by_stamps(given: Problem, fit: Fit, base: Fit) -> bool:
    """False for a time within a step where rows do not lie on the step, or inputs moved on between them: stamps, averages and reality
    differ by that much. Of a robot that slides sideways that is so only where rows were interpolated: else its position and heading are of
    one moment, whenever that was.
    """
    data = given.data
    if not data.interpolated and not data.uneven and not data.way:
        return True
    there = names(base.model)
    values = values_of(fit.model, fit.free)
    new = [
        (bounds_of(fit.model, slot), value)
        for slot, value in zip(fit.free, values.tolist(), strict=True)
        if name_of(fit.model.effects[slot.place]) not in there
        and (data.interpolated or fit.model.effects[slot.place].effect.stage == "input")
    ]
    return all(p.unit != "s" or p.neutral != 0.0 or abs(value) > WITHIN * data.dt for p, value in new)


def _beyond_rounding(given: Problem, fit: Fit, base: Fit) -> bool:
    """False for an offset of a sensor that its rounding may be. In steps of q one value is off by up to q / 2, always by the same; n values
    alike often by q / sqrt(12 n) on average, and hardly ever by q / sqrt(n). What moves some values more than others is no offset.
    """
    there = names(base.model)
    for a in (fit.model.effects[place] for place in fit.added):
        if a.effect.stage != "sensor" or a.channel not in fit.model.states or name_of(a) in there:
            continue
        j = fit.model.states.index(a.channel)
        q = noises.quantum(given.steps.y0[:, j], given.steps.y1[:, j])
        if q > 0.0:
            share = np.unique(np.rint(given.steps.y0[:, j] / q), return_counts=True)[1] / len(given.steps)
            off = (a.effect.to_measured(given.steps.y0, fit.model.nominal, a.channel, a.p) - given.steps.y0)[:, j]
            if np.ptp(off) < SAME * q and abs(off[0]) < q * min(0.5, float(np.sqrt(np.sum(share**2)))):
                return False
    return True


def significant(given: Problem, fit: Fit, base: Fit, tried: int, bar: Bar = STRICT, ahead: float = 0.0) -> bool:
    """Beyond chance, everything tried paid for, and not by one step alone: that may be the error of a stamp. The gain shrunk by how
    much more than white noise the scores of blocks scatter.
    """
    needed = bar.needed(tried, fit.k - base.k, len(given.steps))
    reached = gain(fit, base) + ahead
    each = noises.log_density(fit.z).sum(axis=1) - noises.log_density(base.z).sum(axis=1)
    if reached - max(float(np.max(each, initial=0.0)), 0.0) <= needed:
        return False
    if reached > needed and not _beyond_wandering(given, fit, base, needed - ahead):
        return False
    if reached <= needed or reached > WIDEST**2 * needed or not fit.free:
        return reached > needed
    there = names(base.model)
    new = [i for i, slot in enumerate(fit.free) if name_of(fit.model.effects[slot.place]) not in there]
    return reached > needed * _scattered(scatter(given, fit)[new])


def _scattered(ratios: Array) -> float:
    """Times that scores of blocks scatter more than white noise, a ratio of variances: that of the number that does most so, 1 if chance
    alone makes one of so many as large (chi-squared, a degree of freedom a block). ratios: (k,) of standard deviations.
    """
    from scipy.special import gammaincinv

    most = float(np.max(ratios, initial=1.0)) ** 2
    by_chance = 2.0 * float(gammaincinv(0.5 * SCORE_BLOCKS, 1.0 - BY_CHANCE / max(len(ratios), 1))) / SCORE_BLOCKS
    return most if most > by_chance else 1.0


def _beyond_wandering(given: Problem, fit: Fit, base: Fit, needed: float) -> bool:
    """Whether an effect gains as much where what is left with it wanders: under the law of that, and with that law estimated without the
    effect, too. In closed loop inputs answer what wanders, a moment later: an effect on them then takes up a part of it. Under that law,
    estimates are those of the prediction error (L. Ljung, System identification, 1999, ch. 13: in closed loop right if the noise's law is).
    """
    joined = given.steps.joined
    law, bare = (noises.wandering(f.z, joined, f.colour) for f in (fit, base))
    if law is None and bare is not None:  # an effect explains more than the law of all that is left without it
        with_it, without = (noises.log_likelihood(f.z, f.whiten, c, joined) for f, c in ((fit, fit.colour), (base, bare)))
        return with_it - without > needed
    if law is None:
        return True
    if bare is not None:
        both = (noises.log_likelihood(f.z, f.whiten, c, joined) for f, c in ((fit, law), (base, bare)))
        if next(both) - next(both) <= needed:
            return False
    under = replace(fit, colour=law)
    reached = [
        float(np.sum(noises.log_density(objective(given, under, refine(given, under, m, iterations=SOME)))))
        for m in (fit.model, base.model)
    ]
    return reached[0] - reached[1] > needed


def relevant(given: Problem, fit: Fit, base: Fit, horizon: int, bar: Bar = STRICT) -> bool:
    """Whether some state's error at one step, a quarter of the horizon or all of it falls by the bar's share, cross-validated."""
    known = (begun(given, fit), uncertain(fit, given.data.dt)) if given.floor.axes else None
    edges = _edges(given, fit, base)
    blind = [_blind(given, f, edges, known) for f in (base, fit)]
    for steps in sorted({1, max(1, horizon // 4), horizon}):
        before, after = (one.errors(steps) for one in blind)
        if np.any(before > (1.0 + bar.share) * after):
            return True
    return False


@dataclass(frozen=True)
class _Blind:
    """A fit, each block of time under the model that has its parameters from the other ones."""

    fit: Fit
    models: Sequence[ComposedModel]
    of: Callable[[Fit, Sequence[ComposedModel], int], Array]
    found: dict[int, Array] = field(default_factory=dict)

    def errors(self, steps: int) -> Array:
        """(nx,) rms at the end of rollouts of so many steps."""
        if steps not in self.found:
            self.found[steps] = self.of(self.fit, self.models, steps)
        return self.found[steps]


def _blind(given: Problem, fit: Fit, edges: Array, known: tuple[Array | None, Array] | None) -> _Blind:
    """The last ones are known: many candidates are held against one model, and one model against many that it could do without."""
    key = id(fit), edges.tobytes()
    found = given.blind.pop(key, None) if known is None else None
    if not isinstance(found, _Blind):
        models = _less_each_block(given, fit, edges)
        found = _Blind(fit, models, lambda fit, models, steps: _held_out_errors(given, fit, models, edges, steps, known))
    if known is None:
        given.blind[key] = found
        while len(given.blind) > BLIND:
            given.blind.pop(next(iter(given.blind)))
    return found


def _held_out_errors(
    given: Problem, fit: Fit, models: Sequence[ComposedModel], edges: Array, horizon: int, known: tuple[Array | None, Array] | None
) -> Array:
    """(nx,) rms at the end of rollouts, in blocks of time between the edges, each under the model that has its parameters from the other
    blocks. known: where axes were whose speed was not measured (rows, nx), and its variances; else by what was measured.
    """
    starts = rollout_starts(given.data, horizon)
    starts = starts[np.isin(starts, given.steps.place)]
    starts = starts[:: max(1, len(starts) // STARTS)]
    if not len(starts):
        return np.full(given.steps.y0.shape[1], np.nan)
    errors = []
    for block, model in enumerate(models):
        inside = starts[(starts >= edges[block]) & ((starts < edges[block + 1]) | (block == BLOCKS - 1))]
        if len(inside):
            begin = begun(given, under_noise(given, model, fit.noise)) if given.floor.axes else None
            errors.append(
                rollout(model, given.data, acting(model, given.data), inside, horizon, begun=begin, ends=known and known[0]).error
            )
    off = rms(np.concatenate(errors))
    return off if known is None else np.sqrt(off**2 + known[1])


def _edges(given: Problem, fit: Fit, base: Fit) -> Array:
    """(BLOCKS + 1,) of blocks of time, all of as many steps. Where one of these has nearly all that tells a new number (a wheel that was
    asked to turn once only), the others know nothing of it, and no block can be foretold: then half of what makes blocks alike is that. Not
    of what depends on time itself: of that, something that happens once shows nothing.
    """
    place, even = given.steps.place, np.linspace(0.0, 1.0, BLOCKS + 1)
    edges = np.quantile(place, even)
    there = names(base.model)
    effects = [fit.model.effects[slot.place] for slot in fit.free]
    new = tuple(s for s, a in zip(fit.free, effects, strict=True) if name_of(a) not in there and not getattr(a.effect, "timed", False))
    told = np.square(sensitivities(given, fit, fit.model, new)).reshape(*fit.z.shape, len(new)).sum(axis=1)
    told = told[:, told.sum(axis=0) > 0.0] / told.sum(axis=0)[told.sum(axis=0) > 0.0]
    block = _block(place, edges)
    if max((float(np.max(np.bincount(block, one, BLOCKS))) for one in told.T), default=0.0) <= ALONE_TELLS:
        return np.asarray(edges)
    share = np.cumsum(0.5 / len(place) + 0.5 * told.mean(axis=1))
    cut = np.minimum(np.searchsorted(share, even[1:-1]), len(place) - 1)
    return np.array([place[0], *place[cut], place[-1]], dtype=np.float64)


def _block(place: NDArray[np.int64], edges: Array) -> NDArray[np.int64]:
    """(n,) which block each step is in."""
    return np.clip(np.searchsorted(edges, place, side="right") - 1, 0, BLOCKS - 1)


def _less_each_block(given: Problem, fit: Fit, edges: Array) -> list[ComposedModel]:
    """The model refitted without each block, to first order."""
    free = fit.free
    if not free:
        return [fit.model] * BLOCKS
    z = objective(given, fit, fit.model)
    j = sensitivities(given, fit, fit.model, free)
    w = noises.weight(z).ravel()
    block = np.repeat(_block(given.steps.place, edges), z.shape[1])
    models = []
    for b in range(BLOCKS):
        rest = block != b
        jw = j[rest] * w[rest, None]
        normal = j[rest].T @ jw
        step = np.linalg.lstsq(normal + 1e-9 * np.diag(np.diag(normal)), jw.T @ z.ravel()[rest], rcond=1e-10)[0]
        models.append(with_values(fit.model, free, values_of(fit.model, free) - step) or fit.model)
    return models


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
    """The fit with its rivals. One that does better beside all that was found takes its place, which earlier rounds could not know."""
    found = rivals_that_happen(given, fit)
    for _ in fit.added:
        better = [(gain(s.fit, fit) - bar.price(s.fit.k - fit.k, len(given.steps)), s.fit) for s in found if s.fit is not None]
        more, best = max(better, key=lambda pair: pair[0], default=(0.0, fit))
        if more <= CLOSE:
            break
        fit = plainly(given, from_the_beginning(given, fitted(given, best, best.model), bar))
        found = rivals_that_happen(given, fit)
    return fit, found


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
    return a.effect.stage == "sensor" or (a.effect.stage == "step" and frame in {"body", "sliding"})


def _deviations(given: Problem, fit: Fit) -> Array:
    """(k,) standard deviations of what was fitted."""
    j = sensitivities(given, fit, fit.model, fit.free)
    w = noises.weight(objective(given, fit, fit.model)).ravel()
    return np.asarray(np.sqrt(np.abs(np.diag(np.linalg.pinv(j.T @ (j * w[:, None]), rcond=1e-12, hermitian=True)))))
