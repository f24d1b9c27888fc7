"""Inputs that went on changing between the rows that hold them, and that a sensor told.

A recording that is slower than the loop it listens to (a joint's torque at 100 Hz out of 1 kHz, a quadrotor's tilt, a steering wheel's
angle) has samples of an input that moved on, not commands that were held. On average over a row such an input was up to halfway to the
next one: (m - 1) / (2 m) of the way if the loop set it m times a row, 1/2 if it went straight on. A sample is as noisy as its sensor,
too: what a smooth curve through its neighbours says of it, the robot may have felt. And a speed that an encoder counted is a mean over
the row that is over (`input_interpolation`).

    z = C beta + J delta,    C = what each of these does to the prediction, whitened;  J = what the model's own numbers do

beta is 0 for a command that is held, (m - 1) / m for samples, less where they are noisy; it is 1 for what is the sensor's noise, and 0
for what the robot was asked. No robot answers to what it is told later, and a
controller that answers to noise answers against it, which makes beta negative. One that goes along with it (a speed fed back to make up for
friction) makes it positive, with what noise pushes the robot: mostly beyond FARTHEST, but not always.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset, regridded
from s2r_runtime.trace.data.input_interpolation import MOVING, Samples, Way
from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.prediction import Acting, acting, predicted, residual, state_jacobian
from s2r_runtime.trace.estimation.problem import Fit, Problem, evaluate, fitted, gain, sensitivities, slopes
from s2r_runtime.trace.selection.ties import CLOSE, NEAR

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Lay = Callable[[Way], Problem]

MOST = 0.9
"""Share of the inputs' rows on which states stand: at the ends of a recording speeds do not follow from positions."""

LEAST, FARTHEST = 0.2, 1.25
"""beta between which inputs moved on: less could be the bend of what is held, and more is an input that came a row too late."""

MOST_NOISE = 2.0
"""beta up to which it is noise: a spline that follows what the input does follows noise, too, and takes out a part of it only."""

SOME = 8
"""Changes from which a mean of how far on they came is known to a fifth of a row."""

MEAN, SPREAD = 1.0, 0.58
"""Of how far before its row a change comes, in halves of a row: anywhere between two rows, 2 / sqrt(12)."""

SCATTER = 0.5
"""Of SPREAD, from which changes come at times of their own: all by as much is no clock, but something that remembers in another way."""

BETWEEN = 0.5, 1.5
"""Mean of it, between which changes came between the rows: they come on rows (0), or a row late (2), otherwise."""

LATE = 0.8, 1.2
"""beta between which inputs did come a row too late: what a controller makes of noise is mostly not just that."""

USUAL = 0.75
"""Share from which it is sought by likelihood: of a loop that goes four times a row."""

AGAIN = 3
"""Times that outliers are told from what is left."""

PLACED = 2
"""Times that changes are placed: the noise is first taken for larger than it is."""

LOOKS = 3
"""Times that further ways are looked for, at most: what is left by the first one is less."""

ROUNDS, NARROW = 4, 0.005
"""In which the share is told, and how near it has to come."""

NATS = 15.0
"""By which halfway must explain more than held, and each input on a way of its own more than all alike: what is held is the rule, as
everywhere where rivals are told apart (`ties`). What is noisy, or moved on, is a sample, and samples are mostly both: CLOSE is enough.
"""


def sampled(data: Dataset) -> bool:
    """Whether inputs may be samples: they stand on the states' rows, no more often, and change in most of them. Others are commands."""
    return bool(data.segments) and all(_sampled(states, inputs) for states, inputs in data.segments)


def _sampled(states: Stream, inputs: Stream) -> bool:
    if len(inputs.t) < 2 or len(states.t) < MOST * len(inputs.t) or not np.isin(states.t, inputs.t).all():
        return False
    changed = np.diff(inputs.values, axis=0)  # a command that was not received is not a number
    return bool(np.all(np.isfinite(changed)) and np.mean(np.any(changed != 0.0, axis=1)) > MOVING)


