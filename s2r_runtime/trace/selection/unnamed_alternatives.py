"""Does what was named look more like something that has no name?

The effects that were found on an input, or on an axis, are taken out, and each shape (`input_dynamics`, `state_nonlinearity`) is put in
their place and fitted. With L the log likelihood of the recording, noise re-estimated for each, the smaller of white and coloured, and a
price per number,

    shape wins     L(shape) - L(named) > log(tried / ALPHA) + the price of numbers that it has more than they,
                   and by LITTLE of all that the named effects explain
    it shows       by MORE of that, and some rollout's error is lower by LOWER
    it is told     L(shape) - L(named) > log(tried / TOLD) + the same price, and by LITTLE

A name that loses to a shape that shows is not given: the recording does not look like what it means. Beside one that loses to a shape that
does not, or is behind one that is only told, what the shape depends on is told: the repair is as good, and the name may be wrong. A shape
that has the named effect in it (two lags that are alike) costs a name nothing, as it explains no more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from s2r_runtime.hookspecs import Effect
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.models.forces import axes, lone_speeds
from s2r_runtime.trace.estimation.initial_states import begun, measured
from s2r_runtime.trace.estimation.parameters import bounds_of, values_of
from s2r_runtime.trace.estimation.prediction import acting, covered, first_steps, rms, rollout, rollout_starts, some_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, fitted, gain, without
from s2r_runtime.trace.hypotheses.basis import token_of
from s2r_runtime.trace.hypotheses.input_dynamics import SHAPES, Shape
from s2r_runtime.trace.hypotheses.library import Candidate
from s2r_runtime.trace.hypotheses.state_nonlinearity import STATE_SHAPES, Limit, StateShape
from s2r_runtime.trace.hypotheses.state_nonlinearity import starts as state_starts
from s2r_runtime.trace.selection.acceptance import accepted
from s2r_runtime.trace.selection.scores import at_first_look
from s2r_runtime.trace.selection.screening import screen

ALPHA, TOLD = 1e-3, 0.05
"""Chances that a shape wins against the truth, as far as the likelihood is right, and that it is told beside it."""

MORE = 0.05
"""Of what is explained: less than this is how any model differs from any robot."""

LITTLE = 0.01
"""The same where it takes no name away, and is only told: less than this is how steps are cut."""

LOWER = 0.05
"""As for effects: what lowers no rollout's error by this share, nobody would notice."""

REACHES = 0.3
"""Of what is explained by name: a shape that screening gives less does not come up to it."""

FITTED, BENDS, NEARLY = 3, 2, 0.5
"""Shapes of an input that are fitted, after screening, with memory and without, which must give them that share of what it gives the best:
bends of all kinds are alike, and would leave no place for others.
"""

LEAST = 4.0
"""Nats that screening must give a shape where nothing was named."""

LIMITS = tuple(shape for shape in STATE_SHAPES if isinstance(shape, Limit))
"""An actuator that goes no farther and a tank that overflows look alike; a drag does not look like either."""

STARTS = 600
"""Rollouts that errors are compared on at most."""


SECONDS = ("out", "back", "up", "down", "small", "large", "time_constant")
"""Numbers of shapes that are times."""


@dataclass(frozen=True, eq=False)
class Better:
    """A shape that does. nats: beyond the model without anything on that input, its numbers paid for, which cost `price`. shows: it wins,
    and in some rollout, too, beside the effects that were named. fit: with it.
    """

    token: str
    nats: float
    shows: bool = True
    fit: Fit | None = None
    price: float = 0.0


def better_shape(given: Problem, fit: Fit, horizon: int) -> Better | None:
    """The shape that explains most beyond the effects named on its input, of those that show, if any do; None if none is told."""
    won = [_challenge(given, fit, channel, horizon) for channel in _inputs(given, fit)]
    own = [{fit.model.states[axis.velocity], fit.model.states[axis.position]} for axis in axes(fit.model.nominal)]
    won += [_challenge_on_axis(given, fit, there, horizon) for there in (*own, *({speed} for speed in lone_speeds(fit.model.nominal)))]
    return _first(won)


def _first(won: Sequence[Better | None]) -> Better | None:
    return max((better for better in won if better is not None), key=lambda better: (better.shows, better.nats), default=None)


