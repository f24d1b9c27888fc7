"""Residual -> effect -> repaired model -> error before and after (docs/tracing.md).

    1  faults of measurement are found and taken out                                   faults
    2  part of the recording is held out; the fit never sees it                        holdout
    3  effects are selected, noise estimated under each hypothesis                     selection, fitting, residual_noise
    4  what is left is tested for structure, named by what it depends on               lack_of_fit, whole
    5  if something is left, the library is asked once more                            second_look
       if all is explained by what remembers nothing, first rows that were left out    beginning
       count, and all is asked again
    6  a verdict; errors and gap before and after on what was held out                 verdict, errors, answer
    7  if the answer says that the recording is to be read otherwise, all is asked      straight, throttled,
       again: inputs moved on, forces were measured, faults show under what was found   unplaced

Deterministic: the same recording, model and seed give the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, NotEnoughEvidence, UsageError
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.trace.assemble import answered, with_time
from s2r_runtime.trace.checks.columns import check_plausible
from s2r_runtime.trace.checks.common_start import from_one_place
from s2r_runtime.trace.checks.measured_inputs import refuted, says_forces
from s2r_runtime.trace.data.command_timing import checked_of, only_before_changes
from s2r_runtime.trace.data.dataset import Dataset, thinned
from s2r_runtime.trace.data.initial_conditions import with_history
from s2r_runtime.trace.data.input_hold import (
    NATS,
    acted,
    alike_laid,
    changed_within,
    commanded,
    noisy,
    sampled,
    samples_of,
    straight,
    way_of,
)
from s2r_runtime.trace.data.input_interpolation import MOVING, Way, moving
from s2r_runtime.trace.data.readers import load_dataset
from s2r_runtime.trace.data.split import Part, fit_mask, part
from s2r_runtime.trace.data.unmeasured_states import alike
from s2r_runtime.trace.diagnostics.lack_of_fit import Structure
from s2r_runtime.trace.diagnostics.rollout_error import Held, Kind, displacement, held, judge
from s2r_runtime.trace.diagnostics.whole_recording import Whole
from s2r_runtime.trace.estimation.initial_states import begun
from s2r_runtime.trace.estimation.prediction import Mask, acting, first_steps, rms, steps_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, evaluate, problem
from s2r_runtime.trace.hypotheses.dependence import remembers
from s2r_runtime.trace.reporting.result import TraceResult
from s2r_runtime.trace.second_search import astray, finer, once_more
from s2r_runtime.trace.selection.scores import names
from s2r_runtime.trace.selection.stepwise import MOST, Selection, all_dated, select
from s2r_runtime.trace.selection.ties import CLOSE
from s2r_runtime.trace.sensor_faults.detect import Checked, check
from s2r_runtime.trace.verdict import confirmed, foretold_too

__all__ = ["Dataset", "TraceResult", "load_dataset", "trace", "usual_horizon"]

Array = NDArray[np.float64]
Progress = Callable[[float, float, str], None]

FEWEST = 60
"""Usable transitions below which nothing is said: a fit on 36 of them, and 24 to judge it."""

JUDGED = 24
"""Of these, the fewest that a recording to judge on must have by itself."""

HORIZON_S, HORIZON_STEPS = 1.0, 10
"""Of rollouts where nobody says otherwise: a second is what a robot's controller looks ahead, and one step would show no error grow."""

FIT_STEPS = 4000
"""Transitions that a fit uses at most; a parameter that matters is then known to about a per cent."""

FOLLOWS = 5.0
"""Standard deviations of the correlation of noise with an input, from which a state goes with the input."""

RETOLD = 3
"""Times that a hidden state is told anew under a model, each about where it was told to be: its law may bend."""

MOVED, ASKED = 1.5, 5.0
"""A robot whose measurements lie apart after the horizon as they do after one step has stood still; it was asked to move if the
model would have it that much farther away."""

