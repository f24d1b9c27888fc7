"""Which other effects do these data leave possible?

A rival replaces one effect of the chosen model and explains as much: its log likelihood, noise re-estimated, on what was fitted and on what
was held out, is within CLOSE of the best one's. What its parameters cost counts little here, being simpler is a reason to prefer, not to
know: it must be beyond SURELY. If the best one has more numbers, one that comes within CLOSE with numbers paid for is a rival, too.

A richer effect that has fitted itself to the chosen one (a gain by sign with both gains alike) says the same thing and is no rival. That is
seen on inputs and states that these data need not have: values between the least and the largest seen, and zero, held short and
long, from anywhere about where the robot was, in any direction, at times over the whole recording.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.effects.classes import canonical
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import Dataset, Run
from s2r_runtime.trace.estimation.parameters import Added, slots_of
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import SETTLED, Fit, Problem, evaluate, fitted, foretold, gain, problem, scatter, without
from s2r_runtime.trace.hypotheses.library import candidates
from s2r_runtime.trace.selection.scores import STRICT, Scored, at_first_look, best_candidates, limited, name_of

Array = NDArray[np.float64]

CLOSE = 3.0
"""Nats of likelihood within which rivals cannot be told apart: odds of 20 to 1."""

SURELY = 6.0
"""The same with the numbers paid for, from which on a rival is out however near it comes: four numbers that were looked for everywhere come
near to what one foretells, but that one did foretell it. Odds of 400 to 1: a price of numbers is known to a few nats.
"""

NEAR = 15.0
"""Nats of likelihood within which what was not fitted decides: where noise wanders, a fit may prefer by that much what foretells less."""

LOOSEST = 6.0
"""Noise that wanders makes differences of likelihood larger than they mean, up to this."""

FITTED = 12
"""Candidates that are fitted as rivals, after screening."""

ALIKE = 0.05
"""Mean square of what two models differ in, as a share of what the effect itself does, below which a richer one is the same thing."""

BETTER = 0.5
"""Of how far the best fit is at worst from its rivals: one that is not that much nearer to them does not take its place."""

BEYOND = 3.0
"""Times the largest input of these data to which the next drive may go, where little was asked."""

EQUAL = 0.0025
"""As ALIKE, for numbers of one effect that agree: to a twentieth of what it does."""

ITSELF = 1e-4
"""The same, for an effect that stays what it is with a number less: to a hundredth. Friction that is a fortieth more one way exists."""

IDLE = 1e-3
"""Of what the strongest of several models adds, mean square: one that adds no more does nothing there."""

PROBES, PROBE_STEPS = 8, 120
"""Runs and steps of the rich inputs."""


def rivals_of(given: Problem, fit: Fit, place: int) -> list[Scored]:
    """Models with another effect at this place, of which the likelihood says nearly the same."""
    found: list[Scored] = []
    rich: _Rich | None = None
    mine = name_of(fit.model.effects[place])
    base = fitted(given, fit, without(fit.model, place), 1)
    here = gain(fit, base)
    itself = Scored(*mine, here - STRICT.price(fit.k - base.k, len(given.steps)), fit)
    for s in best_candidates(given, base, FITTED, against=at_first_look(given, fit, base) - NEAR, known=itself)[0]:
        if s.fit is None or (s.name, s.channel) == mine or not limited(s.fit) or not _contends(given, s.fit, fit, base):
            continue
        numberless = not slots_of(fit.model.effects[place], place)
        if numberless and _coincidence(here, gain(s.fit, base)) > CLOSE:
            continue
        if s.fit.k > fit.k or numberless:
            rich = rich or _rich(given, fit.model)
            if rich.same(s.fit.model, fit.model, base.model):
                continue
        found.append(s)
    return found


def _contends(given: Problem, other: Fit, fit: Fit, base: Fit) -> bool:
    """Whether it is near enough for what was not fitted to decide, its numbers paid for or not."""
    behind = gain(fit, base) - gain(other, base)
    return behind + min(STRICT.price(other.k - fit.k, len(given.steps)), 0.0) <= NEAR


def tied(given: Problem, fit: Fit, found: list[Scored], ahead: Sequence[float]) -> tuple[Fit, list[Scored]]:
    """The likeliest explanation on all of the recording, and those that tie with it. ahead: nats of each, `fit` first, by which it
    foretells what was not fitted.
    """
    fits = [fit, *(s.fit for s in found if s.fit is not None)]
    wide = min(max([1.0, *(scatter(given, fit) ** 2)]), LOOSEST) if fit.free else 1.0
    nats = np.array([gain(one, fit) + more for one, more in zip(fits, ahead, strict=True)])
    paid = nats - np.array([STRICT.price(one.k - fit.k, len(given.steps)) for one in fits])
    best = int(np.argmax(paid)) if np.max(paid) > paid[0] + SETTLED else 0
    behind, beaten = nats[best] - nats, paid[best] - paid
    near = (beaten <= CLOSE * wide) | ((behind <= CLOSE * wide) & (beaten <= SURELY * wide))
    white = np.array([one.white - STRICT.price(one.k - fit.k, len(given.steps)) for one in fits])
    near |= (white - white[best] > NEAR) & (behind <= NEAR)  # by noise without a memory it is the other way round, and by far
    left = [i for i in np.flatnonzero(near).tolist() if i != best]
    return fits[best], [found[i - 1] if i else Scored(*only_in(fit, fits[best]), found[0].score, fit) for i in left]


def only_in(fit: Fit, other: Fit) -> tuple[str, str]:
    """The effect of one model that the other does not have."""
    there = {name_of(other.model.effects[place]) for place in other.added}
    return next(name for place in fit.added if (name := name_of(fit.model.effects[place])) not in there)


def _coincidence(mine: float, other: float) -> float:
    """Nats for an effect that has no number (how a model is integrated) against one whose number happens to come out as what that does: a
    Bayes factor, that number being anything from minus to plus twice what it is. mine, other: gains of the two. (With the number known to
    1 / sqrt(2 gain) of itself: 4 sqrt(2 gain) / sqrt(2 pi); H. Jeffreys, Theory of Probability, 5.2.)
    """
    return mine - other + math.log(4.0 * math.sqrt(max(other, 1e-9) / math.pi))


def simplified(given: Problem, fit: Fit) -> Fit:
    """With a simpler effect in the place of one that does the same, or so nearly that it would not be noticed: one without a number where a
    number comes out as what that does (every robot moves on arcs, and few slide sideways by just half a step), one with one number
    where several agree.
    """
    for place in fit.added:
        a = fit.model.effects[place]
        instead = _agreeing(fit, place) if hasattr(a.effect, "simpler") else _without_number(given, fit, place)
        rich = _rich(given, fit.model) if instead else None
        for model in instead:
            near = _near(a, model)
            if rich is not None and rich.same(model, fit.model, without(fit.model, place), near):
                return simplified(given, fitted(given, evaluate(given, model), model))
    return fit


def _near(a: AppliedEffect, model: ComposedModel) -> float:
    """How near a model must come that has a simpler effect instead."""
    if not hasattr(a.effect, "simpler"):
        return ALIKE
    return ITSELF if any(isinstance(other, Added) and name_of(other) == name_of(a) for other in model.effects) else EQUAL


def _agreeing(fit: Fit, place: int) -> list[ComposedModel]:
    """The model with the simpler effect that an effect names."""
    a = fit.model.effects[place]
    name, p = a.effect.simpler(a.p)  # type: ignore[attr-defined]
    name, channel = canonical(fit.model.for_effects, name, a.channel)
    effect = registry().get("effects", name)
    others = {name_of(other) for i, other in enumerate(fit.model.effects) if i != place}
    if p == a.p or (name, channel) in others or not set(p) <= {q.name for q in effect.parameters}:
        return []
    return [replace(fit.model, effects=(*fit.model.effects[:place], Added(effect, channel, p), *fit.model.effects[place + 1 :]))]


def _without_number(given: Problem, fit: Fit, place: int) -> list[ComposedModel]:
    """The model with each effect that has no number in the place of one that has one."""
    a = fit.model.effects[place]
    if len(slots_of(a, place)) != 1 or a.effect.stage != "step":
        return []
    less = without(fit.model, place)
    found = candidates(less, given.data)
    return [model for c in found if not any(slots_of(start, 0) for start in c.starts) for model in c.models(less)]


def representative(given: Problem, fit: Fit, found: list[Scored]) -> tuple[Fit, list[Scored], bool]:
    """Of explanations that tie, the one to go on with, and the others: that which is at worst least far from what the others do, as a share
    of what they do, on inputs as large as these and BEYOND them. Where a limit, a deadband and a gain say the same, a gain is wrong by
    least elsewhere. One that is behind by CLOSE with its numbers paid for is not gone on with. And whether even that one may be farther off
    there than none at all.

    Nothing changes where more than one effect has rivals.
    """
    n = len(given.steps)
    tied = [s.fit for s in found if s.fit is not None]
    mine = {name_of(fit.model.effects[place]): place for place in fit.added}
    gone = {name for other in tied for name in mine.keys() - {name_of(other.model.effects[p]) for p in other.added}}
    if len(gone) != 1:
        return fit, found, False
    name = gone.pop()
    less = without(fit.model, mine[name])
    models = [fit.model, *(other.model for other in tied)]
    worst = np.max([_rich(given, fit.model, reach).worst(models, less) for reach in (1.0, BEYOND)], axis=0)
    dear = [STRICT.price(one.k - fit.k, n) - gain(one, fit) > CLOSE for one in (fit, *tied)]
    best = int(np.argmin(np.where(dear, np.inf, worst)))
    if best == 0 or not np.all(np.isfinite(worst)) or worst[best] > BETTER * worst[0]:
        return fit, found, not worst[0] <= 1.0  # what cannot be told is no less a risk
    chosen = tied[best - 1]
    return chosen, [Scored(*name, found[0].score, fit), *(s for s in found if s.fit is not chosen)], bool(worst[best] > 1.0)


@dataclass(frozen=True)
class _Rich:
    """Rich inputs on a robot, from states all about. scale: (nx,) of its steps."""

    data: Dataset
    scale: Array

    def same(self, one: ComposedModel, other: ComposedModel, less: ComposedModel, near: float = ALIKE) -> bool:
        """Whether two models differ by next to nothing of what the other one adds to `less`. False where that cannot be told."""
        return self.apart(one, other) <= near * self.apart(other, less)

    def worst(self, models: Sequence[ComposedModel], less: ComposedModel) -> Array:
        """(m,) of each model, how far it is at most from one of them, as a share of what that one adds to `less`; NaN if unknown. What does
        nothing on these inputs (a limit that they do not reach) says nothing there of the others.
        """
        done = [self.apart(model, less) for model in models]
        least = IDLE * float(np.max(done))  # NaN if any is
        asked = [(other, size) for other, size in zip(models, done, strict=True) if not size <= least]
        return np.array([np.max([self.apart(one, other) / size for other, size in asked], initial=0.0) for one in models])

    def apart(self, one: ComposedModel, other: ComposedModel) -> float:
        """Mean square difference of their steps, on the scale of the steps themselves; NaN where a user's own model does not step there."""
        given = problem(self.data, steps_of(self.data))
        a, b = (foretold(given, m) for m in (one, other))
        return math.nan if a is None or b is None else float(np.mean((one.difference(a, b) / self.scale) ** 2))


