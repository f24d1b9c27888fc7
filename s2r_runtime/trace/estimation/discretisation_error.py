"""What the grid adds to the intervals of numbers where commands come within steps.

A command that changes within a part of a step counts as its mean over that part. What an effect makes of it is then off by c h or c h^2, h
the part's length, and so are numbers: a rate limit that begins its ramp too early looks slow. With parts of 2 h a number p comes out by
c h (3 c h^2) farther off, so what is left is within  p(h) - p(2 h),  and lies that way (L. F. Richardson, Phil. Trans. A 210, 1911). Where
inputs push masses, a step takes their mean over all of it; what steps in parts say instead is added in the same way. Both to first order:

    p(other) - p = -(J^T W J)^-1 J^T W (z_other - z)        z: whitened residuals on the other grid and on this one
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.forces import axes
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.data.gridding import coarser
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.parameters import Slot, bounds_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, foretold, objective, sensitivities

Array = NDArray[np.float64]
Ranges = dict[Slot, tuple[float, float]]


def widened(given: Problem, fit: Fit, found: Ranges) -> Ranges:
    """Intervals (low, high) with what the grid adds."""
    for shift in _shifts(given, fit):
        for slot, by in zip(fit.free, shift.tolist(), strict=True):
            bounds, (low, high) = bounds_of(fit.model, slot), found[slot]
            found[slot] = max(min(low, low + by), bounds.low), min(max(high, high + by), bounds.high)
    return found


def _shifts(given: Problem, fit: Fit) -> list[Array]:
    """(k,) each, by which numbers would move on a finer grid of commands, and with steps in parts."""
    if not fit.free or given.data.in_parts or not _within_steps(given.data):
        return []
    coarse = replace(given, data=coarser(given.data, 2))
    fine, rough = (objective(there, fit, fit.model) for there in (given, coarse))
    w = noises.weight(fine)
    j = sensitivities(given, fit, fit.model, fit.free)
    inverse = np.linalg.pinv(j.T @ (j * w.ravel()[:, None]), rcond=1e-12, hermitian=True)

    def moves(apart: Array) -> Array:
        return np.asarray(-inverse @ (j.T @ (w * apart).ravel()))

    found = [moves(fine - rough)]
    if axes(fit.model.nominal):
        parts = replace(coarse, data=replace(coarse.data, in_parts=True))
        if foretold(parts, fit.model) is not None:
            found.append(moves(objective(parts, fit, fit.model) - rough))
    return found


def _within_steps(data: Dataset) -> bool:
    """Whether commands change within steps, on a grid that can be made coarser by half."""
    return data.substeps % 2 == 0 and any(np.any(run.u[::2] != run.u[1::2]) for run in data.runs)
