"""Shapes that what acts on an input can have, and that no effect has a name for.

A name says what happens, and a recording can only say that what happens looks like it. Whether it would look more like something else is
asked of shapes that stand near the named ones, each with numbers that are fitted like an effect's:

    memory      two lags (out and back, up and down), a lag or a delay that goes with the input's size, an actuator that rings, one that
                boosts what changes or first goes the other way, one that sticks and jumps (all the way, or short of it), a loop, a
                gain that fades with what was asked lately, or ever
    time        a gain that settles
    the input   a bend (cubic), a power (a root, a square), a soft limit, a dead zone wider on one side, steps

A shape is never handed on: it has no name, belongs to no model that is saved, and runs over whole recordings only. Its scale is `most`, the
largest size of its input, among its values. Where rows do not last alike, those whose memory is of time get the length of each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.effects.input_effect import InputEffect
from s2r_runtime.hookspecs import NominalModel, Parameter

Array = NDArray[np.float64]
Values = dict[str, float]
Numbers = list[float]
Lasts = float | Array
"""How long rows last, s: all alike, or (T,)."""

TIMES = (1.5, 4.0, 12.0, 40.0)
"""Steps of the time constants from which a fit begins."""

SMALL = 1e-6

REACHES = np.geomspace(0.8, 1.8, 40)
"""Of a play that was named: what reaches of something that sticks and jumps are tried in its place. Which way it goes changes at once with
its reach, so that there is no slope to follow to it; by a fiftieth more, it jumps mostly where it did.
"""

SHORT, NEARER = (0.2, 0.35, 0.5, 0.65, 0.8), 0.8
"""Shares s of its reach by which a valve that sticks and jumps stays short of what is asked. A play that was named for it is as wide as the
reach where what is asked goes a little way, and 2 s times that where it goes far: from around the mean of the two, less by a fifth.
"""


class Shape(InputEffect):
    """An input (T,) -> what acts, (T,): `over`. memory: it depends on what was asked before."""

    side_by_side = True

    def __init__(
        self,
        name: str,
        memory: bool,
        parameters: tuple[Parameter, ...],
        over: Callable[[Array, Any, Values], Array | Numbers],
        starts: Callable[[float, Sequence[float]], list[Values]],
        *,
        uneven: bool = True,
        with_time: bool = False,
        of_play: Callable[[float], list[Values]] = lambda width: [],
    ) -> None:
        """with_time: it depends on the time since the run began, only; of_play: values from which a fit begins where a play of this width
        (over `most`) was named.
        """
        self.with_time = with_time
        self.uneven = uneven
        self._of_play = of_play
        self.name = name
        self.memory = memory
        self.parameters = parameters
        self._over = over
        self._starts = starts

    def within_step(self, dt: float, p: Values) -> bool:
        """Memory goes on over the step."""
        return self.memory

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """(n, 1) with memory, (n, 0) without."""
        return np.zeros((n, 1 if self.memory else 0))

    def starts(
        self, u: Array, model: NominalModel, channel: str, dt: float, near: Sequence[float] = (), plays: Sequence[float] = ()
    ) -> list[Values]:
        """Values from which a fit begins. u: (T, nu); near: times (s) that named effects on the channel take, if any do; plays: theirs."""
        most = float(np.max(np.abs(u[:, model.inputs.index(channel)]), initial=0.0))
        if most == 0.0:
            return []
        times = [s for s in near if s > SMALL] or [k * dt for k in TIMES]
        more = [p for play in plays for p in self._of_play(float(play / most))]
        return [{**p, "most": most} for p in (*self._starts(dt, times), *more)]

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """u (T, nu) or (T, runs, nu), from rest."""
        j = model.inputs.index(channel)
        after = u.copy()
        if u.ndim == 2:
            after[:, j] = self._over(u[:, j], dt, p)
        else:
            for run in range(u.shape[1]):
                after[:, run, j] = self._over(u[:, run, j], dt, p)
        return after


class Following(Shape):
    """A shape of which the mean over a row is that of where it begins and where it ends, (z_k + z_{k+1}) / 2, from z = 0."""

    def at_end(
        self, tables: tuple[Array, Array, Array], before: Array | None, model: NominalModel, channel: str, dt: float | Array, p: Values
    ) -> Array:
        """z_{k+1} = 2 (m_k - m_{k-1} + m_{k-2} - ...), of the means m."""
        _, acting, _ = tables
        j = model.inputs.index(channel)
        sign = (1.0 - 2.0 * (np.arange(len(acting)) % 2)).reshape(-1, *([1] * (acting.ndim - 2)))
        after = acting.copy()
        after[..., j] = 2.0 * sign * np.cumsum(sign * acting[..., j], axis=0)
        return after


def _left(dt: Lasts, time_constants: float | Array, u: Array) -> Array:
    """(T,) what a lag leaves of a difference over each row."""
    return np.broadcast_to(np.exp(-dt / np.maximum(time_constants, SMALL)), u.shape)


def _two_lags(u: Array, dt: Lasts, one: float, other: float, first: Callable[[float, float], bool]) -> Numbers:
    """A first-order lag z with two time constants: the first one where first(u, z)."""
    z, acts = 0.0, []
    for v, keep, keep_other in zip(u.tolist(), _left(dt, one, u).tolist(), _left(dt, other, u).tolist(), strict=True):
        before = z
        z = v + (z - v) * (keep if first(v, z) else keep_other)
        acts.append(0.5 * (before + z))
    return acts


def _mean(u: Array, dt: Lasts, time_constant: float) -> Array:
    """The same lag for all, averaged over each step: z_{k+1} - a z_k = (1 - a) u_k as one banded triangular solve."""
    from scipy.linalg import lapack

    keep = _left(dt, time_constant, u)
    band = np.ones((2, len(u)))
    band[1, :-1] = -keep[1:]
    after, _ = lapack.dtbtrs(band, ((1.0 - keep) * u)[:, None], uplo="L", diag="U")
    z: Array = after[:, 0]
    return np.asarray(0.5 * (z + np.append(0.0, z[:-1])))


def _out_and_back(u: Array, dt: Lasts, p: Values) -> Numbers:
    return _two_lags(u, dt, p["out"], p["back"], lambda v, z: abs(v) > abs(z))


def _up_and_down(u: Array, dt: Lasts, p: Values) -> Numbers:
    return _two_lags(u, dt, p["up"], p["down"], lambda v, z: v > z)


def _lag_by_size(u: Array, dt: Lasts, p: Values) -> Numbers:
    time_constants = p["small"] + (p["large"] - p["small"]) * np.abs(u) / p["most"]
    z, acts = 0.0, []
    for v, keep in zip(u.tolist(), _left(dt, time_constants, u).tolist(), strict=True):
        before = z
        z = v + (z - v) * keep
        acts.append(0.5 * (before + z))
    return acts


def _delay_by_size(u: Array, dt: Lasts, p: Values) -> Array:
    late = p["small"] + (p["large"] - p["small"]) * np.abs(u) / p["most"]
    at = np.arange(len(u)) - late / dt
    if isinstance(dt, np.ndarray):
        begins = np.cumsum(dt) - dt
        at = np.interp(begins - late, begins, np.arange(len(u)), left=-2.0)
    low = np.floor(at)
    part = at - low
    first, second = (np.where(k >= 0, u[np.clip(k, 0, len(u) - 1).astype(int)], 0.0) for k in (low, low + 1.0))
    return np.asarray((1.0 - part) * first + part * second)


def _rings(u: Array, dt: Lasts, p: Values) -> Numbers:
    """z'' = w² (u - z) - 2 d w z', exact for a held u."""
    w, d = p["rate"], p["damping"]
    s = w * math.sqrt(max(1.0 - d * d, SMALL))
    decay, c, sn = (np.broadcast_to(e, u.shape) for e in (np.exp(-d * w * dt), np.cos(s * dt), np.sin(s * dt)))
    a11, a12 = decay * (c + d * w / s * sn), decay * sn / s
    a21, a22 = -decay * w * w / s * sn, decay * (c - d * w / s * sn)
    z, v, acts = 0.0, 0.0, []
    for asked, b11, b12, b21, b22 in zip(u.tolist(), a11.tolist(), a12.tolist(), a21.tolist(), a22.tolist(), strict=True):
        off = z - asked
        before = z
        z, v = asked + b11 * off + b12 * v, b21 * off + b22 * v
        acts.append(0.5 * (before + z))
    return acts


