"""What the inputs, and the noise, can do to a state in one step: a fault must be beyond it, or an effect would be explained away as one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.noise import quantum
from s2r_runtime.trace.estimation.prediction import Acting, advanced, first_steps

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDING = math.sqrt(1.0 / 6.0)
"""Of the step in which a state is rounded, standard deviation of what that does to a residual, which has it twice. Where more than half of
the residuals are alike, their median says nothing of noise.
"""

ONE_IN = 100.0
"""Recordings in which noise may once reach a spike's size."""


@dataclass(frozen=True)
class Reach:
    """noise: (nx,) robust standard deviation of a residual; move: (nx,) largest move in a step that the model foresees; turn: (nx,)
    largest change of it from one step to the next; tail: (nx,) leg of a spike that noise with tails such as these has in one recording
    of a hundred. quantum: (nx,) least change; moves: of each run, (K, nx) what the model foresees.
    """

    noise: Array
    move: Array
    turn: Array
    tail: Array
    instant: Mask
    quantum: Array
    moves: tuple[Array, ...]


def reach_of(model: ComposedModel, data: Dataset, act: Acting) -> Reach:
    """From the residuals of all runs."""
    e, moves = [], []
    for i, run in enumerate(data.runs):
        p = predicted(model, data, act, i)
        e.append(model.difference(run.y[1:], p))
        moves.append(model.difference(p, run.y[:-1]))
    residuals, move = np.concatenate(e), np.concatenate(moves)
    good = np.flatnonzero(np.isfinite(residuals).all(axis=1))
    instant = np.array([s in getattr(model.nominal, "reached", {}) for s in model.states])
    unseen = [v for _, v in data.axes_without_speed]
    if not len(good):
        one = np.ones(len(model.states))
        return Reach(one, one, one, one, instant, one, tuple(moves))
    noise = np.median(np.abs(residuals[good]), axis=0) / 0.6745
    largest = np.quantile(np.abs(move[good]), 0.999, axis=0)
    turns = np.concatenate([np.abs(np.diff(part, axis=0)) for part in moves])
    turns = turns[np.isfinite(turns).all(axis=1)]
    turn = np.minimum(np.quantile(turns, 0.999, axis=0), largest) if len(turns) else largest
    y = [run.y[np.isfinite(run.y).all(axis=1)] for run in data.runs]
    starts, ends = np.concatenate([rows[:-1] for rows in y]), np.concatenate([rows[1:] for rows in y])
    rounded = [quantum(starts[:, j], ends[:, j]) for j in range(len(model.states))]
    change = np.abs(ends - starts)
    least = np.min(np.where(change > 0.0, change, np.inf), axis=0)
    noise = np.maximum(noise, ROUNDING * np.array(rounded) + 1e-12)
    noise[unseen] = np.inf  # what was not measured has no fault
    return Reach(noise, largest, turn, _tail(residuals), instant, least, tuple(moves))


def _tail(residuals: Array) -> Array:
    """(nx,) by extrapolation of the quantiles of how far rows are from both neighbours, as a power law: what the tail itself says it
    may reach. Spikes themselves are on fewer rows than are looked at.
    """
    apart = 0.5 * np.abs(np.diff(residuals, axis=0))
    apart = apart[np.isfinite(apart).all(axis=1)]
    if len(apart) < 100:
        return np.zeros(residuals.shape[1])
    bulk, rare = np.quantile(apart, (0.9, 0.98), axis=0)
    steepness = np.log(np.clip(rare / np.maximum(bulk, 1e-300), 1.0, 5.0)) / math.log(5.0)
    return np.asarray(rare * (0.02 * ONE_IN * len(apart)) ** steepness)


def predicted(model: ComposedModel, data: Dataset, act: Acting, run: int) -> Array:
    """(K, nx) of a run: the state after each of its steps, from the one measured before."""
    begin = first_steps(data)[run]
    y = data.runs[run].y[:-1]
    here = slice(begin, begin + len(y))
    return advanced(model, y, act, here)
