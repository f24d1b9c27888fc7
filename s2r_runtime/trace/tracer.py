"""Residual -> effect -> repaired model -> error before and after (docs/tracing.md).

    1  faults of measurement are found and taken out                                   faults
    2  part of the recording is held out; the fit never sees it                        holdout
    3  effects are selected, noise estimated under each hypothesis                     selection, fitting, residual_noise
    4  what is left is tested for structure, named by what it depends on               lack_of_fit, whole
    5  if something is left, the library is asked once more                            second_look
       if all is explained by what remembers nothing, first rows that were left out    beginning
       count, and all is asked again
    6  a verdict; errors and gap before and after on what was held out                 verdict, errors, answer

Deterministic: the same recording, model and seed give the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, NotEnoughEvidence, UsageError
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.trace.about import remembers
from s2r_runtime.trace.answer import answered, with_time
from s2r_runtime.trace.beginning import with_history
from s2r_runtime.trace.begun import begun
from s2r_runtime.trace.dataset import Dataset, thinned
from s2r_runtime.trace.dataset_files import load_dataset
from s2r_runtime.trace.errors import Held, Kind, displacement, held, judge
from s2r_runtime.trace.faults import Checked, check
from s2r_runtime.trace.fitting import Fit, Problem, evaluate, problem
from s2r_runtime.trace.holdout import Part, fit_mask, part
from s2r_runtime.trace.one_place import from_one_place
from s2r_runtime.trace.plausible import check_plausible
from s2r_runtime.trace.residual import Mask, acting, first_steps, rms, steps_of
from s2r_runtime.trace.result import TraceResult
from s2r_runtime.trace.rivals import CLOSE
from s2r_runtime.trace.scores import names
from s2r_runtime.trace.second_look import astray, finer, once_more
from s2r_runtime.trace.selection import MOST, Selection, all_dated, select
from s2r_runtime.trace.straight import NATS, acted, alike_laid, changed_within, commanded, noisy, sampled, samples_of, straight, way_of
from s2r_runtime.trace.throttled import refuted, says_forces
from s2r_runtime.trace.unplaced import checked_of, only_before_changes
from s2r_runtime.trace.unseen import alike
from s2r_runtime.trace.verdict import confirmed, foretold_too
from s2r_runtime.trace.ways import Way, moving
from s2r_runtime.trace.whole import Whole

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
    parts: int | None = None,
    under: ComposedModel | None = None,
) -> TraceResult:
    """parts: S, of each step, where they were asked for (`finer`). under: what was found before, under which more faults show."""
    weights, kind = norm
    asked, as_recorded = model, (dataset, test)

    def again(one: Dataset, other: Dataset | None, begun: float) -> TraceResult:
        return _traced(one, asked, other, horizon, seed, _from(begun, say), norm, parts, under)

    if not model.inputs:
        raise NotEnoughEvidence(f"{dataset.source}: the model has no inputs; nothing can be traced of a robot that is asked nothing")
    model, dataset, test = alike(_in_parts(model, dataset), dataset, test)
    _belongs(dataset, model)
    if test is not None:
        _belongs(test, model)
    model, dataset, test = thinned(model, dataset, test, parts)
    _measured(dataset)
    check_plausible(model, dataset)
    dataset, test = from_one_place(model, dataset), None if test is None else from_one_place(model, test)
    say(0.0, 100.0, "looking for faults of measurement")
    checked = checked_of(model, dataset, under)
    tested = None if test is None else checked_of(model, test, under)
    seen = fit_mask(checked.data, seed, everything=test is not None)
    cut = _cut(checked, seen, tested, model, horizon)
    ahead = max(1, min(round(horizon / dataset.dt), len(cut.fit_part.steps) // 4))
    if test is not None and len(cut.judged_on.steps) < JUDGED:
        raise _too_few(test, len(cut.judged_on.steps), JUDGED)
    _enough(dataset, model, cut.fit_part, cut.judged_on, ahead)
    say(5.0, 100.0, "looking for effects")
    hidden = cut.given.bends
    chosen = select(cut.given, model, ahead, lambda share: say(5.0 + 55.0 * share, 100.0, "looking for effects"), 1 if hidden else MOST)
    lines = _straight(as_recorded, asked, parts, checked, seen, cut.given, chosen.fit)
    if lines is not None:
        placed = again(*lines, 60.0)
        untold = placed.verdict == "unexplained" and lines[0].way.within and only_before_changes(cut.given, chosen.fit)
        return (_less_changes(as_recorded, again) if untold else None) or placed
    for most in range(2, MOST + 1) if hidden else (MOST,):
        if not _told_otherwise(cut.given, chosen.fit):
            break
        cut = _cut(replace(cut.checked, data=_restated(cut.checked, chosen.fit)), seen, tested, model, horizon)
        before = names(chosen.fit.model)
        chosen = select(cut.given, model, ahead, lambda share: say(60.0 + 20.0 * share, 100.0, "looking for effects"), most)
        if names(chosen.fit.model) == before:
            break
    checked, judged_on, given = cut.checked, cut.judged_on, cut.given
    whole = Whole(checked, model, ahead)
    chosen = foretold_too(given, whole.given, chosen, judged_on, ahead)
    chosen = confirmed(given, all_dated(given, whole.given, chosen), judged_on)
    say(80.0, 100.0, "testing what is left")
    structure = whole.structure(chosen)
    if structure.matters or astray(chosen, structure, judged_on, seed):
        chosen, structure = once_more(given, whole, chosen, structure, judged_on, ahead)
    left_out = checked.data.forgetting or (tested is not None and tested.data.forgetting)
    if left_out and not dataset.from_first and not structure.matters and dataset.reconstruction is None and _nothing_remembers(chosen):
        # structure may be a memory without a name, and what was reconstructed is as little known where it begins
        also = None if as_recorded[1] is None else replace(as_recorded[1], from_first=True)
        return again(replace(as_recorded[0], from_first=True), also, 80.0)
    if structure.matters and parts is None:
        more = finer(dataset, model, chosen, structure, ahead, under)
        if more is not None:
            return _traced(as_recorded[0], asked, as_recorded[1], horizon, seed, _from(80.0, say), norm, more, under)
    say(90.0, 100.0, "judging on held-out data")
    w = np.ones(len(model.states)) if weights is None else np.array([weights[asked.states.index(s)] for s in model.states])
    result = answered(dataset, checked, given, chosen, structure, judged_on, seed, w, kind)
    asked_once = under is None and not (dataset.commanded or dataset.measured_forces)
    if asked_once and result.verdict == "unexplained" and refuted(chosen.fit, judged_on):
        taken = replace(as_recorded[0], measured_forces=True)
        other = _traced(taken, asked, as_recorded[1], horizon, seed, _from(90.0, say), norm, parts)
        if says_forces(other.explaining, judged_on):
            return other
    if (
        under is None
        and result.effects
        and any(_more_faults(chosen.fit, model, one, there) for one, there in ((dataset, checked), (test, tested)))
    ):
        return _traced(as_recorded[0], asked, as_recorded[1], horizon, seed, _from(90.0, say), norm, parts, chosen.fit.model)
    if result.verdict == "unexplained" and _of_inputs_alone(result.depends_on):
        lines = _straight(as_recorded, asked, parts, checked, seen, given, chosen.fit, CLOSE)
        moved = None if lines is None else again(*lines, 90.0)
        if moved is not None and not {*moved.depends_on} - {"noise"} and moved.verdict in {"none", "traced", "ambiguous"}:
            return moved
    untimed = result.verdict in {"none", "unexplained"} and not (dataset.unplaced or dataset.commanded or dataset.way)
    on_rows = dataset.apart == 1 and not dataset.interpolated and commanded(dataset)
    if untimed and on_rows and only_before_changes(whole.given, whole.everywhere(chosen.fit)):
        less = _less_changes(as_recorded, again)
        if less is not None:
            return less
    if result.verdict == "unexplained" and chosen.fit.added and not {*result.depends_on} - {"noise"}:
        result = replace(result, depends_on=whole.likeliest or result.depends_on)
    if result.verdict in {"traced", "ambiguous"} and whole.in_one_stretch(chosen):
        result = with_time(result)
    unseen = tuple(s for s in asked.states if s not in model.states)
    result = replace(result, spec=msgspec.structs.replace(result.spec, dt=asked.dt), unseen=unseen)
    say(100.0, 100.0, result.verdict)
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


def _more_faults(fit: Fit, model: ComposedModel, data: Dataset | None, checked: Checked | None) -> bool:
    """Whether rows are clearly off by what was found that might have been the robot by the model as given: commands that it seemed to carry
    out at once could have taken it there.
    """
    if data is None or checked is None or data.reconstruction is not None or not fit.added:
        return False
    return check(model, with_history(model, data), fit.model).faults != checked.faults


def _less_changes(
    recorded: tuple[Dataset, Dataset | None], again: Callable[[Dataset, Dataset | None, float], TraceResult]
) -> TraceResult | None:
    """Without the transitions in which commands change, if that leaves nothing. again: traces recordings."""
    data, test = recorded
    if test is not None and not test.commanded and commanded(test):
        test = replace(test, unplaced=True)
    try:
        less = again(replace(data, unplaced=True), test, 90.0)
    except NotEnoughEvidence:
        return None
    return None if less.verdict == "unexplained" or {*less.depends_on} - {"noise"} else less


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


def _straight(
    recorded: tuple[Dataset, Dataset | None],
    asked: ComposedModel,
    parts: int | None,
    checked: Checked,
    seen: Mask,
    given: Problem,
    fit: Fit,
    price: float = NATS,
) -> tuple[Dataset, Dataset | None] | None:
    """The recordings with inputs that moved on between the rows, if the motion says that they did, at a price."""
    if recorded[0].way or recorded[0].unplaced or recorded[0].measured_forces or not (sampled(recorded[0]) or commanded(recorded[0])):
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
