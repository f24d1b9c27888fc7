"""Rollouts of the uncertain model (paper, eq. uncertain_trajectory). Batched: x (n, nx), u (n, nu).

    x_{k+1} = f(x_k, u_k) + d_k,   u_k = control(x_k, theta_k),   d_k as a law of `disturbance` draws it

In the order of driving: look at the state, let the controller see the scenario, step the model with its hidden state (from rest),
disturb, move the scenario, take note. Angles wrap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.controllers.observing import View, whole
from s2r_runtime.errors import ControllerError, UsageError
from s2r_runtime.evidence.disturbance import LAWS, Ahead, DisturbanceLaw, GapSet
from s2r_runtime.hookspecs import Scenario, Task
from s2r_runtime.models.bound import wrap
from s2r_runtime.models.composed import ComposedModel

__all__ = ["LAWS", "Array", "Control", "GapSet", "Rollouts", "roll_out"]

Array = NDArray[np.float64]
Control = Callable[[Array, Scenario], Array]
Progress = Callable[[float, float], None]

BATCH = 5000
"""Rollouts at a time: their arrays stay in a core's second-level cache. Part of what a seed means: another value, other draws."""

LOOK_EVERY = 8
"""Steps between two looks at whether to give up."""


@dataclass(frozen=True)
class Rollouts:
    """n rollouts: the task's safety values and progress (n,); the states of the first few, (steps + 1, nx) each, as far as they were
    driven, and their scenarios as they began.
    """

    safety: Array
    progress: Array
    paths: list[Array] = field(default_factory=list)
    scenarios: list[Scenario] = field(default_factory=list)


def roll_out(
    control: Control,
    task: Task,
    model: ComposedModel,
    gap: GapSet,
    law: str,
    rng: np.random.Generator,
    n: int,
    *,
    keep: int = 0,
    progress: Progress | None = None,
    give_up_below: float = -np.inf,
    view: View = whole,
) -> Rollouts:
    """n scenarios drawn independently, each driven once. keep: so many paths are kept; progress: called with done, total. view: what
    the controller is shown (`controllers.observing`).

    give_up_below: once a rollout is over with a safety value below this, all of them are left where they are (for who only asks whether
    there is one).

    Raises UsageError for an unknown law or weights that don't fit the model, ControllerError if the controller's answer is not a
    finite (n, nu) array or the state gets out of all bounds. What the controller itself raises passes through.
    """
    if law not in LAWS:
        raise UsageError(f"disturbance law {law!r} is not known, must be one of: {', '.join(LAWS)}")
    if len(gap.weights) != len(model.states):
        raise UsageError(f"gap set: {len(gap.weights)} weights, must be one for each of {', '.join(model.states)}")
    parts: list[Rollouts] = []
    for first in range(0, n, BATCH):
        size = min(BATCH, n - first)
        told = None if progress is None else lambda share, first=first, size=size: progress(first + share * size, n)
        parts.append(_batch(control, task, model, gap, LAWS[law], rng, size, max(0, min(size, keep - first)), told, give_up_below, view))
        if np.any(parts[-1].safety < give_up_below):
            break
    return Rollouts(
        np.concatenate([p.safety for p in parts]),
        np.concatenate([p.progress for p in parts]),
        [path for p in parts for path in p.paths],
        [scenario for p in parts for scenario in p.scenarios],
    )


def _batch(
    control: Control,
    task: Task,
    model: ComposedModel,
    gap: GapSet,
    law: DisturbanceLaw,
    rng: np.random.Generator,
    n: int,
    keep: int,
    progress: Callable[[float], None] | None,
    give_up_below: float,
    view: View,
) -> Rollouts:
    scenario = first = task.draw(rng, n)
    # columns contiguous: a state of all rollouts is one run of memory
    x = np.asfortranarray(scenario["start"])
    hidden = model.at_rest(n)
    drawn = law.begin(gap, rng, n)
    tally = task.observe(task.begin(scenario), x, scenario)
    over = task.done(tally)
    paths = [x[:keep].copy()]
    ends = np.full(keep, task.horizon)
    for k in range(task.horizon):
        u = _answer(control(x, view(x, task.view(scenario), first=k == 0)), n, len(model.inputs))
        stepped, hidden = model.step(x, u, hidden)
        ahead = np.asfortranarray(stepped)
        scenario = task.advance(scenario, rng)
        x = ahead + law.draw(gap, rng, drawn, Ahead(ahead, scenario, task, tally))
        for column in model.angle_columns:
            x[:, column] = wrap(x[:, column])
        if not np.all(np.isfinite(x)):
            raise ControllerError(f"the state is not finite after step {k + 1} of the model")
        tally = task.observe(tally, x, scenario)
        if keep:
            paths.append(x[:keep].copy())
            ends = np.minimum(ends, np.where(task.done(tally)[:keep], k + 1, task.horizon))
        if progress is not None:
            progress((k + 1) / task.horizon)
        over = task.done(tally)
        if over.all() or (k % LOOK_EVERY == 0 and np.any(over) and np.any(np.asarray(task.safety(tally))[over] < give_up_below)):
            break
    kept = [np.array([states[i] for states in paths[: ends[i] + 1]]) for i in range(keep)]
    scenarios = [{name: value[i : i + 1] for name, value in first.items()} for i in range(keep)]
    return Rollouts(np.asarray(task.safety(tally)), np.asarray(task.progress(tally)), kept, scenarios)


def _answer(u: Array, n: int, nu: int) -> Array:
    """u, if it is a finite (n, nu) array; raises ControllerError saying what it is."""
    answer = np.asarray(u)
    if answer.shape != (n, nu):
        raise ControllerError(f"the controller returned shape {answer.shape}, must be ({n}, {nu})")
    if answer.dtype.kind not in "fiu":
        raise ControllerError(f"the controller returned {answer.dtype}, must be numbers")
    if not np.all(np.isfinite(answer)):
        row = int(np.argwhere(~np.isfinite(answer))[0, 0])
        raise ControllerError(f"the controller returned {answer[row].tolist()} in row {row}, must be finite")
    return answer.astype(np.float64, copy=False)
