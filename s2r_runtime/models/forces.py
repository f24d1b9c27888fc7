"""Forces on the axes of a model, all of them together over one step.

An axis is a position q and its rate v. The nominal step takes v0 to v1 with the constant acceleration a = (v1 - v0)/dt; forces add to it:

    v' = a + drive - rate± v - dry± sign(v),      q' = v,      + while v > 0, - while v < 0
    v stays 0 while  -hold- <= a + drive <= hold+                (hold: what dry friction holds at rest; dry, if it is not more)

With constant coefficients this has an exact solution: one exponential up to the moment of standing still, another one after it, or none.
So dry friction stops a motion and never turns it, whatever the step. Coefficients that depend on the state are taken at the middle
of parts of the step (second order; a position there is that at the part's start and half a part of the speed there, which keeps the
energy of a spring). Positions move by the integral of v. All accelerations: of a force over the mass, if there is one.

Joints of an arm move one another: in somebody's own model with an input on every axis, the inverse W(x) of its mass matrix (`mobility`)
says what a force on one does to all. A force F on each axis, in the unit of its input, then adds W F to the accelerations. Each axis in
turn is moved as above under what the others' forces make of its drive, until none changes (projected Gauss-Seidel sweeps, which find what
friction holds on several axes at once: J. J. Moreau, "Unilateral contact and dry friction in finite freedom dynamics", 1988).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import NominalModel
from s2r_runtime.models.bound import PROBED, BoundModel
from s2r_runtime.models.file_model import FileModel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Value = Array | float
Pair = tuple[Value, Value]

PART_S = 0.0125
"""Longest part of a step in which a coefficient that depends on the state is one number, s: an eighth of the longest usual step. It is
not chosen by what the coefficient does there: predictions would jump where its number of parts does, and have no derivative.
"""

LEAST = -50.0
"""Of rate times time: a motion that feeds itself grows by e^50 within a step at most, so that numbers stay finite."""

SMALL = 1e-3
"""Of rate times time: below it a series of four terms is exact to rounding."""

LIKE_NONE = 1e-300
"""Of rate times time: it may be divided by, and what comes out is that of none."""

PROBE_S, PROBE = 1e-3, 1e-3
"""Step within which a bit of an input says whether inputs are forces, s: short against any motion, long against rounding; and that bit,
over the inputs.
"""

SHORT_S = 1e-4
"""The same where axes move one another, s: a light link at the end of an arm loses a few per cent of its speed within PROBE_S."""

COUPLED, SYMMETRIC = 1e-3, 0.02
"""Of the geometric mean of two axes' own mobilities: from where on one moves the other, and how far a mass matrix may be off symmetry by
what changes within two probes.
"""

SWEEPS, SETTLED = 40, 1e-9
"""Most sweeps over axes that move one another, and the change of what friction does, over the largest, at which they are done. Two thirds
of the error are left by one where two links hold each other, and next to none where they move.
"""

FEWER, LEFT = 0.7, 0.95
"""Share of the rows below which sweeping what is left of them saves more than taking them out costs; largest share that a sweep is taken to
leave.
"""

NAMED_RATES = {"vx": "x", "vy": "y", "vz": "z", "qd": "q"}
"""Rates by their names, in models that do not say whose rates their states are. With a heading, vx could be along the body: it must say."""


class Axis(NamedTuple):
    """Columns of x."""

    position: int
    velocity: int


@dataclass(frozen=True)
class Push:
    """What one effect adds on one axis: numbers, or (n,). Pairs: while moving forward, backward. hold: at rest; None: as dry."""

    drive: Value = 0.0
    rate: Pair = (0.0, 0.0)
    dry: Pair = (0.0, 0.0)
    hold: Pair | None = None


Pushing = tuple[Any, str, dict[str, Any]]
"""An effect with a `push`, its channel and its values."""


def axes(model: NominalModel) -> tuple[Axis, ...]:
    """The model's axes, in the order of their velocities."""
    if isinstance(model, BoundModel):
        if model not in _KNOWN:
            _KNOWN[model] = _axes(model)
        return _KNOWN[model]
    return _axes(model)