def commanded(data: Dataset) -> bool:
    """Whether inputs are commands that change between rows now and then: on the states' rows, in few of them, at times of their own."""
    if not data.segments or not data.in_order:
        return False
    changed = 0
    for states, inputs in data.segments:
        if len(inputs.t) < 2 or len(states.t) < MOST * len(inputs.t) or not np.isin(states.t, inputs.t).all():
            return False
        if not np.all(np.isfinite(inputs.values)):
            return False
        changed += int(np.count_nonzero(np.any(np.diff(inputs.values, axis=0) != 0.0, axis=1)))
    rows = sum(len(inputs.t) for _, inputs in data.segments)
    return SOME <= changed <= MOVING * rows


def samples_of(data: Dataset) -> Samples:
    """Of a recording that has samples of its inputs."""
    return Samples([inputs for _, inputs in data.segments], data.reconstruction.cleaned if data.reconstruction else ())


def straight(data: Dataset, model: ComposedModel, way: Way, samples: Samples) -> Dataset:
    """The recording with its inputs as they went, in as many parts a step: rows are where they were, but values that change elsewhere
    could seem to need others.
    """
    segments = [(states, inputs) for (states, _), inputs in zip(data.segments, samples.laid(way), strict=True)]
    again = regridded(replace(data, segments=tuple(segments), way=way), model, substeps=data.substeps)
    return replace(again, campaign=data.campaign)  # the step is the same, so its samples still are of this model


def noisy(data: Dataset, way: Way, samples: Samples) -> dict[str, float]:
    """Standard deviation of what was taken out of inputs as noise."""
    return {
        name: share * float(size) for name, share, size in zip(data.inputs, way.clean, samples.noise, strict=False) if share and size > 0.0
    }


def alike_laid(moved: Dataset, checked: Dataset) -> bool:
    """Whether inputs of the one can stand in the runs of the other, which may begin earlier."""
    counts = [[len(run.y) for run in data.runs] for data in (moved, checked)]
    return moved.substeps == checked.substeps and len(counts[0]) == len(counts[1]) and all(a <= b for a, b in zip(*counts, strict=True))


def acted(checked: Dataset, moved: Dataset) -> Dataset:
    """The recording as it was checked, with the inputs of one that moved on. What is taken to have been before its runs stays: asked of
    each anew, that may be there with some inputs and not with others.
    """
    runs = []
    for run, other in zip(checked.runs, moved.runs, strict=True):
        before = (len(run.y) - len(other.y)) * checked.substeps
        runs.append(replace(run, u=np.concatenate([run.u[:before], other.u])))
    return replace(checked, runs=tuple(runs))


@dataclass(frozen=True)
class _Share:
    """A number that says how inputs went: for which of them, (nu,), and whether it is of what they moved on by, or of their noise."""

    inputs: tuple[bool, ...]
    noise: bool

    @property
    def most(self) -> float:
        """Of this share."""
        return MOST_NOISE if self.noise else 1.0

    def believed(self, beta: float) -> bool:
        """Whether it may be this share."""
        return LEAST < beta < (MOST_NOISE if self.noise else FARTHEST)

    def of(self, way: Way) -> float:
        """It, as a way has it."""
        return (way.clean if self.noise else way.on)[self.inputs.index(True)]

    def put(self, way: Way, share: float) -> Way:
        """The way with this share."""
        now = way.clean if self.noise else way.on
        then = tuple(share if mine else other for mine, other in zip(self.inputs, now, strict=True))
        return replace(way, clean=then) if self.noise else replace(way, on=then)


def way_of(lay: Lay, fit: Fit, moves: Mask, price: float = NATS) -> Way:
    """How inputs went by a fit and its effects, their numbers fitted again. lay: the fit's problem with inputs that went some way; moves:
    (nu,) those that change in most rows; price: by which each number of a way must explain more than inputs that are held.
    """
    nu = len(moves)
    held = Way((0.0,) * nu, (0.0,) * nu)
    instead = _instead(lay, fit, moves) if fit.added else None
    if instead is not None:
        return instead
    return _found(lay, fit, fit, held, moves, price)


