"""States that were not measured but follow from others and their rates: a speed from positions, a wheel's speed from a pose.

Every stretch without a gap is brought on stamps T apart (as recorded, T their usual distance), states and inputs pass through the same
low-pass (differentiation.py), rates are taken within its bandwidth B, and the missing states are what the model says of them (`follows`).

Filtered rows are correlated over 1 / 2B, the Nyquist interval: steps shorter than that show nothing new, and a fit that took each for a
measurement of its own would be as many times too sure. So what is fitted are steps of about 1 / 2B, or longer (`independent`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import NotEnoughEvidence, RecordingError
from s2r_runtime.hookspecs import Follows
from s2r_runtime.models.bound import integrating, steps_coarsely
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import axes
from s2r_runtime.trace.data import differentiation
from s2r_runtime.trace.data.input_interpolation import less_noise_of
from s2r_runtime.trace.data.streams import Stream, complete, fresh, held_between, held_means, unwrapped
from s2r_runtime.trace.estimation.hidden_state import smoothed_hidden, told_through
from s2r_runtime.trace.estimation.speed_spline import Smoothed, smoothed
from s2r_runtime.trace.sensor_faults.fault import Fault
from s2r_runtime.trace.sensor_faults.position_outliers import mended
from s2r_runtime.trace.sensor_faults.speed_latency import late, of_differences

Array = NDArray[np.float64]

APART = 2.5
"""Usual intervals between rows from which on nothing is interpolated."""

FEWEST = 8
"""Rows of a segment from which a speed is told."""

MANY_STEPS = 1500
"""Steps that are enough, if longer ones show the motion as well: shorter ones show how the force went on, which is no new measurement."""

LOOKED_AT = 6000
"""Rows on which it is told whether a speed is late."""

SHORT_S = 0.02
"""Longest of such steps: actuators answer late, or lag, by some tens of milliseconds, which longer ones would blur."""

INSIDE = 0.4
"""Bandwidth over the rate of steps: what is sampled there is not mistaken for something slower."""

FINER = 0.6
"""Of a step: rows that come more often than this are filtered, so that those between the steps say something, too."""

SILENT = 20.0
"""Times the longest but a few intervals of the inputs, from which on it is a silence."""

SNAPPED = 0.01
"""A usual interval this near to a whole fraction of the model's step is that fraction: stamps are printed with a few digits."""


IN_PARTS = "the model's steps are taken in parts (integration_scheme: exact), before and after: whole ones are too coarse to tell it"
"""Of hidden states."""


@dataclass(frozen=True)
class Reconstruction:
    """States that were not measured; Hz within which they, and everything with them, were reconstructed; s between the rows used; Hz that
    hold nearly all of the motion.
    """

    states: tuple[str, ...]
    bandwidth: float
    interval: float
    needed: float
    axes: tuple[tuple[str, str], ...] = ()
    """(position, speed) of axes whose speed is where a residual is looked at, and not a measurement: nothing was filtered."""
    errors: tuple[float, ...] = ()
    """Standard deviations of these speeds."""
    apart: int = 1
    """Of the model's steps, where nothing was filtered that would make neighbours alike."""
    cleaned: tuple[Stream, ...] = field(default=(), repr=False)
    """Inputs of each segment without the noise of samples (`input_interpolation`), where all was filtered: what is left of it then looks
    smooth.
    """
    late: dict[str, float] = field(default_factory=dict)
    """s by which speeds were late that the recording has (`speed_latency`)."""
    faults: tuple[Fault, ...] = ()
    """Of positions, found before anything was done to them (`position_outliers`)."""
    outliers: int = 0
    """Rows of positions that were left out before that, of more than are faults."""
    hidden: bool = False
    """Whether `axes` are no axes, but what tells a hidden state of somebody's own model, and that state."""
    in_parts: bool = False
    """Whether the model's steps are taken in parts for that: what is found would take up what a coarse one makes of a hidden state."""

    def to_json(self) -> dict[str, object]:
        """docs/json.md's `reconstructed`."""
        told: dict[str, object] = {"states": list(self.states), "bandwidth_hz": self.bandwidth}
        return told | ({"late_s": self.late} if self.late else {}) | ({"steps_in_parts": True} if self.in_parts else {})

    def text(self) -> list[str]:
        """For a person."""
        who = ", ".join(self.states)
        were = "was" if len(self.states) == 1 else "were"
        if self.axes:
            of = ", ".join(position for position, _ in self.axes)
            told = [f"{speed} comes {s:.2g} s late, as from a filter, and is not used: {of} tells it" for speed, s in self.late.items()]
            if len(told) == len(self.states):
                return told
            seen = who if self.hidden else "speeds"
            parts = [IN_PARTS] if self.in_parts else []
            return [
                *told,
                f"{who} {were} not measured: what is left over is judged on {of} alone ({seen} seen up to {self.bandwidth:g} Hz)",
                *parts,
            ]
        return [
            f"{who} {were} not measured but reconstructed within {self.bandwidth:g} Hz (--bandwidth HZ)",
            f"all states and inputs were low-passed alike at {self.bandwidth:g} Hz, without delay",
        ]


