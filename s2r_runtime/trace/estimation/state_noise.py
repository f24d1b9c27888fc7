"""Noise of one state: of the process (q) and of its measurement (r), by maximum likelihood over their logarithms.

The covariance of a state's residual alone is tridiagonal, S = q I + r G + D with D of what else is known; with x = S^-1 r,

    cost = 1/2 r' S^-1 r + 1/2 log |S|,    d cost/d log q_i = q_i/2 (tr S^-1 G_i - x' G_i x)

and scoring takes for the bend the mean of the observed and the expected one, q_i q_j/2 x' G_i S^-1 G_j x (A. Gilmour, R. Thompson,
B. Cullis, Average information REML, Biometrics 51, 1995). A few steps reach the maximum to a hundredth of a nat.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST = 1e-6
"""Least share of a residual's variance that process and measurement noise are each given: no drift is believed to be exact."""

SHARES = (1e-3, 0.05, 0.3, 0.7, 0.99)
"""Of the process in a residual's variance, from which Q and R are sought."""

NEWTON, HALVINGS, FARTHEST, NEAR_ENOUGH, AT_BOUND = 30, 6, 3.0, 0.02, 1e-6
"""Steps of scoring; halvings of one; its length, in logarithms; nats that the next one would bring, below which it is not made."""


def of_state(
    r: Array, f: Array, joined: Mask, other: Array, floor: tuple[float, float], near: tuple[float, float] | None
) -> tuple[float, float]:
    """(q, r). r: (n,) residual; f: (n,) dx'/dx; joined: (n,) begins where the one before ended; other: (n,) variance besides. floor:
    least q and r; near: where to begin.
    """
    given = State(r, f, joined, other)
    least = floor[0] + 2.0 * floor[1]
    total = max(float(np.mean(np.minimum(r * r, 9.0 * max(float(np.median(r * r)), least)))), least)
    low, high = tuple(math.log(max(e, LEAST * total)) for e in floor), math.log(16.0 * total)
    starts = [(total * share, total * (1.0 - share) / 2.0) for share in SHARES] if near is None else [near]
    at = min((given.at(_within([math.log(max(e, 1e-300)) for e in start], low, high)) for start in starts), key=lambda at: at.cost)
    for _ in range(NEWTON):
        move, brings = _downhill(at.logs, given.slopes(at), low, high)
        if brings < NEAR_ENOUGH:
            break
        for halving in range(HALVINGS):
            there = given.at(_within([e + 0.5**halving * m for e, m in zip(at.logs, move, strict=True)], low, high))
            if there.cost < at.cost:
                break
        if there.cost >= at.cost:
            break
        at = there
    return math.exp(at.logs[0]), math.exp(at.logs[1])


def _within(logs: Sequence[float], low: Sequence[float], high: float) -> tuple[float, ...]:
    return tuple(min(max(e, least), high) for e, least in zip(logs, low, strict=True))


def _downhill(logs: Sequence[float], curve: Sequence[float], low: Sequence[float], high: float) -> tuple[list[float], float]:
    """A step of scoring, cut where it meets a bound, and none longer than FARTHEST; and the nats that all of it would bring, twice.
    curve: slope and bend (`State.slopes`).
    """
    one, two, bend_one, both, bend_two = curve
    bend_one, bend_two = bend_one * (1.0 + 1e-6) + 1e-9, bend_two * (1.0 + 1e-6) + 1e-9
    size = bend_one * bend_two - both * both
    move = [(both * two - bend_two * one) / size, (both * one - bend_one * two) / size]

    def leaves(i: int) -> bool:
        return (move[i] < 0.0 and logs[i] < low[i] + AT_BOUND) or (move[i] > 0.0 and logs[i] > high - AT_BOUND)

    if leaves(0) or leaves(1):  # what would leave its bounds stays, and the other one moves alone
        move = [0.0 if leaves(0) else -one / bend_one, 0.0 if leaves(1) else -two / bend_two]
        move = [0.0 if leaves(i) else move[i] for i in (0, 1)]
    room = [min(high - logs[i] if move[i] > 0.0 else logs[i] - low[i], FARTHEST) / max(abs(move[i]), 1e-12) for i in (0, 1) if move[i]]
    share = min([1.0, *room])
    return [share * m for m in move], -one * move[0] - two * move[1]


@dataclass(frozen=True)
class _At:
    """-log likelihood at (log q, log r), and what it is made of: S = L D L^T, its diagonal, D, L, and S^-1 r."""

    logs: tuple[float, ...]
    cost: float
    own: Array
    d: Array
    e: Array
    x: Array


class State:
    """The residual under S(q, r)."""

    def __init__(self, r: Array, f: Array, joined: Mask, other: Array) -> None:
        self._r, self._other = r, other
        self._own, self._link = 1.0 + f * f, np.where(joined[1:], -f[1:], 0.0)  # G

    def at(self, logs: tuple[float, ...]) -> _At:
        from scipy.linalg import lapack

        q, s = math.exp(logs[0]), math.exp(logs[1])
        own = q + s * self._own + self._other
        d, e, info = lapack.dpttrf(own, s * self._link)
        if info != 0:
            return _At(logs, math.inf, own, d, e, self._r)
        x, _ = lapack.dpttrs(d, e, self._r)
        return _At(logs, 0.5 * float(self._r @ x) + 0.5 * float(np.log(d).sum()), own, d, e, x)

    def slopes(self, at: _At) -> tuple[float, float, float, float, float]:
        """Slope along log q and log r; bend along log q, both, log r. The diagonal of S^-1 is that of L D L^T begun at either end."""
        from scipy.linalg import lapack

        q, s = math.exp(at.logs[0]), math.exp(at.logs[1])
        backward, _, _ = lapack.dpttrf(at.own[::-1], s * self._link[::-1])
        inverse = 1.0 / (at.d + backward[::-1] - at.own)
        gx = self._own * at.x
        gx[1:] += self._link * at.x[:-1]
        gx[:-1] += self._link * at.x[1:]
        solved, _ = lapack.dpttrs(at.d, at.e, np.array([at.x, gx]).T)
        trace = float(self._own @ inverse - 2.0 * (self._link * at.e) @ inverse[1:])
        one, two = 0.5 * q * (float(inverse.sum()) - float(at.x @ at.x)), 0.5 * s * (trace - float(at.x @ gx))
        return (
            one,
            two,
            0.5 * q * q * float(at.x @ solved[:, 0]),
            0.5 * q * s * float(at.x @ solved[:, 1]),
            0.5 * s * s * float(gx @ solved[:, 1]),
        )