_KNOWN: WeakKeyDictionary[BoundModel, tuple[Axis, ...]] = WeakKeyDictionary()


def _axes(model: NominalModel) -> tuple[Axis, ...]:
    rates = {} if "theta" in model.states else {v: q for v, q in NAMED_RATES.items() if {v, q} <= {*model.states}}
    for name, follows in getattr(model, "follows", {}).items():
        if len(follows.of) == 1:
            one = np.ones(1)
            if np.array_equal(follows.formula({follows.of[0]: 0.7 * one}, {follows.of[0]: one}, model.parameters), one):
                rates[name] = follows.of[0]
    return tuple(Axis(model.states.index(rates[name]), j) for j, name in enumerate(model.states) if name in rates)


SET = 0.01
"""Of a speed, what a model must keep over PROBE_S for it to be one that something pushes, and not one that is set at once."""

EVEN, RATES_KEPT = 1e-3, 256
"""Of what a model loses of a speed, by how much that may differ from state to state and still be in proportion; parameter values of which
losses are known at a time.
"""

LETTERS = {"v", "vx", "vy", "vz", "w"}
"""Words in names of speeds (cmd_v, w_ref)."""

TURNING = ("roll", "pitch", "yaw", "turn")

POSE = {"x", "y", "theta"}

_LONE: WeakKeyDictionary[BoundModel, dict[str, bool]] = WeakKeyDictionary()


def lone_speeds(model: NominalModel, slowed: bool = False) -> tuple[str, ...]:
    """States of somebody's own model that are speeds by their names, without a position, and that the model itself does not slow down.
    (A flying robot's, under tilt and thrust; a motor's.) Forces act on them as on an axis. slowed: with those that it does slow down: what
    it knows of that in proportion to speed has a parameter there (a motor's back EMF), but not all that may brake it besides.
    """
    if not isinstance(model, BoundModel) or not isinstance(model.shared, FileModel):
        return ()
    if model not in _LONE:
        _LONE[model] = {} if {*model.states} >= POSE else _lone_speeds(model)
    return tuple(name for name, losing in _LONE[model].items() if slowed or not losing)


def is_speed(name: str) -> bool:
    """Whether a name says so. A level does not, nor a battery's voltage, nor a rate of flow."""
    words = name.lower().split("_")
    if any(word.startswith(("bat", "volt")) for word in words):
        return False
    return any(
        word in LETTERS
        or "speed" in word
        or "omega" in word
        or ("vel" in word and "level" not in word)
        or (word.endswith("rate") and any(turn in name.lower() for turn in TURNING))
        for word in words
    )


def turns(name: str) -> bool:
    """Whether a speed is one of turning, by its name."""
    return "omega" in name.lower() or any(word in {"w", "qd"} or word.startswith(TURNING) for word in name.lower().split("_"))


def _lone_speeds(model: BoundModel) -> dict[str, bool]:
    """Each with whether the model slows it down."""
    moving = {model.states[axis.velocity] for axis in axes(model)}
    found = {}
    for name in (s for s in model.states if s not in moving and (is_speed(s) or s in NAMED_RATES)):
        kept = _kept(model, model.states.index(name), PROBE_S, model.parameters, 1.0)
        if kept is not None and np.all(np.abs(kept - 1.0) < 1e-9):
            found[name] = False
        elif kept is not None and np.all((kept > SET) & (kept <= 1.0 + 1e-9)):
            found[name] = True
    return found


def _kept(model: BoundModel, column: int, dt: float, parameters: dict[str, float], size: float) -> Array | None:
    """(8,) what the model keeps of a speed over a step, a share of it, at random states of this size; None if it gives no numbers there."""
    model = replace(model, finer=False, schemes={})  # in parts of a step, what a speed does to other states comes back to it
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1.0, 1.0, (8, len(model.states))), rng.uniform(-1.0, 1.0, (8, len(model.inputs)))
    x, faster = size * x, size * x
    faster[:, column] += size
    try:
        more, usual = (model.step(start, u, dt, parameters)[:, column] for start in (faster, x))
    except ConfigError:  # a user's model that cannot be stepped just anywhere
        return None
    return np.asarray((more - usual) / size)


