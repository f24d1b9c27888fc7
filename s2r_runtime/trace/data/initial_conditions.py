"""Did a run begin at rest, or in the middle of a drive? Hidden states (a lag's, a delay's) depend on what came before its first row.

A run whose first steps are foretold clearly better if its first inputs had been acting before was under way; these are then taken to have
been held before the run, long enough for hidden states to settle, but for one without which they are foretold better still: the robot was
told to turn just then. Otherwise the robot stood, and everything before is zero.

A state that the model sets to an input at once (a wheel's speed) says itself what had been acting when the run began: what was measured
first is taken to have been commanded before, whatever the first command is. A wheel that is still coasting down is then no riddle.

The first command need not have been held for long, and not all inputs change at once. If the first steps of a run that was under way are
far off, and those after them are not, something remembers another command, which nobody recorded: these rows only let it be forgotten.
They are told; and where all is explained, and nothing found that remembers, they count after all (`pipeline`): a limit may be met at the
start alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.models.input_chains import Inputs
from s2r_runtime.trace.data.dataset import Dataset, Run
from s2r_runtime.trace.estimation.prediction import acting, residual, steps_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FIRST = 2
"""Steps from which it is told."""

CLEARLY = 0.25
"""Ratio of squared errors below which it counts as clear; where noise hides it, the robot stood."""

NOT_YET = 0.5
"""The same, below which an input was at rest when another one had been held: less than a command leaves that is not carried out at all."""

MOVING = 0.05
"""Of the largest command: what was measured first counts as standing still below it."""

WILD = 5.0
"""Times the usual size of a residual from which the first ones are far off."""

FORGOTTEN, PART = 2, 0.05
"""Times as many steps as are far off that are left to forget in (what falls to 5 of usual from 40 is below 1 by then); share of a run that
is given to it at most.
"""

HELD_S, LEAST, MOST, SHARE = 10.0, 30, 300, 10
"""For how long the first input is taken to have been held, s; in steps at least LEAST, and at most MOST or one SHARE-th of the run. A car
at 30 m/s that follows its command in a second is 1.5 m/s off after three, and 1.4 mm/s after ten.
"""


def with_history(model: ComposedModel, data: Dataset) -> Dataset:
    """The dataset, its runs that began under way with what is taken to have been before: rows without a measurement. Those in which
    something else that was before may act on have none either, and are its `forgetting`, unless all count (`Dataset.from_first`).
    """
    usual = _usual(model, data)
    reached = [(model.states.index(x), model.inputs.index(u)) for x, u in getattr(model.nominal, "reached", {}).items()]
    size = np.max(np.abs(np.concatenate([run.u for run in data.runs])), axis=0)
    runs, forgetting = [], []
    for run in data.runs:
        steps = int(np.clip(HELD_S / data.dt, LEAST, max(MOST, len(run.y) // SHARE)))
        guessed = _acted(model, data, run, steps, usual)
        before = np.where(guessed, run.u[0], 0.0)
        if not np.isnan(run.y[0]).any():
            for x, u in reached:
                before[u] = run.y[0, x] if abs(run.y[0, x]) > MOVING * size[u] else 0.0
                guessed[u] = False
        laid = _preceded(data, run, steps, before) if np.any(before) else run
        early = len(laid.y) - len(run.y)
        rows = 0 if data.from_first or not guessed.any() else _forgetting(model, data, laid, early, usual)
        if rows:
            forgetting.append((run.start_s, run.start_s + float(np.sum(run.durations(data.dt)[:rows]))))
            y = laid.y.copy()
            y[: early + rows] = np.nan
            laid = replace(laid, y=y)
        runs.append(laid)
    return replace(data, runs=tuple(runs), forgetting=tuple(forgetting))


def _forgetting(model: ComposedModel, data: Dataset, run: Run, before: int, usual: Array) -> int:
    """First rows, after so many steps of what was before, in which a run that was under way shows that something else was before."""
    rows = len(run.y) - before
    most = int(PART * rows)
    first = replace(data, runs=(run,))
    steps = steps_of(first)
    off = np.any(np.abs(residual(model, steps, acting(model, first))) > WILD * usual, axis=1)
    there = off[: most + 1] & (steps.place[: most + 1] == before + np.arange(min(most + 1, len(off))))
    wild = int(np.argmin(there)) if not there.all() else 0  # what goes on is no matter of the beginning
    return min(FORGOTTEN * wild, most)


def _usual(model: ComposedModel, data: Dataset) -> Array:
    """(nx,) usual size of a residual, which tells how much an error of the first steps weighs. A speed that was not measured tells nothing:
    it was made with the inputs. So was a hidden state, but it may be all that an input moves within a step: it counts by how well it is
    known.
    """
    act = acting(model, data)
    steps = steps_of(data)
    size = np.median(np.abs(residual(model, steps, act)), axis=0) / 0.6745 + 1e-12 if len(steps) else np.ones(len(model.states))
    made = data.reconstruction
    for j, (_, v) in enumerate(data.axes_without_speed):
        size[v] = max(made.errors[j], size[v]) if made is not None and made.hidden else np.inf
    return size


def _acted(model: ComposedModel, data: Dataset, run: Run, steps: int, usual: Array) -> Mask:
    """(nu,) inputs with which the first steps are foretold clearly better if they had been held before than from rest."""
    none = np.zeros(run.u.shape[1], dtype=bool)
    if len(run.y) < FIRST + 1 or not np.any(run.u[: data.substeps]) or np.isnan(run.y[: FIRST + 1]).any():
        return none
    held = run.u[0] != 0.0
    driven, rested = (_at_first(model, data, run, np.where(mask, run.u[0], 0.0), steps) for mask in (held, none))
    forgets = np.allclose(driven, rested)  # nothing in the model remembers: what was before shows in the first step alone

    def off(mask: Mask) -> float:
        """Squared errors of the first steps."""
        u = _at_first(model, data, run, np.where(mask, run.u[0], 0.0), steps)
        if forgets:
            u = np.concatenate([np.where(mask, u[:1], 0.0), u[1:]])
        return float(np.sum((_errors(model, run, u) / usual) ** 2))

    for i in np.flatnonzero(held).tolist():
        less = held & (np.arange(len(held)) != i)
        held = less if off(less) < NOT_YET * off(held) else held
    return held if off(held) < CLEARLY * off(none) else none


def _at_first(model: ComposedModel, data: Dataset, run: Run, before: Array, steps: int) -> Array:
    """(FIRST, parts, nu) what acts in the first steps after so many of an input (nu,)."""
    first, part = FIRST * data.substeps, data.dt / data.substeps
    u = np.concatenate([np.tile(before, (steps * data.substeps, 1)), run.u[:first]])
    return (
        Inputs([u], part, [run.start_s + part * (first - len(u))]).through(model, _chain(model))[-first:].reshape(FIRST, data.substeps, -1)
    )


def _chain(model: ComposedModel) -> list[AppliedEffect]:
    return [a for a in model.effects if a.effect.stage == "input"]


def _errors(model: ComposedModel, run: Run, u: Array) -> Array:
    """(FIRST, nx) residuals of the first steps under an input as it acts, (FIRST, parts, nu)."""
    foretold = model.advance(run.y[:FIRST], u.mean(axis=1), u[:, -1])
    return model.difference(run.y[1 : FIRST + 1], foretold)


def _preceded(data: Dataset, run: Run, steps: int, before: Array) -> Run:
    """The run after so many steps of an input (nu,)."""
    y = np.concatenate([np.full((steps, run.y.shape[1]), np.nan), run.y])
    first = np.tile(before, (steps * data.substeps, 1))
    lasts = None if run.lasts is None else np.concatenate([np.full(steps, data.dt), run.lasts])
    turned = None if run.turned is None else np.concatenate([np.zeros((steps, run.u.shape[1]), dtype=bool), run.turned])
    return Run(run.start_s - steps * data.dt, y, np.concatenate([first, run.u]), lasts, turned, run.segment)
