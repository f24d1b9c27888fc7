"""The verdict, from what was selected, what is left of it, what the held-out data say of it, and the faults found.

sensor_fault   nothing is missing, but measurements are wrong in places
none           nothing beyond noise
unexplained    structure is left that no effect accounts for: nothing was found; or what was found leaves a large part, or has the
               wrong shape for what it acts on; or exchanges inputs of a model that foretells nothing without that, or silences one; or
               the model (with it) foretells the held-out data no better than `stays where it is`;
               or with what was found rollouts are worse than without;
               or what is left looks like noise, step by step, and takes rollouts much farther than noise does, or half of the way
ambiguous      rivals explain as much
traced         otherwise
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.checks.measured_inputs import refuted
from s2r_runtime.trace.diagnostics.lack_of_fit import Structure
from s2r_runtime.trace.diagnostics.rollout_error import Held, Judged, better, displacement, rollout_starts_of
from s2r_runtime.trace.estimation.noise import OUTLIER
from s2r_runtime.trace.estimation.parameters import Added, slots_of
from s2r_runtime.trace.estimation.prediction import Mask, acting, first_steps, predicted, rms
from s2r_runtime.trace.estimation.problem import Fit, Problem, evaluate, fitted, foretold, gain, plainly, problem, without
from s2r_runtime.trace.hypotheses.dependence import about_states
from s2r_runtime.trace.selection.change_points import rivals_that_happen
from s2r_runtime.trace.selection.scores import STRICT, Scored, name_of, names
from s2r_runtime.trace.selection.stepwise import Selection, doing_something, one_more
from s2r_runtime.trace.selection.ties import only_in, representative, simplified, tied
from s2r_runtime.trace.sensor_faults.fault import Fault

Array = NDArray[np.float64]

Verdict = Literal["none", "traced", "ambiguous", "unexplained", "sensor_fault"]

LARGE = 0.3
"""If more than this share of what the nominal model lacks is still left, a name found on the way is withdrawn."""

SAME_KIND = 0.05
"""As LARGE, where what is left depends on the very thing that the named effect is about: then its shape is wrong."""

CONFIRMED = 0.01
"""An effect stays if it lowers some error on held-out data by this share."""

TIMES, MOSTLY = 10, 0.9
"""Parts of the fit's time, and the share of all that an effect does which must not fall into one of them for it to be kept unconfirmed."""

ASKED = 0.1
"""Of what an effect does in a step where it was found: if it does less where it is judged, that is not asked for it."""

FORETELLS, NEARER = 0.7, 0.95
"""A model whose rollouts end farther off than these shares of the way that the robot went foretells nothing worth a name."""

SET = 0.5
"""The same of a state that goes nowhere (a wheel's speed that inputs set anew): a constant is foretold from what set it 0.7 times as
far off as from one measurement to the next, whatever set it.
"""

MISSES = 0.5
"""Share of the way that the robot went by which rollouts must be off for something to be missing that looks like noise step by step."""

WORSE = 1.1
"""Times the error of rollouts without what was found from which on it is no repair."""

HELPS = 0.95
"""Times the error of rollouts without what was found, from which downwards it is a repair worth offering: it lowers the error by 5 %."""

MATTERS = 1.5
"""Times that rollouts are farther off without an effect, in some state, from which on it matters to somebody who drives as was recorded."""

MIXED = 0.75
"""Of what an input does in its own place: as much of another input in it is not what crosses over from there, but another model's input."""

GOES, STIRS = 5.0, 2.0
"""Times as far as in a step that a state goes in the horizon, if it goes anywhere; and if it does not stand still: noise of a sensor makes
as much of a step as of the horizon, what drifts at random the root of so many steps.
"""

SILENT = 0.1
"""Of what is asked of an input: if less is left of it, effects have silenced it."""

FEWEST_SILENT = 20
"""Rollouts from which on it is told whether the robot goes while nothing is left of an input."""

NOISIER = 3.0
"""Times what noise alone makes of the ends of rollouts from which on it is not noise that takes them there; it may be coloured."""