_SLOWED: WeakKeyDictionary[BoundModel, dict[tuple[object, ...], tuple[float, float]]] = WeakKeyDictionary()


def own_rate(model: NominalModel, column: int, dt: float | Array, parameters: dict[str, float] | None = None) -> Value:
    """1/s by which somebody's own model slows a speed down in proportion to it, a number (or (n,), with dt): what pushes it is slowed down,
    too. 0 where it loses nothing, or otherwise than in proportion, or is set at once; and of a model that is not somebody's own, which has
    forces besides. parameters: others than the model's.
    """
    if not isinstance(model, BoundModel) or not isinstance(model.shared, FileModel):
        return 0.0
    known = _SLOWED.setdefault(model, {})
    values = model.parameters if parameters is None else parameters
    key = (column, *values.items())
    if key not in known:
        if len(known) >= RATES_KEPT:
            known.clear()
        known[key] = _rates(model, column, values)
    rate, each = known[key]
    return rate if each == 0.0 else each / dt


def _rates(model: BoundModel, column: int, parameters: dict[str, float]) -> tuple[float, float]:
    """(per s, per step): the second one of a model that was identified for one step, and does not ask how long it is."""
    once = [_kept(model, column, PROBE_S, parameters, size) for size in PROBED]
    twice = _kept(model, column, 2.0 * PROBE_S, parameters, 1.0)
    if twice is None or any(kept is None for kept in once):
        return 0.0, 0.0
    kept = np.concatenate([one for one in once if one is not None])
    if np.ptp(kept) > EVEN * abs(1.0 - kept[0]) or not SET < kept[0] < 1.0 - 1e-9:
        return 0.0, 0.0
    loss = -math.log(kept[0])
    asks = abs(twice[0] - kept[0]) > EVEN * abs(1.0 - kept[0])
    return (loss / PROBE_S, 0.0) if asks else (0.0, loss)


def mass_name(model: NominalModel) -> str:
    """Name of the parameter by which forces are divided; empty if inputs are accelerations."""
    return next((name for name in ("mass", "inertia") if name in model.parameters), "")


def mass(model: NominalModel) -> float:
    """By which a force is divided; 1 if inputs are accelerations."""
    name = mass_name(model)
    return float(model.parameters[name]) if name else 1.0


def axis_of(model: NominalModel, channel: str) -> Axis | None:
    """The axis whose position or velocity the channel is."""
    return next((axis for axis in axes(model) if channel in {model.states[axis.velocity], model.states[axis.position]}), None)


def is_rotary(model: NominalModel, axis: Axis) -> bool:
    """Whether an axis turns, by its units; without units, if its position wraps or the model has an inertia and no mass."""
    units: dict[str, str] = getattr(model, "units", {})
    position, velocity = model.states[axis.position], model.states[axis.velocity]
    if position in units or velocity in units:
        return units.get(position) == "rad" or units.get(velocity) == "rad/s"
    return position in model.angles or mass_name(model) == "inertia"


def may_turn(model: NominalModel, axis: Axis) -> bool:
    """Whether an axis turns or may turn: the built-in joint's does if its `mass` is an inertia, and a file's `q` if it has no unit."""
    if is_rotary(model, axis):
        return True
    own = isinstance(model, BoundModel) and isinstance(model.shared, FileModel)
    return model.states[axis.position] == "q" and not (own and "q" in getattr(model, "units", {}))


def mass_on(model: NominalModel, channel: str) -> float:
    """Divisor of a force on an axis or a speed: kg, or kg m² on a rotary axis; 1 where the force is an acceleration.

    Whether a model's mass is that of a speed without a position is unknown. A rotary axis has an `inertia`; in a model with a mass only,
    the inertia on which its torque input acts.
    """
    if channel in lone_speeds(model, slowed=True):
        return 1.0
    axis = axis_of(model, channel)
    if axis is None or coupled(model) or not mass_name(model) or not is_rotary(model, axis):
        return mass(model)
    return float(model.parameters["inertia"]) if "inertia" in model.parameters else torque_inertia(model, axis) or 1.0