EXACT = 1e-6
"""Of where the model as given ends: what ends nearer is rounding, and nearer is no better."""


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
        found = _traced(_Asked(dataset, test, model, horizon, seed, progress or (lambda done, total, detail: None), weights, kind))
    return replace(
        found, subset=dataset.subset, test_subset=test.subset if test else None, notes=(*dataset.notes, *(test.notes if test else ()))
    )


@dataclass(frozen=True)
class _Asked:
    """What is asked, of a recording and maybe of another one to judge on. parts: S, of each step, where they were asked for (`finer`).
    under: what was found before, under which more faults show.
    """

    dataset: Dataset
    test: Dataset | None
    model: ComposedModel
    horizon: float
    seed: int
    say: Progress
    weights: tuple[float, ...] | None
    kind: Kind
    parts: int | None = None
    under: ComposedModel | None = None

    def again(self, begun: float, **otherwise: Any) -> TraceResult:
        """The answer to the same with something else in it, when so much of 100 is done."""
        return _traced(replace(self, say=_from(begun, self.say), **otherwise))

    def looking(self, begin: float, span: float) -> Callable[[float], None]:
        """To be told the share of the search that is done, which begins at so much of 100."""
        return lambda share: self.say(begin + span * share, 100.0, "looking for effects")


def _traced(asked: _Asked) -> TraceResult:
    ready = _ready(asked)
    hidden = ready.cut.given.bends
    asked.say(5.0, 100.0, "looking for effects")
    chosen = select(ready.cut.given, ready.model, ready.ahead, asked.looking(5.0, 55.0), 1 if hidden else MOST)
    otherwise = _on_their_way(asked, ready, chosen.fit)
    if otherwise is not None:
        return otherwise
    for most in range(2, MOST + 1) if hidden else (MOST,):
        if not _told_otherwise(ready.cut.given, chosen.fit):
            break
        ready, before = ready.restated(asked, chosen.fit), names(chosen.fit.model)
        chosen = select(ready.cut.given, ready.model, ready.ahead, asked.looking(60.0, 20.0), most)
        if names(chosen.fit.model) == before:
            break
    cut, ahead = ready.cut, ready.ahead
    whole = Whole(cut.checked, ready.model, ahead)
    chosen = foretold_too(cut.given, whole.given, chosen, cut.judged_on, ahead)
    chosen = confirmed(cut.given, all_dated(cut.given, whole.given, chosen), cut.judged_on)
    asked.say(80.0, 100.0, "testing what is left")
    structure = whole.structure(chosen)
    if structure.matters or astray(chosen, structure, cut.judged_on, asked.seed):
        chosen, structure = once_more(cut.given, whole, chosen, structure, cut.judged_on, ahead)
    otherwise = _from_first(asked, ready, chosen, structure) or _in_more_parts(asked, ready, chosen, structure)
    if otherwise is not None:
        return otherwise
    asked.say(90.0, 100.0, "judging on held-out data")
    states = ready.model.states
    w = np.ones(len(states)) if asked.weights is None else np.array([asked.weights[asked.model.states.index(s)] for s in states])
    result = answered(ready.dataset, cut.checked, cut.given, chosen, structure, cut.judged_on, asked.seed, w, asked.kind)
    otherwise = _second_thoughts(asked, ready, whole, chosen, result)
    if otherwise is not None:
        return otherwise
    result = _told(asked, ready, whole, chosen, result)
    asked.say(100.0, 100.0, result.verdict)
    return result


@dataclass(frozen=True)
class _Cut:
    """A recording in two: what is fitted, and what is judged on."""

    checked: Checked
    fit_part: Part
    judged_on: Held

    @cached_property
    def given(self) -> Problem:
        """What is fitted, as a problem; asked for once there is enough of it."""
        return problem(self.fit_part.data, self.fit_part.steps)


def _cut(checked: Checked, seen: Mask, tested: Checked | None, model: ComposedModel, horizon: float) -> _Cut:
    fit_part = part(checked.data, checked.left_out, seen, FIT_STEPS)
    return _Cut(checked, fit_part, _held_out(checked, seen, tested, model, horizon))


