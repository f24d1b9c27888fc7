"""Error of a model on transitions that its fit never saw: one step, rollouts, the gap, and what noise alone would make of them.

rollout_rms is the error at the end of rollouts of the stated horizon, started at every row that has one ahead of it (docs/tracing.md).
`Judged` holds the arrays behind the numbers, for plots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import S2RError
from s2r_runtime.evidence.bounds import scenario_confidence
from s2r_runtime.evidence.gap import different, discrepancy, hold_residuals, residuals
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.recordings.transitions import Transitions
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.data.split import FEWEST_RUNS
from s2r_runtime.trace.estimation.initial_states import begun, measured, uncertain
from s2r_runtime.trace.estimation.inverse_dynamics import Inverse, input_relative, inverse
from s2r_runtime.trace.estimation.noise import Noise, Past
from s2r_runtime.trace.estimation.prediction import (
    Acting,
    Steps,
    acting,
    farthest,
    no_farther,
    residual,
    rms,
    rollout,
    rollout_starts,
    some_of,
    state_jacobian,
    wherever,
)
from s2r_runtime.trace.estimation.problem import Fit, evaluate, gain, problem

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Kind = Literal["ball", "box"]

EPSILON = 0.01
"""Of the gap that is reported; its beta follows from the number of transitions."""

FLOOR_STARTS = 2000
"""Simulated rollouts behind the noise floor; its own error is then 2 %."""

COLOURED = 0.2
"""Autoregression coefficient from which noise has a law of its own in rollouts."""

SETTLE = 600
"""Steps after which noise that wanders has forgotten where it began; of other noise a tenth."""

FEWER = 4
"""Of the simulated rollouts, every so many where noise has a law of its own: a step of it costs more."""

SURELY = 4.0
"""Nats of likelihood on data that neither of two models was fitted to: odds of 50 to 1."""

MANY = 20_000_000
"""Model steps in rollouts from which on not every row is started from, but as many as that allows, evenly."""


@dataclass(frozen=True)
class Held:
    """What is held out. steps: its transitions; within: (M,) steps a rollout may touch; horizon in steps; inverse: for inputs that are
    forces.
    """

    data: Dataset
    steps: Steps
    left_out: tuple[tuple[int, int], ...]
    within: Mask
    horizon: int
    inverse: Inverse | None = None


@dataclass(frozen=True)
class Judged:
    """Of one model. one_step: (n, nx) residuals; ends: (m, nx) errors at the ends of rollouts; input_relative: of the inverse model."""

    one_step: Array
    ends: Array
    input_relative: float | None = None

    def error(self, states: tuple[str, ...], horizon_s: float) -> dict[str, Any]:
        """docs/json.md's `before` and `after`."""
        inverted = {} if self.input_relative is None else {"input_relative": self.input_relative}
        return inverted | {
            "one_step_rms": dict(zip(states, rms(self.one_step).tolist(), strict=True)),
            "rollout_rms": dict(zip(states, (rms(self.ends) if len(self.ends) else rms(self.one_step)).tolist(), strict=True)),
            "rollout_horizon_s": horizon_s,
        }