def _boosts(u: Array, dt: Lasts, p: Values) -> Array:
    """u + share (u - its slow mean): with a share of -1 a lag, below that it first goes the other way."""
    return np.asarray(u + p["share"] * (u - _mean(u, dt, p["time_constant"])))


def _sticks(u: Array, dt: float, p: Values) -> Numbers:
    reach = p["reach"] * p["most"]
    z, acts = 0.0, []
    for v in u.tolist():
        if abs(v - z) > reach:
            z = v
        acts.append(z)
    return acts


def _sticks_short(u: Array, dt: float, p: Values) -> Numbers:
    """As `_sticks`, but it comes to rest short of what is asked, by a share of the reach: with a share of 1, a play of twice the reach."""
    reach = p["reach"] * p["most"]
    short = p["short"] * reach
    z, acts = 0.0, []
    for v in u.tolist():
        if abs(v - z) > reach:
            z = v - math.copysign(short, v - z)
        acts.append(z)
    return acts


def _loop(u: Array, dt: float, p: Values) -> Numbers:
    """u less a part that follows its changes and saturates: h' = u'/w - |u'/w| h, exact for a change at a constant rate."""
    share, width = p["share"] * p["most"], p["width"] * p["most"]
    h, before, acts = 0.0, 0.0, []
    for v in u.tolist():
        d = (v - before) / width
        before = v
        side = 1.0 if d > 0.0 else -1.0
        h = side + (h - side) * math.exp(-abs(d))
        acts.append(v - share * h)
    return acts


