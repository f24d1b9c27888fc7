"""Did a run begin at rest, or in the middle of a drive? Hidden states (a lag's, a delay's) depend on what came before its first row.

A run whose first steps are foretold clearly better if its first input had been acting before was under way; that input is then taken to
have been held before the run, long enough for hidden states to settle. Otherwise the robot stood, and everything before is zero.

A state that the model sets to an input at once (a wheel's speed) says itself what had been acting when the run began: what was measured
first is taken to have been commanded before, whatever the first command is. A wheel that is still coasting down is then no riddle.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.trace.chains import Inputs
from s2r_runtime.trace.dataset import Dataset, Run
from s2r_runtime.trace.residual import acting, residual, steps_of

Array = NDArray[np.float64]

FIRST = 2
"""Steps from which it is told."""

CLEARLY = 0.25
"""Ratio of squared errors below which it counts as clear; where noise hides it, the robot stood."""

MOVING = 0.05
"""Of the largest command: what was measured first counts as standing still below it."""

HELD_S = 3.0
"""For how long the first input is taken to have been held, s (30 to 300 steps)."""


def with_history(model: ComposedModel, data: Dataset) -> Dataset:
    """The dataset, its runs that began under way with what is taken to have been before: rows without a measurement."""
    steps = int(np.clip(HELD_S / data.dt, 30, 300))
    usual = _usual(model, data)
    reached = [(model.states.index(x), model.inputs.index(u)) for x, u in getattr(model.nominal, "reached", {}).items()]
    size = np.max(np.abs(np.concatenate([run.u for run in data.runs])), axis=0)
    runs = []
    for run in data.runs:
        under_way = _under_way(model, data, run, steps, usual)
        before = run.u[0].copy() if under_way else np.zeros(run.u.shape[1])
        if not np.isnan(run.y[0]).any():
            for x, u in reached:
                before[u] = run.y[0, x] if abs(run.y[0, x]) > MOVING * size[u] else 0.0
        runs.append(_preceded(data, run, steps, before) if np.any(before) else run)
    return replace(data, runs=tuple(runs))


def _usual(model: ComposedModel, data: Dataset) -> Array:
    """(nx,) usual size of a residual, which tells how much an error of the first steps weighs. A speed that was not measured tells nothing:
    it was made with the inputs.
    """
    act = acting(model, data)
    steps = steps_of(data)
    size = np.median(np.abs(residual(model, steps, act)), axis=0) / 0.6745 + 1e-12 if len(steps) else np.ones(len(model.states))
    size[[v for _, v in data.axes_without_speed]] = np.inf
    return size


def _under_way(model: ComposedModel, data: Dataset, run: Run, steps: int, usual: Array) -> bool:
    """Whether the first steps are foretold clearly better with the first input held before them than from rest."""
    first = FIRST * data.substeps
    if len(run.y) < FIRST + 1 or not np.any(run.u[: data.substeps]) or np.isnan(run.y[: FIRST + 1]).any():
        return False
    held = np.concatenate([np.tile(run.u[:1], (steps * data.substeps, 1)), run.u[:first]])
    part = data.dt / data.substeps
    acted = [
        Inputs([u], part, [run.start_s + part * (first - len(u))]).through(model, _chain(model))[-first:].reshape(FIRST, data.substeps, -1)
        for u in (held, run.u[:first])
    ]
    if np.allclose(acted[0], acted[1]):  # nothing in the model remembers: what was before shows in the first step alone
        acted[1] = np.where(np.arange(FIRST)[:, None, None] == 0, 0.0, acted[1])
    errors = [_errors(model, run, u) for u in acted]
    driven, rested = (float(np.sum((e / usual) ** 2)) for e in errors)
    return driven < CLEARLY * rested


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
    return Run(run.start_s - steps * data.dt, y, np.concatenate([first, run.u]), lasts, turned)
