"""Rows away from where the rows before and after, and the model, say they are: spikes, tails of the noise, and offsets that stay.

spike        one row (or few) away, and back
offset_jump  one transition by more than the inputs could move the state, and it stays there; to the end, or until it jumps back

What acts on a robot's speed changes where it goes from then on. In one step alone it is no more than the speed itself changes within a
step: a car at 15 m/s whose commands change smoothly does not go 0.7 m more in one step of 0.1 s, and none more in those around it; nor
does a joint at 6 rad/s jump by 0.05 rad in 4 ms.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import axes
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.prediction import Acting
from s2r_runtime.trace.sensor_faults.fault import SIGMAS, Fault, fault_of
from s2r_runtime.trace.sensor_faults.heading import wrong_before
from s2r_runtime.trace.sensor_faults.largest_step import ONE_IN, Reach, predicted

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TAIL_SIGMAS = 3.5
"""Robust standard deviations of both legs of a spike that count as tails: white noise has one in a million."""

WILD_SIGMAS = 6.0
"""As TAIL_SIGMAS, from which a row is left out where tails are known to be heavy; an effect hardly takes a state away for one row alone."""

FEW = 3
"""Rows beyond TAIL_SIGMAS that are no spikes from which on they have a law."""

BEYOND = 2.2
"""Times the largest move in a step: a command that reverses and is late, or followed with a lag, leaves up to twice that. A row that was
stamped late by two rows is as far away.
"""

NEAR = 5
"""Steps on either side of which the pace says by how much a row that was stamped late may be away."""

RIGHT_AT_FIRST = 0.3
"""Of a heading that jumped for good, what was before counts if it is at least this part of the run, unless the course says otherwise."""

BRIEF = 4
"""Rows that a spike lasts at most; a jump that comes back later is an offset."""

STAYS, FARTHER = 10, 2.0
"""Rows over which a jump must stay, and times the largest residual of other steps that it must be, not to be one of many wild rows."""


@dataclass(frozen=True)
class Jumps:
    """Of one run: spikes; rows that the noise's own tail took away (`tails`, as spikes); offsets that stay; (run, step) transitions across
    them; of the offsets, those that are none of the noise's tail either; rows that are away by no more than a late stamp could do
    (`strays`, as spikes), which are not marked, and whether another state says that such a row is in time; by how much headings jumped for
    good, rad (`lasting`).
    """

    spikes: list[Fault]
    tails: list[Fault]
    offsets: list[Fault]
    cut: list[tuple[int, int]]
    sure: list[Fault]
    strays: dict[Fault, bool]
    lasting: list[tuple[Fault, float]]


def jumps_of(model: ComposedModel, data: Dataset, act: Acting, i: int, bad: Mask, reach: Reach, *, of_positions: bool = False) -> Jumps:
    """Of run i; marks in `bad` what of it is wrong. of_positions: no other states are looked at."""
    run = data.runs[i]
    found = Jumps([], [], [], [], [], {}, [])
    if len(run.y) < 3:
        return found
    foretold = predicted(model, data, act, i)
    e, moves = model.difference(run.y[1:], foretold), model.difference(foretold, run.y[:-1])
    change = model.difference(run.y[1:].copy(), run.y[:-1])
    between = _Rows(change)
    pose = {"x", "y", "theta"} if getattr(model.nominal, "integration", None) is not None else set()
    goes_on = pose | {model.states[axis.position] for axis in axes(model.nominal)}  # as its speed says, which is a state of its own
    for j, name in enumerate(model.states):
        if of_positions and name not in goes_on:
            continue
        series = np.nan_to_num(change[:, j] if reach.instant[j] else e[:, j])
        limit = SIGMAS * reach.noise[j] + BEYOND * np.minimum(reach.move[j], _pace(moves[:, j], change[:, j]))
        for_one_step = SIGMAS * reach.noise[j] + BEYOND * (reach.turn if name in goes_on else reach.move)[j]
        tail = max(float(reach.tail[j]), _reached(series, float(reach.noise[j]), float(for_one_step)))
        lost = np.isnan(run.y[:, j])
        single: list[int] = []
        for k in np.flatnonzero(np.abs(series) > for_one_step).tolist():
            if bad[k, j] or bad[k + 1, j]:  # the end of something that is taken out already
                continue
            rows = _there_and_back(series, k)
            if rows is not None and abs(float(series[k])) <= limit[k]:  # a row that was stamped late is as far away, and back
                stray = fault_of(data, i, rows, name, "spike")
                if stray not in found.strays:
                    found.strays[stray] = rows[0] == rows[1] and between.in_time(j, rows[0])
                continue
            if rows is not None:
                bad[rows[0] : rows[1] + 1, j] = True
                kind = found.spikes if abs(float(series[k])) > tail else found.tails
                kind.append(fault_of(data, i, rows, name, "spike"))
            elif _alone(series, k) and not np.any((lost | bad[:, j])[max(k - 1, 0) : k + 3]):  # where rows lack, the way back is not seen
                single.append(k)
        if not reach.instant[j]:
            for k, back in _offsets(series, single):
                rows = _at_an_end(lost, k) if back is None else None
                if rows is not None:
                    bad[rows[0] : rows[1] + 1, j] = True
                    kind = found.spikes if abs(float(series[k])) > tail else found.tails
                    kind.append(fault_of(data, i, rows, name, "spike"))
                    continue
                _take_out(found, model, data, i, j, k, back, bad)
                if _stays(series, k, (bad[1:, j] | bad[:-1, j], single)):
                    found.sure.append(found.offsets[-1])
    return found


@dataclass(frozen=True)
class _Rows:
    """How rows lie between the two around them. change: (K, nx) how far states went in each step."""

    change: Array

    @cached_property
    def off(self) -> Array:
        """(K - 1, nx) from the mean of the two."""
        return 0.5 * (self.change[:-1] - self.change[1:])

    @cached_property
    def usual(self) -> Array:
        """(nx,) of that, by its median; not a number where a state was not measured."""
        finite = [one[np.isfinite(one)] for one in np.abs(self.off).T]
        return np.array([np.median(one) / 0.6745 if len(one) else np.nan for one in finite])

    def in_time(self, j: int, row: int) -> bool:
        """Whether another state of a row says clearly that its stamp is right, of which the state j is off. Had it come late, the others
        would be off by as many steps of what they go hereabouts, and stand where they did a row or two before.
        """
        if not 1 < row < len(self.change):
            return False
        pace = 0.5 * (self.change[row - 1] + self.change[row])  # from the row before to the one after
        if not abs(pace[j]) > self.usual[j]:
            return False
        expected, least = float(self.off[row - 1, j] / pace[j]) * pace, SIGMAS * self.usual
        gone = np.abs([self.change[row - 1], self.change[row - 1] + self.change[row - 2]])
        says = (np.abs(expected) > least) & (np.abs(self.off[row - 1]) < 0.5 * np.abs(expected)) & np.all(gone > least, axis=0)
        return bool(np.any(says & (np.arange(len(pace)) != j)))


def _pace(moves: Array, change: Array) -> Array:
    """(K,) how far the state goes in a step hereabouts: by the model at most, whose inputs act at once, or as measured, in most steps."""
    wide = (np.pad(np.abs(e), NEAR, constant_values=np.nan) for e in (moves, change))
    foretold, measured = (sliding_window_view(np.where(np.isfinite(e), e, np.nan), 2 * NEAR + 1) for e in wide)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # where nothing hereabouts was received
        return np.asarray(np.nan_to_num(np.fmax(np.nanmax(foretold, axis=1), np.nanmedian(measured, axis=1))))


def _reached(series: Array, noise: float, least: float) -> float:
    """What noise whose rarest values are off by less than `least` may reach in one recording of a hundred, by the power law of those beyond
    TAIL_SIGMAS (B. Hill, Annals of Statistics 3(5), 1975): a few wild rows in a thousand are no matter of the quantiles. 0 where there are
    next to none: white noise has none.
    """
    legs = np.minimum(np.abs(series[:-1]), np.abs(series[1:]))
    back = np.abs(series[:-1] + series[1:]) < 0.35 * np.maximum(np.abs(series[:-1]), np.abs(series[1:]))
    wild = legs[back & (legs > TAIL_SIGMAS * noise) & (legs <= least)] / (TAIL_SIGMAS * noise)
    if len(wild) < FEW:
        return 0.0
    return float(TAIL_SIGMAS * noise * (ONE_IN * len(wild)) ** np.mean(np.log(wild)))


def _stays(series: Array, k: int, apart: tuple[Mask, list[int]]) -> bool:
    """Whether a state mostly is off by the whole jump at step k on the rows after it, and nothing else comes near to that: of steps that
    are not taken out (K,), nor jumps.
    """
    after, jump = np.cumsum(series[k : k + 1 + STAYS])[1:], float(series[k])
    out, jumps = apart
    others = np.abs(series)[~(out | np.isin(np.arange(len(series)), jumps))]
    if len(after) < STAYS or not len(others) or abs(jump) <= FARTHER * float(np.max(others)):
        return False
    return bool(abs(float(np.median(after)) - jump) < 0.35 * abs(jump))


def _alone(series: Array, k: int) -> bool:
    """An effect's onset dies away over steps, a jump does not."""
    around = np.abs(np.concatenate([series[max(k - 2, 0) : k], series[k + 1 : k + 3]]))
    return bool(np.all(around < 0.3 * abs(series[k])))


