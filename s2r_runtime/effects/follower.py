"""What effects on inputs with one nonlinear state have in common: an output y that follows the held input u by a rule of its own.

    one step        y, u -> y one step later, and the mean of what acts over the step
    while u holds   y after j steps of the same u has a closed form, so that a recording is a tight loop over the stretches
                    in which the input is held, and the rest is done for all rows at once

Where rows do not last alike (`uneven`), a row is as many steps as it lasts, also a part of one, and `mean` is asked with dt (rows, 1).
Hidden state: y, zero at rest. An input that never holds costs one turn of the loop a row (about a tenth of a microsecond).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from inspect import signature
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns, replaced
from s2r_runtime.hookspecs import NominalModel

Index = NDArray[np.int64]

SHORT = 2
"""Rows a column below which a row at a time is faster than a column at a time."""


KEPT, LARGE = 8, 100_000
"""Inputs of which it is known where they hold, and the values in the largest one that is kept."""


LEAST = 1e-6
"""Of a row: what comes that much after its beginning, or before its end, is on it but for rounding."""


@dataclass(frozen=True, eq=False)
class Held:
    """What follows from an input (T, columns) alone, whatever the effect's numbers are. Columns are end to end, m rows in all; rows with a
    change within (`mixtures`) are in two parts.

    u: (m,); lasts: (m,) steps of `usual` s; first: (T columns,) part of each row, None where all are in one. stretches: of each column,
    the values that are held, and for how many steps each; number: of rows in a stretch; since: (m,) steps since its stretch began.
    """

    source: tuple[Array, float | Array, bool]
    u: Array
    lasts: Array
    usual: float
    first: Index | None
    stretches: list[tuple[list[float], list[float]]]
    number: Index
    since: Array

    def of(self, given: Array, dt: float | Array, mixed: bool) -> bool:
        """Whether it is this input's."""
        there, lasts, both = self.source
        return both == mixed and np.array_equal(there, given) and np.array_equal(lasts, dt)


_KNOWN: deque[Held] = deque(maxlen=KEPT)
"""Of the inputs that were asked for last: a fit asks for one input under many numbers."""


def _held(given: Array, dt: float | Array, mixed: bool) -> Held:
    """Known by what is held, not by the array: that may be written to."""
    found = next((held for held in _KNOWN.copy() if held.of(given, dt, mixed)), None)
    if found is None:
        found = _stretched(given, dt, mixed)
        if given.size <= LARGE:
            _KNOWN.append(found)
    return found


def _stretched(given: Array, dt: float | Array, mixed: bool) -> Held:
    """given: (T, columns); dt: s, or of each row (T,)."""
    rows, many = given.shape
    usual = float(np.median(dt)) if isinstance(dt, np.ndarray) else float(dt)
    u, lasts = given.T.ravel(), np.tile(np.broadcast_to(dt / usual, (rows,)), many)
    begins, first = rows * np.arange(many), None
    at = mixtures(u, rows) if mixed else np.zeros(0, dtype=np.int64)
    if len(at):
        share = (u[at] - u[at - 1]) / (u[at + 1] - u[at - 1])
        before, after = u[at - 1], u[at + 1]
        parts = np.ones(len(u), dtype=np.int64)
        parts[at] = 2
        first = np.cumsum(parts) - parts
        u, lasts, begins = np.repeat(u, parts), np.repeat(lasts, parts), first[begins]
        u[first[at]], u[first[at] + 1] = before, after
        lasts[first[at]] *= 1.0 - share
        lasts[first[at] + 1] *= share
    new = np.append(True, u[1:] != u[:-1])
    new[begins] = True
    start = np.flatnonzero(new)
    number = np.diff(np.append(start, len(u)))
    until = np.cumsum(lasts)
    values, steps = u[start].tolist(), np.diff(until[start + number - 1], prepend=0.0).tolist()
    since = np.append(0.0, until[:-1])
    since -= np.repeat(since[start], number)
    edges = np.searchsorted(start, np.append(begins, len(u))).tolist()
    stretches = [(values[a:b], steps[a:b]) for a, b in pairwise(edges)]
    return Held((given, dt.copy() if isinstance(dt, np.ndarray) else dt, mixed), u, lasts, usual, first, stretches, number, since)


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
        rows, many = given.shape
        held = _held(given, dt, mixed)
        if held.first is not None:
            return replaced(u, model, channel, self._mean_of_both(held, held.first, p).reshape(many, rows).T.reshape(*u.shape[:-1], -1))
        if SHORT * many >= rows:
            y = self._by_rows(given, held.lasts[:rows], held.usual, p)
        else:
            y = self._by_stretches(held, p).reshape(many, rows).T
        each = dt[:, None] if isinstance(dt, np.ndarray) else dt
        return replaced(u, model, channel, self.mean(y, given, each, p).reshape(*u.shape[:-1], -1))

    def _mean_of_both(self, held: Held, first: Index, p: Values) -> Array:
        """Means of what acts, of columns end to end, rows of which some are in two parts; first: (rows,) part of each."""
        y = self._by_stretches(held, p)
        acting = self.mean(y[:, None], held.u[:, None], held.lasts[:, None] * held.usual, p)[:, 0]
        return np.asarray(np.add.reduceat(acting * held.lasts, first) / np.add.reduceat(held.lasts, first))

    def _by_stretches(self, held: Held, p: Values) -> Array:
        """y at the start of each row of columns end to end."""
        begun = [y for values, steps in held.stretches for y in self.begins(values, steps, held.usual, p)]
        return self.after(np.repeat(np.array(begun), held.number), held.u, held.since, held.usual, p)

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
