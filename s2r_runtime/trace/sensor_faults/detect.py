"""Where the measurements, not the motion, are wrong: found before any fit, reported as intervals, left out of the fit.

    dropout      nothing was measured for longer than usual
    clock_step   as above, but the robot moved as in one usual interval: the stamps jumped, not time
    frozen       a state repeats exactly while the model says that it moves
    spike        one row (or few) away from where the rows before and after, and the model, say it is; and back
    inconsistent the heading leaves the motion while the position does not (heading.py)
    offset_jump  one transition by more than the inputs could move the state, and it stays there; to the end, or until it jumps back

A fault must be beyond what any effect on the input could do: an effect that the model lacks is not to be explained away as a
fault. Spikes on more than RARE of the rows are no faults but heavy tails: they are left out too, and counted as outliers. So are rows that
are away by what a late stamp could do, where there are next to none: of more, it is how this robot's rows are stamped.

What was found narrows what an input can do: a robot that follows its commands late does not turn by a tenth of a radian within a step.
Under a model that is believed, positions and headings are looked at once more for single jumps. Speeds are not: whatever the robot hits
makes them jump.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset, Pause
from s2r_runtime.trace.data.missing_rows import bridged
from s2r_runtime.trace.estimation.prediction import Acting, acting
from s2r_runtime.trace.sensor_faults.fault import Fault, fault_of
from s2r_runtime.trace.sensor_faults.frozen import frozen
from s2r_runtime.trace.sensor_faults.heading import carried, departures
from s2r_runtime.trace.sensor_faults.largest_step import Reach, predicted, reach_of
from s2r_runtime.trace.sensor_faults.outliers import WILD_SIGMAS, Jumps, jumps_of, tails_of

__all__ = ["Checked", "Fault", "check"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RARE = 0.01
"""Share of rows above which spikes are a property of the sensor's noise."""

AROUND = 4
"""Steps before and after a silence from which the robot's pace is taken."""

LONG = 3.5
"""Usual intervals without a measurement before it is called a dropout."""

ONE_STEP, MOVED = 0.3, 6.0
"""Of a step, by which a usual interval may differ from it to be one; standard deviations that the state must move in it to be seen to."""

SEEN = 6.0
"""Standard deviations that the robot must go in the time in question for its pace to say whether there was such a time: half way between
the two answers is three from either."""

STRAYS = 0.001
"""Share of rows that are away by what a late stamp could do, up to which they are left out; one always is."""

FEW = 3
"""Jumps that show only under what was found; of more, it is the robot that jumps, which meets something."""

MANY_ROWS = 60
"""Rows of a run in which a heading's departure from the motion is looked for."""

BESIDE = 0.15
"""Of its length: rows before and after a heading's departure that are left out too. Where it begins to wander off is not seen at once."""


@dataclass(frozen=True)
class Checked:
    """data: with faulty rows taken out (NaN); left_out: (run, step) transitions across a jump, or in time that a clock made up; outliers:
    rows taken out as such.
    """

    data: Dataset
    faults: tuple[Fault, ...]
    left_out: tuple[tuple[int, int], ...]
    outliers: int


def check(model: ComposedModel, data: Dataset, under: ComposedModel | None = None) -> Checked:
    """Finds the faults and takes them out. under: what was found, under which a few more jumps may show."""
    act = acting(model, data)
    reach = reach_of(model, data, act)
    faults = [_of_pause(model, data, act, pause, reach) for pause in data.pauses]
    known = data.reconstruction.faults if data.reconstruction else ()
    near = LONG * data.dt  # what was left out there is no dropout
    silent = [f for f in faults if f is not None and all(f.to_s < k.from_s - near or f.from_s > k.to_s + near for k in known)]
    found = [*known, *silent]
    pose = _pose(model)
    bad = [np.zeros(run.y.shape, dtype=bool) for run in data.runs]
    left_out = [at for fault, pause in zip(faults, data.pauses, strict=True) if fault in found for at in _within(data, fault, pause)]
    spikes: list[Fault] = []
    outliers = tails = 0
    sure: list[Fault] = []
    strays: list[tuple[int, Fault, bool]] = []
    jumped: dict[int, tuple[Fault, float]] = {}
    for i in range(len(data.runs)):
        tails += int(np.count_nonzero(tails_of(model, data, act, i, reach).any(axis=1)))
        found += frozen(model, data, act, i, bad[i], reach)
        jumps = jumps_of(model, data, act, i, bad[i], reach)
        spikes += jumps.spikes
        found += jumps.offsets
        jumped.update((i, jump) for jump in jumps.lasting[:1])
        left_out += jumps.cut
        sure += jumps.sure
        outliers += len(jumps.tails)
        strays += [(i, stray, in_time) for stray, in_time in jumps.strays.items()]
        if pose is not None:
            found += _inconsistent(model, data, act, i, bad[i], reach, pose)
    rows = sum(len(run.y) for run in data.runs)
    for i, stray, in_time in strays if len(strays) <= max(STRAYS * rows, 1.0) else ():
        first, last = _rows(data, i, stray.from_s, stray.to_s)
        bad[i][first : last + 1, model.states.index(stray.channel)] = True
        if in_time:
            spikes.append(stray)
        else:
            outliers += 1
    for jumps in [] if under is None else _under(under, data, bad, found):
        spikes += jumps.spikes
        found += jumps.offsets
        left_out += jumps.cut
        sure += jumps.offsets
        outliers += len(jumps.tails)
    many = max(tails, len({(f.segment, f.from_s) for f in spikes}) + outliers) > max(RARE * rows, 3.0)
    jumps_kept = {i: jump for i, (fault, jump) in jumped.items() if not many or fault in sure}
    carried_on = _carried(data, bad, pose, jumps_kept) if pose is not None else []
    found, sure = [*found, *carried_on], [*sure, *carried_on]
    for i, mask in enumerate(bad) if many else ():
        wild = tails_of(model, data, act, i, reach, WILD_SIGMAS) & ~mask
        mask |= wild
    runs = tuple(replace(run, y=np.where(b.any(axis=1, keepdims=True), np.nan, run.y)) for run, b in zip(data.runs, bad, strict=True))
    if many:  # two of them in a row look like a jump
        found = [f for f in found if f.kind != "offset_jump" or f in sure]
    order = {name: k for k, name in enumerate(data.called)}
    faults_ = tuple(sorted([*found, *([] if many else spikes)], key=lambda f: (order.get(f.segment, 0), f.from_s, f.channel)))
    return Checked(bridged(replace(data, runs=runs)), faults_, tuple(sorted(set(left_out))), _untold(data, bad, faults_))


