"""Are the columns what they say? Other units or axes, or exchanged columns, are no effect that a model lacks.

    E(c) = mean over states that go somewhere of  |y_{k+H} (-) f^H(y_k)| / |y_{k+H} (-) y_k|     (trimmed rms, H steps of half a second)

for the recording as it is and with each usual mistake c taken back. As it is, the model foretells little (E > NOTHING); with one
mistake taken back it foretells well (E < WELL, and by far better): then that is what is wrong, and no effect is looked for. A state
that nothing else follows (a car's speed) may be wrong alone: the same with the largest in the place of the mean, and NOTHING_ALONE.
A position and its rate, or all states, may be so many times too large together (degrees, cm), or of the other sign. Where inputs so many
times larger do the same (a mass under a force), only the number itself tells: 180/pi to EXACTLY is no mass.
What an input that does nothing, or a steady push (wind, a slope), explains nearly as well is no mistake, and neither is what a heading
that is off explains clearly better, or what would part a position from its rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import axes
from s2r_runtime.trace.checks.clocks import check_clocks
from s2r_runtime.trace.checks.constant_columns import check_measured
from s2r_runtime.trace.checks.model_order import check_accelerations
from s2r_runtime.trace.checks.prediction_error import STARTS, each_unforetold, some_starts, steps_ahead, trimmed, unforetold, ways_of
from s2r_runtime.trace.checks.scale_free_error import heading_off, loosely_unforetold, sizes
from s2r_runtime.trace.checks.units import SCALES, Scale, axis_pairs, groups
from s2r_runtime.trace.data.dataset import Dataset, regridded
from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.estimation.prediction import acting, advanced, predicted, steps_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Change = Callable[[Array], Array]

NOTHING, WELL, BETTER = 0.35, 0.35, 0.4
"""E from which a model foretells little (two columns of four may be exchanged), E below which it foretells well, and the ratio of both at
most.
"""

NOTHING_ALONE = 0.6
"""As NOTHING, of the state that is foretold least."""

SURELY = 0.1
"""As WELL, for factors that an actuator's limits could have, too."""

CHANGED, NEITHER, WORSE = 0.1, 0.8, 0.1
"""By how much E' of a state must change to count; what it must be below with a mistake taken back; and by how much it may be above what E
may be, of a model that lacks much.
"""

DEAD = 0.7
"""Of E with an input that does nothing, which E must be below: a motor that hardly turns is in no other unit."""

BEYOND = 0.01
"""Share of an input's rows beyond what it can be, from which they are no outliers."""

EXACTLY, FEWEST_STEPS = 0.02, 60
"""How near to a unit's factor a speed must be to its command's multiple, and on how many steps at least."""

NEARLY = 0.08
"""As EXACTLY, of how far states went, friction aside: that is not known as well."""

ONWARD = 1.3
"""Times as far as it is foretold that a robot goes at most, of which a mistake is believed."""

TOLD = 0.15
"""E' below which all is said: that another explanation leaves more than one does is noise then."""

ALIKE = 1.5
"""Times E with states in another unit, below which E with inputs as many times larger says the same."""

FAR = 50.0
"""Times too large, from which on E need not be below SURELY: no robot is that far off by itself."""

ROWS = 6000
"""Rows of each segment that are looked at."""

AT_ONCE = 100_000
"""Rows of recordings that are rolled out at once: some megabytes."""

ROUGHLY, FAR_FROM = 60, 2.0
"""Rollouts of a first look at many mistakes, and times an E that counts from which on that look suffices: so few tell E to a sixth."""

SEGMENTS = 40
"""Segments that are looked at, evenly spread."""


@dataclass(frozen=True)
class _Mistake:
    """What it is, and how it is taken back: of states (N, nx) and inputs (N, nu). well: E below which it is believed. by_number: if states
    then go just as far as they should, too.
    """

    said: str
    states: Change | None
    inputs: Change | None
    well: float
    by_number: bool = False