TORQUE_UNITS, EVENLY = {"N m", "Nm", "N*m", "N·m"}, 0.02
"""Of inputs; and the share by which what a torque does may differ from state to state where it acts on one inertia."""

_INERTIAS: WeakKeyDictionary[BoundModel, dict[Axis, float]] = WeakKeyDictionary()


def torque_inertia(model: NominalModel, axis: Axis) -> float:
    """kg m², the inertia on which the model's torque input acts; 0 where it has no such input, or none that acts on one inertia."""
    if not isinstance(model, BoundModel):
        return 0.0
    known = _INERTIAS.setdefault(model, {})
    if axis not in known:
        known[axis] = _torque_inertia(model, axis)
    return known[axis]


def _torque_inertia(model: BoundModel, axis: Axis) -> float:
    torques = [j for j, name in enumerate(model.inputs) if model.units.get(name) in TORQUE_UNITS]
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (8, len(model.states)))
    try:
        found = response(x, np.zeros((len(x), len(model.inputs))), model, SHORT_S, 1.0 / PROBE)[:, axis.velocity] / SHORT_S
    except ConfigError:  # a user's model that cannot be stepped just anywhere
        return 0.0
    for j in torques:
        usual = float(np.mean(found[:, j]))
        if usual and np.all(np.abs(found[:, j] - usual) <= EVENLY * abs(usual)):
            return 1.0 / abs(usual)
    return 0.0


def coupled(model: NominalModel) -> bool:
    """Whether its inputs are forces on its axes, one each in their order, that move one another: their mobility is the inverse of a mass
    matrix, symmetric and positive definite, and not diagonal, wherever it is looked at.
    """
    if not isinstance(model, BoundModel):
        return False
    if model not in _COUPLED:
        _COUPLED[model] = _coupled(model)
    return _COUPLED[model]


_COUPLED: WeakKeyDictionary[BoundModel, bool] = WeakKeyDictionary()


def _coupled(model: BoundModel) -> bool:
    if len(axes(model)) < 2 or len(axes(model)) != len(model.inputs):
        return False
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (8, len(model.states)))
    rates, rest = [axis.velocity for axis in axes(model)], np.zeros((len(x), len(model.inputs)))  # what 1 N m does to a finger is no bit
    try:
        w, later, back = (
            response(x, rest, model, dt, sign / PROBE)[:, rates] / dt
            for dt, sign in ((SHORT_S, 1.0), (2.0 * SHORT_S, 1.0), (SHORT_S, -1.0))
        )
    except ConfigError:  # a user's model that cannot be stepped just anywhere
        return False
    own = np.sqrt(np.abs(np.einsum("nii->ni", w)))
    size = own[:, :, None] * own[:, None, :]
    alike = all(np.all(np.abs(w - other) <= SYMMETRIC * size) for other in (later, back, w.transpose(0, 2, 1)))
    if not alike or not np.all(np.linalg.eigvalsh(0.5 * (w + w.transpose(0, 2, 1))) > 0.0):
        return False
    return bool(np.any(np.abs(w) * (1.0 - np.eye(len(axes(model)))) > COUPLED * size))


def response(x: Array, u: Array, model: NominalModel, dt: Any, size: float = 1.0) -> Array:
    """(n, nx, nu) what a unit more of each input makes of x (n, nx) over a step under u (n, nu); size: of the probe, over the inputs'."""
    probe = size * PROBE * max(float(np.max(np.abs(u), initial=0.0)), PROBE)
    usual = model.step(x, u, dt, model.parameters)
    made = []
    for j in range(u.shape[1]):
        more = u.copy()
        more[:, j] += probe
        made.append((model.step(x, more, dt, model.parameters) - usual) / probe)
    return np.stack(made, axis=2)


_LAST: WeakKeyDictionary[BoundModel, tuple[float | Array, Array, Array, Array]] = WeakKeyDictionary()