def _found(lay: Lay, fit: Fit, under: Fit, held: Way, moves: Mask, price: float = NATS) -> Way:
    """The way that explains most by a fit, looked for again under the noise that is left by what was found first. under: whose noise it is
    at first.
    """
    way = held
    for _ in range(LOOKS):
        further = _likeliest(_Look(lay, fit, under, way), moves, price)
        if further.late or further == way:
            return further
        way = _settled(lay, fit, further)
        if not way:
            return way
        here = lay(way)
        under = fit = fitted(here, fit, fit.model) if fit.free else evaluate(here, fit.model)
    return way


def _likeliest(look: _Look, moves: Mask, price: float) -> Way:
    """Of the ways that inputs may have gone at a look, each further number paid for."""
    held, nu = look.held, len(moves)
    each = [tuple(i == j for i in range(nu)) for j in np.flatnonzero(moves).tolist()]
    together, noisy = [_Share((True,) * nu, noise=False)], [_Share(one, noise=True) for one in each]
    apart = [_Share(one, noise=False) for one in each] if nu > 1 else []
    ways = [
        (together, price),
        (noisy, price),
        (together + noisy, price + CLOSE),
        (apart, 2.0 * price),
        (apart + noisy, 2.0 * price + CLOSE),
    ]
    if held:
        ways = [(noisy, CLOSE)] if not any(held.clean) else [(together, CLOSE), (apart, price)] if not any(held.on) else []
    best, most = held, 0.0
    for shares, asked in ways:
        way, gained = look.best(shares)
        if gained - asked > most:
            best, most = way, gained - asked
    if held:
        return best
    beta, gained = look.late()
    return replace(held, late=True) if LATE[0] < beta < LATE[1] and gained - NATS > most else best


def _instead(lay: Lay, fit: Fit, moves: Mask) -> Way | None:
    """A way that explains more by itself than all that was found on inputs that are held: on a sine, half a row's lateness of a force is
    friction, and noise of a sensor is a lag. By likelihood, as noise is much less under the right way.
    """
    nu = len(moves)
    held = Way((0.0,) * nu, (0.0,) * nu)
    bare = replace(fit.model, effects=tuple(a for i, a in enumerate(fit.model.effects) if i not in fit.added))
    given = lay(held)
    nominal = evaluate(given, bare)
    on, clean = (USUAL,) * nu, tuple(float(one) for one in moves)
    fits = [evaluate(lay(way), bare) for way in (Way(on, held.clean), Way(held.on, clean), Way(on, clean))]
    best = max(fits, key=lambda other: gain(other, nominal))
    if gain(best, nominal) < NATS or gain(best, fit) < -NEAR:
        return None
    way = _found(lay, nominal, best, held, moves)
    return way if way and gain(evaluate(lay(way), bare), fit) > CLOSE else None


def changed_within(lay: Lay, everywhere: Lay, fit: Fit, samples: Samples, nu: int) -> Way:
    """Whether commands changed between the rows, by a fit and its effects; then the samples know how far on each did. everywhere: as
    `lay`, of all transitions: when a command came has to be told where it came.

    r = sum_j beta_j c_j + noise,  beta ~ (MEAN, SPREAD^2)     c: what half a row does, in the rows from a change to the next one
    """
    held, way = Way((0.0,) * nu, (0.0,) * nu), Way((0.0,) * nu, (0.0,) * nu, within=True)
    given, every = lay(held), samples.within
    at = given.predicted(fit.model)
    columns = []
    for j in range(nu):
        samples.within = [one * np.eye(nu)[j] for one in every]
        columns.append(_does(given, fit, at, acting(fit.model, lay(way).data)))
    mine, own = list(range(nu)), sensitivities(given, fit, fit.model, fit.free)
    while mine:
        betas, gained = _betas(given, fit, [columns[i] for i in mine], own, wild=True)
        kept = [i for i, beta in zip(mine, betas, strict=True) if BETWEEN[0] < beta < BETWEEN[1]]
        if kept == mine:
            break
        mine = kept
    if not mine or gained < NATS:
        return held
    chosen = np.isin(np.arange(nu), mine)
    halves, datas = [one * chosen for one in every], []
    for j in range(nu):
        samples.within = [one * np.eye(nu)[j] for one in every]
        datas.append(everywhere(way).data)
    samples.within = [MEAN * one for one in halves]
    for _ in range(PLACED):
        under = lay(way)
        again = fitted(under, fit, fit.model) if fit.free else evaluate(under, fit.model)
        samples.within = _placed(everywhere(held), again, datas, samples.changes(), halves)
    come = np.concatenate(halves) > 0.0
    placed = np.concatenate(samples.within)
    apart = np.array([one[there].std() > SCATTER * SPREAD if there.any() else False for one, there in zip(placed.T, come.T, strict=True)])
    samples.within = [one * apart for one in samples.within]
    return way if apart.any() else held


