"""What effects on inputs that depend on time have in common: the time of each step, step by step and over a recording at once.

t is the time at the start of a step, s since the recording's (or the rollout's) first stamp; below 0 it counts as 0. An effect is
then its mathematics, `act_at`: what a held input becomes, averaged over [t, t + dt]. Hidden state: t, 0 at the start.
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns, replaced
from s2r_runtime.hookspecs import NominalModel

INSTANT = 1e-6
"""Of a step."""


class TimedInputEffect(InputEffect):
    """An effect without memory that depends on time; override `act_at`."""

    timed = True

    def act_at(self, u: Array, t: Array, dt: float | Array, p: Values) -> Array:
        """The channel's input (..., c), held over steps that begin at t (..., 1), s -> its mean as it acts over each, (..., c)."""
        return u

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """(n, 1): time 0."""
        return np.zeros((n, 1))

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """One step at the time that z holds."""
        return replaced(u, model, channel, self.act_at(u[:, columns(model, channel)], z, dt, p)), z + dt

    def input_sequence(
        self, u: Array, model: NominalModel, channel: str, dt: float | Array, p: Values, start: float | Array = 0.0
    ) -> Array:
        """u (T, nu) from `start` s on; or (T, runs, nu), each run from its own (runs,); or rows of dt (T,), which begin at start (T,)."""
        if isinstance(dt, np.ndarray):
            t = np.asarray(start, dtype=np.float64)[:, None]
            return replaced(u, model, channel, self.act_at(u[:, columns(model, channel)], t, dt[:, None], p))
        begun = np.broadcast_to(np.asarray(start, dtype=np.float64), u.shape[1:-1])
        t = (begun + dt * np.arange(len(u)).reshape(-1, *([1] * begun.ndim)))[..., None]
        return replaced(u, model, channel, self.act_at(u[..., columns(model, channel)], t, dt, p))

    def at_end(
        self, tables: tuple[Array, Array, Array], before: Array | None, model: NominalModel, channel: str, dt: float | Array, p: Values
    ) -> Array:
        """Of what came in at the end, over the last instant of the step; before: when it begins, (..., 1)."""
        _, acting, end = tables
        if before is None:
            return acting
        instant = INSTANT * dt
        return replaced(acting, model, channel, self.act_at(end[..., columns(model, channel)], before[..., :1] + dt - instant, instant, p))
