"""A heading that comes late against the positions, or these against it: two sensors, each with a delay of its own.

With l and f the way of a row to the left of the measured heading and along it, w the yaw rate, and a heading that is s late (positions: -s)

    l_k = f_k sin(theta(t + s) - theta(t)) = f_k (s w + s^2/2 w' + ...)

To first order that is a robot that slides sideways, and turns as late as its heading does. The second order tells. So the shift must
explain the way aside clearly better than all that slides (slip, tyres, a measured point ahead of the axle, in proportion to w), and no
worse than these with a lead or a lag of their own (w'), their numbers paid for. Nothing that slides looks ahead of how it turns, but tyres
and whatever hovers follow it late: positions are late only if they clearly are no slide that follows by a lag, either, at no price for its
numbers; or if they are as late along the way, against a measured speed. Inputs are not asked how late they act, which is another
matter; but a heading that turns with them by far sooner than it is late would have turned before it was asked to, if positions show
that inputs are not stamped late themselves. (Inputs that were measured by the late sensor itself are beyond that.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.streams import Stream, complete, fresh, held, unwrapped
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.speed_spline import less_noise
from s2r_runtime.trace.sensor_faults.fault import Fault

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

POSE, SPEEDS = ("x", "y", "theta"), (("speed",), ("wheel_left", "wheel_right"))
"""A pose, and what may say how fast it goes ahead, whatever the scale."""

FEWEST, LOOKED_AT = 200, 6000
"""Rows from which it is asked, and which are looked at."""

LEAST_ROWS, MOST_S = 0.75, 0.5
"""What it must be late by: an odometry that adds up steps along the heading before, or after them, is half a row off; and longest, s."""

MOST_SHARE = 0.25
"""And of the recording, longest: past its end no heading is known, and one that stands still there is as good as one that is off."""

SEEN = 6.0
"""Standard errors of what slides in proportion to w, below which there is nothing to ask."""

CLEARLY = 15.0
"""Nats by which a shift must explain more than what slides: as rivals on which all the rest is asked (`rivals.NEAR`)."""

BLOCKS, AGAINST = 10, 0.2
"""Of time; and the share of what speaks for a delay in some that may speak against it in others. A sensor is late all the time: a heading
that wandered off for a while looks late then, and not before or after.
"""

WHOLE = 2.0
"""Nats that a whole number of rows may explain less than the best shift: rows then lie on one another."""

SHIFTS = (0.4, 0.6, 0.75, 0.9, 1.0, 1.1, 1.25, 1.4, 1.6)
"""Times the first guess, that are tried."""

ALONG, SAME = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0), 0.25
"""Times how late positions are by their course, that are tried along the way; and by how much that may be another one."""

SOONER, TURNS = 0.5, (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
"""Of how late a heading is, by which at least it must seem to answer the inputs; and times that, at which it is asked to, and before."""

LAGS = (0.25, 0.5, 0.75, 1.0, 1.5)
"""Time constants with which a slide may follow, times how late positions seem to be."""

APART, ROUNDS = 2.5, 3
"""Usual intervals from which on there is a gap; rounds of weights for what is wild."""

WILD = 5.0
"""Times the pace that is exceeded on a tenth of the rows: no motion, but a position that is off, and would say more than all others."""

SPIKE, AROUND = 6.0, 2
"""Times its usual distance from the median of the rows around (so many on either side) from which on a row is off by itself. A motion goes
one way for longer than that; a row that is off stands at either end of two ways, which point where it is off to: as good as any slide.
"""

SHARES = (0.0, 0.2, 0.35, 0.45, 0.49)
"""Of the measurement's noise in the correlation of neighbours: -r / (q + 2 r)."""


