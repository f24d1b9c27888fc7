"""Which input of a model is a force: one whose unit changes a speed by 1/mass in a second, in one direction or spread over several.

A propeller's speed is none, nor is a valve's opening, although what they do is divided by the mass in the end.
"""

from __future__ import annotations

import contextlib
from weakref import WeakKeyDictionary

import numpy as np

from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import NominalModel
from s2r_runtime.models.bound import BoundModel, bind
from s2r_runtime.models.forces import SHORT_S, Axis, axes, coupled, mass, mass_on, response

NEAR = 0.02
"""Of 1/mass: what a model loses to its own friction within the probe is less."""

_KNOWN: WeakKeyDictionary[BoundModel, str | None] = WeakKeyDictionary()
_ON_AXES: WeakKeyDictionary[BoundModel, dict[Axis, str | None]] = WeakKeyDictionary()


def input_on(model: NominalModel, axis: Axis) -> str | None:
    """Name of the input that is the force on this axis: a unit of it adds 1/mass to the speed in a second; None if none does.

    Of axes that move one another, the input in the same place.
    """
    if not isinstance(model, BoundModel):
        return _input_on(bind(model, {}), axis)
    known = _ON_AXES.setdefault(model, {})
    if axis not in known:
        known[axis] = _input_on(model, axis)
    return known[axis]


def _input_on(model: BoundModel, axis: Axis) -> str | None:
    if coupled(model):
        return model.inputs[axes(model).index(axis)]
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (8, len(model.states)))
    try:
        found = response(x, np.zeros((len(x), len(model.inputs))), model, SHORT_S, 1.0 / SHORT_S)[:, axis.velocity] / SHORT_S
    except ConfigError:  # a user's model cannot be stepped just anywhere
        return None
    alike = np.all(np.abs(mass_on(model, model.states[axis.velocity]) * found - 1.0) < NEAR, axis=0)
    return next((name for name, one in zip(model.inputs, alike, strict=True) if one), None)


def force_input(model: NominalModel) -> str | None:
    """Its name, the first one's if there are several; None if none is. Of a model that is not somebody's own: the first input."""
    if not isinstance(model, BoundModel):
        return model.inputs[0]
    if model not in _KNOWN:
        _KNOWN[model] = _found(model)
    return _KNOWN[model]


def _found(model: BoundModel) -> str | None:
    """Asked at rest, and where one state is 1: an attitude may be a quaternion, of which no rotation is (0, 0, 0, 0)."""
    n, rest = len(model.states), np.zeros((1, len(model.inputs)))
    asked = found = None
    for x in (np.zeros((1, n)), *np.eye(n)[:, None]):
        with contextlib.suppress(ConfigError):  # a user's model cannot be stepped just anywhere
            asked = response(x, rest, model, SHORT_S, 1.0 / SHORT_S)[0, [axis.velocity for axis in axes(model)]]
            size = mass(model) / SHORT_S * np.sqrt(np.sum(asked**2, axis=0))
            found = next((name for name, one in zip(model.inputs, size, strict=True) if abs(one - 1.0) < NEAR), None)
        if found is not None:
            return found
    return model.inputs[0] if asked is None else None
