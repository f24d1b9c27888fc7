"""Commands that changed between two rows, nobody knows when.

A table that was filled up on a clock of its own holds a command from the row after it came. In the row before, a part of the step went by
the one and the rest by the other, and a wheel's speed at its end is what was asked last. Where the motion tells when each came, it is
placed (`input_hold`). Where it does not, structure is left in just these transitions, and of one kind: with r the residual, d what the next
command would change in the prediction of a whole step, both for each state, over its one-step noise,

    e = sum over states of min(r^2, CUT)           s = r less the share of d, from 0 to 1, that comes nearest to it
    mean of e before a change  >  MORE times its mean elsewhere, and SURE standard errors above it
    of what it is more, one transition later at most AFTER is there, and by s at most OTHERWISE is left

Then these transitions are left out. What remembers a command (a lag, a delay) shows after a change, and not before it; of a push that was
not foretold, what is taken for noise of the sensor shows once more in the transition after. A push to which a controller answers is no
part of what its answer does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.checks.clocks import earlier
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.data.initial_conditions import with_history
from s2r_runtime.trace.estimation.prediction import acting, first_steps, predicted
from s2r_runtime.trace.estimation.problem import Fit, Problem
from s2r_runtime.trace.sensor_faults.detect import Checked, check

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CUT = 36.0
"""Squares beyond six deviations count as that: a few rows shall not decide."""

MORE, SURE = 1.5, 4.0
"""Beyond what noise that is estimated from all transitions together, or chance, would make of them."""

AFTER, OTHERWISE = 0.75, 0.3
"""Less than what noise of a sensor as large as all of it would leave there, and than the half that chance leaves of any direction."""

FEWEST, MOST = 8, 0.2
"""Transitions of each kind, from which means say something; and the share of all that may be left out: rollouts reach from one change to
the next, and must say what a model does in the long run.
"""


def checked_of(model: ComposedModel, data: Dataset, under: ComposedModel | None = None) -> Checked:
    """`faults.check`, and without transitions in which a command changed that could not be placed, if that is so (`Dataset.unplaced`)."""
    found = check(model, with_history(model, data), under)
    return replace(found, left_out=(*found.left_out, *before_changes(found.data))) if data.unplaced else found


def before_changes(data: Dataset) -> tuple[tuple[int, int], ...]:
    """(run, step) of transitions, measured at both ends, after which another command is held, or nobody knows which: the last of a run."""
    found = []
    for i, run in enumerate(data.runs):
        held, there = run.u[:: data.substeps], np.asarray(np.isfinite(run.y).all(axis=1))
        changes = np.append(np.any(held[1:] != held[:-1], axis=1), True) & there[:-1] & there[1:]
        found += [(i, int(k)) for k in np.flatnonzero(changes)]
    return tuple(found)


def only_before_changes(given: Problem, fit: Fit) -> bool:
    """Whether what a fit leaves of a recording is what changes of commands do that came before their rows."""
    before = _mask(given.data)[given.steps.place]
    after = np.append(False, before[:-1] & (np.diff(given.steps.place) == 1)) & ~before
    rest = ~(before | after)
    kinds = [np.count_nonzero(kind) for kind in (before, after, rest)]
    if min(kinds) < FEWEST or kinds[0] > MOST * len(before):
        return False
    r, d = _residual_and_change(given, fit)
    left = r - np.clip(r * d / np.maximum(d * d, 1e-300), 0.0, 1.0) * d
    e, s = (np.sum(np.minimum(one**2, CUT), axis=1) for one in (r, left))
    there, later, elsewhere = (float(np.mean(e[kind])) for kind in (before, after, rest))
    more, error = there - elsewhere, float(np.std(e[rest])) / np.sqrt(kinds[0])
    seen = there > MORE * elsewhere and more > SURE * error
    return bool(seen and later - elsewhere < AFTER * more and float(np.mean(s[before])) - elsewhere < OTHERWISE * more)


def _residual_and_change(given: Problem, fit: Fit) -> tuple[Array, Array]:
    """(n, nx) each, over the noise: the residual, and what the next step's inputs would do in its place."""
    model, data, parts = fit.model, given.data, given.data.substeps
    sooner = replace(data, runs=tuple(earlier(run, parts) for run in data.runs))
    now, then = (predicted(model, given.steps, acting(model, one)) for one in (data, sooner))
    noise = fit.noise.one_step(given.jacobian(model))
    return model.difference(given.steps.y1.copy(), now) / noise, model.difference(then.copy(), now) / noise


def _mask(data: Dataset) -> Mask:
    """(M,) of the steps of runs laid end to end."""
    begin = first_steps(data)
    mask = np.zeros(begin[-1], dtype=bool)
    mask[[begin[i] + k for i, k in before_changes(data)]] = True
    return mask