def late_pose(model: ComposedModel, segments: Sequence[tuple[Stream, Stream]], missing: Sequence[str]) -> dict[str, float]:
    """s by which the heading is late, or x and y are, in the longest segment; empty where nothing is, or nobody can tell."""
    names = [name for name in model.states if name not in missing]
    if not {*POSE} <= {*names} or "theta" not in model.nominal.angles or not segments:
        return {}
    speeds = next((own for own in SPEEDS if {*own} <= {*names}), ())
    columns = [names.index(name) for name in (*POSE, *speeds)]
    whole, inputs = max(segments, key=lambda segment: len(segment[0].t))
    states = complete(fresh(Stream(whole.t, whole.values[:, columns])))
    if len(states.t) < FEWEST:
        return {}
    states = Stream(states.t[:LOOKED_AT], unwrapped(states.values[:LOOKED_AT], [2]))
    by = _Ways(states).late()
    if by > 0.0 and _turns_sooner(states, _asked(model, names, whole, inputs), by):
        return {}
    return {"theta": by} if by > 0.0 else {"x": -by, "y": -by} if by < 0.0 else {}


@dataclass(frozen=True)
class _Asked:
    """How far the inputs have turned the robot, rad, and taken it ahead, m, by stamps t (m,), by the model, from where it was measured."""

    t: Array
    turned: Array
    gone: Array


def _asked(model: ComposedModel, names: Sequence[str], states: Stream, inputs: Stream) -> _Asked | None:
    """names: of the states that were measured. None where the model does not say, or inputs neither turn nor drive it."""
    theta = model.states.index("theta")
    t = np.union1d(states.t, inputs.t)
    at = np.searchsorted(inputs.t, t, side="right") - 1
    t, at = t[at >= 0], at[at >= 0]  # before the first one nobody knows
    if len(t) < 2:
        return None
    u = held(inputs.values)[at]
    x = np.zeros((len(t), len(model.states)))
    for name, y in zip(names, states.values.T, strict=True):
        good = np.isfinite(y)
        if good.any():
            y = np.unwrap(y[good]) if name in model.nominal.angles else y[good]
            x[:, model.states.index(name)] = np.interp(t, states.t[good], y)
    try:
        apart = model.difference(model.advance(x.copy(), u, u), model.advance(x.copy(), 0.0 * u, 0.0 * u)) / model.dt
    except ConfigError:  # somebody's own model need not step from where another state is not known
        return None
    ahead = sum(apart[:, model.states.index(name)] * way for name, way in (("x", np.cos(x[:, theta])), ("y", np.sin(x[:, theta]))))
    turned, gone = (np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(t))]) for rate in (apart[:, theta], np.asarray(ahead)))
    return _Asked(t, turned, gone) if np.any(turned) and np.any(gone) else None


def _turns_sooner(states: Stream, asked: _Asked | None, late: float) -> bool:
    """Whether the heading in states (x, y, theta, ...) clearly answers what turns it by less than SOONER times what it is late by, and
    positions do not answer what drives them before they are asked to: then stamps of inputs would be late.
    """
    if asked is None:
        return False
    x, y, theta = states.values.T[:3]
    middle = 0.5 * (theta[1:] + theta[:-1])
    tried = np.array([-share for share in TURNS[:0:-1]] + [*TURNS])
    turns = _nats_late(np.diff(theta), states.t, (asked.t, asked.turned), late * tried)
    ways = _nats_late(np.cos(middle) * np.diff(x) + np.sin(middle) * np.diff(y), states.t, (asked.t, asked.gone), late * tried)
    in_time, soon = tried > -SOONER, tried < SOONER
    return bool(max(ways[in_time]) > max(ways[~in_time]) + CLEARLY and max(turns[soon]) > max(turns[~soon]) + CLEARLY)


