"""Dictionaries of terms (see `basis`) in two things at once, and of what comes again with what was named."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation.prediction import Steps

Array = NDArray[np.float64]
Terms = list[Array]

FROM = (0.1, 0.25, 0.5)
"""Of its largest size, from which on a product may act: wheels slide beyond what the floor holds."""

OVERTONES = (2, 3, 4, 5)
"""Times the frequency that was named: a square wave has the third and the fifth, what only pushes one way the second."""


def bent_product(a: Array, b: Array) -> Terms:
    """Shapes of the product of two inputs (n,), each on a scale of 1: of itself, not of either; all are none where it is."""
    p = a * b
    p = p / max(float(np.max(np.abs(p), initial=0.0)), 1e-300)
    size = np.abs(p)
    return [p, p * size, *(np.sign(p) * np.maximum(size - s, 0.0) for s in FROM)]


def over_time(t: Array, moving: Sequence[Array]) -> Terms:
    """Friction that is more at one time than at another (a bearing that warms up): t (n,) from 0 to 1, moving: of speeds, (n,) each."""
    waves = [np.ones(len(t)), t, *(f(np.pi * k * t) for k in (1, 2) for f in (np.sin, np.cos))]
    return [wave * f for f in moving for wave in waves]


def overtones(steps: Steps, model: ComposedModel, dt: float, pushes: Sequence[Array]) -> Iterator[Terms]:
    """Of each sine that was named on an input: what comes again as often, and is no sine. pushes: (n, nx) what each input does. None of
    what comes oftener than once in two steps: four times 5 Hz is a constant to one who looks every 50 ms.
    """
    t = steps.t - steps.t[0] + 0.5 * dt
    for a in model.effects:
        if a.channel in model.inputs and "frequency" in a.p:
            push = pushes[model.inputs.index(a.channel)]
            turns = 2.0 * np.pi * float(a.p["frequency"]) * t
            seen = [k for k in OVERTONES if k * float(a.p["frequency"]) * dt < 0.5]
            if seen:
                yield [f(k * turns)[:, None] * push for k in seen for f in (np.sin, np.cos)]
