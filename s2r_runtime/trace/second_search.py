"""Where something is left by what was found, the library is asked once more, with what is left in view."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.command_timing import checked_of
from s2r_runtime.trace.data.dataset import Dataset, in_finer_parts
from s2r_runtime.trace.diagnostics.lack_of_fit import Structure
from s2r_runtime.trace.diagnostics.rollout_error import Held, at_most_seen, judge, noise_floor
from s2r_runtime.trace.diagnostics.whole_recording import Whole
from s2r_runtime.trace.estimation.change_times import dated
from s2r_runtime.trace.estimation.noise import Whitener
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, fitted, foretold, gain, problem
from s2r_runtime.trace.selection.pairs import two_together
from s2r_runtime.trace.selection.scores import ALONE, LENIENT, STRICT, Bar, Scored, names
from s2r_runtime.trace.selection.stepwise import Selection, against_rivals, all_dated, called_for, crowded
from s2r_runtime.trace.verdict import confirmed, foretelling, takes_far

MAKES = 0.5
"""Of what structure is told by, in nats, that inputs within steps must make at the least to be the reason."""

INTEGRATES = 0.1
"""Of what parts of steps make, that may come of the model's integration: a model whose own steps are too coarse is not tried on finer ones,
which nobody has.
"""


def finer(
    dataset: Dataset, model: ComposedModel, chosen: Selection, structure: Structure, ahead: int, under: ComposedModel | None = None
) -> int | None:
    """Parts of a step in which nothing is left by what was found, or by the model as given, if there are such: then it is what inputs do
    within steps, or within the parts that they are in already. A step has the mean of what they do, and a position more. under: as
    `checked_of` has it.
    """
    data = in_finer_parts(dataset, model)
    if data is None:
        return None
    makes = _makes(dataset, data, chosen.fit)
    if not makes >= MAKES * max([structure.nats, *structure.gains.values()]):
        return None
    if not dataset.in_parts:
        means = _with_means(data)
        if not all(_makes(replace(means, in_parts=False), means, fit) <= INTEGRATES * makes for fit in (chosen.nominal, chosen.fit)):
            return None
    whole = Whole(checked_of(model, data, under), model, ahead)
    nominal = whole.nominal
    fit = nominal if not chosen.fit.added else fitted(whole.given, nominal, chosen.fit.model)
    return None if whole.structure(replace(chosen, nominal=nominal, fit=fit)).matters else data.substeps


def _makes(dataset: Dataset, data: Dataset, fit: Fit) -> float:
    """Nats that residuals of the same steps in other parts are apart, under a fit's noise: structure can owe no more to them. NaN, which
    is no reason for parts, if the steps are others, or a user's own model gives no numbers there.
    """
    before, after = (problem(d, steps_of(d)) for d in (dataset, data))
    there = [foretold(given, fit.model) for given in (before, after)]
    if len(before.steps) != len(after.steps) or there[0] is None or there[1] is None:
        return math.nan
    whiten = Whitener(fit.noise, before.jacobian(fit.model), before.steps.joined)
    return 0.5 * float(np.sum(whiten(fit.model.difference(there[1], there[0])) ** 2))


def _with_means(data: Dataset) -> Dataset:
    """The same with each step's mean input in all of its parts."""
    s = data.substeps
    means = [np.repeat(run.u.reshape(-1, s, run.u.shape[1]).mean(axis=1), s, axis=0) for run in data.runs]
    return replace(data, runs=tuple(replace(run, u=u) for run, u in zip(data.runs, means, strict=True)))


def astray(chosen: Selection, structure: Structure, judged_on: Held, seed: int) -> bool:
    """Whether what is left beside names is no noise, although it looks like noise step by step. Where nothing was named, a second look
    with a lower bar would name what wanders by itself.
    """
    if not chosen.fit.added or structure.tokens != ("noise",):  # as it mostly is: no need for rollouts
        return False
    judged = judge(chosen.nominal.model, judged_on), judge(chosen.fit.model, judged_on)
    floor = at_most_seen(noise_floor(chosen.fit, judged_on, seed), chosen.fit.model, judged_on, judged[1].ends)
    return takes_far(chosen, structure, judged, judged_on, floor[1])