def _nats_late(ways: Array, t: Array, asked: tuple[Array, Array], late: Array) -> Array:
    """Log likelihoods of ways (n,) between stamps t (n + 1,), in proportion to what was asked so many seconds before."""
    nats = []
    for by in late.tolist():
        white = _white(np.column_stack([ways, np.diff(np.interp(t - by, *asked)), np.diff(t)]), SHARES[-1])
        rest = white[:, 0] - white[:, 1:] @ np.linalg.lstsq(white[:, 1:], white[:, 0], rcond=1e-9)[0]
        scale = max(1.4826 * float(np.median(np.abs(rest))), 1e-12)
        nats.append(float(np.sum(noises.log_density(rest / scale))) - len(rest) * math.log(scale))
    return np.array(nats)


def earlier(segments: Sequence[tuple[Stream, Stream]], names: Sequence[str], behind: Mapping[str, float]) -> list[tuple[Stream, Stream]]:
    """The same with the stamps of some states so much earlier, s: on rows of their own, where these do not fall on others'."""
    columns = {j: behind[name] for j, name in enumerate(names) if name in behind}
    return [(_earlier(states, columns), inputs) if len(states.t) > 1 else (states, inputs) for states, inputs in segments]


def late_faults(behind: Mapping[str, float], until: float) -> tuple[Fault, ...]:
    """As faults of measurement, which they are from the first stamp to the last one. until: s."""
    return tuple(Fault(0.0, until, name, "late") for name in behind)


def _earlier(states: Stream, columns: dict[int, float]) -> Stream:
    unit = float(np.median(np.diff(states.t)))
    width = states.values.shape[1]
    groups = {by: [j for j in range(width) if columns.get(j, 0.0) == by] for by in {0.0, *columns.values()}}
    t = np.concatenate([states.t - by for by in groups])
    values = np.full((len(t), width), np.nan)
    for k, own in enumerate(groups.values()):
        rows = slice(k * len(states.t), (k + 1) * len(states.t))
        values[rows, own] = states.values[:, own]
    order = np.argsort(t, kind="stable")
    t, values = t[order], values[order]
    row = np.concatenate([[0], np.cumsum(np.diff(t) > 1e-3 * unit)])  # stamps are printed with a few digits
    at = np.flatnonzero(np.diff(np.append(-1, row)))
    merged = np.full((len(at), width), np.nan)
    for j in range(width):
        there = ~np.isnan(values[:, j])
        merged[row[there], j] = values[there, j]
    kept = ~np.isnan(merged).all(axis=1) & (t[at] > states.t[0] - 1e-3 * unit)  # times count from the first stamp, as they did
    kept &= t[at] < states.t[-1] - max(columns.values(), default=0.0) + 1e-3 * unit
    return Stream(t[at][kept], merged[kept])