def reconstruct(
    model: ComposedModel,
    segments: Sequence[tuple[Stream, Stream]],
    missing: Sequence[str],
    source: str,
    bandwidth: float | None = None,
    behind: Mapping[str, float] | None = None,
) -> tuple[list[tuple[Stream, Stream]], Reconstruction]:
    """Segments of (measured states in the model's order without the missing ones, inputs), filtered, with all states. bandwidth: Hz; None:
    what the data bear. behind: speeds that were left out as they are late. Raises RecordingError if a missing state does not follow, nor is
    told by another one, NotEnoughEvidence if the rows are too few.
    """
    measured = [name for name in model.states if name not in missing]
    if bandwidth is None and (pairs := _axes_without_speed(model, missing)):
        given, done = _with_speeds(model, segments, pairs, source)
        return given, replace(done, late=dict(behind or {}))
    if bandwidth is None and not {*missing} <= {*getattr(model.nominal, "follows", {})} and (pairs := told_through(model.nominal, missing)):
        return _with_hidden(model, segments, pairs, source)
    _check_follows(model, missing, source)
    angles = [measured.index(name) for name in model.nominal.angles if name in measured]
    given = [(complete(states), inputs) for states, inputs in segments]
    intervals = [np.diff(states.t) for states, _ in given if len(states.t) > 1]
    if not intervals:
        raise NotEnoughEvidence(f"{source}: has no two rows on which {', '.join(measured)} were measured; how they change is told by many")
    interval = snapped(float(np.median(np.concatenate(intervals))), model.dt)
    laid = [[_laid(part, interval, angles) for part in _stretches(states, interval)] for states, _ in given]
    rows = [part.values for parts in laid for part in parts if len(part.t) > 2]
    if not rows:
        raise NotEnoughEvidence(f"{source}: {', '.join(missing)} cannot be reconstructed: no three rows follow one another without a gap")
    band = _checked(bandwidth, interval, source) if bandwidth else differentiation.bandwidth(rows, interval)
    made = []
    for parts, (_, inputs) in zip(laid, given, strict=True):
        whole = [_with_rates(model, part, measured, missing, interval, band) for part in parts]
        states = Stream(np.concatenate([w.t for w in whole]), np.concatenate([w.values for w in whole])) if whole else None
        if states is not None and len(states.t):
            made.append((states, _inputs(inputs, parts, interval, band)))
    if not made:
        raise RecordingError(
            f"{source}: {', '.join(missing)} cannot be reconstructed within {band:g} Hz, which takes more than "
            f"{2.0 / band:.3g} s without a gap"
        )
    return made, Reconstruction(tuple(missing), band, interval, min(band, differentiation.bandwidth(rows, interval, rows=0)))


def late_speeds(model: ComposedModel, segments: Sequence[tuple[Stream, Stream]], missing: Sequence[str]) -> dict[str, float]:
    """Speeds of axes that come late against their positions (`late_speeds.late`), in the longest segment; s."""
    names = [name for name in model.states if name not in missing]
    found = ((model.states[axis.position], model.states[axis.velocity]) for axis in axes(model.nominal))
    pairs = tuple((p, v) for p, v in found if p in names and v in names and v in getattr(model.nominal, "follows", {}))
    if not pairs or not segments:
        return {}
    received, inputs = max(segments, key=lambda pair: len(pair[0].t))
    states = _looked_at(model, complete(fresh(received)), names)
    if len(states.t) < FEWEST or not len(inputs.t):
        return {}
    all_rows = _looked_at(model, complete(received), names)  # a position that repeats may be all that a coarse encoder says
    rates, all_rates = (_pushed(model, rows, inputs, names)[1] for rows in (states, all_rows))
    by = {}
    for position, speed in pairs:
        i, j, k = names.index(position), names.index(speed), model.states.index(speed)
        by[speed] = of_differences(all_rows.t, all_rows.values[:, j], all_rows.values[:, i], all_rates[:, k])
        if by[speed] == 0.0:
            smooth = smoothed(states.t, states.values[:, i], rates[:, k])
            by[speed] = late(states.t, states.values[:, j], rates[:, k], smooth)
    return {v: seconds for v, seconds in by.items() if seconds > 0.0}


