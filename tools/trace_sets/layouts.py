"""When states are measured and commands issued, and what becomes of the stamps on their way into the file.

In parts of a step:
    grid       states and commands on the model's grid
    jitter     both up to a third of a step off it, together
    irregular  rows 0.6 to 1.4 steps apart
    other      states and commands together at a rate that is no multiple of the model's
    async      states on the grid, commands on a clock of their own
    late       commands a fixed part of a step after the states
    finer      states and commands some times a step
    split      position and heading on rows of their own, half a step apart
    stamped    on the grid, but each stamp is wrong by up to some per cent of a step
    between    commands on a jittered clock of their own; the file is a table on the grid with the last command in each row
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trace_sets.plants import Plant
from trace_sets.recording import Run
from trace_sets.scale import Scale

Array = NDArray[np.float64]
Whole = NDArray[np.int64]
Rng = np.random.Generator

OFF_GRID = ("jitter", "irregular", "other", "split", "stamped")
"""Layouts for which the truth must not depend on the grid: not for robots that move by Euler's rule."""

ON_GRID = ("async", "late", "finer")


def draw_layout(rng: Rng, plant: Plant, *, euler: bool, plain: float = 0.6) -> str:
    """`plain`: share of recordings on the grid."""
    if rng.random() < plain:
        return "grid"
    return odd_layout(rng, plant, euler=euler)


def odd_layout(rng: Rng, plant: Plant, *, euler: bool = False) -> str:
    """Any but the grid."""
    known = [*ON_GRID, *([] if euler else OFF_GRID)]
    return str(rng.choice([k for k in known if k != "split" or plant.pose]))


def stamps(rng: Rng, layout: str, s: Scale, n: int) -> tuple[Whole, Whole]:
    """(rows, orders) in parts."""
    parts = s.parts
    grid = parts * np.arange(n + 1)
    if layout == "jitter":
        off = rng.integers(0, max(parts // 3, 1) + 1, n + 1)
        off[0] = 0
        return grid + off, grid + off
    if layout == "irregular":
        rows = np.concatenate([[0], np.cumsum(rng.integers(int(0.6 * parts), int(1.4 * parts) + 1, n))])
        return rows, rows
    if layout == "other":
        period = int(rng.choice([k for k in range(max(parts // 3, 2), int(1.3 * parts)) if parts % k and k % parts]))
        rows = period * np.arange(int(n * parts / period) + 1)
        return rows, rows
    if layout == "async":
        period = int(rng.integers(max(parts // 2, 3), 2 * parts))
        wobble = rng.integers(0, max(period // 4, 1) + 1, int(n * parts / period) + 1)
        return grid, int(rng.integers(1, parts)) + period * np.arange(len(wobble)) + wobble
    if layout == "between":
        period = int(rng.integers(max(parts // 2, 3), parts + 1))
        wobble = rng.integers(0, max(period // 3, 1) + 1, int(n * parts / period) + 1)
        wobble[0] = 0
        return grid, period * np.arange(len(wobble)) + wobble
    if layout == "late":
        return grid, grid[:-1] + int(rng.integers(1, parts))
    if layout == "finer":
        rows = parts // int(rng.choice([k for k in (2, 3, 4, 5) if parts % k == 0])) * np.arange(10**6)
        rows = rows[rows <= n * parts]
        return rows, rows
    if layout == "split":
        half = parts // 2
        return np.sort(np.concatenate([grid, grid[:-1] + half])), grid
    return grid, grid


def as_seen(rng: Rng, layout: str, s: Scale, run: Run) -> Run:
    """What the file says of a run, where that is less or other than what was measured."""
    if layout == "stamped":
        off = float(rng.uniform(0.03, 0.25)) * s.dt * rng.uniform(-0.5, 0.5, len(run.t))
        off[0] = 0.0
        return Run(run.t + off, run.y, run.t_u + off[: len(run.t_u)], run.u)
    if layout == "between":
        last = np.searchsorted(run.t_u, run.t + 1e-9, side="right") - 1
        return Run(run.t, run.y, run.t, run.u[np.maximum(last, 0)])
    if layout == "split":
        y = run.y.copy()
        heading = np.arange(len(y)) % 2 == 1
        y[heading, :2] = np.nan
        y[heading, 3:] = np.nan
        y[~heading, 2] = np.nan
        return Run(run.t, y, run.t_u, run.u)
    return run


def lost(rng: Rng, s: Scale, run: Run) -> Run:
    """States that never arrived: some rows, and one gap of up to two seconds; commands are all there."""
    keep = rng.random(len(run.t)) > rng.uniform(0.005, 0.04)
    if rng.random() < 0.5:
        begin, length = float(rng.uniform(0.1, 0.8)), float(rng.uniform(0.02, 0.05))
        keep &= ~((run.t > run.t[0] + begin * s.duration) & (run.t < run.t[0] + begin * s.duration + min(length * s.duration, 2.0)))
    keep[0] = True
    return Run(run.t[keep], run.y[keep], run.t_u, run.u)


def under_way(rng: Rng, run: Run) -> Run:
    """The recorder was started late: what was commanded before is not known, but for what is held."""
    first = int(rng.integers(len(run.t) // 50 + 2, len(run.t) // 8 + 4))
    begin = run.t[first]
    held = int(np.searchsorted(run.t_u, begin, side="right")) - 1
    t_u = np.concatenate([[begin], run.t_u[held + 1 :]])
    return Run(run.t[first:], run.y[first:], t_u, run.u[held:])