def _take_out(found: Jumps, model: ComposedModel, data: Dataset, i: int, j: int, k: int, back: int | None, bad: Mask) -> None:
    """An offset from step k on, to the end or to the step `back`."""
    run = data.runs[i]
    end = len(run.y) - 1 if back is None else back
    told = _wrong_before(model, run.y, j, k) if back is None else False
    first, last = (int(np.argmax(np.isfinite(run.y[:, j]))), k) if told else (k + 1, end)
    found.offsets.append(fault_of(data, i, (first, last), model.states[j], "offset_jump"))
    found.cut.extend([(i, k)] if back is None else [(i, k), (i, back)])
    if model.states[j] in model.nominal.angles:  # a heading that is off leaves the motion
        before = told or (told is None and k < RIGHT_AT_FIRST * len(bad))
        bad[slice(0, k + 1) if before else slice(k + 1, end + 1), j] = True
        if back is None:
            found.lasting.append((found.offsets[-1], float(model.difference(run.y[k + 1 : k + 2].copy(), run.y[k : k + 1])[0, j])))


def _wrong_before(model: ComposedModel, y: Array, j: int, k: int) -> bool | None:
    """Whether a state that jumps in step k was wrong before; None where nothing tells."""
    if model.states[j] != "theta" or not {"x", "y"} <= set(model.states) or getattr(model.nominal, "integration", None) is None:
        return None  # a robot that goes sideways at will has a course of its own
    jump = float(model.difference(y[k + 1 : k + 2].copy(), y[k : k + 1])[0, j])
    return wrong_before(y[:, [model.states.index("x"), model.states.index("y"), j]], k, jump)


