"""When are forces that were recorded taken for measurements (`measured_forces`)?

Where effects throttle them, and the inverse model of effects on the motion says far better which forces were measured: |u - u*| over |u|,
with u* the force that the motion takes, as in identification by the inverse model (A. Janot, M. Gautier, M. Brunot, Data set and reference
models of EMPS, 2019). Of effects on the input it is the same of what they leave of it: a gain of 0.03 takes a force thirty times as large.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.errors import Held
from s2r_runtime.trace.fitting import Fit
from s2r_runtime.trace.inverse import input_relative
from s2r_runtime.trace.residual import acting

THROTTLED = 0.7
"""Of the forces that were recorded, rms: effects that let through less of one throttle it."""

BETTER, WELL = 0.8, 0.5
"""Times the error of the inverse model of what throttles, and share of the force, below which that of effects on the motion is believed."""

FAR = 2.0
"""Times what is left of a force that the force which the motion takes is away from it. Noise makes 1 of a joint that friction holds."""


def throttled(fit: Fit, judged_on: Held) -> bool:
    """Whether effects leave little of a force that was recorded."""
    if judged_on.inverse is None or not any(fit.model.effects[i].effect.stage == "input" for i in fit.added):
        return False
    asked, acts = (np.sqrt(np.mean(acting(fit.model, judged_on.data, chain).mean ** 2, axis=0)) for chain in ((), None))
    return bool(np.any((asked > 0.0) & (acts < THROTTLED * asked)))


def says_better(model: ComposedModel, other: ComposedModel, judged_on: Held) -> bool:
    """Whether the inverse model of one says the forces that were measured far better than that of another one does."""
    mine, theirs = (None if judged_on.inverse is None else input_relative(m, judged_on.inverse, acting_too=True) for m in (model, other))
    return mine is not None and theirs is not None and mine < WELL and mine < BETTER * theirs


def unfollowed(fit: Fit, judged_on: Held) -> bool:
    """Whether the force that the motion takes is FAR from what effects leave of a throttled one: the robot does not go by it, and nothing
    is known of what acts on it.
    """
    if judged_on.inverse is None or not throttled(fit, judged_on):
        return False
    off = input_relative(fit.model, judged_on.inverse, acting_too=True)
    return off is not None and off > FAR
