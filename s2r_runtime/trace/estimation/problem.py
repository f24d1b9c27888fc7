"""How well a composed model explains the transitions: its parameters, its own noise, its log likelihood.

    z = C(L^-1 r)            whitened by the noise that the model itself leaves (`noise`), then by its autoregression
    log likelihood           sum log density(z) - log|L| - n sum log scale

`white` is that with C left out, `coloured` with it: a rival that says "just more noise" or "coloured noise" has the same means as the
model with an effect. Parameters are refined by Gauss-Newton with the weights of the density, damped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.data.gridding import coarse
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.initial_states import retold
from s2r_runtime.trace.estimation.noise import Colour, Noise, Whitener
from s2r_runtime.trace.estimation.parameters import Added, Free, Slot, bounds_of, free_of, inside, values_of, with_values
from s2r_runtime.trace.estimation.prediction import TOGETHER, Steps, acting, advanced, near, predicted, side_by_side, state_jacobian
from s2r_runtime.trace.estimation.prediction_cache import Known, kept
from s2r_runtime.trace.estimation.speed_noise import BEYOND

Array = NDArray[np.float64]

EXACT = 3e-4
"""Least standard deviation of noise, as a share of how far the state moves in a step: no model is meant more exactly than that, and data
without noise stay solvable."""

WIDEST = 5.0
"""Cap of the widening of intervals: beyond it the model is wrong and no interval is right."""

SCORE_BLOCKS = 10
"""Blocks of time whose scores are compared: long against what noise remembers, many enough to tell."""

ITERATIONS = 8
NEXT = 0.02
"""Nats that the next step of a refinement must promise, and the last one have brought."""

ROUNDS = 6
SETTLED = 0.3
"""Nats below which another round of parameters and noise is not worth it."""

FLOORED = 2.0
"""Of its floor: process noise below it is not told from that."""

RETOLD = 2
"""Times that hidden states are told anew under a model, each about where they were: from a tenth off to a ten-thousandth."""

ABOUT, STAYS = 4, 1e-3
"""Rounds of states and numbers in turn, at most; share of itself by which no number moves any more."""


@dataclass(frozen=True)
class Problem:
    """Transitions that a model is to explain. floor: least variances of noise. searches: what was tried beside which model (`scores`).
    blind: how fits foretell what they did not see (`stepwise`).
    """

    data: Dataset
    steps: Steps
    floor: Noise
    searches: dict[tuple[object, ...], object] = field(default_factory=dict, repr=False, compare=False)
    blind: dict[tuple[object, ...], object] = field(default_factory=dict, init=False, repr=False, compare=False)
    known: Known = field(default_factory=Known, init=False, repr=False, compare=False)

    @property
    def bends(self) -> bool:
        """Whether states that were not measured follow a law that may bend: each model is asked about where it has them."""
        made = self.data.reconstruction
        return made is not None and made.hidden

    @cached_property
    def coarse(self) -> Problem:
        """The same with steps in fewer parts, for a first look: most of what it takes is to work out what acts in each."""
        data = coarse(self.data)
        return self if data is self.data else replace(self, data=data)

    def predicted(self, model: ComposedModel) -> Array:
        """Where a model leads, (n, nx)."""
        known = self.known.of(model)
        if known.predicted is None:
            known.predicted = kept(predicted(model, self.steps, acting(model, self.data)))
        return known.predicted

    def residual(self, model: ComposedModel) -> Array:
        """What a model leaves, (n, nx)."""
        return model.difference(self.steps.y1, self.predicted(model))

    def jacobian(self, model: ComposedModel) -> Array:
        """F of a model, (n, nx, nx)."""
        known = self.known.of(model)
        if known.jacobian is None:
            known.jacobian = kept(state_jacobian(model, self.steps, acting(model, self.data)))
        return known.jacobian


@dataclass(frozen=True)
class Fit:
    """A model on a problem. free: what was fitted; z: (n, nx); white, coloured: log likelihoods."""

    model: ComposedModel
    free: Free
    noise: Noise
    colour: Colour
    whiten: Whitener
    z: Array
    white: float
    coloured: float

    @property
    def k(self) -> int:
        """Number of fitted parameters, also of those that these data hardly feel; an effect without any counts as one, and where in time or
        in frequency something is counts as two: it was looked for everywhere (N. Zhang, D. Siegmund, Biometrics 63, 2007: log n).
        """
        named = {slot.place for slot in self.free}
        return len(self.free) + sum(1 for i in self.added if i not in named) + sum(sought(self.model, slot) for slot in self.free)

    @property
    def added(self) -> tuple[int, ...]:
        """Places of the effects that the data, not the user, put there."""
        return tuple(i for i, a in enumerate(self.model.effects) if isinstance(a, Added))


def sought(model: ComposedModel, slot: Slot) -> bool:
    """Whether a number says when, or how often, something happens that does not happen under the model without it."""
    p = bounds_of(model, slot)
    return getattr(model.effects[slot.place].effect, "timed", False) and p.unit in {"s", "Hz"} and p.neutral is None


def gain(fit: Fit, base: Fit) -> float:
    """Nats that `fit` explains beyond `base`, noise re-estimated under both, white and coloured: the smaller one."""
    return min(fit.white - base.white, fit.coloured - base.coloured)


def problem(data: Dataset, steps: Steps) -> Problem:
    """Of these transitions."""
    moved = np.std(steps.y1 - steps.y0, axis=0) + 1e-9 * np.std(steps.y0, axis=0) + 1e-12
    rounding = np.array([noises.quantum(*columns) for columns in zip(steps.y0.T, steps.y1.T, strict=True)]) ** 2 / 12.0
    least = np.maximum((EXACT * moved) ** 2, rounding)
    pairs = data.axes_without_speed
    for _, v in pairs:
        least[v] = (BEYOND * max(float(np.sqrt(np.mean(steps.y0[:, v] ** 2))), 1e-12)) ** 2 if len(steps) else 1.0
    return Problem(data, steps, Noise((EXACT * moved) ** 2, least, pairs))


def evaluate(given: Problem, model: ComposedModel, near: Noise | None = None) -> Fit:
    """The model as it stands, with its own noise. near: noise from which its estimate begins."""
    fit = _evaluated(given, model, near)
    for _ in range(RETOLD if given.bends else 0):
        given = Problem(given.data, retold(given, fit), given.floor)
        fit = _evaluated(given, model, fit.noise)
    return fit


def _evaluated(given: Problem, model: ComposedModel, near: Noise | None) -> Fit:
    """About where the states stand that were not measured."""
    r, f = given.residual(model), given.jacobian(model)
    level = noises.estimate(r, f, given.steps.joined, given.floor, near)
    whiten = Whitener(level, f, given.steps.joined)
    z = whiten(r)
    colour = noises.colour(z, given.steps.joined)
    white = float(np.sum(noises.log_density(z))) - whiten.logdet
    coloured = noises.log_likelihood(z, whiten, colour, given.steps.joined)
    return Fit(model, free_of(model), level, colour, whiten, z, white, coloured)


def under_noise(given: Problem, model: ComposedModel, level: Noise) -> Fit:
    """The model under a noise that is not its own."""
    whiten = Whitener(level, given.jacobian(model), given.steps.joined)
    z = whiten(given.residual(model))
    told = float(np.sum(noises.log_density(z))) - whiten.logdet
    return Fit(model, free_of(model), level, noises.no_colour(z.shape[1]), whiten, z, told, told)


def objective(given: Problem, fit: Fit, model: ComposedModel) -> Array:
    """z (n, nx) of a model under the noise of a fit."""
    return _whitened(given, fit, given.residual(model))


def _whitened(given: Problem, fit: Fit, r: Array) -> Array:
    """z (n, nx) of a residual (n, nx) under the noise of a fit."""
    return fit.colour(fit.whiten(r), given.steps.joined)


def foretold(given: Problem, model: ComposedModel) -> Array | None:
    """What a model predicts, (n, nx); None where a user's own gives no numbers at such values, or absurd ones."""
    try:
        there = advanced(model, given.steps.y0, acting(model, given.data), given.steps.place)
    except ConfigError:
        return None
    return there if near(there, given.steps.farthest) or not np.any(np.abs(there) > given.steps.farthest) else None


