"""Transitions of ordinary driving: a stream of measured states and a stream of inputs, neither on the other's stamps (docs/log-format.md).

A grid of the model's step dt is laid over the drive from the first stamp at which every state was received; x0 and x1 of transition k are
the states at t_k and t_k + dt, each interpolated linearly between its own two neighbours (angles unwrapped), and u is the held
input averaged over [t_k, t_k + dt). One transition follows the other: they are not independent draws of anything.

Left out, and counted: `state_gap`, where a grid point lies in a hole of a state's stream longer than MAX_GAP steps; `no_input`, before
every input was received once. The inputs of all steps are kept all the same (`Drive`): an effect with memory needs them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.bound import wrap
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.recordings.sensor_noise import stream_noise
from s2r_runtime.recordings.transitions import Drive, Transitions

Array = NDArray[np.float64]

MAX_GAP = 1.5
"""Steps. In a longer hole both ends of a transition may be interpolated from the same two measurements: nothing was measured then."""
MOST_STEPS = 100.0
"""Of the model from row to row: more says that a unit of time is wrong, and the grid of them all would fill the memory."""
SILENCE_S = 60.0
"""After so long without any row the drive begins anew, at rest."""
WARM_UP_S = 3.0
"""Of driving, after which what was commanded before a cut does not act any more: longer than delays and time constants of motors."""
REASONS = ("", "state_gap", "no_input", "cut", "outside")
"""Why a step is left out; empty: it is not."""
DOUBT = "the transitions are of ordinary driving, one follows the other, and were not drawn independently"


@dataclass(frozen=True)
class Streams:
    """t: (N,) s, not running backwards; x: (N, nx) and u: (N, nu), NaN where nothing was received at that stamp."""

    t: Array
    x: Array
    u: Array

    def rows(self, chosen: slice) -> Streams:
        """A part of it."""
        return Streams(self.t[chosen], self.x[chosen], self.u[chosen])


def resolution(t: Array, dt: float) -> float:
    """Stamps nearer than this are the same: rounding of decimal stamps, and of large ones (seconds since 1970)."""
    return max(1e-6 * dt, 4.0 * float(np.spacing(np.max(np.abs(t)))))


def state_at(streams: Streams, column: int, when: Array, angle: bool, tolerance: float) -> tuple[Array, Array]:
    """One state at `when` (m,): (values (m,), width of the hole around each (m,): 0 on a stamp, inf outside of the stream)."""
    received = np.isfinite(streams.x[:, column])
    t, x = streams.t[received], streams.x[received, column]
    if len(t) == 0:
        return np.full(len(when), np.nan), np.full(len(when), np.inf)
    if angle:
        x = np.unwrap(x)
    after = np.clip(np.searchsorted(t, when - tolerance), 0, len(t) - 1)
    before = np.clip(np.searchsorted(t, when + tolerance, side="right") - 1, 0, len(t) - 1)
    width = np.maximum(t[after] - t[before], 0.0)
    width[(when < t[0] - tolerance) | (when > t[-1] + tolerance)] = np.inf
    return np.interp(when, t, x), width


def drive_transitions(model: ComposedModel, stretches: list[Streams], digest: str, source: str, *, under_way: bool = False) -> Transitions:
    """All transitions of a drive, stretch after stretch. Stretches that hold no measured state are left out. under_way: each was cut out of
    a longer one, so that its first WARM_UP_S are left out (`cut`): what was commanded before them may still act.
    """
    nx, nu = len(model.states), len(model.inputs)
    _check_pace(model, stretches, source)
    parts = [part for stretch in stretches for part in _continuous(stretch)]
    x0: list[Array] = []
    x1: list[Array] = []
    u: list[Array] = []
    t0: list[Array] = []
    inputs: list[Array] = []
    steps: list[NDArray[np.int64]] = []
    offset = 0
    rejected: dict[str, int] = {}
    for part in parts:
        grid, x, mean_u, reason = _on_grid(model, part)
        if under_way and len(reason):
            reason[(reason == 0) & (grid[:-1] < grid[0] + WARM_UP_S)] = REASONS.index("cut")
        used = np.flatnonzero(reason == 0)
        for name, count in zip(REASONS, np.bincount(reason, minlength=len(REASONS)).tolist(), strict=True):
            if count and name not in {"", "outside"}:
                rejected[name] = rejected.get(name, 0) + count
        x0.append(x[used])
        x1.append(x[used + 1])
        u.append(mean_u[used])
        t0.append(grid[used])
        steps.append(used + offset)
        inputs.append(mean_u)
        offset += len(mean_u)
    drive = Drive(tuple(inputs) or (np.empty((0, nu)),), np.concatenate(steps) if steps else np.empty(0, dtype=np.int64))
    return Transitions(
        _joined(x0, (0, nx)),
        _joined(u, (0, nu)),
        _joined(x1, (0, nx)),
        None,
        1,
        independent=False,
        rejected=rejected,
        digest=digest,
        t0_s=_joined(t0, (0,)),
        source=source,
        doubt=DOUBT,
        noise=streams_noise(model, parts),
        drive=drive,
    )


def _joined(parts: list[Array], empty: tuple[int, ...]) -> Array:
    """One array of all parts, which are given up; of that shape if there are none."""
    joined = parts[0] if len(parts) == 1 else np.concatenate(parts) if parts else np.empty(empty)
    parts.clear()
    return joined


def _check_pace(model: ComposedModel, stretches: list[Streams], source: str) -> None:
    """Raises RecordingError where a grid of the model's steps would be nearly all holes, and too large for the memory, or where stamps are
    so large that a float does not tell one step from the next.
    """
    for stretch in stretches:
        told = float(np.spacing(np.max(np.abs(stretch.t), initial=0.0)))
        if told > 0.5 * model.dt:
            raise RecordingError(f"{source}: its stamps are so large that they tell {told:g} s at best, the model's step is {model.dt:g} s")
    for column, name in enumerate(model.states):
        intervals = np.concatenate([np.diff(s.t[np.isfinite(s.x[:, column])]) for s in stretches] or [np.empty(0)])
        intervals = intervals[intervals > 0.0]
        apart = float(np.median(intervals)) if len(intervals) else 0.0
        if apart > MOST_STEPS * model.dt:
            raise RecordingError(
                f"{source}: {name} comes every {apart:g} s, the model's step is {model.dt:g} s, so nothing shows one step; is t in seconds?"
            )


def _continuous(streams: Streams) -> list[Streams]:
    cuts = np.flatnonzero(np.diff(streams.t) > SILENCE_S) + 1
    edges = [0, *cuts.tolist(), len(streams.t)]
    return [streams.rows(slice(a, b)) for a, b in pairwise(edges) if b - a > 1]


def _on_grid(model: ComposedModel, s: Streams) -> tuple[Array, Array, Array, NDArray[np.int8]]:
    """(t (m+1,), x (m+1, nx), mean u (m, nu), index in REASONS of each of the m steps)."""
    dt, tolerance = model.dt, resolution(s.t, model.dt)
    known = [s.t[np.isfinite(s.x[:, c])] for c in range(s.x.shape[1])]
    if not all(len(t) for t in known):
        return np.empty(0), np.empty((0, s.x.shape[1])), np.empty((0, s.u.shape[1])), np.empty(0, dtype=np.int8)
    start, stop = max(float(t[0]) for t in known), min(float(t[-1]) for t in known)
    heard = [s.t[np.isfinite(s.u[:, c])] for c in range(s.u.shape[1])]
    first_input = min((float(t[0]) for t in heard if len(t)), default=start)
    all_inputs = max(float(t[0]) if len(t) else np.inf for t in heard)
    steps = np.arange(min(0, int(np.floor((first_input - start) / dt))), int(np.floor((stop - start + tolerance) / dt)) + 1)
    grid = np.asarray(start + steps * dt, dtype=np.float64)
    x, width = np.empty((len(grid), s.x.shape[1])), np.zeros(len(grid))
    for column in range(s.x.shape[1]):
        angle = column in model.angle_columns
        values, hole = state_at(s, column, grid, angle, tolerance)
        x[:, column] = wrap(values) if angle else values
        width = np.maximum(width, hole)
    reason = np.zeros(max(0, len(grid) - 1), dtype=np.int8)
    hole = np.maximum(width[:-1], width[1:])
    reason[hole > MAX_GAP * dt] = REASONS.index("state_gap")
    reason[grid[:-1] < all_inputs - tolerance] = REASONS.index("no_input")
    reason[np.isinf(hole)] = REASONS.index("outside")
    return grid, x, _averages(s, grid), reason


def _averages(s: Streams, grid: Array) -> Array:
    """(m, nu) mean of each held input over the steps of the grid (m+1,); zero before it was first received."""
    edges = grid - grid[0] if len(grid) else grid
    mean = np.zeros((max(0, len(grid) - 1), s.u.shape[1]))
    for column in range(s.u.shape[1]):
        received = np.isfinite(s.u[:, column])
        if not np.any(received) or len(grid) < 2:
            continue
        t, u = s.t[received] - grid[0], s.u[received, column]
        so_far = np.concatenate([[0.0], np.cumsum(u[:-1] * np.diff(t))])
        last = np.searchsorted(t, edges, side="right") - 1
        integral = np.where(last >= 0, so_far[last] + u[last] * (edges - t[last]), 0.0)
        mean[:, column] = np.diff(integral) / np.diff(edges)
    return mean


def streams_noise(model: ComposedModel, parts: list[Streams]) -> Array | None:
    """(nx,) standard deviation of the measurements in these runs together; None where they do not show it (`sensor_noise`)."""
    if not parts:
        return None
    found = []
    number = np.concatenate([np.full(len(p.t), i) for i, p in enumerate(parts)]) if len(parts) > 1 else None
    t = _joined([p.t for p in parts], (0,))
    for column in range(len(model.states)):
        values = np.concatenate([p.x[:, column] for p in parts])
        if column in model.angle_columns:
            place = 0
            for p in parts:
                received = place + np.flatnonzero(np.isfinite(values[place : place + len(p.t)]))
                values[received] = np.unwrap(values[received])
                place += len(p.t)
        noise = stream_noise(t, values[:, None], number)
        if noise is None:
            return None
        found.append(noise[0])
    return np.array(found)
