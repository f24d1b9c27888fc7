"""What people really hand to a tracer: recordings from which nothing, or nothing true, can be traced. No name is right here.

constant_inputs   every command the same all the time          still          it never moved, whatever was asked
idle              nothing asked, nothing done                   one_row        one row, over and over
wrong_model       another robot's data under the right names    swapped        two columns exchanged
degrees           the heading in degrees                        two_clocks     commands on a clock that is hours away
drifting_clock    commands on a clock that runs fast by a per cent
empty, no_rows, missing_column, words, backwards, not_finite, short    files that must be refused, in one line
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from trace_sets.making import EXACT, Draft, common, draw_noise, drive, recording_of
from trace_sets.recording import Recording, Run, TraceSet
from trace_sets.scale import Scale, draw_scale

Rng = np.random.Generator

ODD = ("constant_inputs", "still", "idle", "one_row", "wrong_model", "swapped", "degrees", "two_clocks", "drifting_clock")
BROKEN = ("empty", "no_rows", "missing_column", "words", "backwards", "not_finite", "short")


def bad(name: str, seed: int, rng: Rng) -> TraceSet:
    """One of them, in turn."""
    kind = (ODD + BROKEN)[seed % len(ODD + BROKEN)]
    names: tuple[str, ...] = ("unicycle", "double_integrator", "joint")
    if kind in {"swapped", "degrees", "wrong_model"}:
        names = ("unicycle",) if kind == "wrong_model" else ("unicycle", "bicycle")
    s = draw_scale(rng, names, n=int(rng.uniform(300, 1200)), rate=float(rng.choice([10.0, 20.0, 30.303, 50.0])))
    rule: dict[str, Any] = {"declared": (EXACT,)} if s.plant.pose else {}
    draft = Draft(s, draw_noise(rng, s, "white", float(10 ** rng.uniform(-3.5, -2.3))), "holds", "grid", whole=True, **rule)
    if kind in {"constant_inputs", "idle"}:
        values = np.zeros(len(s.ranges)) if kind == "idle" else np.array([r.size * rng.uniform(0.2, 0.9) for r in s.ranges])
        draft.asked = lambda rng, t: np.tile(values, (len(t), 1))
    runs, _ = drive(rng, draft)
    runs[0] = _odd(rng, kind, s, runs[0])
    recording = recording_of(rng, draft, runs)
    recording.wrap = recording.wrap and kind != "degrees"  # who writes degrees does not wrap them at pi
    truth = {"expect": "bad", **common(draft, None), "kind": kind, "must_refuse": kind in BROKEN, "accepted": []}
    return TraceSet(name, seed, recording, draft.model(), truth, raw=_broken(kind, recording) if kind in BROKEN else None, draft=draft)


def _odd(rng: Rng, kind: str, s: Scale, run: Run) -> Run:
    y, u = run.y.copy(), run.u.copy()
    if kind == "still":
        y = y[:1] + rng.normal(size=y.shape) * np.std(np.diff(y, 2, axis=0), axis=0) * 0.3
    elif kind == "one_row":
        y, u = np.repeat(y[:1], len(y), axis=0), np.repeat(u[:1], len(u), axis=0)
    elif kind == "swapped":
        y = y[:, [1, 0, *range(2, y.shape[1])]]
    elif kind == "degrees":
        y[:, 2] = np.degrees(y[:, 2])
    elif kind == "wrong_model":  # a hovercraft: its commands are accelerations
        speed = np.cumsum(u[: len(y)], axis=0) * s.dt
        heading = y[0, 2] + np.cumsum(speed[:, 1]) * s.dt
        y = np.column_stack([np.cumsum(speed[:, 0] * np.cos(heading)) * s.dt, np.cumsum(speed[:, 0] * np.sin(heading)) * s.dt, heading])
        y += rng.normal(size=y.shape) * 1e-3
    elif kind == "two_clocks":
        return Run(run.t, y, run.t_u + 3600.0 * float(rng.uniform(1.0, 12.0)), u)
    elif kind == "drifting_clock":
        return Run(run.t, y, run.t_u[0] + (run.t_u - run.t_u[0]) * 1.01, u)
    return Run(run.t, y, run.t_u, u)


def _broken(kind: str, recording: Recording) -> str:
    """A text that is no recording."""
    lines = recording.text().splitlines()
    needed = recording.plant.inputs[0]
    if kind == "empty":
        lines = []
    elif kind == "no_rows":
        lines = lines[:1]
    elif kind == "missing_column":
        place = lines[0].split(",").index(needed)
        lines = [",".join(c for i, c in enumerate(line.split(",")) if i != place) for line in lines]
    elif kind == "words":
        lines[len(lines) // 2] = lines[len(lines) // 2].rpartition(",")[0] + ",fast"
    elif kind == "backwards":
        half = len(lines) // 2
        lines[half : half + 20] = reversed(lines[half : half + 20])
    elif kind == "not_finite":
        lines[len(lines) // 2] = lines[len(lines) // 2].rpartition(",")[0] + "," + str(math.inf)
    else:
        lines = lines[:9]
    return "\n".join(lines) + ("\n" if lines else "")
