"""Terms that a residual can depend on, in dictionaries by what they depend on (docs/tracing.md: the tokens of `depends_on`).

A term is c(y, u, t) d: a number for every transition times a direction of the state in which it pushes. Directions of a model
with a planar pose: along, across and about the body, each further state, and the world's axes; of another one: where its inputs push
(each state, if they push nowhere).
Small dictionaries stand beside larger ones of the same group: with few data the small one is judged better.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import POSE, axes, coupled, lone_speeds
from s2r_runtime.trace.estimation.noise import Noise
from s2r_runtime.trace.estimation.parameters import free_of
from s2r_runtime.trace.estimation.prediction import Acting, Steps, acting, wherever
from s2r_runtime.trace.estimation.problem import Problem, slopes
from s2r_runtime.trace.hypotheses.crossed_basis import bent_product, over_time, overtones

Array = NDArray[np.float64]
Terms = list[Array]

HARMONICS = 6
"""Of the heading: grooves, cables and slopes have few."""

WAVES = 24
"""Waves of a position over the way that was gone: cogging has many."""

LIKE = 0.5
"""Share of an input that must be left of it, else what was asked is asked about beside what acts."""

LAGS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89)
"""Steps back at which an input may still act."""

MOST_LATE = 8
"""Of these, for a position that comes late against its speed: a third of a second at 100 Hz."""

NEAR_ENDS = (0.002, 0.01, 0.03, 0.1)
"""Of the way between the two ends: within so much of one, a stop may push back."""

PATCHES = 5
"""Along each axis of the region: what lies on a part of the floor is then seen if the part is a fifth of it."""

LONGEST = 65_536
"""Steps up to which a spectrum is looked at."""

FINER, FLOOR = 4, 25
"""Points of a spectrum for each of its own; how many of these make a neighbourhood."""

ROUNDS = 4
"""Periods that a line must have gone through."""

LINE = 25.0
"""Times its neighbourhood by which a line must stand out: of 10 000 points of white noise, the highest is about 10."""

FEWEST_LEVELS, MOST_LEVELS = 4.0, 200.0
"""Steps between zero and the largest input, in which it may be carried out: fewer have dictionaries of their own."""

PARALLEL = 0.999
"""Share of a push along one axis, mean square, from which it is that axis': a tilt of two degrees is another direction."""

WIDEST = 30
"""Steps to each side over which states are averaged at most."""

