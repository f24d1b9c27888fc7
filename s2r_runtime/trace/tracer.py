"""Residual -> effect -> repaired model -> error before and after (docs/tracing.md).

    1  faults of measurement are found and taken out                                   faults
    2  part of the recording is held out; the fit never sees it                        holdout
    3  effects are selected, noise estimated under each hypothesis                     selection, fitting, residual_noise
    4  what is left is tested for structure, named by what it depends on               lack_of_fit
    5  a verdict; errors and gap before and after on what was held out                 verdict, errors, result

Deterministic: the same recording, model and seed give the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, NotEnoughEvidence, UsageError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.any_shape import any_shape_of
from s2r_runtime.trace.beginning import with_history
from s2r_runtime.trace.begun import begun
from s2r_runtime.trace.dataset import MOST_PARTS, Dataset, in_finer_parts, thinned
from s2r_runtime.trace.dataset_files import load_dataset
from s2r_runtime.trace.endless import endless
from s2r_runtime.trace.errors import Held, Kind, displacement, gaps, held, judge, noise_floor
from s2r_runtime.trace.excitation import advice
from s2r_runtime.trace.faults import Checked, check
from s2r_runtime.trace.fitting import Fit, Problem, evaluate, fitted, problem, told, without
from s2r_runtime.trace.found import each_once
from s2r_runtime.trace.grid_errors import widened
from s2r_runtime.trace.hidden_pairs import two_together
from s2r_runtime.trace.holdout import Part, fit_mask, part
from s2r_runtime.trace.lack_of_fit import Structure
from s2r_runtime.trace.late_poses import late_faults
from s2r_runtime.trace.one_place import from_one_place
from s2r_runtime.trace.orders import in_either_order
from s2r_runtime.trace.plausible import check_plausible
from s2r_runtime.trace.power import visible
from s2r_runtime.trace.residual import Mask, acting, first_steps, rms, steps_of
from s2r_runtime.trace.residual_noise import no_colour
from s2r_runtime.trace.result import Found, Limit, TraceResult
from s2r_runtime.trace.retimed import dated
from s2r_runtime.trace.scores import ALONE, LENIENT, STRICT, Scored, names
from s2r_runtime.trace.selection import Selection, against_rivals, called_for, crowded, select
from s2r_runtime.trace.slots import Slot
from s2r_runtime.trace.straight import acted, alike_laid, changed_within, commanded, noisy, sampled, samples_of, straight, way_of
from s2r_runtime.trace.unseen import alike
from s2r_runtime.trace.verdict import asked, confirmed, final_fit, foretelling, foretold_too, takes_far, verdict_of, worth_its_risk
from s2r_runtime.trace.ways import Way, moving
from s2r_runtime.trace.whole import Whole

__all__ = ["Dataset", "TraceResult", "load_dataset", "trace", "usual_horizon"]

Array = NDArray[np.float64]
Progress = Callable[[float, float, str], None]

FEWEST = 60
"""Usable transitions below which nothing is said: a fit on 36 of them, and 24 to judge it."""

HORIZON_S, HORIZON_STEPS = 1.0, 10
"""Of rollouts where nobody says otherwise: a second is what a robot's controller looks ahead, and one step would show no error grow."""

FIT_STEPS = 4000
"""Transitions that a fit uses at most; a parameter that matters is then known to about a per cent."""

FOLLOWS = 5.0
"""Standard deviations of the correlation of noise with an input, from which a state goes with the input."""

MOVED, ASKED = 1.5, 5.0
"""A robot whose measurements lie apart after the horizon as they do after one step has stood still; it was asked to move if the
model would have it that much farther away."""

WILD = 5.0
"""Standard deviations of a whitened residual from which it is counted as an outlier (and has next to no weight)."""


def usual_horizon(dt: float) -> float:
    """Of rollouts, s: a second, and ten steps of what is slow."""
    return max(HORIZON_S, HORIZON_STEPS * dt)


