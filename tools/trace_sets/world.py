"""A robot with what its model lacks, run through time in small parts; and rollouts of it from what was measured.

Time is cut into parts of h = dt / parts seconds. Commands are one number an input a part (so they may change anywhere on that grid), and
effects on inputs run through every part with memories of their own. A state that follows an input at once is read at the very end of a part
(`instant`: the chain is asked once more with a vanishing step, on copies of its memories).

    ratio = rms over rollouts of |nominal - measured| / |oracle - measured|,   the largest over the states

where a rollout begins at a measured (noisy) state, the oracle is this same robot without noise, and the nominal one this robot
without effects.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from trace_sets.plants import Numbers, Plant, move_masses, move_pose, twist

Array = NDArray[np.float64]

VANISHING = 1e-7
"""Part of a part: what an instant lasts."""


class TruthEffect:
    """Does nothing: override what the effect is about. m: its memory, a list of its own."""

    def memory(self) -> Numbers:
        """At rest."""
        return []

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        """Changes what acts over this part, in place."""

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        """Pose plants: changes the twist [v, w, side, east, north], in place."""

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        """Force plants: changes the acceleration of each axis, in place. May be asked more than once a part."""

    def dry(self, s: Moment, x: Numbers, axis: int, speed: float) -> float:
        """Force plants: greatest deceleration by dry friction on this axis."""
        return 0.0

    def to_measured(self, x: Numbers, t: float) -> Numbers:
        """Sensors: true -> measured, t seconds after the recording's first stamp."""
        return x

    def to_true(self, x: Numbers, t: float) -> Numbers:
        """Sensors: measured -> true."""
        return x


@dataclass(frozen=True)
class World:
    """euler: whether the pose is moved along the heading at the start of the recorded step. Effects act in their order."""

    plant: Plant
    dt: float
    parts: int
    effects: tuple[TruthEffect, ...] = ()
    euler: bool = False
    plant_effects: tuple[TruthEffect, ...] = field(init=False)
    input_effects: tuple[tuple[int, TruthEffect], ...] = field(init=False)
    turning: tuple[tuple[int, TruthEffect], ...] = field(init=False)
    sensing: tuple[TruthEffect, ...] = field(init=False)

    def __post_init__(self) -> None:
        def those(*methods: str) -> list[tuple[int, TruthEffect]]:
            return [(i, e) for i, e in enumerate(self.effects) if any(getattr(type(e), m) is not getattr(TruthEffect, m) for m in methods)]

        object.__setattr__(self, "plant_effects", tuple(e for _, e in those("push", "dry")))
        object.__setattr__(self, "input_effects", tuple(those("act")))
        object.__setattr__(self, "turning", tuple(those("turn")))
        object.__setattr__(self, "sensing", tuple(e for _, e in those("to_measured")))

    @property
    def h(self) -> float:
        """A part, s."""
        return self.dt / self.parts

    def without_effects(self, *, euler: bool | None = None) -> World:
        """The nominal robot."""
        return World(self.plant, self.dt, self.parts, (), self.euler if euler is None else euler)

    def measured(self, x: Numbers, t: float) -> Numbers:
        """Through the sensors, without noise."""
        for e in self.sensing:
            x = e.to_measured(x, t)
        return x

    def true(self, y: Numbers, t: float) -> Numbers:
        """Back from the sensors."""
        for e in reversed(self.sensing):
            y = e.to_true(y, t)
        return y