def _looked_at(model: ComposedModel, states: Stream, names: Sequence[str]) -> Stream:
    """The first rows, angles unwrapped."""
    angles = [names.index(name) for name in model.nominal.angles if name in names]
    return Stream(states.t[:LOOKED_AT], unwrapped(states.values[:LOOKED_AT], angles))


def independent_step(done: Reconstruction, dt: float) -> int:
    """Steps of dt that make one of 1 / 2B or nearly."""
    if done.axes:
        return done.apart
    return max(1, round(1.0 / (2.0 * done.bandwidth * dt)))


def _axes_without_speed(model: ComposedModel, missing: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """(position, speed) of axes, if all that is missing are speeds of axes."""
    found = tuple((model.states[axis.position], model.states[axis.velocity]) for axis in axes(model.nominal))
    pairs = tuple(pair for pair in found if pair[1] in missing and pair[0] not in missing)
    return pairs if len(pairs) == len(missing) else ()


def _with_speeds(
    model: ComposedModel, segments: Sequence[tuple[Stream, Stream]], pairs: tuple[tuple[str, str], ...], source: str
) -> tuple[list[tuple[Stream, Stream]], Reconstruction]:
    """Segments as they were received, with speeds of axes (`speed_spline`) on the same rows. Where rows come much more often than steps are
    taken, all passes through one low-pass, so that no row is lost.
    """
    missing = tuple(speed for _, speed in pairs)
    measured = [name for name in model.states if name not in missing]
    angles = [measured.index(name) for name in model.nominal.angles if name in measured]
    given = [(complete(fresh(states)), inputs) for states, inputs in segments]
    given = [(Stream(s.t, unwrapped(s.values, angles)), inputs) for s, inputs in given if len(s.t) >= FEWEST]
    if not given:
        raise NotEnoughEvidence(
            f"{source}: {', '.join(missing)} cannot be told: fewer than {FEWEST} rows on which {', '.join(measured)} were measured"
        )
    interval = snapped(float(np.median(np.concatenate([np.diff(s.t) for s, _ in given]))), model.dt)
    given, faults, outliers = _mended(model, given, measured, pairs)
    made, known = [], []
    for states, inputs in given:
        whole, found = _speeds(model, states, inputs, measured, pairs)
        made.append((whole, inputs))
        known.append(found)
    errors = tuple(float(np.median([found[j].error for found in known])) for j in range(len(pairs)))
    band = max(one.bandwidth for found in known for one in found)
    steps = sum(float(s.t[-1] - s.t[0]) for s, _ in made) / model.dt
    shown = float(f"{min(band, 0.5 / interval):.2g}")
    rows = [part.values for s, _ in given for part in _stretches(s, interval) if len(part.t) > 2]
    needed = min(shown, differentiation.bandwidth(rows, interval, rows=0)) if rows else shown
    apart = max(1, min(math.ceil(steps / MANY_STEPS), math.floor(INSIDE / (needed * model.dt)), math.floor(SHORT_S / model.dt)))
    cleaned: list[Stream] = []
    if apart > 1 or interval < FINER * model.dt:
        band = INSIDE / (apart * model.dt)
        cleaned = [part for s, u in made for _, part in _filtered(s, less_noise_of(u)[0], interval, band)]
        made = [both for s, u in made for both in _filtered(s, u, interval, band)]
        if not made:
            raise NotEnoughEvidence(f"{source}: {', '.join(missing)} cannot be told: no stretch without a gap is long enough")
    return made, Reconstruction(missing, shown, interval, needed, pairs, errors, apart, tuple(cleaned), faults=faults, outliers=outliers)


def _with_hidden(
    model: ComposedModel, segments: Sequence[tuple[Stream, Stream]], pairs: tuple[tuple[str, str], ...], source: str
) -> tuple[list[tuple[Stream, Stream]], Reconstruction]:
    """Segments as they were received, with states of somebody's own model that others tell (`hidden_state`), on the same rows."""
    missing = tuple(h for _, h in pairs)
    measured = [name for name in model.states if name not in missing]
    coarse = not model.nominal.integration and steps_coarsely(model.nominal)
    nominal = integrating(model.nominal, "exact") if coarse else model.nominal
    given = [(complete(fresh(states)), inputs) for states, inputs in segments]
    spaces = [np.diff(states.t) for states, _ in given if len(states.t) > 1]
    interval = snapped(float(np.median(np.concatenate(spaces))), model.dt) if spaces else model.dt
    angles = [measured.index(name) for name in model.nominal.angles if name in measured]
    made, known = [], []
    for states, inputs in given:
        parts = [part for part in _stretches(states, interval) if len(part.t) >= FEWEST]
        whole = []
        for part in parts:
            x = np.zeros((len(part.t), len(model.states)))
            x[:, [model.states.index(name) for name in measured]] = unwrapped(part.values, angles)
            x, found = smoothed_hidden(nominal, part.t, x, held_between(inputs, part.t, 1), interval, pairs, source)
            whole.append(Stream(part.t, x))
            known.append(found)
        if whole:
            made.append((Stream(np.concatenate([w.t for w in whole]), np.concatenate([w.values for w in whole])), inputs))
    if not made:
        raise NotEnoughEvidence(
            f"{source}: {', '.join(missing)} cannot be told: no {FEWEST} rows without a gap on which {', '.join(measured)} were measured"
        )
    errors = tuple(float(np.median([found[j].error for found in known])) for j in range(len(pairs)))
    shown = float(f"{min(max(one.bandwidth for found in known for one in found), 0.5 / interval):.2g}")
    return made, Reconstruction(missing, shown, interval, shown, pairs, errors=errors, hidden=True, in_parts=coarse)


def _mended(
    model: ComposedModel, given: list[tuple[Stream, Stream]], measured: list[str], pairs: tuple[tuple[str, str], ...]
) -> tuple[list[tuple[Stream, Stream]], tuple[Fault, ...], int]:
    """Segments without what is wrong with their positions, cut where these jumped, what that was, and how many rows were mere outliers."""
    begin = min(float(states.t[0]) for states, _ in given)
    columns = [(measured.index(position), position) for position, _ in pairs]
    made: list[tuple[Stream, Stream]] = []
    faults: list[Fault] = []
    outliers = 0
    for states, inputs in given:
        rates = _pushed(model, states, inputs, measured)[1]
        done = mended(states, columns, rates[:, [model.states.index(speed) for _, speed in pairs]], begin)
        faults += done.faults
        outliers += done.outliers
        for part in done.parts if done.faults or done.outliers else (states,):
            if len(part.t) >= FEWEST:
                until = np.searchsorted(inputs.t, part.t[-1], side="right")
                made.append((part, inputs if part is states else Stream(inputs.t[:until], inputs.values[:until])))
    return made, tuple(faults), outliers


def _pushed(model: ComposedModel, states: Stream, inputs: Stream, measured: list[str]) -> tuple[Array, Array]:
    """All states on the rows of what was measured, 0 where they were not, and the rates there (n - 1, nx)."""
    nominal, h = model.nominal, 1e-3 * model.dt
    x = np.zeros((len(states.t), len(model.states)))
    for j, name in enumerate(measured):
        x[:, model.states.index(name)] = states.values[:, j]
    return x, (nominal.step(x[:-1], held_between(inputs, states.t, 1), h, nominal.parameters) - x[:-1]) / h


def _speeds(
    model: ComposedModel, states: Stream, inputs: Stream, measured: list[str], pairs: tuple[tuple[str, str], ...]
) -> tuple[Stream, list[Smoothed]]:
    """All states on the rows of what was measured."""
    x, rates = _pushed(model, states, inputs, measured)
    found = []
    for position, speed in pairs:
        j = model.states.index(speed)
        found.append(smoothed(states.t, x[:, model.states.index(position)], rates[:, j]))
        x[:, j] = found[-1].speed
    return Stream(states.t, x), found


def _filtered(states: Stream, inputs: Stream, interval: float, band: float) -> list[tuple[Stream, Stream]]:
    """Stretches without a gap and their inputs, low-passed alike."""
    edge = max(1, round(1.0 / (band * interval)))
    parts = [_laid(part, interval, []) for part in _stretches(states, interval)]
    parts = [part for part in parts if len(part.t) >= 2 * edge + 2]
    if not parts:
        return []
    smooth = [Stream(p.t[edge:-edge], differentiation.low_pass(p.values, interval, band)[edge:-edge]) for p in parts]
    whole = Stream(np.concatenate([p.t for p in smooth]), np.concatenate([p.values for p in smooth]))
    return [(whole, _inputs(inputs, parts, interval, band))]


def at_step(model: ComposedModel, dt: float) -> ComposedModel:
    """The same model with another step."""
    return replace(model, spec=msgspec.structs.replace(model.spec, dt=dt))


def _check_follows(model: ComposedModel, missing: Sequence[str], source: str) -> None:
    follows = getattr(model.nominal, "follows", {})
    for name in missing:
        of = follows[name].of if name in follows else ()
        if not of or set(of) & set(missing):
            known = "; ".join(f"{state} follows from {', '.join(f.of)}" for state, f in follows.items())
            raise RecordingError(f"{source}: {name} was not measured and does not follow from what was ({known or 'no state of it does'})")


def _checked(bandwidth: float, interval: float, source: str) -> float:
    if bandwidth > 0.5 / interval:
        raise RecordingError(
            f"{source}: a bandwidth of {bandwidth:g} Hz was asked for; rows {interval:.4g} s apart show at most {0.5 / interval:.4g} Hz"
        )
    return bandwidth


def snapped(interval: float, dt: float) -> float:
    """The interval; a whole fraction of dt, if it is nearly one."""
    parts = round(dt / interval)
    return dt / parts if parts and abs(dt / parts - interval) < SNAPPED * interval else interval


def _stretches(states: Stream, interval: float) -> list[Stream]:
    cut = np.flatnonzero(np.diff(states.t) > APART * interval) + 1
    edges = [0, *cut.tolist(), len(states.t)]
    return [Stream(states.t[a:b], states.values[a:b]) for a, b in pairwise(edges) if b - a > 1]


def _laid(states: Stream, interval: float, angles: list[int]) -> Stream:
    """On stamps exactly one interval apart."""
    values = unwrapped(states.values, angles)
    t: Array = states.t[0] + interval * np.arange(round((states.t[-1] - states.t[0]) / interval) + 1)
    return Stream(t, np.column_stack([np.interp(t, states.t, column) for column in values.T]))


def _with_rates(model: ComposedModel, part: Stream, measured: list[str], missing: Sequence[str], interval: float, band: float) -> Stream:
    """All states of one stretch, less the rows at its ends (1 / B) that lean on a reflection."""
    edge = max(1, round(1.0 / (band * interval)))
    if len(part.t) < 2 * edge + 2:
        return Stream(np.zeros(0), np.zeros((0, len(model.states))))
    smooth = differentiation.low_pass(part.values, interval, band)
    rates = differentiation.low_pass(part.values, interval, band, 1)
    x = {name: smooth[:, j] for j, name in enumerate(measured)}
    slope = {name: rates[:, j] for j, name in enumerate(measured)}
    follows: dict[str, Follows] = getattr(model.nominal, "follows", {})
    for name in missing:
        x[name] = follows[name].formula(x, slope, model.parameters)
    values: Array = np.column_stack([x[name] for name in model.states]).astype(np.float64)
    return Stream(part.t[edge:-edge], values[edge:-edge])


def _inputs(inputs: Stream, parts: Sequence[Stream], interval: float, band: float) -> Stream:
    """Means over intervals, filtered as the states' stretches are; from before the first state, if inputs were there before. Where nothing
    came for far longer than usual, states neither, nothing is made up, and what came last holds: a clock may have jumped there.
    """
    first, last = float(parts[0].t[0]), float(parts[-1].t[-1])
    early = max(0, math.ceil((first - inputs.t[0]) / interval - 1e-6)) if len(inputs.t) else 0
    begin = first - early * interval
    means = held_means(inputs, begin, max(2, round((last - begin) / interval)), interval, 1)
    t = np.asarray(begin + interval * np.arange(len(means)), dtype=np.float64)
    smooth, apart = differentiation.low_pass(means, interval, band), np.diff(inputs.t)
    longest = SILENT * float(np.quantile(apart, 0.99)) if len(apart) else math.inf
    received = np.ones(len(t), dtype=bool)
    for before, after in pairwise(parts):
        k = int(np.searchsorted(inputs.t, before.t[-1] + interval, side="right")) - 1
        if 0 <= k < len(apart) and apart[k] > longest and inputs.t[k + 1] > after.t[0] - interval:
            silent = (t > inputs.t[k] + interval) & (t < inputs.t[k + 1] - interval)
            received &= ~silent
            kept = np.flatnonzero(received & (t <= inputs.t[k] + interval))
            smooth[kept[-1:]] = means[kept[-1:]]
    return Stream(t[received], smooth[received])