def _placed(
    given: Problem, fit: Fit, datas: Sequence[Dataset], changes: Sequence[tuple[int, int, float]], halves: Sequence[Array]
) -> list[Array]:
    """(N, nu) of each segment, how far on changes came, in halves of a row: beside the fit's numbers, which make up for them on average.
    given: with inputs that are held; datas: with all changes of an input half a row on.
    """
    model, steps, nu = fit.model, given.steps, len(datas)
    act = acting(model, given.data)
    at = predicted(model, steps, act)
    whiten = noises.Whitener(fit.noise, state_jacobian(model, steps, act), steps.joined)
    z = whiten(residual(model, steps, act))
    c = np.stack([whiten(predicted(model, steps, acting(model, data)) - at) for data in datas], axis=2)
    j = whiten(slopes(given, model, fit.free)) if fit.free else np.zeros((*z.shape, 0))
    starts = np.array([stamp for _, _, stamp in changes]) - given.data.origin_s - 0.5 * given.data.dt
    edges = np.searchsorted(np.searchsorted(starts, steps.t, side="right") - 1, np.arange(len(changes) + 1))
    c, j, z = (e.reshape(len(steps) * z.shape[1], -1 if e.size else 0) for e in (c, j, z))
    solved = []
    normal, slope = j.T @ j, j.T @ z[:, 0]
    for here in (slice(p, q) for p, q in pairwise((edges * len(model.states)).tolist())):  # of the numbers, what is left beside each change
        x, own, r = c[here], j[here], z[here]
        product = x.T @ x + np.eye(nu) / SPREAD**2
        by, alone = (np.linalg.solve(product, e) for e in (x.T @ own, x.T @ r[:, 0] + MEAN / SPREAD**2))
        normal, slope = normal - own.T @ x @ by, slope - own.T @ x @ alone
        solved.append((by, alone))
    numbers = np.linalg.lstsq(normal, slope, rcond=1e-9)[0]
    placed = [np.zeros_like(one) for one in halves]
    for (segment, row, _), (by, alone) in zip(changes, solved, strict=True):
        placed[segment][row] = halves[segment][row] * np.clip(alone - by @ numbers, 0.0, 2.0)
    return placed


class _Look:
    """What ways do to what a fit predicts of inputs that are held."""

    def __init__(self, lay: Lay, fit: Fit, under: Fit, held: Way) -> None:
        self._lay, self.held = lay, held
        self._given = lay(held)
        act = acting(fit.model, self._given.data)
        self._predicted = predicted(fit.model, self._given.steps, act)
        z = fit.z if under is fit else under.whiten(residual(fit.model, self._given.steps, act))
        self._fit = replace(under, model=fit.model, free=fit.free, z=z)
        self._j = sensitivities(self._given, self._fit, fit.model, fit.free)
        self._known: dict[Way, Array] = {}

    def _does(self, way: Way) -> Array:
        if way not in self._known:
            self._known[way] = _does(self._given, self._fit, self._predicted, acting(self._fit.model, self._lay(way).data))
        return self._known[way]

    def best(self, shares: list[_Share]) -> tuple[Way, float]:
        """The likeliest shares, less those that are none, and the nats that they gain. How inputs moved on is asked of them without the
        noise that is asked about beside it: to the next row's it would go, too.
        """
        while shares:
            clean = self.held
            for noise in [s for s in shares if s.noise]:
                clean = noise.put(clean, 1.0)
            columns = [self._does(s.put(self.held, 1.0)) if s.noise else self._does(s.put(clean, 1.0)) - self._does(clean) for s in shares]
            betas, gained = _betas(self._given, self._fit, columns, self._j)
            kept = [s for s, beta in zip(shares, betas, strict=True) if s.believed(beta)]
            if len(kept) == len(shares):
                way = self.held
                for share, beta in zip(shares, betas, strict=True):
                    way = share.put(way, min(beta, share.most))
                return way, gained
            shares = kept
        return self.held, 0.0

    def late(self) -> tuple[float, float]:
        """How far inputs came a row too late, in rows, and the nats that this gains."""
        betas, gained = _betas(self._given, self._fit, [self._does(replace(self.held, late=True))], self._j)
        return betas[0], gained


