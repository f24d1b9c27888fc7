"""Other names of what was found, for one and the same thing on this model (`effects.classes`), with the numbers that it has by them."""

from __future__ import annotations

from typing import Any

from s2r_runtime.effects.classes import same
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.trace.found import Found, Limit

Names = dict[tuple[str, str], dict[str, Any]]
"""(effect, channel) -> values."""


def other_names(model: ComposedModel, found: Found) -> tuple[Found, ...]:
    """All of them, with intervals where those of what was found have two ends."""
    low, high = (_at_end(model, found, end) for end in (0, 1))
    called = []
    instead_of = found.instead_of or ((found.name, found.channel),)
    for (name, channel), values in _called(model, found, found.values).items():
        unit = registry().get("effects", name).unit
        ends = {p: _between(low.get((name, channel), {}).get(p), high.get((name, channel), {}).get(p)) for p in values}
        numbers = {p: (value, *ends[p], unit(model.nominal, channel, p)) for p, value in values.items()}
        called.append(Found(name, channel, numbers, instead_of))
    return tuple(called)


def _called(model: ComposedModel, found: Found, values: dict[str, Any]) -> Names:
    return {(name, channel): p for name, channel, p in same(model.for_effects, found.name, found.channel, values)}


def _at_end(model: ComposedModel, found: Found, end: int) -> Names:
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