class _Ways:
    """From row to row: ways, yaw rate, and what they may be made of."""

    def __init__(self, states: Stream) -> None:
        self._t, (x, y, theta, *speeds) = states.t, states.values.T
        self._speed = np.mean(speeds, axis=0) if speeds else None
        self._h = np.diff(self._t)
        self._unit = float(np.median(self._h))
        self._longest = min(MOST_S, MOST_SHARE * float(self._t[-1] - self._t[0]))
        off, turned = _spikes(np.column_stack([x, y])), _spikes(theta[:, None])
        self._dx, self._dy = np.diff(x), np.diff(y)
        self._theta = np.interp(self._t, self._t[~turned], theta[~turned])
        pace = np.hypot(self._dx, self._dy) / self._h
        plain = ~(off[1:] | off[:-1])
        self._there = plain & (self._h < APART * self._unit) & (pace <= WILD * np.quantile(pace[plain], 0.9))
        self._share = 0.0

    def late(self) -> float:
        """s by which the heading is late, positions if it is negative; 0: nobody can tell."""
        guess = self._guess()
        if not LEAST_ROWS * self._unit < abs(guess) / SHIFTS[0] or abs(guess) * SHIFTS[0] > self._longest:
            return 0.0
        self._theta = less_noise(self._t, self._theta)[0]
        ways, still = self._of(0.0), self._still(0.0)
        slides, turning = self._slides()
        self._share = max(SHARES, key=lambda share: self._nats(ways, [*still, *slides], share))
        alike = guess > 0.0 or self._along(-guess)
        price = 0.5 * math.log(len(self._h)) if alike else 0.0
        nats = self._nats(ways, [*still, *slides]) - (len(slides) - 1) * price
        leading = self._nats(ways, [*still, *slides, *turning]) - (len(slides) + len(turning) - 1) * price
        if not alike:
            lags = (self._lagging(slides, share * -guess) for share in LAGS)
            nats = max([nats, leading, *(self._nats(ways, [*still, *slow]) for slow in lags)])
        tried = [guess * share for share in SHIFTS]
        found = [self._shifted(by) for by in tried]
        best = _peak(tried, found)
        most = max(self._shifted(best), *found)
        if not (LEAST_ROWS * self._unit < abs(best) < self._longest and most > max(nats + CLEARLY, leading)):
            return 0.0
        if not self._all_the_time(best, ways, [*still, *slides]):
            return 0.0
        whole = self._unit * round(best / self._unit)
        return float(whole if whole and self._shifted(whole) > most - WHOLE else best)

    def _all_the_time(self, by: float, ways: Array, columns: list[Array]) -> bool:
        """Whether a shift explains more than what slides does in nearly all of the recording."""
        more = self._each(self._of(by), self._still(by)) - self._each(ways, columns)
        parts = np.array([part.sum() for part in np.array_split(more, BLOCKS)])
        return bool(-np.sum(np.minimum(parts, 0.0)) <= AGAINST * np.sum(np.maximum(parts, 0.0)))

    def _shifted(self, by: float) -> float:
        return self._nats(self._of(by), self._still(by))

    def _turned(self, by: float) -> Array:
        """Heading in the middle of each row's way, by seconds later."""
        theta = np.interp(self._t + by, self._t, self._theta)
        return np.asarray(0.5 * (theta[1:] + theta[:-1]))

    def _of(self, by: float) -> Array:
        theta = self._turned(by)
        return np.asarray(np.cos(theta) * self._dy - np.sin(theta) * self._dx)

    def _ahead(self) -> Array:
        theta = self._turned(0.0)
        return np.asarray(np.cos(theta) * self._dx + np.sin(theta) * self._dy)

    def _still(self, by: float) -> list[Array]:
        """What may be besides: a heading that is off, a push of the body or of the world."""
        theta = self._turned(by)
        return [self._ahead(), self._h, -np.sin(theta) * self._h, np.cos(theta) * self._h]

    def _slides(self) -> tuple[list[Array], list[Array]]:
        """Slip, tyres, a point ahead of the axle, with the yaw rate; and with how that changes."""
        w = np.diff(self._theta) / self._h
        turns = np.gradient(w) / self._unit
        f = self._ahead()
        kinds = [f, f * f / self._h, self._h]
        return [kind * w for kind in kinds], [kind * turns for kind in kinds]

    def _lagging(self, slides: list[Array], lag: float) -> list[Array]:
        """What slides, each following by a lag, s."""
        from scipy.linalg import solve_banded

        keeps = np.exp(-self._h / lag)
        upper = np.array([np.ones(len(keeps)), np.append(-keeps[1:], 0.0)])
        return [np.asarray(solve_banded((1, 0), upper, (1.0 - keeps) * slide)) for slide in slides]

    def _along(self, late: float) -> bool:
        """Whether the way ahead is about as late against a measured speed, whatever its scale."""
        if self._speed is None:
            return False
        speeds = [np.interp(self._t - late * share, self._t, self._speed) for share in ALONG]
        gone = [self._nats(self._ahead(), [0.5 * (v[1:] + v[:-1]) * self._h, self._h], SHARES[-1]) for v in speeds]
        best = int(np.argmax(gone))
        return gone[best] > gone[0] + CLEARLY and abs(ALONG[best] - 1.0) <= SAME

    def _guess(self) -> float:
        """s that the way aside is of f w, where that is seen; else 0. The yaw rate is a mean over some rows, as is the way."""
        wide = max(1, round(0.1 / self._unit))
        ways, columns = (np.array([np.convolve(c * self._there, np.ones(wide), "valid")[::wide] for c in cs]) for cs in self._first())
        beta, *_ = np.linalg.lstsq(columns.T, ways[0], rcond=None)
        rest = ways[0] - columns.T @ beta
        scale = max(1.4826 * float(np.median(np.abs(rest))), 1e-12)
        error = scale * math.sqrt(max(float(np.linalg.pinv(columns @ columns.T)[0, 0]), 0.0))
        return float(beta[0]) if abs(beta[0]) > SEEN * error else 0.0

    def _first(self) -> tuple[list[Array], list[Array]]:
        f = self._ahead()
        wide = max(1, round(0.1 / self._unit))
        w = np.convolve(np.diff(self._theta) / self._h, np.ones(wide) / wide, "same")
        return [self._of(0.0)], [f * w, *self._still(0.0)]

    def _nats(self, ways: Array, columns: list[Array], share: float | None = None) -> float:
        """Log likelihood of ways aside, less what the columns make of them. Neighbours share the error of the row between them."""
        return float(np.sum(self._each(ways, columns, share)))

    def _each(self, ways: Array, columns: list[Array], share: float | None = None) -> Array:
        """The same of each row that is there, in order of time."""
        share = self._share if share is None else share
        white = _white(np.column_stack([ways, *columns])[self._there], share)
        y, x = white[:, 0], white[:, 1:]
        x = x / np.maximum(np.linalg.norm(x, axis=0), 1e-300)
        weight, scale = np.ones(len(y)), 1.0
        for _ in range(ROUNDS):
            root = np.sqrt(weight)
            rest = y - x @ np.linalg.lstsq(root[:, None] * x, root * y, rcond=1e-9)[0]
            scale = max(math.sqrt(float(np.sum(weight * rest**2) / np.sum(weight))), 1e-300)
            weight = noises.weight(rest / scale)
        return np.asarray(noises.log_density(rest / scale) - math.log(scale) - _logdet(len(y), share) / len(y))