PLAYS = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Widths of plays, as shares of the largest input."""

VELOCITIES = ("speed", "vx", "vy", "qd", "wheel_left", "wheel_right")
HEADINGS, PLACES = ("theta", "heading", "yaw"), ("x", "y", "z", "q")


def token_of(model: ComposedModel, state: str) -> str:
    """What is said of something that depends on a state."""
    if state in model.nominal.angles:
        return "heading" if state in HEADINGS else state
    return "speed" if state in VELOCITIES else "position" if state in PLACES else state


def dictionaries(given: Problem, model: ComposedModel, act: Acting, noise: Noise, r: Array) -> Iterator[tuple[str, Terms]]:
    """(token, terms (n, nx) each); `wave`: a line in the spectrum of r (n, nx), which depends on time, and does not wander."""
    steps = given.steps
    body, world = directions_of(given, model, act)
    u = act.mean[steps.place]
    size = np.maximum(np.max(np.abs(u), axis=0), 1e-12)
    u = u / size
    t = (steps.t - np.min(steps.t)) / max(float(np.ptp(steps.t)), 1e-9)
    one = np.ones(len(u))
    yield "constant", _push([one], [*body, *world])
    for j, asked in _swallowed(given, model, act):
        yield from ((model.inputs[j], _push(terms, body)) for terms in _static(asked[steps.place]))
        yield from ((f"memory({model.inputs[j]})", _push(terms, body)) for terms in _memory(asked, steps.place))
    for j, name in enumerate(model.inputs):
        yield from ((name, _push(terms, body)) for terms in _static(u[:, j]))
        yield from ((name, _push(terms, body)) for terms in _levels(r, u[:, j], body))
        yield from ((f"memory({name})", _push(terms, body)) for terms in _memory(act.mean[:, j] / size[j], steps.place))
        yield from ((f"memory({name})", _push(terms, body)) for terms in _bent_memory(act.mean[:, j] / size[j], steps.place))
        if given.data.in_order:
            yield from ((f"time*{name}", _push(terms, body)) for terms in _over_time(t, u[:, j]))
        for i in range(j):
            a, b = u[:, i], u[:, j]
            yield f"{model.inputs[i]}*{name}", _push([a * b, np.abs(a) * b, a * np.abs(b), np.abs(a * b)], body)
            yield f"{model.inputs[i]}*{name}", _push([a * b, a * a * b, a * b * b], body)
            yield f"{model.inputs[i]}*{name}", _push(bent_product(a, b), body)
    if not given.floor.axes:
        yield from (("speed", terms) for terms in _not_its_rate(given, model))
    pushes = [u[:, j][:, None] * own for j, own in enumerate(own_pushes(given, model, act))]
    for name, terms, directions in _of_states(model, quieter(given, noise, r), u, body, world, pushes):
        yield name, terms if directions is None else _push(terms, directions)
    yield from _varying(given, model, t, u)
    if not given.data.in_order:
        return
    for name, push in zip(model.inputs, pushes, strict=True):
        yield from ((f"time*{name}", [push, *(wave[:, None] * push for wave in waves)]) for waves in _hum(r, given, [push]))
    yield from (("time", terms) for terms in overtones(steps, model, given.data.dt, pushes))
    if {"x", "y", "theta"} <= set(model.states):
        yield from (("time", drift) for drift in _drifting_heading(steps, model, t))
    elif moving := _moving(model, quieter(given, noise, r)):
        yield "speed", _push(over_time(t, moving), body)
    yield "time", _push([one, t], [*body, *world])
    yield "time", _push([one, *(f(2.0 * np.pi * k * t) for k in (0.5, 1.0, 1.5, 2.0) for f in (np.sin, np.cos))], [*body, *world])
    yield "time", _push([one, *(np.where(t > s, one, 0.0) for s in np.linspace(0.1, 0.9, 9))], body)
    for directions in (body, world):
        yield from (("wave", _push(waves, directions)) for waves in _hum(r, given, directions))


def _swallowed(given: Problem, model: ComposedModel, act: Acting) -> Iterator[tuple[int, Array]]:
    """(input, (M,) what was asked of it, over its largest size) where what effects leave of it is something else: a robot that does nothing
    by one input may do something else by it.
    """
    if not any(a.effect.stage == "input" for a in model.effects):
        return
    for j, (asked, left) in enumerate(zip(acting(model, given.data, ()).mean.T, act.mean.T, strict=True)):
        size = float(np.max(np.abs(asked), initial=0.0))
        if size > 0.0 and not _goes_with(asked, left):
            yield j, asked / size


def _goes_with(a: Array, b: Array) -> bool:
    """Whether two are one and the same for the most part, but for their size and mean."""
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) ** 2 > LIKE * float(a @ a) * float(b @ b)


def pushes_by_token(given: Problem, model: ComposedModel, act: Acting) -> list[tuple[str, Array]]:
    """(token, (n, nx)) of what may come and go: a push in each direction, and a share of each input."""
    body, world = directions_of(given, model, act)
    u = act.mean[given.steps.place]
    own = [
        (f"time*{name}", u[:, j][:, None] * push)
        for j, (name, push) in enumerate(zip(model.inputs, own_pushes(given, model, act), strict=True))
    ]
    own = [] if given.data.measured_forces else own
    return [(token, push) for token, push in [*own, *(("time", d) for d in (*body, *world))] if np.any(push)]


def quieter(given: Problem, noise: Noise, r: Array) -> Array:
    """(n, nx) states at the start of steps, each the mean of what its neighbours say of it, over the time in which noise of the process
    grows to that of the measurement. A residual has the error of its own first state in it, with the other sign: terms in that very state
    would find it. r: (n, nx) what the model leaves; by what it does not, it moves on from a neighbour to the state that is asked for: of a
    robot that turns, the plain mean of headings is another heading. Where speeds were not measured, r is not of these states.
    """
    steps = given.steps
    moves = np.zeros_like(r) if given.floor.axes else steps.y1 - steps.y0 - r
    first = np.flatnonzero(~steps.joined)
    edges = np.append(first, len(steps))
    number = np.repeat(first, np.diff(edges)), np.repeat(edges[1:], np.diff(edges))
    y = steps.y0.copy()
    at = np.arange(len(y))
    for i, wide in enumerate(np.sqrt(noise.r / noise.q)):
        half = int(min(wide, WIDEST))
        if half:
            gone = np.concatenate([[0.0], np.cumsum(moves[:-1, i])])
            total = np.concatenate([[0.0], np.cumsum(steps.y0[:, i] - gone)])
            reach = np.minimum(np.minimum(at - number[0], number[1] - 1 - at), half)
            y[:, i] = (total[at + reach + 1] - total[at - reach]) / (2 * reach + 1) + gone
    return y


def _varying(given: Problem, model: ComposedModel, t: Array, u: Array) -> Iterator[tuple[str, Terms]]:
    """A number of an effect that the data, not the user, put there, and that is not one number: it grows with time, with the speed, with an
    input's size. What a change of it would do, times that.
    """
    free = free_of(model)
    moved = slopes(given, model, free) if free else np.zeros((*given.steps.y0.shape, 0))
    speed = [_scaled(np.abs(given.steps.y0[:, i]), centred=False) for i, name in enumerate(model.states) if name in VELOCITIES]
    for place in dict.fromkeys(slot.place for slot in free):
        own = [moved[:, :, k] for k, slot in enumerate(free) if slot.place == place]
        effect, channel = model.effects[place].effect, model.effects[place].channel
        on_input = channel in model.inputs
        if given.data.in_order:
            waves = [t, *(f(np.pi * k * t) for k in (1, 2, 3) for f in (np.sin, np.cos))]
            yield f"time*{channel}" if on_input else "time", [w[:, None] * m for m in own for w in waves]
        remembers = on_input and effect.hidden(1, model.nominal, channel, model.dt, model.effects[place].p).size > 0
        for j, name in enumerate(model.inputs):
            token = f"memory({channel})" if remembers else f"{channel}*{name}" if on_input and channel != name else name
            yield token, [np.abs(u[:, j])[:, None] * m for m in own]
        if speed:
            yield f"memory({channel})" if remembers else "speed", [v[:, None] * m for m in own for v in speed]


def _drifting_heading(steps: Steps, model: ComposedModel, t: Array) -> Iterator[Terms]:
    """A heading that is measured ever further off, by c(t): it turns by c', and goes aside by c of its way (t from 0 to 1; c: a line, and
    waves).
    """
    x, y, theta = (model.states.index(name) for name in ("x", "y", "theta"))
    aside = np.zeros_like(steps.y0)
    aside[:, x], aside[:, y] = steps.y1[:, y] - steps.y0[:, y], steps.y0[:, x] - steps.y1[:, x]
    about = np.zeros_like(aside)
    about[:, theta] = np.median(np.diff(t)) if len(t) > 1 else 0.0
    waves = [(f(w * t), w * df(w * t)) for w in np.pi * np.arange(1, 5) for f, df in ((np.sin, np.cos), (np.cos, lambda a: -np.sin(a)))]
    yield [t[:, None] * aside + about, aside]
    yield [aside, *(c[:, None] * aside + rate[:, None] * about for c, rate in [(t, np.ones(len(t))), *waves])]


def _over_time(t: Array, u: Array) -> Iterator[Terms]:
    """An input that does more or less as time goes on (t from 0 to 1): steadily, slowly up and down, from some time on."""
    yield [t * u]
    yield [t * u, *(f(np.pi * k * t) * u for k in range(1, 7) for f in (np.sin, np.cos))]
    yield [np.where(t > s, u, 0.0) for s in np.linspace(0.1, 0.9, 9)]


def _hum(r: Array, given: Problem, directions: Terms) -> Iterator[Terms]:
    """A wave of the one frequency at which the residual has a line in its spectrum, if it has one. r: (n, nx)."""
    dt, steps = given.data.dt, given.steps
    place = np.floor((steps.t - steps.t[0]) / dt + 0.01).astype(np.int64)
    if not directions or place[-1] >= LONGEST or np.any(np.diff(place) <= 0):
        return
    series = np.zeros((int(place[-1]) + 1, len(directions)))
    seen = np.stack([np.sum(r * d, axis=1) for d in directions], axis=1)  # where nothing pushes, nothing is seen
    series[place] = seen - seen.mean(axis=0)  # and none where nothing was measured
    frequency, height = line(series, dt)
    if height > LINE:
        yield [f(2.0 * np.pi * frequency * steps.t) for f in (np.sin, np.cos)]


def line(series: Array, dt: float) -> tuple[float, float]:
    """Frequency (Hz) at which the spectrum of a column of (n, c) stands out most from its neighbourhood, and how many times that is."""
    series = series - series.mean(axis=0)
    kept = np.sum(series[1:] * series[:-1], axis=0) / np.maximum(np.sum(series**2, axis=0), 1e-300)
    series = series[1:] - np.clip(kept, 0.0, 1.0) * series[:-1]  # the spectrum of what wanders falls steeply: that is no line
    padded = FINER * len(series)
    power = np.abs(np.fft.rfft(series, padded, axis=0)) ** 2
    first, wide = ROUNDS * FINER, FLOOR * FINER
    if len(power) < 2 * wide:
        return 0.0, 0.0
    edges = np.linspace(first, len(power), max((len(power) - first) // wide, 1) + 1).astype(int)
    middles = 0.5 * (edges[:-1] + edges[1:])
    levels = np.array([np.median(power[a:b], axis=0) for a, b in pairwise(edges.tolist())]) / math.log(2.0)
    at = np.arange(first, len(power))
    floor = np.stack([np.interp(at, middles, column) for column in levels.T], axis=1)
    ratio = power[first:] / np.maximum(floor, 1e-300)
    k, c = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    return float((k + first) / (padded * dt)), float(ratio[k, c])


def _static(u: Array) -> Iterator[Terms]:
    """Shapes of one input, on a scale of 1: a few, and many."""
    a = np.abs(u)
    yield [u, u * a, np.sign(u) * (a > 0.02)]
    yield [u, a, u * a, u * u, np.sign(u) * (a > 0.02), *(np.sign(u) * np.maximum(a - s, 0.0) for s in (0.1, 0.25, 0.5, 0.75))]
    yield [u, *(f(0.5 * np.pi * k * u) for k in range(1, 13) for f in (np.sin, np.cos))]


def _levels(r: Array, u: Array, directions: Terms) -> Iterator[Terms]:
    """What comes again and again as the input grows (on a scale of 1): commands that are carried out in steps. Of the one number of steps
    at which the residual r (n, nx) follows the input most, if it stands out.
    """
    if len(np.unique(u)) < FLOOR:
        return
    steps = np.arange(FEWEST_LEVELS, MOST_LEVELS + 0.5, 0.5)
    seen = np.stack([np.sum(r * d, axis=1) for d in directions], axis=1)
    seen = np.clip(seen - np.median(seen, axis=0), *(sign * 4.0 * np.median(np.abs(seen), axis=0) for sign in (-1, 1)))
    turns = np.tile(np.exp(-0.5j * np.pi * u), (len(steps), 1))
    turns[0] = np.exp(-1j * np.pi * steps[0] * u)
    power = np.abs(np.multiply.accumulate(turns) @ seen) ** 2
    ratio = power / np.maximum(np.median(power, axis=0) / math.log(2.0), 1e-300)
    k, c = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    if ratio[k, c] > LINE:
        yield [f(h * np.pi * steps[k] * u) for h in (1, 2, 3) for f in (np.sin, np.cos)]


def _memory(u: Array, place: NDArray[np.int64]) -> Iterator[Terms]:
    """Earlier values of one input, and its slow means, less its present one. The first steps of a run see the run before: few, and
    harmless."""
    yield [u[np.maximum(place - lag, 0)] - u[place] for lag in (1, 2)]
    terms = [u[np.maximum(place - lag, 0)] - u[place] for lag in LAGS]
    means = [_mean_before(u, place, width) - u[place] for width in (12, 30, 80)]
    yield [*terms, *means]
    heat = [_mean_before(u * u, place, width) for width in (30, 100, 300, 1000)]
    yield [*(h * u[place] for h in heat), *(h * u[place] ** 3 for h in heat[:1])]


def _bent_memory(u: Array, place: NDArray[np.int64]) -> Iterator[Terms]:
    """Memory that is not linear: slower one way than the other, slower when there is more of it; and play, which holds where it is."""
    behind = [u[np.maximum(place - lag, 0)] - u[place] for lag in (1, 2, 4, 8, 16, 32)]
    yield [*behind, *(np.abs(d) for d in behind), *(d * np.abs(u[place]) for d in behind)]
    yield [(_play(u, width) - u)[place] for width in PLAYS]


def _play(u: Array, width: float) -> Array:
    """u behind a play of this width: it follows only when it is taken along."""
    behind, half = [], 0.5 * width
    now = 0.0
    for value in u.tolist():
        now = min(max(now, value - half), value + half)
        behind.append(now)
    return np.array(behind)


def _mean_before(u: Array, place: NDArray[np.int64], width: int) -> Array:
    total = np.concatenate([[0.0], np.cumsum(u)])
    begin = np.maximum(place - width, 0)
    return np.asarray((total[place] - total[begin]) / np.maximum(place - begin, 1))


def _of_states(
    model: ComposedModel, y: Array, u: Array, body: Terms, world: Terms, pushes: Terms
) -> Iterator[tuple[str, Terms, Terms | None]]:
    """Terms in the heading, the position, the speed, and any other state of a model of the user's own, and where they push. pushes: what
    each input does now, for terms that say how much more or less of it there is (None: they push by themselves).
    """
    known: set[str] = set()
    inputs, one = [u[:, j] for j in range(u.shape[1])], np.ones(len(u))
    for name in model.nominal.angles:
        angle = y[:, model.states.index(name)]
        token = token_of(model, name)
        first, second = [np.cos(angle), np.sin(angle)], [np.cos(2.0 * angle), np.sin(2.0 * angle)]
        known.add(name)
        yield token, first, body
        yield token, [c * v for c in first for v in inputs], body
        yield token, [c * v for c in [one, *first, *second] for v in [one, *inputs]], body
        ripples = [wave(k * angle) for k in range(1, HARMONICS + 1) for wave in (np.cos, np.sin)]
        yield token, ripples, body
        yield token, [c[:, None] * p for c in ripples for p in pushes], None
        yield from ((token, [c * v for c in ripples], body) for v in inputs)
    position = [_scaled(y[:, i]) for i, name in enumerate(model.states) if name in {"x", "y", "z", "q"}]
    posed = {*model.states} >= POSE
    anywhere = world if posed else [*body, *world]
    if position:
        known |= {"x", "y", "z", "q"}
        squares = [a * b for i, a in enumerate(position) for b in position[: i + 1]]
        yield "position", [one, *position], anywhere
        yield "position", [a * v for a in position for v in inputs], body
        yield "position", [c[:, None] * p for c in _patches(position) for p in pushes], None
        for a in [] if posed else position:
            yield "position", [*_push(_at_ends(a), body), *(c[:, None] * p for c in _there(a) for p in pushes)], None
        yield "position", [one, *position, *squares, *(a**3 for a in position)], [*body, *world]
        for a in position:
            yield "position", [f(np.pi * k * a) for k in range(1, WAVES + 1) for f in (np.sin, np.cos)], anywhere
        rubbed = [term for i in _speeds(model) for term in _rubbed(_patches(position), y[:, i], _pushing(body, i))]
        if rubbed:
            yield "position", rubbed, None
    speed = [_scaled(y[:, i], centred=False) for i, name in enumerate(model.states) if name in VELOCITIES]
    if speed:
        known |= set(VELOCITIES)
        yield "speed", speed, body
        yield "speed", [f for v in speed for f in (v, np.abs(v) * v, v**3, np.tanh(v / 0.05), np.abs(v))], body
        if len(speed) > 1:
            yield "speed", [v * w for i, v in enumerate(speed) for w in speed[: i + 1]], body
    for i, name in enumerate(model.states):
        if name not in known:
            v = _scaled(y[:, i])
            yield name, [v, v * v, v**3, np.sign(v), *(v * w for w in inputs)], [*body, *world]


def _not_its_rate(given: Problem, model: ComposedModel) -> Iterator[Terms]:
    """A position that moves otherwise than its speed says, although inputs push neither beside the other: by a share of the speed (a
    sensor's scale), or as the speed was a while ago (a sensor that comes late). Speeds as they were measured until then, no later one: a
    controller that sees a position's noise makes speed of it. Of what was, what is left when whitened knows nothing.
    """
    y = given.steps.y0
    shares: Terms = []
    late: Terms = []
    first = np.flatnonzero(~given.steps.joined)
    begin = np.repeat(first, np.diff(np.append(first, len(y))))
    at = np.arange(len(y))
    for axis in axes(model.nominal):
        v, push = _scaled(y[:, axis.velocity], centred=False), np.eye(len(model.states))[axis.position]
        shares.append(v[:, None] * push)
        late += [(v[np.maximum(at - lag, begin)] - v)[:, None] * push for lag in LAGS[:MOST_LATE]]
    if shares:
        yield shares
        yield [*shares, *late]


def _moving(model: ComposedModel, y: Array) -> Terms:
    """What friction goes with, of each speed of the states y (n, nx)."""
    return [f for i in _speeds(model) for f in _dry(y[:, i])]


def _speeds(model: ComposedModel) -> list[int]:
    return [i for i, name in enumerate(model.states) if name in VELOCITIES]


def _pushing(directions: Sequence[Array], i: int) -> list[Array]:
    """Those that push state i."""
    return [d for d in directions if np.any(d[:, i])]


def _rubbed(patches: Terms, v: Array, directions: Sequence[Array]) -> Terms:
    """Friction of one speed on patches of the floor: it brakes that speed, and no other."""
    return _push([c * f for c in patches for f in _dry(v)], directions)


def _dry(v: Array) -> tuple[Array, Array]:
    """Which way it moves, and how fast."""
    v = _scaled(v, centred=False)
    return np.tanh(v / 0.05), v


def _patches(position: Sequence[Array]) -> Terms:
    """Smooth bumps over where the robot was: a grid of PATCHES along each axis (at most two axes)."""
    centres = np.linspace(-0.8, 0.8, PATCHES)
    bumps = [[np.exp(-0.5 * ((p - c) * PATCHES / 1.6) ** 2) for c in centres] for p in position[:2]]
    return bumps[0] if len(bumps) == 1 else [a * b for a in bumps[0] for b in bumps[1]]


def _at_ends(position: Array) -> Terms:
    """How far it is into either end of where it ever was, and whether it is there: end stops, which push back ever more, or at once."""
    return [side * f for side, d in _depths(position) for f in (np.maximum(d, 0.0), (d > 0.0).astype(float))]


def _there(position: Array) -> Terms:
    """Whether it is at either end: a stop holds against whatever pushes there."""
    return [(d > 0.0).astype(float) for _, d in _depths(position)]


def _depths(position: Array) -> Iterator[tuple[float, Array]]:
    """(side, depth beyond a place near that end, over the distance of that place from the end)."""
    low, high = float(np.min(position)), float(np.max(position))
    for near in NEAR_ENDS:
        reach = max(near * (high - low), 1e-12)
        yield 1.0, (position - high) / reach + 1.0
        yield -1.0, (low - position) / reach + 1.0


def _scaled(v: Array, *, centred: bool = True) -> Array:
    v = v - float(np.mean(v)) if centred else v
    return v / max(float(np.max(np.abs(v))), 1e-12)


def _push(terms: Sequence[Array], directions: Sequence[Array]) -> Terms:
    return [c[:, None] * d for c in terms for d in directions]


def directions_of(given: Problem, model: ComposedModel, act: Acting) -> tuple[list[Array], list[Array]]:
    """((n, nx) each) in which something can push: along, across and about the body and each further state; and the world's axes. For a
    model without a planar pose, where its inputs push (each state, if they push nowhere); and its axes, along which none of them does.
    """
    n, nx = given.steps.y0.shape
    unit = np.eye(nx)
    if {*model.states} >= POSE:
        x, y, theta = (model.states.index(name) for name in ("x", "y", "theta"))
        c, s = np.cos(given.steps.y0[:, theta]), np.sin(given.steps.y0[:, theta])
        along, across = np.zeros((n, nx)), np.zeros((n, nx))
        along[:, x], along[:, y], across[:, x], across[:, y] = c, s, -s, c
        others = [np.tile(unit[i], (n, 1)) for i in range(nx) if i not in {x, y}]
        return [along, across, *others], [np.tile(unit[x], (n, 1)), np.tile(unit[y], (n, 1))]
    own = own_pushes(given, model, act)
    if not any(np.any(d) for d in own):
        return [np.tile(axis, (n, 1)) for axis in unit], []
    alone = [np.tile(axis, (n, 1)) for axis in _pushed_alone(model)]
    return own, [axis for axis in alone if not any(_along(model, axis, push) for push in own)]


def _pushed_alone(model: ComposedModel) -> Terms:
    """(nx,) where a force along one axis pushes: the ground lifts what flies, however it tilts. Not of links that move one another."""
    if coupled(model.nominal):
        return []
    unit = np.eye(len(model.states))
    lone = [unit[model.states.index(name)] for name in lone_speeds(model.nominal, slowed=True)]
    return [*(unit[axis.velocity] + 0.5 * model.dt * unit[axis.position] for axis in axes(model.nominal)), *lone]


def _along(model: ComposedModel, axis: Array, push: Array) -> bool:
    """Whether a push (n, nx) changes speeds only along one axis (n, nx), where it changes any."""
    speeds = [*(one.velocity for one in axes(model.nominal)), *map(model.states.index, lone_speeds(model.nominal, slowed=True))]
    there = push[:, speeds]
    there = there[np.any(there, axis=1)]
    own = np.argmax(axis[0, speeds])
    return len(there) > 0 and float(np.mean(there[:, own] ** 2 / np.sum(there**2, axis=1))) > PARALLEL


def own_pushes(given: Problem, model: ComposedModel, act: Acting) -> Terms:
    """(n, nx) by input: where it pushes."""
    here = act.at(given.steps.place)
    usual, pushed = wherever(model, given.steps.y0, here, slice(None)), []
    for j in range(here.mean.shape[1]):
        h = 1e-4 * max(1.0, float(np.max(np.abs(here.mean[:, j]), initial=0.0)))
        up = np.zeros(here.mean.shape[1])
        up[j] = h
        pushed.append((wherever(model, given.steps.y0, here.moved(up), slice(None)) - usual) / h)
    return pushed
