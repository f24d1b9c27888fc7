"""A nominal model with the parameter values that are used: what effects are given.

A registered model is one object that everybody shares, and its `parameters` are defaults. Here they are the values of one composed model;
the rest is the shared model's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import Follows, NominalModel

Array = NDArray[np.float64]

PROBE_S, PROBED, ROUNDING = 0.1, (1.0, 0.1, 10.0), 1e-7
"""Step at which a model is asked how it integrates, s; sizes of the states; and what is rounding, over what moved. A rule of the first
order is off by half of the step over a time constant: a millionth for one of a day.
"""


def wrap(angle: Array) -> Array:
    """Angles in rad, to (-pi, pi]; any shape."""
    return -((-angle + math.pi) % (2.0 * math.pi) - math.pi)


@dataclass(eq=False)
class BoundModel:
    """shared: the nominal model itself; parameters: the values used. The others as in `NominalModel`, empty where it does not say."""

    shared: NominalModel
    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    angles: tuple[str, ...]
    parameters: dict[str, float]
    units: dict[str, str]
    integration: str
    reached: dict[str, str]
    follows: dict[str, Follows]
    schemes: dict[str, BoundModel] = field(default_factory=dict, repr=False)
    """The same by the scheme that integrates its pose, as far as asked for: one object a scheme."""
    finer: bool = False
    """Whether its own step is taken in parts, as a model is that says nothing of how it integrates."""

    def step(self, x: Array, u: Array, dt: float, parameters: dict[str, float]) -> Array:
        """The shared model's; in parts, one step, two of half the length and four of a quarter, with what their differences say of none at
        all: (8 x4 - 6 x2 + x1) / 3, right to the third order where a step is to the first (L. F. Richardson, 1911; W. Romberg, 1955).
        """
        if not self.finer:
            return self.shared.step(x, u, dt, parameters)
        one, two, four = (self._in(parts, x, u, dt, parameters) for parts in (1, 2, 4))
        two, four = (one + turned(self, there - one) for there in (two, four))  # a step may bring a heading back into one turn
        return np.asarray(four + (5.0 * (four - two) + (one - two)) / 3.0)

    def _in(self, parts: int, x: Array, u: Array, dt: float, parameters: dict[str, float]) -> Array:
        for _ in range(parts):
            x = self.shared.step(x, u, dt / parts, parameters)
        return x


SHORT, CONVERGES = 1e-3, 0.7
"""Of that step, in which a model goes next to nowhere; and the share of what halving it changes that halving it again may change at most
(half, by Euler's rule). A model that was identified for one step alone, and does not ask how long it is, does neither: that is no rule.
"""

_COARSELY: WeakKeyDictionary[BoundModel, bool] = WeakKeyDictionary()


def bind(model: NominalModel, parameters: dict[str, float]) -> BoundModel:
    """The model with these values instead of defaults; parameters that are not given keep theirs."""
    return BoundModel(
        model,
        model.name,
        tuple(model.states),
        tuple(model.inputs),
        tuple(model.angles),
        {**model.parameters, **parameters},
        getattr(model, "units", {}),
        getattr(model, "integration", ""),
        getattr(model, "reached", {}),
        getattr(model, "follows", {}),
    )


def integrating(model: BoundModel, scheme: str) -> BoundModel:
    """The model as one that integrates its pose by this scheme; in finer steps, if it does not say that it has a pose."""
    if scheme == model.integration:
        return model
    if scheme not in model.schemes:
        other = replace(model, integration=scheme) if model.integration else replace(model, finer=scheme != "euler")
        model.schemes[scheme] = replace(other, schemes={})
    return model.schemes[scheme]


def steps_coarsely(model: NominalModel) -> bool:
    """Whether two steps of half the length lead elsewhere than one: it is integrated by a rule. Asked at random states of several sizes, as
    far as the model gives numbers there.
    """
    if not isinstance(model, BoundModel):
        return any(_coarse_at(model, scale) for scale in PROBED)
    if model not in _COARSELY:
        _COARSELY[model] = any(_coarse_at(model, scale) for scale in PROBED)
    return _COARSELY[model]


def _coarse_at(model: NominalModel, scale: float) -> bool:
    rng = np.random.default_rng(0)
    x, u = (scale * rng.uniform(0.2, 1.0, (4, len(names))) for names in (model.states, model.inputs))

    def gone(parts: int, lasts: float = PROBE_S) -> Array:
        there = x
        for _ in range(parts):
            there = model.step(there, u, lasts / parts, model.parameters)
        return turned(model, there - x)

    try:
        one, two, four, hardly = gone(1), gone(2), gone(4), gone(1, SHORT * PROBE_S)
    except (ConfigError, ArithmeticError, ValueError):  # not everywhere does somebody's own model give numbers
        return False
    moved, apart, next_apart, stays = (
        float(np.max(np.abs(e), initial=0.0)) for e in (one, turned(model, two - one), turned(model, four - two), hardly)
    )
    converges = next_apart < CONVERGES * apart and stays < 0.5 * moved
    return apart > ROUNDING * moved and converges


def turned(model: NominalModel, change: Array) -> Array:
    """A change of states (n, nx) by less than half a turn, where these are angles."""
    columns = [model.states.index(name) for name in model.angles]
    if columns:
        change = change.copy()
        change[:, columns] = wrap(change[:, columns])
    return change