def _response(x: Array, u: Array, model: BoundModel, dt: float | Array) -> Array:
    """`response`, kept for the last rows asked for, as a fit asks of the same ones again. What another thread keeps is not returned."""
    known = _LAST.get(model)
    if known is not None and np.array_equal(known[0], dt) and np.array_equal(known[1], x) and np.array_equal(known[2], u):
        return known[3]
    found = response(x, u, model, dt)
    _LAST[model] = (np.copy(dt), x.copy(), u.copy(), found)
    return found


def pushed(
    x: Array,
    u: Array,
    x_next: Array,
    model: NominalModel,
    pushing: Sequence[Pushing],
    dt: float | Array,
    parameters: dict[str, float] | None = None,
) -> Array:
    """The result of the step under u without these effects, x_next (n, nx), with all of them. dt: also of each row, (n,). parameters: by
    which the model slows down, if others than its own.
    """
    alone = {*lone_speeds(model, slowed=True)}.intersection(channel for _, channel, _ in pushing)
    for name in sorted(alone):
        rate = own_rate(model, model.states.index(name), dt, parameters)
        x_next = _braked(x, u, x_next, model, [one for one in pushing if one[1] == name], dt, rate)
    pushing = [one for one in pushing if one[1] not in alone]
    if not pushing:
        return x_next
    if isinstance(model, BoundModel) and coupled(model):
        return _pushed_together(x, u, x_next, model, pushing, dt)
    varies = any(effect.varies for effect, _, _ in pushing)
    moved = [k for k in axes(model) if any(effect.push(x[:1], k, model, channel, p) is not None for effect, channel, p in pushing)]
    rates = [own_rate(model, k.velocity, dt, parameters) for k in moved]
    given = [_given(x[:, k.velocity], x_next[:, k.velocity], rate, dt) for k, rate in zip(moved, rates, strict=True)]
    parts = max(1, math.ceil(float(np.max(dt, initial=0.0)) / PART_S - 1e-9)) if varies else 1
    h = dt / parts
    now, at = (x.copy(), x.copy()) if varies else (x, x)
    for _ in range(parts if varies else 0):
        for k, g, rate in zip(moved, given, rates, strict=True):
            half, _ = _glide(now[:, k.velocity], g, _losing(_together(now, u, k, model, pushing), rate), 0.5 * h)
            at[:, k.position] = now[:, k.position] + 0.5 * h * now[:, k.velocity]
            at[:, k.velocity] = half
        for k, g, rate in zip(moved, given, rates, strict=True):
            now[:, k.velocity], way = _glide(now[:, k.velocity], g, _losing(_together(at, u, k, model, pushing), rate), h)
            now[:, k.position] += way
    after = x_next.copy()
    for k, g, rate in zip(moved, given, rates, strict=True):
        v = np.ascontiguousarray(x[:, k.velocity])
        if varies:
            end, way = now[:, k.velocity], now[:, k.position] - x[:, k.position]
        else:
            end, way = _glide(v, g, _losing(_together(x, u, k, model, pushing), rate), dt)
        after[:, k.position] += way - (dt * v + 0.5 * dt * dt * g if _lossless(rate) else _moved(v, g, _flow(rate, dt))[1])
        after[:, k.velocity] = end
    return after


def _lossless(rate: Value) -> bool:
    return not isinstance(rate, np.ndarray) and rate == 0.0


def _given(v: Array, v_next: Array, rate: Value, dt: float | Array) -> Array:
    """(n,) the acceleration that the model itself gives, besides what it loses at this rate: with both, v becomes v_next."""
    if _lossless(rate):
        return (v_next - v) / dt
    flow = _flow(rate, dt)
    return np.asarray((v_next - flow.keep * v) / flow.first)


def _losing(push: Push, rate: Value) -> Push:
    """A push where the model itself slows down at this rate."""
    return push if _lossless(rate) else replace(push, rate=_sum(push.rate, (rate, rate)))


