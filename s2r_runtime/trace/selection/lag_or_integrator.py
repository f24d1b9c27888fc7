"""Lags that are integrals.

What follows its command with a time constant T goes for t << T as the integral of the command over T. Where the recording is too short
to tell the two apart, no lag was seen: the input says how fast something grows, and the gains that make up for that are of nothing.
"""

from __future__ import annotations

from collections.abc import Callable

from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.parameters import Slot, values_of
from s2r_runtime.trace.estimation.problem import Fit

LAG = "input_lag"

QUARTER = 0.25
"""Of the longest run: a shorter lag is told from an integral, whatever the interval (`model_order`)."""


def endless(fit: Fit, intervals: Callable[[], dict[Slot, tuple[float, float]]], data: Dataset) -> tuple[str, ...]:
    """Tokens of the inputs on which a lag was found that may be longer than any run. intervals: of the numbers of the fit."""
    longest = max(float(run.durations(data.dt).sum()) for run in data.runs)
    numbers = zip(fit.free, values_of(fit.model, fit.free).tolist(), strict=True)
    long = [slot for slot, value in numbers if fit.model.effects[slot.place].effect.name == LAG and value > QUARTER * longest]
    found = intervals() if long else {}
    channels = [fit.model.effects[slot.place].channel for slot in long if found[slot][1] > longest]
    names = fit.model.inputs if "*" in channels else channels
    return tuple(f"memory({name})" for name in names)
