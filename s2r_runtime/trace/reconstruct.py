"""States that were not measured but follow from others and their rates: a speed from positions, a wheel's speed from a pose.

Every stretch without a gap is brought on stamps T apart (as recorded, T their usual distance), states and inputs pass through the same
low-pass (differentiation.py), rates are taken within its bandwidth B, and the missing states are what the model says of them (`follows`).

Filtered rows are correlated over 1 / 2B, the Nyquist interval: steps shorter than that show nothing new, and a fit that took each for a
measurement of its own would be as many times too sure. So what is fitted are steps of about 1 / 2B, or longer (`independent`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import RecordingError
from s2r_runtime.hookspecs import Follows
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace import differentiation
from s2r_runtime.trace.streams import Stream, complete, held_means, unwrapped

Array = NDArray[np.float64]

APART = 2.5
"""Usual intervals between rows from which on nothing is interpolated."""

SNAPPED = 0.01
"""A usual interval this near to a whole fraction of the model's step is that fraction: stamps are printed with a few digits."""


@dataclass(frozen=True)
class Reconstruction:
    """States that were not measured; Hz within which they, and everything with them, were reconstructed; s between the rows used; Hz that
    hold nearly all of the motion.
    """

    states: tuple[str, ...]
    bandwidth: float
    interval: float
    needed: float

    def to_json(self) -> dict[str, object]:
        """docs/json.md's `reconstructed`."""
        return {"states": list(self.states), "bandwidth_hz": self.bandwidth}

    def text(self) -> list[str]:
        """For a person."""
        who = ", ".join(self.states)
        were = "was" if len(self.states) == 1 else "were"
        return [
            f"{who} {were} not measured but reconstructed within {self.bandwidth:g} Hz (--bandwidth HZ)",
            f"all states and inputs were low-passed alike at {self.bandwidth:g} Hz, without delay",
        ]


def reconstruct(
    model: ComposedModel, segments: Sequence[tuple[Stream, Stream]], missing: Sequence[str], source: str, bandwidth: float | None = None
) -> tuple[list[tuple[Stream, Stream]], Reconstruction]:
    """Segments of (measured states in the model's order without the missing ones, inputs), filtered, with all states. bandwidth: Hz; None:
    what the data bear. Raises RecordingError if a missing state does not follow, or if the rows are too few.
    """
    _check_follows(model, missing, source)
    measured = [name for name in model.states if name not in missing]
    angles = [measured.index(name) for name in model.nominal.angles if name in measured]
    given = [(complete(states), inputs) for states, inputs in segments]
    intervals = [np.diff(states.t) for states, _ in given if len(states.t) > 1]
    if not intervals:
        raise RecordingError(f"{source}: has no two rows on which {', '.join(measured)} were measured")
    interval = snapped(float(np.median(np.concatenate(intervals))), model.dt)
    laid = [[_laid(part, interval, angles) for part in _stretches(states, interval)] for states, _ in given]
    rows = [part.values for parts in laid for part in parts if len(part.t) > 2]
    if not rows:
        raise RecordingError(f"{source}: {', '.join(missing)} cannot be reconstructed: no three rows follow one another without a gap")
    band = _checked(bandwidth, interval, source) if bandwidth else differentiation.bandwidth(rows, interval)
    made = []
    for parts, (_, inputs) in zip(laid, given, strict=True):
        whole = [_with_rates(model, part, measured, missing, interval, band) for part in parts]
        states = Stream(np.concatenate([w.t for w in whole]), np.concatenate([w.values for w in whole])) if whole else None
        if states is not None and len(states.t):
            made.append((states, _inputs(inputs, parts[0].t[0], parts[-1].t[-1], interval, band)))
    if not made:
        raise RecordingError(
            f"{source}: {', '.join(missing)} cannot be reconstructed within {band:g} Hz, which takes more than "
            f"{2.0 / band:.3g} s without a gap"
        )
    return made, Reconstruction(tuple(missing), band, interval, min(band, differentiation.bandwidth(rows, interval, rows=0)))


def independent_step(done: Reconstruction, dt: float) -> int:
    """Steps of dt that make one of 1 / 2B or nearly."""
    return max(1, round(1.0 / (2.0 * done.bandwidth * dt)))


def at_step(model: ComposedModel, dt: float) -> ComposedModel:
    """The same model with another step."""
    return replace(model, spec=msgspec.structs.replace(model.spec, dt=dt))


def _check_follows(model: ComposedModel, missing: Sequence[str], source: str) -> None:
    follows = getattr(model.nominal, "follows", {})
    for name in missing:
        of = follows[name].of if name in follows else ()
        if not of or set(of) & set(missing):
            known = "; ".join(f"{state} follows from {', '.join(f.of)}" for state, f in follows.items())
            raise RecordingError(f"{source}: {name} was not measured and does not follow from what was ({known or 'no state of it does'})")


def _checked(bandwidth: float, interval: float, source: str) -> float:
    if bandwidth > 0.5 / interval:
        raise RecordingError(
            f"{source}: a bandwidth of {bandwidth:g} Hz was asked for; rows {interval:.4g} s apart show at most {0.5 / interval:.4g} Hz"
        )
    return bandwidth


def snapped(interval: float, dt: float) -> float:
    """The interval; a whole fraction of dt, if it is nearly one."""
    parts = round(dt / interval)
    return dt / parts if parts and abs(dt / parts - interval) < SNAPPED * interval else interval


def _stretches(states: Stream, interval: float) -> list[Stream]:
    cut = np.flatnonzero(np.diff(states.t) > APART * interval) + 1
    edges = [0, *cut.tolist(), len(states.t)]
    return [Stream(states.t[a:b], states.values[a:b]) for a, b in pairwise(edges) if b - a > 1]


def _laid(states: Stream, interval: float, angles: list[int]) -> Stream:
    """On stamps exactly one interval apart."""
    values = unwrapped(states.values, angles)
    t: Array = states.t[0] + interval * np.arange(round((states.t[-1] - states.t[0]) / interval) + 1)
    return Stream(t, np.column_stack([np.interp(t, states.t, column) for column in values.T]))


def _with_rates(model: ComposedModel, part: Stream, measured: list[str], missing: Sequence[str], interval: float, band: float) -> Stream:
    """All states of one stretch, less the rows at its ends (1 / B) that lean on a reflection."""
    edge = max(1, round(1.0 / (band * interval)))
    if len(part.t) < 2 * edge + 2:
        return Stream(np.zeros(0), np.zeros((0, len(model.states))))
    smooth = differentiation.low_pass(part.values, interval, band)
    rates = differentiation.low_pass(part.values, interval, band, 1)
    x = {name: smooth[:, j] for j, name in enumerate(measured)}
    slope = {name: rates[:, j] for j, name in enumerate(measured)}
    follows: dict[str, Follows] = getattr(model.nominal, "follows", {})
    for name in missing:
        x[name] = follows[name].formula(x, slope, model.parameters)
    values: Array = np.column_stack([x[name] for name in model.states]).astype(np.float64)
    return Stream(part.t[edge:-edge], values[edge:-edge])


def _inputs(inputs: Stream, first: float, last: float, interval: float, band: float) -> Stream:
    """Means over intervals, filtered as the states are; from before the first state, if inputs were there before."""
    early = max(0, math.ceil((first - inputs.t[0]) / interval - 1e-6)) if len(inputs.t) else 0
    begin = first - early * interval
    means = held_means(inputs, begin, max(2, round((last - begin) / interval)), interval, 1)
    t = np.asarray(begin + interval * np.arange(len(means)), dtype=np.float64)
    return Stream(t, differentiation.low_pass(means, interval, band))