def _settled(lay: Lay, fit: Fit, way: Way) -> Way:
    """The shares when numbers and noise have been fitted under them: noise is first taken for larger than it is, and of another colour."""
    together = len({*way.on}) == 1
    nu = len(way.on)
    each = [tuple(i == j for i in range(nu)) for j in range(nu)]
    shares = [_Share((True,) * nu, noise=False)] if together and way.on[0] else []
    shares += [_Share(one, noise=False) for one, on in zip(each, way.on, strict=True) if on and not together]
    shares += [_Share(one, noise=True) for one, clean in zip(each, way.clean, strict=True) if clean]
    now = [s.of(way) for s in shares]
    ends = [tuple(acting(fit.model, lay(s.put(way, end)).data) for end in (0.0, 1.0)) for s in shares]
    for _ in range(ROUNDS):
        here = lay(way)
        again = fitted(here, fit, fit.model) if fit.free else evaluate(here, fit.model)
        columns = [_does(here, again, predicted(again.model, here.steps, one), other) for one, other in ends]
        more, _ = _betas(here, again, columns, sensitivities(here, again, again.model, again.free))
        then = [min(max(value + change, LEAST), share.most) for share, value, change in zip(shares, now, more, strict=True)]
        for share, value in zip(shares, then, strict=True):
            way = share.put(way, value)
        moved = max(abs(change) for change in more)
        now = then
        if moved < NARROW:
            break
    for share, value in zip(shares, now, strict=True):
        way = share.put(way, value if value > LEAST else 0.0)
    return way


def _does(given: Problem, fit: Fit, held: Array, act: Acting) -> Array:
    """(n nx, 1) what inputs that act so do to what was predicted, (n, nx), whitened."""
    change = predicted(fit.model, given.steps, act) - held
    return np.asarray(fit.colour(fit.whiten(change), given.steps.joined).reshape(-1, 1))


def _betas(given: Problem, fit: Fit, columns: list[Array], j: Array, *, wild: bool = False) -> tuple[list[float], float]:
    """How far inputs went each of some ways beyond where they are in a fit, and the nats that this gains beyond the fit's own numbers, j,
    which may make up for it: half a row's lateness of an input is a delay that is longer by as much. wild: where a command changes
    between rows that row is far off, and no outlier before it is known how far on the change came.
    """
    z = fit.colour(fit.z, given.steps.joined).ravel()
    c = np.hstack(columns)
    x = np.hstack([c, j])
    if not np.all(np.isfinite(x)) or not np.any(c):
        return [0.0] * len(columns), 0.0
    beta, left = _solved(x, z, wild)
    _, without = _solved(j, z, wild)
    gained = np.sum(noises.log_density(left)) - np.sum(noises.log_density(without))
    return beta[: len(columns)].tolist(), float(gained)


def _solved(x: Array, z: Array, wild: bool) -> tuple[Array, Array]:
    """Weighted least squares of z (n,) on x (n, m), and what it leaves."""
    weight = np.ones(len(z)) if wild else noises.weight(z)
    beta: Array = np.zeros(x.shape[1])
    left = z
    for _ in range((AGAIN if wild else 1) if x.shape[1] else 0):
        weighted = x * weight[:, None]
        beta = np.asarray(np.linalg.lstsq(weighted.T @ x, weighted.T @ z, rcond=1e-12)[0], dtype=np.float64)
        left = z - x @ beta
        weight = noises.weight(left)
    return beta, left
