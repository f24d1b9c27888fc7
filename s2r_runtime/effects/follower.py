"""What effects on inputs with one nonlinear state have in common: an output y that follows the held input u by a rule of its own.

    one step        y, u -> y one step later, and the mean of what acts over the step
    while u holds   y after j steps of the same u has a closed form, so that a recording is a tight loop over the stretches
                    in which the input is held, and the rest is done for all rows at once

Where rows do not last alike (`uneven`), a row is as many steps as it lasts, also a part of one, and `mean` is asked with dt (rows, 1).
Hidden state: y, zero at rest. An input that never holds costs one turn of the loop a row (about a tenth of a microsecond).
"""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns, replaced
from s2r_runtime.hookspecs import NominalModel

Index = NDArray[np.int64]

SHORT = 2
"""Rows a column below which a row at a time is faster than a column at a time."""


LEAST = 1e-6
"""Of a row: what comes that much after its beginning, or before its end, is on it but for rounding."""


class Follower(InputEffect):
    """Override `after`, `mean` (arrays, broadcast) and `begins` (lists of floats). Steps may be parts of one, and dt those of each row. One
    that overrides `input_sequence`, too, is told of mixed rows if it takes `mixed` there.
    """

    takes_mixed = True

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "input_sequence" in vars(cls) and "takes_mixed" not in vars(cls):
            cls.takes_mixed = "mixed" in signature(cls.input_sequence).parameters

    def after(self, y: Array, u: Array, steps: Array | float, dt: float, p: Values) -> Array:
        """y -> y after so many steps of the same u."""
        raise NotImplementedError

    def mean(self, y: Array, u: Array, dt: float | Array, p: Values) -> Array:
        """What acts, averaged over one step that begins at y."""
        raise NotImplementedError

    def begins(self, held: list[float], steps: Sequence[float], dt: float, p: Values) -> list[float]:
        """y at the start of each stretch of a held input, from rest. The same as `after`, one stretch after the other."""
        raise NotImplementedError

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """(n, c): y, zero."""
        return np.zeros((n, len(columns(model, channel))))

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """One step from y = z."""
        given = u[:, columns(model, channel)]
        return replaced(u, model, channel, self.mean(z, given, dt, p)), self.after(z, given, 1, dt, p)

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float | Array, p: Values, *, mixed: bool = False) -> Array:
        """u (T, nu) or (T, runs, nu), from rest. mixed: a row between two that hold may be the mean of what comes before and after a change
        within it, and is taken as both.
        """
        given = u[..., columns(model, channel)].reshape(len(u), -1)
        usual = float(np.median(dt))
        lasts = np.broadcast_to(dt / usual, (len(u),))
        rows, many = given.shape
        flat = given.T.ravel()
        at = mixtures(flat, rows) if mixed else np.zeros(0, dtype=np.int64)
        if len(at):
            return replaced(
                u, model, channel, self._mean_of_both(flat, lasts, usual, p, at).reshape(many, rows).T.reshape(*u.shape[:-1], -1)
            )
        if SHORT * many >= rows:
            y = self._by_rows(given, lasts, usual, p)
        else:
            y = self._by_stretches(flat, np.tile(lasts, many), rows * np.arange(many), usual, p).reshape(many, rows).T
        each = dt[:, None] if isinstance(dt, np.ndarray) else dt
        return replaced(u, model, channel, self.mean(y, given, each, p).reshape(*u.shape[:-1], -1))

    def _mean_of_both(self, flat: Array, lasts: Array, dt: float, p: Values, at: Index) -> Array:
        """u of columns end to end, rows of so many steps (T,) -> means of what acts; rows `at` in two parts, each of what is held."""
        share = (flat[at] - flat[at - 1]) / (flat[at + 1] - flat[at - 1])
        parts = np.ones(len(flat), dtype=np.int64)
        parts[at] = 2
        first = np.cumsum(parts) - parts
        u, long = np.repeat(flat, parts), np.repeat(np.tile(lasts, len(flat) // len(lasts)), parts)
        u[first[at]], u[first[at] + 1] = flat[at - 1], flat[at + 1]
        long[first[at]] *= 1.0 - share
        long[first[at] + 1] *= share
        y = self._by_stretches(u, long, first[:: len(lasts)], dt, p)
        acting = self.mean(y[:, None], u[:, None], long[:, None] * dt, p)[:, 0]
        return np.asarray(np.add.reduceat(acting * long, first) / np.add.reduceat(long, first))

    def _by_stretches(self, flat: Array, lasts: Array, begins: Index, dt: float, p: Values) -> Array:
        """u of columns end to end, (rows,), each row so many steps (rows,), columns from `begins` on -> y at the start of each row."""
        new = np.append(True, flat[1:] != flat[:-1])
        new[begins] = True
        first = np.flatnonzero(new)
        number = np.diff(np.append(first, len(flat)))
        until = np.cumsum(lasts)
        ends = until[first + number - 1]
        held, counts, begun = flat[first].tolist(), np.diff(ends, prepend=0.0).tolist(), []
        for a, b in pairwise(np.searchsorted(first, np.append(begins, len(flat))).tolist()):
            begun += self.begins(held[a:b], counts[a:b], dt, p)
        since = np.append(0.0, until[:-1])
        since -= np.repeat(since[first], number)
        return self.after(np.repeat(np.array(begun), number), flat, since, dt, p)

    def _by_rows(self, u: Array, lasts: Array, dt: float, p: Values) -> Array:
        """The same, a row at a time."""
        y = np.empty_like(u)
        now = np.zeros(u.shape[1])
        for k, (row, steps) in enumerate(zip(u, lasts.tolist(), strict=True)):
            y[k] = now
            now = self.after(now, row, steps, dt, p)
        return y


def mixtures(flat: Array, rows: int) -> Index:
    """Rows, of columns of so many rows end to end, that lie between two values of which each is held for two rows or more: where an input
    changes within a row, that has the mean of before and after.
    """
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    k = changes[:-1][np.diff(changes) == 1]
    k = k[(k % rows >= 2) & (k % rows < rows - 2)]
    held = (flat[k - 2] == flat[k - 1]) & (flat[k + 1] == flat[k + 2])
    span = flat[k + 1] - flat[k - 1]
    share = (flat[k] - flat[k - 1]) / np.where(span != 0.0, span, np.inf)  # there and back is a peak
    return np.asarray(k[held & (share > LEAST) & (share < 1.0 - LEAST)])