ASTRAY = 3.8
"""The same of all rollouts between rows that are no outliers. Of 80 clean recordings (coloured noise, tails) the most was 3.2."""


def confirmed(given: Problem, chosen: Selection, judged_on: Held) -> Selection:
    """Less the effects without which the held-out data are foretold as well: what wandered in the fit's part need not go on."""
    fit, again = chosen.fit, True
    while again and fit.added:
        again = False
        for place in fit.added:
            less = fitted(given, fit, without(fit.model, place), 2)
            if asked(given, judged_on, fit.model, less.model):
                stays = _holds(judged_on, fit, less, place)
            else:  # numbers fitted without it foretell a little better or worse by chance
                stays = not _once(given, fit.model, less.model)
            if not stays:
                fit, again = less, True
                break
    gone = fit is not chosen.fit  # rivals of a model with more effects are none of this one
    found = rivals_that_happen(given, fit) if gone else list(chosen.rivals)
    risky = False
    fit, found = doing_something(given, fit), [s if s.fit is None else replace(s, fit=doing_something(given, s.fit)) for s in found]
    found = _in_its_place(fit, found)
    if found:
        best, found, risky = representative(given, *_likeliest(given, fit, found, judged_on))
        fit = best if best is fit else simplified(given, best)  # a rival need not need all of its numbers either
        found = _in_its_place(fit, found)
    fit = fit if fit is chosen.fit else plainly(given, fit)
    return replace(chosen, fit=fit, rivals=tuple(found), risky=risky)


def _likeliest(given: Problem, fit: Fit, found: list[Scored], judged_on: Held) -> tuple[Fit, list[Scored]]:
    """The likeliest explanation on all of the recording, and those that tie with it. One that takes the place of an effect does so beside
    the others: their own rivals are asked once more beside it.
    """
    for _ in range(len(fit.added) + 1):
        fits = [fit, *(s.fit for s in found if s.fit is not None)]
        best, ties = tied(given, fit, found, foretelling(judged_on, fits))
        if best is fit or len(fit.added) < 2:
            break
        found = [*_beside(given, fit, best, found), Scored(*only_in(fit, best), found[0].score, fit)]
        fit = best
    return best, ties


def _beside(given: Problem, fit: Fit, best: Fit, found: Sequence[Scored]) -> list[Scored]:
    """Rivals of what was found beside the best one: with the effect that has changed since changed in them, too, and all that they share
    with it as it is there. The one that changed it is none; others in its place stay.
    """
    gone, came = only_in(fit, best), only_in(best, fit)
    there = {name_of(a): a for a in best.model.effects if isinstance(a, Added)}
    moved = []
    for s in found:
        if s.fit is None or s.fit is best:
            continue
        mine = names(s.fit.model)
        if gone not in mine or came in mine:  # it is another one in the same place, or has the old one in the place of a third
            moved.append(s)
        else:
            as_now = {gone: there[came]} | there
            effects = (as_now.get(name_of(a), a) if isinstance(a, Added) else a for a in s.fit.model.effects)
            model = replace(s.fit.model, effects=tuple(effects))
            if foretold(given, model) is not None:
                moved.append(replace(s, fit=fitted(given, best, model)))
    return moved


def _in_its_place(fit: Fit, found: Sequence[Scored]) -> list[Scored]:
    """Those that have one effect in the place of another. What says the same in more effects is no tie: a delay of all is one of each."""
    mine, kept = {*names(fit.model)}, []
    for s in found:
        theirs = {*names(s.fit.model)} if s.fit is not None else set()
        if len(theirs - mine) == len(mine - theirs) == 1:
            kept.append(s)
    return kept


def foretold_too(given: Problem, everything: Problem, chosen: Selection, judged_on: Held, horizon: int) -> Selection:
    """With an effect besides that only all of the recording shows. everything: transitions of all of it (as many as are fitted at most)."""

    def ahead(fit: Fit, base: Fit) -> float:
        told = foretelling(judged_on, [base, fit])[1]
        if told <= 0.0 or len(everything.steps) <= len(given.steps) or given.data.reconstruction is not None:
            return told  # states that a filter told have no one law of noise
        dearer = STRICT.price(fit.k - base.k, len(everything.steps)) - STRICT.price(fit.k - base.k, len(given.steps))
        return max(told, _of_all(everything, fit, base) - gain(fit, base) - dearer)

    return one_more(given, chosen, horizon, ahead)