def _fades(u: Array, dt: Lasts, p: Values) -> Array:
    warm = _mean((u / p["most"]) ** 2, dt, p["time_constant"])
    return np.asarray(u / (1.0 + max(p["loss"], -0.9) * warm))


def _tires(u: Array, dt: float, p: Values) -> Array:
    spent = dt * (np.cumsum(np.abs(u)) - 0.5 * np.abs(u)) / p["most"]
    return np.asarray(u * (1.0 - p["loss"] * np.tanh(spent / p["time_constant"])))


def _settles(u: Array, dt: Lasts, p: Values) -> Array:
    """A gain that goes from 1 to 1 - loss with time alone, by the middle of each row."""
    lasts = np.broadcast_to(dt, u.shape)
    return np.asarray(u * (1.0 - p["loss"] * -np.expm1(-(np.cumsum(lasts) - 0.5 * lasts) / p["time_constant"])))


def _bends(u: Array, dt: float, p: Values) -> Array:
    return np.asarray(u * (p["gain"] + p["cubic"] * (u / p["most"]) ** 2))


def _power(u: Array, dt: float, p: Values) -> Array:
    """gain most |u/most|^power, with the sign of u: a root or a logarithm below 1, a valve or a propeller above."""
    return np.asarray(p["gain"] * p["most"] * np.sign(u) * (np.abs(u) / p["most"]) ** p["power"])


def _soft(u: Array, dt: float, p: Values) -> Array:
    limit = p["limit"] * p["most"]
    return np.asarray(p["gain"] * limit * np.tanh(u / limit))


def _dead_by_side(u: Array, dt: float, p: Values) -> Array:
    return np.asarray(np.maximum(u - p["positive"] * p["most"], 0.0) + np.minimum(u + p["negative"] * p["most"], 0.0))


def _switches(u: Array, dt: float, p: Values) -> Numbers:
    """u while it is on: from where it is larger than `on`, to where it is smaller than the share `off` of that."""
    on, off = p["on"] * p["most"], p["on"] * p["off"] * p["most"]
    works, acts = 0.0, []
    for v, size in zip(u.tolist(), np.abs(u).tolist(), strict=True):
        works = 1.0 if size > on else 0.0 if size < off else works
        acts.append(v * works)
    return acts


def _steps(u: Array, dt: float, p: Values) -> Array:
    step = p["step"] * p["most"]
    return np.asarray(step * np.rint(u / step))


def _second(name: str, *, kink: bool = False) -> Parameter:
    return Parameter(name, "s", 1e-6, 1e3, neutral=0.0, kink=kink)


def _number(name: str, low: float, high: float, neutral: float | None = None, *, kink: bool = False) -> Parameter:
    return Parameter(name, "", low, high, neutral=neutral, kink=kink)


def _pairs(one: str, two: str) -> Callable[[float, Sequence[float]], list[Values]]:
    return lambda dt, times: [{one: a * s, two: b * s} for s in times for a, b in ((0.6, 1.8), (1.8, 0.6))]


