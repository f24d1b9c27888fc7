"""When something happened, asked again once all else is known; and which other times say nearly the same.

The likelihood of a time has many peaks, one for every large input near it. The first look takes the highest one of what the model left
then, with other effects still missing, and a fit from there stays on its peak. Here times are tried one by one, on the model that has all
the others: with z what that leaves and c what a change then does to it, both whitened and less what the other numbers can do,

    nats = (c . z)^2 / (2 c . c)            whatever the size of the change
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.parameters import Slot, bounds_of, values_of, with_values
from s2r_runtime.trace.estimation.problem import Fit, Problem, evaluate, predicted_by, refine, sensitivities, sought, under_noise, without

Array = NDArray[np.float64]

CLEARER = 0.5
"""Nats by which another peak must be higher."""

ALL, NEAR = 80, 40
"""Times that are tried over the whole recording, and steps on either side of the best of them, and of what was found, at their starts and
middles.
"""

ALIKE = 3.0
"""Nats within which a fit cannot tell one time from another."""

WITHIN = 1.5
"""Steps between rows from which on there is a gap."""


def retimed(given: Problem, fit: Fit) -> Fit:
    """The fit with every time at its highest peak."""
    for slot in [slot for slot in fit.free if is_time(fit.model, slot)]:
        times, nats = _curve(given, fit, slot)
        best = int(np.argmax(nats))
        moved = _at(fit.model, slot, float(times[best]))
        if moved is not None and nats[best] > nats[-1] + CLEARER:
            other = evaluate(given, refine(given, fit, moved), fit.noise)
            fit = other if other.white > fit.white else fit
    return fit


def dated(given: Problem, everything: Problem, fit: Fit) -> Fit:
    """The fit with every time at its highest peak. Of times that it cannot tell apart, some of them where nothing was fitted, the
    one that all of the recording says; a gap without any rows is as many times likelier as steps would fit into it.
    """
    fit = retimed(given, fit)
    dt, t, rows = given.data.dt, given.steps.t, everything.steps.t
    gaps = np.flatnonzero(np.diff(t) > WITHIN * dt)
    for slot in [slot for slot in fit.free if is_time(fit.model, slot)]:
        now = float(values_of(fit.model, (slot,))[0])
        if not np.any((t[gaps] - NEAR * dt < now) & (now < t[gaps + 1] + NEAR * dt)):
            continue
        low, high = spread(given, fit, slot, ALIKE)
        first, last = (int(np.searchsorted(t, when)) for when in (low, high))  # of a gap, one end says what the other says
        inside = rows[(rows >= t[max(first - 1, 0)]) & (rows <= t[min(last, len(t) - 1)])]
        gone = np.diff(inside)
        times = np.append(now, np.where(gone < WITHIN * dt, inside[1:], 0.5 * (inside[:-1] + dt + inside[1:])))
        ways = np.append(0.0, np.log(np.maximum(gone / dt, 1.0)))
        whole = evaluate(everything, fit.model, fit.noise)
        base = under_noise(everything, without(fit.model, slot.place), whole.noise)
        moved = _at(fit.model, slot, float(times[int(np.argmax(_nats(everything, whole, base, slot, times) + ways))]))
        fit = fit if moved is None else evaluate(given, moved, fit.noise)
    return fit


def spread(given: Problem, fit: Fit, slot: Slot, drop: float) -> tuple[float, float]:
    """First and last time, s, that explain within `drop` nats of the best one. Between them may lie times that do not."""
    times, nats = _curve(given, fit, slot)
    near = times[nats > float(nats.max()) - drop]
    return float(near.min()), float(near.max())


def is_time(model: ComposedModel, slot: Slot) -> bool:
    """Whether a number says when something happens."""
    return sought(model, slot) and bounds_of(model, slot).unit == "s"


def _at(model: ComposedModel, slot: Slot, time: float) -> ComposedModel | None:
    return with_values(model, (slot,), np.array([time]))


def _curve(given: Problem, fit: Fit, slot: Slot) -> tuple[Array, Array]:
    """Times, (m,) s, and the nats of each; what was found is the last one."""
    base = under_noise(given, without(fit.model, slot.place), fit.noise)
    now, t = float(values_of(fit.model, (slot,))[0]), given.steps.t
    coarse = t[:: max(1, len(t) // ALL)]
    first = _nats(given, fit, base, slot, coarse)
    fine = [np.arange(-NEAR, NEAR + 0.5, 0.5) * given.data.dt + when for when in (float(coarse[int(np.argmax(first))]), now)]
    times = np.append(np.clip(np.concatenate(fine), t[0], t[-1]), now)
    return np.append(coarse, times), np.append(first, _nats(given, fit, base, slot, times))


def _nats(given: Problem, fit: Fit, base: Fit, slot: Slot, times: Array) -> Array:
    before = given.predicted(base.model)
    models = [_at(fit.model, slot, float(when)) for when in times]
    there = iter(predicted_by(given, [m for m in models if m is not None]))
    moved = np.array([0.0 * before if m is None else next(there) - before for m in models]).transpose(1, 2, 0)
    weights = np.sqrt(noises.weight(base.z)).ravel()
    z, c = weights * base.z.ravel(), weights[:, None] * base.whiten(moved).reshape(len(weights), -1)
    if base.free:
        aside = np.linalg.qr(weights[:, None] * sensitivities(given, base, base.model, base.free))[0]
        z, c = z - aside @ (aside.T @ z), c - aside @ (aside.T @ c)
    return np.asarray(0.5 * (c.T @ z) ** 2 / np.maximum(np.sum(c * c, axis=0), 1e-9))
