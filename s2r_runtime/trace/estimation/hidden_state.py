"""A state that nobody measured, of somebody's own model, told by a measured one that it moves: the level of a tank above another one.

    (p, h)+ = f(p, h, u)        p: measured, h: not, and df_p/dh is not zero

h is where the model is stepped from, and no measurement (as the speed of an axis is, `speed_noise`): models are judged by what p says of
them. It is told by p under the nominal model, linearised about what is known so far, by as much smoothing as p itself asks for
(`smoother`, with noise that moves h, and p through it: with g = df_p/dh,  G = (g^2/3 g/2; g/2 1)), until it stays where it is: the iterated
Kalman smoother of A. Jazwinski, Stochastic processes and filtering theory, 1970. It begins with what the model makes of it from the first
row that explains the rows after it best, every measured state being where it was measured.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.hookspecs import NominalModel
from s2r_runtime.models.bound import turned
from s2r_runtime.trace.estimation.smoother import Smoother
from s2r_runtime.trace.estimation.speed_spline import Smoothed

Array = NDArray[np.float64]
Pair = tuple[str, str]

PROBED, SCALES, MOVES = 16, (0.1, 1.0, 10.0), 1e-9
"""Random states of each size on which a model is asked what moves what, and what counts as nothing, over what moves it."""

STARTS, FIRST_ROWS = 60, 300
"""Values that a hidden state is tried at in the first row, of either sign and all sizes; rows that tell which it was."""

ROUNDS, STAYS, HALVINGS = 12, 1e-4, 8
"""Of linearising and smoothing; change, over its own size, at which a hidden state stays where it is; of a way that leaves the model."""

LEAST_MOVED = 1e-2
"""Of its usual size, g in a row: where h hardly moves p, p says next to nothing of it there, and G has no inverse."""

WILD = 4.0
"""Standard deviations from which a row counts less, as in `speed_spline`."""


def told_through(nominal: NominalModel, missing: Sequence[str]) -> tuple[Pair, ...]:
    """(measured, hidden) for each missing state, each told by another measured one; empty where some cannot be told so. Angles wrap, and
    are not told.
    """
    hidden = [s for s in nominal.states if s in missing]
    measured = [s for s in nominal.states if s not in missing]
    if not hidden or len(measured) < len(hidden) or {*hidden} & {*nominal.angles}:
        return ()
    moves = _moves(nominal)
    column = {name: j for j, name in enumerate(nominal.states)}

    def strength(of: Sequence[str]) -> float:
        return min(float(moves[column[p], column[h]]) for p, h in zip(of, hidden, strict=True))

    from scipy.optimize import linear_sum_assignment

    table = np.array([[math.log(max(float(moves[column[p], column[h]]), 1e-300)) for p in measured] for h in hidden])
    _, chosen = linear_sum_assignment(table, maximize=True)
    best = [measured[k] for k in chosen]
    return tuple(zip(best, hidden, strict=True)) if strength(best) > MOVES else ()


def _moves(nominal: NominalModel) -> Array:
    """(nx, nx) by how much state i is moved in a short step by a bit of state j, over that bit, where that is most."""
    rng, nx = np.random.default_rng(0), len(nominal.states)
    most = np.zeros((nx, nx))
    for scale in SCALES:
        for sign in (1.0, -1.0):
            x, u = (sign * scale * rng.uniform(0.2, 1.0, (PROBED, k)) for k in (nx, len(nominal.inputs)))
            bit = 1e-4 * scale * np.eye(nx)
            for row in range(PROBED):
                try:
                    at = nominal.step(np.concatenate([x[row] + bit, x[row] - bit]), np.tile(u[row], (2 * nx, 1)), 1e-3, nominal.parameters)
                except ConfigError:  # not everywhere does somebody's own model give numbers
                    continue
                change = np.abs(at[:nx] - at[nx:]).T / (2e-4 * scale)
                most = np.maximum(most, np.nan_to_num(change))
    return most


@dataclass(frozen=True)
class _Rows:
    """Of one segment. t: (n,); x: (n, nx), the measured states as measured; u: (n - 1, nu); unit: usual s from row to row."""

    nominal: NominalModel
    t: Array
    x: Array
    u: Array
    unit: float

    @property
    def share(self) -> Array:
        """(n - 1, 1) of a usual row that each lasts."""
        return np.asarray(np.diff(self.t)[:, None] / self.unit)

    def on(self, x: Array, k: slice) -> Array:
        """Where the model leads from rows x (m, nx) under the inputs of k."""
        at = slice(*k.indices(len(self.u)))
        return np.asarray(x + self.share[at] * self.moved(x, self.u[at]))

    def moved(self, x: Array, u: Array) -> Array:
        """Where rows x (m, nx) go in a usual step, less themselves; angles by less than half a turn."""
        return turned(self.nominal, self.nominal.step(x, u, self.unit, self.nominal.parameters) - x)


def smoothed_hidden(
    nominal: NominalModel, t: Array, x: Array, u: Array, unit: float, pairs: Sequence[Pair], source: str
) -> tuple[Array, list[Smoothed]]:
    """(n, nx) with the hidden states, and each of them. t: (n,); x: (n, nx) as measured; u: (n - 1, nu) held from row to row; unit: usual s
    between rows. Raises RecordingError where no value of a hidden state lets the model give numbers, or where it moves nothing.
    """
    columns = [(nominal.states.index(p), nominal.states.index(h)) for p, h in pairs]
    rows = _begun(_Rows(nominal, t, x, u, unit), columns, source)
    found = [_smoothed(rows, p, h, source) for p, h in columns]
    for _ in range(ROUNDS):
        moved = 0.0
        for k, (p, h) in enumerate(columns):
            there = _as_far_as_it_goes(rows, h, found[k].speed)
            moved = max(moved, float(np.max(np.abs(there.x[:, h] - rows.x[:, h])) / max(float(np.std(there.x[:, h])), 1e-12)))
            rows, found[k] = there, _smoothed(there, p, h, source)
        if moved < STAYS:
            break
    return rows.x, found


def _begun(rows: _Rows, columns: Sequence[tuple[int, int]], source: str) -> _Rows:
    """With hidden states where the model has them, from the start that foretells best."""
    told, hidden = (list(names) for names in zip(*columns, strict=True))
    size = max(float(np.max(np.abs(rows.x))), float(np.max(np.abs(rows.u), initial=0.0)), 1e-6)
    tried = np.concatenate([size * np.logspace(-3, 1, STARTS // 2), -size * np.logspace(-3, 1, STARTS // 2), [0.0]])
    starts, off = np.tile(tried[:, None], len(hidden)), np.zeros(0)
    for place in range(len(hidden)):  # one after the other, the others where they were best
        starts[:, place] = tried
        off = _off(rows, starts, hidden, told)
        starts = np.tile(starts[int(np.argmin(off))], (len(tried), 1))
    if not math.isfinite(float(np.min(off))):
        names = ", ".join(rows.nominal.states[h] for h in hidden)
        raise RecordingError(f"{source}: {names} cannot be told: the model gives no numbers for this recording, whatever {names} was")
    x, ends = rows.x.copy(), _driven(rows, starts[:1], hidden, len(rows.x) - 1, stays=True)
    x[0, hidden], x[1:, hidden] = starts[0], ends[:, 0, hidden]
    return replace(rows, x=x)


def _driven(rows: _Rows, starts: Array, hidden: Sequence[int], until: int, *, stays: bool = False) -> Array:
    """(until, m, nx) where the model leads from each row, hidden states running on from each of the starts (m, hidden). stays: they stay
    where they are in rows in which the model gives no numbers; else it raises ConfigError, as the model does.
    """
    ends = np.zeros((until, len(starts), rows.x.shape[1]))
    at = last = starts
    for k in range(until):
        x = np.tile(rows.x[k], (len(starts), 1))
        x[:, hidden] = at
        u = np.tile(rows.u[k], (len(starts), 1))
        try:
            move = rows.moved(x, u)
        except ConfigError:
            if not stays or not k:
                raise
            x[:, hidden] = ends[k - 1][:, hidden] = last  # where it gave numbers the row before
            move = np.zeros_like(x)
        ends[k] = x + rows.share[k] * move
        last, at = x[:, hidden], ends[k][:, hidden]
    return ends


def _off(rows: _Rows, starts: Array, hidden: Sequence[int], told: Sequence[int]) -> Array:
    """(m,) squared errors, from each start, of what tells hidden states in the first rows; infinite where the model gives no numbers."""
    until = min(FIRST_ROWS, len(rows.x) - 1)
    try:
        ends = _driven(rows, starts, hidden, until)
    except ConfigError:
        if len(starts) == 1:
            return np.array([math.inf])
        return np.concatenate([_off(rows, half, hidden, told) for half in np.array_split(starts, 2)])
    size = np.maximum(np.std(rows.x[: until + 1, told], axis=0), 1e-12)
    with np.errstate(all="ignore"):
        off = np.sum(np.minimum(np.abs((rows.x[1 : until + 1, None, told] - ends[:, :, told]) / size), 1e6) ** 2, axis=(0, 2))
    return np.where(np.isfinite(off), off, math.inf)


def _as_far_as_it_goes(rows: _Rows, h: int, told: Array) -> _Rows:
    """With a hidden state moved to where it was told to be, or as many halves of that way as the model gives numbers for."""
    for halves in range(HALVINGS):
        x = rows.x.copy()
        x[:, h] += 0.5**halves * (told - x[:, h])
        try:
            rows.on(x[:-1], slice(0, len(x) - 1))
        except ConfigError:
            continue
        return replace(rows, x=x)
    return rows


def _smoothed(rows: _Rows, p: int, h: int, source: str) -> Smoothed:
    """The hidden state of one pair, the others being where they are."""
    x, y, pair = rows.x, rows.x[:, p], [p, h]
    end, f = _linearised(rows, x, pair)
    g = f[:, 0, 1]
    felt = np.abs(g[g != 0.0])
    usual = float(np.median(felt)) if len(felt) else 0.0
    if not usual > 0.0 or not np.all(np.isfinite(f)):
        names = rows.nominal.states
        raise RecordingError(f"{source}: {names[h]} cannot be told: nowhere in this recording does it move {names[p]}")
    g = np.where(np.abs(g) < LEAST_MOVED * usual, np.where(g < 0.0, -1.0, 1.0) * LEAST_MOVED * usual, g)
    f[:, 0, 1] = g
    scale = np.array([1.0, max(usual, 1e-300)])  # h as p feels it in a row
    f = f * scale[:, None] / scale
    c = end[:, pair] * scale - np.einsum("kij,kj->ki", f, x[:-1, pair] * scale)
    moved, share = g / scale[1], rows.share[:, 0]
    inverse = tuple(part / share for part in (12.0 / moved**2, -6.0 / moved, np.full_like(moved, 4.0)))
    weight = np.ones(len(y))
    for _ in range(3):
        law = Smoother(f, c, inverse, y, weight)
        _, ratio = law.best()
        told, noise, spread = law.solve(ratio)
        off = np.abs(y - told[:, 0]) / max(math.sqrt(noise), 1e-300)
        if not np.any(off > WILD):
            break
        weight = np.where(off > WILD, (WILD / np.maximum(off, WILD)) ** 2 / 4.0, 1.0)
    return Smoothed(told[:, 1] / scale[1], spread / scale[1], math.exp(0.25 * ratio) / (2.0 * math.pi * rows.unit))


def _linearised(rows: _Rows, x: Array, pair: list[int]) -> tuple[Array, Array]:
    """(n - 1, nx) where the model leads, and (n - 1, 2, 2) how that goes with the two numbers."""
    every = slice(0, len(x) - 1)
    end = rows.on(x[:-1], every)
    f = np.zeros((len(x) - 1, 2, 2))
    for j, column in enumerate(pair):
        bit = 1e-4 * max(float(np.std(x[:, column])), 1e-4 * float(np.max(np.abs(x[:, column]))), 1e-6)
        there = x[:-1].copy()
        for sign in (1.0, -1.0):
            there[:, column] = x[:-1, column] + sign * bit
            with contextlib.suppress(ConfigError):  # at the edge of where the model gives numbers, the other side has some
                f[:, :, j] = sign * (rows.on(there, every)[:, pair] - end[:, pair]) / bit
                break
    return end, f