def _of_all(everything: Problem, fit: Fit, base: Fit) -> float:
    """Nats that a model explains of all transitions beyond another one, numbers and noise fitted on all of them: one law of noise for the
    whole recording is told more sharply than one for each of its parts.
    """
    if any(foretold(everything, one.model) is None for one in (base, fit)):
        return -math.inf
    less, more = (fitted(everything, evaluate(everything, one.model, one.noise), one.model) for one in (base, fit))
    return gain(more, less)


def foretelling(judged_on: Held, fits: list[Fit]) -> list[float]:
    """Nats by which each foretells what is held out better than the first one. What a user's own model gives no numbers for there is out of
    the question; if that is so of the first one, nothing is known.
    """
    here = problem(judged_on.data, judged_on.steps)
    there = [None if foretold(here, one.model) is None else evaluate(here, one.model) for one in fits]
    first = there[0]
    return [0.0 if first is None else -math.inf if one is None else gain(one, first) for one in there]


def _holds(judged_on: Held, fit: Fit, less: Fit, place: int) -> bool:
    """Whether held-out data are foretold better with an effect; if it has no number, whether they are likelier."""
    if len(fit.added) > 1 and not slots_of(fit.model.effects[place], place) and len(judged_on.steps):
        return foretelling(judged_on, [less, fit])[1] > 0.0
    return better(judged_on, fit.model, less.model, CONFIRMED)


def asked(given: Problem, judged_on: Held, model: ComposedModel, less: ComposedModel) -> bool:
    """Whether the held-out data ask for an effect at all: an end stop that they never meet, they can neither confirm nor refute."""
    fitted_on, held_out = (
        rms(model.difference(*(predicted(m, steps, acting(m, data)) for m in (model, less))))
        for data, steps in ((given.data, given.steps), (judged_on.data, judged_on.steps))
    )
    return bool(np.any(held_out > ASKED * fitted_on))


def _once(given: Problem, model: ComposedModel, less: ComposedModel) -> bool:
    """Whether an effect does what it does at one time only: somebody may have held the robot there."""
    apart = model.difference(*(given.predicted(m) for m in (model, less)))
    done = np.append(0.0, np.cumsum(np.sum((apart / np.maximum(rms(apart), 1e-300)) ** 2, axis=1)))
    place = given.steps.place
    rows, reach = math.ceil(len(place) / TIMES), math.ceil((np.ptp(place) + 1) / TIMES) if len(place) else 0
    at = place + reach * given.steps.run  # what was held out, or thinned away, lies between, and so does the time between runs
    ends = np.minimum(np.searchsorted(at, at + reach), np.arange(len(place)) + rows)
    return bool(np.max(done[ends] - done[:-1], initial=0.0) > MOSTLY * done[-1])


def verdict_of(
    chosen: Selection,
    structure: Structure,
    faults: tuple[Fault, ...],
    judged: tuple[Judged, Judged],
    given: Held,
    floors: tuple[Array, Array],
) -> Verdict:
    """One of the five. judged: the nominal model and what was chosen, on what was held out; floors: of rollouts, by noise alone under its
    own law, and by noise that remembers nothing.
    """
    before, after = judged
    floor = where_measured(floors[0], given)
    away = takes_far(chosen, structure, judged, given, floors[0])
    faulty = any(fault.kind != "dropout" for fault in faults)
    if not chosen.fit.added:
        nothing = away or misses(after, given, floors[1])
        return "unexplained" if structure.matters or nothing else "sensor_fault" if faulty else "none"
    noise_alone = 0.0 * floors[0] if structure.matters else floors[0]  # what is left was taken for noise, too
    if away or not foretells(after, given, noise_alone) or _withdrawn(chosen.fit, structure, given) or harms(before, after, floor):
        return "unexplained"
    if _another_model(chosen.fit, before, given) or _silenced(chosen.fit, after, given) or _silenced_for_a_while(chosen.fit, after, given):
        return "unexplained"
    if refuted(chosen.fit, given):
        return "unexplained"
    return "ambiguous" if chosen.rivals else "traced"


