"""What a fit leaves, as the effects may see it that find their starting values there: a sine's frequency, the time of a change."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Effect
from s2r_runtime.models.composed import AppliedEffect
from s2r_runtime.models.force_inputs import input_on
from s2r_runtime.models.forces import axis_of
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.prediction import Acting, acting, predicted, wherever
from s2r_runtime.trace.estimation.problem import Fit, Problem, insert

Array = NDArray[np.float64]

NUDGE = 1e-4
"""Of an input's size, for differences: small against what bends, large against rounding."""

WAVE = {"frequency", "amplitude", "phase"}
"""Parameters of what adds a sine to an input."""


@dataclass(frozen=True)
class Leftover:
    """Whitened residual of a fit."""

    given: Problem
    fit: Fit

    def starts(self, effect: Effect, channel: str) -> list[dict[str, Any]]:
        """Further values to begin from, of an effect that asks for the residual; none of another one's."""
        model, steps = self.fit.model, self.given.steps
        if hasattr(effect, "starts_from_states"):
            return self._from_states(effect, channel)
        if not hasattr(effect, "starts_from_residual") or channel not in {*model.inputs, "*"}:  # a state has no input that pushes
            return []
        pushes = self._pushes(channel, proportional=bool(getattr(effect, "proportional", False)))
        wave = {p.name for p in effect.parameters} >= WAVE
        if self.given.floor.axes or wave:
            # whitened, a push is felt for long after, a sine at another phase: its score at every step is p' S^-1 r, its size is told apart
            pulled = self.fit.whiten.back(self.fit.z * noises.weight(self.fit.z))
            found = effect.starts_from_residual(pulled, steps.t, pushes, model.nominal, channel, model.dt)
            return [self._sized(effect, channel, p, pushes) for p in found]
        return list(effect.starts_from_residual(self.fit.z, steps.t, self.fit.whiten(pushes), model.nominal, channel, model.dt))

    def _from_states(self, effect: Any, channel: str) -> list[dict[str, Any]]:
        """Sines of a state, with amplitude and phase by least squares of what they change."""
        model = self.fit.model
        axis = axis_of(model.nominal, channel)
        force = None if axis is None else input_on(model.nominal, axis)
        if force is None:
            return []
        pulled = self.fit.whiten.back(self.fit.z * noises.weight(self.fit.z))
        starts = effect.starts_from_states(
            self.given.steps.y0, pulled, self._pushes(force, proportional=False), model.nominal, channel, model.dt
        )
        found = []
        for p in starts:
            ahead = {**p, "phase": math.remainder(float(p["phase"]) + 0.25 * math.tau, math.tau)}
            columns = np.stack([self._changed(effect, channel, one).ravel() for one in (p, ahead)], axis=1)
            a, b = np.linalg.lstsq(columns, self.fit.z.ravel(), rcond=None)[0].tolist()
            size, phase = math.hypot(a, b), math.remainder(float(p["phase"]) + math.atan2(b, a), math.tau)
            found.append({**p, "amplitude": size * float(p["amplitude"]), "phase": phase})
        return found

    def _sized(self, effect: Effect, channel: str, p: dict[str, Any], pushes: Array) -> dict[str, Any]:
        """The same as large as it explains most: by least squares of what it changes, a sine's phase being free."""
        wave = {*p} >= WAVE
        if wave:
            angle = math.tau * float(p["frequency"]) * (self.given.steps.t + 0.5 * self.fit.model.dt) + float(p["phase"])
            waves = float(p["amplitude"]) * np.stack([np.sin(angle), np.cos(angle)], axis=1)
            columns = self.fit.whiten(pushes[:, :, None] * waves[:, None, :]).reshape(-1, 2)
        else:
            columns = self._changed(effect, channel, p).reshape(-1, 1)
        size = np.linalg.lstsq(columns, self.fit.z.ravel(), rcond=None)[0]
        sized = dict(p)
        if wave:
            sized["phase"] = math.remainder(float(p["phase"]) + math.atan2(float(size[1]), float(size[0])), math.tau)
        for bounds in effect.parameters:
            if bounds.neutral is not None and isinstance(p.get(bounds.name), float):
                share = float(np.hypot(*size)) if wave else float(size[0])
                sized[bounds.name] = float(np.clip(bounds.neutral + share * (p[bounds.name] - bounds.neutral), bounds.low, bounds.high))
        return sized

    def _changed(self, effect: Effect, channel: str, p: dict[str, Any]) -> Array:
        """(n, nx), whitened: what the effect changes in the prediction."""
        model, steps = self.fit.model, self.given.steps
        other = insert(model, AppliedEffect(effect, channel, p), len(model.effects))
        here, there = (predicted(m, steps, act) for m, act in ((model, self._act), (other, acting(other, self.given.data))))
        return self.fit.whiten(there - here)

    def _pushes(self, channel: str, *, proportional: bool) -> Array:
        """(n, nx): by how much a unit more of the input, or the input's own value more, moves the state over each step."""
        model, steps = self.fit.model, self.given.steps
        here = self._act
        more = np.zeros_like(here.mean)
        columns = slice(None) if channel == "*" else slice(model.inputs.index(channel), model.inputs.index(channel) + 1)
        more[:, columns] = here.mean[:, columns] if proportional else 1.0
        h = NUDGE * max(float(np.max(np.abs(here.mean), initial=0.0)), NUDGE) / max(float(np.max(np.abs(more), initial=0.0)), NUDGE)
        nudged = here.moved(h * more)
        return (wherever(model, steps.y0, nudged, steps.place) - wherever(model, steps.y0, here, steps.place)) / h

    @cached_property
    def _act(self) -> Acting:
        return acting(self.fit.model, self.given.data)
