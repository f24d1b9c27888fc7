"""The gap set D and the laws that disturbances are drawn from (paper, eq. uncertain_model; guarantee G8). Batched over n rollouts.

    D = {d : |d|_W <= r},   |d|_W = sqrt(sum_i (w_i d_i)^2) (ball) or max_i w_i |d_i| (box)

`uniform`      d_k independent, uniform in D.
`persistent`   d_k = m g + e_k: direction g drawn once a rollout, uniform, |g|_W = 1; m = r_h / h; e_k independent, uniform in what D
               leaves around the push, the same set with radius r - m (none if m > r: the push itself is never cut).
`adversarial`  as persistent, but g is chosen at every step: down the gradient of the task's clearance at f(x_k, u_k), steepest in
               the norm of D. A task without a clearance: the axis direction after which the task's safety value is least.

Directions: ball, W g uniform on the unit sphere; box, uniform on the surface of the box, because what bounds the hold gap there is
the box's own norm, and a sphere inside the box would leave its corners untried.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import UsageError
from s2r_runtime.hookspecs import Scenario, Task

Array = NDArray[np.float64]

SLOPE_STEP = 1e-6
"""Step of the clearance's difference quotients, in the norm's unit: far above rounding, far below any clearance that matters."""


@dataclass(frozen=True)
class GapSet:
    """D and the hold gap. weights: one a state, > 0; radius, hold_radius in the norm's unit. Raises UsageError for impossible values."""

    kind: Literal["ball", "box"]
    weights: tuple[float, ...]
    radius: float
    hold_radius: float = 0.0
    hold_periods: int = 1

    def __post_init__(self) -> None:
        if self.kind not in {"ball", "box"}:
            raise UsageError(f"gap set: kind is {self.kind!r}, must be ball or box")
        if not all(0.0 < w < np.inf for w in self.weights) or not self.weights:
            raise UsageError(f"gap set: weights are {list(self.weights)}, must be numbers > 0")
        for name, value in (("radius", self.radius), ("hold radius", self.hold_radius)):
            if not 0.0 <= value < np.inf:
                raise UsageError(f"gap set: {name} is {value}, must be >= 0 and finite")
        if self.hold_periods < 1:
            raise UsageError(f"gap set: hold periods are {self.hold_periods}, must be >= 1")

    @property
    def push(self) -> float:
        """m = r_h / h, in the norm's unit per step."""
        return self.hold_radius / self.hold_periods

    @property
    def rest(self) -> float:
        """r - m, not below 0: the radius of what D leaves around a push."""
        return max(self.radius - self.push, 0.0)

    def norm(self, d: Array) -> Array:
        """|d|_W of each row, (n,)."""
        weighted: Array = np.abs(d * np.asarray(self.weights))
        if self.kind == "box":
            return np.asarray(weighted.max(axis=1))
        return np.asarray(np.sqrt(np.sum(weighted * weighted, axis=1)))

    def inside(self, rng: np.random.Generator, n: int, radius: float) -> Array:
        """n points, independent, uniform in the set of this radius, (n, nx).

        Ball: g / sqrt(|g|^2 + 2 e) with g standard normal and e standard exponential (2 e is chi-square with two degrees of freedom, so
        these are the first nx coordinates of a uniform point on the unit sphere in nx + 2 dimensions: uniform in the ball).
        """
        nx = len(self.weights)
        if self.kind == "box":
            points = rng.random((nx, n))
            points *= 2.0
            points -= 1.0
            scale: float | Array = radius
        else:
            points = rng.standard_normal((nx, n))
            length2 = 2.0 * rng.standard_exponential(n)
            for row in points:
                length2 += row * row
            scale = radius / np.sqrt(length2)
        for row, weight in zip(points, self.weights, strict=True):
            row *= scale
            row /= weight
        return points.T

    def boundary(self, rng: np.random.Generator, n: int) -> Array:
        """n directions, independent, uniform as above, |g|_W = 1, (n, nx)."""
        nx = len(self.weights)
        if self.kind == "box":
            points = rng.uniform(-1.0, 1.0, (nx, n))
            points[rng.integers(0, nx, n), np.arange(n)] = np.where(rng.random(n) < 0.5, -1.0, 1.0)
        else:
            points = rng.standard_normal((nx, n))
            points /= np.sqrt(np.sum(points * points, axis=0))
        return np.asarray((points / np.asarray(self.weights)[:, None]).T)

    def descent(self, slope: Array, otherwise: Array) -> Array:
        """Direction in which a function with this gradient (n, nx) falls most, |g|_W = 1; `otherwise` where it is flat."""
        scaled = slope / np.asarray(self.weights)
        if self.kind == "box":
            scaled = np.sign(scaled)
        length = np.max(np.abs(scaled), axis=1) if self.kind == "box" else np.sqrt(np.sum(scaled * scaled, axis=1))
        flat = length == 0.0
        down = -scaled / np.where(flat, 1.0, length)[:, None] / np.asarray(self.weights)
        return np.asarray(np.where(flat[:, None], otherwise, down))