def _within(data: Dataset, fault: Fault | None, pause: Pause) -> list[tuple[int, int]]:
    """(run, step) of the time that a clock made up: a rollout across it would go on while the robot did not."""
    if fault is None or fault.kind != "clock_step":
        return []
    return [(pause.run, step) for step in range(*_rows(data, pause.run, fault.from_s, fault.to_s))]


def _rows(data: Dataset, run: int, *at: float) -> tuple[int, ...]:
    """Of a run, those nearest to these times in s."""
    return tuple(round((t - data.runs[run].start_s) / data.dt) for t in at)


def _untold(data: Dataset, bad: list[Mask], faults_: Sequence[Fault]) -> int:
    """Rows that are taken out and lie in no fault that is told."""
    count = 0
    for i, (run, mask) in enumerate(zip(data.runs, bad, strict=True)):
        t, segment, there = run.start_s + data.dt * np.arange(len(mask)), data.segment_of(i), mask.copy()
        for f in (f for f in faults_ if f.segment == segment):
            columns = [j for j, name in enumerate(data.states) if f.channel in {name, "*"}]
            within = (t > f.from_s - 0.5 * data.dt) & (t < f.to_s + 0.5 * data.dt)
            there[within[:, None] & np.isin(np.arange(there.shape[1]), columns)] = False
        count += int(np.count_nonzero(there.any(axis=1)))
    return count


def _under(model: ComposedModel, data: Dataset, bad: list[Mask], known: Sequence[Fault]) -> list[Jumps]:
    """Spikes and jumps of positions and headings under another model that are not known yet; marked in `bad`. None if they are more than
    FEW.
    """
    act, there = acting(model, data), {(f.kind, f.channel, f.from_s) for f in known}
    reach = reach_of(model, data, act)
    marks = [mask.copy() for mask in bad]
    found = [jumps_of(model, data, act, i, marks[i], reach, of_positions=True) for i in range(len(data.runs))]
    found = [replace(jumps, offsets=[f for f in jumps.offsets if (f.kind, f.channel, f.from_s) not in there]) for jumps in found]
    if not 0 < sum(len(jumps.offsets) + len(jumps.spikes) for jumps in found) <= FEW:
        return []
    for mask, mark in zip(bad, marks, strict=True):
        mask |= mark
    return found