def _withdrawn(fit: Fit, structure: Structure, given: Held) -> bool:
    """Whether what is left takes the names away from the effects that were found."""
    if not structure.matters or structure.share <= SAME_KIND:
        return False
    kinds = {token for place in fit.added for token in _about(fit.model, place)}
    kinds |= about_states(fit.model, fit.added, given.data, given.steps)
    return structure.share > LARGE or bool(kinds & set(structure.tokens))


def _another_model(fit: Fit, before: Judged, given: Held) -> bool:
    """Whether names stand for the model, and not for what it lacks: the model as given foretells nothing, and by what was named, what acts
    in the place of an input is another input as much (the speeds of two wheels, taken for those of a body).
    """
    model = fit.model
    mixed = [model.effects[i].channel for i in fit.added if model.effects[i].effect.name == "input_coupling"]
    share, goes = _off(before, given) if mixed and len(before.ends) else (np.zeros(1), np.zeros(1, dtype=bool))
    if not goes.any() or np.any(share[goes] <= FORETELLS):
        return False
    asked, acts = _asked_and_acting(fit, given)
    parts = np.abs(np.linalg.lstsq(asked, acts, rcond=None)[0]) * np.std(asked, axis=0)[:, None]  # (asked, acts)
    own = np.diag(parts)
    others = np.max(parts - np.diag(own), axis=0)
    return any(others[j] > MIXED * own[j] for j in map(model.inputs.index, dict.fromkeys(mixed)))


def _silenced(fit: Fit, after: Judged, given: Held) -> bool:
    """Whether names leave nothing of an input while the robot goes where no model foretells: it does something else by that input."""
    if not any(fit.model.effects[i].effect.stage == "input" for i in fit.added) or not len(after.ends):
        return False
    asked, acts = (np.std(u, axis=0) for u in _asked_and_acting(fit, given))
    share, goes = _off_at(after, given, np.ones(len(after.ends), dtype=bool), STIRS)
    return bool(np.any((asked > 0.0) & (acts < SILENT * asked)) and np.any(share[goes] >= FORETELLS))


def _silenced_for_a_while(fit: Fit, after: Judged, given: Held) -> bool:
    """The same of rollouts in which an input is asked for something and nothing is left of it from beginning to end: what stood still would
    go nowhere. A robot that goes on as it did, but not as it is told, does so on another clock, or by another one's commands.
    """
    starts = rollout_starts_of(given)
    if not any(fit.model.effects[i].effect.stage == "input" for i in fit.added) or len(after.ends) != len(starts):
        return False
    asked, acts = (acting(fit.model, given.data, chain).mean for chain in ((), None))
    told, left = asked != 0.0, np.abs(acts) > SILENT * np.abs(asked)
    for is_told, is_left in zip(told.T, left.T, strict=True):
        some, any_left = (np.concatenate([[0], np.cumsum(yes)]) for yes in (is_told, is_left & is_told))
        ends = starts + given.horizon
        there = (some[ends] > some[starts]) & (any_left[ends] == any_left[starts])
        if np.count_nonzero(there) < FEWEST_SILENT:
            continue
        share, goes = _off_at(after, given, there)
        if np.any(share[goes] >= FORETELLS):
            return True
    return False


def _asked_and_acting(fit: Fit, given: Held) -> tuple[Array, Array]:
    """(M, nu) inputs before and after what acts on them, less their means."""
    asked, acts = (acting(fit.model, given.data, chain).mean for chain in ((), None))
    return asked - asked.mean(axis=0), acts - acts.mean(axis=0)