@dataclass(frozen=True)
class Ahead:
    """What a law may look at: predicted states f(x, u) (n, nx), the scenario at that time, the tally so far."""

    x: Array
    scenario: Scenario
    task: Task
    tally: Any


class DisturbanceLaw(Protocol):
    """How d_k is drawn."""

    name: str

    def begin(self, gap: GapSet, rng: np.random.Generator, n: int) -> Array:
        """What is drawn once a rollout, (n, nx)."""

    def draw(self, gap: GapSet, rng: np.random.Generator, drawn: Array, ahead: Ahead) -> Array:
        """d_k, (n, nx)."""


class Uniform:
    """Independent, uniform in D (the paper's)."""

    name = "uniform"

    def begin(self, gap: GapSet, rng: np.random.Generator, n: int) -> Array:
        """Nothing."""
        return np.zeros((n, 0))

    def draw(self, gap: GapSet, rng: np.random.Generator, drawn: Array, ahead: Ahead) -> Array:
        """Uniform in D."""
        return gap.inside(rng, len(ahead.x), gap.radius)


class Persistent:
    """One direction a rollout."""

    name = "persistent"

    def begin(self, gap: GapSet, rng: np.random.Generator, n: int) -> Array:
        """The push."""
        return gap.push * gap.boundary(rng, n)

    def draw(self, gap: GapSet, rng: np.random.Generator, drawn: Array, ahead: Ahead) -> Array:
        """The push, and uniform noise in what D leaves."""
        return drawn + gap.inside(rng, len(ahead.x), gap.rest) if gap.rest > 0.0 else drawn


class Adversarial:
    """The worst direction one step ahead, at every step."""

    name = "adversarial"

    def begin(self, gap: GapSet, rng: np.random.Generator, n: int) -> Array:
        """A direction for where no direction is worse than another."""
        return gap.boundary(rng, n)

    def draw(self, gap: GapSet, rng: np.random.Generator, drawn: Array, ahead: Ahead) -> Array:
        """The worst push, and uniform noise in what D leaves."""
        clearance = ahead.task.clearance(ahead.x, ahead.scenario)
        if clearance is None:
            pushed = gap.push * self._worst_axis(gap, drawn, ahead)
        else:
            pushed = gap.push * gap.descent(self._slope(gap, ahead, clearance, ahead.task.clearance), drawn)
        return pushed + gap.inside(rng, len(ahead.x), gap.rest) if gap.rest > 0.0 else pushed

    @staticmethod
    def _slope(gap: GapSet, ahead: Ahead, here: Array, clearance: Callable[[Array, Scenario], Array | None]) -> Array:
        """Gradient of the clearance by forward differences, (n, nx); 0 where it isn't finite (nothing anywhere near)."""
        slope = np.zeros_like(ahead.x)
        for column, weight in enumerate(gap.weights):
            beside = ahead.x.copy("K")
            beside[:, column] += SLOPE_STEP / weight
            there = np.asarray(clearance(beside, ahead.scenario), dtype=np.float64)
            with np.errstate(invalid="ignore"):
                difference = there - here
            slope[:, column] = np.where(np.isfinite(difference), difference * (weight / SLOPE_STEP), 0.0)
        return slope

    @staticmethod
    def _worst_axis(gap: GapSet, otherwise: Array, ahead: Ahead) -> Array:
        """Axis direction after which safety is least, then progress; `otherwise` where all are alike."""
        n = len(ahead.x)
        worst, least, most = otherwise, np.full((2, n), np.inf), np.full((2, n), -np.inf)
        for column, weight in enumerate(gap.weights):
            for sign in (1.0, -1.0):
                axis = np.zeros_like(ahead.x)
                axis[:, column] = sign / weight
                tally = ahead.task.observe(copy.deepcopy(ahead.tally), ahead.x + gap.push * axis, ahead.scenario)
                score = np.stack([ahead.task.safety(tally), ahead.task.progress(tally)])
                lower = (score[0] < least[0]) | ((score[0] == least[0]) & (score[1] < least[1]))
                worst, least = np.where(lower[:, None], axis, worst), np.where(lower, score, least)
                most = np.maximum(most, score)
        return np.where(np.all(most == least, axis=0)[:, None], otherwise, worst)


LAWS: dict[str, DisturbanceLaw] = {law.name: law for law in (Uniform(), Persistent(), Adversarial())}
"""By name, in the order in which their random streams are numbered."""