def once_more(
    given: Problem, whole: Whole, chosen: Selection, structure: Structure, judged_on: Held, ahead: int
) -> tuple[Selection, Structure]:
    """Where structure is left, or a shape without a name is likelier than what was named, something is there: a rival that leaves nothing;
    or two effects together, with what is called for beside them, that do, coloured noise neither (two take up a part of anything, and the
    rest looks like that); or what is found with a lower bar, if that leaves nothing. What was not fitted must be foretold no worse. Each is
    challenged by shapes, too. What explains clearly less than what is found with the lower bar leaves what that explains, and is not asked
    about.
    """
    refused = {names(chosen.fit.model)}
    nameless = max([structure.nats, *structure.gains.values()]) if structure.matters else 0.0

    def found_by(bar: Bar, alone: Selection, may_be_left: set[str]) -> tuple[Selection, Structure] | None:
        """What was called for by this bar, beside its rivals, if it leaves no more than that."""
        rest = _all_explained(whole, alone, structure, refused)
        if rest is None or not {*rest.tokens} <= may_be_left:  # as it mostly is: no need to ask for rivals
            return None
        other = against_rivals(given, alone, bar)
        other = confirmed(given, all_dated(given, whole.given, other), judged_on)
        if other.fit is not alone.fit:
            rest = _all_explained(whole, other, structure, refused)
        if rest is None or not {*rest.tokens} <= may_be_left:
            return None
        return (other, rest) if foretelling(judged_on, [chosen.fit, other.fit])[1] >= 0.0 else None

    lower = LENIENT if chosen.fit.added else ALONE
    besides = called_for(given, chosen.nominal.model, ahead, lambda share: None, lower, chosen, lacks=nameless)
    more = names(besides.fit.model) != names(chosen.fit.model) and not crowded(besides.fit)

    def behind(fit: Fit) -> bool:
        needed = STRICT.needed(besides.tried, besides.fit.k - fit.k, len(given.steps))
        return more and gain(besides.fit, fit) > needed

    rivals = [s for s in chosen.rivals if s.fit is not None and not behind(s.fit)]
    complete = [(s, rest) for s in rivals if (rest := _left_by(whole, chosen, s, structure, refused)) is not None]
    for best, rest in sorted(complete, key=lambda pair: pair[0].score, reverse=True):  # what ties, and leaves nothing, is more than that
        if best.fit is not None and foretelling(judged_on, [chosen.fit, best.fit])[1] >= 0.0:
            fit = dated(given, whole.given, best.fit)
            return replace(chosen, fit=fit, rivals=tuple(s for s, _ in complete if s is not best)), rest
    pair = two_together(given, chosen, lambda fits: foretelling(judged_on, fits))
    if pair is not None and not behind(pair.fit):
        # a change between the parts that are fitted is anywhere there: its time is told by all of the recording
        pair = replace(pair, fit=dated(given, whole.given, pair.fit))
        both = called_for(given, chosen.nominal.model, ahead, lambda share: None, STRICT, pair)
        answer = found_by(STRICT, both, set())
        if answer is not None:
            return answer
    return found_by(lower, besides, {"noise"}) or (chosen, structure)


def _left_by(
    whole: Whole, chosen: Selection, rival: Scored, structure: Structure, refused: set[tuple[tuple[str, str], ...]]
) -> Structure | None:
    """What is left by a rival of what was chosen, as far as it is noise; None if it is more."""
    rest = None if rival.fit is None else _all_explained(whole, replace(chosen, fit=rival.fit, rivals=()), structure, refused)
    return rest if rest is not None and {*rest.tokens} <= {"noise"} else None


def _all_explained(whole: Whole, other: Selection, structure: Structure, refused: set[tuple[tuple[str, str], ...]]) -> Structure | None:
    """What another selection leaves, if it shows in no rollout; None if it does. refused: effects that were asked about and leave more.
    structure: what was left before: that is asked for first, as it mostly still is there.
    """
    if names(other.fit.model) in refused or crowded(other.fit):
        return None
    rest = None if whole.falls_short(other) or whole.still(other, structure) else whole.structure(other)
    if rest is not None and not rest.matters:
        return rest
    refused.add(names(other.fit.model))
    return None