def foretells(judged: Judged, given: Held, floor: Array) -> bool:
    """Whether rollouts end nearer to the measurement than the state was from which they began: clearly in some state, or not clearly where
    noise alone takes all of them as far, and not even so where inputs set another one that goes nowhere (a wheel's speed) beyond doubt;
    and in every one that goes somewhere (much farther in the horizon than in a step, which noise does not) and not where noise takes it (a
    heading that nobody steers wanders). A position counts as one: a robot that drives straight on goes nowhere sideways. floor: (nx,) what
    noise alone makes of the ends of rollouts.
    """
    if not len(judged.ends):
        return True
    share, goes = _off(judged, given)
    by_noise = np.logical_not(_beyond_noise(judged, given, floor))
    clearly = NEARER if by_noise[goes].all() else FORETELLS
    some = np.any(share[goes] < clearly) or (by_noise[goes].all() and np.any(_set(share, given, floor)[~goes]))
    return not goes.any() or bool(some and np.all((share[goes] < NEARER) | by_noise[goes]))


def _set(share: Array, given: Held, floor: Array) -> Mask:
    """(groups,) whether inputs set a state farther apart than noise does, and it is foretold where."""
    columns = _together(given.data.states)
    return np.asarray((share < SET) & (_lengths(displacement(given), columns) > NOISIER * _lengths(floor[None], columns)), dtype=bool)


def where_measured(floor: Array, given: Held) -> Array:
    """(nx,), without end where a speed was not: nobody knows how far off that is."""
    measured = floor.copy()
    measured[[speed for _, speed in given.data.axes_without_speed]] = np.inf
    return measured


def takes_far(chosen: Selection, structure: Structure, judged: tuple[Judged, Judged], given: Held, floor: Array) -> bool:
    """Whether what is left looks like noise step by step, and takes rollouts much farther. judged: the nominal model and what was chosen;
    floor: (nx,) what noise alone makes of the ends of rollouts.
    """
    return structure.tokens == ("noise",) and goes_astray(chosen.fit.model, judged, given, where_measured(floor, given))


def goes_astray(model: ComposedModel, judged: tuple[Judged, Judged], given: Held, floor: Array) -> bool:
    """Whether rollouts end far beyond what noise alone makes of them, in a state that goes on from where it was, and a large part of
    what they were off before is left. What wanders slowly enough (a road's grade, a sensor that drifts, another clock) is a step's noise,
    and what happens a few times (commands that are lost) a step's outliers; noise of a measurement, however coloured, does not add up. Nor
    does a row that is off: it takes nothing else with it but the rollouts that begin or end there. floor: (nx,).
    """
    plain = _between_plain_rows(judged[1], given)
    if not plain.any():
        return False
    goes_on = np.array([state not in getattr(model.nominal, "reached", {}) for state in model.states])
    ends_before, ends = (rms(one.ends[plain]) for one in judged)
    was, left = (np.maximum(e**2 - floor**2, 0.0) for e in (ends_before, ends))
    far = ends > ASTRAY * floor
    return bool(np.any(goes_on & far & (left > LARGE * was)))


def _between_plain_rows(judged: Judged, given: Held) -> Mask:
    """(m,) which rollouts neither begin nor end at a row that may be an outlier: between two steps that are wild, or were not judged."""
    usual = np.median(np.abs(judged.one_step), axis=0) / 0.6745
    first = first_steps(given.data)  # of each run; the row at either end of a run has a step on one side only
    wild = np.ones(first[-1] + 2, dtype=bool)
    wild[given.steps.place + 1] = np.any(np.abs(judged.one_step) > OUTLIER * np.maximum(usual, 1e-300), axis=1)
    before, after = wild[:-1].copy(), wild[1:].copy()
    before[first], after[first] = True, True
    starts = rollout_starts_of(given)
    ends = starts + given.horizon
    off: Mask = (before & wild[1:])[starts] | (wild[:-1] & after)[ends]
    return ~off


def harms(before: Judged, after: Judged, floor: Array) -> bool:
    """Whether rollouts end clearly farther off with what was found than without it, all states together, each over what noise makes of it:
    a step that is a little better and a second that is worse is no repair. floor: (nx,), without end where nobody measured.
    """
    if not len(before.ends):
        return False
    was, now = _relative_to_noise(before, after, floor)
    return float(np.linalg.norm(now)) > WORSE * float(np.linalg.norm(was))


