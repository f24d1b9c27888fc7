"""Families whose true effect is in no library: `unopened_NN`, and another robot's, `unopened_robot_...`.

Made from a description of the tracer's task alone (the effects' names, the shape of a recording), by somebody who had not read the tracer.
NEVER TO BE OPENED by whoever changes the tracer: neither this file, nor unopened_*.py and vessel*.py, nor the sets one by one.
The bench counts them and shows no set of them. Once opened they are in-sample, and others must be made.

    unopened_NN             a kind of model error that real robots have, on the bench's own robots
    unopened_robot_NN       the same, on a vessel
    unopened_robot_clean    nothing is missing on the vessel: white noise; ..._coloured, ..._closed
    unopened_robot_named_N  an effect that the library has, on the vessel

Sizes are drawn from what is usual on real robots, not until the tracer sees them. A robot and its noise are drawn again until the nominal
model's error over a second is STRONG times the oracle's: else nothing would be wrong with answering `none`. Each truth has

    words       what is true         depends_on   tokens that the missing effect depends on
    parameters  in SI units          shares       of each state, share of the one-step mean square error of the nominal model that the
                                                  missing effect makes, d² / (d² + e²): d its rms over a step, e the oracle's error
    share       the largest of them
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trace_sets.layouts import draw_layout
from trace_sets.making import EXACT, Draft, Missing, common, draw_law, draw_noise, drive, realise
from trace_sets.recording import TraceSet
from trace_sets.same import accepted, alternatives
from trace_sets.scale import Scale, draw_scale, log_uniform
from trace_sets.sizing import STRONG
from trace_sets.unopened_kinds import Kind
from trace_sets.unopened_masses import MASSES
from trace_sets.unopened_poses import POSES
from trace_sets.vessel import VESSEL, autopilot, draw_vessel, open_thrusts, vessel_noise
from trace_sets.world import Start, rollout_errors

Array = NDArray[np.float64]
Rng = np.random.Generator
Family = Callable[[str, int, Rng], TraceSet]
Draw = Callable[[Rng], Draft]

TRIES = 40
"""Robots that are drawn until the effect matters on one."""

ONE_STEP_ROLLOUTS = 300
"""Of which the one-step share is computed."""

NOISES = ("white", "white", "white", "white", "coloured", "student", "outliers", "quantised")
"""Noise models; repeated entries are drawn more often."""


def one_step_shares(rng: Rng, draft: Draft) -> dict[str, float]:
    """By state, the share of the one-step mean square error that the missing effect makes. rng: as it was when the set was driven."""
    _, starts = drive(rng, draft, ahead=1, rollouts=ONE_STEP_ROLLOUTS)
    oracle, effect = rollout_errors(starts, draft.nominal()).oracle, one_step_effect(starts, draft)
    whole = effect**2 + oracle**2
    each = np.divide(effect**2, whole, out=np.zeros(len(whole)), where=whole > 0.0)
    return {name: float(f"{share:.4g}") for name, share in zip(draft.scale.plant.states, each, strict=True)}


def one_step_effect(starts: list[Start], draft: Draft) -> Array:
    """(nx,) rms of what the missing effect changes in a step from what was measured."""
    ends = []
    for start in starts:
        moment = start.moment.copy()
        moment.x = moment.world.true(list(start.y), moment.t)
        while moment.i < start.until:
            moment.part()
        ends.append(replace(start, y_end=moment.read()))
    return rollout_errors(ends, draft.nominal()).nominal


def _mattering(name: str, seed: int, rng: Rng, draw: Draw, expect: Callable[[Draft], dict[str, Any]]) -> TraceSet:
    """The first robot on which the effect matters; after TRIES the last one, whose truth states how small it is."""
    for _ in range(TRIES):
        draft = draw(rng)
        before = copy.deepcopy(rng)
        recording, errors = realise(rng, draft)
        if errors and errors.ratio >= STRONG:
            break
    each = one_step_shares(before, draft)
    truth = {**common(draft, errors), **expect(draft), "shares": each, "share": max(each.values())}
    return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)


def _outside(draft: Draft) -> dict[str, Any]:
    return {"expect": "outside"}


def _named(draft: Draft) -> dict[str, Any]:
    return {"expect": "one", "accepted": accepted(draft), "alternatives": alternatives(draft)}


def draw_kind(rng: Rng, kind: Kind) -> Draft:
    """One of the bench's robots with this kind of error, driven and seen as the others are; it moves on arcs, and the model says so."""
    size = dict(kind.size)
    if "rate" in size:
        size["rate"] = float(rng.choice(size["rate"]))
    if "steps" in size:
        size["n"] = int(log_uniform(rng, *size.pop("steps")))
    s = draw_scale(rng, kind.robots, **size)
    drawn = kind.draw(rng, s)
    law = drawn.law or draw_law(rng, closed=0.2 if s.plant.pose else 0.45)
    noise = draw_noise(rng, s, str(rng.choice(NOISES)))
    layout = draw_layout(rng, s.plant, euler=False, plain=0.7)
    extra = {"words": drawn.words, "depends_on": sorted(set(drawn.depends_on)), "parameters": drawn.values}
    declared = (EXACT,) if s.plant.pose else ()
    return Draft(s, noise, law, layout, outside=(drawn.effect,), declared=declared, extra=extra)


