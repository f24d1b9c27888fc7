"""Where the measurements, not the motion, are wrong: found before any fit, reported as intervals, left out of the fit.

    dropout      nothing was measured for longer than usual
    clock_step   as above, but the robot moved as in one usual interval: the stamps jumped, not time
    frozen       a state repeats exactly while the model says that it moves
    spike        one row (or few) away from where the rows before and after, and the model, say it is; and back
    inconsistent the heading leaves the motion while the position does not (heading.py)
    offset_jump  one transition by more than the inputs could move the state, and it stays there; to the end, or until it jumps back

A fault must be beyond what any effect on the input could do: an effect that the model lacks is not to be explained away as a
fault. Spikes on more than RARE of the rows are no faults but heavy tails: they are left out too, and counted as outliers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.dataset import Dataset, Pause
from s2r_runtime.trace.heading import departures
from s2r_runtime.trace.residual import Acting, acting, advanced, first_steps

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SIGMAS = 8.0
"""Robust standard deviations from which a single residual is suspected."""

TAIL_SIGMAS = 3.5
"""Robust standard deviations of both legs of a spike that count as tails: white noise has one in a million."""

BEYOND = 2.2
"""Times the largest move in a step: a command that reverses and is late, or followed with a lag, leaves up to twice that."""

ONE_IN = 100.0
"""Recordings in which noise may once reach a spike's size."""

RARE = 0.01
"""Share of rows above which spikes are a property of the sensor's noise."""

FROZEN_ROWS = 5
"""Rows that repeat a state exactly before it counts as frozen."""

AROUND = 4
"""Steps before and after a silence from which the robot's pace is taken."""

RIGHT_AT_FIRST = 0.3
"""Of a heading that jumped for good, what was before counts if it is at least this part of the run."""

QUANTA = 6.0
"""Least changes by which a state must have moved on while it repeated: below that it may be resolution."""

LONG_FROZEN = 50
"""Rows of exact repeats that need no catching up to count as frozen."""

LONG = 3.5
"""Usual intervals without a measurement before it is called a dropout."""

MANY_ROWS = 60
"""Rows of a run in which a heading's departure from the motion is looked for."""

BRIEF = 4
"""Rows that a spike lasts at most; a jump that comes back later is an offset."""


@dataclass(frozen=True)
class Fault:
    """An interval of the recording, s since its first stamp. channel: a state, or `*`. kind: as docs/json.md."""

    from_s: float
    to_s: float
    channel: str
    kind: str


@dataclass(frozen=True)
class Checked:
    """data: with faulty rows taken out (NaN); left_out: (run, step) transitions across a jump; outliers: rows taken out as such."""

    data: Dataset
    faults: tuple[Fault, ...]
    left_out: tuple[tuple[int, int], ...]
    outliers: int


def check(model: ComposedModel, data: Dataset) -> Checked:
    """Finds the faults and takes them out."""
    act = acting(model, data)
    reach = _reach(model, data, act)
    faults = [_of_pause(model, data, pause, reach) for pause in data.pauses]
    found = [f for f in faults if f is not None]
    pose = _pose(model)
    bad = [np.zeros(run.y.shape, dtype=bool) for run in data.runs]
    left_out: list[tuple[int, int]] = []
    spikes: list[Fault] = []
    tails = 0
    for i in range(len(data.runs)):
        tails += _tails(model, data, act, i, reach)
        found += _frozen(model, data, act, i, bad[i], reach)
        some, jumps, cut = _jumps(model, data, act, i, bad[i], reach)
        spikes += some
        found += jumps
        left_out += cut
        if pose is not None:
            found += _inconsistent(model, data, act, i, bad[i], reach, pose)
    rows = sum(len(run.y) for run in data.runs)
    many = max(tails, len({f.from_s for f in spikes})) > max(RARE * rows, 3.0)
    runs = tuple(replace(run, y=np.where(b.any(axis=1, keepdims=True), np.nan, run.y)) for run, b in zip(data.runs, bad, strict=True))
    if many:  # two of them in a row look like a jump
        found = [f for f in found if f.kind != "offset_jump"]
    faults_ = tuple(sorted([*found, *([] if many else spikes)], key=lambda f: (f.from_s, f.channel)))
    return Checked(replace(data, runs=runs), faults_, tuple(sorted(set(left_out))), len(spikes) if many else 0)