def _of_pause(model: ComposedModel, data: Dataset, act: Acting, pause: Pause, reach: Reach) -> Fault | None:
    """A long interval: had the robot gone on meanwhile, or only its clock? Judged by how fast it went before and after, since the model may
    lack what made it slow; or by the model, if the robot was where one step of it leads. Where inputs went on being received, the clock
    did too.
    """
    run = data.runs[pause.run]
    first, last = _rows(data, pause.run, pause.from_s, pause.to_s)
    before = model.difference(run.y[max(0, first - AROUND) + 1 : first + 1], run.y[max(0, first - AROUND) : first])
    after = model.difference(run.y[last + 1 : last + AROUND + 1], run.y[last : last + AROUND][: len(run.y[last + 1 : last + AROUND + 1])])
    steps, usual = (pause.to_s - pause.from_s) / data.dt, pause.usual_s / data.dt
    if pause.silent and min(np.count_nonzero(np.isfinite(d).all(axis=1)) for d in (before, after)) >= 2:
        pace = 0.5 * (np.nanmean(before, axis=0) + np.nanmean(after, axis=0))
        went = model.difference(pause.after[None, :], pause.before[None, :].copy())[0]
        apart, noise = np.abs(pace) * (steps - usual), 4.0 * reach.noise
        stood = np.abs(went - pace * usual) <= np.maximum(0.3 * apart, noise)
        steady = np.abs(np.nanmean(before, axis=0) - np.nanmean(after, axis=0)) < 0.5 * np.abs(pace)
        by_pace = np.any(stood & steady & (apart > 2.0 * noise)) and np.all(stood | reach.instant)
        if (by_pace or _one_step_on(model, data, act, pause, first, reach)) and not _went_on(
            model, run.y, (first, last), pace, usual, reach
        ):
            return Fault(pause.from_s, pause.to_s, "*", "clock_step", data.segment_of(pause.run))
    if pause.to_s - pause.from_s <= LONG * pause.usual_s:
        return None
    return Fault(pause.from_s, pause.to_s, "*", "dropout", data.segment_of(pause.run))


def _went_on(model: ComposedModel, y: Array, pause: tuple[int, int], pace: Array, usual: float, reach: Reach) -> bool:
    """Whether the robot went as far as the stamps of a pause (its first and last row) say, by the rows beside these two, at this pace (nx,)
    a step: a row that is off by itself, just before one that was lost, looks like a clock that stepped.
    """
    first, last = pause
    if first < 1 or last + 1 >= len(y):
        return False
    steps, went = last - first, model.difference(y[[last + 1]], y[[first - 1]])[0]
    told = ~reach.instant & np.isfinite(went) & np.isfinite(pace)
    size = float(np.sum((pace[told] / reach.noise[told]) ** 2))
    if size * (steps - usual) ** 2 < SEEN**2:
        return False
    gone = float(np.sum(went[told] * pace[told] / reach.noise[told] ** 2)) / size - 2.0
    return gone > 0.5 * (usual + steps)


def _one_step_on(model: ComposedModel, data: Dataset, act: Acting, pause: Pause, first: int, reach: Reach) -> bool:
    """Whether the state after a pause is clearly where one step of the model from the row `first` leads, and not where it was before."""
    run = data.runs[pause.run]
    if abs(pause.usual_s / data.dt - 1.0) > ONE_STEP or first >= len(run.y) - 1:
        return False
    foretold = predicted(model, data, act, pause.run)[[first]]
    off = model.difference(pause.after[None, :].copy(), foretold)[0]
    moved = model.difference(foretold, pause.before[None, :])[0]
    apart, way = (float(np.linalg.norm((e / reach.noise)[~reach.instant])) for e in (off, moved))
    return way > MOVED and apart < 0.5 * way and bool(np.all((np.abs(off) <= 4.0 * reach.noise) | reach.instant))


def _pose(model: ComposedModel) -> list[int] | None:
    """Columns of x, y and heading of a robot that moves along its heading."""
    if getattr(model.nominal, "integration", None) is None or not {"x", "y", "theta"} <= set(model.states):
        return None
    return [model.states.index(name) for name in ("x", "y", "theta")]


def _carried(data: Dataset, bad: list[Mask], pose: list[int], jumps: Mapping[int, float]) -> list[Fault]:
    """A heading that is off in whole runs. jumps: rad, by run, where it jumped for good."""
    found = []
    seen = [np.where(mask, np.nan, run.y)[:, pose] for run, mask in zip(data.runs, bad, strict=True)] if jumps else []
    for i in carried(seen, jumps):
        there = np.flatnonzero(np.isfinite(data.runs[i].y[:, pose[2]]))
        bad[i][there, pose[2]] = True
        found.append(fault_of(data, i, (int(there[0]), int(there[-1])), data.states[pose[2]], "offset_jump"))
    return found


def _inconsistent(model: ComposedModel, data: Dataset, act: Acting, i: int, bad: Mask, reach: Reach, pose: list[int]) -> list[Fault]:
    """A heading that leaves the motion, by more than a spike or a jump."""
    run = data.runs[i]
    if len(run.y) < MANY_ROWS:
        return []
    y = np.where(bad, np.nan, run.y)[:, pose]
    foretold = predicted(model, data, act, i)[:, pose[2]]
    turned = np.where(np.isnan(np.diff(y[:, 2])), np.nan, run.y[1:, pose[2]] - foretold)
    turned = (turned + math.pi) % math.tau - math.pi
    noise = float(np.max(reach.noise[pose[:2]]))
    found = []
    for off in departures(y, turned, foretold - run.y[:-1, pose[2]], noise):
        beside = round(BESIDE * (off.last - off.first))
        bad[max(0, off.first - beside) : off.last + beside + 1, pose[2]] = True
        found.append(fault_of(data, i, (off.first, off.last), model.states[pose[2]], "inconsistent"))
    return found
