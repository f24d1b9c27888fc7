"""Input design for model discrimination: which excitation separates effects that explain the same data.

`advice` is one sentence: each effect is recognised by one feature of the input. A bias needs zero and both signs, a gain several sizes, a
limit sizes up to the largest, memory samples right after steps, a coupling values of one input at several values of the other.

`suggest` draws many sequences (`candidates`). It takes the one under which the smallest expected log likelihood difference between
competing hypotheses (`discrimination`) is largest: a maximin T-optimal design (A. Atkinson, V. Fedorov, Biometrika 62, 1975). For the whole
library it takes the sequence that separates most pairs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.design.candidates import Room, draw, room_of
from s2r_runtime.trace.design.competing_fits import Hypotheses, competing_hypotheses, ground, library
from s2r_runtime.trace.design.discrimination import as_data, between, expected, refitted, trajectories
from s2r_runtime.trace.design.suggestion import ENOUGH, Suggestion
from s2r_runtime.trace.diagnostics.rollout_error import Held
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import Fit, evaluate

if TYPE_CHECKING:
    from s2r_runtime.trace.data.dataset import Dataset
    from s2r_runtime.trace.reporting.result import TraceResult

Array = NDArray[np.float64]
Bounds = Mapping[str, tuple[float, float]]
Ways = tuple[tuple[int, int], ...]

DURATION_S, FEWEST, MOST = 20.0, 300, 4000
"""Default length of a sequence, s; minimum and maximum number of samples."""

ROWS, SEQUENCES = 30_000, (8, 60)
"""Samples that are simulated for each hypothesis; minimum and maximum number of sequences."""

FINALS, CLOSEST = 3, 5
"""Sequences that are re-evaluated with re-fitted hypotheses, and closest pairs of each; of the best one all pairs."""

PLENTY = 10.0 * ENOUGH
"""Expected evidence, nats, beyond which more is not preferred."""

HOMEWARD = 0.3
"""Share of its value that a sequence loses if it ends at the edge of the region."""

NESTED = 0.02
"""Nested hypotheses: one loses at most this share, under all inputs, of what the other loses in its place."""

REPEATS = 10.0
"""Repetitions of a sequence beyond which it does not count as separating a pair."""

MOST_NEEDS = 4
"""Number of features of one input in a sentence."""

_SIZES = "at least three sizes"
_FAR = "steps between values far apart, each held until the response has settled"
_BOTH = "slow and fast in both directions, and coasting at zero input"
_TURNS = "every heading, at several speeds"
_NEEDS = {
    "input_bias": "zero and both signs",
    "input_gain": _SIZES,
    "input_gain_asymmetry": "at least three sizes of both signs",
    "input_saturation": "sizes from small up to the largest that is allowed",
    "wheel_saturation": "the largest values of each at several values of the other",
    "input_delay": "steps between values far apart, with single periods recorded after each",
    "input_lag": _FAR,
    "input_rate_limit": "small and large steps, each held until the response has settled",
    "input_deadband": "values around zero, small and large, of both signs",
    "input_backlash": "reversals, small and large",
    "input_coupling": "several values of each at several values of the other",
    "input_gain_drift": "the same values early and late",
    "regime_change": "the same values early and late",
    "periodic_disturbance": "one value, held for many seconds",
    "viscous_friction": _BOTH,
    "coulomb_friction": _BOTH,
    "stribeck_friction": "very slow and fast in both directions",
    "quadratic_drag": "at least three speeds",
    "castor_drag": "straight ahead, turns on the spot and curves, slow and fast",
    "link_gravity": "the whole range of positions, slowly",
    "torque_ripple": "slow motion over the whole range of positions",
    "gear_backlash": "many reversals, small and large, sampled quickly",
    "load_friction": "small and large forces in both directions, also against the motion",
    "cubic_stiffness": "the whole range of positions",
    "constant_disturbance": _TURNS,
    "gravity_slope": _TURNS,
    "heading_offset": _TURNS,
    "position_field": "all over the floor",
    "lateral_slip": "curves of several radii at several speeds",
    "understeer": "the same steering at several speeds",
    "rear_slip": "curves at several speeds",
    "longitudinal_slip": _SIZES,
    "track_scale": _SIZES,
    "wheel_radius_scale": "straight ahead, turns on the spot to both sides, and curves, at several speeds",
    "sensor_lever_arm": "turning on the spot, and driving straight",
}
_OTHERWISE = "steps of several sizes and both signs"


def advice(model: ComposedModel, tied: Iterable[tuple[str, str]]) -> str:
    """One sentence. tied: (effect, channel)."""
    wanted: dict[str, list[str]] = {}
    for name, channel in tied:
        for single in model.inputs if channel == "*" else (channel,):
            needs = wanted.setdefault(single if single in model.inputs else "", [])
            text = _NEEDS.get(name, _OTHERWISE)
            if text not in needs:
                needs.append(text)
    features = {channel: "; ".join(needs[:MOST_NEEDS]) for channel, needs in sorted(wanted.items(), reverse=True)}
    if features.get("") in {needs for channel, needs in features.items() if channel}:
        del features[""]  # it is listed for an input already
    parts = [f"{channel}: {needs}" if channel else f"{needs[0].upper()}{needs[1:]}" for channel, needs in features.items()]
    apart = " Change one input at a time while the others hold still." if len([c for c in wanted if c]) > 1 else ""
    return ("Drive " if next(iter(features)) else "") + ". ".join(parts) + "." + apart


@dataclass(frozen=True)
class _Choice:
    """u: (T, nu); pairs: (one, other, nats), the closest first; never: pairs that no sequence separates."""

    u: Array
    pairs: tuple[tuple[str, str, float], ...]
    never: tuple[str, ...]


def suggest(
    r: TraceResult,
    *,
    bounds: Bounds | None = None,
    region: Bounds | None = None,
    duration: float | None = None,
    seed: int = 0,
) -> Suggestion:
    """Suggest inputs for a result. bounds: of the inputs (None: the range seen); region: allowed range of states; duration: s."""
    given = ground(r.held)
    hypotheses = competing_hypotheses(r, given)
    base = evaluate(given, r.model) if hypotheses is None else hypotheses.fits[0]
    found = _suggested(r.held, base, hypotheses, bounds, region, duration, seed)
    longer = max(1, round(r.model.dt / r.spec.dt))  # steps of the fit may be longer than the model's
    return found if found.u is None else replace(found, u=np.repeat(found.u, longer, axis=0), dt=r.spec.dt)


def suggest_first(
    model: ComposedModel, data: Dataset, *, bounds: Bounds | None, region: Bounds | None, duration: float | None, seed: int
) -> Suggestion:
    """Suggest inputs for a recording that cannot be traced: a sequence that excites the whole library."""
    steps = steps_of(data)
    held = Held(data, steps, (), np.ones(sum(len(run.y) - 1 for run in data.runs), dtype=bool), 1)
    return _suggested(held, evaluate(ground(held), model), None, bounds, region, duration, seed)


def _suggested(
    held: Held, base: Fit, hypotheses: Hypotheses | None, bounds: Bounds | None, region: Bounds | None, duration: float | None, seed: int
) -> Suggestion:
    model, rng = base.model, np.random.default_rng(seed)
    ends = _bounds(held, model.inputs, bounds)
    limits = {name: (float(low), float(high)) for name, (low, high) in zip(model.inputs, ends, strict=True)}
    nothing = Suggestion(model.inputs, model.dt, limits, bounds is None, hypotheses is not None)
    if not np.any(ends[:, 1] > ends[:, 0]):
        return replace(nothing, refused="the bounds leave no input that may change; a profile states what is allowed (--profile)")
    room = room_of(model, held, ends, region)
    steps = _steps(duration, model.dt)
    drawn = draw(rng, model, room, ends, int(np.clip(ROWS // steps, *SEQUENCES)), steps)
    drawn = _inside(hypotheses.fits if hypotheses else (base,), room, drawn, strictly=region is not None)
    if not len(drawn):
        return replace(nothing, refused="no sequence of that length stays inside the region; give a shorter length or a larger region")
    choice = _for_hypotheses(hypotheses, held, room, drawn, rng) if hypotheses else None
    if choice is None or not (choice.pairs or choice.never):
        nothing, choice = replace(nothing, tied=False), _for_library(base, held, room, drawn, rng)
    if not choice.pairs:
        return replace(nothing, refused=f"no inputs within the bounds separate {'; '.join(choice.never) or 'anything'}", never=choice.never)
    y = trajectories(model, None, room.start, choice.u[None], rng)[0]
    away = np.hypot(*(y - room.start)[:, list(room.pose)].T) if room.pose is not None else room.excess(y)
    begin = tuple((s, float(room.start[i])) for i, s in enumerate(model.states) if region and s in region and s in {"x", "y", "q"})
    return replace(
        nothing,
        u=choice.u,
        pairs=choice.pairs,
        never=choice.never,
        begin=begin,
        farthest=float(np.max(away)),
        ends=float(away[-1]),
        metres=room.pose is not None,
    )


def _bounds(held: Held, inputs: tuple[str, ...], bounds: Bounds | None) -> Array:
    """(nu, 2) bounds of the inputs. The range seen includes zero: the robot was at rest before."""
    if bounds is not None:
        return np.array([bounds[name] for name in inputs], dtype=np.float64)
    u = np.concatenate([run.u for run in held.data.runs])
    return np.column_stack([np.minimum(u.min(axis=0), 0.0), np.maximum(u.max(axis=0), 0.0)])


def _steps(duration: float | None, dt: float) -> int:
    return max(2, round(duration / dt)) if duration is not None else int(np.clip(round(DURATION_S / dt), FEWEST, MOST))


def _inside(fits: tuple[Fit, ...], room: Room, drawn: Array, *, strictly: bool) -> Array:
    """Sequences (count, T, nu) under which every hypothesis stays in the region. If not strictly: at least those that leave it least."""
    worst = np.zeros(len(drawn))
    for fit in fits:
        y = trajectories(fit.model, None, room.start, drawn, np.random.default_rng(0))
        worst = np.maximum(worst, room.excess(y).max(axis=1))
    good = np.flatnonzero(worst <= 1.0)
    return drawn[good] if len(good) or strictly else drawn[np.argsort(worst)[: SEQUENCES[0]]]


def _for_hypotheses(hypotheses: Hypotheses, held: Held, room: Room, drawn: Array, rng: np.random.Generator) -> _Choice:
    """Sequence with the largest expected evidence for the closest pair; hypotheses are re-fitted for the best few."""
    fits = hypotheses.fits
    couples = [(i, j) for i, j in combinations(range(len(fits)), 2) if i == 0 or hypotheses.every]
    nats = np.zeros((len(drawn), len(fits), len(fits)))
    for truth, fit in enumerate(fits):
        y = trajectories(fit.model, fit.noise, room.start, drawn, rng)
        for c, u in enumerate(drawn):
            nats[c, truth] = expected(fits, truth, as_data(held.data, y[c], u))
    ways = [_ways(nats, i, j) for i, j in couples]
    roughly = np.array([[min(n[way] for way in both) for both in ways] for n in nats])
    ends = room.excess(trajectories(fits[0].model, None, room.start, drawn, rng)[:, -1])
    finals = np.argsort(-_worth(roughly, ends))[:FINALS]
    really = roughly[finals]
    for row, c in zip(really, finals, strict=True):
        _refit(hypotheses, held, room, drawn[c], ways, row, np.argsort(row)[:CLOSEST])
    best = int(np.argmax(_worth(really, ends[finals])))
    _refit(hypotheses, held, room, drawn[finals[best]], ways, really[best], np.argsort(really[best]))
    named = [hypotheses.named(i, j) for i, j in couples]
    found = sorted(((*name, round(float(n), 2)) for name, n in zip(named, really[best], strict=True)), key=lambda pair: pair[2])
    never = tuple(f"{one} and {other}" for one, other, n in found if n * REPEATS < ENOUGH) if hypotheses.every else ()
    return _Choice(drawn[finals[best]], tuple(pair for pair in found if pair[2] * REPEATS >= ENOUGH), never)


def _refit(hypotheses: Hypotheses, held: Held, room: Room, u: Array, ways: list[Ways], nats: Array, which: NDArray[np.int64]) -> None:
    """Lower nats (pairs,) of some pairs to the value with a re-fitted hypothesis."""
    for pair in which.tolist():
        if nats[pair] * REPEATS >= ENOUGH:
            left = [refitted(hypotheses.fits, truth, alternative, held.data, room.start, u) for truth, alternative in ways[pair]]
            nats[pair] = min(float(nats[pair]), *left)


def _worth(nats: Array, ends: Array) -> Array:
    """(count,) value of sequences with nats (count, pairs): evidence of the closest separable pair, less if it ends far away."""
    can = nats.max(axis=0) * REPEATS >= ENOUGH
    closest = nats[:, can].min(axis=1) if can.any() else nats.max(axis=1)
    return np.asarray(np.minimum(closest, PLENTY) * (1.0 - HOMEWARD * np.minimum(ends, 1.0)))


def _ways(nats: Array, i: int, j: int) -> Ways:
    """(truth, alternative) that count for a pair, of nats (count, R, R): both, except if one contains the other (a gain by sign and a
    gain): the tracer then takes the simpler one.
    """
    there, back = nats[:, i, j], nats[:, j, i]
    if np.all(there < 1.0 + NESTED * back):
        return ((j, i),)
    return ((i, j),) if np.all(back < 1.0 + NESTED * there) else ((i, j), (j, i))


def _for_library(base: Fit, held: Held, room: Room, drawn: Array, rng: np.random.Generator) -> _Choice:
    """Sequence that separates most effects from one another and from no effect."""
    y = trajectories(base.model, base.noise, room.start, drawn, rng)
    hypotheses = library(base, as_data(held.data, y[0], drawn[0]))
    drawn, y = drawn[: SEQUENCES[0] * 2], y[: SEQUENCES[0] * 2]
    tables = np.stack([between(hypotheses.fits, base, as_data(held.data, y[c], u)) for c, u in enumerate(drawn)])
    either = np.maximum(tables, tables.transpose(0, 2, 1))  # of nested effects, the richer one may be true
    couples = list(combinations(range(len(hypotheses.fits)), 2))
    best = int(np.argmax(np.minimum(either / ENOUGH, 1.0).sum(axis=(1, 2))))
    shown = either[:, 0].max(axis=0) * REPEATS >= ENOUGH
    shown[0] = True
    pairs = [(hypotheses.names[i], hypotheses.names[j], round(float(either[best, i, j]), 2)) for i, j in couples if shown[i] and shown[j]]
    never = tuple(name for name, ok in zip(hypotheses.names, shown, strict=True) if not ok)
    return _Choice(drawn[best], tuple(sorted(pairs, key=lambda pair: pair[2])), never)
