"""A sine is added to an input (an unbalanced wheel, a pump, a swell): u_act = u + amplitude sin(2 pi frequency t + phase).

The mean over a step is that of the sine, damped: with m = t + dt/2,

    mean over [t, t + dt] = amplitude sinc(frequency dt) sin(2 pi frequency m + phase),   sinc(x) = sin(pi x)/(pi x)

t counts from the start; before it the sine stands where it begins. The tracer finds the frequency in the residual's periodogram along
the channel (`periodogram`).
"""

from __future__ import annotations

import numpy as np

from s2r_runtime.effects.input_effect import Array, Values
from s2r_runtime.effects.periodogram import peaks
from s2r_runtime.effects.projection import along
from s2r_runtime.effects.timed_input import TimedInputEffect
from s2r_runtime.hookspecs import NominalModel, Parameter

TURN = 2.0 * np.pi

BEST = 2
"""Peaks that are offered."""


class PeriodicDisturbance(TimedInputEffect):
    """frequency in Hz, amplitude in the input's unit (0 is none), phase in rad at the start."""

    name = "periodic_disturbance"
    parameters = (
        Parameter("frequency", "Hz", 1e-5, 1e4),
        Parameter("amplitude", "input", 0.0, 1e6, neutral=0.0),
        Parameter("phase", "rad", -TURN, TURN),
    )
    linear = True
    uneven = True

    def within_step(self, dt: float, p: Values) -> bool:
        """The sine goes on over the step."""
        return bool(p["amplitude"] != 0.0)

    def act_at(self, u: Array, t: Array, dt: float | Array, p: Values) -> Array:
        """u and the sine's mean."""
        rate, phase, amplitude = TURN * float(p["frequency"]), float(p["phase"]), float(p["amplitude"])
        damped = amplitude * np.sinc(float(p["frequency"]) * dt)
        after = np.asarray(u + damped * np.sin(rate * (t + 0.5 * dt) + phase))
        if t.min(initial=0.0) < 0.0:  # a few rows, if any, begin before the start
            early = np.broadcast_to(t < 0.0, after.shape)
            u, t, dt = (np.broadcast_to(one, after.shape)[early] for one in (u, t, dt))
            begin, end = np.maximum(t, 0.0), np.maximum(t + dt, 0.0)
            moving = amplitude * (end - begin) * np.sinc(float(p["frequency"]) * (end - begin)) * np.sin(0.5 * rate * (begin + end) + phase)
            after[early] = u + (moving + (dt - (end - begin)) * amplitude * np.sin(phase)) / dt
        return after

    def starts(self, u: Array, model: NominalModel, channel: str, dt: float, t: Array) -> list[Values]:
        """None: the input does not show it."""
        return []

    def starts_from_residual(self, residual: Array, t: Array, pushes: Array, model: NominalModel, channel: str, dt: float) -> list[Values]:
        """The highest peaks of the periodogram of the residual along the channel."""
        found: list[Values] = []
        for peak in peaks(t + 0.5 * dt, *along(residual, pushes), dt, BEST):
            amplitude, phase = float(np.hypot(peak.sine, peak.cosine)), float(np.arctan2(peak.cosine, peak.sine))
            found.append({"frequency": peak.frequency, "amplitude": amplitude / float(np.sinc(peak.frequency * dt)), "phase": phase})
        return found


EFFECT = PeriodicDisturbance()