def _of_kind(kind: Kind) -> Family:
    def family(name: str, seed: int, rng: Rng) -> TraceSet:
        return _mattering(name, seed, rng, lambda r: draw_kind(r, kind), _outside)

    return family


def _on_vessel(rng: Rng, s: Scale, noise: str, law: str, **more: Any) -> Draft:
    """excitation: closed loop, or one of an open loop."""
    commands = autopilot(s) if law == "closed" else open_thrusts(s, law)
    return Draft(s, vessel_noise(rng, s, noise), law, asked=commands, **more)


def _vessel_law(rng: Rng) -> str:
    return "closed" if rng.random() < 0.4 else str(rng.choice(["holds", "sines", "human"]))


def draw_vessel_kind(rng: Rng, kind: Kind) -> Draft:
    """The vessel with one of its own kinds of error."""
    s = draw_vessel(rng)
    drawn = kind.draw(rng, s)
    extra = {"words": drawn.words, "depends_on": sorted(set(drawn.depends_on)), "parameters": drawn.values}
    noise = str(rng.choice(["white", "white", "coloured"]))
    return _on_vessel(rng, s, noise, drawn.law or _vessel_law(rng), outside=(drawn.effect,), extra=extra)


def _of_vessel_kind(kind: Kind) -> Family:
    def family(name: str, seed: int, rng: Rng) -> TraceSet:
        return _mattering(name, seed, rng, lambda r: draw_vessel_kind(r, kind), _outside)

    return family


def _delay(rng: Rng, s: Scale) -> Missing:
    """Radio link and motor controllers."""
    return Missing("input_delay", "*", {"delay": float(rng.uniform(0.15, 0.6))})


def _lag(rng: Rng, s: Scale) -> Missing:
    """One thruster spins up slowly."""
    return Missing("input_lag", str(rng.choice(s.plant.inputs)), {"time_constant": float(rng.uniform(0.3, 1.2))})


def _astern(rng: Rng, s: Scale) -> Missing:
    """A propeller gives less thrust astern."""
    p = {"gain_positive": 1.0, "gain_negative": float(rng.uniform(0.5, 0.8))}
    return Missing("input_gain_asymmetry", str(rng.choice(s.plant.inputs)), p)


def _current(rng: Rng, s: Scale) -> Missing:
    """Of the water; measured speeds are those through it."""
    speed, to = float(rng.uniform(0.1, 0.4)), float(rng.uniform(0.0, 2.0 * np.pi))
    return Missing("constant_disturbance", "world", {"x": speed * float(np.cos(to)), "y": speed * float(np.sin(to))})


NAMED = (_delay, _lag, _astern, _current)


def draw_vessel_named(rng: Rng, missing: Callable[[Rng, Scale], Missing]) -> Draft:
    """The vessel with an effect of the library."""
    s = draw_vessel(rng)
    return _on_vessel(rng, s, str(rng.choice(["white", "white", "coloured"])), _vessel_law(rng), missing=(missing(rng, s),))


def _of_named(missing: Callable[[Rng, Scale], Missing]) -> Family:
    def family(name: str, seed: int, rng: Rng) -> TraceSet:
        return _mattering(name, seed, rng, lambda r: draw_vessel_named(r, missing), _named)

    return family


def _clean(name: str, seed: int, rng: Rng, *, noise: str, closed: bool) -> TraceSet:
    draft = _on_vessel(rng, draw_vessel(rng), noise, "closed" if closed else str(rng.choice(["holds", "sines", "human"])))
    recording, errors = realise(rng, draft)
    return TraceSet(name, seed, recording, draft.model(), {"expect": "clean", **common(draft, errors)}, draft=draft)


KINDS: dict[str, Family] = {f"unopened_{k:02}": _of_kind(kind) for k, kind in enumerate((*POSES, *MASSES), 1)}

ROBOT_KINDS: dict[str, Family] = {f"unopened_robot_{k:02}": _of_vessel_kind(kind) for k, kind in enumerate(VESSEL, 1)}

ROBOT_CLEAN: dict[str, Family] = {
    "unopened_robot_clean": partial(_clean, noise="white", closed=False),
    "unopened_robot_clean_coloured": partial(_clean, noise="coloured", closed=False),
    "unopened_robot_clean_closed": partial(_clean, noise="white", closed=True),
}

ROBOT_NAMED: dict[str, Family] = {f"unopened_robot_named_{k}": _of_named(missing) for k, missing in enumerate(NAMED, 1)}

UNOPENED: dict[str, Family] = KINDS | ROBOT_KINDS | ROBOT_CLEAN | ROBOT_NAMED
"""Numbers stand for the kinds, so that a table of the bench does not say what they are."""
