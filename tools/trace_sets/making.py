"""From a draft (which robot, what is missing, how it is driven and seen) to a recording with its ratio."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trace_sets import draws
from trace_sets.excitation import Controller, open_loop, tracker
from trace_sets.layouts import as_seen, lost, stamps, under_way
from trace_sets.newer_effects import newer_physics
from trace_sets.noise import Noise
from trace_sets.recording import Recording, Run, record
from trace_sets.scale import Scale, log_uniform
from trace_sets.world import Rollouts, Start, TruthEffect, World, rollout_errors

Array = NDArray[np.float64]
Rng = np.random.Generator

TIMED = {"input_gain_drift", "regime_change", "periodic_disturbance"}
"""Effects whose time counts from the recording's first stamp: that one must be there."""

HORIZON_S = 1.0
"""Of rollouts, as `s2r trace` has it by default."""

PAUSE_S = (1.0, 6.0)
"""Between the runs of one recording."""


@dataclass(frozen=True)
class Missing:
    """A library's effect that the model lacks."""

    name: str
    channel: str
    p: dict[str, Any]

    def told(self) -> dict[str, Any]:
        """As plain data."""
        return {"name": self.name, "channel": self.channel, "parameters": self.p}


@dataclass
class Draft:
    """euler: whether the truth itself moves by Euler's rule; declared: what the tracer's model has besides its nominal step;
    asked: a law of commands of its own; begin: the true state in which each run begins; whole: every sample reaches the file; extra: goes
    into the truth.
    """

    scale: Scale
    noise: Noise
    law: str
    layout: str = "grid"
    missing: tuple[Missing, ...] = ()
    outside: tuple[TruthEffect, ...] = ()
    euler: bool = False
    runs: int = 1
    declared: tuple[dict[str, Any], ...] = ()
    asked: Callable[[Rng, Array], Array | Controller] | None = None
    begin: Callable[[Rng], list[float]] | None = None
    together: bool = True
    whole: bool = False
    extra: dict[str, Any] = field(default_factory=dict)

    def world(self) -> World:
        """The robot."""
        plant = self.scale.plant
        named = [m for m in self.missing if m.name != "integration_scheme"]
        first = [m for m in named if m.name == "input_delay"]
        rest = [m for m in named if m.name != "input_delay"]
        effects = (*(newer_physics(plant, m.name, m.channel, m.p) for m in (*first, *rest)), *self.outside)
        return World(plant, self.scale.dt, self.scale.parts, effects, self.euler)

    def nominal(self) -> World:
        """What the tracer's model does."""
        scheme = any(m.name == "integration_scheme" for m in self.missing)
        return self.world().without_effects(euler=self.euler or scheme)

    def model(self) -> dict[str, Any]:
        """As a model TOML has it."""
        return {
            "name": self.scale.plant.file or self.scale.plant.name,
            "dt": self.scale.dt,
            "parameters": dict(self.scale.plant.parameters),
            "effects": [*self.declared],
        }


EXACT: dict[str, Any] = {"name": "integration_scheme", "channel": "*", "parameters": {"scheme": "exact"}}


def draw_noise(rng: Rng, s: Scale, law: str, level: float | None = None, loud: float = 1.0) -> Noise:
    """level: measurement noise over what moves in a second; loud: times all of the noise."""
    level = level if level is not None else log_uniform(rng, 2e-4, 2e-2)
    plant = s.plant
    sigma = []
    for name in plant.states:
        own = level * log_uniform(rng, 0.5, 2.0)
        if name == "theta":
            sigma.append(own)
        elif name.startswith("wheel"):
            sigma.append(own * s.speed / plant.parameters["wheel_radius"])
        else:
            sigma.append(own * s.speed)
    r = loud * np.array(sigma)
    kind: dict[str, Any] = {}
    if law == "student":
        kind = {"freedom": float(rng.uniform(2.5, 5.0))}
    elif law == "outliers":
        kind = {"outliers": float(rng.uniform(0.01, 0.05)), "far": log_uniform(rng, 5.0, 60.0)}
    elif law == "quantised":
        kind = {"quantum": r * log_uniform(rng, 1.0, 5.0)}
    push = s.ranges[0].size / plant.parameters.get("mass", 1.0)
    usual = loud * (np.array([s.speed, max(s.yaw, 0.3)]) if plant.pose else np.full(plant.axes, push))
    if law == "coloured":
        strong = log_uniform(rng, 0.003, 0.08) * np.exp(rng.uniform(-0.7, 0.7, len(usual)))
        kind |= {"push": strong * usual, "memory": log_uniform(rng, max(2.0 * s.dt, 0.02), max(0.5, 4.0 * s.dt))}
    elif rng.random() < 0.5:
        kind |= {"push": log_uniform(rng, 0.002, 0.05) * math.sqrt(0.033 / s.dt) * usual}
    return Noise(law, r, **kind)


def draw_law(rng: Rng, *, closed: float = 0.2) -> str:
    """A law of excitation; `closed` is the share of closed loops."""
    if rng.random() < closed:
        return "closed"
    return str(rng.choice(["holds", "sines", "ramps", "chirp", "human"], p=[0.4, 0.2, 0.12, 0.08, 0.2]))


