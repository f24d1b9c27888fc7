"""An input's gain changes at one time and stays so (a part breaks, a load is put on): u_act = u before `time`, gain u from then on.

u is constant over each step; the mean over the step in which it happens has the part of the step that is left:

    s = min(max((t + dt - time) / dt, 0), 1),   u_act = (1 + (gain - 1) s) u

The tracer finds the time in one pass over the residual: with r the residual and c = what the input's own value more of it does to the
state, a change at t_k by (gain - 1) = A_k / B_k explains A_k² / B_k of the sum of squares, where A_k = sum over j >= k of c_j . r_j,
B_k = sum over j >= k of |c_j|².
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, Values, columns
from s2r_runtime.effects.projection import along
from s2r_runtime.effects.timed_input import TimedInputEffect
from s2r_runtime.hookspecs import NominalModel, Parameter

COARSE = 3
"""Times that the tracer begins from, so that between two of them the input does a third of what it does in all; the residual shows better
ones."""

GAINS = (0.7, 1.3)

BEST = 3
"""Peaks of the explained sum of squares that are offered: the noise may put the highest one a few steps off."""

EDGE = 0.02
"""A change before or after which the input does less than this share of what it does in all is a constant gain, or none."""

MEDIAN = 0.455
"""Of the square of a standard normal number."""

PARTS = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95)

APART = 0.02
"""Peaks nearer to each other than this share of the rows are one."""


class RegimeChange(TimedInputEffect):
    """time in s since the start, gain from then on (1 is none); on one input, or on all alike (`*`)."""

    name = "regime_change"
    parameters = (Parameter("time", "s", 0.0, 1e7, kink=True), Parameter("gain", "", 0.0, 100.0, neutral=1.0))
    all_alike = True
    proportional = True
    uneven = True

    def within_step(self, dt: float, p: Values) -> bool:
        """It comes within a step, unless between two."""
        place = p["time"] / dt
        return bool(abs(place - round(place)) > 1e-9 * max(place, 1.0))

    def act_at(self, u: Array, t: Array, dt: float | Array, p: Values) -> Array:
        """u, gain u after."""
        time, gain = float(p["time"]), float(p["gain"])
        left = np.clip((t + (dt - time)) / dt, 0.0, 1.0) if time > 0.0 else np.ones_like(t)
        return u * (1.0 + (gain - 1.0) * left)

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float, t: Array) -> list[Values]:
        """Times that cut what the input does into equal parts, a change down and up."""
        done: Array = np.cumsum(np.sum(u[:, columns(model, channel)] ** 2, axis=1))
        if not len(done) or done[-1] == 0.0:
            return []
        shares = (np.arange(COARSE) + 0.5) / COARSE
        times = t[np.minimum(np.searchsorted(done, shares * done[-1]), len(t) - 1)]
        return [{"time": max(float(when), 0.0), "gain": gain} for when in times for gain in GAINS]

    def starts_from_residual(self, residual: Array, t: Array, pushes: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """The best times, each with the gain that fits."""
        d, w = along(residual, pushes)
        a, b = (np.cumsum(part[::-1])[::-1] for part in (d, w))
        inside = (b > EDGE * b[:1]) & (b < (1.0 - EDGE) * b[:1])
        if not np.any(inside):
            return []
        explained = np.where(inside, a * a / np.maximum(b, 1e-300), 0.0)
        best = int(np.argmax(explained))
        left = np.where(np.arange(len(t)) < best, d, d - w * a[best] / b[best])
        noise = float(np.median(left[w > 0.0] ** 2 / w[w > 0.0])) / MEDIAN
        # where the data have a gap before a step, the change may have come anywhere in it: so many times more ways to come about
        ways = np.log(np.maximum(np.diff(t, prepend=t[0] - dt) / dt, 1.0))
        score = np.where(inside, explained + 2.0 * noise * ways, 0.0)
        found: list[Values] = []
        apart = max(1, round(APART * len(t)))
        while len(found) < BEST and score.max() > 0.0:
            k = int(np.argmax(score))
            found.append(_within(k, a, b, t, dt))
            score[max(0, k - apart) : k + apart + 1] = 0.0
        return found


def _within(k: int, a: Array, b: Array, t: Array, dt: float) -> Values:
    """A change at about the start of step k, to a tenth of a step: of a step in which it comes a part s only has the new gain. After a gap:
    in its middle.
    """
    best: tuple[float, float, float] = (0.0, float(t[k]), float(a[k] / b[k]))
    if k > 0 and t[k] - t[k - 1] > 1.5 * dt:
        return {"time": max(0.5 * float(t[k - 1] + dt + t[k]), 0.0), "gain": _gain(best[2])}
    for j in range(max(k - 1, 0), min(k + 1, len(t) - 1)):
        for s in PARTS:
            above = a[j + 1] + s * (a[j] - a[j + 1])
            below = b[j + 1] + s * s * (b[j] - b[j + 1])
            if below > 0.0 and above * above / below > best[0]:
                best = float(above * above / below), float(t[j] + (1.0 - s) * dt), float(above / below)
    return {"time": max(best[1], 0.0), "gain": _gain(best[2])}


def _gain(more: float) -> float:
    return float(np.clip(1.0 + more, 0.0, 100.0))


EFFECT = RegimeChange()
