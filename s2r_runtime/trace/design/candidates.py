"""Random input sequences within bounds that keep the robot near its start, drawn by seed.

Each sequence has a character of its own: how long inputs are held, whether they change together or in turn, how often they jump to an
extreme, to zero, to the opposite, or ramp. At the end of a hold a few next ones are drawn and predicted; one is taken of those that stay
inside what is allowed, also coasting on; where none does, the one that leaves it least. So an open sequence comes back by itself, whatever
the robot is. At the end the ones that lead home are preferred.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.diagnostics.rollout_error import Held

Array = NDArray[np.float64]

CHOICES = 10
"""Number of next holds that are drawn to choose from."""

LOOK_S, LOOKS = 0.1, 24
"""Step of the prediction of a next hold, s, and maximum number of steps."""

COAST_S = 1.0
"""Time for which the motion continues before another input acts, s."""

TURN_S = 0.2
"""Length of a hold that is to turn the robot round at the edge of the room, s."""

FEW_INPUTS = 4
"""Inputs of which all combinations of extremes are tried for that."""

PLANNED = 0.8
"""Share of the region that is used in the plan: other hypotheses and noise depart from it."""

HOME = 0.85
"""From this part of the time on the robot returns; REST of it is zero input, so that delays show."""

REST = 0.03

SEEN = 1.2
"""Times the values that were seen, for a state's rates."""

AT_LEAST_S = 1.0
"""What was seen is widened to what the largest inputs do in this time from rest, s: a robot that stood still has seen no range."""


@dataclass(frozen=True)
class Room:
    """Where the robot may go. start: (nx,); low, high: (nx,) ends for each state; radius: m from the start for a planar pose, or inf."""

    start: Array
    low: Array
    high: Array
    radius: float
    pose: tuple[int, int] | None

    def excess(self, x: Array) -> Array:
        """x (..., nx) -> how far it is out, as a share of the room: inside up to 1."""
        bounded = np.isfinite(self.high) & np.isfinite(self.low)
        low, high = np.where(bounded, self.low, -np.inf), np.where(bounded, self.high, np.inf)
        middle = np.where(bounded, 0.5 * (np.where(bounded, low, 0.0) + np.where(bounded, high, 0.0)), 0.0)
        half = np.where(bounded, np.maximum(0.5 * (high - low), 1e-12), np.inf)
        most = np.max(np.abs(x - middle) / half, axis=-1)
        if self.pose is None:
            return np.asarray(most)
        i, j = self.pose
        away = np.hypot(x[..., i] - self.start[i], x[..., j] - self.start[j])
        return np.asarray(np.maximum(most, away / max(self.radius, 1e-12)))


def room_of(model: ComposedModel, held: Held, bounds: Array, region: Mapping[str, tuple[float, float]] | None) -> Room:
    """From the profile's region, else as large as what was seen. bounds: (nu, 2)."""
    y = np.concatenate([run.y for run in held.data.runs])
    y = y[np.isfinite(y).all(axis=1)]
    nx = len(model.states)
    low, high, start = np.full(nx, -np.inf), np.full(nx, np.inf), np.zeros(nx)
    free = set(model.nominal.angles) | set(getattr(model.nominal, "reached", {}))
    pose = (model.states.index("x"), model.states.index("y")) if {"x", "y", "theta"} <= set(model.states) else None
    largest = _reach(model, bounds)
    for i, name in enumerate(model.states):
        given = (region or {}).get(name)
        if given is not None and name not in free:
            low[i], high[i] = given
            start[i] = 0.5 * (low[i] + high[i]) if name in {"x", "y", "q"} else min(max(0.0, low[i]), high[i])
        elif name in {"x", "y", "q"} and name not in free:
            start[i] = 0.5 * float(y[:, i].min() + y[:, i].max())
            half = max(0.5 * float(np.ptp(y[:, i])), largest[i])
            low[i], high[i] = start[i] - half, start[i] + half
        elif name not in free:
            size = max(SEEN * float(np.max(np.abs(y[:, i]))), largest[i], 1e-9)
            low[i], high[i] = -size, size
    if pose is None:
        return Room(start, low, high, math.inf, None)
    i, j = pose
    if region and {"x", "y"} <= set(region):
        radius = 0.5 * min(high[i] - low[i], high[j] - low[j])  # whatever the heading
    else:
        radius = max(*(_farthest(run.y[:, [i, j]]) for run in held.data.runs), float(np.hypot(largest[i], largest[j])))
    low[[i, j]], high[[i, j]] = -np.inf, np.inf  # the circle says it
    return Room(start, low, high, float(radius), pose)


def _farthest(path: Array) -> float:
    there = path[np.isfinite(path).all(axis=1)]
    return float(np.max(np.hypot(*(there - there[0]).T))) if len(there) else 0.0


def _reach(model: ComposedModel, bounds: Array) -> Array:
    """(nx,) how far the largest inputs take each state in AT_LEAST_S, from zero."""
    x = np.zeros((2, len(model.states)))
    for _ in range(max(1, round(AT_LEAST_S / LOOK_S))):
        x = model.nominal.step(x, bounds.T.copy(), LOOK_S, model.parameters)
    return np.asarray(np.max(np.abs(x), axis=0))


