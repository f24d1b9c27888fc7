"""Dry and viscous friction of all axes at once: a bearing has both, and a joint that lacks one of them hides the other.

A torque that is mostly there to overcome friction explains more as a deadband than dry friction does alone, and beside a deadband no
friction does better: looked for one by one, neither is found. An arm of two joints lacks four of them, beside three of which
the fourth is still asked for in every candidate. With c_i (n nx,) what one of them changes in the prediction, whitened,

    sizes = argmin |z - sum_i s_i c_i|,  s_i >= 0           (C. L. Lawson, R. J. Hanson, Solving least squares problems, 1974, ch. 23)

is where the fit of those that are there begins. Each must earn its place afterwards, as what was found one by one must.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.models.forces import axes, lone_speeds
from s2r_runtime.plugins import registry
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.problem import Fit, Problem, fitted, foretold, insert
from s2r_runtime.trace.selection.scores import name_of

Array = NDArray[np.float64]

KINDS = ("viscous_friction", "coulomb_friction")

ROUNDS = 2
"""Of numbers and noise, as other candidates get before they are compared."""


def with_friction(given: Problem, base: Fit) -> Fit | None:
    """The model with friction in its axes, of either kind, fitted; None where fewer than two of these do anything, or where the model has
    some already.
    """
    model = base.model
    if any(name_of(a)[0] in KINDS for a in model.effects):
        return None
    ones = _ones(given, model)
    if len(ones) < 2:
        return None
    alone = [foretold(given, insert(model, one, len(model.effects))) for one in ones]
    before = given.predicted(model)
    sizes = _sizes(base, np.array([before if one is None else one for one in alone]) - before)
    kept = [_scaled(one, size) for one, size in zip(ones, sizes.tolist(), strict=True) if size > 0.0]
    if len(kept) < 2:
        return None
    for a in kept:
        model = insert(model, a, len(model.effects))
    return None if foretold(given, model) is None else fitted(given, base, model, ROUNDS)


def _ones(given: Problem, model: ComposedModel) -> list[AppliedEffect]:
    """Each kind on each axis, at the size at which it would begin alone."""
    nominal, known = model.nominal, registry()
    rates = [*(model.states[axis.velocity] for axis in axes(nominal)), *lone_speeds(nominal)]
    found = []
    for kind in KINDS:
        effect = known.get("effects", kind)
        for channel in (c for c in effect.channels(nominal) if c in rates):
            u = np.concatenate([run.u for run in given.data.runs])
            found.append(AppliedEffect(effect, channel, effect.starts(u, nominal, channel, given.data.dt)[0]))
    return found


def _scaled(one: AppliedEffect, size: float) -> AppliedEffect:
    return AppliedEffect(one.effect, one.channel, {name: size * float(value) for name, value in one.p.items()})


def _sizes(base: Fit, moved: Array) -> Array:
    """(k,) how much of each of some changes of the prediction (k, n, nx) explains what a model leaves."""
    from scipy.optimize import nnls

    z = base.z.ravel()
    root = np.sqrt(noises.weight(z))
    table = base.whiten(moved.transpose(1, 2, 0)).reshape(len(z), -1) * root[:, None]
    length = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
    sizes, _ = nnls(table / length, root * z)
    return np.asarray(sizes / length)
