"""Families of sets. Each is a function of (family, seed): the same pair gives the same bytes, whatever else is made.

TUNING    seeds that the tracer's authors may look at and tune on
UNTOUCHED seeds that nobody looks at set by set; a bench on them is what the docs state

clean, clean_closed, clean_coloured, clean_outliers, clean_jittered, clean_student, clean_quantised
one      one effect of the library that matters (ratio >= 1.5)         weak     one that hardly does (1.1 to 1.5)
outside  an effect that the library does not have
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from trace_sets import draws, outside
from trace_sets.making import EXACT, Draft, Missing, draw_law, draw_layout, draw_missing, draw_noise, draw_pose_rule, realise
from trace_sets.recording import TraceSet
from trace_sets.same import accepted
from trace_sets.scale import PLANTS, Scale, draw_scale
from trace_sets.world import Rollouts

Rng = np.random.Generator

TUNING = range(1_000_000)
UNTOUCHED = range(1_000_000, 2_000_000)

STRONG = 1.5
WEAK = 1.1
"""Ratios of the nominal model's error over the oracle's from which an effect matters, and from which it is there at all."""

TRIES = 14

Family = Callable[[str, int, Rng], TraceSet]


def make(family: str, seed: int) -> TraceSet:
    """One set. Raises KeyError for an unknown family."""
    return FAMILIES[family](family, seed, np.random.default_rng([seed, zlib.crc32(family.encode())]))


def _common(draft: Draft, errors: Rollouts | None) -> dict[str, Any]:
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


def _runs(rng: Rng, n: int) -> int:
    return int(rng.choice([1, 2, 3, 6], p=[0.8, 0.08, 0.06, 0.06])) if n >= 600 else 1


def _clean(law: str, *, closed: float = 0.15, layout: str | None = None) -> Family:
    def family(name: str, seed: int, rng: Rng) -> TraceSet:
        s = draw_scale(rng)
        rule = draw_pose_rule(rng, s) if layout not in {"jitter", "irregular", "other"} or not s.plant.pose else {"declared": (EXACT,)}
        shape = layout or draw_layout(rng, euler=bool(rule.get("euler")), plain=0.8)
        draft = Draft(s, draw_noise(rng, s, law), draw_law(rng, closed=closed), shape, runs=_runs(rng, s.n), **rule)
        recording, errors = realise(rng, draft)
        return TraceSet(name, seed, recording, draft.model(), {"expect": "clean", **_common(draft, errors)}, draft=draft)

    return family


def _jittered(name: str, seed: int, rng: Rng) -> TraceSet:
    return _clean("white", layout=str(rng.choice(["jitter", "irregular", "other", "async", "late"])))(name, seed, rng)


def _one(low: float, high: float, effect: str | None = None) -> Family:
    """One effect whose ratio lies in [low, high): drawn again, larger or smaller, until it does."""

    def family(name: str, seed: int, rng: Rng) -> TraceSet:
        size = float(np.exp(rng.uniform(-1.0, 0.7))) if low >= STRONG else 0.3
        for attempt in range(TRIES):
            if attempt in {0, 5, 10}:
                s, chosen = _robot_for(rng, effect)
            draft = _draft_with(rng, s, (draw_missing(rng, s, chosen, size),))
            recording, errors = realise(rng, draft)
            ratio = errors.ratio if errors else 1.0
            if low <= ratio < high:
                break
            size = min(max(size * (2.0 if ratio < low else 0.45), 0.003), 4.0)
        truth = {"expect": "one", **_common(draft, errors), "accepted": accepted(draft)}
        return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)

    return family


def _robot_for(rng: Rng, effect: str | None) -> tuple[Scale, str]:
    """A robot, and an effect for it: effects alike often, whatever robots have them."""
    everything = sorted({n for p in PLANTS for n in draws.names(_plant(p))})
    chosen = effect or str(rng.choice(everything))
    while True:
        s = draw_scale(rng)
        if chosen not in draws.names(s.plant):
            continue
        if chosen == "input_gain_asymmetry" and all(r.low >= 0.0 for r in s.ranges):
            continue
        if chosen == "integration_scheme" and s.dt < 0.02:
            continue
        return s, chosen


def _plant(name: str) -> Any:
    return draw_scale(np.random.default_rng(0), (name,)).plant


def _draft_with(rng: Rng, s: Scale, missing: tuple[Missing, ...], **more: Any) -> Draft:
    scheme = any(m.name == "integration_scheme" for m in missing)
    rule = {} if scheme else draw_pose_rule(rng, s)
    law = str(rng.choice(["white", "white", "white", "white", "coloured", "student", "outliers", "quantised"]))
    shape = "grid" if scheme else draw_layout(rng, euler=bool(rule.get("euler")), plain=0.7)
    return Draft(s, draw_noise(rng, s, law), draw_law(rng), shape, missing, runs=_runs(rng, s.n), **rule, **more)


def _outside(name: str, seed: int, rng: Rng) -> TraceSet:
    size = float(np.exp(rng.uniform(-0.3, 0.7)))
    kind = str(rng.choice(list(outside.KINDS)))
    for attempt in range(TRIES):
        if attempt in {0, 5, 10}:
            s = draw_scale(rng, outside.KINDS[kind].plants)
        effect, tokens, told = outside.KINDS[kind].draw(rng, s, size)
        draft = _draft_with(rng, s, (), outside=(effect,), extra={"kind": kind, "values": told})
        recording, errors = realise(rng, draft)
        ratio = errors.ratio if errors else 1.0
        if ratio >= STRONG:
            break
        size = min(size * 1.8, 5.0)
    truth = {"expect": "outside", **_common(draft, errors), "depends_on": sorted(tokens)}
    return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)


FAMILIES: dict[str, Family] = {
    "clean": _clean("white"),
    "clean_closed": _clean("white", closed=1.0),
    "clean_coloured": _clean("coloured"),
    "clean_outliers": _clean("outliers"),
    "clean_student": _clean("student"),
    "clean_quantised": _clean("quantised"),
    "clean_jittered": _jittered,
    "one": _one(STRONG, 1e9),
    "weak": _one(WEAK, STRONG),
    "outside": _outside,
}