def draw(rng: np.random.Generator, model: ComposedModel, room: Room, bounds: Array, count: int, steps: int) -> Array:
    """(count, steps, nu) inputs. bounds: (nu, 2) least and largest."""
    nu = len(bounds)
    rest = np.clip(0.0, bounds[:, 0], bounds[:, 1])
    u = np.tile(rest, (count, steps, 1))
    corners = np.array(list(product(*bounds.tolist())) if nu <= FEW_INPUTS else bounds.T)
    characters = [_Character.drawn(rng, model.dt) for _ in range(count)]
    x, hidden = np.tile(room.start, (count, 1)), model.at_rest(count)
    until = np.full(count, max(1, round(0.2 / model.dt)))  # begins at rest, so that hidden states are known
    for k in range(steps - max(1, round(REST * steps))):
        for c in np.flatnonzero(until <= k):
            before = u[c, k - 1] if k else rest
            home = k > HOME * steps
            length = characters[c].length(rng, model.dt)
            options = np.stack([characters[c].next(rng, before, bounds, rest) for _ in range(CHOICES)])
            place, inside = _chosen(model, room, x[c], options, length, home=home)
            if not inside:  # turn round, for a moment
                length = max(1, round(TURN_S / model.dt))
                options = np.concatenate([options, corners])
                place, _ = _chosen(model, room, x[c], options, length, home=home)
            value = options[place]
            end = min(k + length, steps)
            ramp = inside and characters[c].ramps > rng.random()
            share = np.linspace(0.0, 1.0, end - k + 1)[1:, None] if ramp else np.ones((end - k, 1))
            u[c, k:end] = before + share * (value - before)
            until[c] = end
        x, hidden = model.step(x, u[:, k], hidden)
    u[:, steps - max(1, round(REST * steps)) :] = rest
    decimals = [max(0, 3 - math.floor(math.log10(max(high - low, 1e-9)))) for low, high in bounds]
    for j in range(nu):
        u[:, :, j] = np.clip(np.round(u[:, :, j], decimals[j]), bounds[j, 0], bounds[j, 1])
    return u


def _chosen(model: ComposedModel, room: Room, x: Array, options: Array, length: int, *, home: bool) -> tuple[int, bool]:
    """The first of the options that stays in the room (else the one that leaves it least); near the end, the one that ends nearest to the
    start. And whether it stays in the room.
    """
    duration = length * model.dt
    looks = max(1, min(LOOKS, math.ceil(duration / LOOK_S)))
    state, worst = np.tile(x, (len(options), 1)), np.zeros(len(options))
    for _ in range(looks):
        before = state
        state = model.nominal.step(state, options, duration / looks, model.parameters)
        worst = np.maximum(worst, room.excess(state))
    coasting = state + (state - before) * (COAST_S * looks / duration)
    worst = np.maximum(worst, room.excess(np.where(np.isfinite(room.high - room.low) | _placed(room), coasting, state)))
    inside = np.flatnonzero(worst <= PLANNED)
    if home:
        best = int(np.argmin(np.maximum(worst / PLANNED, 1.0) + room.excess(0.5 * (state + coasting))))
        return best, bool(worst[best] <= PLANNED)
    return (int(inside[0]), True) if len(inside) else (int(np.argmin(worst)), False)


def _placed(room: Room) -> NDArray[np.bool_]:
    """(nx,) the states that the circle is about."""
    there = np.zeros(len(room.start), dtype=bool)
    if room.pose is not None:
        there[list(room.pose)] = True
    return there


@dataclass(frozen=True)
class _Character:
    """What a sequence is like. shortest, longest: of a hold, s; the others: shares of holds."""

    shortest: float
    longest: float
    together: float
    extremes: float
    zeros: float
    turns: float
    ramps: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, dt: float) -> _Character:
        """One."""
        shortest = float(rng.choice([dt, 3.0 * dt, 0.15, 0.5]))
        longest = max(shortest, float(rng.choice([0.3, 1.0, 3.0])))
        return cls(
            max(shortest, dt),
            max(longest, 2.0 * dt),
            float(rng.choice([0.0, 0.5, 1.0])),
            float(rng.choice([0.1, 0.4, 0.8])),
            float(rng.choice([0.05, 0.15, 0.35])),
            float(rng.choice([0.1, 0.4])),
            float(rng.choice([0.0, 0.1, 0.4])),
        )

    def length(self, rng: np.random.Generator, dt: float) -> int:
        """Of a hold, steps."""
        return max(1, round(math.exp(rng.uniform(math.log(self.shortest), math.log(self.longest))) / dt))

    def next(self, rng: np.random.Generator, before: Array, bounds: Array, rest: Array) -> Array:
        """(nu,) what is held next: all inputs drawn again, or one of them while the others stay, or rest."""
        u = before.copy()
        which = range(len(u)) if rng.random() < self.together else [int(rng.integers(len(u)))]
        for j in which:
            low, high = bounds[j]
            kind = rng.random()
            if kind < self.zeros:
                u[j] = rest[j]
            elif kind < self.zeros + self.turns:
                u[j] = np.clip(2.0 * rest[j] - before[j], low, high)
            elif rng.random() < self.extremes:
                u[j] = low if rng.random() < 0.5 else high
            else:
                u[j] = rng.uniform(low, high) if rng.random() < 0.6 else rest[j] + (rng.uniform(low, high) - rest[j]) * 0.2
        if len(u) > 1 and rng.random() < 0.25:  # the others at rest: only one input acts
            keep = int(rng.integers(len(u)))
            u = np.where(np.arange(len(u)) == keep, u, rest)
        return u
