"""Single rows that lack, in recordings of axes whose speed was not measured: bridged, so that what is known of the speed is not lost there.

Without a speed, every gap begins the reckoning anew: it takes many rows until the positions say again how fast the axis is. A row or few
between two that were measured are put on the cubic that has their positions and speeds (Hermite's): off by a 384th of the fourth
derivative times the gap's fourth power, which is far below what a row says by itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.data.dataset import Dataset, Run
from s2r_runtime.trace.sensor_faults.fault import stretches

Array = NDArray[np.float64]

BRIEF = 4
"""Rows that are bridged at most."""

FEW = 3
"""Rows that a line is put through."""


def filled(y: Array) -> Array:
    """y (K+1, nx) with a line through gaps of FEW rows or less, for what may be rough: between two values that are the same, that value."""
    lost = np.asarray(np.isnan(y).any(axis=1))
    gaps = [(a, b) for a, b in stretches(lost) if a > 0 and b < len(y) and b - a <= FEW]
    if not gaps:
        return y
    y = y.copy()
    for a, b in gaps:
        share = np.arange(1, b - a + 1)[:, None] / (b - a + 1)
        y[a:b] = y[a - 1] + share * (y[b] - y[a - 1])
    return y


def bridged(data: Dataset) -> Dataset:
    """The same; unchanged where some state is none of such an axis."""
    pairs = data.axes_without_speed
    if data.reconstruction is not None and data.reconstruction.hidden:  # these are no rates of theirs
        return data
    if {j for pair in pairs for j in pair} != set(range(len(data.states))):
        return data
    return replace(data, runs=tuple(_but_silences(i, run, _bridged(run, pairs, data.dt), data) for i, run in enumerate(data.runs)))


def _but_silences(number: int, run: Run, whole: Run, data: Dataset) -> Run:
    """The bridged run less what lies in silences in which the command changed: nobody knows when."""
    begins = run.begins(data.dt)
    for pause in data.pauses:
        if pause.run != number or not pause.silent:
            continue
        a, b = (int(np.argmin(np.abs(begins - s))) for s in (pause.from_s, pause.to_s))
        if np.any(run.u[a * data.substeps] != run.u[b * data.substeps]):
            whole.y[a + 1 : b] = run.y[a + 1 : b]
    return whole


def _bridged(run: Run, pairs: tuple[tuple[int, int], ...], dt: float) -> Run:
    there = np.flatnonzero(~np.isnan(run.y).any(axis=1))
    gaps = np.flatnonzero((np.diff(there) > 1) & (np.diff(there) <= BRIEF + 1))
    if not len(gaps):
        return run
    y = run.y.copy()
    t = np.concatenate([[0.0], np.cumsum(np.full(len(y) - 1, dt) if run.lasts is None else run.lasts)])
    for a, b in zip(there[gaps].tolist(), there[gaps + 1].tolist(), strict=True):
        h = t[b] - t[a]
        s = (t[a + 1 : b] - t[a]) / h
        for p, v in pairs:
            way, first, last = y[b, p] - y[a, p], h * y[a, v], h * y[b, v]
            bend, twist = 3.0 * way - 2.0 * first - last, first + last - 2.0 * way
            y[a + 1 : b, p] = y[a, p] + s * (first + s * (bend + s * twist))
            y[a + 1 : b, v] = (first + s * (2.0 * bend + 3.0 * s * twist)) / h
    return replace(run, y=y)
