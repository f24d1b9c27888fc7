"""Do inputs and states have one clock?

Inputs that come after the motion that they cause are on another clock: the model foretells a tenth of a second far better with the inputs
earlier by some steps than with any delay. Where that lead grows over the recording, the clocks run at different rates. Friction makes a
mass follow its force sooner than without: where inputs push, what goes with the state at the start, and with the way that rates go from
there on, is taken out of every error first.
Where it holds the mass, for a while or from then on, inputs do nothing, and that is compared with, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import axes
from s2r_runtime.trace.checks.prediction_error import FEWEST_STARTS
from s2r_runtime.trace.data.dataset import Dataset, Run
from s2r_runtime.trace.estimation.prediction import Index, acting, first_steps, rollout, rollout_starts

Array = NDArray[np.float64]

LEAD_S, APART_S = 4.0, 0.05
LEADS = (-60, -40, -28, -20, -14, -10, -7, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 7, 10, 14, 20, 28, 40, 56, 80)
"""Leads (below zero: delays) that are tried, in steps and in steps of APART_S, up to LEAD_S and to a quarter of the longest run."""

GLANCE_S, GLANCES = 0.1, 2400
"""What is foretold to see which input it was (1 to 50 steps: in one step of a fast recording nothing moves), and from how many rows."""

WILD = 6.0
"""Robust standard deviations beyond which a residual counts no more."""

AHEAD = 0.4
"""Squared error with the inputs earlier, over the best with them as they are or later, below which they are on another clock."""

EVENLY = 0.3
"""Of how far a lead goes over the recording: how far it may lie off a line."""

DRIFTS, PARTS, DRIFTING = 3, 8, 0.7
"""Steps by which the lead must grow from the first to the last of so many parts of the recording; and the squared error with it, over
the one with the best lead for all, below which it does.
"""


def check_clocks(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if the motion comes before the inputs."""
    apart = max(1, round(APART_S / data.dt))
    longest = max((len(run.y) for run in data.runs), default=0)
    tried = sorted({lead * unit for lead in LEADS for unit in (1, apart)})
    leads = [lead for lead in tried if (abs(lead) * data.dt <= LEAD_S or abs(lead) <= 2) and 4 * abs(lead) < longest]
    long = [run for run in data.runs if leads and len(run.y) > 4 * max(leads)]
    if not long or not any(np.any(run.u[1:] != run.u[:-1]) for run in long):
        return
    few = replace(data, runs=tuple(long))
    ahead = int(np.clip(round(GLANCE_S / data.dt), 1, 50))
    starts = rollout_starts(few, ahead)
    starts = starts[:: max(1, len(starts) // GLANCES)]
    if len(starts) < FEWEST_STARTS:
        return
    size = np.median(np.abs(_errors(model, few, 0, starts, ahead)), axis=0) / 0.6745 + 1e-12
    aside = _pushed_aside(model, few, starts, ahead)

    def costs(lead: int, of: Dataset = few) -> list[float]:
        z = _errors(model, of, lead, starts, ahead) / size
        return [float(np.sum(part)) for part in _parts(z if aside is None else _less(z, aside))]

    cost = np.array([costs(lead) for lead in leads])
    total = cost.sum(axis=1)
    best = leads[int(np.argmin(total))]
    by_part = [leads[int(k)] for k in np.argmin(cost, axis=0)]
    steadily = by_part in (sorted(by_part), sorted(by_part, reverse=True))
    followed, single = float(np.sum(np.min(cost, axis=0))), float(np.min(total))
    even = max(by_part) > 0 or _evenly(by_part)  # a delay may grow: by the same in every part, it is a clock's
    drifts = abs(by_part[-1] - by_part[0]) >= DRIFTS and steadily and even and followed < DRIFTING * single
    still = replace(few, runs=tuple(replace(run, u=0.0 * run.u, turned=None) for run in long))
    try:
        held = np.array(costs(0, still))  # friction that holds a robot for a while makes inputs do nothing
    except ConfigError:  # somebody's own model may need some
        held = np.full(cost.shape[1], math.inf)
    causal = float(np.min(np.minimum(cost, held).sum(axis=1)[np.array(leads) <= 0]))
    if min(followed if drifts else math.inf, single if best > 0 else math.inf) < AHEAD * causal:
        causal = min(causal, _least_causal(lambda delay: sum(costs(-delay)), min(round(LEAD_S / data.dt), longest // 4), apart))
    if drifts and followed < AHEAD * causal:
        first, last = (f"{abs(lead) * data.dt:.2g} s {'before' if lead > 0 else 'after'}" for lead in (by_part[0], by_part[-1]))
        raise RecordingError(
            f"{data.source}: the motion comes {first} the inputs that cause it at first and {last} them in the end: their clocks run "
            "at different rates, their stamps must be of one clock"
        )
    if best > 0 and single < AHEAD * causal:
        best = min(range(round(0.7 * best), round(1.4 * best) + 1, max(1, best // 20)), key=lambda lead: sum(costs(lead)))
        raise RecordingError(
            f"{data.source}: the motion comes about {best * data.dt:.2g} s before the inputs that cause it: their stamps must be of "
            "one clock, and an input must stand at the time from which it acts"
        )


def _evenly(leads: list[int]) -> bool:
    """Whether they lie on a line, but for the grid of what is tried."""
    line = np.linspace(leads[0], leads[-1], len(leads))
    return bool(np.max(np.abs(np.array(leads) - line)) <= EVENLY * abs(leads[-1] - leads[0]))


def _least_causal(cost: Callable[[int], float], longest: int, apart: int) -> float:
    """Of all delays up to the longest, steps, at the bottom between them: inputs that repeat themselves come before and after it."""
    near = min(range(0, longest + 1, apart), key=cost)
    around = {delay: cost(delay) for delay in range(max(0, near - apart), near + apart + 1)}
    best = min(around, key=lambda delay: around[delay])
    if best - 1 not in around or best + 1 not in around:
        return around[best]
    before, here, after = (around[best + k] for k in (-1, 0, 1))
    bend = before - 2.0 * here + after
    return max(0.0, here - (before - after) ** 2 / (8.0 * bend)) if bend > 0.0 else here


def _errors(model: ComposedModel, data: Dataset, lead: int, starts: Index, ahead: int) -> Array:
    """(n, nx) after `ahead` steps with the inputs earlier by `lead`."""
    shifted = replace(data, runs=tuple(earlier(run, lead * data.substeps) for run in data.runs))
    with np.errstate(all="ignore"):
        error = rollout(model, data, acting(model, shifted), starts, ahead).error
    return np.nan_to_num(error, nan=1e300, posinf=1e300, neginf=-1e300)


def _pushed_aside(model: ComposedModel, data: Dataset, starts: Index, ahead: int) -> Array | None:
    """(n, k) what friction and springs could go with in rollouts: each state at the start, which way it goes there, and how much of the
    rollout a rate goes either way. None for a robot on a plane, whose inputs set its speeds: what it does now tells what was asked a
    moment ago.
    """
    if {"x", "y", "theta"} <= set(model.states):
        return None
    begin = first_steps(data)
    every = np.concatenate([run.y for run in data.runs])
    rows = starts + np.searchsorted(begin, starts, side="right") - 1
    rates = [axis.velocity for axis in axes(model.nominal)]
    y = every[rows]
    y = y - np.where(np.isin(np.arange(y.shape[1]), rates), 0.0, y.mean(axis=0))
    ways = np.cumsum(np.concatenate([np.zeros((1, len(rates))), np.nan_to_num(np.sign(every[:, rates]))]), axis=0)
    return np.column_stack([np.ones(len(y)), y, np.sign(y), (ways[rows + ahead] - ways[rows]) / ahead])


def _less(z: Array, aside: Array) -> Array:
    """z (n, nx) less what of it goes with `aside` (n, k), wild values cut off."""
    for _ in range(2):
        z = z - aside @ np.linalg.lstsq(aside, np.clip(z, -WILD, WILD), rcond=1e-8)[0]
    return z


def _parts(z: Array) -> list[Array]:
    """Squares, cut off where they are wild, of each part of the recording."""
    return np.array_split(np.minimum(np.abs(z), WILD) ** 2, PARTS)


def earlier(run: Run, rows: int) -> Run:
    """With its inputs so many of their rows earlier (later, if negative); the last ones (the first ones) hold."""
    u = np.roll(run.u, -rows, axis=0)
    if rows > 0:
        u[-rows:] = run.u[-1]
    elif rows < 0:
        u[:-rows] = run.u[0]
    return replace(run, u=u, turned=None)
