"""Families of sets. Each is a function of (family, seed): the same pair gives the same bytes, whatever else is made.

TUNING    seeds that the tracer's authors may look at and tune on
UNTOUCHED seeds that nobody looks at set by set; a bench on them is what the docs state

clean...        nothing is missing: white noise, closed loop, poor excitation; coloured, heavy-tailed, quantised noise; odd stamps
one, weak       one effect of the library that matters (ratio >= 1.5), or hardly does (1.1 to 1.5)
pair            two effects, each of which matters beside the other
outside         an effect that the library does not name, of a kind that the tracer's unnamed nonlinearities know (in-sample by kind)
unmeasured      one effect that matters, and no speed is measured
tie             not separable, by how the robot was driven
fault, bad      measurements that are wrong in places; input from which nothing can be traced
tiny, long      20 to 120 steps; 50 000 to 100 000 steps
late_heading, late_speed, measured_torque, position_faults, rounded, same_place, between_samples, hidden_gain, newer
                as logs of real robots are, and the library's newer effects (log_kinds.py)
unopened_...    effects of no library, and another robot; not to be opened by whoever changes the tracer (unopened.py)
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from trace_sets import draws, outside
from trace_sets.bad_inputs import bad
from trace_sets.confounded import confounded
from trace_sets.excitation import LAWS
from trace_sets.faulty import faulty
from trace_sets.layouts import OFF_GRID, ON_GRID, draw_layout, odd_layout
from trace_sets.log_kinds import LOG_KINDS
from trace_sets.making import (
    EXACT,
    Draft,
    Missing,
    common,
    draw_law,
    draw_missing,
    draw_noise,
    draw_pose_rule,
    drive,
    realise,
    recording_of,
)
from trace_sets.recording import TraceSet
from trace_sets.same import accepted, alternatives, share_a_name
from trace_sets.scale import PLANTS, Scale, draw_scale, log_uniform
from trace_sets.sizing import HARDLY, MATTERS, STRONG, Band, sized
from trace_sets.unopened import UNOPENED
from trace_sets.world import World, rollout_errors

Rng = np.random.Generator

TUNING = range(1_000_000)
UNTOUCHED = range(1_000_000, 2_000_000)

BESIDE = 1.3
"""Ratio by which an effect of a pair shows beside the other."""

LARGE = 5000
"""Steps from which on a set is not drawn many times over."""

TRIES = 14

PUSHES = {"input_bias", "constant_disturbance", "input_coupling"}
"""With one of these an open loop of masses ends kilometres away: they are mostly driven in closed loop."""

Family = Callable[[str, int, Rng], TraceSet]


def make(family: str, seed: int) -> TraceSet:
    """One set. Raises KeyError for an unknown family."""
    return FAMILIES[family](family, seed, np.random.default_rng([seed, zlib.crc32(family.encode())]))


def _runs(rng: Rng, n: int) -> int:
    return int(rng.choice([1, 2, 3, 6], p=[0.8, 0.08, 0.06, 0.06])) if n >= 600 else 1


def _clean(law: str, *, closed: float = 0.15, odd: bool = False, poor: bool = False, least: int = 20, most: int | None = None) -> Family:
    def family(name: str, seed: int, rng: Rng) -> TraceSet:
        s = draw_scale(rng, n=int(log_uniform(rng, least, most)) if most else None)
        layout = odd_layout(rng, s.plant) if odd else ""
        rule = _arcs(s) if layout in OFF_GRID else draw_pose_rule(rng, s)
        layout = layout or str(rng.choice(["grid", *ON_GRID], p=[0.82, 0.06, 0.06, 0.06]))
        asked = _poorly(rng, s) if poor else None
        shown = "poor" if poor else draw_law(rng, closed=closed)
        draft = Draft(s, draw_noise(rng, s, law), shown, layout, runs=_runs(rng, s.n), asked=asked, **rule)
        recording, errors = realise(rng, draft)
        return TraceSet(name, seed, recording, draft.model(), {"expect": "clean", **common(draft, errors)}, draft=draft)

    return family


def _arcs(s: Scale) -> dict[str, Any]:
    return {"declared": (EXACT,)} if s.plant.pose else {}


def _poorly(rng: Rng, s: Scale) -> Callable[[Rng, Any], Any]:
    """Each input constant, or between two values, or at rest for most of the time."""
    kinds = rng.choice(["constant", "two", "rare"], len(s.ranges)) if s.plant.pose else ["rare"] * len(s.ranges)
    values = [r.size * float(rng.uniform(0.3, 1.0)) for r in s.ranges]

    def asked(rng: Rng, t: Any) -> Any:
        columns = []
        for r, kind, value in zip(s.ranges, kinds, values, strict=True):
            holds = LAWS["holds"](rng, t, 2.0 * s.pace)
            two = np.where(holds > 0.0, value, r.low if r.low >= 0.0 else -value)
            columns.append(
                np.full(len(t), value) if kind == "constant" else two if kind == "two" else value * holds * (np.abs(holds) > 0.85)
            )
        return np.column_stack(columns)

    return asked


def _one(band: Band, *, least: int | None = None, most: int | None = None) -> Family:
    """One effect whose ratio lies in the band. least, most: steps."""

    def family(name: str, seed: int, rng: Rng) -> TraceSet:
        steps = int(log_uniform(rng, least, most)) if least and most else None
        chosen = [_effect(rng)] * 2 + [_effect(rng), _effect(rng)]

        def draw(number: int, rng: Rng, size: float, loud: float) -> Draft:
            s = _robot_for(rng, chosen[number], steps)
            return _draft_with(rng, s, (draw_missing(rng, s, chosen[number], size),), loud=loud)

        long = steps is not None and steps > LARGE
        draft, recording, errors = sized(rng, draw, band, **({"steps": 2, "robots": 1} if long else {}))
        truth = {"expect": "one", **common(draft, errors), "accepted": accepted(draft), "alternatives": alternatives(draft)}
        return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)

    return family


def _unmeasured(name: str, seed: int, rng: Rng) -> TraceSet:
    """Speeds (of masses, wheels, a car) have no column, and an effect matters; the ratio is that of a robot that measures them, too."""

    def draw(number: int, rng: Rng, size: float, loud: float) -> Draft:
        s = draw_scale(rng, ("joint", "double_integrator", "joint", "differential_drive", "bicycle"))
        known = [n for n in draws.names(s.plant) if n not in {"sensor_offset", "integration_scheme"}]
        return _draft_with(rng, s, (draw_missing(rng, s, str(rng.choice(known)), size),), loud=0.3 * loud)

    draft, recording, errors = sized(rng, draw, MATTERS)
    plant = draft.scale.plant
    recording.unseen = plant.states[3:] if plant.pose else plant.states[plant.axes :]
    truth = {"expect": "one", **common(draft, errors), "accepted": accepted(draft), "alternatives": alternatives(draft)}
    return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)


def _pair(name: str, seed: int, rng: Rng) -> TraceSet:
    """Two effects: the nominal model is off by 1.5 at least, and so it is by 1.3 if only one of them is missing."""
    sizes = [float(np.exp(rng.uniform(-1.2, 0.5))) for _ in range(2)]
    for attempt in range(TRIES):
        if attempt % 4 == 0:
            first = _effect(rng)
            s = _robot_for(rng, first)
            second = str(rng.choice([n for n in draws.names(s.plant) if n not in {"integration_scheme", first}]))
        missing = tuple(draw_missing(rng, s, n, size) for n, size in zip((first, second), sizes, strict=True))
        draft = _draft_with(rng, s, missing)
        if share_a_name(draft):
            continue
        runs, starts = drive(rng, draft)
        if not starts:
            continue
        alone = [rollout_errors(starts, _lacking(draft, m)).ratio for m in missing]
        errors = rollout_errors(starts, draft.nominal())
        recording = recording_of(rng, draft, runs)
        if min(alone) >= BESIDE and errors.ratio >= STRONG:
            break
        sizes = [min(size * (1.8 if r < BESIDE else 1.0), 4.0) for size, r in zip(sizes, alone, strict=True)]
    told = common(draft, errors) | {"alone": alone, "accepted": accepted(draft), "alternatives": alternatives(draft)}
    return TraceSet(name, seed, recording, draft.model(), {"expect": "pair", **told}, draft=draft)


def _lacking(draft: Draft, one: Missing) -> World:
    """The robot without one of its effects."""
    rest = replace(draft, missing=tuple(m for m in draft.missing if m is not one), euler=draft.euler or one.name == "integration_scheme")
    return rest.world()


def _effect(rng: Rng) -> str:
    """Effects alike often, whatever robots have them."""
    return str(rng.choice(sorted({n for p in PLANTS for n in draws.names(_plant(p))})))


def _robot_for(rng: Rng, chosen: str, steps: int | None = None) -> Scale:
    """A robot that may have the effect."""
    while True:
        s = draw_scale(rng, n=steps)
        if chosen not in draws.names(s.plant):
            continue
        if chosen == "input_gain_asymmetry" and all(r.low >= 0.0 for r in s.ranges):
            continue
        if chosen == "integration_scheme" and s.dt < 0.02:
            continue
        return s


def _plant(name: str) -> Any:
    return draw_scale(np.random.default_rng(0), (name,)).plant


def _draft_with(rng: Rng, s: Scale, missing: tuple[Missing, ...], loud: float = 1.0, **more: Any) -> Draft:
    scheme = any(m.name == "integration_scheme" for m in missing)
    rule = {} if scheme else draw_pose_rule(rng, s)
    law = str(rng.choice(["white", "white", "white", "white", "coloured", "student", "outliers", "quantised"]))
    shape = "grid" if scheme else draw_layout(rng, s.plant, euler=bool(rule.get("euler")), plain=0.7)
    pushed = not s.plant.pose and any(m.name in PUSHES for m in missing)
    return Draft(
        s,
        draw_noise(rng, s, law, loud=loud),
        draw_law(rng, closed=0.9 if pushed else 0.2 if s.plant.pose else 0.45),
        shape,
        missing,
        runs=_runs(rng, s.n),
        **rule,
        **more,
    )


def _outside(name: str, seed: int, rng: Rng) -> TraceSet:
    kind = str(rng.choice(list(outside.KINDS)))

    def draw(number: int, rng: Rng, size: float, loud: float) -> Draft:
        s = draw_scale(rng, outside.KINDS[kind].plants)
        effect, true, told = outside.KINDS[kind].draw(rng, s, size)
        return _draft_with(rng, s, (), loud=loud, outside=(effect,), extra={"kind": kind, "values": told, "depends_on": sorted(true)})

    draft, recording, errors = sized(rng, draw, MATTERS)
    return TraceSet(name, seed, recording, draft.model(), {"expect": "outside", **common(draft, errors)}, draft=draft)


FAMILIES: dict[str, Family] = {
    "clean": _clean("white"),
    "clean_closed": _clean("white", closed=1.0),
    "clean_coloured": _clean("coloured"),
    "clean_outliers": _clean("outliers"),
    "clean_student": _clean("student"),
    "clean_quantised": _clean("quantised"),
    "clean_jittered": _clean("white", odd=True),
    "clean_poor": _clean("white", poor=True),
    "one": _one(MATTERS),
    "weak": _one(HARDLY),
    "pair": _pair,
    "outside": _outside,
    "unmeasured": _unmeasured,
    "tie": confounded,
    "fault": faulty,
    "bad": bad,
    "tiny": _one(MATTERS, least=20, most=120),
    "tiny_clean": _clean("white", most=120),
    "long": _one(MATTERS, least=50_000, most=100_000),
    "long_clean": _clean("white", closed=0.0, least=50_000, most=100_000),
    **LOG_KINDS,
    **UNOPENED,
}