@dataclass(frozen=True)
class _Reach:
    """noise: (nx,) robust standard deviation of a residual; move: (nx,) largest move in a step that the model foresees; tail: (nx,)
    leg of a spike that noise with tails such as these has in one recording of a hundred.
    """

    noise: Array
    move: Array
    tail: Array
    instant: Mask


def _reach(model: ComposedModel, data: Dataset, act: Acting) -> _Reach:
    e, moves = [], []
    for i, run in enumerate(data.runs):
        p = _predicted(model, data, act, i)
        e.append(model.difference(run.y[1:], p))
        moves.append(model.difference(p, run.y[:-1]))
    residuals, move = np.concatenate(e), np.concatenate(moves)
    good = np.flatnonzero(np.isfinite(residuals).all(axis=1))
    instant = np.array([s in getattr(model.nominal, "reached", {}) for s in model.states])
    if not len(good):
        one = np.ones(len(model.states))
        return _Reach(one, one, one, instant)
    noise = np.median(np.abs(residuals[good]), axis=0) / 0.6745
    largest = np.quantile(np.abs(move[good]), 0.999, axis=0)
    return _Reach(np.maximum(noise, 1e-12), largest, _tail(residuals), instant)


def _tail(residuals: Array) -> Array:
    """(nx,) by extrapolation of the quantiles of how far rows are from both neighbours, as a power law: what the tail itself says it
    may reach. Spikes themselves are on fewer rows than are looked at.
    """
    apart = 0.5 * np.abs(np.diff(residuals, axis=0))
    apart = apart[np.isfinite(apart).all(axis=1)]
    if len(apart) < 100:
        return np.zeros(residuals.shape[1])
    bulk, rare = np.quantile(apart, (0.9, 0.98), axis=0)
    steepness = np.log(np.clip(rare / np.maximum(bulk, 1e-300), 1.0, 5.0)) / math.log(5.0)
    return np.asarray(rare * (0.02 * ONE_IN * len(apart)) ** steepness)


def _predicted(model: ComposedModel, data: Dataset, act: Acting, run: int) -> Array:
    begin = first_steps(data)[run]
    y = data.runs[run].y[:-1]
    here = slice(begin, begin + len(y))
    return advanced(model, y, act, here)


def _of_pause(model: ComposedModel, data: Dataset, pause: Pause, reach: _Reach) -> Fault | None:
    """A long interval: had the robot gone on meanwhile, or only its clock? Judged by how fast it went before and after, not by the model,
    which may lack what made it slow. Where inputs went on being received, the clock did too.
    """
    run = data.runs[pause.run]
    first, last = (round((at - run.start_s) / data.dt) for at in (pause.from_s, pause.to_s))
    before = model.difference(run.y[max(0, first - AROUND) + 1 : first + 1], run.y[max(0, first - AROUND) : first])
    after = model.difference(run.y[last + 1 : last + AROUND + 1], run.y[last : last + AROUND][: len(run.y[last + 1 : last + AROUND + 1])])
    steps, usual = (pause.to_s - pause.from_s) / data.dt, pause.usual_s / data.dt
    if pause.silent and min(np.count_nonzero(np.isfinite(d).all(axis=1)) for d in (before, after)) >= 2:
        pace = 0.5 * (np.nanmean(before, axis=0) + np.nanmean(after, axis=0))
        went = model.difference(pause.after[None, :], pause.before[None, :].copy())[0]
        apart, noise = np.abs(pace) * (steps - usual), 4.0 * reach.noise
        stood = np.abs(went - pace * usual) <= np.maximum(0.3 * apart, noise)
        steady = np.abs(np.nanmean(before, axis=0) - np.nanmean(after, axis=0)) < 0.5 * np.abs(pace)
        if np.any(stood & steady & (apart > 2.0 * noise)) and np.all(stood | reach.instant):
            return Fault(pause.from_s, pause.to_s, "*", "clock_step")
    return Fault(pause.from_s, pause.to_s, "*", "dropout") if pause.to_s - pause.from_s > LONG * pause.usual_s else None