def helps(before: Judged, after: Judged, floor: Array) -> bool:
    """Whether rollouts on held-out data are clearly better with what was found: 5 % nearer, all states together, and none that noise does
    not hide farther off. Such a repair is offered whatever else is missing. floor: (nx,) as for `harms`.
    """
    if not len(before.ends):
        return False
    was, now = _relative_to_noise(before, after, floor)
    worse = (now > WORSE * was) & (now > NOISIER)
    return float(np.linalg.norm(now)) < HELPS * float(np.linalg.norm(was)) and not worse.any()


def _relative_to_noise(before: Judged, after: Judged, floor: Array) -> tuple[Array, Array]:
    """(nx,) rms at the ends of rollouts over what noise makes of them, before and after; 0 where nobody measured."""
    was, now = (rms(judged.ends) / np.maximum(floor, 1e-300) for judged in (before, after))
    return was, now


def worth_its_risk(chosen: Selection, before: Judged, after: Judged) -> bool:
    """Whether what was chosen goes into the model: not if it stands for several things that tie, of which one says that it does more harm
    than good elsewhere, and if it does little here.
    """
    if not chosen.risky or len(chosen.fit.added) != 1 or not len(before.ends):
        return True
    return bool(np.any(rms(before.ends) > MATTERS * rms(after.ends)))


def misses(judged: Judged, given: Held, floor: Array) -> bool:
    """Whether rollouts miss a large part of the way in some state that goes somewhere, and not because noise takes it there: the model
    lacks that part, whatever its residual looks like. floor: (nx,) what noise alone makes of the ends of rollouts.
    """
    if not len(judged.ends):
        return False
    off, goes = _off(judged, given)
    return bool(np.any(goes & (off > MISSES) & _beyond_noise(judged, given, floor)))


def _beyond_noise(judged: Judged, given: Held, floor: Array) -> Mask:
    """(groups,) whether rollouts end farther off than noise takes them."""
    columns = _together(given.data.states)
    return np.asarray(_lengths(judged.ends, columns) > NOISIER * _lengths(floor[None], columns), dtype=bool)


def _off(judged: Judged, given: Held) -> tuple[Array, Mask]:
    """(groups,) how far rollouts end from the measurement, over how far the state went; and whether it goes anywhere."""
    return _off_at(judged, given, np.ones(len(judged.ends), dtype=bool))


def _off_at(judged: Judged, given: Held, there: Mask, farther: float = GOES) -> tuple[Array, Mask]:
    """The same of some rollouts, (m,) there. farther: times a step, from which on a state goes anywhere."""
    columns = _together(given.data.states)
    way = displacement(given)
    gone, step, off = (_lengths(e, columns) for e in (way[there], given.steps.y1 - given.steps.y0, judged.ends[there]))
    goes = gone > min(farther, 0.5 * given.horizon) * step
    return off / np.maximum(gone, 1e-300), np.asarray(goes, dtype=bool)


def _together(states: tuple[str, ...]) -> list[list[int]]:
    """Columns of what is one thing: the position, and each other state."""
    position = [i for i, name in enumerate(states) if name in {"x", "y", "z"}]
    return [*([position] if position else []), *([i] for i in range(len(states)) if i not in position)]


def _lengths(e: Array, columns: list[list[int]]) -> Array:
    """(groups,) rms of what columns of e (n, nx) make together."""
    return np.array([float(np.sqrt(np.sum(rms(e[:, group]) ** 2))) for group in columns])


def final_fit(chosen: Selection, verdict: Verdict) -> Fit:
    """The model that is handed on: with the effects, unless their names were withdrawn."""
    return chosen.nominal if verdict in {"unexplained", "sensor_fault", "none"} else chosen.fit


def _about(model: ComposedModel, place: int) -> list[str]:
    """Tokens that speak of the same thing as an effect does."""
    a = model.effects[place]
    names = model.inputs if a.channel == "*" else (a.channel,)
    memory = a.effect.stage == "input" and a.effect.hidden(1, model.nominal, a.channel, model.dt, a.p).size > 0
    return [f"memory({name})" if memory else name for name in names]
