"""Does something that opposes an input explain more than what was named on it?

z0 = J d + X b + e     z0: what is left without the names on an input, whitened; J: by the numbers of all other names; X: pushes by that
                       input, as smooth functions of its axis' own position and speed; e: white, by the noise of the named model

A controller asks of a joint for what its weight and friction take. Input and state then go together, and where the model lacks the force
that goes with the state, it looks as if the input did less: a gain near nothing explains nearly all of it, foretells the next second well,
and no function of the state explains what is left. So the state is given the place of the name:

    it wins     (|z|^2 - |z0 - J d - X b|^2) / 2 > log(n) / 2 (columns of X - numbers of the names) + log(1 / ALPHA)

where z is what the named model leaves (G. Schwarz, Ann. Statist. 6, 1978). An input that really does less is not explained by where the
axis is and how fast it goes, in closed loop either. Only of models with axes (a position, and its speed, that inputs push).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.forces import axes
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.prediction import acting
from s2r_runtime.trace.estimation.problem import Fit, Problem, foretold, objective, sensitivities, without
from s2r_runtime.trace.hypotheses.basis import own_pushes, quieter

Array = NDArray[np.float64]

ALPHA = 1e-3
"""Chance that a state wins against the truth, as far as the likelihood is right."""

STICKS = 0.1
"""Of the usual speed: below that, dry friction grows with it, and is all there beyond."""

GROUPS = {"position": slice(0, 3), "speed": slice(3, 6)}
"""Columns of X by what they depend on; the last one is a constant."""


def opposed(given: Problem, fit: Fit) -> tuple[str, ...]:
    """What explains more than the names on some input do, most first (`position`, `speed`); nothing if these stand."""
    if not axes(fit.model.nominal):
        return ()
    for j, name in enumerate(fit.model.inputs):
        effects = fit.model.effects
        named = [i for i in fit.added if effects[i].effect.stage == "input" and effects[i].channel in {name, "*"}]
        tokens = _opposes(given, fit, j, named) if named else ()
        if tokens:
            return tokens
    return ()


def _opposes(given: Problem, fit: Fit, j: int, named: list[int]) -> tuple[str, ...]:
    """The same of one input. named: places of the effects on it."""
    bare = fit.model
    for place in reversed(named):
        bare = without(bare, place)
    pushes = _pushes(given, fit, j)
    if pushes is None or foretold(given, bare) is None:
        return ()
    z = objective(given, fit, fit.model)
    root = np.sqrt(noises.weight(z)).ravel()
    others = [i for i, slot in enumerate(fit.free) if slot.place not in named]
    own = root[:, None] * sensitivities(given, fit, fit.model, fit.free)[:, others]
    x = root[:, None] * fit.colour(fit.whiten(pushes), given.steps.joined).reshape(len(root), -1)
    r = root * objective(given, fit, bare).ravel()
    numbers, price = len(fit.free) - len(others), 0.5 * math.log(len(z))
    left = _left(np.hstack([own, x]), r)
    ahead = 0.5 * (float(np.sum((root * z.ravel()) ** 2)) - left)
    if ahead <= price * (x.shape[1] - numbers) + math.log(1.0 / ALPHA):
        return ()
    gone = {token: np.delete(x, np.arange(x.shape[1])[group], axis=1) for token, group in GROUPS.items()}
    told = {token: 0.5 * (_left(np.hstack([own, rest]), r) - left) for token, rest in gone.items()}
    most = max(told.values())
    sure = [token for token in told if told[token] > 3.0 * price or told[token] == most]  # three terms each
    return tuple(sorted(sure, key=lambda token: -told[token]))


def _pushes(given: Problem, fit: Fit, j: int) -> Array | None:
    """(n, nx, 7) by an input as its axis' position and speed have it, their first three powers, dry friction and drag, and always; None if
    it pushes along no axis, or that one does not move.
    """
    model = fit.model
    push = own_pushes(given, model, acting(model, given.data))[j]
    axis = max(axes(model.nominal), key=lambda axis: float(np.sum(push[:, axis.velocity] ** 2)))
    states = quieter(given, fit.noise, given.residual(model))
    q, v = states[:, axis.position] - states[:, axis.position].mean(), states[:, axis.velocity]
    size, pace = float(np.std(q)), float(np.sqrt(np.mean(v**2)))
    if not np.any(push[:, axis.velocity]) or size <= 0.0 or pace <= 0.0:
        return None
    q, v = q / size, v / pace
    terms = np.stack([q, q**2, q**3, v, np.tanh(v / STICKS), v * np.abs(v), np.ones_like(q)], axis=1)
    return np.asarray(push[:, :, None] * terms[:, None, :])


def _left(columns: Array, r: Array) -> float:
    """Squares of what columns (m, k) leave of r (m,)."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    numbers = np.linalg.lstsq(columns / scale, r, rcond=1e-10)[0]
    return float(np.sum((r - columns / scale @ numbers) ** 2))