def _braked(x: Array, u: Array, x_next: Array, model: NominalModel, pushing: Sequence[Pushing], dt: float | Array, rate: Value) -> Array:
    """x_next (n, nx), under pushes on one speed that has no position, which the model itself slows down at this rate."""
    j = model.states.index(pushing[0][1])
    axis = Axis(x.shape[1], j)  # a push that asks where it is fails
    varies = any(effect.varies for effect, _, _ in pushing)
    parts = max(1, math.ceil(float(np.max(dt, initial=0.0)) / PART_S - 1e-9)) if varies else 1
    given, at = _given(x[:, j], x_next[:, j], rate, dt), x.copy()
    v = np.ascontiguousarray(x[:, j])
    for _ in range(parts):
        at[:, j] = v
        if varies:
            at[:, j] = _glide(v, given, _losing(_together(at, u, axis, model, pushing), rate), 0.5 * dt / parts)[0]
        v = _glide(v, given, _losing(_together(at, u, axis, model, pushing), rate), dt / parts)[0]
    after = x_next.copy()
    after[:, j] = v
    return after


def _pushed_together(x: Array, u: Array, x_next: Array, model: BoundModel, pushing: Sequence[Pushing], dt: float | Array) -> Array:
    """The same where axes move one another: forces act as the inputs u do, so that what they change turns what else depends on speeds."""
    among = axes(model)
    does = mass(model) * _response(x, u, model, dt)
    w = does[:, [k.velocity for k in among]] / (dt[:, None, None] if isinstance(dt, np.ndarray) else dt)
    given = [(x_next[:, k.velocity] - x[:, k.velocity]) / dt for k in among]
    varies = any(effect.varies for effect, _, _ in pushing)
    parts = max(1, math.ceil(float(np.max(dt, initial=0.0)) / PART_S - 1e-9)) if varies else 1
    h = dt / parts
    now, mean = x.copy(), np.zeros((len(among), len(x)))
    for _ in range(parts):
        at = now.copy()
        for k, g in zip(among if varies else (), given, strict=False):
            at[:, k.position] += 0.5 * h * now[:, k.velocity]
            at[:, k.velocity] += 0.5 * h * g
        pushes = [_times(_together(at, u, k, model, pushing), w[:, i, i]) for i, k in enumerate(among)]
        forces, moved = _swept([np.ascontiguousarray(now[:, k.velocity]) for k in among], given, pushes, w, h)
        mean += forces / parts
        for k, (end, way) in zip(among, moved, strict=True):
            now[:, k.velocity] = end
            now[:, k.position] += way
    after = np.asarray(x_next + np.einsum("nij,jn->ni", does, mean))
    for i, (k, g) in enumerate(zip(among, given, strict=True)):  # a force that changes within the step makes another way than its mean
        steady = dt * x[:, k.velocity] + 0.5 * dt * dt * (g + np.einsum("nj,jn->n", w[:, i], mean))
        after[:, k.position] += now[:, k.position] - x[:, k.position] - steady
    return after


def _swept(
    speeds: list[Array], given: list[Array], pushes: list[Push], w: Array, h: float | Array
) -> tuple[Array, list[tuple[Array, Array]]]:
    """Mean force of the pushes on each axis over h seconds, (axes, n), and each axis' speed then with the way made, all at once. Rows that
    are done are swept no more: most are after two or three. In others, where friction holds links against each other, each sweep leaves
    the same share of what the last one changed: every second one of the first half goes on to where that ends (A. Aitken, Proc. R. Soc.
    Edinburgh 46, 1926).
    """
    forces = np.zeros((len(speeds), len(speeds[0])))
    moved = [(v, v) for v in speeds]
    flows = [_flows(push.rate, h) for push in pushes]  # rates stay from sweep to sweep
    rows: slice | NDArray[np.int64] = slice(None)
    now, last = forces.copy(), forces
    for sweep in range(SWEEPS):
        before = now.copy()
        for i, (v, g, push, flow) in enumerate(zip(speeds, given, pushes, flows, strict=True)):
            drive = g + sum(w[:, i, j] * now[j] for j in range(len(speeds)) if j != i)
            end, way = _glide(v, drive, push, h, flow)
            now[i] = ((end - v) / h - drive) / w[:, i, i]
            if isinstance(rows, slice):
                moved[i] = end, way
            else:
                moved[i][0][rows], moved[i][1][rows] = end, way
        forces[:, rows] = now
        changed = now - before
        changing = np.flatnonzero(np.max(np.abs(changed), axis=0) > SETTLED * np.max(np.abs(forces), initial=1e-300))
        if not len(changing):
            break
        if len(changing) < FEWER * w.shape[0]:
            rows = changing if isinstance(rows, slice) else rows[changing]
            w, pushes = w[changing], [_rows(push, changing) for push in pushes]
            h = h[changing] if isinstance(h, np.ndarray) else h
            flows = [(_flow_at(ahead, changing), _flow_at(back, changing)) for ahead, back in flows]
            speeds, given = [v[changing] for v in speeds], [g[changing] for g in given]
            now, changed, last = now[:, changing], changed[:, changing], last[:, changing]
        if sweep % 2 and sweep < SWEEPS // 2:  # where links go on changing between stick and slip, steps so long never end
            share = np.sum(changed * last, axis=0) / np.maximum(np.sum(last**2, axis=0), 1e-300)
            share = np.clip(share, 0.0, LEFT)
            now = now + share / (1.0 - share) * changed
        last = changed
    return forces, moved