class Moment:
    """Where a run stands: what effects may look at. u: commands so far, one list an input; i: the part; t, h: s; x: the true state."""

    def __init__(self, world: World, u: list[Numbers], x: Numbers, i: int = 0) -> None:
        self.world, self.u, self.x, self.i, self.h = world, u, x, i, world.h
        self.memories = [e.memory() for e in world.effects]
        self.frozen: float | None = None
        self.instant = False
        self.origin = 0.0
        self.wander: list[Numbers] | None = None
        self.acting: Numbers = []

    @property
    def t(self) -> float:
        """Seconds since the recording's first stamp. A sensor reads at the end of the part whose command it sees."""
        return self.origin + (self.i + self.instant) * self.world.h

    def copy(self) -> Moment:
        """An independent one, over the same commands, without noise."""
        other = copy.copy(self)
        other.x, other.memories, other.wander = list(self.x), copy.deepcopy(self.memories), None
        return other

    def command(self, channel: int, ago: float) -> float:
        """The command `ago` parts before this one, averaged over a part; zero before the first."""
        whole = math.floor(ago + 1e-9)
        share = 0.0 if self.instant else max(ago - whole, 0.0)
        line, i = self.u[channel], self.i - whole
        now = line[i] if i >= 0 else 0.0
        return now if share == 0.0 else (1.0 - share) * now + share * (line[i - 1] if i >= 1 else 0.0)

    def chain(self) -> Numbers:
        """What acts over this part."""
        a = [line[self.i] for line in self.u]
        for k, e in self.world.input_effects:
            e.act(self, a, self.memories[k])
        return a

    def part(self) -> None:
        """One part of h seconds."""
        world, x = self.world, self.x
        plant = world.plant
        a = self.chain()
        self.acting = a
        if plant.move is not None:
            plant.move(plant, x, a, self.h, self)
        elif plant.pose:
            if world.euler and self.i % world.parts == 0:
                self.frozen = x[2]
            for state, channel in plant.reached.items():
                x[state] = a[channel]
            q = twist(plant, a)
            for k, e in world.turning:
                e.turn(self, x, q, self.memories[k])
            if self.wander is not None:
                push = self.wander[self.i // world.parts]
                q[0] += push[0]
                q[1] += push[1]
            move_pose(x, q, self.h, self.frozen if world.euler else None)
        else:
            if self.wander is not None:
                mass = plant.parameters.get("mass", 1.0)
                a = [value + mass * push for value, push in zip(a, self.wander[self.i // world.parts], strict=True)]
            move_masses(plant, x, a, self.h, self)
        self.i += 1

    def read(self) -> Numbers:
        """The state as the sensors see it now, without noise."""
        x = list(self.x)
        plant = self.world.plant
        if plant.reached and self.i > 0:
            kept, self.memories = self.memories, copy.deepcopy(self.memories)
            self.i, self.h, self.instant = self.i - 1, self.world.h * VANISHING, True
            a = self.chain()
            self.i, self.h, self.instant, self.memories = self.i + 1, self.world.h, False, kept
            for state, channel in plant.reached.items():
                x[state] = a[channel]
        return self.world.measured(x, self.t)


def wrapped(angle: float) -> float:
    """To (-pi, pi]."""
    return -((-angle + math.pi) % (2.0 * math.pi) - math.pi)


def difference(plant: Plant, first: Array, second: Array) -> Array:
    """(..., nx), headings wrapped."""
    e = first - second
    if plant.pose:
        e[..., 2] = -((-e[..., 2] + math.pi) % (2.0 * math.pi) - math.pi)
    return e


@dataclass(frozen=True)
class Rollouts:
    """Errors against what was measured, rms over rollouts, (nx,) each: oracle and nominal; ratio: the largest over states."""

    oracle: Array
    nominal: Array

    @property
    def ratio(self) -> float:
        """nominal / oracle; a state that is known to a billionth is not counted."""
        good = self.nominal > 1e-9
        return float(np.max(self.nominal[good] / np.maximum(self.oracle[good], 1e-9), initial=1.0))


@dataclass(frozen=True)
class Start:
    """A rollout's begin: the moment (a copy, true state), what was measured there, and the part and measurement at its end."""

    moment: Moment
    y: Numbers
    until: int
    y_end: Numbers


def rollout_errors(starts: list[Start], nominal: World) -> Rollouts:
    """From every start to its end, twice."""
    plant = nominal.plant
    errors: list[list[Array]] = [[], []]
    for start in starts:
        moments = [start.moment.copy(), Moment(nominal, start.moment.u, list(start.y), start.moment.i)]
        moments[1].origin = start.moment.origin
        moments[0].x = moments[0].world.true(list(start.y), start.moment.t)
        for place, moment in enumerate(moments):
            while moment.i < start.until:
                moment.part()
            errors[place].append(difference(plant, np.array(moment.read()), np.array(start.y_end)))
    oracle, plain = (np.sqrt(np.mean(np.array(e) ** 2, axis=0)) for e in errors)
    return Rollouts(oracle, plain)