def _frozen(model: ComposedModel, data: Dataset, act: Acting, i: int, bad: Mask, reach: _Reach) -> list[Fault]:
    """Exact repeats through which the model moves the state by more than noise and quantisation, and after which it catches up.

    Without catching up the robot itself may have stood still; only a long silence of a state that jitters otherwise is then a fault.
    """
    run = data.runs[i]
    if len(run.y) < FROZEN_ROWS + 1:
        return []
    predicted = _predicted(model, data, act, i)
    moves, e = model.difference(predicted, run.y[:-1]), model.difference(run.y[1:], predicted)
    found = []
    for j, name in enumerate(model.states):
        change = np.abs(np.diff(run.y[:, j]))
        if reach.instant[j] or not np.any(change > 0.0):
            continue
        quantum = float(np.min(change[change > 0.0]))
        least = SIGMAS * reach.noise[j] + QUANTA * quantum
        for a, b in _stretches(change == 0.0):
            if b - a < FROZEN_ROWS:
                continue
            path = np.cumsum(np.nan_to_num(moves[a:b, j]))
            expected, far = float(path[-1]), float(np.max(np.abs(path)))
            if far < least:
                continue
            off = float(e[min(b, len(e) - 1), j]) - expected
            off = math.remainder(off, math.tau) if name in model.nominal.angles else off
            caught_up = b < len(e) and abs(expected) > least and abs(off) < 0.5 * abs(expected)
            jitters = reach.noise[j] > QUANTA * quantum  # even where the robot stands
            if caught_up or (b - a > LONG_FROZEN and jitters and far > 10.0 * reach.move[j]):
                bad[a + 1 : b + 1, j] = True
                found.append(Fault(run.start_s + data.dt * a, run.start_s + data.dt * b, name, "frozen"))
    return found


def _pose(model: ComposedModel) -> list[int] | None:
    """Columns of x, y and heading of a robot that moves along its heading."""
    if getattr(model.nominal, "integration", None) is None or not {"x", "y", "theta"} <= set(model.states):
        return None
    return [model.states.index(name) for name in ("x", "y", "theta")]


def _inconsistent(model: ComposedModel, data: Dataset, act: Acting, i: int, bad: Mask, reach: _Reach, pose: list[int]) -> list[Fault]:
    """A heading that leaves the motion, by more than a spike or a jump."""
    run = data.runs[i]
    if len(run.y) < MANY_ROWS:
        return []
    y = np.where(bad, np.nan, run.y)[:, pose]
    predicted = _predicted(model, data, act, i)[:, pose[2]]
    turned = np.where(np.isnan(np.diff(y[:, 2])), np.nan, run.y[1:, pose[2]] - predicted)
    turned = (turned + math.pi) % math.tau - math.pi
    noise = float(np.max(reach.noise[pose[:2]]))
    found = []
    for off in departures(y, turned, predicted - run.y[:-1, pose[2]], noise):
        bad[off.first : off.last + 1, pose[2]] = True
        found.append(Fault(run.start_s + data.dt * off.first, run.start_s + data.dt * off.last, model.states[pose[2]], "inconsistent"))
    return found


