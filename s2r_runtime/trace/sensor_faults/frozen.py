"""A state that repeats exactly while the model says that it moves, or a speed that jitters at all other times: the sensor, or what carries
its readings, stands still, or is at the end of its range.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import axes, lone_speeds
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.data.missing_rows import filled
from s2r_runtime.trace.estimation.prediction import Acting, advanced, first_steps
from s2r_runtime.trace.sensor_faults.fault import FROZEN_ROWS, QUANTA, REPEATS, RESTLESS, RESTS, SIGMAS, Fault, fault_of, stretches
from s2r_runtime.trace.sensor_faults.heading import course_of
from s2r_runtime.trace.sensor_faults.largest_step import Reach, predicted

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LONG_FROZEN = 50
"""Rows of exact repeats that need no catching up to count as frozen."""

ALTERNATES = -0.3
"""Rows of exact repeats count as frozen, however little the robot moves, where a state jitters on other rows on which it hardly moves
either: on at least RESTS of them, of which less than REPEATS repeat, and whose residuals alternate. Noise of a measurement has a
correlation of -1/2 from one residual to the next; a slow motion, or an effect that the model lacks, has none below zero.
"""

BENDS = 5
"""Rows after which a bend of an input is over, less those that it takes."""

MOVING = 1.5
"""Times that a speed bends from row to row by noise, for white noise 1.65 standard deviations, from which on no robot stands."""

ASIDE = 0.2
"""Of a turn that a heading seems to have missed, by which its course must leave it: of an even one it is half of that on average."""

PLACE = {"x", "y", "z"}
"""States that stand together where something holds a robot."""

FOLLOWS, FOLLOWED = 0.25, 0.9
"""Of what a frozen speed is off at most, how near to its command it is on other rows, and on which share of them at least."""


def frozen(model: ComposedModel, data: Dataset, act: Acting, i: int, bad: Mask, reach: Reach) -> list[Fault]:
    """Exact repeats through which the model moves the state by more than noise and quantisation, and after which it catches up.

    Without catching up the robot itself may have stood still; only a long silence of a state that jitters otherwise is then a fault; or one
    of a state that jitters on other rows on which the robot stands, or nearly; or of a speed that jitters, and is not zero. A silence in
    which a run begins or ends catches up with nothing: one of a state that repeats nowhere else, while others move, is a fault. So is one
    at the end of a sensor's range, with the single rows there.
    """
    run = data.runs[i]
    if len(run.y) < FROZEN_ROWS + 1:
        return []
    foretold = predicted(model, data, act, i)
    e = model.difference(run.y[1:], foretold)
    run = replace(run, y=filled(run.y))
    if run.y is not data.runs[i].y:  # a row that is lost amid a silence does not end it
        data = replace(data, runs=(*data.runs[:i], run, *data.runs[i + 1 :]))
        foretold = predicted(model, data, act, i)
    moves = model.difference(foretold, run.y[:-1])
    speeds = {model.states.index(name) for name in lone_speeds(model.nominal)} | {axis.velocity for axis in axes(model.nominal)}
    speeds |= {*np.flatnonzero(reach.instant).tolist()}
    asked = run.u.reshape(len(run.y) - 1, -1, run.u.shape[1]).mean(axis=1)
    found, single = [], np.zeros_like(bad)
    for j, name in enumerate(model.states):
        change = np.abs(np.diff(run.y[:, j]))
        there = change > 0.0
        quantum = float(np.min(change[there])) if np.any(there) else float(reach.quantum[j])
        if not np.isfinite(reach.noise[j]) or not np.isfinite(quantum):
            continue
        least = SIGMAS * reach.noise[j] + QUANTA * quantum
        for a, b in stretches(change == 0.0):
            if b - a < FROZEN_ROWS:
                continue
            told = b - a >= RESTLESS and j in speeds and _stuck(run.y[:, j], e[:, j], asked, a, QUANTA * quantum)
            if b - a >= RESTLESS and not told and reach.instant[j]:
                told = _ignored(foretold[:, j], run.y[:, j], (a, b), least)
            elif b - a >= RESTLESS and not told:
                told = _restless(change, e[:, j], np.abs(moves[:, j]) < reach.noise[j], (a, b))
            goes = np.nansum(np.abs(moves[a:b, j])) > reach.noise[j]  # a robot that rests where it never went beyond is not
            if not told and goes and not reach.instant[j] and _outermost(data, j, float(run.y[a, j])):
                told = _pegged(run.y[:, j], e[:, j], asked, a, QUANTA * quantum)
                single[:, j] |= told & (run.y[:, j] == run.y[a, j])
            if told:
                found.append(_taken_out(data, i, j, name, (a, b), bad))
            if told or reach.instant[j]:
                continue
            if np.max(np.abs(np.cumsum(np.nan_to_num(moves[a:b, j])))) < least:
                continue
            path = _led(model, data, act, i, (a, min(b + 1, len(e))))[:, j] - float(run.y[a, j])
            expected, far = float(path[b - a]), float(np.max(np.abs(path[: b - a + 1])))
            if far < least:
                continue
            off = float(run.y[min(b + 1, len(e)), j] - run.y[a, j] - path[-1])
            off = math.remainder(off, math.tau) if name in model.nominal.angles else off
            caught_up = b < len(e) and abs(expected) > least and abs(off) < 0.5 * abs(expected)
            jitters = reach.noise[j] > QUANTA * quantum  # even where the robot stands
            ends = (a == 0 or b == len(e)) and not caught_up and _alone(data, reach, i, j, (a, b), j in speeds)
            if caught_up or ends or (b - a > LONG_FROZEN and jitters and far > 10.0 * reach.move[j]):
                found.append(_taken_out(data, i, j, name, (a, b), bad))
    found += _with_them(model, data, i, bad)
    bad |= single
    return found


def _alone(data: Dataset, reach: Reach, i: int, j: int, within: tuple[int, int], speed: bool) -> bool:
    """Whether state j repeats over the steps [a, b) of run i, for long, while another moves on, although it hardly ever does on other rows
    of any run on which the model moves it the same way, by no more. Not where all stands, nor all of a place: something may hold the
    robot, at an end of where it ever is, too. Nor a speed of next to nothing: dry friction holds that.
    """
    a, b = within
    y, moves = data.runs[i].y, reach.moves[i][a:b, j]
    place = {k for k, name in enumerate(data.states) if name in PLACE}
    among = place if j in place and len(place) > 1 else {*range(len(data.states))}
    change = np.diff(y[a : b + 1], axis=0)[:, sorted(among - {j})]
    goes_on = np.mean(np.isfinite(change) & (change != 0.0), axis=0)
    if b - a < RESTLESS or np.max(goes_on, initial=0.0) <= FOLLOWED or (speed and abs(y[a, j]) < SIGMAS * reach.noise[j]):
        return False
    if data.states[j] == "theta" and {"x", "y"} <= {*data.states}:  # held by a rail, a robot goes where its heading says
        pose = [data.states.index(name) for name in ("x", "y", "theta")]
        if abs(course_of(y[a : b + 1, pose])) < ASIDE * abs(float(np.nansum(moves))):
            return False
    way, most = math.copysign(1.0, float(np.nansum(moves))), float(np.nanmax(np.abs(moves)))
    silent, still = _same_silence(data, i, j, within), []
    for k, (run, move) in enumerate(zip(data.runs, reach.moves, strict=True)):
        asked = (way * move[:, j] > 0.0) & (way * move[:, j] <= most)
        if k in silent:
            first, last = silent[k]
            asked[first:last] = False
        gone = np.diff(run.y[:, j])[asked]
        still.append(gone[np.isfinite(gone)] == 0.0)
    others, every = np.concatenate(still), np.concatenate([run.y[:, j] for run in data.runs])
    return len(others) >= RESTS and bool(np.mean(others) < REPEATS and np.nanmin(every) < y[a, j] < np.nanmax(every))


def _same_silence(data: Dataset, i: int, j: int, within: tuple[int, int]) -> dict[int, tuple[int, int]]:
    """The steps of a silence by run: it may go on at the same value in the runs before and after, up to where it ends."""
    value, silent = data.runs[i].y[within[0], j], {i: within}
    for way in (-1, 1):
        k, (first, last) = i, within
        while True:
            y = data.runs[k].y[:, j]
            beyond = y[:first] if way < 0 else y[last + 1 :]
            k += way
            if np.isfinite(beyond).any() or not 0 <= k < len(data.runs):
                break
            y = data.runs[k].y[:, j]
            others = np.flatnonzero(np.isfinite(y) & (y != value))
            first = 0 if way > 0 or not len(others) else int(others[-1]) + 1
            last = len(y) - 1 if way < 0 or not len(others) else int(others[0]) - 1
            if last < first:
                break
            silent[k] = first, last
    return silent


def _led(model: ComposedModel, data: Dataset, act: Acting, i: int, within: tuple[int, int]) -> Array:
    """(last - first + 1, nx) where the model goes over the steps [first, last) from a measured row: states that repeat go on from where it
    led, others are as they were measured. From one place that repeats, what pulls a level or a speed back would pull at every step anew.
    """
    first, last = within
    run, begun = data.runs[i], first_steps(data)[i]
    still = np.all(run.y[first + 1 : first + FROZEN_ROWS + 1] == run.y[first], axis=0)
    x = run.y[first].copy()
    led = [x]
    for k in range(first, last):
        x = np.where(still, x, run.y[k])
        try:
            after = advanced(model, x[None, :], act, slice(begun + k, begun + k + 1))
        except ConfigError:  # somebody's own model gives no numbers where it would have led: there it stays
            after = x[None, :]
        move = model.difference(after, x[None, :])[0]  # of an angle by less than half a turn
        x = x + np.where(np.isfinite(move), move, 0.0)
        led.append(x)
    return np.array(led)


def _with_them(model: ComposedModel, data: Dataset, i: int, bad: Mask) -> list[Fault]:
    """States that repeat exactly on rows on which others were found frozen, although they hardly ever do elsewhere: they came in the same
    message, however little they had to move.
    """
    run = data.runs[i]
    still, there = np.diff(run.y, axis=0) == 0.0, np.any(bad[1:], axis=1)
    if not np.any(there) or np.all(there):
        return []
    hardly = np.mean(still[~there], axis=0) < REPEATS
    found = []
    for a, b in stretches(there):
        for j, name in enumerate(model.states):
            if hardly[j] and not np.any(bad[a + 1 : b + 1, j]) and np.all(still[a:b, j]):
                found.append(_taken_out(data, i, j, name, (a, b), bad))
    return found


def _taken_out(data: Dataset, i: int, j: int, name: str, within: tuple[int, int], bad: Mask) -> Fault:
    """State j of run i, which repeats over the steps [a, b), marked in `bad` (K+1, nx) on the rows that repeat the first one."""
    a, b = within
    bad[a + 1 : b + 1, j] = True
    return fault_of(data, i, within, name, "frozen")


def _ignored(foretold: Array, y: Array, within: tuple[int, int], least: float) -> bool:
    """Whether a state that an input sets (a wheel's speed) stays through commands that it follows at all other times. Not at zero, where
    robots stand, nor where every command is beyond it: that is a limit. foretold: (K,) by the command.
    """
    a, b = within
    there, value = foretold[a:b], float(y[a])
    missed = float(np.max(np.abs(there - value)))
    limit = bool(np.all(there * math.copysign(1.0, value) >= abs(value) - least))
    if missed < least or float(np.ptp(there)) < least or abs(value) < least or limit:
        return False
    off = np.abs(y[1:] - foretold)
    followed = off < FOLLOWS * missed
    back = followed[b : b + FROZEN_ROWS]
    followed[a:b] = False
    others = len(followed) - (b - a)
    return bool(np.count_nonzero(followed) > FOLLOWED * others and np.any(back))


def _outermost(data: Dataset, j: int, value: float) -> bool:
    """Whether state j never goes beyond a value, in any run."""
    every = np.concatenate([run.y[:, j] for run in data.runs])
    return bool(np.nanmax(every) <= value or np.nanmin(every) >= value)


def _pegged(y: Array, e: Array, u: Array, first: int, least: float) -> bool:
    """Whether a state y (K+1,) that jitters elsewhere repeats a value that is not next to zero, from its row `first` on. At an end of what
    it ever is that is the end of a sensor's range: what holds a robot there (a full tank, an end stop) does not stop its sensor's noise.
    As in `_stuck`. A state that is read without any noise, of a process that has some, looks alike where something holds it.
    """
    others = _elsewhere(y, e) & (y[1:] != y[first])
    bend = _unasked(_bends(e[:, None])[:, 0], u, others)
    others &= np.isfinite(bend)
    jitter = float(np.median(np.abs(bend[others]))) if np.any(others) else 0.0
    if jitter <= least or abs(float(y[first])) <= MOVING * jitter or np.count_nonzero(others) < RESTS:
        return False
    return float(np.mean(np.diff(y)[others] == 0.0)) < REPEATS and _alternates(bend, others)


def _elsewhere(y: Array, e: Array) -> Mask:
    """(K,) steps of y (K+1,) that are measured, away from where it repeats and from the beginning. e: (K,) its residuals."""
    change = np.diff(y)
    others = np.isfinite(change) & np.isfinite(e)
    for a, b in stretches(change == 0.0):
        if b - a >= FROZEN_ROWS:
            others[a : b + 3] = False
    others[:BENDS] = False
    return others


def _stuck(y: Array, e: Array, u: Array, first: int, least: float) -> bool:
    """Whether a speed y (K+1,) that jitters wherever it is not next to zero is not from its row `first` on, which it repeats. Not one that
    hardly any exceeds: there a sensor may be at its end. e: (K,) its residuals; u: (K, nu) what was asked; least: of jitter that is no
    rounding.

    From row to row, noise of a measurement bends to and fro, whatever the inputs do; what moves evenly, or follows its commands in any
    way, and is read without noise, does not. Where it repeats for as long elsewhere is not asked.
    """
    value, change, others = float(y[first]), np.diff(y), _elsewhere(y, e)
    if np.count_nonzero(others) < RESTS or np.count_nonzero(np.abs(y) > abs(value)) < FROZEN_ROWS:
        return False
    bend = _unasked(_bends(e[:, None])[:, 0], u, others)
    others &= np.isfinite(bend)
    jitter = float(np.median(np.abs(bend[others]))) if np.any(others) else 0.0
    others &= np.minimum(np.abs(y[1:]), np.abs(y[:-1])) > MOVING * jitter
    if jitter <= least or abs(value) <= MOVING * jitter or np.count_nonzero(others) < RESTS:
        return False
    return float(np.mean(change[others] == 0.0)) < REPEATS and _alternates(bend, others)


def _bends(values: Array) -> Array:
    """(K, c) second differences of values (K, c), at the last of three rows; NaN for the first two."""
    return np.concatenate([np.full((2, values.shape[1]), np.nan), np.diff(values, n=2, axis=0)])[: len(values)]


def _unasked(bend: Array, u: Array, there: Mask) -> Array:
    """bend (K,) less what of it goes with bends of the inputs (K, nu), up to BENDS rows ago. there: (K,) by which that is told."""
    asked = _bends(u)
    lagged = np.column_stack([np.roll(asked, lag, axis=0) for lag in range(BENDS - 1)])
    told = there & np.isfinite(bend) & np.isfinite(lagged).all(axis=1)
    told[:BENDS] = False
    if np.count_nonzero(told) < RESTS:
        return np.full(len(bend), np.nan)
    rest = bend - np.nan_to_num(lagged) @ np.linalg.lstsq(lagged[told], bend[told], rcond=1e-9)[0]
    return np.where(np.isfinite(lagged).all(axis=1), rest, np.nan)


def _restless(change: Array, e: Array, resting: Mask, within: tuple[int, int]) -> bool:
    """Whether a state jitters on rows outside `within` on which it hardly moves. e: (K,) its residuals."""
    others = resting & np.isfinite(e)
    others[slice(*within)] = False
    if np.count_nonzero(others) < RESTS or float(np.mean(change[others] == 0.0)) >= REPEATS:
        return False
    return _alternates(e, others)


def _alternates(e: Array, there: Mask) -> bool:
    """Whether neighbours in e (K,), wild ones cut off, have the correlation of a measurement's noise. there: (K,) of which are asked."""
    pairs = there[:-1] & there[1:]
    limit = 3.0 * float(np.median(np.abs(e[there])))
    first, second = (np.clip(part[pairs], -limit, limit) for part in (e[:-1], e[1:]))
    size = float(np.sqrt(np.sum(first**2) * np.sum(second**2)))
    return bool(np.count_nonzero(pairs) >= RESTS // 2 and size > 0.0 and float(np.sum(first * second)) < ALTERNATES * size)
