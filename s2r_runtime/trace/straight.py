"""Inputs that went on changing between the rows that hold them.

A recording that is slower than the loop it listens to (a joint's torque at 100 Hz out of 1 kHz, a quadrotor's tilt, a steering wheel's
angle) has samples of an input that moved on, not commands that were held. On average over a row such an input was up to halfway to the
next one: (m - 1) / (2 m) of the way if the loop set it m times a row, 1/2 if it went straight on.

    z = beta c + J delta,    c = what halfway does to the prediction, whitened;  J = what the model's own numbers do

beta is 0 for a command that is held, (m - 1) / m for samples, less where they are noisy. No robot answers to what it is told later, and a
controller that answers to noise answers against it, which makes beta negative. One that goes along with it (a speed fed back to make up for
friction) makes it positive, with what noise pushes the robot: mostly beyond FARTHEST, but not always.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace import residual_noise as noises
from s2r_runtime.trace.dataset import Dataset, regridded
from s2r_runtime.trace.fitting import Fit, Problem, evaluate, fitted, sensitivities
from s2r_runtime.trace.residual import Acting, acting, predicted
from s2r_runtime.trace.streams import Stream

Array = NDArray[np.float64]

MOVING = 0.5
"""Share of the rows in which some input is another one than in the row before: of fewer, they are commands that are held."""

MOST = 0.9
"""Share of the inputs' rows on which states stand: at the ends of a recording speeds do not follow from positions."""

LEAST, FARTHEST = 0.2, 1.25
"""beta between which inputs moved on: less could be the bend of what is held, and more is an input that came a row too late."""

ROUNDS, CLOSE = 4, 0.005
"""In which the share is told, and how near it has to come."""

NATS = 15.0
"""By which halfway must explain more than held: what is held is the rule, as everywhere where rivals are told apart (`rivals`)."""


def sampled(data: Dataset) -> bool:
    """Whether inputs may be samples: they stand on the states' rows, no more often, and change in most of them. Others are commands."""
    return bool(data.segments) and all(_sampled(states, inputs) for states, inputs in data.segments)


def _sampled(states: Stream, inputs: Stream) -> bool:
    if len(inputs.t) < 2 or len(states.t) < MOST * len(inputs.t) or not np.isin(states.t, inputs.t).all():
        return False
    changed = np.diff(inputs.values, axis=0)  # a command that was not received is not a number
    return bool(np.all(np.isfinite(changed)) and np.mean(np.any(changed != 0.0, axis=1)) > MOVING)


def straight(data: Dataset, model: ComposedModel, share: float) -> Dataset:
    """The recording with each input a share of halfway on to the next one."""
    segments = [(states, Stream(inputs.t, _moved_on(inputs.values, share))) for states, inputs in data.segments]
    again = regridded(replace(data, segments=tuple(segments), straight=share), model)
    return replace(again, campaign=data.campaign)  # the step is the same, so its samples still are of this model


def alike_laid(moved: Dataset, checked: Dataset) -> bool:
    """Whether inputs of the one can stand in the runs of the other, which may begin earlier."""
    counts = [[len(run.y) for run in data.runs] for data in (moved, checked)]
    return moved.substeps == checked.substeps and len(counts[0]) == len(counts[1]) and all(a <= b for a, b in zip(*counts, strict=True))


def acted(checked: Dataset, moved: Dataset) -> Dataset:
    """The recording as it was checked, with the inputs of one that moved on. What is taken to have been before its runs stays: asked of
    each anew, that may be there with some inputs and not with others.
    """
    runs = []
    for run, other in zip(checked.runs, moved.runs, strict=True):
        before = (len(run.y) - len(other.y)) * checked.substeps
        runs.append(replace(run, u=np.concatenate([run.u[:before], other.u])))
    return replace(checked, runs=tuple(runs))


def _moved_on(values: Array, share: float) -> Array:
    """Towards the mean over the row of a cubic through the rows around: a straight line cuts a sine's corners."""
    before, after, late = (np.concatenate([values[:1], values, values[-1:], values[-1:]])[k : k + len(values)] for k in (0, 2, 3))
    mean = 0.5 * (values + after) - (late - after - values + before) / 24.0
    return np.asarray(values + share * (mean - values))


def moved_on(laid: Callable[[float], Problem], fit: Fit) -> float:
    """Share of halfway that inputs moved on by a fit and its effects, their numbers fitted again; 0 where they were held. laid: the fit's
    problem with inputs moved on so far.
    """
    held, halfway = (acting(fit.model, laid(share).data) for share in (0.0, 1.0))
    share, gained = _beta(laid(0.0), fit, held, halfway)
    if gained < NATS or not LEAST < share < FARTHEST:
        return 0.0
    for _ in range(ROUNDS):  # the noise is taken for larger than it is, and of another colour, until inputs are where they were
        here = laid(min(share, 1.0))
        now = fitted(here, fit, fit.model) if fit.free else evaluate(here, fit.model)
        more, _ = _beta(here, now, held, halfway)
        share = min(max(share + more, LEAST), 1.0)
        if abs(more) < CLOSE:
            break
    return share if share > LEAST else 0.0


def _beta(given: Problem, fit: Fit, held: Acting, halfway: Acting) -> tuple[float, float]:
    """How far inputs moved on beyond where they are in a fit, and the nats that this gains."""
    joined = given.steps.joined
    change = predicted(fit.model, given.steps, halfway) - predicted(fit.model, given.steps, held)
    z = fit.colour(fit.z, joined).ravel()
    c = fit.colour(fit.whiten(change), joined).reshape(-1, 1)
    x = np.hstack([c, sensitivities(given, fit, fit.model, fit.free)])
    if not np.all(np.isfinite(x)) or not np.any(c):
        return 0.0, 0.0
    weighted = x * noises.weight(z)[:, None]
    beta = np.linalg.lstsq(weighted.T @ x, weighted.T @ z, rcond=1e-12)[0]
    left = z - x @ beta
    gained = np.sum(noises.log_density(left)) - np.sum(noises.log_density(left + beta[0] * c.ravel()))
    return float(beta[0]), float(gained)
