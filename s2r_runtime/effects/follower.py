"""What effects on inputs with one nonlinear state have in common: an output y that follows the held input u by a rule of its own.

    one step        y, u -> y one step later, and the mean of what acts over the step
    while u holds   y after j steps of the same u has a closed form, so that a recording is a tight loop over the stretches
                    in which the input is held, and the rest is done for all rows at once

Hidden state: y, zero at rest. An input that never holds costs one turn of the loop a row (about a tenth of a microsecond).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns, replaced
from s2r_runtime.hookspecs import NominalModel

SHORT = 2
"""Rows a column below which a row at a time is faster than a column at a time."""


class Follower(InputEffect):
    """Override `after`, `mean` (arrays, broadcast) and `begins` (lists of floats)."""

    def after(self, y: Array, u: Array, steps: Array | int, dt: float, p: Values) -> Array:
        """y -> y after so many steps of the same u."""
        raise NotImplementedError

    def mean(self, y: Array, u: Array, dt: float, p: Values) -> Array:
        """What acts, averaged over one step that begins at y."""
        raise NotImplementedError

    def begins(self, held: list[float], steps: list[int], dt: float, p: Values) -> list[float]:
        """y at the start of each stretch of a held input, from rest. The same as `after`, one stretch after the other."""
        raise NotImplementedError

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """(n, c): y, zero."""
        return np.zeros((n, len(columns(model, channel))))

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """One step from y = z."""
        given = u[:, columns(model, channel)]
        return replaced(u, model, channel, self.mean(z, given, dt, p)), self.after(z, given, 1, dt, p)

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """u (T, nu) or (T, runs, nu), from rest."""
        given = u[..., columns(model, channel)].reshape(len(u), -1)
        y = self._by_rows(given, dt, p) if SHORT * given.shape[1] >= len(u) else self._by_stretches(given, dt, p)
        return replaced(u, model, channel, self.mean(y, given, dt, p).reshape(*u.shape[:-1], -1))

    def _by_stretches(self, u: Array, dt: float, p: Values) -> Array:
        """u (T, m) -> y at the start of each step, (T, m)."""
        rows, many = u.shape
        flat = u.T.ravel()
        new = np.append(True, flat[1:] != flat[:-1])
        new[::rows] = True
        first = np.flatnonzero(new)
        steps = np.diff(np.append(first, len(flat)))
        held, counts, begun = flat[first].tolist(), steps.tolist(), []
        for a, b in pairwise(np.searchsorted(first, rows * np.arange(many + 1)).tolist()):
            begun += self.begins(held[a:b], counts[a:b], dt, p)
        since = (np.arange(len(flat)) - np.repeat(first, steps)).astype(np.float64)
        y = self.after(np.repeat(np.array(begun), steps), flat, since, dt, p)
        return y.reshape(many, rows).T

    def _by_rows(self, u: Array, dt: float, p: Values) -> Array:
        """The same, a row at a time."""
        y = np.empty_like(u)
        now = np.zeros(u.shape[1])
        for k, row in enumerate(u):
            y[k] = now
            now = self.after(now, row, 1, dt, p)
        return y