def _rich(given: Problem, model: ComposedModel, reach: float = 1.0) -> _Rich:
    rng = np.random.default_rng(0)
    source, steps = given.data, given.steps
    asked = np.concatenate([run.u for run in source.runs])
    least, most = np.minimum(np.min(asked, axis=0), 0.0), np.maximum(np.max(asked, axis=0), 0.0)
    if reach > 1.0:
        most = reach * np.maximum(-least, most)
        least = -most
    low, high = np.min(steps.y0, axis=0), np.max(steps.y0, axis=0)
    low, high = low - 0.5 * (high - low), high + 0.5 * (high - low)
    low[model.angle_columns], high[model.angle_columns] = -np.pi, np.pi
    runs = []
    for start in np.linspace(float(steps.t[0]), float(steps.t[-1]), PROBES):
        hold = np.maximum(1, np.rint(10.0 ** rng.uniform(0.0, 1.6, PROBE_STEPS)).astype(int))
        u = np.repeat(rng.uniform(least, most, (PROBE_STEPS, len(most))), hold, axis=0)[:PROBE_STEPS]
        y = rng.uniform(low, high, (PROBE_STEPS + 1, len(low)))
        runs.append(Run(float(start), y, np.repeat(u, source.substeps, axis=0)))
    made = Dataset(source.states, source.inputs, source.dt, source.substeps, tuple(runs), 0, "rich inputs")
    return _Rich(made, np.sqrt(np.mean((steps.y1 - steps.y0) ** 2, axis=0)) + 1e-12)
