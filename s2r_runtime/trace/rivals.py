"""Which other effects do these data leave possible?

A rival replaces one effect of the chosen model and explains as much: its log likelihood, noise re-estimated, is within CLOSE of the chosen
one's. What its parameters cost does not count here: being simpler is a reason to prefer, not to know.

A richer effect that has fitted itself to the chosen one (a gain by sign with both gains alike) says the same thing and is no rival. That is
seen on inputs and states that these data need not have: values of both signs up to the largest seen, held short and long, from
anywhere about where the robot was, in any direction, at times over the whole recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.dataset import Dataset, Run
from s2r_runtime.trace.fitting import Fit, Problem, fitted, gain, scatter, without
from s2r_runtime.trace.residual import acting, steps_of
from s2r_runtime.trace.scores import Scored, best_candidates, limited, name_of

Array = NDArray[np.float64]

CLOSE = 3.0
"""Nats of likelihood within which rivals cannot be told apart: odds of 20 to 1."""

LOOSEST = 6.0
"""Noise that wanders makes differences of likelihood larger than they mean, up to this."""

FITTED = 12
"""Candidates that are fitted as rivals, after screening."""

ALIKE = 0.05
"""Mean square of what two models differ in, as a share of what the effect itself does, below which a richer one is the same thing."""

PROBES, PROBE_STEPS = 8, 120
"""Runs and steps of the rich inputs."""


def rivals(given: Problem, fit: Fit) -> list[Scored]:
    """Models with one effect replaced by another, of which the likelihood says the same."""
    found = []
    rich = _rich(given, fit.model) if fit.added else None
    loose = scatter(given, fit) ** 2 if fit.free else np.ones(0)
    for place in fit.added:
        close = CLOSE * min(max([1.0, *(loose[i] for i, slot in enumerate(fit.free) if slot.place == place)]), LOOSEST)
        mine = name_of(fit.model.effects[place])
        base = fitted(given, fit, without(fit.model, place), 1)
        here = gain(fit, base)
        for s in best_candidates(given, base, FITTED, against=here - close)[0]:
            if s.fit is None or (s.name, s.channel) == mine or not limited(s.fit) or gain(s.fit, base) < here - close:
                continue
            if s.fit.k <= fit.k or rich is None or rich.apart(s.fit.model, fit.model) > ALIKE * rich.apart(fit.model, base.model):
                found.append(s)
    return found


@dataclass(frozen=True)
class _Rich:
    """Rich inputs on a robot, from states all about. scale: (nx,) of its steps."""

    data: Dataset
    scale: Array

    def apart(self, one: ComposedModel, other: ComposedModel) -> float:
        """Mean square difference of their steps, on the scale of the steps themselves."""
        steps = steps_of(self.data)
        a, b = (m.advance(steps.y0, act.mean[steps.place], act.end[steps.place]) for m in (one, other) for act in [acting(m, self.data)])
        return float(np.mean((one.difference(a, b) / self.scale) ** 2))


def _rich(given: Problem, model: ComposedModel) -> _Rich:
    rng = np.random.default_rng(0)
    source, steps = given.data, given.steps
    largest = np.max(np.abs(np.concatenate([run.u for run in source.runs])), axis=0)
    low, high = np.min(steps.y0, axis=0), np.max(steps.y0, axis=0)
    low, high = low - 0.5 * (high - low), high + 0.5 * (high - low)
    low[model.angle_columns], high[model.angle_columns] = -np.pi, np.pi
    runs = []
    for start in np.linspace(float(steps.t[0]), float(steps.t[-1]), PROBES):
        hold = np.maximum(1, np.rint(10.0 ** rng.uniform(0.0, 1.6, PROBE_STEPS)).astype(int))
        u = np.repeat(rng.uniform(-1.0, 1.0, (PROBE_STEPS, len(largest))) * largest, hold, axis=0)[:PROBE_STEPS]
        y = rng.uniform(low, high, (PROBE_STEPS + 1, len(low)))
        runs.append(Run(float(start), y, np.repeat(u, source.substeps, axis=0)))
    made = Dataset(source.states, source.inputs, source.dt, source.substeps, tuple(runs), False, 0, "rich inputs")
    return _Rich(made, np.sqrt(np.mean((steps.y1 - steps.y0) ** 2, axis=0)) + 1e-12)
