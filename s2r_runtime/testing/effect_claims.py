"""How far an effect on inputs is from what it claims of itself; 0 where the claim is true. E: the effect over time, u: (T, nu).

linear     E(u) - E(0) is linear in u, and commutes with a gain, a lag and a delay on the same channel
shift      E(g(u)) = g(E(u)) for a curve g, wherever E(u) is one of the values of u (not in the middle of a step between two)
additive   E(u; p) - u is the sum over parameters of E(u; the others neutral) - u, and in proportion to each one's distance from neutral
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Effect, NominalModel

Array = NDArray[np.float64]
Values = dict[str, Any]

DIGITS = 9
"""To which two values are the same: a mean of equal ones is rounded."""


def linear_gap(effect: Effect, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> float:
    """Largest deviation from superposition and from commuting with linear filters."""
    bend = effect.input_sequence(np.zeros_like(u), model, channel, dt, p)

    def response(given: Array) -> Array:
        return effect.input_sequence(given, model, channel, dt, p) - bend

    other = np.roll(u, 7, axis=0) * 1.7
    columns = _columns(model, channel)
    commuting = [response(_on(u, columns, f)) - _on(response(u), columns, f) for f in _filters()]
    gaps = [response(u + other) - response(u) - response(other), *commuting]
    return max(float(np.max(np.abs(gap))) for gap in gaps)


def shift_gap(effect: Effect, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> float:
    """Largest deviation from commuting with a curve. Infinite if what acts is hardly ever a value of the input."""
    columns = _columns(model, channel)
    here = effect.input_sequence(u, model, channel, dt, p)
    there = effect.input_sequence(_on(u, columns, _curve), model, channel, dt, p)
    gaps = []
    for j in columns:
        known = np.isin(here[:, j].round(DIGITS), np.append(u[:, j], 0.0).round(DIGITS))
        if np.count_nonzero(known) < 0.5 * len(u):
            return np.inf
        gaps.append(float(np.max(np.abs(there[known, j] - _curve(here[known, j])))))
    return max(gaps)


def additive_gap(effect: Effect, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> float:
    """Largest deviation from the sum over the parameters, and from proportion."""
    neutral = {q.name: q.neutral for q in effect.parameters if isinstance(p.get(q.name), float)}

    def done(values: Values) -> Array:
        return effect.input_sequence(u, model, channel, dt, {**p, **values}) - u

    alone = {name: done({**neutral, name: p[name]}) for name in neutral}
    gaps = [done({}) - sum(alone.values())]
    for name, at in neutral.items():
        gaps.append(done({**neutral, name: at + 0.5 * (p[name] - at)}) - 0.5 * alone[name])
    return max(float(np.max(np.abs(gap))) for gap in gaps)


def first_of(model: NominalModel, channel: str) -> str:
    """The first other input."""
    return next(name for name in model.inputs if name != channel)


def _columns(model: NominalModel, channel: str) -> list[int]:
    return [model.inputs.index(channel)] if channel in model.inputs else list(range(len(model.inputs)))


def _on(u: Array, columns: list[int], f: Callable[[Array], Array]) -> Array:
    after = u.copy()
    for j in columns:
        after[:, j] = f(u[:, j])
    return after


def _curve(u: Array) -> Array:
    """Bent and clipped, zero at zero."""
    return np.minimum(np.maximum(u + u**3, -0.5), 0.8)


def _filters() -> tuple[Callable[[Array], Array], ...]:
    """A gain, a first-order lag, a delay of three steps, of a column (T,)."""

    def lag(u: Array) -> Array:
        s, after = 0.0, []
        for value in u.tolist():
            s += 0.3 * (value - s)
            after.append(s)
        return np.array(after)

    return (lambda u: -0.7 * u, lag, lambda u: np.concatenate([np.zeros(3), u[:-3]]))