def tails_of(model: ComposedModel, data: Dataset, act: Acting, i: int, reach: Reach, sigmas: float = TAIL_SIGMAS) -> Mask:
    """(K+1, nx) rows of run i that are away from both neighbours by more than so many deviations, whatever the inputs could do."""
    run = data.runs[i]
    e = np.nan_to_num(model.difference(run.y[1:], predicted(model, data, act, i)))
    first, second = e[:-1], e[1:]
    back = np.abs(first + second) < 0.35 * np.maximum(np.abs(first), np.abs(second))
    away = np.minimum(np.abs(first), np.abs(second)) > sigmas * reach.noise
    found = np.zeros(run.y.shape, dtype=bool)
    found[1:-1] = back & away & ~reach.instant
    return found


def _there_and_back(series: Array, k: int) -> tuple[int, int] | None:
    """First and last row that are away, if the residual at step k is one leg of a spike."""
    for length in range(1, BRIEF + 1):
        for begin in (k, k - length):
            legs = series[max(begin, 0) : begin + length + 1]
            if len(legs) == length + 1 and abs(float(np.sum(legs))) < 0.35 * abs(float(series[k])):
                return begin + 1, begin + length
    return None


def _at_an_end(lost: Mask, k: int) -> tuple[int, int] | None:
    """The rows before a jump at step k if they are the first few that there are, or those after it, if they are the last: of these, nobody
    knows whether they would have gone back. lost: (K+1,).
    """
    first, last = int(np.argmin(lost)), len(lost) - 1 - int(np.argmin(lost[::-1]))
    if k - first < BRIEF:
        return first, k
    return (k + 1, last) if last - k <= BRIEF else None


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
