"""States that were not measured, and that the motion does not need: what a model sets to an input at once, and never looks at again.

    f(x, u) = (p', s')      p' = p'(p, u),   s' = s'(u)       p: what was measured, s: what was not

A car's speed and a wheel's speed are such states. The residual of p is what it is without s; nothing has to be differentiated or
filtered for it, and every row stays a measurement of its own. So the tracer works on the model of p alone. Effects that s alone
would tell apart are then one and the same (a wheel's gain on both wheels and slip), and are named so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import NominalModel
from s2r_runtime.models.bound import BoundModel
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset, regridded
from s2r_runtime.trace.data.streams import Stream

Array = NDArray[np.float64]

TRIED, TRIED_DT_S, SAME = 8, 0.1, 1e-12
"""Random states on which a step is tried with other values of what was not measured, the step, and what counts as no difference."""


@dataclass(eq=False)
class _Without:
    """A nominal model without some of its states, which its step is given as zero."""

    full: NominalModel
    kept: tuple[int, ...]
    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    angles: tuple[str, ...]
    parameters: dict[str, float]
    integration: str

    def step(self, x: Array, u: Array, dt: float, parameters: dict[str, float]) -> Array:
        """The full model's, (n, kept)."""
        whole = np.zeros((len(x), len(self.full.states)))
        whole[:, self.kept] = x
        return self.full.step(whole, u, dt, parameters)[:, self.kept]


def unneeded(model: ComposedModel, missing: Sequence[str]) -> tuple[str, ...]:
    """Those of the missing states that the motion of the others does not need."""
    nominal = model.nominal
    touched = {a.channel for a in model.effects}
    names = tuple(s for s in missing if s in nominal.reached and s not in touched)
    rest = [i for i, s in enumerate(nominal.states) if s not in names]
    if not names or not rest:
        return ()
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1.0, 1.0, (TRIED, len(nominal.states))), rng.uniform(-1.0, 1.0, (TRIED, len(nominal.inputs)))
    other = x.copy()
    other[:, [nominal.states.index(s) for s in names]] = rng.uniform(-1.0, 1.0, (TRIED, len(names)))
    try:
        made = [nominal.step(at, u, TRIED_DT_S, nominal.parameters)[:, rest] for at in (x, other)]
    except ConfigError:  # a user's model that cannot be stepped just anywhere
        return ()
    return names if float(np.max(np.abs(made[0] - made[1]))) < SAME else ()


def without(model: ComposedModel, names: Sequence[str]) -> ComposedModel:
    """The model of the other states: the same spec, the same effects."""
    if not names:
        return model
    nominal = model.nominal
    kept = tuple(i for i, s in enumerate(nominal.states) if s not in names)
    states = tuple(nominal.states[i] for i in kept)
    angles = tuple(a for a in nominal.angles if a in states)
    rule = getattr(nominal.shared, "integration", "")
    less = _Without(nominal.shared, kept, nominal.name, states, nominal.inputs, angles, nominal.parameters, rule)
    there = {s: u for s, u in nominal.reached.items() if s in states}
    follows = {s: f for s, f in nominal.follows.items() if {s, *f.of} <= set(states)}
    bound = BoundModel(
        less, nominal.name, states, nominal.inputs, angles, nominal.parameters, nominal.units, nominal.integration, there, follows
    )
    return replace(model, nominal=bound)


def alike(model: ComposedModel, data: Dataset, test: Dataset | None) -> tuple[ComposedModel, Dataset, Dataset | None]:
    """Model and recordings with the states that both recordings have, where the motion does not need the others."""
    there = set(data.states) & set(test.states if test else data.states)
    names = [s for s in model.states if s not in there]
    if not names or set(unneeded(model, names)) != set(names):
        return model, data, test
    less = without(model, names)
    return less, _seen(data, less), None if test is None else _seen(test, less)


def _seen(data: Dataset, model: ComposedModel) -> Dataset:
    """The recording with the model's states alone."""
    if data.states == model.states:
        return data
    columns = [data.states.index(s) for s in model.states]
    cut = tuple((Stream(measured.t, measured.values[:, columns]), inputs) for measured, inputs in data.segments)
    return regridded(replace(data, segments=cut), model)
