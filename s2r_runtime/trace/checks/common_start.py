"""Did all runs begin in one place, as near as was measured?

Then what was measured at the start of a run, y_0 = c + e_0, says nothing of that run: the residual of its first step, e_1 - F e_0, goes
with y_0 although the robot does not, and short runs, which are mostly first steps, seem to be drawn to where they began (attenuation:
R. J. Carroll et al., Measurement error in nonlinear models, 2006, ch. 3). With d the starts less their mean and S their true variance,

    r_j = -b d_j + what goes with no d,     b = R / (S + R):    1 if they are one place, 0 if they are far apart

A state with b clearly above SAME begins everywhere at the mean. What a strong brake does to starts that do differ looks alike, but it
leaves states that vary less than the starts do; an error of measurement is at the end of a step, too.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.prediction import acting, first_steps, residual, steps_of

Array = NDArray[np.float64]

FEWEST = 12
"""Runs from which on it is told."""

SAME, SURELY = 0.5, 3.0
"""Share of the starts' variance that must be the sensor's, and standard deviations by which it must be known to be more."""


def from_one_place(model: ComposedModel, data: Dataset) -> Dataset:
    """The dataset, with the mean of what was measured where states of all runs begin alike."""
    steps = steps_of(data)
    rows = np.flatnonzero(np.isin(steps.place, first_steps(data)[:-1]))
    if len(rows) < FEWEST:
        return data
    begun = steps.take(rows)
    apart = model.difference(begun.y0.copy(), begun.y0[:1])
    off = apart - apart.mean(axis=0)
    alike = _alike(off, residual(model, begun, acting(model, data)))
    if not np.any(alike):
        return data
    runs = list(data.runs)
    for run, row in zip(begun.run.tolist(), np.where(alike, begun.y0 - off, begun.y0), strict=True):
        runs[run] = replace(runs[run], y=np.concatenate([row[None, :], runs[run].y[1:]]))
    return replace(data, runs=tuple(runs))


def _alike(off: Array, r: Array) -> NDArray[np.bool_]:
    """(nx,) from the starts less their mean, and the residuals of the steps from them, (n, nx)."""
    n, size = len(off), np.sum(off**2, axis=0)
    there = size > 0.0
    share = -np.sum(off * (r - r.mean(axis=0)), axis=0) / np.where(there, size, 1.0)
    ends = r - r.mean(axis=0) + off  # where the steps end, whatever was measured at their start
    rest = np.sum((r - r.mean(axis=0) + share * off) ** 2, axis=0) / n
    known = share - SURELY * np.sqrt(rest / np.where(there, size, 1.0)) > SAME
    as_noisy = np.sum(ends**2, axis=0) > math.exp(-SURELY * math.sqrt(4.0 / n)) * size  # log of a ratio of variances of n values each
    return np.asarray(there & known & as_noisy)
