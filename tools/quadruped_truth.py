"""The quadruped as the true system of the paper's experiment: its sampling procedure (section V), and runs of controllers on it.

    walked    as the paper: to a random waypoint, stop, hold one random input for 1000 steps of the robot (the daemon's own campaign)
    placed    the same law's holds, from start states that are set directly: states after stops on a flat floor, moved rigidly to anywhere
    run       a controller in a scenario of the task, from a standing start; whether it was safe is judged by the true pose

Every hold is measured 100 times a second, so that one campaign tells what other model steps would have seen.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ControllerError, NotEnoughEvidence
from s2r_runtime.evidence.comparison import Campaign
from s2r_runtime.evidence.uncertain import Control
from s2r_runtime.hookspecs import Scenario
from s2r_runtime.messages import Observation, SampleTaken
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.profile import Profile
from s2r_runtime.tasks.grid_world import GridWorld

Array = NDArray[np.float64]
Pose = tuple[float, float, float]

FINE = 0.01
"""s between two measurements in a hold."""
SETTLED, JITTER = 0.8, 4
"""s that a robot is given to stop, and up to so many periods more: its gait is not met at one phase."""
WHOLE_TURN = (-4.0, 4.0)
"""Bounds of an angle that is not bounded, rad: wider than its circle."""


class Walker(Protocol):
    """What is asked of the robot: `s2r_standins.quadruped_body.Quadruped`."""

    fallen: str
    now_s: float

    def reset(self, seed: int, start: Pose) -> None:
        """Another robot, at rest at a pose."""

    def step(self, v: float, w: float, seconds: float) -> Pose:
        """Walks."""

    def pose(self) -> Pose:
        """Where it is."""

    def observe(self) -> Pose:
        """Where it is, measured."""

    def place(self, x: float, y: float, theta: float) -> None:
        """Moves it rigidly."""

    def state(self) -> Any:
        """All of its state."""

    def restore(self, state: Any) -> None:
        """Takes it up from there."""


@dataclass(frozen=True)
class Holds:
    """N held inputs. path: (N, T + 1, 3), measured every FINE s from the moment at which the input begins; u: (N, 2).

    samples, drive: of a walked campaign, as the daemon has them: (t (M,) s, states (M, 3), inputs (M, 2)), one row a period.
    """

    path: Array
    u: Array
    samples: tuple[SampleTaken, ...] = ()
    drive: tuple[Array, Array, Array] | None = field(default=None, repr=False)

    def __getitem__(self, rows: slice) -> Holds:
        """Some of them."""
        return Holds(self.path[rows], self.u[rows], self.samples[rows])

    def errors(self, model: ComposedModel, after: int = 0) -> Array:
        """(N, 3) measured less foretold, over one step of the model that begins `after` of its steps into the hold."""
        return self._errors(model, after, 1)

    def held_errors(self, model: ComposedModel) -> Array:
        """(N, 3) as `errors`, over as many whole steps as the hold has."""
        return self._errors(model, 0, self.periods(model))

    def periods(self, model: ComposedModel) -> int:
        """h: whole steps of the model in a hold."""
        return int((self.path.shape[1] - 1) * FINE / model.dt + 1e-9)

    def _errors(self, model: ComposedModel, after: int, steps: int) -> Array:
        hidden = model.at_rest(len(self.u))
        for _ in range(after):
            _, _, hidden = model.act(self.u, hidden)
        at = [round(k * model.dt / FINE) for k in (after, after + steps)]
        x = self.path[:, at[0]]
        for _ in range(steps):
            x, hidden = model.step(x, self.u, hidden)
        return model.difference(self.path[:, at[1]].copy(), x)


def held(robot: Walker, u: Sequence[float], seconds: float, first: Pose, every: float = FINE) -> list[Pose]:
    """Poses measured every so many seconds under a held input, `first` the one at which it begins."""
    path = [first]
    for _ in range(round(seconds / every)):
        robot.step(u[0], u[1], every)
        path.append(robot.observe())
    return path


def walked(robot: Walker, profile: Profile, n: int, seed: int, told: Callable[[int, int], None] | None = None) -> Holds:
    """The daemon's campaign on the robot in this process. Raises NotEnoughEvidence if it cannot be completed (a fall)."""
    campaign = campaign_of(profile, n, seed)
    dt, states = profile.model.dt, []
    paths: list[list[Pose]] = []
    samples: list[SampleTaken] = []
    inputs, stamps = [], []
    path, seen = [robot.observe()], robot.observe()
    for k in range(10**9):
        step = campaign.step(Observation(k, round(k * dt * 1e9), seen))
        if step.sample is not None:
            samples.append(step.sample)
            paths.append(path)
            if told is not None:
                told(len(paths), n)
        stamps.append(k * dt)
        states.append(seen)
        inputs.append(step.u)
        if step.done or step.failed or robot.fallen:
            break
        v, w = step.u[0], step.u[1]
        if step.phase != "hold":
            robot.step(v, w, dt)
            seen, path = robot.observe(), []
        else:
            part = held(robot, step.u, dt, path[-1] if path else seen)
            path = [*path[:-1], *part]
            seen = part[-1]
    if len(paths) < n:
        raise NotEnoughEvidence(f"the campaign ended after {len(paths)} of {n} samples: {robot.fallen or step.failed}", n - len(paths))
    drive = (np.array(stamps), np.array(states), np.array(inputs))
    return Holds(np.array(paths), np.array([s.u for s in samples]), tuple(samples), drive)


