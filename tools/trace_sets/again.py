"""The same robot driven once more, without noise: how far the nominal and the repaired model go wrong there, of what they could.

    reached = (E_nominal - E_repaired) / (E_nominal - E_oracle)
    E²      = sum over states of (rms error at the end of rollouts / the state's usual way in them)²

The oracle's own error on such data is zero; with the measurement noise of the recording (as the oracle's rollouts had it) added to all
three it is the share of what was achievable there. Models are the project's own; the truth is this package's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from trace_sets.excitation import open_loop
from trace_sets.making import HORIZON_S, TIMED, Draft
from trace_sets.noise import Noise
from trace_sets.recording import record

Array = NDArray[np.float64]

STEPS = 600
"""Of the new drive, where time itself does not matter."""


def errors_again(draft: Draft, seed: int, nominal: ComposedModel, repaired: ComposedModel, oracle: list[float] | None) -> dict[str, Any]:
    """`clean` and `noisy`: [E_nominal, E_repaired, E_oracle] each."""
    rng = np.random.default_rng([seed, 1])
    s = draft.scale
    steps = s.n if any(m.name in TIMED for m in draft.missing) else min(STEPS, s.n)
    steps = min(steps, 5000)
    grid = s.parts * np.arange(steps + 1)
    law = draft.law if draft.law in {"holds", "sines", "ramps", "human"} else "holds"
    commands = open_loop(rng, s.plant, law, s.dt * np.arange(steps + 1), s.ranges, s.pace, s.speed)
    quiet = Noise("none", np.zeros(len(s.plant.states)))
    x0 = [0.0] * len(s.plant.states)
    run = record(draft.world(), grid, grid, commands, quiet, x0, rng)
    ahead = max(1, min(round(HORIZON_S / s.dt), steps // 4))
    starts = np.unique(np.linspace(0, steps - ahead, 60).astype(int))
    way = np.sqrt(np.mean((run.y[starts + ahead] - run.y[starts]) ** 2, axis=0))
    way = np.maximum(way, 1e-3 * float(np.max(way)) + 1e-9)
    found = [_rollouts(model, run.y, run.u, starts, ahead) for model in (nominal, repaired)]
    floor = np.zeros(len(way)) if oracle is None else np.array(oracle)
    clean = [_size(e, way) for e in (*found, np.zeros(len(way)))]
    noisy = [_size(np.hypot(e, floor), way) for e in (*found, np.zeros(len(way)))]
    return {"clean": clean, "noisy": noisy}


def _size(e: Array, way: Array) -> float:
    return float(np.sqrt(np.sum((e / way) ** 2)))


def _rollouts(model: ComposedModel, y: Array, u: Array, starts: NDArray[np.int64], ahead: int) -> Array:
    """(nx,) rms errors at the ends. Hidden states run along the whole drive, from rest."""
    acting = []
    hidden = model.at_rest(1)
    for k in range(len(y) - 1):
        mean, end, hidden = model.act(u[k : k + 1], hidden)
        acting.append((mean, end))
    x = y[starts].copy()
    for step in range(ahead):
        mean = np.concatenate([acting[k + step][0] for k in starts])
        end = np.concatenate([acting[k + step][1] for k in starts])
        same = all(a is b for a, b in (acting[k + step] for k in starts))
        x = model.advance(x, mean, mean if same else end)
    return np.asarray(np.sqrt(np.mean(model.difference(y[starts + ahead].copy(), x) ** 2, axis=0)))
