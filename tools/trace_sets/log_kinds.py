"""Families of recordings as the logs of real robots are, with an effect of the library or without one.

position_faults   positions of axes without speeds; outlying, frozen or jumping samples, or none
rounded           states in few digits: encoder ticks, or 2 to 4 decimals
same_place        many short runs from nearly one place, each with a noisy start
between_samples   commands that change between samples, in a table that has the last one in each row
hidden_gain       a closed loop hides an unknown gain, or the wrong sign, of an input
late_heading, late_speed, measured_torque, newer: in delayed.py, driven_axes.py, newer.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trace_sets import draws
from trace_sets.delayed import late_heading, late_speed
from trace_sets.driven_axes import measured_torque
from trace_sets.excitation import Controller, tracker
from trace_sets.faulty import spoilt
from trace_sets.making import EXACT, Draft, Missing, common, draw_law, draw_missing, draw_noise, drive, realise, recording_of
from trace_sets.newer import newer
from trace_sets.recording import Run, TraceSet
from trace_sets.same import accepted, alternatives
from trace_sets.scale import PLANTS, Scale, draw_scale, log_uniform
from trace_sets.sizing import Band, sized
from trace_sets.world import rollout_errors

Array = NDArray[np.float64]
Rng = np.random.Generator
Robot = Callable[[Rng], Scale]
Seen = Callable[[Rng, Scale, tuple[Missing, ...], float], Draft]
"""(rng, robot, what its model lacks, loudness of the noise) -> draft."""

CLEAN_SHARE = 0.4
SHOWS = Band(2.0, 1e9, 2.4, 30.0)
"""Nominal over oracle error of an effect."""


def _arcs(s: Scale) -> dict[str, Any]:
    return {"declared": (EXACT,)} if s.plant.pose else {}


def _effect(rng: Rng, s: Scale, without: set[str]) -> str:
    forward = all(r.low >= 0.0 for r in s.ranges)
    never = {"integration_scheme", *({"input_gain_asymmetry"} if forward else ())}
    return str(rng.choice([n for n in draws.names(s.plant) if n not in never | without]))


def _set(name: str, seed: int, rng: Rng, robot: Robot, seen: Seen, without: set[str]) -> TraceSet:
    """Nothing missing, or an effect that shows."""
    if rng.random() < CLEAN_SHARE:
        draft = seen(rng, robot(rng), (), 1.0)
        recording, errors = realise(rng, draft)
        return TraceSet(name, seed, recording, draft.model(), {"expect": "clean", **common(draft, errors)}, draft=draft)

    def draw(number: int, rng: Rng, size: float, loud: float) -> Draft:
        s = robot(rng)
        return seen(rng, s, (draw_missing(rng, s, _effect(rng, s, without), size),), loud)

    draft, recording, errors = sized(rng, draw, SHOWS)
    truth = {"expect": "one", **common(draft, errors), "accepted": accepted(draft), "alternatives": alternatives(draft), "close": True}
    return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)


def position_faults(name: str, seed: int, rng: Rng) -> TraceSet:
    """Speeds have no column. A third of the sets has no fault; a third of the others an effect besides."""
    kind = str(rng.choice(["none", "spike", "frozen", "offset_jump"], p=[0.34, 0.22, 0.22, 0.22]))
    with_effect = rng.random() < (0.5 if kind == "none" else 0.33)
    size = 1.0
    for _ in range(10):
        s = draw_scale(
            rng, ("joint", "double_integrator"), n=int(rng.uniform(500, 2000)), rate=float(rng.choice([20.0, 50.0, 100.0, 200.0]))
        )
        names = ("input_gain", "input_bias", "input_lag", "viscous_friction", "coulomb_friction")
        missing = (draw_missing(rng, s, str(rng.choice(names)), size),) if with_effect else ()
        law = "closed" if with_effect and missing[0].name == "input_bias" else str(rng.choice(["holds", "sines", "human", "closed"]))
        draft = Draft(s, draw_noise(rng, s, "white", float(10 ** rng.uniform(-3.7, -2.7))), law, "grid", missing, whole=True)
        runs, starts = drive(rng, draft)
        errors = rollout_errors(starts, draft.nominal())
        faults: list[dict[str, Any]] = []
        if kind != "none":
            plain = runs[0]
            runs[0], faults = spoilt(rng, kind, draft, plain)
        enough = kind != "frozen" or _moved(plain, runs[0], draft)
        if enough and (not missing or errors.ratio >= SHOWS.low):
            break
        size = min(1.4 * size, 3.0)
    recording = recording_of(rng, draft, runs)
    recording.unseen = s.plant.states[s.plant.axes :]
    truth = {**common(draft, errors), "kind": kind, "accepted": accepted(draft), "alternatives": alternatives(draft), "close": True}
    if kind == "none":
        truth |= {"expect": "one" if missing else "clean", "no_fault": ["spike", "frozen", "offset_jump", "inconsistent"]}
    else:
        truth |= {"expect": "fault_effect" if missing else "fault", "true_faults": faults}
    return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)


def _moved(plain: Run, spoilt_run: Run, draft: Draft) -> bool:
    """Whether the robot left by 20 standard deviations of the noise the place where its sensor froze."""
    off = np.abs(spoilt_run.y - plain.y)[:, : draft.scale.plant.axes]
    return bool(np.max(off / draft.noise.sigma[: draft.scale.plant.axes]) > 20.0)


def rounded(name: str, seed: int, rng: Rng) -> TraceSet:
    """The rounding is the larger part of the noise, or most of it."""
    ticks = rng.random() < 0.4
    decimals = int(rng.integers(2, 5))
    step = log_uniform(rng, 3e-4, 6e-3)
    share = log_uniform(rng, 0.05, 0.6)

    def seen(rng: Rng, s: Scale, missing: tuple[Missing, ...], loud: float) -> Draft:
        usual = draw_noise(rng, s, "white", step, loud=min(max(loud, 0.1), 10.0)).sigma
        quantum = usual if ticks else np.full(len(usual), 10.0**-decimals)
        noise = replace(draw_noise(rng, s, "white", 1e-9), law="quantised", sigma=share * quantum, quantum=quantum, push=np.zeros(0))
        pushed = bool(missing) and not s.plant.pose and missing[0].name in {"input_bias", "constant_disturbance", "input_coupling"}
        kind = {"kind": "ticks" if ticks else f"{decimals} decimals"}
        return Draft(s, noise, draw_law(rng, closed=0.9 if pushed else 0.3), "grid", missing, extra=kind, **_arcs(s))

    def robot(rng: Rng) -> Scale:
        return draw_scale(rng, n=int(log_uniform(rng, 400, 1000)), rate=float(rng.choice([10.0, 20.0, 30.303, 50.0, 100.0])))

    return _set(name, seed, rng, robot, seen, set())


def same_place(name: str, seed: int, rng: Rng) -> TraceSet:
    """Runs of one to five seconds. The robot is put back by hand (it begins elsewhere by some noise), or into a fixture."""
    runs = int(rng.integers(8, 41))
    scatter = 0.0 if rng.random() < 0.5 else log_uniform(rng, 0.5, 20.0)
    angle = float(rng.uniform(-3.0, 3.0))

    def robot(rng: Rng) -> Scale:
        rate = float(rng.choice([10.0, 20.0, 30.303, 50.0, 100.0]))
        each = max(rng.uniform(1.0, 5.0) * rate, 25.0)
        return draw_scale(rng, n=min(int(runs * each), 3000), rate=rate)

    def seen(rng: Rng, s: Scale, missing: tuple[Missing, ...], loud: float) -> Draft:
        noise = draw_noise(rng, s, str(rng.choice(["white", "white", "coloured"])), loud=loud)
        moved = 3 if s.plant.pose else s.plant.axes
        place = [0.3, -0.2, angle] if s.plant.pose else [0.1] * moved

        def begin(rng: Rng) -> list[float]:
            at = np.array(place) + scatter * noise.sigma[:moved] * rng.standard_normal(moved)
            return [*(float(v) for v in at), *[0.0] * (len(s.plant.states) - moved)]

        extra = {"kind": "fixture" if scatter == 0.0 else "by hand", "scatter": scatter}
        law = draw_law(rng, closed=0.15)
        return Draft(s, noise, law, "grid", missing, runs=runs, begin=begin, whole=True, extra=extra, **_arcs(s))

    return _set(name, seed, rng, robot, seen, {"input_gain_drift", "regime_change", "periodic_disturbance"})


def between_samples(name: str, seed: int, rng: Rng) -> TraceSet:
    """Mostly commands that are held so long that changes lie within less than a fifth of the samples' intervals.

    Of others nothing is promised. A delay is at least six tenths of a step, so that it can be reported.
    """
    law = str(rng.choice(["holds", "human", "sines"], p=[0.8, 0.1, 0.1]))

    def robot(rng: Rng) -> Scale:
        rate = float(rng.choice([10.0, 20.0, 30.303, 50.0, 100.0]))
        s = draw_scale(rng, n=int(log_uniform(rng, 500, 1800)), rate=rate)
        return replace(s, pace=max(s.pace, 7.0 * len(s.ranges) * s.dt))

    def seen(rng: Rng, s: Scale, missing: tuple[Missing, ...], loud: float) -> Draft:
        missing = tuple(replace(m, p=m.p | {"delay": max(m.p["delay"], 0.6 * s.dt)}) if m.name == "input_delay" else m for m in missing)
        noise = draw_noise(rng, s, "white", log_uniform(rng, 1e-4, 3e-3), loud=loud)
        return Draft(s, noise, law, "between", missing, together=True, whole=True, extra={"kind": law}, **_arcs(s))

    given = _set(name, seed, rng, robot, seen, {"input_bias", "constant_disturbance", "input_coupling"})
    if law != "holds" and not given.truth["effects"]:
        given.truth["expect"] = "unpromised"
    return given


def hidden_gain(name: str, seed: int, rng: Rng) -> TraceSet:
    """The controller was tuned on the robot, so it works: where the sign is wrong, it commands the opposite.

    A wrong sign is rejected, or reported as a gain below zero, or left unexplained.
    """
    kind = str(rng.choice(["none", "gain", "sign"], p=[0.3, 0.4, 0.3]))
    strength = float(rng.choice([0.0, 1.0])) * float(rng.uniform(0.1, 0.5))
    band = Band(2.0, 1e9, 3.0, 60.0)

    def draw(number: int, rng: Rng, size: float, loud: float) -> Draft:
        while True:
            s = draw_scale(rng, PLANTS, n=int(log_uniform(rng, 400, 1800)), rate=float(rng.choice([10.0, 20.0, 30.303, 50.0, 100.0])))
            both = [j for j, r in enumerate(s.ranges) if r.low < 0.0]
            if both:
                break
        j = int(rng.choice(both)) if kind == "sign" else int(rng.integers(len(s.ranges)))
        off = min(size * float(rng.uniform(0.15, 0.5)), 0.7) * float(rng.choice([-1.0, 1.0]))
        gain = -(1.0 + strength * np.sign(off)) if kind == "sign" else 1.0 + off
        missing = () if kind == "none" else (Missing("input_gain", s.plant.inputs[j], {"gain": float(gain)}),)

        def asked(rng: Rng, t: Array) -> Controller:
            pace = max(0.6 * s.pace, 12.0 * s.dt)
            inner = tracker(rng, s.plant, s.ranges, pace, s.speed, s.plant.parameters.get("mass", 1.0))

            def commanded(t: float, y: list[float]) -> list[float]:
                u = inner(t, y)
                return [-v if kind == "sign" and k == j else v for k, v in enumerate(u)]

            return commanded

        noise = draw_noise(rng, s, str(rng.choice(["white", "coloured"])), loud=loud)
        return Draft(s, noise, "closed", "grid", missing, asked=asked, extra={"kind": kind}, **_arcs(s))

    if kind == "none":
        draft = draw(0, rng, 1.0, 1.0)
        recording, errors = realise(rng, draft)
        return TraceSet(name, seed, recording, draft.model(), {"expect": "clean", **common(draft, errors)}, draft=draft)
    draft, recording, errors = sized(rng, draw, band)
    truth = {"expect": "reversed" if kind == "sign" else "one", **common(draft, errors), "accepted": accepted(draft), "close": True}
    return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)


LOG_KINDS = {
    "late_heading": late_heading,
    "late_speed": late_speed,
    "measured_torque": measured_torque,
    "position_faults": position_faults,
    "rounded": rounded,
    "same_place": same_place,
    "between_samples": between_samples,
    "hidden_gain": hidden_gain,
    "newer": newer,
}
"""Family -> its maker."""