@dataclass(frozen=True)
class _Ready:
    """The recordings, and the model, as they are fitted: without what was not measured and is not needed, on steps that states are often
    enough for, without what is wrong with them. ahead: steps of a rollout.
    """

    model: ComposedModel
    dataset: Dataset
    test: Dataset | None
    checked: Checked
    tested: Checked | None
    seen: Mask
    cut: _Cut
    ahead: int

    def restated(self, asked: _Asked, fit: Fit) -> _Ready:
        """With hidden states told anew, under a fit."""
        checked = replace(self.cut.checked, data=_restated(self.cut.checked, fit))
        return replace(self, cut=_cut(checked, self.seen, self.tested, self.model, asked.horizon))


def _ready(asked: _Asked) -> _Ready:
    if not asked.model.inputs:
        raise NotEnoughEvidence(f"{asked.dataset.source}: the model has no inputs; nothing can be traced of a robot that is asked nothing")
    model, dataset, test = alike(_in_parts(asked.model, asked.dataset), asked.dataset, asked.test)
    _belongs(dataset, model)
    if test is not None:
        _belongs(test, model)
    model, dataset, test = thinned(model, dataset, test, asked.parts)
    _measured(dataset)
    check_plausible(model, dataset)
    dataset, test = from_one_place(model, dataset), None if test is None else from_one_place(model, test)
    asked.say(0.0, 100.0, "looking for faults of measurement")
    checked = checked_of(model, dataset, asked.under)
    tested = None if test is None else checked_of(model, test, asked.under)
    seen = fit_mask(checked.data, asked.seed, everything=test is not None)
    cut = _cut(checked, seen, tested, model, asked.horizon)
    ahead = max(1, min(round(asked.horizon / dataset.dt), len(cut.fit_part.steps) // 4))
    if test is not None and len(cut.judged_on.steps) < JUDGED:
        raise _too_few(test, len(cut.judged_on.steps), JUDGED)
    _enough(dataset, model, cut.fit_part, cut.judged_on, ahead)
    return _Ready(model, dataset, test, checked, tested, seen, cut, ahead)


def _on_their_way(asked: _Asked, ready: _Ready, fit: Fit) -> TraceResult | None:
    """The answer with inputs that moved on between the rows, if the motion says that they did."""
    lines = _straight(asked, ready, fit)
    if lines is None:
        return None
    placed = asked.again(60.0, dataset=lines[0], test=lines[1])
    if placed.verdict == "unexplained" and lines[0].way.within and only_before_changes(ready.cut.given, fit):
        return _less_changes(asked) or placed
    return placed


def _from_first(asked: _Asked, ready: _Ready, chosen: Selection, structure: Structure) -> TraceResult | None:
    """The answer with runs from their first rows on, if nothing remembers what was commanded before: rows were left out for that. Structure
    may be a memory without a name, and what was reconstructed is as little known where it begins.
    """
    left_out = ready.cut.checked.data.forgetting or (ready.tested is not None and ready.tested.data.forgetting)
    if not left_out or ready.dataset.from_first or ready.dataset.reconstruction is not None:
        return None
    if structure.matters or not _nothing_remembers(chosen):
        return None
    test = None if asked.test is None else replace(asked.test, from_first=True)
    return asked.again(80.0, dataset=replace(asked.dataset, from_first=True), test=test)


def _in_more_parts(asked: _Asked, ready: _Ready, chosen: Selection, structure: Structure) -> TraceResult | None:
    """The answer with steps in parts, if that explains structure that is left."""
    if not structure.matters or asked.parts is not None:
        return None
    parts = finer(ready.dataset, ready.model, chosen, structure, ready.ahead, asked.under)
    return None if parts is None else asked.again(80.0, parts=parts)


def _second_thoughts(asked: _Asked, ready: _Ready, whole: Whole, chosen: Selection, result: TraceResult) -> TraceResult | None:
    """The answer to a recording that is read otherwise, as this answer suggests, if it explains what this one does not."""
    fit, dataset = chosen.fit, ready.dataset
    unexplained = result.verdict == "unexplained"
    if unexplained and _may_be_measured(asked, ready) and refuted(fit, ready.cut.judged_on):
        other = _with_measured_forces(asked, ready)
        if other is not None:
            return other
    recorded = ((dataset, ready.cut.checked), (ready.test, ready.tested))
    if asked.under is None and result.effects and any(_more_faults(fit, ready.model, one, there) for one, there in recorded):
        return asked.again(90.0, under=fit.model)
    if unexplained and _of_inputs_alone(result.depends_on) and sampled(asked.dataset):
        lines = _straight(asked, ready, fit, CLOSE)  # less noise is no way on: it would smooth an input as a motor does that has no name
        moved = None if lines is None or any(lines[0].way.clean) else asked.again(90.0, dataset=lines[0], test=lines[1])
        if moved is not None and _leaves_nothing(moved):
            return moved
    if not unexplained and _may_be_measured(asked, ready) and _ever_another(dataset) and _doubted_memory(fit, result):
        # of a memory without a name that is not asked: a motor that rings would be noise of its sensor
        other = _with_measured_forces(asked, ready)
        if other is not None and other.effects and _leaves_nothing(other) and _foretells_better(other, result):
            return other
    untimed = result.verdict in {"none", "unexplained"} and not (dataset.unplaced or dataset.commanded or dataset.way)
    on_rows = dataset.apart == 1 and commanded(dataset)
    if untimed and on_rows and only_before_changes(whole.given, whole.everywhere(fit)):
        return _less_changes(asked)
    return None


def _may_be_measured(asked: _Asked, ready: _Ready) -> bool:
    """Whether it has not been asked yet if inputs are forces that were measured."""
    data, force = ready.dataset, ready.cut.judged_on.inverse
    return asked.under is None and force is not None and not (data.commanded or data.measured_forces)


def _with_measured_forces(asked: _Asked, ready: _Ready) -> TraceResult | None:
    """The answer with inputs that are forces with noise of their own, if its inverse model says them."""
    other = asked.again(90.0, dataset=replace(asked.dataset, measured_forces=True))
    return other if says_forces(other.explaining, ready.cut.judged_on) else None


def _ever_another(data: Dataset) -> bool:
    """Whether inputs are others in most rows than in the row before, as a sensor's noise makes them; what is held was commanded."""
    changed = [np.any(np.diff(run.u[:: data.substeps], axis=0) != 0.0, axis=1) for run in data.runs]
    every = np.concatenate(changed)
    return bool(len(every) and np.mean(every) > MOVING)


def _doubted_memory(fit: Fit, result: TraceResult) -> bool:
    """Whether an input was found to remember, and something may depend on that memory all the same: noise that a sensor filters looks so,
    where the motion follows none of it.
    """
    found = [a for a in (fit.model.effects[place] for place in fit.added) if remembers(fit.model, a)]
    asked = {name for a in found for name in (fit.model.inputs if a.channel == "*" else (a.channel,))}
    return any(f"memory({name})" in result.may_depend_on for name in asked)


def _foretells_better(one: TraceResult, other: TraceResult) -> bool:
    """Whether rollouts on held-out data end nearer, all states together, each against where the model as given ends."""
    given = np.maximum(rms(other.before.ends), 1e-300)
    ends = [np.maximum(rms(r.after.ends) / given, EXACT) for r in (one, other)]
    return bool(np.sum(np.log(ends[0])) < np.sum(np.log(ends[1])))


def _told(asked: _Asked, ready: _Ready, whole: Whole, chosen: Selection, result: TraceResult) -> TraceResult:
    """The answer, with what is said of it once it is the last one."""
    if result.verdict == "unexplained" and chosen.fit.added and not {*result.depends_on} - {"noise"}:
        result = replace(result, depends_on=whole.likeliest or result.depends_on)
    if result.verdict in {"traced", "ambiguous"} and whole.in_one_stretch(chosen):
        result = with_time(result)
    unseen = tuple(s for s in asked.model.states if s not in ready.model.states)
    return replace(result, spec=msgspec.structs.replace(result.spec, dt=asked.model.dt), unseen=unseen)


def _more_faults(fit: Fit, model: ComposedModel, data: Dataset | None, checked: Checked | None) -> bool:
    """Whether rows are clearly off by what was found that might have been the robot by the model as given: commands that it seemed to carry
    out at once could have taken it there.
    """
    if data is None or checked is None or data.reconstruction is not None or not fit.added:
        return False
    return check(model, with_history(model, data), fit.model).faults != checked.faults


def _less_changes(asked: _Asked) -> TraceResult | None:
    """Without the transitions in which commands change, if that leaves nothing."""
    test = asked.test
    if test is not None and not test.commanded and commanded(test):
        test = replace(test, unplaced=True)
    try:
        less = asked.again(90.0, dataset=replace(asked.dataset, unplaced=True), test=test)
    except NotEnoughEvidence:
        return None
    return less if _leaves_nothing(less) else None


def _leaves_nothing(result: TraceResult) -> bool:
    return result.verdict != "unexplained" and not {*result.depends_on} - {"noise"}


def _of_inputs_alone(depends_on: Sequence[str]) -> bool:
    """Whether what is left is a memory of inputs and nothing else: so looks, too, what went on between the rows that tell it."""
    left = {*depends_on} - {"noise"}
    return bool(left) and all(one.startswith("memory(") for one in left)


def _nothing_remembers(chosen: Selection) -> bool:
    """Whether by nothing that was found, nor by what ties with it, an input acts on that was asked before."""
    models = [chosen.fit.model, *(s.fit.model for s in chosen.rivals if s.fit is not None)]
    return not any(remembers(model, a) for model in models for a in model.effects)


def _in_parts(model: ComposedModel, data: Dataset) -> ComposedModel:
    """The model with its steps taken in parts, where hidden states were told so."""
    there = any(hasattr(a.effect, "integrates") for a in model.effects)
    if data.reconstruction is None or not data.reconstruction.in_parts or there:
        return model
    finer = AppliedEffect(registry().get("effects", "integration_scheme"), "*", {"scheme": "exact"})
    return replace(model, effects=(*model.effects, finer))


def _from(begun: float, say: Progress) -> Progress:
    """Progress of what is still to do when so much of 100 is done."""
    return lambda done, total, detail: say(begun + (1.0 - begun / 100.0) * done, total, detail)


def _straight(asked: _Asked, ready: _Ready, fit: Fit, price: float = NATS) -> tuple[Dataset, Dataset | None] | None:
    """The recordings with inputs that moved on between the rows, if the motion says that they did, at a price."""
    if asked.dataset.way or asked.dataset.unplaced or asked.dataset.measured_forces:
        return None
    if not (sampled(asked.dataset) or commanded(asked.dataset)):
        return None
    checked, given, parts = ready.cut.checked, ready.cut.given, asked.parts
    less, data, test = alike(asked.model, asked.dataset, asked.test)  # a recording without a state is laid for the model without it
    samples = samples_of(data)

    def so_far(way: Way) -> Dataset:
        return acted(checked.data, thinned(less, straight(data, less, way, samples), test, parts)[1])

    def laid(way: Way) -> Problem:
        return replace(given, data=part(so_far(way), checked.left_out, ready.seen, FIT_STEPS).data, searches={}) if way else given

    def everywhere(way: Way) -> Problem:
        there = so_far(way) if way else checked.data
        return problem(there, steps_of(there, checked.left_out))

    if not alike_laid(thinned(less, straight(data, less, Way(late=True), samples), test, parts)[1], checked.data):
        return None
    try:
        if sampled(data):
            way = way_of(laid, fit, moving([inputs for _, inputs in data.segments]), price)
        else:
            way = changed_within(laid, everywhere, fit, samples, len(less.inputs))
    except ConfigError:  # a user's own model may give no numbers for inputs that went so
        return None
    if not way:
        return None
    if test is not None and (commanded(test) if way.within else sampled(test)):
        test = straight(test, less, way, samples_of(test).as_of(samples))
    return replace(straight(data, less, way, samples), noisy=noisy(data, way, samples)), test


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


def _too_few(data: Dataset, usable: int, fewest: int = FEWEST) -> NotEnoughEvidence:
    more = max(fewest - usable, 1)
    return NotEnoughEvidence(
        f"{data.source}: {usable} usable transitions of {data.dt:g} s, at least {fewest} are needed: {more} more", more
    )


def _held_out(checked: Checked, seen: Mask, tested: Checked | None, model: ComposedModel, horizon: float) -> Held:
    """The transitions that the fit does not see."""
    if tested is not None:
        everything = np.ones(sum(len(run.y) - 1 for run in tested.data.runs), dtype=bool)
        return held(model, tested.data, steps_of(tested.data, tested.left_out), tested.left_out, everything, horizon)
    steps = steps_of(checked.data, checked.left_out)
    return held(model, checked.data, steps.take(np.flatnonzero(~seen[steps.place])), checked.left_out, ~seen, horizon)


def _told_otherwise(given: Problem, fit: Fit) -> bool:
    """Whether states that were not measured are others with what was found. A hidden state's law may bend anywhere, so that effects are
    told one after the other, each about where the state is with those before it.
    """
    return bool(given.floor.axes) and any(given.bends or fit.model.effects[place].effect.stage == "step" for place in fit.added)


def _restated(checked: Checked, fit: Fit) -> Dataset:
    """The recording with the states that were not measured as the model has them, which knows more than none: what depends on a speed is
    seen where the speed is better known.
    """
    data = checked.data
    for _ in range(RETOLD if data.reconstruction is not None and data.reconstruction.hidden else 1):
        everything = problem(data, steps_of(data, checked.left_out))
        states = begun(everything, evaluate(everything, fit.model, fit.noise))
        data = data if states is None else _at(data, states)
    return data


def _at(data: Dataset, states: Array) -> Dataset:
    """The same with states (rows of the runs laid end to end, nx) in the place of those that were not measured."""
    rows = np.cumsum([0] + [len(run.y) for run in data.runs])
    runs = []
    for run, a, b in zip(data.runs, rows[:-1], rows[1:], strict=True):
        y = run.y.copy()
        for _, v in data.axes_without_speed:
            y[:, v] = np.where(np.isnan(y[:, v]), np.nan, states[a:b, v])
        runs.append(replace(run, y=y))
    return replace(data, runs=tuple(runs))


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
    longest = max((len(run.y) - 1 for run in fit_part.data.runs), default=0)
    sooner = [steps for steps in (2, 3, 5, 10) if steps < ahead]
    later = [times * ahead for times in (3, 10) if 2 * times * ahead < longest]  # a robot may be slow, and its sensor loud
    gone = [way for steps in (ahead, *sooner, *later) if len(way := displacement(replace(here, horizon=steps)))]
    if gone and all(np.all(rms(way) < MOVED * jitter) for way in gone) and not _follows(fit_part, model):
        raise NotEnoughEvidence(f"{data.source}: no state goes farther than its noise makes it jump from row to row; nothing can be traced")


def _follows(given: Part, model: ComposedModel) -> bool:
    """Whether some state at the end of a step goes with an input over it. A robot that answers within a step, and is asked for something
    else in each, goes no farther in many steps than in one.
    """
    u, y = acting(model, given.data).mean[given.steps.place], given.steps.y1
    u, y = (e - e.mean(axis=0) for e in (u, y))
    together, apart = np.abs(u.T @ y), np.outer(np.linalg.norm(u, axis=0), np.linalg.norm(y, axis=0))
    return bool(np.any(together > FOLLOWS / math.sqrt(len(y)) * apart + 1e-9))
