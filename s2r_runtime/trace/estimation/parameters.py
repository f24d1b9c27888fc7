"""The numbers of a composed model that a fit may change, one slot each: a parameter, or an entry of a parameter that is a matrix."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Parameter
from s2r_runtime.models.composed import AppliedEffect, ComposedModel

Array = NDArray[np.float64]


class Slot(NamedTuple):
    """place: of the effect in the model's list; name: of its parameter; entry: (row, column) in a matrix, else None."""

    place: int
    name: str
    entry: tuple[int, int] | None = None


Free = tuple[Slot, ...]


@dataclass(frozen=True)
class Added(AppliedEffect):
    """An effect that the tracer added. instead: the one of the model as given in whose place it stands, if it does."""

    instead: AppliedEffect | None = None


def free_of(model: ComposedModel) -> Free:
    """All numbers of the added effects."""
    return tuple(slot for i, a in enumerate(model.effects) if isinstance(a, Added) for slot in slots_of(a, i))


def slots_of(a: AppliedEffect, place: int) -> list[Slot]:
    """The numbers of one effect: exactly those that its values hold."""
    found: list[Slot] = []
    for p in a.effect.parameters:
        value = a.p.get(p.name)
        if isinstance(value, float):
            found.append(Slot(place, p.name))
        elif isinstance(value, list):
            found += [Slot(place, p.name, (i, j)) for i, row in enumerate(value) for j in range(len(row))]
    return found


def bounds_of(model: ComposedModel, slot: Slot) -> Parameter:
    """The parameter's declaration."""
    return next(p for p in model.effects[slot.place].effect.parameters if p.name == slot.name)


def values_of(model: ComposedModel, free: Free) -> Array:
    """(k,) current values."""
    return np.array([_value(model.effects[s.place], s) for s in free], dtype=np.float64)


def with_values(model: ComposedModel, free: Free, values: Array) -> ComposedModel | None:
    """The model with these values, None if they are not allowed."""
    changed: dict[int, dict[str, object]] = {}
    for slot, value in zip(free, values.tolist(), strict=True):
        bounds = bounds_of(model, slot)
        if not bounds.low <= value <= bounds.high:
            return None
        p = changed.setdefault(slot.place, dict(model.effects[slot.place].p))
        if slot.entry is None:
            p[slot.name] = value
        else:
            matrix = [list(row) for row in p[slot.name]]  # type: ignore[attr-defined]
            matrix[slot.entry[0]][slot.entry[1]] = value
            p[slot.name] = matrix
    effects = list(model.effects)
    for place, p in changed.items():
        effects[place] = replace(effects[place], p=p)
        if getattr(effects[place].effect, "wrong", lambda p: "")(p):
            return None
    return replace(model, effects=tuple(effects))


def inside(model: ComposedModel, free: Free, values: Array) -> Array:
    """Values moved into their bounds."""
    bounds = [bounds_of(model, slot) for slot in free]
    return np.clip(values, [b.low for b in bounds], [b.high for b in bounds])


def _value(a: AppliedEffect, slot: Slot) -> float:
    value = a.p[slot.name]
    return float(value if slot.entry is None else value[slot.entry[0]][slot.entry[1]])
