"""How inputs went that a recording has samples of: between its rows, and less the noise of the sensors that told them.

u_k = a_k + n_k                    a: what acted at the row's stamp, n: white noise of its sensor
a'_k = u_k + clean (s_k - u_k)     s: a smoothing spline through u, as smooth as its own likelihood says (`speed_spline`)
a''_k = a'_k + on (m_k - a'_k)     m: the mean over the row of a cubic through a'
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.estimation.speed_spline import FEWEST, less_noise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOVING = 0.5
"""Share of the rows in which an input is another one than in the row before: one that changes in fewer is a command that is held."""


@dataclass(frozen=True)
class Way:
    """By input, (nu,): on: share of halfway to the next one by which it moved on; clean: share of its noise that is taken out. late: each
    row tells what acted over the row before it. within: what is held changed between rows, as far on as the samples know.
    """

    on: tuple[float, ...] = ()
    clean: tuple[float, ...] = ()
    late: bool = False
    within: bool = False

    def __bool__(self) -> bool:
        return self.late or self.within or any(self.on) or any(self.clean)

    @property
    def most(self) -> float:
        """The largest share by which one of them moved on."""
        return max(self.on, default=0.0)


def moving(inputs: Sequence[Stream]) -> Mask:
    """(nu,) which inputs change in most rows."""
    changed = np.concatenate([np.diff(stream.values, axis=0) for stream in inputs])
    return np.asarray(np.mean((changed != 0.0) & np.isfinite(changed), axis=0) > MOVING)


def less_noise_of(inputs: Stream, ratios: Sequence[float] = ()) -> tuple[Stream, tuple[float, ...]]:
    """Inputs without the noise of samples, where they change in most rows, and how smooth each is (`speed_spline`; NaN where it is as it
    was). ratios: the latter, where it is known.
    """
    values, told = inputs.values.copy(), [math.nan] * inputs.values.shape[1]
    sure = moving([inputs]) & np.isfinite(inputs.values).all(axis=0) & (np.count_nonzero(np.diff(inputs.t)) + 1 >= FEWEST)
    for j in np.flatnonzero(sure).tolist():
        known = ratios[j] if ratios else None
        if known is None or math.isfinite(known):
            values[:, j], _, told[j] = less_noise(inputs.t, inputs.values[:, j], known)
    return Stream(inputs.t, values), tuple(told)


class Samples:
    """Inputs as sampled, and without their noise. smooth: the latter, if it is known; noise: (nu,) standard deviations of it."""

    def __init__(self, inputs: Sequence[Stream], smooth: Sequence[Stream] = ()) -> None:
        self._inputs = inputs
        longest = int(np.argmax([len(stream.t) for stream in inputs]))
        known = [less_noise_of(inputs[longest])] if not smooth else []
        ratios = known[0][1] if known else ()
        self._smooth = [one.values for one in smooth] or [less_noise_of(one, ratios)[0].values for one in inputs]
        off = self._inputs[longest].values - self._smooth[longest]
        self.noise = np.sqrt(np.mean(off**2, axis=0))
        self.within = [_changing(one.values).astype(np.float64) for one in inputs]
        """(N, nu) of each segment: how far a change came before its row, in halves of a row; 0 where there is none."""

    def as_of(self, others: Samples) -> Samples:
        """These, of another recording in which no other inputs change within rows than in the one that was placed; each at its mean."""
        chosen = np.any([one.any(axis=0) for one in others.within], axis=0)
        self.within = [one * chosen for one in self.within]
        return self

    def laid(self, way: Way) -> list[Stream]:
        """The inputs as they went."""
        if way.within:
            return [
                Stream(one.t, one.values + 0.5 * halves * _ahead(one.values)) for one, halves in zip(self._inputs, self.within, strict=True)
            ]
        return [Stream(one.t, _went(one.values, smooth, way)) for one, smooth in zip(self._inputs, self._smooth, strict=True)]

    def changes(self) -> list[tuple[int, int, float]]:
        """(segment, row, stamp) of each row before one that tells a change, in order."""
        return [
            (place, k, float(one.t[k]))
            for place, one in enumerate(self._inputs)
            for k in np.flatnonzero(_changing(one.values).any(axis=1)).tolist()
        ]


def _went(values: Array, smooth: Array, way: Way) -> Array:
    if way.late:
        return np.concatenate([values[1:], values[-1:]])
    cleaned = values + np.array(way.clean) * (smooth - values)
    went = cleaned + np.array(way.on) * (_means(cleaned) - cleaned)
    ends = [end(values, axis=0, initial=-size, where=np.isfinite(values)) for end, size in ((np.min, -np.inf), (np.max, np.inf))]
    return np.asarray(np.clip(went, *ends))  # a valve that was closed did not open the other way between two rows


def _ahead(values: Array) -> Array:
    """(N, nu) by how much the next row differs."""
    return np.diff(values, axis=0, append=values[-1:])


def _changing(values: Array) -> Mask:
    """(N, nu) whether the next row tells something else."""
    return np.asarray(_ahead(values) != 0.0)


def _means(values: Array) -> Array:
    """Over each row, of a cubic through the rows around: a straight line cuts a sine's corners."""
    before, after, late = (np.concatenate([values[:1], values, values[-1:], values[-1:]])[k : k + len(values)] for k in (0, 2, 3))
    return np.asarray(0.5 * (values + after) - (late - after - values + before) / 24.0)
