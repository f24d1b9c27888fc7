"""Tubes: whether a scenario is safe under *every* disturbance sequence in the gap set, not under drawn ones (guarantee G13).

    z_{k+1} = F_k(z_k)              the nominal run: closed loop F_k without disturbance, in the scenario's k-th step
    x_{k+1} = F_k(x_k) + d_k        any run with all d_k in D = {d : |d|_W <= R}, from the same start

A scenario's own course does not depend on the state (`Task.advance`), so both runs meet the same F_k. e_k = x_k - z_k, e_0 = 0.

`linear`   F_k(x) - F_k(z) = M (x - z) for all x, z, with M = A - B K: a linear model with linear feedback (`linear_feedback`).
           Then e_k = sum_{j<k} M^j d_{k-1-j} exactly. For a projection C on position, the triangle inequality gives

               |C e_k| <= R sum_{j<k} g_j,     g_j = max {|C M^j d| : |d|_W <= 1}.
               ball: the spectral norm of C M^j W^-1.    box: the maximum over the corners, because a norm is convex.

`rate`     A person states L: |F_k(x) - F_k(z_k)|_W <= L |x - z_k|_W for every x in the tube, at every step of every scenario.
           Then |e_{k+1}|_W <= L |e_k|_W + R, so |e_k|_W <= R sum_{j<k} L^j, and |C e_k| is at most that times max {|C d| : |d|_W <= 1}.
           This is an assumption. Drawn states in the tube test it at every step; they may refute it, and cannot prove it.

A scenario is *enclosed* when the task's own rule (`Task.enclosed`) calls every position within that reach of z_k safe, for each k until
all such runs are over. Then no disturbance in D^J makes it unsafe. N scenarios drawn independently, N fixed beforehand, f not enclosed:
P(a new scenario is not enclosed) <= Clopper-Pearson(f, N). All else is *worst found, not proved*: a search over disturbances
shows that there is a bad one, never that all are good.

Models with memory have no tube here: their runs differ in more than x. References: A. Girard, *Reachability of uncertain linear systems
using zonotopes*, HSCC 2005; tubes from a contraction rate: W. Lohmiller & J.-J. Slotine, *On contraction analysis*, Automatica 1998.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import UsageError
from s2r_runtime.evidence.uncertain import Control, GapSet
from s2r_runtime.hookspecs import Task
from s2r_runtime.models.bound import wrap
from s2r_runtime.models.composed import ComposedModel

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

NOT_PROVED = "worst found, not proved"
"""What is reported of every check against disturbances other than an enclosure."""
ROUNDING, ROUNDING_M = 1e-9, 1e-9
"""By which a reach is enlarged, as a share and in m. Some thousand steps in double precision are off by less than 1e-12 of what moves."""
SHRINK = 1.0 - 1e-9
"""Of the tube's radius, for drawn states: they are in the tube whatever is rounded."""
SCALES = 3.0
"""Powers of ten, over which the distances of drawn states are spread evenly."""
CORNERS_MAX = 16
"""States of a box whose corners are enumerated."""


@dataclass(frozen=True)
class Tube:
    """reach: (horizon + 1,), by how much a disturbed run's position may be off the nominal one's after k steps, m. norm: the same for the
    whole state in the gap set's norm, or None where it is not needed. rate: the stated one, or None for a linear loop.
    """

    reach: Array
    norm: Array | None = None
    rate: float | None = None


@dataclass(frozen=True)
class Enclosed:
    """Of n scenarios: whether each is enclosed (n,); the largest reach that was compared, m; and the largest rate that drawn states showed
    (0: not tested).
    """

    enclosed: Bools
    reach: float
    rate_seen: float = 0.0

    @property
    def failed(self) -> int:
        """Number of scenarios that are not enclosed."""
        return int(np.sum(~self.enclosed))


def tube_for(gain: Sequence[Sequence[float]] | None, rate: float, task: Task, model: ComposedModel, gap: GapSet, threshold: float) -> Tube:
    """The tube of a stated rate, or of linear feedback if rate is 0. gain: of the feedback (`linear_feedback.gain_of`), None: not linear.

    Raises UsageError where no tube can be had, with what would give one.
    """
    columns = position_columns(task, model)
    if any(z.size for z in model.at_rest(1)):
        raise UsageError(f"the model {model.nominal.name} has effects with memory, for which there is no tube: {NOT_PROVED}")
    named: Any = task
    scenario = task.draw(np.random.default_rng(0), 1)
    if named.enclosed(scenario["start"], 0.0, scenario, threshold) is None:
        raise UsageError(
            f"the task {task.name} does not say what is safe within a distance at verification.threshold = {threshold:g}: {NOT_PROVED}"
        )
    if rate > 0.0:
        return rate_tube(rate, gap, columns, task.horizon)
    if gain is None:
        raise UsageError(
            "the controller is not linear feedback by its source (GAIN, reference, control as in docs/composition.md), so its loop has "
            f"no exact tube: {NOT_PROVED}. State a rate of its closed loop: --rate L --because TEXT"
        )
    return linear_tube(closed_loop(model, np.array(gain, dtype=np.float64)), gap, columns, task.horizon)


def position_columns(task: Task, model: ComposedModel) -> list[int]:
    """Columns of the states in which the task measures distance. Raises UsageError for a task without `enclosed`."""
    if not hasattr(task, "enclosed"):
        raise UsageError(
            f"the task {task.name} does not say what is safe within a distance (Task.enclosed), so no tube can be compared with it: "
            f"{NOT_PROVED}"
        )
    named: Any = task
    return [model.states.index(name) for name in named.position]


