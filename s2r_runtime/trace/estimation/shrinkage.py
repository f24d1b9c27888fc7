"""Numbers of one effect that are entries of a vector or a matrix, drawn in where the data do not tell them apart.

A push along two axes, or a field over places, has entries of one kind. A drive along one line tells how the push goes on that line, and
says next to nothing of what it is beside it; the likeliest entries there are whatever the noise made of them, and a robot that goes there
is sent astray by the repaired model. With p the likeliest numbers of the whole model, C their covariance (as wide as their intervals are),
and an effect's entries e taken to be drawn alike about the value at which it does nothing,

    e ~ N(0, t^2 I),  p | e ~ N(., C):     p' = p - C_e (C_ee + t^2 I)^-1 e

with t^2 the likeliest for these entries: e ~ N(0, C_ee + t^2 I). (C. Stein, Inadmissibility of the usual estimator for the mean of a
multivariate normal distribution, 1956; B. Efron, C. Morris, J. Am. Stat. Assoc. 68, 1973.) What is well known stays where it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation.intervals import spread_of
from s2r_runtime.trace.estimation.parameters import Free, bounds_of, inside, values_of, with_values
from s2r_runtime.trace.estimation.problem import Fit, Problem, evaluate

Array = NDArray[np.float64]

SIZES = 200
"""Values of t^2 that are tried, evenly in the logarithm: from where nothing is drawn in to where all is."""


def drawn_in(given: Problem, fit: Fit, there: Problem, near: Fit) -> Fit:
    """The fit with entries drawn in; itself, where no effect has several. there, near: problem and fit about where the robot was, by which
    numbers are told (`fitting.told`).
    """
    groups = list(_entries(fit.model, fit.free))
    if not groups or not np.all(np.isfinite(near.z)):
        return fit
    covariance = spread_of(there, near).widened
    values = values_of(near.model, near.free)
    moved = values.copy()
    for group in groups:
        e, own = values[group], covariance[np.ix_(group, group)]
        moved -= covariance[:, group] @ np.linalg.solve(own + _size(e, own) * np.eye(len(e)), e)
    model = with_values(fit.model, fit.free, inside(fit.model, fit.free, values_of(fit.model, fit.free) + moved - values))
    return fit if model is None else replace(evaluate(given, model, fit.noise), colour=fit.colour)


def _entries(model: ComposedModel, free: Free) -> Iterator[list[int]]:
    """Places in `free` of each effect's numbers that are entries: several in one unit, none at zero, and of either sign."""
    for place in dict.fromkeys(slot.place for slot in free):
        own = [i for i, slot in enumerate(free) if slot.place == place]
        kinds = [bounds_of(model, free[i]) for i in own]
        alike = len({kind.unit for kind in kinds}) == 1
        if len(own) > 1 and alike and all(kind.neutral == 0.0 and kind.low < 0.0 < kind.high for kind in kinds):
            yield own


def _size(e: Array, own: Array) -> float:
    """t^2, the likeliest."""
    spread, axes = np.linalg.eigh(own)
    squares, spread = (axes.T @ e) ** 2, np.maximum(spread, 0.0)
    top = float(np.max(squares))
    sizes = top * np.logspace(-8.0, 2.0, SIZES) if top > 0.0 else np.array([1.0])
    total = spread[:, None] + sizes
    return float(sizes[np.argmax(-0.5 * np.sum(np.log(total) + squares[:, None] / total, axis=0))])
