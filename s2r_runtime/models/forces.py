"""Forces on the axes of a model, all of them together over one step.

An axis is a position q and its rate v. The nominal step takes v0 to v1 with the constant acceleration a = (v1 - v0)/dt; forces add to it:

    v' = a + drive - rate± v - dry± sign(v),      q' = v,      + while v > 0, - while v < 0
    v stays 0 while  -hold- <= a + drive <= hold+                (hold: what dry friction holds at rest; dry, if it is not more)

With constant coefficients this has an exact solution: one exponential up to the moment of standing still, another one after it, or none.
So dry friction stops a motion and never turns it, whatever the step. Coefficients that depend on the state are taken at the middle
of parts of the step (second order; a position there is that at the part's start and half a part of the speed there, which keeps the
energy of a spring). Positions move by the integral of v. All accelerations: of a force over the mass, if there is one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import NominalModel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Value = Array | float
Pair = tuple[Value, Value]

PART_S = 0.0125
"""Longest part of a step in which a coefficient that depends on the state is one number, s: an eighth of the longest usual step. It is
not chosen by what the coefficient does there: predictions would jump where its number of parts does, and have no derivative.
"""

LEAST = -50.0
"""Of rate times time: a motion that feeds itself grows by e^50 within a step at most, so that numbers stay finite."""

NAMED_RATES = {"vx": "x", "vy": "y", "vz": "z", "qd": "q"}
"""Rates by their names, in models that do not say whose rates their states are. With a heading, vx could be along the body: it must say."""


class Axis(NamedTuple):
    """Columns of x."""

    position: int
    velocity: int


@dataclass(frozen=True)
class Push:
    """What one effect adds on one axis: numbers, or (n,). Pairs: while moving forward, backward. hold: at rest; None: as dry."""

    drive: Value = 0.0
    rate: Pair = (0.0, 0.0)
    dry: Pair = (0.0, 0.0)
    hold: Pair | None = None


Pushing = tuple[Any, str, dict[str, Any]]
"""An effect with a `push`, its channel and its values."""


def axes(model: NominalModel) -> tuple[Axis, ...]:
    """The model's axes, in the order of their velocities."""
    rates = {} if "theta" in model.states else {v: q for v, q in NAMED_RATES.items() if {v, q} <= {*model.states}}
    for name, follows in getattr(model, "follows", {}).items():
        if len(follows.of) == 1:
            one = np.ones(1)
            if np.array_equal(follows.formula({follows.of[0]: 0.7 * one}, {follows.of[0]: one}, model.parameters), one):
                rates[name] = follows.of[0]
    return tuple(Axis(model.states.index(rates[name]), j) for j, name in enumerate(model.states) if name in rates)


def mass_name(model: NominalModel) -> str:
    """Name of the parameter by which forces are divided; empty if inputs are accelerations."""
    return next((name for name in ("mass", "inertia") if name in model.parameters), "")


def mass(model: NominalModel) -> float:
    """By which a force is divided; 1 if inputs are accelerations."""
    name = mass_name(model)
    return float(model.parameters[name]) if name else 1.0


def pushed(x: Array, x_next: Array, model: NominalModel, pushing: Sequence[Pushing], dt: float) -> Array:
    """The result of the step without these effects, x_next (n, nx), with all of them."""
    varies = any(effect.varies for effect, _, _ in pushing)
    parts = math.ceil(dt / PART_S - 1e-9) if varies else 1
    h = dt / parts
    moved = [k for k in axes(model) if any(effect.push(x[:1], k, model, channel, p) is not None for effect, channel, p in pushing)]
    given = [(x_next[:, axis.velocity] - x[:, axis.velocity]) / dt for axis in moved]
    now = x.copy()
    for _ in range(parts):
        at = now
        if varies:
            halves = [_glide(now[:, k.velocity], g, _together(now, k, model, pushing), 0.5 * h) for k, g in zip(moved, given, strict=True)]
            at = _moved(now, moved, [(v, 0.5 * h * now[:, k.velocity]) for k, (v, _) in zip(moved, halves, strict=True)])
        ends = [_glide(now[:, k.velocity], g, _together(at, k, model, pushing), h) for k, g in zip(moved, given, strict=True)]
        now = _moved(now, moved, ends)
    after = x_next.copy()
    for axis, g in zip(moved, given, strict=True):
        way = now[:, axis.position] - x[:, axis.position]
        after[:, axis.position] += way - (dt * x[:, axis.velocity] + 0.5 * dt * dt * g)
        after[:, axis.velocity] = now[:, axis.velocity]
    return after