def draw_pose_rule(rng: Rng, s: Scale) -> dict[str, Any]:
    """Whether the truth moves on arcs and the model says so (two thirds), or both move by Euler's rule."""
    if not s.plant.pose:
        return {}
    return {"declared": (EXACT,)} if rng.random() < 0.67 else {"euler": True}


def realise(rng: Rng, draft: Draft) -> tuple[Recording, Rollouts | None]:
    """Drives the draft's robot, and measures how far the nominal model goes wrong."""
    runs, starts = drive(rng, draft)
    return recording_of(rng, draft, runs), rollout_errors(starts, draft.nominal()) if starts else None


def drive(rng: Rng, draft: Draft, *, ahead: int | None = None, rollouts: int = 30) -> tuple[list[Run], list[Start]]:
    """Runs as measured, and begins of rollouts. ahead: rows of each, by default those of HORIZON_S."""
    s, world = draft.scale, draft.world()
    origin, runs, starts = 0.0, [], []
    for _ in range(draft.runs):
        n = max(s.n // draft.runs, 10)
        rows, orders = stamps(rng, draft.layout, s, n)
        commands = draft.asked(rng, s.dt / s.parts * orders) if draft.asked else asked(rng, draft, s.dt / s.parts * orders)
        x0 = draft.begin(rng) if draft.begin else _begin(rng, s)
        usual = max(1, min(round(HORIZON_S / (world.h * float(np.median(np.diff(rows))))), n // 4))
        how: dict[str, Any] = {"origin": origin, "ahead": ahead or usual, "rollouts": max(rollouts // draft.runs, 6)}
        run = record(world, rows, orders, commands, draft.noise, x0, rng, **how)
        origin += round(s.dt * n + rng.uniform(*PAUSE_S), 3)
        starts += run.starts
        runs.append(run)
    return runs, starts


def asked(rng: Rng, draft: Draft, t: Array) -> Array | Controller:
    """Commands of the draft's law at these stamps, or its controller."""
    s = draft.scale
    if draft.law == "closed":
        return tracker(rng, s.plant, s.ranges, max(s.pace, 8.0 * s.dt), s.speed, s.plant.parameters.get("mass", 1.0))
    return open_loop(rng, s.plant, draft.law, t, s.ranges, s.pace, s.speed)


def recording_of(rng: Rng, draft: Draft, runs: list[Run]) -> Recording:
    """What the file says: on some clock, with a number of digits."""
    s = draft.scale
    timed = any(m.name in TIMED for m in draft.missing)
    seen = [as_seen(rng, draft.layout, s, run) for run in runs]
    plain = draft.layout in {"grid", "async", "late"}
    if plain and len(runs) == 1 and s.n >= 200 and not timed and not draft.whole:
        chance = rng.random()
        seen = [lost(rng, s, seen[0])] if chance < 0.08 else [under_way(rng, seen[0])] if chance < 0.16 else seen
        draft.extra |= {"seen": "lost" if chance < 0.08 else "under_way"} if chance < 0.16 else {}
    shift = float(rng.choice([0.0, round(rng.uniform(0.0, 9e4), 3), 1.7e9 + round(rng.uniform(0.0, 1e6), 3)], p=[0.6, 0.25, 0.15]))
    digits = int(rng.choice([4, 5])) if s.dt >= 0.02 and rng.random() < 0.2 else 6
    shifted = [Run(run.t + shift, run.y, run.t_u + shift, run.u) for run in seen]
    return Recording(
        s.plant, shifted, digits=digits, figures=int(rng.choice([7, 9])), together=draft.together, wrap=bool(rng.random() < 0.85)
    )


def _begin(rng: Rng, s: Scale) -> list[float]:
    plant = s.plant
    if plant.pose:
        wide = min(2.0, s.speed * min(2.0 * s.pace, 0.25 * s.duration))
        place = [float(rng.uniform(-wide, wide)), float(rng.uniform(-wide, wide)), float(rng.uniform(-3.1, 3.1))]
        return [*place, *[0.0] * (len(plant.states) - 3)]
    return [*(float(rng.uniform(-0.5, 0.5)) * s.speed for _ in range(plant.axes)), *[0.0] * plant.axes]


def draw_missing(rng: Rng, s: Scale, name: str, size: float) -> Missing:
    """An effect with values."""
    channel, p = draws.draw(rng, name, s, size)
    return Missing(name, channel, p)


def common(draft: Draft, errors: Rollouts | None) -> dict[str, Any]:
    """What every truth holds."""
    s = draft.scale
    return {
        "robot": s.plant.name,
        "rate": round(1.0 / s.dt, 3),
        "n": s.n,
        "law": draft.law,
        "layout": draft.layout,
        "noise": draft.noise.law,
        "runs": draft.runs,
        "euler": draft.euler,
        "ratio": round(errors.ratio, 4) if errors else None,
        "oracle": errors.oracle.tolist() if errors else None,
        "effects": [m.told() for m in draft.missing],
        **draft.extra,
    }
