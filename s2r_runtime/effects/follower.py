"""What effects on inputs with one nonlinear state have in common: an output y that follows the held input u by a rule of its own.

    one step        y, u -> y one step later, and the mean of what acts over the step
    while u holds   y after j steps of the same u has a closed form, so that a recording is a tight loop over the stretches
                    in which the input is held, and the rest is done for all rows at once

Where rows do not last alike (`uneven`), a row is as many steps as it lasts, also a part of one, and `mean` is asked with dt (rows, 1).
Hidden state: y, zero at rest. An input that never holds costs one turn of the loop a row (about a tenth of a microsecond).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns, replaced
from s2r_runtime.hookspecs import NominalModel

SHORT = 2
"""Rows a column below which a row at a time is faster than a column at a time."""


class Follower(InputEffect):
    """Override `after`, `mean` (arrays, broadcast) and `begins` (lists of floats)."""

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

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """u (T, nu) or (T, runs, nu), from rest."""
        given = u[..., columns(model, channel)].reshape(len(u), -1)
        usual = float(np.median(dt))
        lasts = np.broadcast_to(dt / usual, (len(u),))
        y = self._by_rows(given, lasts, usual, p) if SHORT * given.shape[1] >= len(u) else self._by_stretches(given, lasts, usual, p)
        each = dt[:, None] if isinstance(dt, np.ndarray) else dt
        return replaced(u, model, channel, self.mean(y, given, each, p).reshape(*u.shape[:-1], -1))

    def _by_stretches(self, u: Array, lasts: Array, dt: float, p: Values) -> Array:
        """u (T, m), rows of so many steps (T,) -> y at the start of each, (T, m)."""
        rows, many = u.shape
        flat = u.T.ravel()
        new = np.append(True, flat[1:] != flat[:-1])
        new[::rows] = True
        first = np.flatnonzero(new)
        number = np.diff(np.append(first, len(flat)))
        until = np.cumsum(np.tile(lasts, many))
        ends = until[first + number - 1]
        held, counts, begun = flat[first].tolist(), np.diff(ends, prepend=0.0).tolist(), []
        for a, b in pairwise(np.searchsorted(first, rows * np.arange(many + 1)).tolist()):
            begun += self.begins(held[a:b], counts[a:b], dt, p)
        since = np.append(0.0, until[:-1])
        since -= np.repeat(since[first], number)
        y = self.after(np.repeat(np.array(begun), number), flat, since, dt, p)
        return y.reshape(many, rows).T

    def _by_rows(self, u: Array, lasts: Array, dt: float, p: Values) -> Array:
        """The same, a row at a time."""
        y = np.empty_like(u)
        now = np.zeros(u.shape[1])
        for k, (row, steps) in enumerate(zip(u, lasts.tolist(), strict=True)):
            y[k] = now
            now = self.after(now, row, steps, dt, p)
        return y
