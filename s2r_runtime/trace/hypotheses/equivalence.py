"""Other names of what was found, for one and the same thing on this model (`effects.classes`), with the numbers that it has by them.

Beside other effects a name may mean another thing: half the gain before a limit is not half the yaw rate behind it. So each is put in the
place of what was found, and told only if the whole model goes on as it did.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.effects.classes import same
from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.trace.reporting.found import Found, Limit

Array = NDArray[np.float64]
Name = tuple[str, str]
"""(effect, channel)."""

TRIED, STEPS, DECADES, ALIKE = 24, 12, (-2.0, 2.0), 1e-12
"""Robots and steps on which two models are held against each other, powers of ten within which their states and inputs are, from row to row
elsewhere, and what counts as alike, of the larger.
"""

SOON = 2.5
"""Steps to which longer times of the other effects are cut: what comes after a second does not show within a few steps."""


def other_names(model: ComposedModel, place: int, found: Found) -> tuple[Found, ...]:
    """All names by which the model goes on as it does, with intervals where those of what was found have two ends. place: of the effect."""
    low, high = (_at_end(model, found, end) for end in (0, 1))
    called = []
    for (name, channel), values in _called(model, found, found.values).items():
        effect = registry().get("effects", name)
        if not _goes_on(model, place, AppliedEffect(effect, channel, values)):
            continue
        ends = {p: _between(low.get((name, channel), {}).get(p), high.get((name, channel), {}).get(p)) for p in values}
        numbers = {p: (value, *ends[p], effect.unit(model.nominal, channel, p)) for p, value in values.items()}
        called.append(Found(name, channel, numbers, ((found.name, found.channel),), same_thing=True))
    return tuple(called)


def _called(model: ComposedModel, found: Found, values: dict[str, Any]) -> dict[Name, dict[str, Any]]:
    return {(name, channel): p for name, channel, p in same(model.for_effects, found.name, found.channel, values)}


def _goes_on(model: ComposedModel, place: int, other: AppliedEffect) -> bool:
    """Whether the model does the same with another effect in this place, or at the end of its list."""
    before, after = (tuple(_soon(model, a) for a in part) for part in (model.effects[:place], model.effects[place + 1 :]))
    orders = (*before, model.effects[place], *after), (*before, other, *after), (*before, *after, other)
    with np.errstate(all="ignore"):  # anywhere is also where numbers leave what a computer holds: what does is not alike
        usual, *tried = (_walked(replace(model, effects=order)) for order in orders)
        return usual is not None and any(there is not None and _alike(there, usual) for there in tried)


def _soon(model: ComposedModel, a: AppliedEffect) -> AppliedEffect:
    """The same effect, with its times cut short."""
    at_once = {q.name for q in a.effect.parameters if q.unit == "s"}
    cut = {name: min(v, SOON * model.dt) for name, v in a.p.items() if name in at_once and isinstance(v, float)}
    return AppliedEffect(a.effect, a.channel, {**a.p, **cut})


def _alike(there: Array, usual: Array) -> bool:
    return bool(np.all(np.abs(there - usual) <= ALIKE * np.maximum(1.0, np.abs(usual))))


def _walked(model: ComposedModel) -> Array | None:
    """(STEPS, TRIED, nx) one step later, from states and under inputs anywhere, hidden states as they come; None where a user's own model
    gives no numbers there.
    """
    rng = np.random.default_rng(0)
    hidden, rows = model.at_rest(TRIED), []

    def anywhere(columns: int) -> Array:
        sizes: Array = 10.0 ** rng.uniform(*DECADES, (TRIED, columns))
        return np.asarray(sizes * rng.choice([-1.0, 1.0], (TRIED, columns)))

    try:
        for _ in range(STEPS):
            x, u = anywhere(len(model.states)), anywhere(len(model.inputs))
            after, hidden = model.step(x, u, hidden)
            rows.append(after)
    except ConfigError:
        return None
    told: Array = np.array(rows)
    return told


def _at_end(model: ComposedModel, found: Found, end: int) -> dict[Name, dict[str, Any]]:
    """With all numbers at one end of their intervals; nothing, where one has none."""
    values: dict[str, Any] = {}
    for name, (value, *ends, _) in found.parameters.items():
        if isinstance(value, float) and ends[end] is None:
            return {}
        values[name] = ends[end] if isinstance(value, float) else value
    return _called(model, found, values)


def _between(one: object, other: object) -> tuple[Limit, Limit]:
    """An interval by its two ends, in order: the larger gain is the smaller mass. None of what is 0 by that name."""
    if not isinstance(one, float) or not isinstance(other, float) or one == other:
        return None, None
    return min(one, other), max(one, other)
