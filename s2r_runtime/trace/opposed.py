"""Does something that opposes an input do what a name on it is said to do?

z = J d + X b + e      z: what is left, whitened; J: by the numbers of what was named; X: pushes by an input, as smooth functions of its
                       axis' own position and speed; e: white

A controller asks of a joint for what its weight and friction take. Input and state then go together, and where the model lacks the
force that goes with the state, it looks as if the input did less: a gain near nothing leaves hardly anything, and no function of the state
explains what is left by it. So both are fitted at once (J. A. Hausman, Specification tests in econometrics, Econometrica 46, 1978): if the
name is right, b is nothing and d does not move but by chance,

    |z - J d0|^2 - |z - J d - X b|^2 ~ chi^2 (columns of X),      d - d0 ~ N(0, Var(d) - Var(d0))

the latter times what the scores of blocks of time scatter beyond white noise. A name that says that an input hardly does anything is not
believed if b is something, whether or not d moves. Only of models with axes (a position, and its speed, that inputs push).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.forces import axes
from s2r_runtime.trace import residual_noise as noises
from s2r_runtime.trace.acceptance import scattered
from s2r_runtime.trace.fitting import SCORE_BLOCKS, Fit, Problem, objective, sensitivities, widening
from s2r_runtime.trace.lack_of_fit_terms import own_pushes, quieter
from s2r_runtime.trace.residual import acting
from s2r_runtime.trace.slots import bounds_of, values_of

Array = NDArray[np.float64]

ALPHA = 1e-3
"""Chance that states seem to push where they do not."""

MOVED = 3.0
"""Standard deviations by which a number of what was named must move."""

MORE = 0.05
"""The same, of how far it is from doing nothing: less is how any model differs from any robot."""

SWALLOWED = 0.3
"""Of what is asked of an input: if less of it is left by what was named, that says that the input hardly does anything."""

STICKS = 0.1
"""Of the usual speed: below that, dry friction grows with it, and is all there beyond."""

GROUPS = {"position": slice(0, 3), "speed": slice(3, 6)}
"""Columns of X by what they depend on; the last one is a constant."""


@dataclass(frozen=True)
class _Beside:
    """Numbers and squares of what is left, of J and some columns of X. covariance: of all of these numbers, (k, k)."""

    numbers: Array
    covariance: Array
    left: float


def opposed(given: Problem, fit: Fit) -> tuple[str, ...]:
    """What pushes against an input that names are about, most first (`position`, `speed`); nothing if these stand."""
    model = fit.model
    if not axes(model.nominal) or not fit.free:
        return ()
    for j, name in enumerate(model.inputs):
        named = [
            i
            for i, slot in enumerate(fit.free)
            if slot.place in fit.added
            and model.effects[slot.place].effect.stage == "input"
            and model.effects[slot.place].channel in {name, "*"}
        ]
        tokens = _opposes(given, fit, j, named) if named else ()
        if tokens:
            return tokens
    return ()


def _opposes(given: Problem, fit: Fit, j: int, named: list[int]) -> tuple[str, ...]:
    """The same of one input. named: which of the fit's numbers are about it."""
    terms = _pushes(given, fit, j)
    if terms is None:
        return ()
    z = objective(given, fit, fit.model)
    root = np.sqrt(noises.weight(z)).ravel()
    r = -root * z.ravel()
    own = root[:, None] * sensitivities(given, fit, fit.model, fit.free)
    x = root[:, None] * fit.colour(fit.whiten(terms), given.steps.joined).reshape(len(root), -1)
    columns, k = np.hstack([own, x]), own.shape[1]
    alone, both = _fitted(own, r), _fitted(columns, r)
    if alone.left - both.left <= 2.0 * _by_chance(x.shape[1]):
        return ()
    scores = columns * (r - columns @ both.numbers)[:, None]
    wide = scattered(widening(scores, both.covariance, z.shape[1], SCORE_BLOCKS)[named])
    moved = (both.numbers[:k] - alone.numbers)[named]
    variance = (np.diag(both.covariance)[:k] - np.diag(alone.covariance))[named]
    surely = np.abs(moved) > MOVED * np.sqrt(np.maximum(variance, 0.0) * wide)
    if not np.any(surely & (np.abs(moved) > MORE * _does(fit, named))) and not _swallowed(given, fit, j):
        return ()
    told = {
        token: _fitted(np.hstack([own, np.delete(x, np.arange(6)[group], axis=1)]), r).left - both.left for token, group in GROUPS.items()
    }
    sure = [token for token in told if told[token] > 2.0 * _by_chance(3)] or [max(told, key=lambda token: told[token])]
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


def _swallowed(given: Problem, fit: Fit, j: int) -> bool:
    """Whether hardly anything is left of an input, or it goes the other way."""
    asked, left = (acting(fit.model, given.data, *which).mean[given.steps.place, j] for which in (((),), ()))
    asked = asked - asked.mean()
    return float(asked @ left) < SWALLOWED * float(asked @ asked)


def _fitted(columns: Array, r: Array) -> _Beside:
    normal = columns.T @ columns
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    covariance = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-10, hermitian=True) / np.outer(scale, scale)
    numbers = covariance @ (columns.T @ r)
    return _Beside(numbers, np.asarray(covariance), float(np.sum((r - columns @ numbers) ** 2)))


def _by_chance(terms: int) -> float:
    """Nats that so many terms of no meaning gain with a chance of ALPHA."""
    from scipy.special import gammaincinv

    return float(gammaincinv(0.5 * terms, 1.0 - ALPHA))


def _does(fit: Fit, named: list[int]) -> Array:
    """How far numbers are from where they would do nothing."""
    slots = tuple(fit.free[i] for i in named)
    neutral = [bounds_of(fit.model, slot).neutral or 0.0 for slot in slots]
    return np.asarray(np.abs(values_of(fit.model, slots) - np.array(neutral)))
