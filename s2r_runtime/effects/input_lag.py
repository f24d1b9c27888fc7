"""An input is followed with a first-order lag: time_constant s' = u - s, exact for u constant over the step, averaged over it.

With a = exp(-dt/T):  s_{k+1} = u_k + (s_k - u_k) a,   u_act = u_k + (s_k - u_k) (T/dt) (1 - a).   Hidden state: s, zero at rest.
"""

from __future__ import annotations

import math

import numpy as np

from s2r_runtime.effects.input_effect import Array, InputEffect, Values, columns, replaced
from s2r_runtime.hookspecs import NominalModel, Parameter

SMALLEST = 1e-300
"""Not to divide by zero where nothing is left of a difference, on average or at the end."""


class InputLag(InputEffect):
    """time_constant T in s; 0 is none."""

    name = "input_lag"
    parameters = (Parameter("time_constant", "s", 0.0, 1e3, neutral=0.0),)
    linear = True
    uneven = True

    def within_step(self, dt: float, p: Values) -> bool:
        """The response goes on over the step."""
        return float(p["time_constant"]) > 0.0

    def hidden(self, n: int, model: NominalModel, channel: str, dt: float, p: Values) -> Array:
        """(n, 1): zero."""
        return np.zeros((n, len(columns(model, channel))))

    def input_step(self, u: Array, z: Array, model: NominalModel, channel: str, dt: float, p: Values) -> tuple[Array, Array]:
        """One step of the filter."""
        keep, mean = _factors(p["time_constant"], dt)
        given = u[:, columns(model, channel)]
        return replaced(u, model, channel, given + (z - given) * mean), given + (z - given) * keep

    def input_sequence(self, u: Array, model: NominalModel, channel: str, dt: float | Array, p: Values) -> Array:
        """The recursion as one banded triangular solve: s_{k+1} - a s_k = (1 - a) u_k, with a of row k."""
        from scipy.linalg import lapack

        keep, mean = _factors(p["time_constant"], dt)
        given = u[..., columns(model, channel)]
        band = np.ones((2, len(u)))
        band[1, :-1] = -keep[1:] if isinstance(keep, np.ndarray) else -keep
        keep, mean = (e[:, None] if isinstance(e, np.ndarray) else e for e in (keep, mean))
        after, _ = lapack.dtbtrs(band, (1.0 - keep) * given.reshape(len(u), -1), uplo="L", diag="U")
        before = np.concatenate([np.zeros((1, *given.shape[1:])), after[:-1].reshape(given[:-1].shape)])
        return replaced(u, model, channel, given + (before - given) * mean)

    def at_end(
        self, tables: tuple[Array, Array, Array], before: Array | None, model: NominalModel, channel: str, dt: float | Array, p: Values
    ) -> Array:
        """The state itself, from its mean over the step: s_{k+1} = u_k + (u_act - u_k) a / mean."""
        given, acting, _ = tables
        keep, mean = _factors(p["time_constant"], dt)
        u = given[..., columns(model, channel)]
        return replaced(acting, model, channel, u + (acting[..., columns(model, channel)] - u) * (keep / np.maximum(mean, SMALLEST)))

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """From a tenth of a step to 40 steps, and the time constants that actuators have."""
        usual = [s for s in (0.05, 0.1, 0.2, 0.4, 0.8, 1.5) if 6.0 * dt < s <= 400.0 * dt]
        return [{"time_constant": s} for s in sorted({*(dt * k for k in (0.1, 0.3, 0.7, 1.5, 3.0, 6.0, 12.0, 40.0)), *usual})]


def _factors(time_constant: float, dt: float | Array) -> tuple[float | Array, float | Array]:
    """What is left of a difference at the end of the step, and on average over it; (T,) each for steps of dt (T,)."""
    if np.min(dt) * 1e-6 > time_constant:
        return 0.0, 0.0
    ratio = dt / time_constant
    if not isinstance(ratio, np.ndarray):
        return math.exp(-ratio), -math.expm1(-ratio) / ratio
    return np.exp(-ratio), -np.expm1(-ratio) / ratio


EFFECT = InputLag()