def best_shape(given: Problem, base: Fit, horizon: int) -> Better | None:
    """The shape that explains most of what a model leaves, on whichever input; None if none would be taken if it were an effect."""
    on = () if given.data.measured_forces else base.model.inputs
    fits = [fit for channel in on for fit in _fits(given, base, channel)]
    fits += _state_fits(given, base, _states(base, STATE_SHAPES))
    tried = len(SHAPES) * len(on) + len(_states(base, STATE_SHAPES))
    found = [(gain(fit, base) - _price(given, fit, base), fit) for fit in fits]
    for nats, fit in sorted(found, key=lambda pair: -pair[0]):
        if nats > 0.0 and accepted(given, fit, base, tried, horizon):
            return Better(_token(fit), nats, fit=fit, price=_price(given, fit, base))
    return None


def _inputs(given: Problem, fit: Fit) -> list[str]:
    """Inputs on which effects were named, if these were commanded."""
    if given.data.measured_forces:
        return []
    named = [fit.model.effects[i] for i in fit.added if fit.model.effects[i].effect.stage == "input"]
    channels = [c for a in named for c in (fit.model.inputs if a.channel == "*" else (a.channel,))]
    return [c for c in dict.fromkeys(channels) if c in fit.model.inputs]  # drag may act on a speed


def _challenge(given: Problem, fit: Fit, channel: str, horizon: int) -> Better | None:
    bare = fit.model
    for i in reversed(fit.added):
        a = bare.effects[i]
        if a.effect.stage == "input" and a.channel in {channel, "*"}:
            bare = without(bare, i)
    base = fitted(given, fit, bare, 1)
    least = REACHES * at_first_look(given, fit, base)
    shapes = _fits(given, base, channel, least, _times(fit, channel), _plays(fit, channel))
    limits = _states(base, LIMITS)
    return _won(given, fit, base, [*shapes, *_state_fits(given, base, limits, least)], len(SHAPES) + len(limits), horizon)


def _challenge_on_axis(given: Problem, fit: Fit, own: set[str], horizon: int) -> Better | None:
    """Of what was named on an axis. own: its speed and position, or a speed that has none."""
    model = fit.model
    there = [i for i in fit.added if model.effects[i].channel in own and model.effects[i].effect.stage != "sensor"]
    if not there:
        return None
    bare = model
    for i in reversed(there):
        bare = without(bare, i)
    base = fitted(given, fit, bare, 1)
    on = [(shape, channel) for shape, channel in _states(base, STATE_SHAPES) if channel in own]
    return _won(given, fit, base, _state_fits(given, base, on, REACHES * at_first_look(given, fit, base)), len(on), horizon)


def _won(given: Problem, fit: Fit, base: Fit, shapes: Sequence[Fit], tried: int, horizon: int) -> Better | None:
    """Of shapes in the place of what was named, the one that does best, if any is told. base: without what was named; tried: how many
    shapes were.
    """
    here = gain(fit, base)
    won: list[Better] = []
    for shape in shapes:
        ahead = gain(shape, base) - here
        beyond = ahead - max(_price(given, shape, fit), 0.0)
        if beyond > math.log(tried / TOLD) and ahead > LITTLE * here:
            shows = beyond > math.log(tried / ALPHA) and ahead > MORE * here and _lower(given, fit, shape, horizon)
            won.append(Better(_token(shape), gain(shape, base) - _price(given, shape, base), shows))
    return _first(won)


def _price(given: Problem, fit: Fit, base: Fit) -> float:
    """Of the numbers that a model has beyond another one (Schwarz)."""
    return 0.5 * math.log(max(len(given.steps), 2)) * (fit.k - base.k)


def _times(fit: Fit, channel: str) -> list[float]:
    """What the effects named on an input take, s."""
    found = []
    for slot, value in zip(fit.free, values_of(fit.model, fit.free).tolist(), strict=True):
        p = bounds_of(fit.model, slot)
        if fit.model.effects[slot.place].channel in {channel, "*"} and p.unit == "s" and p.neutral == 0.0:
            found.append(value)
    return found


def _plays(fit: Fit, channel: str) -> list[float]:
    """How wide the plays named on an input are."""
    named = [fit.model.effects[i] for i in fit.added]
    return [float(a.p["width"]) for a in named if a.effect.name == "input_backlash" and a.channel == channel]