def _spikes(values: Array) -> Mask:
    """(n,) rows of values (n, m) that are off from those around them."""
    padded = np.pad(values, ((AROUND, AROUND), (0, 0)), mode="edge")
    apart = np.abs(values - np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * AROUND + 1, axis=0), axis=-1))
    usual = np.quantile(np.abs(np.diff(values, axis=0)), 0.75, axis=0) / 1.15  # from row to row, also if it rests half of the time
    return np.asarray(np.any((apart > SPIKE * usual) & (usual > 0.0), axis=1))


def _peak(at: list[float], nats: list[float]) -> float:
    """Where the parabola through the best and its neighbours is highest."""
    k = int(np.clip(int(np.argmax(nats)), 1, len(at) - 2))
    a, b, _ = np.polyfit(np.array(at[k - 1 : k + 2]) - at[k], nats[k - 1 : k + 2], 2)
    if a >= 0.0:
        return at[int(np.argmax(nats))]
    return float(np.clip(at[k] - b / (2.0 * a), min(at[k - 1], at[k + 1]), max(at[k - 1], at[k + 1])))


def _white(columns: Array, share: float) -> Array:
    """L^-1 of columns, with L L^T = 1 on and -share beside the diagonal."""
    from scipy.linalg import cholesky_banded, solve_banded

    n = len(columns)
    lower = cholesky_banded(np.array([np.ones(n), np.full(n, -share)]), lower=True)
    return np.asarray(solve_banded((1, 0), lower, columns))


def _logdet(n: int, share: float) -> float:
    from scipy.linalg import cholesky_banded

    return float(np.sum(np.log(cholesky_banded(np.array([np.ones(n), np.full(n, -share)]), lower=True)[0])))
