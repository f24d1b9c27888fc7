"""A joint under a position controller, with the torque that was measured in the input's column.

The controller runs at 1 kHz on an encoder, follows a motion that repeats, and knows nothing of friction. The torque is that of the motor's
current: it acts as the controller commands it, and is recorded at the samples with noise and rounding. The model has the inertia, and lacks
viscous and dry friction, which may differ by direction.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trace_sets import plants
from trace_sets.excitation import Controller, Range
from trace_sets.making import Draft, Missing, common, recording_of
from trace_sets.noise import Noise
from trace_sets.recording import Run, TraceSet, record
from trace_sets.same import accepted, alternatives
from trace_sets.scale import Scale, log_uniform
from trace_sets.world import Start, rollout_errors

Array = NDArray[np.float64]
Rng = np.random.Generator

LOOP_S = 0.001
"""Step of the controller."""
RATES = (100.0, 125.0, 200.0, 250.0, 500.0, 1000.0)
LEAST_PARTS = 8
LONGEST = 12_000
"""Samples."""
RATIO = 3.0
TRIES = 6
FRICTION = ("none", "viscous", "coulomb", "both", "coulomb_by_direction", "both_by_direction")


def measured_torque(name: str, seed: int, rng: Rng) -> TraceSet:
    """Friction that matters, or none in a fifth of the sets."""
    kind = str(rng.choice(FRICTION, p=[0.2, 0.15, 0.15, 0.25, 0.1, 0.15]))
    seen = rng.random() < 0.7
    size = 1.0
    for _ in range(TRIES):
        draft, run, largest = _driven(rng, kind, size)
        errors = rollout_errors(run.starts, draft.nominal())
        if kind == "none" or errors.ratio >= RATIO:
            break
        size = min(1.5 * size, 2.5)
    noise = log_uniform(rng, 0.002, 0.02) * float(np.std(run.u))
    quantum = largest / 2.0 ** int(rng.integers(9, 14))
    torque = np.round((run.u + noise * rng.standard_normal(run.u.shape)) / quantum) * quantum
    rows = np.searchsorted(run.t_u, run.t + 1e-9, side="right") - 1
    recording = recording_of(rng, draft, [Run(run.t, run.y, run.t, torque[rows])])
    recording.unseen = () if seen else ("qd",)
    expect = {0: "clean", 1: "one", 2: "pair"}[len(draft.missing)]
    truth = {"expect": expect, **common(draft, errors), "kind": kind, "close": True}
    truth |= {"accepted": accepted(draft), "alternatives": alternatives(draft), "torque_noise": noise, "quantum": quantum}
    return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)


def _driven(rng: Rng, kind: str, size: float) -> tuple[Draft, Run, float]:
    """A joint, its run, and the torque at which its sensor ends."""
    rate = float(rng.choice(RATES))
    dt = 1.0 / rate
    loops = round(dt / LOOP_S)
    parts = loops * max(2, LEAST_PARTS // loops)
    inertia = round(log_uniform(rng, 0.01, 20.0), 4)
    reach, period = float(rng.uniform(0.3, 1.5)), float(rng.uniform(1.2, 4.0))
    repeats = int(rng.integers(3, 9))
    n = min(round(period * repeats * rate), LONGEST)
    goal = _motion(rng, reach, period)
    time = np.arange(0.0, period, 0.005)
    speed = float(np.max(np.abs(np.gradient(np.array([goal(t)[0] for t in time]), 0.005))))
    push = inertia * float(np.max(np.abs([goal(t)[2] for t in time])))
    missing = _friction(rng, kind, size, push, speed)
    most = 2.0 * push + sum(abs(v) * (speed if m.name.startswith("viscous") else 1.0) for m in missing for v in m.p.values())
    plant = plants.joint(inertia)
    scale = Scale(plant, round(dt, 6), parts, n, (Range(-push, push),), speed, 0.0, period / 8.0)
    encoder = log_uniform(rng, 1e-6, 5e-5) * reach
    noise = Noise("white", np.array([encoder, log_uniform(rng, 5e-4, 5e-3) * speed]))
    draft = Draft(scale, noise, "position_loop", "grid", missing, whole=True)
    follow = _loop(rng, inertia, goal, most, encoder)
    rows = parts * np.arange(n + 1)
    orders = parts // loops * np.arange(n * loops + 1)
    ahead = max(1, round(0.5 * rate))
    # the controller reads its own sensors, not the recording's samples: rows for it are all orders
    fine = np.union1d(rows, orders)
    run = record(
        draft.world(), fine, orders, follow, Noise("none", np.zeros(2)), [goal(0.0)[0], 0.0], rng, ahead=loops * ahead, rollouts=14
    )
    at = np.searchsorted(fine, rows)
    y = run.y[at] + noise.errors(rng, len(at))
    ends = noise.errors(rng, 2 * len(run.starts)).reshape(-1, 2, 2)
    starts = [
        Start(b.moment, (np.array(b.y) + e[0]).tolist(), b.until, (np.array(b.y_end) + e[1]).tolist())
        for b, e in zip(run.starts, ends, strict=True)
    ]
    return draft, Run(run.t[at], y, run.t_u, run.u, starts), most


def _motion(rng: Rng, reach: float, period: float) -> Any:
    """t -> position, speed, acceleration of a sum of harmonics, or of smooth moves there and back with rests. From rest at t = 0."""
    if rng.random() < 0.5:
        order = np.arange(1, int(rng.integers(3, 6)))
        size = reach * rng.uniform(-1.0, 1.0, len(order)) / order
        rate = math.tau * order / period

        def harmonics(t: float) -> tuple[float, float, float]:
            c, s = np.cos(rate * t), np.sin(rate * t)
            return float(np.sum(size * (1.0 - c))), float(np.sum(size * rate * s)), float(np.sum(size * rate**2 * c))

        return harmonics
    move = float(rng.uniform(0.25, 0.45)) * period

    def there_and_back(t: float) -> tuple[float, float, float]:
        phase = t % period
        back = phase >= 0.5 * period
        share = min((phase - 0.5 * period if back else phase) / move, 1.0)
        q = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        v = 30.0 * share**2 * (1.0 - share) ** 2 / move
        a = 60.0 * share * (1.0 - share) * (1.0 - 2.0 * share) / move**2
        return (reach * (1.0 - q), -reach * v, -reach * a) if back else (reach * q, reach * v, reach * a)

    return there_and_back


def _friction(rng: Rng, kind: str, size: float, push: float, speed: float) -> tuple[Missing, ...]:
    """Torques in proportion to that which accelerates the joint."""
    viscous = Missing("viscous_friction", "qd", {"coefficient": size * float(rng.uniform(0.15, 0.8)) * push / speed})
    force, ratio = size * float(rng.uniform(0.15, 0.8)) * push, float(np.exp(rng.uniform(0.15, 0.6) * rng.choice([-1.0, 1.0])))
    two = {"force_positive": force * math.sqrt(ratio), "force_negative": force / math.sqrt(ratio)}
    dry = Missing("coulomb_friction", "qd", two if kind.endswith("by_direction") else {"force": force})
    return {"none": (), "viscous": (viscous,), "both": (viscous, dry), "both_by_direction": (viscous, dry)}.get(kind, (dry,))


def _loop(rng: Rng, inertia: float, goal: Any, most: float, encoder: float) -> Controller:
    """Proportional and derivative action with feedforward of the acceleration, on an encoder of its own resolution; clipped."""
    fast = math.tau * float(rng.uniform(3.0, 10.0))
    share = float(rng.uniform(0.0, 1.0))

    def follow(t: float, y: list[float]) -> list[float]:
        q, v, a = goal(t)
        seen = round(y[0] / encoder) * encoder
        return [min(max(inertia * (share * a + fast * fast * (q - seen) + 1.6 * fast * (v - y[1])), -2.0 * most), 2.0 * most)]

    return follow
