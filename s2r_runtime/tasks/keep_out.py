"""Reach a goal, stay out of a disc and inside a region.

s = least clearance over the run, m: the distance of the robot's disc from the keep-out disc and from the region's edge, whichever is
less; s >= 0 iff it never touched either. A scenario ends when the robot's centre is within `goal_radius` of the goal.

The law. Start and goal are uniform in the region, the disc's centre is their midpoint plus a shift uniform in a square of half-side
`shift`; given that start and goal are at least `min_distance` apart, that the start's clearance is at least `start_clearance`, and that the
goal is clear of the disc and of the edge by that too. Angles among the states start uniform, all others but x and y at 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.hookspecs import NominalModel, Scenario
from s2r_runtime.tasks.parameters import columns_of, filled_in, require, whole

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

MAX_ROUNDS = 1000
"""Rounds of rejection before the law is given up; each proposes at least 8."""


@dataclass(frozen=True)
class Tally:
    """Least clearance, distance from the goal at first and at last, whether it arrived; (n,) each."""

    least: Array
    first: Array
    last: Array
    arrived: Bools


class KeepOut:
    """Interface: `hookspecs.Task`. Models with the states x, y."""

    name = "keep_out"
    position = ("x", "y")
    PARAMETERS: ClassVar[dict[str, tuple[float, str]]] = {
        "x_low": (-1.6, "the region, m"),
        "x_high": (1.6, "the region, m"),
        "y_low": (-1.0, "the region, m"),
        "y_high": (1.0, "the region, m"),
        "disc_radius": (0.25, "the keep-out disc, m"),
        "shift": (0.2, "how far the disc is at most off the middle between start and goal, m by axis"),
        "robot_radius": (0.055, "the robot's disc, m"),
        "min_distance": (0.9, "from start to goal at least, m"),
        "goal_radius": (0.1, "the robot has arrived when its centre is so near to the goal, m"),
        "start_clearance": (0.05, "clearance at the start at least, m"),
        "steps": (300, "horizon, steps of the model"),
        "min_progress": (0.5, "median of the share of the distance to the goal that was covered"),
    }

    def __init__(self, parameters: dict[str, Any], model: NominalModel, dt: float) -> None:
        p = filled_in(self.name, parameters, self.PARAMETERS)
        whole(self.name, p, 1, ("steps",))
        for name, ok, must in (
            ("x_high", p["x_high"] > p["x_low"], "above x_low"),
            ("y_high", p["y_high"] > p["y_low"], "above y_low"),
            *((name, p[name] > 0.0, "> 0 m") for name in ("disc_radius", "robot_radius", "goal_radius")),
            *((name, p[name] >= 0.0, ">= 0 m") for name in ("shift", "min_distance", "start_clearance")),
            ("min_distance", p["min_distance"] > p["goal_radius"], "above goal_radius"),
            ("min_progress", 0.0 <= p["min_progress"] <= 1.0, "between 0 and 1"),
        ):
            require(self.name, p, name, ok, must)
        self._x, self._y = columns_of(self.name, model, ("x", "y"))
        self._angles = [model.states.index(name) for name in model.angles]
        self._nx, self._dt = len(model.states), dt
        self._p = p
        self.horizon = int(p["steps"])

    # ---------------------------------------------------------------- the law

    def draw(self, rng: np.random.Generator, n: int) -> Scenario:
        """n scenarios from the law, independent. Raises ConfigError if there are none."""
        p = self._p

        def propose(k: int) -> Array:
            start = np.zeros((k, self._nx))
            start[:, self._x] = rng.uniform(p["x_low"], p["x_high"], k)
            start[:, self._y] = rng.uniform(p["y_low"], p["y_high"], k)
            for column in self._angles:
                start[:, column] = rng.uniform(-math.pi, math.pi, k)
            return start

        scenario = self._accepted(rng, n, propose)
        if scenario is None:
            raise ConfigError(f"task {self.name}: no scenario was found; a smaller disc or min_distance would leave some")
        return scenario

    def draw_at(self, rng: np.random.Generator, x: Array) -> Scenario:
        """One scenario from the law given that the robot starts at x (nx,). Raises NotEnoughEvidence where the law has none."""
        at = np.asarray(x, dtype=np.float64)[None, :]
        scenario = self._accepted(rng, 1, lambda k: np.repeat(at, k, axis=0)) if np.all(np.isfinite(at)) else None
        if scenario is None:
            here = f"the robot is at x {at[0, self._x]:.3f}, y {at[0, self._y]:.3f} m"
            must = f"in the region with its disc at least {self._p['start_clearance']:g} m from the edge"
            raise NotEnoughEvidence(f"task {self.name}: {here}; scenarios start {must}")
        return scenario

    def _accepted(self, rng: np.random.Generator, n: int, propose: Callable[[int], Array]) -> Scenario | None:
        """n scenarios by rejection; propose(k) gives k starts, (k, nx)."""
        parts: list[Scenario] = []
        missing = n
        for _ in range(MAX_ROUNDS):
            scenario, accepted = self._proposed(rng, propose(2 * missing + 8))
            rows = np.flatnonzero(accepted)[:missing]
            parts.append({name: value[rows] for name, value in scenario.items()})
            missing -= len(rows)
            if missing == 0:
                return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return None

    def _proposed(self, rng: np.random.Generator, start: Array) -> tuple[Scenario, Bools]:
        p, k = self._p, len(start)
        goal = np.stack([rng.uniform(p["x_low"], p["x_high"], k), rng.uniform(p["y_low"], p["y_high"], k)], axis=1)
        here = start[:, [self._x, self._y]]
        disc = (here + goal) / 2.0 + rng.uniform(-p["shift"], p["shift"], (k, 2))
        scenario: Scenario = {"start": start, "goal": goal, "disc": disc, "step": np.zeros(k, dtype=np.int64)}
        apart = np.hypot(goal[:, 0] - here[:, 0], goal[:, 1] - here[:, 1]) >= p["min_distance"]
        start_clear = self._clear(here[:, 0], here[:, 1], disc) >= p["start_clearance"]
        return scenario, apart & start_clear & (self._clear(goal[:, 0], goal[:, 1], disc) >= p["start_clearance"])

    def advance(self, scenario: Scenario, rng: np.random.Generator) -> Scenario:
        """Nothing moves."""
        return {**scenario, "step": scenario["step"] + 1}

    def view(self, scenario: Scenario) -> Scenario:
        """goal, disc (n, 2) m; disc_radius (n,) m; low, high (n, 2): the region's corners, m; time_left (n,) s."""
        p, n = self._p, len(scenario["step"])
        return {
            "goal": scenario["goal"],
            "disc": scenario["disc"],
            "disc_radius": np.broadcast_to(p["disc_radius"], (n,)),
            "low": np.broadcast_to([p["x_low"], p["y_low"]], (n, 2)),
            "high": np.broadcast_to([p["x_high"], p["y_high"]], (n, 2)),
            "time_left": (self.horizon - scenario["step"]) * self._dt,
        }

    # ---------------------------------------------------------------- safety

    def _clear(self, x: Array, y: Array, disc: Array) -> Array:
        p = self._p
        edge_x = np.minimum(x - p["x_low"], p["x_high"] - x)
        edge_y = np.minimum(y - p["y_low"], p["y_high"] - y)
        dx, dy = x - disc[:, 0], y - disc[:, 1]
        return np.minimum(np.minimum(edge_x, edge_y), np.sqrt(dx * dx + dy * dy) - p["disc_radius"]) - p["robot_radius"]

    def clearance(self, x: Array, scenario: Scenario) -> Array:
        """Distance of the robot's disc from the keep-out disc and the region's edge, m, (n,); negative if it touches."""
        return self._clear(x[:, self._x], x[:, self._y], scenario["disc"])

    def enclosed(self, x: Array, reach: float, scenario: Scenario, threshold: float) -> tuple[Bools, Bools] | None:
        """Every place within `reach`, m, keeps the clearance `threshold`; and it is within the goal. Clearance and distance are
        1-Lipschitz in the place.
        """
        arrived = self._from_goal(x, scenario) + reach <= self._p["goal_radius"]
        return self.clearance(x, scenario) - reach >= threshold, arrived

    def _from_goal(self, x: Array, scenario: Scenario) -> Array:
        goal: Array = scenario["goal"]
        dx, dy = x[:, self._x] - goal[:, 0], x[:, self._y] - goal[:, 1]
        return np.sqrt(dx * dx + dy * dy)

    def begin(self, scenario: Scenario) -> Tally:
        """Nothing has happened."""
        n = len(scenario["start"])
        distance = self._from_goal(scenario["start"], scenario)
        return Tally(np.full(n, np.inf), distance, distance, np.zeros(n, dtype=np.bool_))

    def observe(self, tally: Tally, x: Array, scenario: Scenario) -> Tally:
        """Clearance and distance at x (n, nx); nothing counts after the arrival."""
        distance = self._from_goal(x, scenario)
        least = np.where(tally.arrived, tally.least, np.minimum(tally.least, self.clearance(x, scenario)))
        last = np.where(tally.arrived, tally.last, distance)
        return Tally(least, tally.first, last, tally.arrived | (distance <= self._p["goal_radius"]))

    def safety(self, tally: Tally) -> Array:
        """Least clearance, m."""
        return tally.least

    def progress(self, tally: Tally) -> Array:
        """Share of the distance to the goal's circle that was covered, 0 to 1."""
        goal = self._p["goal_radius"]
        return np.asarray(np.clip((tally.first - tally.last) / (tally.first - goal), 0.0, 1.0))

    def done(self, tally: Tally) -> Bools:
        """Arrived. A crash doesn't end it: the clearance may still become less."""
        return tally.arrived

    def progress_ok(self, progress: Array) -> bool:
        """Whether the median share covered is at least `min_progress`."""
        return bool(np.median(progress) >= self._p["min_progress"])