def held(model: ComposedModel, data: Dataset, steps: Steps, left_out: tuple[tuple[int, int], ...], within: Mask, horizon_s: float) -> Held:
    """With the horizon asked for, halved until some row has that much ahead of it."""
    ahead = max(1, round(horizon_s / data.dt))
    while ahead > 1 and not len(rollout_starts(data, ahead, left_out, within)):
        ahead = max(1, ahead // 2)
    return Held(data, steps, left_out, within, ahead, inverse(model, data, steps))


def judge(model: ComposedModel, given: Held) -> Judged:
    """The model's errors on what is held out."""
    act = acting(model, given.data)
    starts = rollout_starts_of(given)
    inverted = None if given.inverse is None else input_relative(model, given.inverse)
    ends = rollout(model, given.data, act, starts, given.horizon, begun=_begun(given, model)).error
    return Judged(residual(model, given.steps, act), ends, inverted)


def better(given: Held, model: ComposedModel, other: ComposedModel, share: float) -> bool:
    """Whether some error of `model`, at one step, a quarter of the horizon or all of it, is lower by that share than the other's; where
    speeds were not measured, also if what was measured is clearly likelier under it.
    """
    if given.data.axes_without_speed and len(given.steps):
        here = problem(given.data, given.steps)
        if gain(evaluate(here, model), evaluate(here, other)) > SURELY:
            return True
    pair = [(m, acting(m, given.data), _begun(given, m)) for m in (model, other)]
    for ahead in sorted({1, max(1, given.horizon // 4), given.horizon}):
        starts = some_of(rollout_starts(given.data, ahead, given.left_out, given.within), ahead, FLOOR_STARTS)
        errors = [rms(measured(given.data, rollout(m, given.data, act, starts, ahead, begun=begin).error)) for m, act, begin in pair]
        if len(starts) and np.any(errors[1] > (1.0 + share) * errors[0]):
            return True
    return False


def _begun(given: Held, model: ComposedModel) -> Array | None:
    """Where rollouts begin, under the noise that the model leaves there (`initial_states`)."""
    if not given.data.axes_without_speed or not len(given.steps):
        return None
    here = problem(given.data, given.steps)
    return begun(here, evaluate(here, model))


def displacement(given: Held) -> Array:
    """(m, nx) how far measured states went in the horizon, from every start of a rollout."""
    starts = rollout_starts_of(given)
    begin = np.cumsum([0] + [len(run.y) - 1 for run in given.data.runs])
    rows = starts + np.searchsorted(begin, starts, side="right") - 1
    y = np.concatenate([run.y for run in given.data.runs])
    return np.asarray(y[rows + given.horizon] - y[rows])


def rollout_starts_of(given: Held) -> NDArray[np.int64]:
    """Steps from which rollouts are judged, (m,)."""
    starts = rollout_starts(given.data, given.horizon, given.left_out, given.within)
    return starts[:: max(1, len(starts) * given.horizon // MANY)]


def noise_floor(fit: Fit, given: Held, seed: int) -> tuple[Array, Array]:
    """(nx,) rms that the noise alone makes of a one-step residual, and of a rollout's end: both by simulation from measured states.

    Noise that is correlated in time keeps its law: what a sensor has wrong for a while does not add up as what pushes the robot does.
    """
    fit = _there(fit, given)
    model, noise = fit.model, _as_measured(fit.noise, given.data)
    act = acting(model, given.data)
    slope = state_jacobian(model, given.steps, act)
    one = noise.one_step(slope)
    starts = rollout_starts_of(given)
    starts = starts[:: max(1, len(starts) // FLOOR_STARTS)]
    if not len(starts):
        return one, one
    rng = np.random.default_rng(seed)
    begin = np.cumsum([0] + [len(run.y) - 1 for run in given.data.runs])
    rows = starts + np.searchsorted(begin, starts, side="right") - 1
    y = np.concatenate([run.y for run in given.data.runs])
    clean, far = y[rows], farthest(y)  # of all: where rollouts begin may be the origin of each run
    if not given.data.axes_without_speed and (np.any(fit.colour.strength > COLOURED) or fit.colour.slow.size):
        ends = _coloured_ends(fit, given, act, starts[::FEWER], clean[::FEWER], far, rng)
        if ends is not None:
            return one, rms(ends)
    known = uncertain(fit, slope) if fit.noise.axes else noise.r
    noisy = clean + rng.normal(size=clean.shape) * np.sqrt(known)
    for h in range(given.horizon):
        clean, noisy = (no_farther(x, far) for x in _each_on(model, (clean, noisy), act, starts + h))
        noisy = noisy + rng.normal(size=clean.shape) * np.sqrt(noise.q)
    return one, rms(model.difference(clean, noisy) + rng.normal(size=clean.shape) * np.sqrt(noise.r))


def at_most_seen(floor: tuple[Array, Array], model: ComposedModel, given: Held, ends: Array) -> tuple[Array, Array]:
    """A `noise_floor` of which the rollouts' is at most how far rollouts of the model mostly end off where it was fitted, or all of
    them where it is judged, by `ends` (m, nx), whichever is more: noise is a part of that. A law with a memory that took up an event lets
    it happen all the time.
    """
    one, rolled = floor
    fitted_on = rollout_starts(given.data, given.horizon, given.left_out, ~given.within)
    if given.data.axes_without_speed or not len(ends) or not len(fitted_on) or np.all(rolled <= rms(ends)):
        return floor
    starts = fitted_on[:: max(1, len(fitted_on) // FLOOR_STARTS)]
    there = rollout(model, given.data, acting(model, given.data), starts, given.horizon).error
    mostly = np.median(np.abs(there), axis=0) / 0.6745
    return one, np.minimum(rolled, np.maximum(mostly, rms(ends)))


def _coloured_ends(fit: Fit, given: Held, act: Acting, starts: Index, y: Array, far: Array, rng: np.random.Generator) -> Array | None:
    """(m, nx) measured less foretold at the ends of rollouts from y (m, nx), where every step's residual is drawn by the noise's law:

        r_k = scale (w_k + e_{k+1} - F e_k) + what of r the past foretells        (the colour of z taken for that of r)

    None if that law has no end: then it says nothing of so long a time. far: (nx,) sizes that nothing exceeds.
    """
    model, (q, s) = fit.model, (np.sqrt(fit.noise.q), np.sqrt(fit.noise.r))
    law, e, x = Past(fit.colour, y.shape), s * rng.normal(size=y.shape), y
    measured = [np.flatnonzero(~np.isnan(run.y).any(axis=1)) for run in given.data.runs]  # rows before the first one are inputs alone
    longest = max((int(rows[-1] - rows[0]) for rows in measured if len(rows)), default=0)
    before = longest - given.horizon  # what lasts longer than a run was not seen, nor its law
    settle = min(SETTLE if fit.colour.slow.size else SETTLE // 10, max(before, 0))
    for k in range(settle + given.horizon):
        late = s * rng.normal(size=y.shape)
        push = q * rng.normal(size=y.shape) + late
        if k < settle:
            law.follow(push - e)
        else:
            place = starts + k - settle
            there, as_seen, x = _each_on(model, (y, y - e, x), act, place)
            y = no_farther(there + law.follow(push - (there - as_seen)), far)
            x = no_farther(x, far)
        e = late
    ends = model.difference(y, x)
    return ends if law.settled else None


def _each_on(model: ComposedModel, states: Sequence[Array], act: Acting, place: Index) -> Array:
    """(several, m, nx), each of several (m, nx) one step on, all in one call: what that takes hardly depends on how many rows there are."""
    return wherever(model, np.concatenate(states), act, np.tile(place, len(states))).reshape(len(states), *states[0].shape)


def noise_there(fit: Fit, given: Held) -> Noise:
    """The noise of a fit on what is held out."""
    return _as_measured(_there(fit, given).noise, given.data)


def _there(fit: Fit, given: Held) -> Fit:
    """A fit with its noise on what is held out, which may be another recording, with other states measured."""
    if fit.noise.axes == given.data.axes_without_speed or not len(given.steps):
        return fit
    return replace(fit, noise=evaluate(problem(given.data, given.steps), fit.model).noise)


def _as_measured(noise: Noise, data: Dataset) -> Noise:
    """With the errors of speeds that were not measured, instead of the bounds for them."""
    r = noise.r.copy()
    for (_, v), error in zip(data.axes_without_speed, data.reconstruction.errors if data.reconstruction else (), strict=False):
        r[v] = error**2
    return replace(noise, r=r)


def gaps(
    before: tuple[ComposedModel, Judged], after: tuple[ComposedModel, Judged], given: Held, weights: Array, kind: Kind
) -> tuple[dict[str, Any], dict[str, Any], bool]:
    """docs/json.md's `gap` before and after, and whether its transitions were drawn independently: a campaign's samples where the log has
    some that were held out, else all held-out transitions (numbers without a statement).
    """
    campaign = _campaign(before[0], given)
    if campaign is not None:
        n, independent = _counted(before[0], campaign)
        told = [_campaign_gap(model, campaign, n, weights, kind) for model, _ in (before, after)]
        return told[0], told[1], independent
    first, second = (discrepancy(judged.one_step, weights, kind) for _, judged in (before, after))
    return _gap(float(np.max(first)), len(first)), _gap(float(np.max(second)), len(second)), False


def _gap(radius: float, n: int) -> dict[str, Any]:
    return {"radius": radius, "n": n, "epsilon": EPSILON, "beta": scenario_confidence(n, 0, EPSILON)}


def _campaign_gap(model: ComposedModel, samples: Transitions, n: int, weights: Array, kind: Kind) -> dict[str, Any]:
    """n: how many of them are different.

    With what the discrepancy is after the hold: a robot that answers late shows little after one step from rest.
    """
    told = _gap(float(np.max(discrepancy(residuals(model, samples), weights, kind))), n)
    held_too = hold_residuals(model, samples)
    if held_too is not None:
        told |= {"hold_radius": float(np.max(discrepancy(held_too, weights, kind))), "hold_periods": samples.hold_periods}
    return told


def _campaign(model: ComposedModel, given: Held) -> Transitions | None:
    """Samples of the recording's campaign that lie in what is held out."""
    if len(given.data.runs) >= FEWEST_RUNS or not len(given.steps):
        return None
    found = given.data.campaign or _in_file(model, given.data.paths)
    if found is None:
        return None
    nearest = np.searchsorted(given.steps.t, found.t0_s - given.data.origin_s - 0.5 * given.data.dt)
    apart = given.steps.t[np.minimum(nearest, len(given.steps) - 1)] - (found.t0_s - given.data.origin_s)
    inside = np.abs(apart) < 0.5 * given.data.dt
    if found.drive is not None or np.count_nonzero(inside) < 2:
        return None
    return found.chosen(np.flatnonzero(inside))


def _counted(model: ComposedModel, samples: Transitions) -> tuple[int, bool]:
    """How many samples are different, and whether they count as independent."""
    alike = different(model, samples)
    return alike.distinct, samples.independent and not alike.doubt


def _in_file(model: ComposedModel, paths: tuple[Path, ...]) -> Transitions | None:
    """A campaign's samples in a log."""
    if len(paths) != 1 or paths[0].suffix != ".mcap":
        return None
    from s2r_runtime.recordings.loading import from_mcap

    try:
        return from_mcap(paths[0], model)
    except S2RError:
        return None
