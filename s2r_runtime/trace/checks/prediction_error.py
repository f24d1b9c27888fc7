"""How much of the motion a model foretells, whatever its columns are.

E = |y_{k+H} (-) f^H(y_k)| / |y_{k+H} (-) y_k|     for each state that goes somewhere, trimmed rms, H steps of half a second, at most 2
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.prediction import Index, acting, first_steps, rollout, rollout_starts

Array = NDArray[np.float64]

HORIZON_S = 0.5
"""Of the rollouts, s (1 to 50 steps)."""

SLOW_STEPS = 10
"""Of the rollouts, where a step is as long as that: in one step a tank's level hardly moves beyond its noise."""

STARTS = 300
"""Rollouts: their mean error is then known to a few per cent."""

FEWEST_STARTS = 20
"""Fewer say nothing."""

GOES = 5.0
"""Standard deviations of its noise that a state must go in the horizon to count."""


def unforetold(model: ComposedModel, data: Dataset, among: list[int] | None = None, *, pushed: bool = False) -> Array | None:
    """The share that E is the mean of, of each state (or of these) that goes somewhere; None where nothing goes anywhere. pushed: less a
    steady push on each state.
    """
    return each_unforetold(model, [data], among, pushed=pushed)[0]


def each_unforetold(
    model: ComposedModel, each: Sequence[Dataset], among: list[int] | None = None, *, pushed: bool = False, most: int = STARTS
) -> list[Array | None]:
    """`unforetold` of recordings with one step. most: rollouts, or so."""
    starts = [some_starts(data, most) for data in each]
    if not any(map(len, starts)):  # a user's own model need not take a table without rows
        return [None] * len(starts)
    begin = np.cumsum([0] + [int(first_steps(data)[-1]) for data in each])
    together = replace(each[0], runs=tuple(run for data in each for run in data.runs))
    places = np.concatenate([b + s for b, s in zip(begin[:-1], starts, strict=True)])
    with np.errstate(all="ignore"):
        errors = rollout(model, together, acting(model, together), places, steps_ahead(together)).error
    parts = np.split(errors, np.cumsum([len(s) for s in starts])[:-1])
    return [shares(model, data, s, e, among, pushed) for data, s, e in zip(each, starts, parts, strict=True)]


def some_starts(data: Dataset, most: int = STARTS) -> Index:
    """Of rollouts; none if there are too few."""
    starts = rollout_starts(data, steps_ahead(data))
    starts = starts[:: max(1, len(starts) // most)]
    return starts if len(starts) >= FEWEST_STARTS else starts[:0]


def ways_of(model: ComposedModel, data: Dataset, starts: Index) -> tuple[Array, Array]:
    """(n, nx) of each rollout: how far it went, and how far it was foretold to go."""
    with np.errstate(all="ignore"):
        error = rollout(model, data, acting(model, data), starts, steps_ahead(data)).error
    rows = starts + np.searchsorted(first_steps(data), starts, side="right") - 1
    y = np.concatenate([run.y for run in data.runs])
    gone = model.difference(y[rows + steps_ahead(data)].copy(), y[rows])
    return gone, gone - error


def shares(model: ComposedModel, data: Dataset, starts: Index, error: Array, among: list[int] | None, pushed: bool) -> Array | None:
    """Errors (n, nx) over how far each state goes."""
    if not len(starts):
        return None
    begin = first_steps(data)
    rows = starts + np.searchsorted(begin, starts, side="right") - 1
    y = np.concatenate([run.y for run in data.runs])
    error = trimmed(error - np.median(error, axis=0) if pushed else error)
    gone = trimmed(model.difference(y[rows + steps_ahead(data)].copy(), y[rows]))
    goes = gone > GOES * bend_noise(data) + 1e-12
    if among is not None:
        goes &= np.isin(np.arange(len(goes)), among)
    return np.minimum(error[goes] / gone[goes], 2.0) if goes.any() else None


def bend_noise(data: Dataset) -> Array:
    """(nx,) standard deviation of the noise of each state, by how it bends from row to row."""
    bent = np.concatenate([np.diff(run.y, 2, axis=0) for run in data.runs])
    # nanmedian of a table goes row by row, and this is asked of dozens of them
    return np.array([np.median(b[np.isfinite(b)]) for b in np.abs(bent.T)]) / 0.6745 / math.sqrt(6.0)


def steps_ahead(data: Dataset) -> int:
    """Steps of the rollouts."""
    return int(np.clip(round(HORIZON_S / data.dt), 1, 50)) if data.dt < HORIZON_S else SLOW_STEPS


def trimmed(e: Array) -> Array:
    """(nx,) rms of the four fifths that are smallest."""
    sizes = np.sort(np.abs(np.nan_to_num(e, nan=1e300)), axis=0)[: max(1, int(0.8 * len(e)))]
    return np.asarray(np.sqrt(np.mean(np.minimum(sizes, 1e100) ** 2, axis=0)))
