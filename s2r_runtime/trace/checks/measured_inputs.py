"""When are forces that were recorded taken for measurements (`measured_forces`)?

Where effects throttle them, and are refuted by it: the force that the motion takes, u*, is far from what they leave of the recorded one,
for how little that is, beyond what the noise of the measurements makes of u*. A gain of 0.03 takes a force thirty times as large. Then
effects on the motion are asked, and believed if the recorded force varies with u* by their inverse model (identification by the inverse
model: A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, 2019).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.diagnostics.rollout_error import Held, noise_there
from s2r_runtime.trace.estimation.inverse_dynamics import off, off_by_noise, recorded
from s2r_runtime.trace.estimation.problem import Fit

Array = NDArray[np.float64]

THROTTLED = (0.1, 0.3), (0.7, 1.0)
"""Shares of a force that was recorded, rms, below which effects that leave less throttle it; and how far, over what they leave, the force
that the motion takes may be from it. Several effects together may look a little like any motion, and the less is left of a command the
less that says.
"""

WELL, HARDLY = 0.7, 0.05
"""Of how a recorded force varies, by which the inverse model of effects on the motion may be off: half of the variance. Of its size, below
which it does not vary, and says nothing.
"""


def refuted(fit: Fit, judged_on: Held) -> bool:
    """Whether effects throttle a force, and the motion does not go by what they leave of it."""
    if judged_on.inverse is None or not any(fit.model.effects[i].effect.stage == "input" for i in fit.added):
        return False
    told = recorded(fit.model, judged_on.inverse)
    throttled = [(told.asked > 0.0) & (told.left < share * told.asked) for share, _ in THROTTLED]
    if not np.any(throttled):
        return False

    def beyond(error: Array) -> bool:
        return any(bool(np.any(those & (error > far * told.left))) for those, (_, far) in zip(throttled, THROTTLED, strict=True))

    error = off(fit.model, judged_on.inverse)
    if not beyond(error):
        return False
    noise = off_by_noise(fit.model, judged_on.inverse, noise_there(fit, judged_on).r)
    return beyond(np.sqrt(np.where(error > np.max(noise, axis=0), error**2 - np.mean(noise**2, axis=0), 0.0)))


def says_forces(model: ComposedModel, judged_on: Held) -> bool:
    """Whether the inverse model says how the recorded forces vary."""
    if judged_on.inverse is None:
        return False
    told = recorded(model, judged_on.inverse)
    used = told.varies > HARDLY * told.asked
    return bool(used.any() and np.all((off(model, judged_on.inverse) <= WELL * told.varies)[used]))