def _stretches(yes: Mask) -> list[tuple[int, int]]:
    """[a, b) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], yes.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _jumps(
    model: ComposedModel, data: Dataset, act: Acting, i: int, bad: Mask, reach: _Reach
) -> tuple[list[Fault], list[Fault], list[tuple[int, int]]]:
    """(spikes, offset jumps, transitions across jumps) of one run."""
    run = data.runs[i]
    if len(run.y) < 3:
        return [], [], []
    e = model.difference(run.y[1:], _predicted(model, data, act, i))
    change = model.difference(run.y[1:].copy(), run.y[:-1])
    spikes: list[Fault] = []
    jumps: list[Fault] = []
    cut: list[tuple[int, int]] = []
    lost = np.isnan(run.y)
    for j, name in enumerate(model.states):
        series = np.nan_to_num(change[:, j] if reach.instant[j] else e[:, j])
        limit = SIGMAS * reach.noise[j] + BEYOND * reach.move[j]
        single: list[int] = []
        for k in np.flatnonzero(np.abs(series) > limit).tolist():
            if bad[k, j] or bad[k + 1, j]:  # the end of something that is taken out already
                continue
            rows = _there_and_back(series, k)
            if rows is None:
                around = np.abs(np.concatenate([series[max(k - 2, 0) : k], series[k + 1 : k + 3]]))
                beside = lost[max(k - 1, 0) : k + 3, j].any() or bad[max(k - 1, 0) : k + 3, j].any()  # there the way back is not seen
                if not beside and np.all(around < 0.3 * abs(series[k])):  # an effect's onset dies away, a jump does not
                    single.append(k)
                continue
            bad[rows[0] : rows[1] + 1, j] = True
            if abs(float(series[k])) > reach.tail[j]:
                spikes.append(Fault(run.start_s + data.dt * rows[0], run.start_s + data.dt * rows[1], name, "spike"))
        if not reach.instant[j]:
            for k, back in _offsets(series, single):
                end = len(run.y) - 1 if back is None else back
                jumps.append(Fault(run.start_s + data.dt * (k + 1), run.start_s + data.dt * end, name, "offset_jump"))
                cut += [(i, k)] if back is None else [(i, k), (i, back)]
                if name in model.nominal.angles:  # a heading that is off leaves the motion; it was right at first, if that is long enough
                    off = slice(k + 1, end + 1) if back is not None or k >= RIGHT_AT_FIRST * len(bad) else slice(0, k + 1)
                    bad[off, j] = True
    return spikes, jumps, cut


def _tails(model: ComposedModel, data: Dataset, act: Acting, i: int, reach: _Reach) -> int:
    """Rows that are away from both neighbours by more than white noise would have them, whatever the inputs could do."""
    run = data.runs[i]
    e = np.nan_to_num(model.difference(run.y[1:], _predicted(model, data, act, i)))
    first, second = e[:-1], e[1:]
    back = np.abs(first + second) < 0.35 * np.maximum(np.abs(first), np.abs(second))
    away = np.minimum(np.abs(first), np.abs(second)) > TAIL_SIGMAS * reach.noise
    return int(np.count_nonzero((back & away & ~reach.instant).any(axis=1)))


def _there_and_back(series: Array, k: int) -> tuple[int, int] | None:
    """First and last row that are away, if the residual at step k is one leg of a spike."""
    for length in range(1, BRIEF + 1):
        for begin in (k, k - length):
            legs = series[max(begin, 0) : begin + length + 1]
            if len(legs) == length + 1 and abs(float(np.sum(legs))) < 0.35 * abs(float(series[k])):
                return begin + 1, begin + length
    return None


def _offsets(series: Array, single: list[int]) -> list[tuple[int, int | None]]:
    """Each jump with the one that takes it back, if there is one."""
    found: list[tuple[int, int | None]] = []
    left = list(single)
    while left:
        k = left.pop(0)
        back = next((m for m in left if abs(float(series[m] + series[k])) < 0.35 * abs(float(series[k]))), None)
        if back is not None:
            left.remove(back)
        found.append((k, back))
    return found
