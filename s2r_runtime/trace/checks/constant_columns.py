"""A state that says the same in every row although the robot moves it was never measured.

    m_k = f(y_k) - y_k             what the model moves it by in step k
    D   = rms(m_k + .. + m_{k+W-1}) / (sqrt(W) rms(m))       1 if that is noise of other states, sqrt(W) if it goes somewhere

Where the model sets a state to an input at once, the way is what the input goes: under the same command all the time, a car's speed says
the same. A robot that stood still (every state says the same) is another matter, and so is a coarse sensor in whose last digit it stayed.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.prediction import Steps, acting, predicted, steps_of

Array = NDArray[np.float64]

WINDOW, SOMEWHERE = 10, 1.8
"""W, and D from which a state goes somewhere."""

SHARE = 0.1
"""Of the way that a state of the same unit goes: less may be within what its sensor resolves."""

TURNS = 0.2
"""Rad that an angle must turn, likewise."""

FEWEST = 20
"""Steps from which it is told."""


def check_measured(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if a state never changes although the model, from what was measured beside it, says that it does."""
    steps = steps_of(data)
    if len(steps) < FEWEST:
        return
    same = np.ptp(np.concatenate([steps.y0, steps.y1]), axis=0) == 0.0
    if not same.any() or same.all():
        return
    foretold = predicted(model, steps, acting(model, data))
    moves = model.difference(foretold, steps.y0)
    at_once = np.array([name in model.nominal.reached for name in model.states])
    ways = np.where(at_once, np.ptp(foretold, axis=0), [_way(steps, column) for column in moves.T])
    units: dict[str, str] = getattr(model.nominal, "units", {})
    unit = [units.get(name, name) for name in model.states]
    for j in np.flatnonzero(same).tolist():
        name = model.states[j]
        most = max(way for way, u in zip(ways.tolist(), unit, strict=True) if u == unit[j])
        least = TURNS if name in model.nominal.angles else SHARE * most
        if ways[j] > least and (at_once[j] or _directed(moves[:, j])):
            hint = "; leave its column out" if name in model.nominal.follows else ""
            raise RecordingError(
                f"{data.source}: {name} is {steps.y0[0, j]:.6g} in every row although the model moves it: it was not measured{hint}"
            )


def _way(steps: Steps, moves: Array) -> float:
    """From one end to the other of where the moves lead, over the run in which that is most."""
    return max(float(np.ptp(np.cumsum(moves[steps.run == run]))) for run in np.unique(steps.run))


def _directed(moves: Array) -> bool:
    size = math.sqrt(WINDOW) * float(np.sqrt(np.mean(moves**2)))
    sums = np.convolve(moves, np.ones(WINDOW), mode="valid")
    return size > 0.0 and float(np.sqrt(np.mean(sums**2))) > SOMEWHERE * size