def campaign_of(profile: Profile, n: int, seed: int) -> Campaign:
    """The paper's campaign under this profile: each sample is the first period of a hold."""
    states = ("x", "y", "theta")
    region, fence = (tuple(table.get(name, WHOLE_TURN) for name in states) for table in (profile.region, profile.geofence))
    bounds = tuple(profile.inputs[name] for name in ("v", "w"))
    sampling = msgspec.structs.replace(profile.sampling, period="first")
    return Campaign(profile.model.name, states, ("theta",), region, fence, bounds, profile.model.dt, sampling, n=n, epoch=1, seed=seed)


def stops(robot: Walker, n: int, seed: int, profile: Profile) -> list[Any]:
    """n states of robots that walked under a random input for a while and then stopped: another robot each, so all independent."""
    found = []
    for k in range(n):
        rng = random.Random(f"{seed}/{k}")
        robot.reset(rng.randrange(2**31), (0.0, 0.0, rng.uniform(-math.pi, math.pi)))
        robot.step(*drawn(rng, profile), round(rng.uniform(1.0, 2.0), 3))
        robot.step(0.0, 0.0, SETTLED + profile.model.dt * rng.randrange(JITTER))
        if robot.fallen:
            raise NotEnoughEvidence(f"the robot fell on its way to start state {k}: {robot.fallen}")
        found.append(robot.state())
    return found


def placed(robot: Walker, starts: Sequence[Any], n: int, seed: int, profile: Profile, seconds: float, every: float = FINE) -> Holds:
    """n holds, each from a start state drawn from those, moved to a random pose in the region. Independent, of one law given `starts`."""
    paths, inputs = [], []
    for k in range(n):
        rng = random.Random(f"{seed}/{k}")
        robot.restore(starts[rng.randrange(len(starts))])
        robot.place(*(rng.uniform(*profile.region[name]) for name in ("x", "y")), rng.uniform(-math.pi, math.pi))
        u = drawn(rng, profile)
        paths.append(held(robot, u, seconds, robot.observe(), every))
        inputs.append(u)
        if robot.fallen:
            raise NotEnoughEvidence(f"the robot fell in hold {k}: {robot.fallen}")
    return Holds(np.array(paths), np.array(inputs))


def drawn(rng: random.Random, profile: Profile) -> tuple[float, float]:
    """An input, uniform over the bounds."""
    v, w = (rng.uniform(*profile.inputs[name]) for name in ("v", "w"))
    return v, w


class Run(NamedTuple):
    """One run on the robot. path: (steps + 1, 3) measured; u: (steps, 2); fallen: why, if it fell."""

    scenario: Scenario
    path: Array
    u: Array
    safety: float
    progress: float
    fallen: str


def run(robot: Walker, control: Control, task: GridWorld, scenario: Scenario, profile: Profile, dt: float, seed: int) -> Run:
    """A controller in one scenario, its input held for dt s. A fall is a crash, wherever it was."""
    low, high = np.array([profile.inputs[name] for name in ("v", "w")]).T
    x, y, theta = scenario["start"][0]
    robot.reset(seed, (float(x), float(y), float(theta)))
    rng, first = np.random.default_rng([seed, 3]), scenario
    tally = task.observe(task.begin(scenario), np.array([robot.pose()]), scenario)
    path, inputs = [robot.observe()], []
    for _ in range(task.horizon):
        u = np.clip(control(np.array([path[-1]]), task.view(scenario))[0], low, high)
        if not np.all(np.isfinite(u)):
            raise ControllerError(f"the controller returned {u.tolist()}, must be finite")
        robot.step(float(u[0]), float(u[1]), dt)
        scenario = task.advance(scenario, rng)
        tally = task.observe(tally, np.array([robot.pose()]), scenario)
        path.append(robot.observe())
        inputs.append(u)
        if robot.fallen or task.done(tally)[0]:
            break
    safety = -1.0 if robot.fallen else float(task.safety(tally)[0])
    return Run(first, np.array(path), np.array(inputs), safety, float(task.progress(tally)[0]), robot.fallen)