def _moved(x: Array, moved: Sequence[Axis], steps: Sequence[tuple[Array, Array]]) -> Array:
    after = x.copy()
    for axis, (v, way) in zip(moved, steps, strict=True):
        after[:, axis.position] += way
        after[:, axis.velocity] = v
    return after


def _together(x: Array, axis: Axis, model: NominalModel, pushing: Sequence[Pushing]) -> Push:
    """The sum of all pushes on one axis."""
    total = Push(hold=(0.0, 0.0))
    for effect, channel, p in pushing:
        one = effect.push(x, axis, model, channel, p)
        if one is not None:
            total = Push(
                total.drive + one.drive,
                _sum(total.rate, one.rate),
                _sum(total.dry, one.dry),
                _sum(total.hold or (0.0, 0.0), one.dry if one.hold is None else one.hold),
            )
    return total


def _sum(a: Pair, b: Pair) -> Pair:
    first = a[0] + b[0]
    return first, first if a[0] is a[1] and b[0] is b[1] else a[1] + b[1]


def _glide(v: Array, given: Array, push: Push, h: float) -> tuple[Array, Array]:
    """v (n,) h seconds later, and the way made, with constant coefficients; given: (n,) acceleration without the push."""
    drive = given + push.drive
    if _alike(push.rate) and not any(np.any(force) for force in (*push.dry, *(push.hold or ()))):
        return _free(v, drive, push.rate[0], h)
    sign = np.sign(v)
    rate, dry = _by_sign(push.rate, v > 0.0), _by_sign(push.dry, v > 0.0)
    pull = drive - sign * dry
    end, way = _free(v, pull, rate, h)
    stops = np.flatnonzero(end * sign <= 0.0)
    if len(stops):
        begun, c, b = v[stops], _at(rate, stops), pull[stops]
        until = np.minimum(_time_to_rest(begun, b, c), h)
        _, before = _free(begun, b, c, until)
        held = push.hold or push.dry
        force = drive[stops]
        onward = np.where(force > _at(held[0], stops), 1.0, np.where(force < -_at(held[1], stops), -1.0, 0.0))
        c2, f2 = (_by_sign((_at(pair[0], stops), _at(pair[1], stops)), onward > 0.0) for pair in (push.rate, push.dry))
        end[stops], after = _free(np.zeros_like(begun), np.where(onward == 0.0, 0.0, force - onward * f2), c2, h - until)
        way[stops] = before + after
    return end, way


def _free(v: Array, pull: Array, rate: Value, t: Value) -> tuple[Array, Array]:
    """v' = pull - rate v for t seconds: v then, and the way made."""
    z = np.maximum(rate * t, LEAST) if isinstance(rate * t, np.ndarray) else max(rate * t, LEAST)
    first = _phi1(z)
    return v * (1.0 - z * first) + pull * t * first, v * t * first + pull * t * t * _phi2(z, first)


def _phi1(z: Value) -> Value:
    """(1 - exp(-z))/z."""
    if isinstance(z, float):
        return 1.0 if z == 0.0 else -math.expm1(-z) / z
    safe = np.where(z == 0.0, 1.0, z)
    return np.where(z == 0.0, 1.0, -np.expm1(-safe) / safe)


def _phi2(z: Value, first: Value) -> Value:
    """(1 - phi1(z))/z; below a thousandth by its series, where the difference loses digits."""
    small = np.abs(z) < 1e-3
    series = 0.5 - z * (1.0 / 6.0 - z * (1.0 / 24.0 - z / 120.0))
    if not np.any(small):
        return (1.0 - first) / z
    return series if np.all(small) else np.where(small, series, (1.0 - first) / np.where(small, 1.0, z))


def _time_to_rest(v: Array, pull: Array, rate: Value) -> Array:
    """When v' = pull - rate v is 0: log(1 - rate v/pull)/rate; -v/pull without rate. pull is against v, or v is 0."""
    ratio = np.where(v == 0.0, 0.0, -v / np.where(pull == 0.0, 1.0, pull))
    z = rate * ratio
    safe = np.where(np.abs(z) < 1e-9, 1.0, z)
    return np.asarray(ratio * np.where(np.abs(z) < 1e-9, 1.0 - 0.5 * z, np.log1p(np.maximum(safe, -0.9999)) / safe))


def _alike(pair: Pair) -> bool:
    return pair[0] is pair[1] or (not isinstance(pair[0], np.ndarray) and not isinstance(pair[1], np.ndarray) and pair[0] == pair[1])


def _by_sign(pair: Pair, forward: Mask) -> Value:
    return pair[0] if _alike(pair) else np.where(forward, pair[0], pair[1])


def _at(value: Value, rows: NDArray[np.int64]) -> Value:
    return value[rows] if isinstance(value, np.ndarray) else value