def check_plausible(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if the columns are clearly not what they say, with what they seem to be; ConfigError if somebody's own model
    gives no numbers where the robot was.
    """
    check_measured(model, data)
    _check_columns(model, data)
    _check_loosely(model, data)
    check_accelerations(model, data)
    _check_angles(model, data)
    _check_scales(model, data)
    _check_speeds(model, data)
    check_clocks(model, data)
    steps = steps_of(data)  # last: what is not what it says may lie where no model goes
    advanced(model, steps.y0, acting(model, data), steps.place)


def _check_columns(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if the motion is foretold so much better with one usual mistake taken back that it must have been made."""
    every = unforetold(model, data)
    if every is None or not data.segments or (np.mean(every) <= NOTHING and np.max(every) <= NOTHING_ALONE):
        return
    few = _few(model, data)
    mistakes = list(_mistakes(model))
    known = zip(_if_near(model, few, mistakes, WELL), mistakes, strict=True)
    tried = [(e, m) for e, m in known if e is not None and _moves_as_well(model, few, m)]
    for measure, nothing in ((np.mean, NOTHING), (np.max, NOTHING_ALONE)):
        as_it_is = float(measure(every))
        best, said = min([(float(measure(e)), m.said) for e, m in tried if measure(e) < m.well], default=(math.inf, ""))
        if as_it_is <= nothing or best >= BETTER * as_it_is:
            continue
        if _heading_off(model, few, measure) < DEAD * best:
            continue
        if best < DEAD * min((float(measure(e)) for e in _otherwise(model, few)), default=math.inf):
            raise RecordingError(f"{data.source}: {said}: so read, the model errs by {best:.0%} of the motion; as it is, by {as_it_is:.0%}")


def _check_loosely(model: ComposedModel, data: Dataset) -> None:
    """The same of a model that lacks so much that it foretells little whatever is taken back: by the states that a mistake changes, each by
    itself, in whatever size (`scale_free_error`). All that it is in must be foretold then, and nothing worse than it was.
    """
    few = _few(model, data) if data.segments else data
    as_it_is = loosely_unforetold(model, few) if data.segments else None
    if as_it_is is None or not np.nanmax(as_it_is, initial=0.0) > NOTHING_ALONE:
        return
    every = unforetold(model, data)
    if every is None or (np.mean(every) <= NOTHING and np.max(every) <= NOTHING_ALONE):
        return
    found: list[tuple[float, int, float, float, Mask, _Mistake]] = []
    for mistake in (*(m for m in _mistakes(model) if m.well == WELL), *_other_scales(model)):  # a few times as far is no mistake here
        e = _loosely_if(model, few, mistake) if _moves_as_well(model, few, mistake) else None
        if e is None or np.any(e > as_it_is + CHANGED) or np.any(e[_spoilt(model, mistake)] > NEITHER):
            continue
        changed = (np.abs(e - as_it_is) > CHANGED) & (e < NEITHER)
        before, after = (float(np.mean(one[changed])) if changed.any() else math.inf for one in (as_it_is, e))
        better = before > NOTHING_ALONE and after < min(WELL + WORSE, BETTER * before)
        if better and _by_number(model, few, mistake, changed):
            found.append((float(np.sum((as_it_is - e)[changed])), _columns(model, few, mistake), before, after, changed, mistake))
    if not found:
        return
    _, _, before, after, changed, mistake = max(found, key=lambda one: (round(one[0], 2), one[1]))
    nothing = _Mistake("", None, None, WELL)
    others = [_loosely_if(model, few, one, pushed=pushed) for one in (nothing, *_no_mistakes(model, few)) for pushed in (False, True)]
    otherwise = min((float(np.mean(np.where(np.isnan(e), 2.0, e)[changed])) for e in others if e is not None), default=math.inf)
    if after < DEAD * otherwise and otherwise > TOLD:
        names = ", ".join(name for name, there in zip(model.states, changed, strict=True) if there)
        raise RecordingError(
            f"{data.source}: {mistake.said}: so read, the model errs by {after:.0%} of how {names} moved; as it is, by {before:.0%}, even "
            "if it may be off in size"
        )


def _other_scales(model: ComposedModel) -> Iterator[_Mistake]:
    """Of positions with their rates, or of all states, those that are told by their number: a light load may be about as far off."""
    for group in groups(model):
        for scale in SCALES if len(group) > 1 else ():
            if scale.by_number and not scale.zero:
                said = scale.said([model.states[j] for j in group])
                yield _Mistake(said, partial(_rescaled, list(group), 1.0 / scale.times, 0.0), None, WELL, by_number=True)


def _by_number(model: ComposedModel, data: Dataset, mistake: _Mistake, changed: Mask) -> bool:
    """Whether all states of a mistake go just as far as they are foretold to with it taken back, friction aside, if that tells it; else
    whether none goes clearly farther: robots fall short, and two weak gains together are as far from one as degrees are.
    """
    found = sizes(model, _taken_back(model, data, mistake))
    if mistake.by_number:
        return bool(np.all(np.abs(found[_spoilt(model, mistake)] - 1.0) < NEARLY))
    return not np.any(found[changed] > ONWARD)


def _spoilt(model: ComposedModel, mistake: _Mistake) -> Mask:
    """(nx,) the states that a mistake is in."""
    values = np.arange(1.0, len(model.states) + 1.0)[None, :]
    return np.zeros(len(model.states), dtype=np.bool_) if mistake.states is None else (mistake.states(values.copy()) != values)[0]


def _loosely_if(model: ComposedModel, data: Dataset, mistake: _Mistake, *, pushed: bool = False) -> Array | None:
    """E' with a mistake taken back; None where somebody's own model cannot go there. pushed: less a steady push."""
    try:
        return loosely_unforetold(model, _taken_back(model, data, mistake), pushed=pushed)
    except ConfigError:
        return None


def _columns(model: ComposedModel, data: Dataset, mistake: _Mistake) -> int:
    """How many columns that the recording has a mistake is in."""
    made_up = np.isin(model.states, data.reconstruction.states if data.reconstruction else ())
    values = np.arange(1.0, len(model.inputs) + 1.0)[None, :]
    inputs = 0 if mistake.inputs is None else int(np.count_nonzero(mistake.inputs(values.copy()) != values))
    return inputs + int(np.count_nonzero(_spoilt(model, mistake) & ~made_up))


def _no_mistakes(model: ComposedModel, data: Dataset) -> Iterator[_Mistake]:
    """What else it may be: an input that does nothing, a heading that is off all the time."""
    for j in range(len(model.inputs)):
        yield _mistake("inputs", "", partial(_scaled, [j], 0.0))
    by = heading_off(model, data) if {"x", "y", "theta"} <= set(model.states) else None
    if by is not None:
        yield _mistake("states", "", partial(_rescaled, [model.states.index("theta")], 1.0, -by))


def _check_angles(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if an input is where it means nothing: wheels are not steered by a quarter turn."""
    for name, most in getattr(model.nominal.shared, "within", {}).items() if data.segments else ():
        u = np.concatenate([inputs.values[:, model.inputs.index(name)] for _, inputs in data.segments])
        if np.mean(np.abs(u) >= most) > BEYOND:
            raise RecordingError(
                f"{data.source}: {name} goes to {np.nanmax(np.abs(u)):.4g}, must be below {most:.4g} rad: it seems to be in degrees, or "
                "the angle of a steering wheel and not of the wheels on the road"
            )


def _check_scales(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if states that belong together are clearly so many times what they must be."""
    every = unforetold(model, data)
    if every is None or not data.segments or (np.mean(every) <= NOTHING and np.max(every) <= NOTHING_ALONE):
        return
    few, every_input = _few(model, data), list(range(len(model.inputs)))
    dead = [_Mistake("", None, partial(_scaled, some, 0.0), WELL) for some in (every_input, *([j] for j in every_input))]
    still = DEAD * min(_errs(model, few, dead))
    pushed = DEAD * min((float(np.mean(e)) for e in _otherwise(model, few)[-1:]), default=math.inf)
    limit = min(WELL, BETTER * float(np.mean(every)), still)
    moving = {j for pair in axis_pairs(model) for j in pair}  # no temperature
    offered = [(group, scale) for group in groups(model) for scale in SCALES if not (scale.zero and moving & {*group})]
    changes = [_Mistake("", partial(_rescaled, list(group), 1.0 / scale.times, scale.zero), None, WELL) for group, scale in offered]
    for e, (group, scale) in sorted(zip(_means(_if_near(model, few, changes, limit)), offered, strict=True), key=lambda one: one[0]):
        if not e < (limit if scale.times >= FAR else min(limit, SURELY)):
            return
        if _heading_off(model, few, np.mean) < DEAD * e:
            continue
        if scale.zero == 0.0 and not e < pushed:  # another zero is a steady push, told from others by its number
            continue
        gains = (every_input, *([j] for j in every_input if 1.0 / FAR < abs(scale.times) < FAR))
        alike = scale.zero != 0.0 or min(_err(model, few, inputs=partial(_scaled, g, scale.times)) for g in gains) < ALIKE * e
        if not alike or (scale.by_number and _exactly(model, few, group, scale)):
            raise RecordingError(
                f"{data.source}: {scale.said([model.states[j] for j in group])}: so read, the model errs by {e:.0%} of the motion"
            )


def _exactly(model: ComposedModel, data: Dataset, group: tuple[int, ...], scale: Scale) -> bool:
    """Whether it is this number, to EXACTLY, by which states are foretold best."""
    tried = (1.0 - 2.0 * EXACTLY, 1.0 - EXACTLY, 1.0, 1.0 + EXACTLY, 1.0 + 2.0 * EXACTLY)
    off = [(1.0 / scale.times, k * scale.zero) if scale.zero else (k / scale.times, 0.0) for k in tried]
    return abs(int(np.argmin([_err(model, data, partial(_rescaled, list(group), *one)) for one in off])) - 2) <= 1


def _errs(model: ComposedModel, data: Dataset, changes: Sequence[_Mistake]) -> list[float]:
    """Mean E with columns changed; infinite where nothing goes anywhere then."""
    return _means(_if_each_taken_back(model, data, changes))


def _means(each: Sequence[Array | None]) -> list[float]:
    return [math.inf if e is None else float(np.mean(e)) for e in each]


def _if_near(model: ComposedModel, data: Dataset, mistakes: Sequence[_Mistake], limit: float) -> list[Array | None]:
    """`_if_each_taken_back`; None, too, where a first look says that E is far above a limit."""
    roughly = _means(_if_each_taken_back(model, data, mistakes, ROUGHLY))
    near = [i for i, e in enumerate(roughly) if e < FAR_FROM * limit]
    closely = dict(zip(near, _if_each_taken_back(model, data, [mistakes[i] for i in near]), strict=True))
    return [closely.get(i) for i in range(len(mistakes))]


def _err(model: ComposedModel, data: Dataset, states: Change | None = None, inputs: Change | None = None) -> float:
    """The same of one change."""
    return _errs(model, data, [_Mistake("", states, inputs, WELL)])[0]


def _check_speeds(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if a speed that an input sets is that in another unit: it goes with the command, times just that number, while
    the robot goes as far as it was told.
    """
    steps = steps_of(data)
    if len(steps) < FEWEST_STEPS:
        return
    foretold = predicted(model, steps, acting(model, data))
    units: dict[str, str] = getattr(model.nominal, "units", {})
    for j, name in enumerate(model.states):
        if name not in model.nominal.reached:
            continue
        told, y = foretold[:, j], steps.y1[:, j]
        slope = float(told @ y) / max(float(told @ told), 1e-300)
        for unit, right, factor, _ in (*_UNITS.get(units.get(name, ""), ()), *_OF_STATES.get(units.get(name, ""), ())):
            left = trimmed((y - told / factor)[:, None])[0]
            if abs(slope * factor - 1.0) < EXACTLY and left < SURELY * float(np.std(y)) and _goes_as_told(model, data):
                raise RecordingError(
                    f"{data.source}: {name} seems to be in {unit}, must be in {right}: it is {slope:.4g} times what was commanded, and "
                    "the robot goes as far as it was told"
                )


def _goes_as_told(model: ComposedModel, data: Dataset) -> bool:
    """Whether the states that are not set by an input are foretold."""
    others = [i for i, name in enumerate(model.states) if name not in model.nominal.reached]
    found = unforetold(model, data, others)
    return found is not None and float(np.mean(found)) < WELL


def _few(model: ComposedModel, data: Dataset) -> Dataset:
    """The beginning of each segment, of many every so many, and runs of these."""
    some = [pair for pair in data.segments if len(pair[0].t) > 1]
    every = max(1, len(some) // SEGMENTS)
    cut = tuple((Stream(s.t[:ROWS], s.values[:ROWS]), _until(i, s.t[:ROWS])) for s, i in some[::every])
    return regridded(replace(data, segments=cut), model)


def _until(inputs: Stream, t: Array) -> Stream:
    inside = inputs.t <= t[-1] if len(t) else np.zeros(len(inputs.t), dtype=bool)
    return Stream(inputs.t[inside], inputs.values[inside])


def _taken_back(model: ComposedModel, data: Dataset, mistake: _Mistake) -> Dataset:
    """On the grid as it is, where that says the same: what is laid on it is linear in all but angles, which jump."""
    of_states, of_inputs = mistake.states or _as_it_is, mistake.inputs or _as_it_is
    probe = np.random.default_rng(0).normal(size=(2, len(model.states)))
    straight = np.array_equal(of_states(probe)[:, model.angle_columns], probe[:, model.angle_columns])
    if straight and (mistake.inputs is None or data.turned is None):
        return replace(data, runs=tuple(replace(run, y=of_states(run.y), u=of_inputs(run.u)) for run in data.runs))
    changed = []
    for states, inputs in data.segments:
        y = states.values if mistake.states is None else mistake.states(states.values)
        u = inputs.values if mistake.inputs is None else mistake.inputs(inputs.values)
        changed.append((Stream(states.t, y), Stream(inputs.t, u)))
    return regridded(replace(data, segments=tuple(changed)), model)


def _as_it_is(values: Array) -> Array:
    return values


def _if_taken_back(model: ComposedModel, data: Dataset, mistake: _Mistake) -> Array | None:
    """What is foretold then; None where somebody's own model cannot go there."""
    try:
        return unforetold(model, _taken_back(model, data, mistake))
    except ConfigError:
        return None


def _if_each_taken_back(model: ComposedModel, data: Dataset, mistakes: Sequence[_Mistake], most: int = STARTS) -> list[Array | None]:
    """The same of each of some by itself, many rolled out at once: what a step costs hardly depends on how many take it. None, too, where
    fewer states go anywhere than as it is: a heading 57 times as large is wrapped to chance, and what is not asked is not foretold. most:
    rollouts of each, or so.
    """
    as_it_is = each_unforetold(model, [data], most=most)[0]
    asked = 0 if as_it_is is None else len(as_it_is)
    count = max(1, AT_ONCE // max(1, sum(len(run.y) for run in data.runs)))
    found: list[Array | None] = []
    for some in (mistakes[k : k + count] for k in range(0, len(mistakes), count)):
        try:
            changed = [_taken_back(model, data, mistake) for mistake in some]
            alike = len({one.substeps for one in changed}) == 1  # inputs that never change have no parts of a step
            found += each_unforetold(model, changed, most=most) if alike else [unforetold(model, one) for one in changed]
        except ConfigError:
            found += [_if_taken_back(model, data, mistake) for mistake in some]
    return [None if e is None or len(e) < asked else e for e in found]


def _mistakes(model: ComposedModel) -> Iterator[_Mistake]:
    """The usual ones, each as what would be right."""
    units: dict[str, str] = getattr(model.nominal, "units", {})
    for kind, names in (("states", model.states), ("inputs", model.inputs)):
        for a, b in combinations(names, 2):
            yield _exchanged(kind, names, ((a, b),))
        for j, name in enumerate(names):
            for unit, right, factor, well in (
                *_UNITS.get(units.get(name, ""), ()),
                *(_OF_STATES.get(units.get(name, ""), ()) if kind == "states" else ()),
            ):
                yield _mistake(kind, f"{name} seems to be in {unit}, must be in {right}", partial(_scaled, [j], factor), well)
            if kind == "inputs":
                yield _mistake(kind, f"{name} seems to have the other sign", partial(_scaled, [j], -1.0))
    yield from _speeds_together(model, units)
    yield from _sides_exchanged(model)
    if {"x", "y"} <= set(model.states):
        both = [model.states.index("x"), model.states.index("y")]
        yield _mistake("states", "x and y seem to be in mm, must be in m", partial(_scaled, both, 1e-3))
        yield _mistake("states", "y seems to point right, must point left", partial(_scaled, both[1:], -1.0))
    for name in model.nominal.angles:
        j = model.states.index(name)
        yield _mistake("states", f"{name} seems to be clockwise, must be counter-clockwise", partial(_scaled, [j], -1.0))
        yield _mistake("states", f"{name} seems to be clockwise from y, must be counter-clockwise from x", partial(_turned, j, 1.0))
        said = f"{name} seems to be in degrees clockwise from y, must be in rad counter-clockwise from x"
        yield _mistake("states", said, partial(_turned, j, math.pi / 180.0))

    for one, other in combinations(axis_pairs(model), 2):
        yield _exchanged("states", model.states, tuple((model.states[j], model.states[k]) for j, k in zip(one, other, strict=True)))


def _speeds_together(model: ComposedModel, units: dict[str, str]) -> Iterator[_Mistake]:
    """Speeds that are asked for, all of a unit and with what is measured of them, in another one."""
    for of in dict.fromkeys(units.get(name, "") for name in model.inputs):
        inputs = [j for j, name in enumerate(model.inputs) if units.get(name, "") == of]
        states = [model.states.index(s) for s, i in model.nominal.reached.items() if s in model.states and model.inputs.index(i) in inputs]
        if len(inputs) + len(states) < 2:
            continue
        names = [*(model.states[j] for j in states), *(model.inputs[j] for j in inputs)]
        said = ", ".join(names[:-1]) + " and " + names[-1]
        for unit, right, factor, _ in (*_UNITS.get(of, ()), *(_OF_STATES.get(of, ()) if states else ())):
            yield _Mistake(
                f"{said} seem to be in {unit}, must be in {right}",
                partial(_scaled, states, factor) if states else None,
                partial(_scaled, inputs, factor),
                SURELY,
            )


def _sides_exchanged(model: ComposedModel) -> Iterator[_Mistake]:
    """What is commanded of two sides, together with what is measured of it: each wheel goes as it is told, and the robot the other way."""
    there = [(s, i) for s, i in model.nominal.reached.items() if s in model.states]
    for one, other in combinations(there, 2):
        states, inputs = ((one[k], other[k]) for k in (0, 1))
        of_states, of_inputs = _exchanged("states", model.states, (states,)), _exchanged("inputs", model.inputs, (inputs,))
        said = f"the columns {states[0]} and {states[1]}, {inputs[0]} and {inputs[1]} seem to be exchanged"
        yield _Mistake(said, of_states.states, of_inputs.inputs, WELL)


def _exchanged(kind: str, names: tuple[str, ...], pairs: tuple[tuple[str, str], ...]) -> _Mistake:
    other = {name: partner for a, b in pairs for name, partner in ((a, b), (b, a))}
    said = ", ".join(f"{a} and {b}" for a, b in pairs)
    return _mistake(
        kind, f"the columns {said} seem to be exchanged", partial(_ordered, [names.index(other.get(name, name)) for name in names])
    )


def _otherwise(model: ComposedModel, data: Dataset) -> list[Array]:
    """E where it is no mistake: each input by itself does nothing; something pushes steadily (wind, a slope)."""
    dead = _if_each_taken_back(model, data, [_mistake("inputs", "", partial(_scaled, [j], 0.0)) for j in range(len(model.inputs))])
    return [e for e in (*dead, unforetold(model, data, pushed=True)) if e is not None]


def _heading_off(model: ComposedModel, data: Dataset, measure: Callable[[Array], np.floating]) -> float:
    """E with the heading turned by what the way goes aside of it, all in all; infinite where there is none. A robot that hardly turned goes
    much the same with axes exchanged or mirrored.
    """
    starts = some_starts(data)
    if not {"x", "y", "theta"} <= set(model.states) or not len(starts):
        return math.inf
    way, foretold = ways_of(model, data, starts)
    x, y, theta = (model.states.index(name) for name in ("x", "y", "theta"))
    by = np.angle(np.nansum((way[:, x] + 1j * way[:, y]) * (foretold[:, x] - 1j * foretold[:, y])))
    (turned,) = _if_each_taken_back(model, data, [_mistake("states", "", partial(_rescaled, [theta], 1.0, -float(by)))])
    return math.inf if turned is None else float(measure(turned))


def _moves_as_well(model: ComposedModel, data: Dataset, mistake: _Mistake) -> bool:
    """Whether positions go as their rates say with a mistake of states taken back, if they do as it is: no effect changes that."""
    if mistake.states is None or not axes(model.nominal):
        return True
    before, after = (_unlike(model, one) for one in (data, _taken_back(model, data, mistake)))
    return bool(np.all(after <= np.maximum(before, WELL)))


def _unlike(model: ComposedModel, data: Dataset) -> Array:
    """(axes,) how far positions go otherwise than their rates say in the steps of a rollout, over how far they go, at most 2."""
    ahead = steps_ahead(data)
    found = []
    for axis in axes(model.nominal):
        off, way = [np.zeros(0)], [np.zeros(0)]
        for run in data.runs:
            rate = run.y[:, axis.velocity]
            gone = np.append(0.0, np.nancumsum(0.5 * (rate[1:] + rate[:-1]) * run.durations(data.dt)))
            went = run.y[ahead:, axis.position] - run.y[:-ahead, axis.position]
            off.append(went - (gone[ahead:] - gone[:-ahead]))
            way.append(went)
        e, w = (trimmed(np.concatenate(part)[:, None]) for part in (off, way))
        found.append(min(float(e[0] / max(w[0], 1e-300)), 2.0))
    return np.array(found)


_UNITS = {
    "rad": (("degrees", "rad", math.pi / 180.0, WELL),),
    "rad/s": (("degrees a second", "rad/s", math.pi / 180.0, WELL), ("revolutions a minute", "rad/s", math.pi / 30.0, SURELY)),
    "m/s": (("mm/s", "m/s", 1e-3, WELL),),
}
"""Unit of a column -> units in which it may be by mistake: name, right one, factor, E below which it is believed."""

_OF_STATES = {"m/s": (("km/h", "m/s", 1.0 / 3.6, SURELY),), "m": (("cm", "m", 1e-2, WELL), ("mm", "m", 1e-3, WELL))}
"""The same for what is measured; an input could as well have such a gain."""


def _mistake(kind: str, said: str, change: Change, well: float = WELL) -> _Mistake:
    return _Mistake(said, change if kind == "states" else None, change if kind == "inputs" else None, well)


def _ordered(order: list[int], values: Array) -> Array:
    return values[:, order]


def _scaled(columns: list[int], factor: float, values: Array) -> Array:
    return _rescaled(columns, factor, 0.0, values)


def _rescaled(columns: list[int], factor: float, zero: float, values: Array) -> Array:
    """values (N, n): these columns less their zero, times a number."""
    values = values.copy()
    values[:, columns] = factor * (values[:, columns] - zero)
    return values


def _turned(column: int, factor: float, values: Array) -> Array:
    values = values.copy()
    values[:, column] = 0.5 * math.pi - factor * values[:, column]
    return values