def _rows(push: Push, rows: NDArray[np.int64]) -> Push:
    """Of some of its rows."""
    drive = push.drive[rows] if isinstance(push.drive, np.ndarray) else push.drive
    return Push(drive, _at(push.rate, rows), _at(push.dry, rows), None if push.hold is None else _at(push.hold, rows))


def _flow_at(flow: Flow, rows: NDArray[np.int64]) -> Flow:
    """Of some of its rows."""
    return Flow(*(e[rows] if isinstance(e, np.ndarray) else e for e in flow))


def _times(push: Push, w: Array) -> Push:
    """As accelerations, of what is over the mass (n,) or the model's."""
    dry = _both(push.dry, w)
    return Push(push.drive * w, _both(push.rate, w), dry, None if push.hold is None else _both(push.hold, w))


def _both(pair: Pair, w: Array) -> Pair:
    if _alike(pair) and not isinstance(pair[0], np.ndarray) and pair[0] == 0.0:
        return pair
    first = pair[0] * w
    return first, first if _alike(pair) else pair[1] * w


def _together(x: Array, u: Array, axis: Axis, model: NominalModel, pushing: Sequence[Pushing]) -> Push:
    """The sum of all pushes on one axis, at x (n, nx) under u (n, nu)."""
    total = Push(hold=(0.0, 0.0))
    for effect, channel, p in pushing:
        under = getattr(effect, "push_under", None)
        one = effect.push(x, axis, model, channel, p) if under is None else under(x, u, axis, model, channel, p)
        if one is not None:
            total = Push(
                total.drive + one.drive,
                _sum(total.rate, one.rate),
                _sum(total.dry, one.dry),
                _sum(total.hold or (0.0, 0.0), one.dry if one.hold is None else one.hold),
            )
    return total


def _sum(a: Pair, b: Pair) -> Pair:
    first = a[0] + b[0]
    return first, first if a[0] is a[1] and b[0] is b[1] else a[1] + b[1]


