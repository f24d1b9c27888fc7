"""A nominal model with the parameter values that are used: what effects are given.

A registered model is one object that everybody shares, and its `parameters` are defaults. Here they are the values of one composed model;
the rest is the shared model's.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Follows, NominalModel

Array = NDArray[np.float64]


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

    def step(self, x: Array, u: Array, dt: float, parameters: dict[str, float]) -> Array:
        """The shared model's."""
        return self.shared.step(x, u, dt, parameters)


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
    """The model as one that integrates its pose by this scheme."""
    if scheme == model.integration:
        return model
    if scheme not in model.schemes:
        model.schemes[scheme] = replace(model, integration=scheme, schemes={})
    return model.schemes[scheme]