SHAPES = (
    Following("two lags, out and back", True, (_second("out"), _second("back")), _out_and_back, _pairs("out", "back")),
    Following("two lags, up and down", True, (_second("up"), _second("down")), _up_and_down, _pairs("up", "down")),
    Following("a lag that goes with the size", True, (_second("small"), _second("large")), _lag_by_size, _pairs("small", "large")),
    Shape(
        "a delay that goes with the size",
        True,
        (_second("small", kink=True), _second("large", kink=True)),
        _delay_by_size,
        _pairs("small", "large"),
    ),
    Following(
        "an actuator that rings",
        True,
        (_number("rate", 1e-2, 1e4), _number("damping", 0.01, 0.999)),
        _rings,
        lambda dt, times: [{"rate": 1.0 / s, "damping": d} for s in times for d in (0.2, 0.7)],
    ),
    Shape(
        "a boost of what changes",
        True,
        (_number("share", -10.0, 10.0, 0.0), _second("time_constant")),
        _boosts,
        lambda dt, times: [{"share": share, "time_constant": s} for s in times for share in (-0.4, 0.4)],
    ),
    Shape(
        "sticking",
        True,
        (_number("reach", 0.0, 2.0, 0.0, kink=True),),
        _sticks,
        lambda dt, times: [{"reach": r} for r in (0.1, 0.2, 0.4, 0.7)],
        uneven=False,
        of_play=lambda width: [{"reach": float(k * width)} for k in REACHES],
    ),
    Shape(
        "sticking, and short of it",
        True,
        (_number("reach", 0.0, 2.0, 0.0, kink=True), _number("short", 0.0, 1.0, 0.0)),
        _sticks_short,
        lambda dt, times: [],
        uneven=False,
        of_play=lambda width: [{"reach": float(NEARER * k * width / math.sqrt(2.0 * s)), "short": s} for s in SHORT for k in REACHES],
    ),
    Shape(
        "a loop",
        True,
        (_number("share", -1.0, 1.0, 0.0), _number("width", 0.02, 10.0)),
        _loop,
        lambda dt, times: [{"share": 0.2, "width": w} for w in (0.1, 0.3, 1.0)],
        uneven=False,
    ),
    Shape(
        "fading with what was asked lately",
        True,
        (_number("loss", -0.9, 20.0, 0.0), _second("time_constant")),
        _fades,
        lambda dt, times: [{"loss": 0.5, "time_constant": k * dt} for k in (10.0, 40.0, 160.0, 640.0)],
    ),
    Shape(
        "tiring with all that was asked",
        True,
        (_number("loss", -5.0, 1.0, 0.0), _second("time_constant")),
        _tires,
        lambda dt, times: [{"loss": 0.3, "time_constant": k * dt} for k in (100.0, 300.0, 1000.0)],
        uneven=False,
    ),
    Shape(
        "settling with time",
        True,
        (_number("loss", -5.0, 1.0, 0.0), _second("time_constant")),
        _settles,
        lambda dt, times: [{"loss": 0.3, "time_constant": k * dt} for k in (30.0, 100.0, 300.0, 1000.0)],
        with_time=True,
    ),
    Shape(
        "a bend",
        False,
        (_number("gain", -2.0, 5.0, 1.0), _number("cubic", -5.0, 5.0, 0.0)),
        _bends,
        lambda dt, times: [{"gain": 1.0, "cubic": -0.2}],
        uneven=False,
    ),
    Shape(
        "a power",
        False,
        (_number("gain", -2.0, 5.0, 1.0), _number("power", 0.2, 5.0, 1.0)),
        _power,
        lambda dt, times: [{"gain": 1.0, "power": k} for k in (0.6, 1.7)],
        uneven=False,
    ),
    Shape(
        "a soft limit",
        False,
        (_number("gain", -2.0, 5.0, 1.0), _number("limit", 0.05, 20.0)),
        _soft,
        lambda dt, times: [{"gain": 1.0, "limit": k} for k in (0.4, 1.0)],
        uneven=False,
    ),
    Shape(
        "a dead zone by side",
        False,
        (_number("positive", 0.0, 2.0, 0.0, kink=True), _number("negative", 0.0, 2.0, 0.0, kink=True)),
        _dead_by_side,
        lambda dt, times: [{"positive": a, "negative": b} for a, b in ((0.3, 0.01), (0.01, 0.3), (0.6, 0.01), (0.01, 0.6))],
        uneven=False,
    ),
    Shape(
        "switching on and off",
        True,
        (_number("on", 0.0, 2.0, 0.0, kink=True), _number("off", 0.0, 1.0, kink=True)),
        _switches,
        lambda dt, times: [{"on": on, "off": off} for on in (0.2, 0.4, 0.7) for off in (0.3, 0.7)],
        uneven=False,
    ),
    Shape(
        "steps",
        False,
        (_number("step", 1e-3, 3.0, kink=True),),
        _steps,
        lambda dt, times: [{"step": s} for s in (0.1, 0.2, 0.35, 0.5, 0.8)],
        uneven=False,
    ),
)