def closed_loop(model: ComposedModel, gain: Array) -> Array:
    """M = A - B K, (nx, nx), of a linear model under the feedback u = v_k - K (x - r_k). gain: K (nu, nx).

    Raises UsageError for a model that is not linear, or a gain of another shape.
    """
    nx, nu = len(model.states), len(model.inputs)
    if not getattr(model.nominal.shared, "linear", False) or model.effects:
        effects = "".join(f" + {one.effect.name}" for one in model.effects)
        raise UsageError(f"the model {model.nominal.name}{effects} is not linear, so feedback alone gives no tube; state a rate (--rate)")
    if gain.shape != (nu, nx):
        raise UsageError(f"GAIN has shape {gain.shape}, must be ({nu}, {nx}) for the model {model.nominal.name}")
    none = model.at_rest(nx)
    a = model.step(np.eye(nx), np.zeros((nx, nu)), none)[0].T
    b = model.step(np.zeros((nu, nx)), np.eye(nu), model.at_rest(nu))[0].T
    return np.asarray(a - b @ gain)


def linear_tube(matrix: Array, gap: GapSet, columns: list[int], horizon: int) -> Tube:
    """The tube of e_{k+1} = M e_k + d_k. matrix: M (nx, nx); columns: of the position."""
    power, gains = np.eye(len(matrix)), []
    for _ in range(horizon):
        gains.append(_largest(power[columns], gap))
        power = power @ matrix
    return Tube(gap.radius * np.concatenate([[0.0], np.cumsum(gains)]))


def rate_tube(rate: float, gap: GapSet, columns: list[int], horizon: int) -> Tube:
    """The tube of a loop that takes states at most `rate` times as far from the nominal run. Raises UsageError unless rate > 0."""
    if not 0.0 < rate < np.inf:
        raise UsageError(f"the rate is {rate}, must be above 0 and finite")
    with np.errstate(over="ignore"):
        norm = gap.radius * np.concatenate([[0.0], np.cumsum(rate ** np.arange(horizon))])
    return Tube(norm * _largest(np.eye(len(gap.weights))[columns], gap), norm, rate)


def _largest(rows: Array, gap: GapSet) -> float:
    """max {|rows d| : |d|_W <= 1}, rows (m, nx). Raises UsageError for a box of too many states."""
    weighted = rows / np.asarray(gap.weights)
    if gap.kind == "ball":
        return float(np.linalg.norm(weighted, 2))
    active = np.flatnonzero(np.any(weighted != 0.0, axis=0))
    if len(active) > CORNERS_MAX:
        raise UsageError(f"a box of {len(active)} states has too many corners for a tube, at most {CORNERS_MAX} are enumerated; use a ball")
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=len(active)))).reshape(-1, len(active))
    return float(np.max(np.linalg.norm(corners @ weighted[:, active].T, axis=1), initial=0.0))


def enclose(
    control: Control,
    task: Task,
    model: ComposedModel,
    gap: GapSet,
    tube: Tube,
    rng: np.random.Generator,
    n: int,
    *,
    threshold: float = 0.0,
    progress: Callable[[float, float], None] | None = None,
) -> Enclosed:
    """n scenarios drawn independently, each compared with the tube around its nominal run. A stated rate is tested on the way.

    The model has no memory, and the task says what is safe at this threshold (`tube_for` refuses others).
    """
    hidden = model.at_rest(n)
    named: Any = task
    drawn = np.random.default_rng(rng.integers(1 << 63))  # apart, so that the scenarios are the same with and without a stated rate
    scenario = task.draw(rng, n)
    x = np.asfortranarray(scenario["start"])
    safe, over = np.ones(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    farthest, seen = 0.0, 0.0
    for k in range(task.horizon + 1):
        reach = float(tube.reach[k]) * (1.0 + ROUNDING) + ROUNDING_M
        found = named.enclosed(x, reach, scenario, threshold) if np.isfinite(reach) else (np.zeros(n, dtype=np.bool_), over)
        safe &= found[0] | over
        over |= safe & found[1]
        farthest = max(farthest, reach)
        if k == task.horizon or np.all(over | ~safe):
            break
        view = task.view(scenario)
        ahead, after = model.step(x, control(x, view), hidden)
        if tube.rate is not None and tube.norm is not None and tube.norm[k] > 0.0 and np.isfinite(tube.norm[k]):
            scale = SHRINK * 10.0 ** (-SCALES * drawn.random(n))  # a jump shows in states near the nominal run, a slope anywhere
            other = x + scale[:, None] * gap.inside(drawn, n, float(tube.norm[k]))
            there = model.step(np.asfortranarray(other), control(other, view), hidden)[0]
            live = safe & ~over
            ratio = gap.norm(_apart(there, ahead, model)) / np.maximum(gap.norm(other - x), 1e-300)
            seen = max(seen, float(np.max(ratio[live], initial=0.0)))
        x, hidden = np.asfortranarray(ahead), after
        for column in model.angle_columns:
            x[:, column] = wrap(x[:, column])
        scenario = task.advance(scenario, rng)
        if progress is not None:
            progress((k + 1) * n / task.horizon, n)
    return Enclosed(safe, farthest, seen)


def _apart(a: Array, b: Array, model: ComposedModel) -> Array:
    """a - b, (n, nx), angles by the shorter way."""
    difference = a - b
    for column in model.angle_columns:
        difference[:, column] = wrap(difference[:, column])
    return difference
