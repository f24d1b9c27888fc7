"""An input acts later: u_act(t) = u(t - delay), averaged over the step.

u is constant over each step of dt. With delay = (m + f) dt, 0 <= f < 1, the mean over step k is  (1 - f) u_{k-m} + f u_{k-m-1}.
Hidden state: the last m + 1 inputs, newest first; zero at rest.
"""

from __future__ import annotations

import math

import numpy as np

from s2r_runtime.effects.follower import mixtures
from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns, replaced
from s2r_runtime.hookspecs import NominalModel, Parameter

ROUNDING = 1e-9
"""A delay this close below a whole number of steps is that number."""


class InputDelay(InputEffect):
    """delay in s; on one input, or on all alike (`*`)."""

    name = "input_delay"
    parameters = (Parameter("delay", "s", 0.0, 600.0, neutral=0.0, kink=True),)
    all_alike = True
    linear = True
    shift = True
    uneven = True
    takes_mixed_ends = True

    def within_step(self, dt: float, p: Values) -> bool:
        """A delay of whole steps keeps what is constant over a step so."""
        return _steps(p["delay"], dt)[1] > ROUNDING

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """(n, c (m + 1)): zero inputs."""
        whole, _ = _steps(p["delay"], dt)
        return np.zeros((n, len(columns(model, channel)) * (whole + 1)))

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """One step through the line of past inputs."""
        whole, part = _steps(p["delay"], dt)
        width = len(columns(model, channel))
        line = np.concatenate([u[:, columns(model, channel)], z], axis=1).reshape(len(u), whole + 2, width)
        acting = (1.0 - part) * line[:, whole] + part * line[:, whole + 1]
        return replaced(u, model, channel, acting), line[:, :-1].reshape(len(u), -1)

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """The whole recording shifted."""
        if isinstance(dt, np.ndarray):
            return replaced(u, model, channel, _shifted(u[:, columns(model, channel)], dt, float(p["delay"])))
        whole, part = _steps(p["delay"], dt)
        given = u[..., columns(model, channel)]
        line = np.concatenate([np.zeros((whole + 1, *given.shape[1:])), given])
        return replaced(u, model, channel, (1.0 - part) * line[1 : 1 + len(u)] + part * line[: len(u)])

    def at_end(
        self,
        tables: tuple[Array, Array, Array],
        before: Array | None,
        model: NominalModel,
        channel: str,
        dt: float | Array,
        p: Values,
        *,
        mixed: bool = False,
    ) -> Array:
        """What was held a delay before the end: u_{k-m}, whole, where the mean is a mixture. mixed: as `Follower.input_sequence` has it."""
        given, acting, _ = tables
        u = given[..., columns(model, channel)]
        if before is not None:
            whole, _ = _steps(p["delay"], float(np.min(dt)))
            line = np.concatenate([u, before], axis=1).reshape(len(u), whole + 2, u.shape[1])
            return replaced(acting, model, channel, line[:, whole])
        if not mixed and not isinstance(dt, np.ndarray):
            whole, _ = _steps(p["delay"], dt)
            line = np.concatenate([np.zeros((whole, *u.shape[1:])), u])
            return replaced(acting, model, channel, line[: len(u)])
        lasts = np.broadcast_to(dt, (len(u), *u.shape[1:-1], 1))[..., 0].reshape(len(u), -1)
        runs = u.reshape(len(u), lasts.shape[1], -1)
        late = np.stack([_before(runs[:, i], lasts[:, i], float(p["delay"]), mixed=mixed) for i in range(lasts.shape[1])], axis=1)
        return replaced(acting, model, channel, late.reshape(u.shape))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """Parts of a step at first, then wider, up to half a second or a dozen steps."""
        wide = [s for s in (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5) if 4.0 * dt < s <= 200.0 * dt]
        return [{"delay": s} for s in sorted({*(dt * k for k in (0.1, 0.3, 0.6, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 12.0)), *wide})]


def _shifted(u: Array, lasts: Array, delay: float) -> Array:
    """u (T, c), held over rows that last so long, (T,) s, a delay later: the mean over each row, and exactly u where one value fills it."""
    edges = np.concatenate([[0.0], np.cumsum(lasts)])
    at = edges - delay
    row = np.clip(np.searchsorted(edges, at, side="right") - 1, -1, len(u) - 1)
    since = np.where(row >= 0, at - edges[row], 0.0)[:, None]
    given = np.concatenate([u, np.zeros((1, u.shape[1]))])[row]  # zero, the last of these, before the first row
    area = np.concatenate([[np.zeros(u.shape[1])], np.cumsum(u * lasts[:, None], axis=0)])[np.maximum(row, 0)] + given * since
    changes = np.cumsum(np.any(np.diff(u, axis=0, prepend=0.0) != 0.0, axis=1))
    number = np.concatenate([changes, [0]])[row]
    return np.where((number[1:] == number[:-1])[:, None], given[:-1], np.diff(area, axis=0) / lasts[:, None])


def _before(u: Array, lasts: Array, delay: float, *, mixed: bool) -> Array:
    """u (T, c), held over rows that last so long, (T,) s, as it was a delay before the end of each row; zero before the first. mixed: a
    row within which an input changes, whose mean says when, has what came before that or after it.
    """
    edges = np.concatenate([[0.0], np.cumsum(lasts)])
    at = edges[1:] - delay
    row = np.searchsorted(edges, at - ROUNDING * np.max(lasts), side="right") - 1
    k = np.clip(row, 0, None)
    known = u[k]
    for j in range(u.shape[1] if mixed else 0):
        changes = mixtures(u[:, j], len(u))
        before, mean, after = (u[changes + shift, j] for shift in (-1, 0, 1))
        until = np.full(len(u), np.nan)
        until[changes] = (after - mean) / (after - before)
        since = (at - edges[k]) / lasts[k]
        known[:, j] = np.where(np.isnan(until[k]), known[:, j], u[np.where(since <= until[k], k - 1, np.minimum(k + 1, len(u) - 1)), j])
    return np.where((row >= 0)[:, None], known, 0.0)


def _steps(delay: float, dt: float) -> tuple[int, float]:
    """delay / dt as a whole number of steps and the part of a step that is left."""
    whole = math.floor(delay / dt + ROUNDING)
    return whole, max(delay / dt - whole, 0.0)


EFFECT = InputDelay()