def _fits(
    given: Problem, base: Fit, channel: str, least: float = LEAST, near: Sequence[float] = (), plays: Sequence[float] = ()
) -> list[Fit]:
    """Shapes on one input, beside what the model has, that do best, the best first. least: nats that screening must give them; near:
    times from which some begin, s; plays: how far what is named on the input gives.
    """
    model = base.model
    u = given.data.chains.through(model, [a for a in model.effects if a.effect.stage == "input"])
    end = len(model.effects)
    offered = [
        Candidate(shape.name, channel, end, tuple(AppliedEffect(cast(Effect, shape), channel, p) for p in starts))
        for shape in SHAPES
        if (starts := shape.starts(u, model.nominal, channel, given.data.dt, near, plays))
    ]
    screened, _ = screen(given, base, offered, math.inf) if offered else ([], 0)  # from few starts
    enough = max(least, NEARLY * screened[0].value) if screened else least
    kept = [s for s in screened if s.value > max(enough, 0.0)]
    bends = [s for s in kept if not _remembers(s.start)][:BENDS]
    fits = [fitted(given, base, s.start, 2) for s in [*[s for s in kept if _remembers(s.start)][:FITTED], *bends]]
    return sorted((fit for fit in fits if _outlasts(fit, given.data.dt)), key=lambda fit: -gain(fit, base))


def _states(base: Fit, shapes: Sequence[StateShape]) -> list[tuple[StateShape, str]]:
    """Shapes of states, each with the state that it may be of."""
    return [(shape, channel) for shape in shapes for channel in shape.channels(base.model.nominal)]


def _state_fits(given: Problem, base: Fit, on: Sequence[tuple[StateShape, str]], least: float = LEAST) -> list[Fit]:
    """Shapes of states, beside what the model has, that do best, the best first."""
    end = len(base.model.effects)
    y = given.steps.y0
    offered = [
        Candidate(shape.name, channel, end, tuple(AppliedEffect(cast(Effect, shape), channel, dict(p)) for p in values))
        for shape, channel in on
        if (values := state_starts(shape, y[:, base.model.states.index(channel)]))
    ]
    screened, _ = screen(given, base, offered, math.inf) if offered else ([], 0)
    enough = max(least, NEARLY * screened[0].value) if screened else least
    fits = [fitted(given, base, s.start, 2) for s in screened[:FITTED] if s.value > max(enough, 0.0)]
    return sorted(fits, key=lambda fit: -gain(fit, base))


def _remembers(model: ComposedModel) -> bool:
    """Whether the last effect of a model, a shape, has memory."""
    return cast(Shape, model.effects[-1].effect).memory


def _outlasts(fit: Fit, dt: float) -> bool:
    """False for memory of less than a step: that is how steps were cut, and when things were stamped."""
    p = fit.model.effects[-1].p
    times = [p[name] for name in SECONDS if name in p] + ([1.0 / p["rate"]] if "rate" in p else [])
    return not times or max(times) > dt


def _token(fit: Fit) -> str:
    """What the last effect of a model, a shape, depends on."""
    last = fit.model.effects[-1]
    if last.channel in fit.model.states:
        return token_of(fit.model, last.channel)
    if getattr(last.effect, "with_time", False):
        return f"time*{last.channel}"
    memory = last.effect.hidden(1, fit.model.nominal, last.channel, fit.model.dt, last.p).size > 0
    return f"memory({last.channel})" if memory else last.channel


def _lower(given: Problem, named: Fit, shape: Fit, horizon: int) -> bool:
    """Whether some rollout's error is lower under the shape, where nothing was left out."""
    _, there = covered(given.steps, int(first_steps(given.data)[-1]))
    pair = [(fit.model, acting(fit.model, given.data), begun(given, fit)) for fit in (named, shape)]
    for ahead in sorted({1, max(1, horizon // 4), horizon}):
        starts = some_of(rollout_starts(given.data, ahead, within=there), ahead, STARTS)
        if len(starts) < 10:
            continue
        errors = [rollout(m, given.data, act, starts, ahead, begun=begin).error for m, act, begin in pair]
        before, after = (rms(measured(given.data, e)) for e in errors)
        if np.any(before > (1.0 + LOWER) * after):
            return True
    return False
