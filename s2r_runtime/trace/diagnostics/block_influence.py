"""Does what speaks for a name come from one short stretch of the recording?

d_k = m_k . (S^-1 (r + m/2))_k      r: what the model leaves; m_k: what the effect does in step k; S: covariance of the noise

which sums up to the nats that speak for it, (r + m)^T S^-1 (r + m) / 2 - r^T S^-1 r / 2, and is nothing where it does nothing: what is left
when whitened is not, for long, where a sensor is noisier than the motion.

An end stop that was met once, or a command that was cut off once, can be anything that happened there and then: nothing else in the
recording says that it would happen again. So it is told that the name may be about a time, where a SHORT-th of the time holds MOSTLY all of
sum d_k, and what the rest says pays for no number (Schwarz, and a chance of one in twenty). What is about time itself is left out.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.problem import Fit, Problem, foretold, without

Array = NDArray[np.float64]

SHORT = 8
"""Of so many parts of the steps one is a short stretch."""

MOSTLY = 0.9
"""Of all that speaks for a name."""

ALPHA = 0.05
"""Chance that what the rest says is chance."""


def in_one_stretch(given: Problem, fit: Fit) -> bool:
    """Whether some effect of a fit was seen in one stretch only; all of the recording is asked."""
    timeless = [place for place in fit.added if not getattr(fit.model.effects[place].effect, "timed", False)]
    return given.data.in_order and any(_once(_speaks_for(given, fit, place), _numbers(fit, place)) for place in timeless)


def _numbers(fit: Fit, place: int) -> int:
    return max(1, sum(slot.place == place for slot in fit.free))


def _speaks_for(given: Problem, fit: Fit, place: int) -> Array:
    """(n,) nats of each step for an effect."""
    less = without(fit.model, place)
    if foretold(given, less) is None:  # somebody's own model may not step without it
        return np.zeros(0)
    without_it = given.residual(less)
    middle = 0.5 * (fit.z + fit.whiten(without_it))
    return np.asarray(np.sum((without_it - given.residual(fit.model)) * fit.whiten.back(noises.weight(fit.z) * middle), axis=1))


def _once(nats: Array, numbers: int) -> bool:
    """Whether one short stretch holds nearly all of the nats (n,) of an effect, and the rest nothing to speak of."""
    wide = len(nats) // SHORT
    if not wide:
        return False
    so_far = np.concatenate([[0.0], np.cumsum(nats)])
    total, there = float(so_far[-1]), float(np.max(so_far[wide:] - so_far[:-wide]))
    needed = 0.5 * numbers * math.log(len(nats)) + math.log(1.0 / ALPHA)
    return 0.0 < MOSTLY * total < there and total - there < needed
