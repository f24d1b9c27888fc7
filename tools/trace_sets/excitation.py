"""What is asked of the robot: open-loop laws of commands, and controllers that see the measured, noisy state.

An open-loop law gives s(t) in [-1, 1] at the stamps of commands; it is scaled to the input's range. Force plants get accelerations
that keep the nominal speed near a wandering goal, or they would be a kilometre away after a minute. A controller is called with (t, y)
and answers u.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trace_sets.plants import Numbers, Plant

Array = NDArray[np.float64]
Rng = np.random.Generator
Law = Callable[[Rng, Array, float], Array]
Controller = Callable[[float, Numbers], Numbers]


def holds(rng: Rng, t: Array, pace: float) -> Array:
    """Random values, each held for a random time; now and then none."""
    s = np.zeros(len(t))
    begin = t[0] if len(t) else 0.0
    end = t[-1] if len(t) else 0.0
    while begin <= end:
        length = pace * float(np.exp(rng.uniform(-0.7, 0.7)))
        s[(t >= begin) & (t < begin + length)] = 0.0 if rng.random() < 0.12 else rng.uniform(-1.0, 1.0)
        begin += length
    return s


def sines(rng: Rng, t: Array, pace: float) -> Array:
    """A sum of some sines around the pace."""
    n = int(rng.integers(3, 7))
    rate = math.tau / (4.0 * pace) * np.exp(rng.uniform(-1.2, 1.0, n))
    s = np.sum(np.sin(np.outer(t, rate) + rng.uniform(0.0, math.tau, n)) * rng.uniform(0.3, 1.0, n), axis=1)
    return np.asarray(s / max(float(np.max(np.abs(s), initial=1e-9)), 1e-9))


def ramps(rng: Rng, t: Array, pace: float) -> Array:
    """Straight lines between random points."""
    n = max(2, int((t[-1] - t[0]) / pace) + 2)
    knots = t[0] + np.cumsum(pace * np.exp(rng.uniform(-0.7, 0.7, n))) - pace
    return np.interp(t, knots, rng.uniform(-1.0, 1.0, n))


def chirp(rng: Rng, t: Array, pace: float) -> Array:
    """A sine whose frequency rises over the run, with a random size and a slow offset."""
    span = max(t[-1] - t[0], 1e-9)
    first = 1.0 / (8.0 * pace)
    last = 1.0 / (1.2 * pace)
    share = (t - t[0]) / span
    phase = math.tau * span * (first * share + 0.5 * (last - first) * share**2)
    return np.asarray(rng.uniform(0.6, 0.8) * np.sin(phase + rng.uniform(0.0, math.tau)) + 0.2 * sines(rng, t, 3.0 * pace))


def human(rng: Rng, t: Array, pace: float) -> Array:
    """Holds that are reached smoothly, with small corrections and pauses."""
    step = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    goal = holds(rng, t, 1.5 * pace)
    width = max(1, int(0.4 * pace / step))
    window = np.hanning(width + 2)[1:-1]
    smooth = np.convolve(np.concatenate([np.full(width, goal[0]), goal, np.full(width, goal[-1])]), window / window.sum(), mode="same")
    moving = np.abs(smooth[width:-width]) > 0.02
    return np.clip(smooth[width:-width] + 0.06 * moving * sines(rng, t, 0.6 * pace), -1.0, 1.0)


def binary(rng: Rng, t: Array, pace: float) -> Array:
    """Three levels, switched at random."""
    return np.asarray(np.sign(np.round(1.5 * holds(rng, t, pace))))


LAWS: dict[str, Law] = {"holds": holds, "sines": sines, "ramps": ramps, "chirp": chirp, "human": human}


@dataclass(frozen=True)
class Range:
    """Of an input: it is driven within [low, high]."""

    low: float
    high: float

    @property
    def size(self) -> float:
        """The greatest absolute value."""
        return max(abs(self.low), abs(self.high))

    def scaled(self, s: Array) -> Array:
        """[-1, 1] -> the range."""
        return np.asarray(self.low + (self.high - self.low) * 0.5 * (s + 1.0)) if self.low >= 0.0 else np.asarray(self.size * s)


def open_loop(rng: Rng, plant: Plant, law: str, t: Array, ranges: tuple[Range, ...], pace: float, speed: float) -> Array:
    """(len(t), nu) commands."""
    if plant.pose:
        return np.column_stack([r.scaled(LAWS[law](rng, t, pace)) for r in ranges])
    return np.column_stack([_accelerations(rng, law, t, r.size, pace, speed) for r in ranges])


def _accelerations(rng: Rng, law: str, t: Array, most: float, pace: float, speed: float) -> Array:
    """Inputs of one axis of a force plant whose nominal speed follows a law, and whose position stays about."""
    goal = speed * LAWS[law](rng, t, pace)
    step = np.diff(t, append=t[-1] + (t[-1] - t[-2] if len(t) > 1 else 1.0))
    reach = max(2.0 * pace, 1e-9)
    u = np.zeros(len(t))
    v = p = held = 0.0
    for k in range(len(t)):
        wanted = goal[k] - 0.3 * p / reach - v
        if law in {"holds", "binary"}:
            if k == 0 or goal[k] != goal[k - 1]:
                held = float(np.clip(wanted / pace, -1.0, 1.0)) * rng.uniform(0.5, 1.0)
            u[k] = held
        else:
            u[k] = float(np.clip(wanted / (0.4 * pace), -1.0, 1.0))
        p += step[k] * v
        v += step[k] * u[k] * speed / pace
    return np.asarray(most * u)


def tracker(rng: Rng, plant: Plant, ranges: tuple[Range, ...], pace: float, speed: float, mass: float = 1.0) -> Controller:
    """A tracking controller on the measured state: a moving goal on a wandering curve, proportional (and derivative) action, clipped."""
    n = 2 if plant.pose or plant.axes == 2 else 1
    rate = math.tau / (8.0 * pace) * rng.uniform(0.6, 1.4, (n, 2))
    phase = rng.uniform(0.0, math.tau, (n, 2))
    span = 0.5 * speed / rate

    def goal(t: float) -> Numbers:
        return [float(np.sum(span[j] * np.sin(rate[j] * t + phase[j]) - span[j] * np.sin(phase[j]))) for j in range(n)]

    if not plant.pose:
        stiff = float(rng.uniform(1.0, 3.0)) / pace

        def hold(t: float, y: Numbers) -> Numbers:
            ahead, now = goal(t + 0.05 * pace), goal(t)
            u = []
            for j in range(n):
                wanted = (ahead[j] - now[j]) / (0.05 * pace) + stiff * (now[j] - y[j])
                r = ranges[j]
                u.append(min(max(mass * 3.0 * stiff * (wanted - y[n + j]), r.low), r.high))
            return u

        return hold
    eager = float(rng.uniform(0.7, 2.0)) / pace
    turning = float(rng.uniform(1.5, 4.0)) / pace
    start: Numbers = []

    def follow(t: float, y: Numbers) -> Numbers:
        if not start:
            start.extend(y[:2])
        gx, gy = (g + s for g, s in zip(goal(t + 0.3 * pace), start, strict=True))
        dx, dy = gx - y[0], gy - y[1]
        off = math.remainder(math.atan2(dy, dx) - y[2], math.tau)
        v, w = eager * math.hypot(dx, dy) * math.cos(off), turning * off
        return _as_inputs(plant, v, w, ranges)

    return follow


def _as_inputs(plant: Plant, v: float, w: float, ranges: tuple[Range, ...]) -> Numbers:
    if plant.name == "differential_drive":
        radius, track = plant.parameters["wheel_radius"], plant.parameters["track"]
        u = [(v - 0.5 * track * w) / radius, (v + 0.5 * track * w) / radius]
    elif plant.name == "bicycle":
        v = max(v, 0.2 * ranges[1].size)
        u = [math.atan(plant.parameters["wheel_base"] * w / v), v]
    else:
        u = [v, w]
    return [min(max(value, r.low), r.high) for value, r in zip(u, ranges, strict=True)]
