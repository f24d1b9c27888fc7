"""Recordings in which the measurements, not the motion, are wrong in places; some with an effect besides.

offset_jump    a measured state is off by a constant from one row on, for a while or to the end
frozen         it repeats its last value exactly while the robot moves
spike          single rows are far away
clock_step     stamps jump ahead, time does not
inconsistent   the heading leaves the motion (it wanders off and stays, or comes back) while position does not
dropout        no state for a while
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trace_sets.making import EXACT, Draft, Missing, common, draw_missing, draw_noise, drive, recording_of
from trace_sets.recording import Run, TraceSet
from trace_sets.same import accepted
from trace_sets.scale import draw_scale
from trace_sets.world import rollout_errors

Array = NDArray[np.float64]
Rng = np.random.Generator

KINDS = ("offset_jump", "frozen", "spike", "clock_step", "inconsistent", "dropout")
EFFECTS = ("input_gain", "input_delay", "input_lag", "input_bias")


def faulty(name: str, seed: int, rng: Rng) -> TraceSet:
    """A fault; in every third set with an effect."""
    kind = str(rng.choice(KINDS))
    names = (
        ("unicycle", "bicycle", "differential_drive") if kind == "inconsistent" else ("unicycle", "bicycle", "double_integrator", "joint")
    )
    s = draw_scale(rng, names, n=int(rng.uniform(500, 2500)), rate=float(rng.choice([10.0, 20.0, 30.303, 50.0, 100.0])))
    missing: tuple[Missing, ...] = ()
    if rng.random() < 1.0 / 3.0:
        missing = (draw_missing(rng, s, str(rng.choice(EFFECTS)), 1.0),)
    rule: dict[str, Any] = {"declared": (EXACT,)} if s.plant.pose else {}
    law = str(rng.choice(["holds", "sines", "human", "closed"]))
    draft = Draft(s, draw_noise(rng, s, "white", float(10 ** rng.uniform(-3.5, -2.3))), law, "grid", missing, whole=True, **rule)
    runs, starts = drive(rng, draft)
    errors = rollout_errors(starts, draft.nominal()) if starts else None
    runs[0], faults = spoilt(rng, kind, draft, runs[0])
    told = {"accepted": accepted(draft), "kind": kind, "true_faults": faults}
    truth = {"expect": "fault_effect" if missing else "fault", **common(draft, errors), **told}
    return TraceSet(name, seed, recording_of(rng, draft, runs), draft.model(), truth, draft=draft)


def spoilt(rng: Rng, kind: str, draft: Draft, run: Run) -> tuple[Run, list[dict[str, Any]]]:
    """The run with a fault, and where it is: from_s, to_s since the first stamp, channel, and the kinds that it may be called."""
    s = draft.scale
    t, y, t_u = run.t.copy(), run.y.copy(), run.t_u.copy()
    n = len(t)
    first = int(rng.uniform(0.15, 0.6) * n)
    length = max(int(rng.uniform(0.06, 0.2) * n), 12)
    last = min(first + length, n - 2)
    if kind == "clock_step":
        jump = float(rng.uniform(0.5, 4.0))
        t[first:] += jump
        t_u[np.searchsorted(t_u, run.t[first] - 1e-9) :] += jump
        return Run(t, y, t_u, run.u), [_fault(t[first - 1], t[first], "*", ("clock_step", "dropout"))]
    if kind == "dropout":
        last = first + max(int(rng.uniform(0.3, 1.5) / s.dt), 8)
        keep = np.ones(n, dtype=bool)
        keep[first:last] = False
        return Run(t[keep], y[keep], t_u, run.u), [_fault(t[first], t[min(last, n - 1)], "*", ("dropout",))]
    j = 2 if kind == "inconsistent" else int(rng.integers(min(3, len(s.plant.states)) if s.plant.pose else s.plant.axes))
    step = float(np.quantile(np.abs(np.diff(y[:, j])), 0.98))
    far = float(rng.uniform(4.0, 30.0)) * (step + 3.0 * float(draft.noise.sigma[j])) * float(rng.choice([-1.0, 1.0]))
    far = float(np.clip(far, -2.0, 2.0)) if s.plant.pose and j == 2 else far
    channel = s.plant.states[j]
    if kind == "offset_jump":
        for_good = rng.random() < 0.5
        last = n - 1 if for_good else last
        y[first : last + 1, j] += far
        return Run(t, y, t_u, run.u), [_fault(t[first], t[last], channel, ("offset_jump", "inconsistent"))]
    if kind == "frozen":
        y[first : last + 1, j] = y[first, j]
        return Run(t, y, t_u, run.u), [_fault(t[first], t[last], channel, ("frozen",))]
    if kind == "spike":
        rows = np.sort(rng.choice(np.arange(5, n - 5), size=int(rng.integers(1, max(2, n // 250))), replace=False))
        y[rows, j] += far * np.exp(rng.uniform(0.0, 1.0, len(rows)))
        return Run(t, y, t_u, run.u), [_fault(t[k], t[k], channel, ("spike",)) for k in rows.tolist()]
    ramp = max(int(rng.uniform(0.3, 1.0) * length / 2), 5)
    off = float(rng.uniform(0.4, 1.5)) * float(rng.choice([-1.0, 1.0]))
    shape = np.interp(np.arange(n), [first, first + ramp, last, last + ramp], [0.0, off, off, 0.0])
    y[:, 2] += shape
    to = t[min(last + ramp, n - 1)]
    return Run(t, y, t_u, run.u), [_fault(t[first], to, "theta", ("inconsistent", "offset_jump"))]


def _fault(begin: float, end: float, channel: str, kinds: tuple[str, ...]) -> dict[str, Any]:
    return {"from_s": float(begin), "to_s": float(end), "channel": channel, "kinds": list(kinds)}