def trace(
    dataset: Dataset,
    model: ComposedModel,
    *,
    test: Dataset | None = None,
    horizon: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    weights: tuple[float, ...] | None = None,
    kind: Kind = "ball",
) -> TraceResult:
    """What the model lacks. test: another recording to judge on; horizon: of the rollouts, s (default `usual_horizon`); weights (nx,),
    kind: the gap's norm.

    Raises NotEnoughEvidence if there are too few transitions or nothing was asked of the robot, UsageError if dataset and
    model do not belong together.
    """
    import scipy.linalg  # noqa: F401  what brings threads of its own must be there before they are limited
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        horizon = usual_horizon(model.dt) if horizon is None else horizon
        return _traced(dataset, model, test, horizon, seed, progress or (lambda done, total, detail: None), (weights, kind))


def _traced(
    dataset: Dataset,
    model: ComposedModel,
    test: Dataset | None,
    horizon: float,
    seed: int,
    say: Progress,
    norm: tuple[tuple[float, ...] | None, Kind],
    parts: int = MOST_PARTS,
) -> TraceResult:
    """parts: S, of a thinned recording."""
    weights, kind = norm
    asked, as_recorded = model, (dataset, test)
    if not model.inputs:
        raise NotEnoughEvidence(f"{dataset.source}: the model has no inputs; nothing can be traced of a robot that is asked nothing")
    model, dataset, test = alike(model, dataset, test)
    _belongs(dataset, model)
    if test is not None:
        _belongs(test, model)
    model, dataset, test = thinned(model, dataset, test, parts)
    _measured(dataset)
    check_plausible(model, dataset)
    dataset, test = from_one_place(model, dataset), None if test is None else from_one_place(model, test)
    say(0.0, 100.0, "looking for faults of measurement")
    checked = check(model, with_history(model, dataset))
    seen = fit_mask(checked.data, seed, everything=test is not None)
    fit_part = part(checked.data, checked.left_out, seen, FIT_STEPS)
    judged_on = _held_out(checked, seen, test, model, horizon)
    ahead = max(1, min(round(horizon / dataset.dt), len(fit_part.steps) // 4))
    _enough(dataset, model, fit_part, judged_on, ahead)
    given = problem(fit_part.data, fit_part.steps)
    say(5.0, 100.0, "looking for effects")
    chosen = select(given, model, ahead, lambda share: say(5.0 + 55.0 * share, 100.0, "looking for effects"))
    lines = _straight(as_recorded, asked, parts, checked, seen, given, chosen.fit)
    if lines is not None:
        return _traced(lines[0], asked, lines[1], horizon, seed, _from(60.0, say), norm, parts)
    if given.floor.axes and any(chosen.fit.model.effects[place].effect.stage == "step" for place in chosen.fit.added):
        checked = replace(checked, data=_restated(checked, chosen.fit))  # what depends on a speed is seen where the speed is better known
        fit_part = part(checked.data, checked.left_out, seen, FIT_STEPS)
        judged_on = _held_out(checked, seen, test, model, horizon)
        given = problem(fit_part.data, fit_part.steps)
        chosen = select(given, model, ahead, lambda share: say(60.0 + 20.0 * share, 100.0, "looking for effects"))
    whole = Whole(checked, model, ahead)
    chosen = foretold_too(given, chosen, judged_on, ahead)
    chosen = confirmed(given, replace(chosen, fit=dated(given, whole.given, chosen.fit)), judged_on)
    say(80.0, 100.0, "testing what is left")
    structure = whole.structure(chosen)
    if structure.matters or _astray(chosen, structure, judged_on, seed):
        chosen, structure = _once_more(given, whole, chosen, structure, judged_on, ahead)
    if structure.matters and parts == MOST_PARTS:
        finer = _finer(dataset, model, chosen, ahead)
        if finer is not None:
            return _traced(as_recorded[0], asked, as_recorded[1], horizon, seed, _from(80.0, say), norm, finer)
    say(90.0, 100.0, "judging on held-out data")
    w = np.ones(len(model.states)) if weights is None else np.array([weights[asked.states.index(s)] for s in model.states])
    result = _result(dataset, checked, given, chosen, structure, judged_on, seed, w, kind)
    if result.verdict == "unexplained" and chosen.fit.added and not {*result.depends_on} - {"noise"}:
        result = replace(result, depends_on=whole.likeliest or result.depends_on)
    if result.verdict in {"traced", "ambiguous"} and whole.in_one_stretch(chosen):
        result = _with_time(result)
    unseen = tuple(s for s in asked.states if s not in model.states)
    result = replace(result, spec=msgspec.structs.replace(result.spec, dt=asked.dt), unseen=unseen)
    say(100.0, 100.0, result.verdict)
    return result


def _in_order(structure: Structure, verdict: str) -> tuple[str, ...]:
    """What is left first, where no name is given and it is more than noise; else what a name may depend on."""
    left = verdict == "unexplained" and {*structure.tokens} - {"noise"}
    return (*structure.tokens, *structure.beside) if left else (*structure.beside, *structure.tokens)


def _with_time(result: TraceResult) -> TraceResult:
    """With the time last among what names may depend on, unless it is told already: what is left beyond doubt is not less sure by that."""
    if "time" in result.depends_on:
        return result
    left, beside = (tuple(dict.fromkeys((*tokens, "time"))) for tokens in (result.depends_on, result.may_depend_on))
    return replace(result, depends_on=left, may_depend_on=beside)


def _from(begun: float, say: Progress) -> Progress:
    """Progress of what is still to do when so much of 100 is done."""
    return lambda done, total, detail: say(begun + (1.0 - begun / 100.0) * done, total, detail)


def _straight(
    recorded: tuple[Dataset, Dataset | None], asked: ComposedModel, parts: int, checked: Checked, seen: Mask, given: Problem, fit: Fit
) -> tuple[Dataset, Dataset | None] | None:
    """The recordings with inputs that moved on between the rows, if the motion says that they did."""
    if recorded[0].way or not (sampled(recorded[0]) or commanded(recorded[0])):
        return None
    less, data, test = alike(asked, *recorded)  # a recording without a state is laid for the model without it
    samples = samples_of(data)

    def so_far(way: Way) -> Dataset:
        return acted(checked.data, thinned(less, straight(data, less, way, samples), test, parts)[1])

    def laid(way: Way) -> Problem:
        return replace(given, data=part(so_far(way), checked.left_out, seen, FIT_STEPS).data, searches={}) if way else given

    def everywhere(way: Way) -> Problem:
        there = so_far(way) if way else checked.data
        return problem(there, steps_of(there, checked.left_out))

    if not alike_laid(thinned(less, straight(data, less, Way(late=True), samples), test, parts)[1], checked.data):
        return None
    try:
        if sampled(data):
            way = way_of(laid, fit, moving([inputs for _, inputs in data.segments]))
        else:
            way = changed_within(laid, everywhere, fit, samples, len(less.inputs))
    except ConfigError:  # a user's own model may give no numbers for inputs that went so
        return None
    if not way:
        return None
    if test is not None and (commanded(test) if way.within else sampled(test)):
        test = straight(test, less, way, samples_of(test).as_of(samples))
    return replace(straight(data, less, way, samples), noisy=noisy(data, way, samples)), test


def _finer(dataset: Dataset, model: ComposedModel, chosen: Selection, ahead: int) -> int | None:
    """Parts of a step in which nothing is left by what was found, or by the model as given, if there are such: then it is what inputs do
    within the parts there are. Of what they do a part has the mean, and a position more.
    """
    data = in_finer_parts(dataset, model)
    if data is None:
        return None
    checked = check(model, with_history(model, data))
    whole = Whole(checked, model, ahead)
    nominal = whole.nominal
    fit = nominal if not chosen.fit.added else fitted(whole.given, nominal, chosen.fit.model)
    return None if whole.structure(replace(chosen, nominal=nominal, fit=fit)).matters else data.substeps


def _astray(chosen: Selection, structure: Structure, judged_on: Held, seed: int) -> bool:
    """Whether what is left beside names is no noise, although it looks like noise step by step. Where nothing was named, a second look
    with a lower bar would name what wanders by itself.
    """
    if not chosen.fit.added or structure.tokens != ("noise",):  # as it mostly is: no need for rollouts
        return False
    judged = judge(chosen.nominal.model, judged_on), judge(chosen.fit.model, judged_on)
    return takes_far(chosen, structure, judged, judged_on, noise_floor(chosen.fit, judged_on, seed)[1])


def _once_more(
    given: Problem, whole: Whole, chosen: Selection, structure: Structure, judged_on: Held, ahead: int
) -> tuple[Selection, Structure]:
    """Where structure is left, or a shape without a name is likelier than what was named, something is there: a rival that leaves nothing;
    or two effects together that do, coloured noise neither (two take up a part of anything, and the rest looks like that); or what is
    found with a lower bar, if that leaves nothing. What was not fitted must be foretold no worse. Each is challenged by shapes, too.
    """
    refused = {names(chosen.fit.model)}
    complete = [(s, rest) for s in chosen.rivals if (rest := _left_by(whole, chosen, s, structure, refused)) is not None]
    for best, rest in sorted(complete, key=lambda pair: pair[0].score, reverse=True):  # what ties, and leaves nothing, is more than that
        if best.fit is not None and foretelling(judged_on, [chosen.fit, best.fit])[1] >= 0.0:
            fit = dated(given, whole.given, best.fit)
            return replace(chosen, fit=fit, rivals=tuple(s for s, _ in complete if s is not best)), rest
    pair = two_together(given, chosen, lambda fits: foretelling(judged_on, fits))
    if pair is not None:  # a change between the parts that are fitted is anywhere there: its time is told by all of the recording
        pair = replace(pair, fit=dated(given, whole.given, pair.fit))
    told = None if pair is None else _all_explained(whole, pair, structure, refused)
    for bar, before, may_be_left in (
        (STRICT, pair if told is not None and not told.tokens else None, set()),
        (LENIENT if chosen.fit.added else ALONE, chosen, {"noise"}),
    ):
        if before is None:
            continue
        alone = called_for(given, chosen.nominal.model, ahead, lambda share: None, bar, before)
        rest = _all_explained(whole, alone, structure, refused)
        if rest is None or not {*rest.tokens} <= may_be_left:  # as it mostly is: no need to ask for rivals
            continue
        other = against_rivals(given, alone, bar)
        other = confirmed(given, replace(other, fit=dated(given, whole.given, other.fit)), judged_on)
        if other.fit is not alone.fit:
            rest = _all_explained(whole, other, structure, refused)
        if rest is None or not {*rest.tokens} <= may_be_left:
            continue
        if foretelling(judged_on, [chosen.fit, other.fit])[1] >= 0.0:
            return other, rest
    return chosen, structure


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
    rest = None if whole.still(other, structure) else whole.structure(other)
    if rest is not None and not rest.matters:
        return rest
    refused.add(names(other.fit.model))
    return None


def _result(
    dataset: Dataset,
    checked: Checked,
    given: Problem,
    chosen: Selection,
    structure: Structure,
    judged_on: Held,
    seed: int,
    weights: Array,
    kind: Kind,
) -> TraceResult:
    """Verdict, intervals, errors and gap before and after."""
    model = chosen.nominal.model
    there, near = given, chosen.fit
    if dataset.reconstruction is None:  # what a filter leaves has the filter's law, not the noise's
        fit, there, near = told(given, chosen.fit)
        chosen = replace(chosen, fit=fit)
    integrals = endless(chosen.fit, lambda: widened(there, near, in_either_order(there, near)), checked.data)
    if integrals:
        structure = replace(structure, tokens=tuple(dict.fromkeys((*integrals, *structure.tokens))), matters=True, share=1.0)
    before, after = judge(model, judged_on), judge(chosen.fit.model, judged_on)
    floor = noise_floor(chosen.fit, judged_on, seed)
    forgets = replace(chosen.fit, colour=no_colour(len(model.states)))  # a law with a memory may have taken up all that the model lacks
    alone = floor if chosen.fit.added else noise_floor(forgets, judged_on, seed)
    last = max(run.start_s + float(np.sum(run.durations(dataset.dt))) for run in dataset.runs)
    faults = (*late_faults(dataset.behind, last), *checked.faults)
    verdict = verdict_of(chosen, structure, faults, (before, after), judged_on, (floor[1], alone[1]))
    if verdict == "unexplained" and not {*structure.tokens} - {"noise"}:  # what was named foretells nothing: what else it looks like
        structure = replace(structure, tokens=structure.likeliest or structure.tokens)
    final = final_fit(chosen, verdict)
    if verdict == "unexplained":
        level, colour = structure.noise or (chosen.fit.noise, chosen.fit.colour)  # the structure itself is no noise
        floor = noise_floor(replace(final, noise=level, colour=colour), judged_on, seed)
    elif final is not chosen.fit:
        floor = noise_floor(final, judged_on, seed)
    after = before if final is chosen.nominal else after
    gap_before, gap_after, independent = gaps((model, before), (final.model, after), judged_on, weights, kind)
    ranges = widened(there, near, in_either_order(there, near)) if final is chosen.fit else {}
    effects = tuple(_found(model, final, place, ranges) for place in final.added)
    idle = [place for place in final.added if not asked(given, judged_on, final.model, without(final.model, place))]
    rivals = [s.fit for s in chosen.rivals if s.fit is not None] if verdict == "ambiguous" else []
    left = _in_order(structure, verdict)
    shared = tuple(token for token in any_shape_of(final, rivals, given.data, given.steps) if token not in left)
    ties = each_once(_found(model, fit, place, {}) for fit in rivals for place in _new(fit, final))
    return TraceResult(
        verdict=verdict,
        effects=effects,
        partial=() if final is chosen.fit else tuple(_found(model, chosen.fit, place, {}) for place in chosen.fit.added),
        ambiguous_with=ties,
        candidates=tuple((s.name, s.channel, s.score) for s in chosen.ranking),
        depends_on=tuple(dict.fromkeys((*shared, *left))),
        any_shape_of=shared,
        may_depend_on=() if verdict == "unexplained" else structure.beside,
        share_left=float(structure.share),
        suggested_excitation=advice(model, [(f.name, f.channel) for f in (*effects, *ties)]) if ties else None,
        faults=faults,
        outliers=checked.outliers + int(np.count_nonzero(np.abs(final.z).max(axis=1) > WILD)),
        spec=_spec(model, final if worth_its_risk(chosen, before, after) else chosen.nominal, dataset),
        model=final.model,
        nominal=model,
        before=before,
        after=after,
        floor=floor,
        gap=(gap_before, gap_after, independent),
        held=judged_on,
        n_fit=len(given.steps),
        n_rows=dataset.rows,
        source=dataset.source,
        interpolated=dataset.interpolated,
        reconstruction=dataset.reconstruction,
        way=dataset.way,
        noisy=dataset.noisy,
        behind=dataset.behind,
        unconfirmed=tuple((final.model.effects[place].effect.name, final.model.effects[place].channel) for place in idle),
        could_see=visible(given, final, chosen.tried),
    )


def _belongs(data: Dataset, model: ComposedModel) -> None:
    if (data.states, data.inputs, data.dt) != (model.states, model.inputs, model.dt):
        raise UsageError(
            f"{data.source}: was laid on a grid for states {', '.join(data.states)}, inputs {', '.join(data.inputs)}, dt {data.dt:g} s; "
            f"the model has {', '.join(model.states)}, {', '.join(model.inputs)}, {model.dt:g} s"
        )


def _measured(data: Dataset) -> None:
    """Raises NotEnoughEvidence if hardly any two rows on end have all states."""
    there = [np.asarray(np.isfinite(run.y).all(axis=1)) for run in data.runs]
    usable = sum(int(np.count_nonzero(row[1:] & row[:-1])) for row in there)
    if usable < FEWEST:
        raise _too_few(data, usable)


def _too_few(data: Dataset, usable: int) -> NotEnoughEvidence:
    more = max(FEWEST - usable, 1)
    return NotEnoughEvidence(
        f"{data.source}: {usable} usable transitions of {data.dt:g} s, at least {FEWEST} are needed: {more} more", more
    )


def _held_out(checked: Checked, seen: Mask, test: Dataset | None, model: ComposedModel, horizon: float) -> Held:
    """The transitions that the fit does not see."""
    if test is not None:
        other = check(model, with_history(model, test))
        everything = np.ones(sum(len(run.y) - 1 for run in other.data.runs), dtype=bool)
        return held(model, other.data, steps_of(other.data, other.left_out), other.left_out, everything, horizon)
    steps = steps_of(checked.data, checked.left_out)
    return held(model, checked.data, steps.take(np.flatnonzero(~seen[steps.place])), checked.left_out, ~seen, horizon)


def _restated(checked: Checked, fit: Fit) -> Dataset:
    """The recording with the speeds that were not measured as the model has them, which knows more than none."""
    everything = problem(checked.data, steps_of(checked.data, checked.left_out))
    states = begun(everything, evaluate(everything, fit.model, fit.noise))
    if states is None:
        return checked.data
    rows = np.cumsum([0] + [len(run.y) for run in checked.data.runs])
    runs = []
    for run, a, b in zip(checked.data.runs, rows[:-1], rows[1:], strict=True):
        y = run.y.copy()
        for _, v in checked.data.axes_without_speed:
            y[:, v] = np.where(np.isnan(y[:, v]), np.nan, states[a:b, v])
        runs.append(replace(run, y=y))
    return replace(checked.data, runs=tuple(runs))


def _enough(data: Dataset, model: ComposedModel, fit_part: Part, judged_on: Held, ahead: int) -> None:
    """Raises NotEnoughEvidence if there is too little to fit and to judge, or if nothing happened."""
    usable = len(fit_part.steps) + len(judged_on.steps)
    if usable < FEWEST or not len(judged_on.steps):
        raise _too_few(data, usable)
    if not any(np.any(run.u) for run in fit_part.data.runs):
        raise NotEnoughEvidence(
            f"{data.source}: every input is zero in the part that is fitted; nothing can be traced until the robot is asked to move"
        )
    here = Held(fit_part.data, fit_part.steps, fit_part.left_out, np.ones(first_steps(fit_part.data)[-1], dtype=bool), ahead)
    went, jitter = rms(displacement(here)), rms(model.difference(fit_part.steps.y1, fit_part.steps.y0))
    if np.all(went < MOVED * jitter + 1e-12) and np.any(rms(judge(model, here).ends) > ASKED * went):
        raise NotEnoughEvidence(f"{data.source}: the robot stood still although it was asked to move; nothing can be traced until it moves")
    sooner = [replace(here, horizon=steps) for steps in (2, 3, 5, 10) if steps < ahead]
    if all(np.all(rms(displacement(h)) < MOVED * jitter) for h in (here, *sooner)) and not _follows(fit_part, model):
        raise NotEnoughEvidence(f"{data.source}: no state goes farther than its noise makes it jump from row to row; nothing can be traced")


def _follows(given: Part, model: ComposedModel) -> bool:
    """Whether some state at the end of a step goes with an input over it. A robot that answers within a step, and is asked for something
    else in each, goes no farther in many steps than in one.
    """
    u, y = acting(model, given.data).mean[given.steps.place], given.steps.y1
    u, y = (e - e.mean(axis=0) for e in (u, y))
    together, apart = np.abs(u.T @ y), np.outer(np.linalg.norm(u, axis=0), np.linalg.norm(y, axis=0))
    return bool(np.any(together > FOLLOWS / math.sqrt(len(y)) * apart + 1e-9))


def _new(fit: Fit, other: Fit) -> list[int]:
    """Places of the effects of one fit that the other does not have."""
    there = {(a.effect.name, a.channel) for a in other.model.effects}
    return [i for i in fit.added if (fit.model.effects[i].effect.name, fit.model.effects[i].channel) not in there]


def _found(model: ComposedModel, fit: Fit, place: int, ranges: dict[Slot, tuple[float, float]]) -> Found:
    a = fit.model.effects[place]
    values = {}
    for p in a.effect.parameters:
        value = a.p.get(p.name)
        if value is None:
            continue
        low, high = _limits(value, lambda entry, name=p.name: ranges.get(Slot(place, name, entry)))
        values[p.name] = (value, low, high, a.effect.unit(model.nominal, a.channel, p.name))
    return Found(a.effect.name, a.channel, values)


def _limits(value: object, at: Callable[..., tuple[float, float] | None]) -> tuple[Limit, Limit]:
    """Low and high in the shape of the value."""
    if not isinstance(value, list):
        return at(None) or (None, None)
    pairs = [[at((i, j)) or (None, None) for j in range(len(row))] for i, row in enumerate(value)]
    return [[low for low, _ in row] for row in pairs], [[high for _, high in row] for row in pairs]


def _spec(model: ComposedModel, final: Fit, data: Dataset) -> ModelSpec:
    """The repaired model; the one given, if nothing was added."""
    if not final.added:
        return model.spec
    effects = tuple(EffectSpec(a.effect.name, a.channel, a.p) for a in final.model.effects)
    fitted_on = tuple(dict.fromkeys((*model.spec.fitted_on, *data.digests)))
    return msgspec.structs.replace(model.spec, effects=effects, fitted_on=fitted_on)