def foretold_by(given: Problem, models: Sequence[ComposedModel]) -> list[Array | None]:
    """The same of each. Those that differ in what acts only take their steps together, as many as are few enough to gain by it."""
    found: list[Array | None] = [None] * len(models)
    alike: dict[tuple[int, ...], list[int]] = {}
    for i, model in enumerate(models):
        on_step = (id(a) for a in model.effects if a.effect.stage != "input" or hasattr(a.effect, "pushes"))  # drag is either
        alike.setdefault((id(model.nominal), *on_step), []).append(i)
    many = max(1, TOGETHER // max(given.steps.y0.size, 1))
    for those in alike.values():
        for some in (those[k : k + many] for k in range(0, len(those), many)):
            for i, there in zip(some, _foretold_together(given, [models[i] for i in some]), strict=True):
                found[i] = there
    return found


def predicted_by(given: Problem, models: Sequence[ComposedModel]) -> list[Array]:
    """Where each leads, (n, nx), as `Problem.predicted`, of many that are asked for once."""
    found = foretold_by(given, models)
    return [given.predicted(model) if there is None else there for model, there in zip(models, found, strict=True)]


def _foretold_together(given: Problem, models: Sequence[ComposedModel]) -> Iterable[Array | None]:
    """Of models with the same effects on the step."""
    n, place = len(given.steps), given.steps.place
    try:
        if len(models) > 1:
            act = side_by_side([acting(model, given.data).over(place) for model in models])
            there = advanced(models[0], np.tile(given.steps.y0, (len(models), 1)), act, slice(None)).reshape(len(models), n, -1)
            if near(there, given.steps.farthest):
                return list(there)
            beyond = np.any(np.abs(there) > given.steps.farthest, axis=(1, 2))
            return [None if far else one for far, one in zip(beyond.tolist(), there, strict=True)]
    except ConfigError:  # somebody's own model takes no step there for one of them
        pass
    return (foretold(given, model) for model in models)


def sensitivities(given: Problem, fit: Fit, model: ComposedModel, free: Free) -> Array:
    """dz/dp, (n nx, k), under the noise of a fit."""
    n, nx = given.steps.y0.shape
    if not free:
        return np.zeros((n * nx, 0))
    moved = slopes(given, model, free)
    return fit.colour(fit.whiten(moved), given.steps.joined).reshape(n * nx, len(free))


def slopes(given: Problem, model: ComposedModel, free: Free) -> Array:
    """d(residual)/dp, (n, nx, k), one-sided differences inside the bounds."""
    known = given.known.of(model).slopes
    if free not in known:
        known[free] = kept(_slopes(given, model, free))
    return known[free]


def _slopes(given: Problem, model: ComposedModel, free: Free) -> Array:
    n, nx = given.steps.y0.shape
    here = given.predicted(model)
    now, away = values_of(model, free), np.array(_differences(given, model, free))
    moved = np.zeros((n, nx, len(free)))
    open_yet = list(range(len(free)))
    for signed in (away, -away):  # to the other side, where a bound or somebody's own model does not let it go to one
        others = [(j, with_values(model, free, now + np.where(np.arange(len(free)) == j, signed, 0.0))) for j in open_yet]
        allowed = [(j, other) for j, other in others if other is not None]
        for (j, _), beyond in zip(allowed, foretold_by(given, [other for _, other in allowed]), strict=True):
            if beyond is not None:
                moved[:, :, j] = (beyond - here) / -signed[j]
                open_yet.remove(j)
    return moved


def scatter(given: Problem, fit: Fit) -> Array:
    """(k,) how much more than white noise the scores of blocks of time scatter, a ratio of standard deviations, of what was fitted."""
    z = objective(given, fit, fit.model)
    j = sensitivities(given, fit, fit.model, fit.free)
    w = noises.weight(z).ravel()
    covariance = np.linalg.pinv(j.T @ (j * w[:, None]), rcond=1e-12, hermitian=True)
    return widening(j * (w * z.ravel())[:, None], np.asarray(covariance), z.shape[1], SCORE_BLOCKS)


def widening(scores: Array, covariance: Array, nx: int, blocks: int) -> Array:
    """(k,) ratio of the sandwich's standard deviation to the plain one, within [1, WIDEST]. scores: (n nx, k), in order of time.

    Where noise wanders more slowly than the likelihood knows, the scores of blocks of time scatter more than it says.
    """
    n = len(scores) // nx
    edges = (np.arange(blocks + 1) * n // blocks) * nx
    sums = np.stack([scores[a:b].sum(axis=0) for a, b in pairwise(edges.tolist())])
    sandwich = covariance @ (sums.T @ sums) @ covariance
    ratio = np.sqrt(np.diag(sandwich) / np.maximum(np.diag(covariance), 1e-300))
    return np.asarray(np.clip(ratio, 1.0, WIDEST))


def _differences(given: Problem, model: ComposedModel, free: Free) -> list[float]:
    """Wide enough that a kink is seen, small against the value."""
    steps = []
    span = float(np.ptp(given.steps.t)) + given.data.dt
    for slot, value in zip(free, values_of(model, free).tolist(), strict=True):
        p = bounds_of(model, slot)
        if p.unit == "Hz":
            steps.append(1e-3 / span)  # moves the phase at the end of the data by a thousandth of a turn, whatever the frequency
            continue
        usual = given.data.dt if p.unit == "s" else 1e-3
        steps.append((1e-3 if p.kink else 1e-4) * max(abs(value - (p.neutral or 0.0)), usual))
    return steps


def refine(given: Problem, fit: Fit, model: ComposedModel, free: Free | None = None, iterations: int = ITERATIONS) -> ComposedModel:
    """Parameters that maximise the likelihood under the noise of `fit`, from where the model stands."""
    free = free_of(model) if free is None else free
    if not free:
        return model
    z = objective(given, fit, model)
    best = float(np.sum(noises.log_density(z)))
    damping = 1e-4
    for _ in range(iterations):
        j = sensitivities(given, fit, model, free)
        w = noises.weight(z).ravel()
        normal, slope = j.T @ (j * w[:, None]), j.T @ (w * z.ravel())
        before = best
        while damping < 1e6:
            damped = normal + np.diag(damping * np.diag(normal) + 1e-12 * np.max(np.diag(normal), initial=1e-300))
            step = np.linalg.solve(damped, slope)
            if slope @ step - 0.5 * step @ normal @ step < NEXT:  # and with more damping, less
                break
            other = with_values(model, free, inside(model, free, values_of(model, free) - step))
            if other is not None:
                there = foretold(given, other)
                z_other = z if there is None else _whitened(given, fit, other.difference(given.steps.y1, there))
                reached = float(np.sum(noises.log_density(z_other)))
                if there is not None and reached > best:
                    model, z, best, damping = other, z_other, reached, damping / 10.0
                    given.known.of(model).predicted = kept(there)
                    break
            damping *= 10.0
        damping = max(damping, 1e-8)
        if best - before < NEXT:
            break
    return model


def fitted(
    given: Problem, start: Fit, model: ComposedModel, rounds: int = ROUNDS, hopeless: Callable[[Fit], bool] = lambda fit: False
) -> Fit:
    """Parameters and noise in turn, until neither gains. start: whose noise to begin with. hopeless: what is not gone on with."""
    fit = replace(start, colour=noises.no_colour(start.z.shape[1]))  # what looks like colour may be what the effect explains
    for turn in range(rounds):
        model = _on_the_highest_step(given, fit, refine(given, fit, model))
        before, fit = fit, evaluate(given, model, fit.noise)
        if (turn and fit.white - before.white < SETTLED) or hopeless(fit):
            break
    return fit


def _on_the_highest_step(given: Problem, fit: Fit, model: ComposedModel) -> ComposedModel:
    """The model with its delays where the likelihood is highest, row by row of the inputs. A state that is set to its input at once (the
    speed of a wheel) is the same for all delays between two such rows: the likelihood has steps, and no slope says where to go.
    """
    slots = [slot for slot in free_of(model) if _shifts_what_is_set(model, slot)]
    if not slots:
        return model
    row, began = given.data.dt / given.data.substeps, model
    best = float(np.sum(noises.log_density(objective(given, fit, model))))
    for slot in slots:
        for way in (row, -row):
            while (other := with_values(model, (slot,), inside(model, (slot,), values_of(model, (slot,)) + way))) is not None:
                there = foretold(given, other)
                z = None if there is None else _whitened(given, fit, other.difference(given.steps.y1, there))
                reached = best if z is None else float(np.sum(noises.log_density(z)))
                if not reached > best + NEXT:  # nor where it is no number
                    break
                model, best = other, reached
    return model if model is began else refine(given, fit, model)


def _shifts_what_is_set(model: ComposedModel, slot: Slot) -> bool:
    """Whether a number is the delay of an input that states are set to at once."""
    a, there = model.effects[slot.place], {*getattr(model.nominal, "reached", {}).values()}
    return getattr(a.effect, "shift", False) and (a.channel in there or (a.channel == "*" and bool(there)))


def settled(given: Problem, fit: Fit) -> Fit:
    """The same with its numbers under the law of what it leaves, where that wanders: nearer, and their intervals are those of that law."""
    law = _law(given, fit)
    if law is None or not fit.free:
        return fit
    again = evaluate(given, refine(given, replace(fit, colour=law), fit.model), fit.noise)
    return replace(again, colour=_law(given, again) or again.colour)


def _law(given: Problem, fit: Fit) -> Colour | None:
    """Of what wanders, for numbers."""
    law = noises.wandering(fit.z, given.steps.joined, fit.colour)
    if law is None:
        return None
    law = noises.no_steadier(law, fit.colour, fit.noise.q <= FLOORED * given.floor.q)
    return law if np.any(law.slow) else None


def about(given: Problem, fit: Fit) -> Problem:
    """The same transitions, taken about where a model says, with its noise, that the robot was: with e_k = y_k - x_k (`initial_states`),

        y0 -> x,   y1 -> y1 - F e,   so that  y1 (-) f(y0)  becomes  y1 (-) f(x) - F e:

    the same to first order, with the same covariance. What bends with the state (dry friction near standstill, drag, a curve) is asked
    where the robot was, not where its sensors were off to: noise in a regressor makes a curve look flatter and wider than it is (R. J.
    Carroll et al., Measurement error in nonlinear models, 2006; the iterated Kalman smoother of A. Jazwinski, Stochastic processes and
    filtering theory, 1970).
    """
    steps, act = given.steps, acting(fit.model, given.data)
    f = given.jacobian(fit.model)
    s = fit.whiten.back(fit.z * noises.weight(fit.z))
    before = np.where(steps.joined[:, None], np.concatenate([np.zeros((1, s.shape[1])), s[:-1]]), 0.0)
    error = fit.noise.r * (before - np.einsum("kji,kj->ki", f, s))
    begin = replace(steps, y0=steps.y0 - error)
    moved = np.einsum("kij,kj->ki", state_jacobian(fit.model, begin, act), error)
    return replace(given, steps=replace(begin, y1=steps.y1 - moved))


def nearer(given: Problem, fit: Fit, base: Fit) -> float:
    """Nats that a fit explains beyond another one more than `gain` tells, where each is asked about where the robot was (`about`): a force
    that bends with a noisy state looks like noise of the process else. 0 where states were reconstructed: those are smoothed already.
    """
    if given.floor.axes or given.data.reconstruction is not None:
        return 0.0
    one, other = (_where_it_was(given, f)[1] for f in (fit, base))
    white, coloured = one.white - max(other.white, base.white), one.coloured - max(other.coloured, base.coloured)
    return max(min(white, coloured) - gain(fit, base), 0.0)


def _where_it_was(given: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """The transitions about where the robot was, and the fit on them, states and numbers in turn."""
    problem = given
    for _ in range(ABOUT if fit.free else 1):
        before = values_of(fit.model, fit.free)
        problem = about(given, evaluate(given, fit.model, fit.noise))
        fit = fitted(problem, evaluate(problem, fit.model, fit.noise), fit.model, 2)
        if np.allclose(values_of(fit.model, fit.free), before, rtol=STAYS, atol=0.0):
            break
    return problem, fit


def told(given: Problem, fit: Fit) -> tuple[Fit, Problem, Fit]:
    """The fit with its numbers as they are told; the problem on which they are (`about`), and the fit on that."""
    turned = [
        math.remainder(v, math.tau) if slot.name == "phase" else v for slot, v in zip(fit.free, values_of(fit.model, fit.free), strict=True)
    ]
    fit = replace(fit, model=with_values(fit.model, fit.free, np.array(turned)) or fit.model)  # a sine's phase is one of a turn
    if given.floor.axes or not fit.free:  # where speeds were not measured, the model is stepped from smoothed ones as it is
        fit = settled(given, fit)
        return fit, given, fit
    problem, near = _where_it_was(given, fit)
    near = settled(problem, near)
    fit = evaluate(given, near.model, near.noise)
    return replace(fit, colour=noises.wandering(fit.z, given.steps.joined, fit.colour) or fit.colour), problem, near


def plainly(given: Problem, fit: Fit) -> Fit:
    """The same model with parameters under white noise, where speeds were not measured; else as it is.

    There Q has the colour of noise already, and what is left is mostly what every model lacks of a robot at high frequencies (actuators,
    bending). Taken for colour, it would make parameters follow those frequencies, where they matter least.
    """
    if not given.floor.axes:
        return fit
    best = fit
    for _ in range(ROUNDS):
        model = refine(given, replace(best, colour=noises.no_colour(best.z.shape[1])), best.model)
        before, best = best, evaluate(given, model, best.noise)
        if best.white - before.white < SETTLED:
            break
    return best


def insert(model: ComposedModel, effect: AppliedEffect, place: int) -> ComposedModel:
    """The model with an added effect at a place of its list."""
    added = Added(effect.effect, effect.channel, effect.p)
    return replace(model, effects=(*model.effects[:place], added, *model.effects[place:]))


def without(model: ComposedModel, place: int) -> ComposedModel:
    """The model less one effect; with the one that was given in its place, if there was one."""
    a = model.effects[place]
    given = (a.instead,) if isinstance(a, Added) and a.instead is not None else ()
    return replace(model, effects=(*model.effects[:place], *given, *model.effects[place + 1 :]))