def _glide(v: Array, given: Array, push: Push, h: float | Array, flows: tuple[Flow, Flow] | None = None) -> tuple[Array, Array]:
    """v (n,) h seconds later, and the way made, with constant coefficients; given: (n,) acceleration without the push; flows: `_flows` of
    it, where they are known.
    """
    drive = given + push.drive
    ahead, back = flows or _flows(push.rate, h)
    held = push.hold or push.dry
    if _alike(push.rate) and not any(_some(force) for force in (*push.dry, *held)):
        return _moved(v, drive, ahead)
    forward = v > 0.0
    sign = np.sign(v)
    pull = drive - sign * _by_sign(push.dry, forward)
    flow = ahead if back is ahead else Flow(*(_by_sign(pair, forward) for pair in zip(ahead, back, strict=True)))
    end, way = _moved(v, pull, flow)
    stops = np.flatnonzero(end * sign <= 0.0)
    if len(stops):
        begun, force = v[stops], drive[stops]
        whole = h[stops] if isinstance(h, np.ndarray) else h
        until = np.minimum(_time_to_rest(begun, pull[stops], _by_sign(_at(push.rate, stops), begun > 0.0)), whole)
        _, before = _moved(begun, pull[stops], _flow(_by_sign(_at(push.rate, stops), begun > 0.0), until))
        up, down = _at(held, stops)
        onward = np.where(force > up, 1.0, np.where(force < -down, -1.0, 0.0))
        rate, dry = (_by_sign(_at(pair, stops), onward > 0.0) for pair in (push.rate, push.dry))
        end[stops], after = _moved(np.zeros_like(begun), np.where(onward == 0.0, 0.0, force - onward * dry), _flow(rate, whole - until))
        way[stops] = before + after
    return end, way


class Flow(NamedTuple):
    """v' = pull - rate v over a time t, linear in v and pull:  v+ = keep v + first pull,  way = first v + second pull."""

    keep: Value
    first: Value
    second: Value


def _flows(rate: Pair, t: Value) -> tuple[Flow, Flow]:
    """While moving forward, and backward."""
    ahead = _flow(rate[0], t)
    return ahead, ahead if _alike(rate) else _flow(rate[1], t)


def _flow(rate: Value, t: Value) -> Flow:
    """keep = exp(-z), first = t (1 - exp(-z))/z, second = t² (z - 1 + exp(-z))/z², z = rate t."""
    z = rate * t
    if isinstance(z, np.ndarray):
        z = np.maximum(z, LEAST)
        safe = z if z.all() else np.where(z == 0.0, LIKE_NONE, z)
        one = -np.expm1(-safe) / safe
        two = np.where(np.abs(z) < SMALL, _series(z), (1.0 - one) / safe)
        return Flow(1.0 - z * one, t * one, t * t * two)
    z = max(float(z), LEAST)
    single = -math.expm1(-z) / z if z else 1.0
    return Flow(1.0 - z * single, t * single, t * t * (_series(z) if abs(z) < SMALL else (1.0 - single) / z))


def _series(z: Value) -> Value:
    """(z - 1 + exp(-z))/z², where the difference would lose digits."""
    return 0.5 - z * (1.0 / 6.0 - z * (1.0 / 24.0 - z / 120.0))


def _moved(v: Array, pull: Array, flow: Flow) -> tuple[Array, Array]:
    return flow.keep * v + flow.first * pull, flow.first * v + flow.second * pull


def _time_to_rest(v: Array, pull: Array, rate: Value) -> Array:
    """When v' = pull - rate v is 0: log(1 - rate v/pull)/rate; -v/pull without rate. pull is against v, or v is 0."""
    ratio = np.where(v == 0.0, 0.0, -v / np.where(pull == 0.0, 1.0, pull))
    z = rate * ratio
    safe = np.where(np.abs(z) < 1e-9, 1.0, z)
    return np.asarray(ratio * np.where(np.abs(z) < 1e-9, 1.0 - 0.5 * z, np.log1p(np.maximum(safe, -0.9999)) / safe))


def _alike(pair: Pair) -> bool:
    return pair[0] is pair[1] or (not isinstance(pair[0], np.ndarray) and not isinstance(pair[1], np.ndarray) and pair[0] == pair[1])


def _some(value: Value) -> bool:
    """Whether it is anything but zero. Mostly it is one number, and asked of that, numpy takes as long as for a thousand."""
    return bool(np.any(value)) if isinstance(value, np.ndarray) else value != 0.0


def _by_sign(pair: Pair, forward: Mask) -> Value:
    return pair[0] if _alike(pair) else np.where(forward, pair[0], pair[1])


def _at(pair: Pair, rows: NDArray[np.int64]) -> Pair:
    first = pair[0][rows] if isinstance(pair[0], np.ndarray) else pair[0]
    return first, first if pair[1] is pair[0] else pair[1][rows] if isinstance(pair[1], np.ndarray) else pair[1]
