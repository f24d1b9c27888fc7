"""Recordings in which one sensor has a delay relative to the others.

late_heading   the heading reaches the recording 20 to 300 ms after the positions, or the positions after the heading
late_speed     the recorded speed is filtered, delayed, or the difference of two positions

Every signal is simulated in parts of a step and then read late, so that a delay is no whole number of samples. In clean sets nothing is
delayed. Half of all sets lack an effect as well. Truth: `delayed` holds the states and the seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trace_sets import draws
from trace_sets.making import EXACT, HORIZON_S, Draft, Missing, asked, common, draw_missing, draw_noise, recording_of
from trace_sets.recording import Run, TraceSet, record
from trace_sets.same import accepted, alternatives
from trace_sets.scale import Scale, draw_scale, log_uniform
from trace_sets.world import Rollouts, Start, rollout_errors

Array = NDArray[np.float64]
Rng = np.random.Generator
Sensor = Callable[[Array], Array]
"""(parts, nx) without noise, one row a part -> as the sensors deliver it."""

MATTERS = 2.0
"""Of a delay, and of an effect: nominal over oracle error at the end of rollouts."""
TRIES = 10

EFFECTS = {"input_gain", "input_bias", "input_delay", "input_lag", "longitudinal_slip", "track_scale", "constant_disturbance"}
LIKE_A_DELAY = {"lateral_slip", "sensor_lever_arm", "understeer"}
"""With a delayed heading these are one guess too many; without one they must not be taken for it."""
ON_AXES = {"input_gain", "input_bias", "input_lag", "input_deadband", "viscous_friction", "coulomb_friction", "constant_disturbance"}


def _later(y: Array, parts: int, columns: list[int]) -> Array:
    """Before the first row the robot stood still."""
    out = y.copy()
    out[:, columns] = y[np.maximum(np.arange(len(y)) - parts, 0)][:, columns]
    return out


def _filtered(y: Array, parts: float, columns: list[int]) -> Array:
    """A first-order low-pass, time constant in parts."""
    out, keep = y.copy(), math.exp(-1.0 / parts)
    for k in range(1, len(y)):
        out[k, columns] = keep * out[k - 1, columns] + (1.0 - keep) * y[k, columns]
    return out


def measured(rng: Rng, draft: Draft, sensor: Sensor) -> tuple[Run, Rollouts, Rollouts]:
    """The run as delivered, and the errors of rollouts on it: nominal against an oracle without delay; as without the delay."""
    s, world = draft.scale, draft.world()
    rows = np.arange(s.n * s.parts + 1)
    orders = rows[:: s.parts]
    quiet = replace(draft.noise, sigma=np.zeros(len(draft.noise.sigma)), freedom=0.0, outliers=0.0, quantum=np.zeros(0))
    ahead = max(1, min(round(HORIZON_S / s.dt), s.n // 4)) * s.parts
    x0 = [float(v) for v in rng.uniform(-1.0, 1.0, 3 if s.plant.pose else s.plant.axes)] + [0.0] * len(s.plant.states)
    commands = asked(rng, draft, s.dt / s.parts * orders)
    run = record(world, rows, orders, commands, quiet, x0[: len(s.plant.states)], rng, ahead=ahead, rollouts=30)
    late = sensor(run.y)

    def errors(y: Array) -> Rollouts:
        ends = draft.noise.errors(rng, 2 * len(run.starts)).reshape(len(run.starts), 2, -1)
        starts = [
            Start(b.moment, (y[b.moment.i] + e[0]).tolist(), b.until, (y[b.until] + e[1]).tolist())
            for b, e in zip(run.starts, ends, strict=True)
        ]
        return rollout_errors(starts, draft.nominal())

    plain = errors(run.y)
    e = draft.noise.errors(rng, len(orders))
    y = np.array([draft.noise.rounded(v) for v in (late[orders] + e).tolist()])
    return Run(run.t[orders], y, run.t_u, run.u), Rollouts(plain.oracle, errors(late).nominal), plain


def _missing(rng: Rng, s: Scale, among: set[str], size: float) -> Missing:
    return draw_missing(rng, s, str(rng.choice(sorted(among & set(draws.names(s.plant))))), size)


def _truth(draft: Draft, errors: Rollouts, delayed: dict[str, Any], to_s: float) -> dict[str, Any]:
    """What is expected, whatever is delayed."""
    truth = {**common(draft, errors), "delayed": delayed, "accepted": accepted(draft), "alternatives": alternatives(draft), "close": True}
    if delayed["kind"] == "none":
        return truth | {"expect": "one" if draft.missing else "clean", "no_fault": ["late"]}
    where = {"from_s": 0.0, "to_s": to_s, "channel": "*", "kinds": ["late"]}
    return truth | {"expect": "fault_effect" if draft.missing else "fault", "true_faults": [where]}


def late_heading(name: str, seed: int, rng: Rng) -> TraceSet:
    """The delay of a heading (or position) shows in the displacement sideways: it matters to x and y."""
    kind = str(rng.choice(["none", "heading", "position"], p=[0.4, 0.4, 0.2]))
    with_effect = rng.random() < 0.4
    among = EFFECTS | LIKE_A_DELAY if kind == "none" else EFFECTS
    size, level = 1.0, log_uniform(rng, 2e-4, 3e-3)
    for _ in range(TRIES):
        robots = ("unicycle", "differential_drive", "bicycle")
        s = draw_scale(rng, robots, n=int(log_uniform(rng, 400, 1500)), rate=float(rng.choice([10.0, 20.0, 30.303, 50.0, 100.0])))
        missing = (_missing(rng, s, among, size),) if with_effect else ()
        law = str(rng.choice(["holds", "sines", "human", "closed"]))
        draft = Draft(s, draw_noise(rng, s, "white", level), law, "grid", missing, whole=True, declared=(EXACT,))
        parts = round(log_uniform(rng, max(0.02, s.dt), 0.3) * s.parts / s.dt)
        columns = [2] if kind == "heading" else [0, 1]
        delay = 0 if kind == "none" else parts
        run, errors, plain = measured(rng, draft, lambda y, d=delay, c=columns: _later(y, d, c))  # type: ignore[misc]
        shown = float(np.max(errors.nominal[:2] / np.maximum(errors.oracle[:2], 1e-9)))
        if (kind == "none" or shown >= MATTERS) and (not missing or plain.ratio >= MATTERS):
            break
        size, level = min(1.3 * size, 3.0), 0.6 * level
    states = [] if kind == "none" else [s.plant.states[j] for j in columns]
    delayed = {"kind": kind, "states": states, "seconds": delay * s.dt / s.parts, "shown": shown}
    truth = _truth(draft, plain, delayed, float(run.t[-1])) | {"kind": kind}
    return TraceSet(name, seed, recording_of(rng, draft, [run]), draft.model(), truth, draft=draft)


def late_speed(name: str, seed: int, rng: Rng) -> TraceSet:
    """Speeds of axes: treated as not measured, and no fault. Of a car or wheels nothing is promised: no false effect."""
    kind = str(rng.choice(["none", "delay", "filter", "difference"], p=[0.3, 0.25, 0.25, 0.2]))
    axes = rng.random() < 0.75 or kind in {"none", "difference"}
    with_effect = axes and rng.random() < 0.5
    size, level = 1.0, log_uniform(rng, 1e-4, 2e-3)
    for _ in range(TRIES):
        robots = ("joint", "double_integrator") if axes else ("bicycle", "differential_drive")
        rates = [20.0, 50.0, 100.0, 200.0, 500.0, 1000.0]
        s = draw_scale(rng, robots, n=int(log_uniform(rng, 500, 2000)), rate=float(rng.choice(rates)))
        missing = (_missing(rng, s, ON_AXES, size),) if with_effect else ()
        law = str(rng.choice(["sines", "human", "holds", "closed"]))
        rule: dict[str, Any] = {"declared": (EXACT,)} if s.plant.pose else {}
        draft = Draft(s, draw_noise(rng, s, "white", level), law, "grid", missing, whole=True, **rule)
        columns = list(range(3, len(s.plant.states))) if s.plant.pose else list(range(s.plant.axes, 2 * s.plant.axes))
        parts = round(min(log_uniform(rng, 0.8, 6.0) * s.dt, 0.5 * s.pace) * s.parts / s.dt)
        samples = max(round(parts / s.parts), 1)
        parts = {"none": 0, "difference": s.parts * samples // 2}.get(kind, parts)
        sensor: dict[str, Sensor] = {
            "none": lambda y: y,
            "filter": lambda y, d=parts, c=columns: _filtered(y, d, c),  # type: ignore[misc]
        }
        run, errors, plain = measured(rng, draft, sensor.get(kind, lambda y, d=parts, c=columns: _later(y, d, c)))  # type: ignore[misc]
        if (kind == "none" or errors.ratio >= MATTERS) and (not missing or plain.ratio >= MATTERS):
            break
        size, level = min(1.3 * size, 3.0), 0.6 * level
    if kind == "difference":
        run.y[:, columns] = _difference(run.y[:, : s.plant.axes], samples, s.dt)
    delayed = {"kind": kind, "states": [s.plant.states[j] for j in columns] if parts else [], "seconds": parts * s.dt / s.parts}
    truth = _truth(draft, plain, delayed, float(run.t[-1])) | {"kind": kind, "expect": "one" if missing else "clean"}
    truth |= {} if axes else {"expect": "unpromised"}
    truth.pop("true_faults", None)
    return TraceSet(name, seed, recording_of(rng, draft, [run]), draft.model(), truth, draft=draft)


def _difference(positions: Array, samples: int, dt: float) -> Array:
    """Over this many samples back: late by half of them."""
    before = positions[np.maximum(np.arange(len(positions)) - samples, 0)]
    return np.asarray((positions - before) / (samples * dt))
