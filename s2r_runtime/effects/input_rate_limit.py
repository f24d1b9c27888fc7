"""An input is followed at a limited rate: y' = rate where y < u, -rate_down where y > u, until y = u.

Over a step of dt with u constant and d = u - y, r the limit in d's direction:

    |d| <= r dt   reached within the step:   y+ = u,                  mean = u - d |d| / (2 r dt)
    else          a ramp over all of it:     y+ = y + sign(d) r dt,   mean = y + sign(d) r dt / 2

After j steps of the same u:  y + min(max(d, -rate_down j dt), rate j dt).   Hidden state: y, zero at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from s2r_runtime.effects.follower import Follower, mixtures
from s2r_runtime.effects.input_effect import Array, Values, columns, replaced
from s2r_runtime.hookspecs import NominalModel, Parameter

CATCHING_UP = (0.1, 0.35, 0.8, 1.5, 3.0, 6.0, 11.0, 20.0, 36.0)
"""Steps that a large change of the input takes at the rates from which the tracer begins: what is over within a step shows in a measured
wheel, and in a mean.
"""


class InputRateLimit(Follower):
    """rate in the input's unit a second, for growing values; rate_down for falling ones (left out: the same)."""

    name = "input_rate_limit"
    parameters = (Parameter("rate", "input/s", 1e-6, 1e9, kink=True), Parameter("rate_down", "input/s", 1e-6, 1e9, kink=True))
    optional = ("rate_down",)
    uneven = True

    def within_step(self, dt: float, p: Values) -> bool:
        """A ramp goes on over the step."""
        return True

    def after(self, y: Array, u: Array, steps: Array | float, dt: float, p: Values) -> Array:
        """y moved toward u."""
        up, down = _limits(p, dt)
        return np.asarray(y + np.minimum(np.maximum(u - y, -down * steps), up * steps))

    def mean(self, y: Array, u: Array, dt: float | Array, p: Values) -> Array:
        """Of the ramp, and of u where the ramp has reached it."""
        up, down = _limits(p, dt)
        d = u - y
        reach = np.where(d > 0.0, up, down)
        moved = np.minimum(np.abs(d), reach)
        # a ramp of `moved` takes moved / reach of the step; what it covers it stands at for the rest
        return np.asarray(y + np.sign(d) * moved * (1.0 - moved / (2.0 * reach)))

    def at_end(
        self, tables: tuple[Array, Array, Array], before: Array | None, model: NominalModel, channel: str, dt: float | Array, p: Values
    ) -> Array:
        """The ramp's end, from its mean: half a step's ramp further, and u where it got there (the mean is less than that short of it).
        Where u changed within the row (`mixtures`), the ramp's beginning in the next one, from the mean of that.
        """
        given, acting, _ = tables
        u, mean = given[..., columns(model, channel)], acting[..., columns(model, channel)]
        up, down = _limits(p, dt)
        end = np.ascontiguousarray(mean + np.minimum(np.maximum(u - mean, -0.5 * down), 0.5 * up))
        if before is None:
            rows, flat = len(u), u.reshape(len(u), -1).T.ravel()
            at = mixtures(flat, rows)
            after = (at + 1) % rows, at // rows
            short, reach = (np.broadcast_to(e, u.shape).reshape(rows, -1)[after] for e in (u - mean, np.where(u > mean, up, down)))
            end.reshape(rows, -1)[at % rows, at // rows] = flat[at + 1] - np.sign(short) * _before(np.abs(short), reach)
        return replaced(acting, model, channel, end)

    def begins(self, held: list[float], steps: Sequence[float], dt: float, p: Values) -> list[float]:
        """One ramp a stretch."""
        up, down = _limits(p, dt)
        y, found = 0.0, []
        for u, n in zip(held, steps, strict=True):
            found.append(y)
            if u > y + up * n:
                y += up * n
            elif u < y - down * n:
                y -= down * n
            else:
                y = u
        return found

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """From a limit that a large change meets for a tenth of a step to one that takes it thirty-six."""
        change = np.abs(np.diff(u[:, columns(model, channel)], axis=0))
        if not np.any(change):
            return []
        rate = float(np.quantile(change[change > 0.0], 0.9)) / dt
        return [{"rate": rate / n} for n in CATCHING_UP]

    def fuller(self, p: Values) -> Values | None:
        """One for each direction."""
        return None if "rate_down" in p else {**p, "rate_down": p["rate"]}


def _before(short: Array, reach: Array) -> Array:
    """How far a row's beginning is from the input that its mean falls short of, by so much; reach: how far the ramp gets in a row."""
    return np.where(short < 0.5 * reach, np.sqrt(2.0 * reach * short), short + 0.5 * reach)


def _limits(p: Values, dt: Any) -> tuple[Any, Any]:
    """How far it gets in a step, up and down; of every row, where dt is an array."""
    return float(p["rate"]) * dt, float(p["rate_down"] if "rate_down" in p else p["rate"]) * dt


EFFECT = InputRateLimit()
