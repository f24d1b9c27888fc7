"""Commands that changed between two rows, nobody knows when.

A table that was filled up on a clock of its own holds a command from the row after it came. In the row before, a part of the step went by
the one and the rest by the other, and a wheel's speed at its end is what was asked last. Where the motion tells when each came, it is
placed (`straight`). Where it does not, structure is left in just these transitions:

    e_k = sum over states of min(z_k^2, CUT)         z: whitened residual
    mean of e before a change  >  MORE times its mean elsewhere, and in the transition after it there is at most AFTER of that more

Then these transitions are left out. What remembers a command (a lag, a delay) shows after a change, and not before it; of a push that was
not foretold, what is taken for noise of the sensor shows once more in the transition after.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.dataset import Dataset
from s2r_runtime.trace.fitting import Fit, Problem
from s2r_runtime.trace.residual import first_steps

Mask = NDArray[np.bool_]

CUT = 36.0
"""Squares beyond six deviations count as that: a few rows shall not decide."""

MORE, AFTER = 1.5, 0.75
"""See above."""

SURE = 4.0
"""Standard errors by which it must be more, too."""

FEWEST = 8
"""Transitions of each kind, from which means say something."""


def before_changes(data: Dataset) -> tuple[tuple[int, int], ...]:
    """(run, step) of transitions, measured at both ends, after which another command is held."""
    found = []
    for i, run in enumerate(data.runs):
        held, there = run.u[:: data.substeps], np.asarray(np.isfinite(run.y).all(axis=1))
        changes = np.any(held[1:] != held[:-1], axis=1) & there[:-2] & there[1:-1]
        found += [(i, int(k)) for k in np.flatnonzero(changes)]
    return tuple(found)


def only_before_changes(given: Problem, fit: Fit) -> bool:
    """Whether what a fit leaves of a recording is in the transitions before changes of a command."""
    before = _mask(given.data)[given.steps.place]
    after = np.append(False, before[:-1] & (np.diff(given.steps.place) == 1)) & ~before
    rest = ~(before | after)
    if min(np.count_nonzero(kind) for kind in (before, after, rest)) < FEWEST:
        return False
    e = np.sum(np.minimum(fit.z**2, CUT), axis=1)
    there, later, elsewhere = (float(np.mean(e[kind])) for kind in (before, after, rest))
    error = float(np.std(e[rest])) / np.sqrt(np.count_nonzero(before))
    more = there - elsewhere
    return bool(there > MORE * elsewhere and more > SURE * error and later - elsewhere < AFTER * more)


def _mask(data: Dataset) -> Mask:
    """(M,) of the steps of runs laid end to end."""
    begin = first_steps(data)
    mask = np.zeros(begin[-1], dtype=bool)
    mask[[begin[i] + k for i, k in before_changes(data)]] = True
    return mask
