"""Is each number of what was named one number everywhere?

A friction that is one number has it here and there, early and late, slow and fast. With J_q = dz/dp_q whitened by the noise's own law, and
z what is left, terms are offered in which a number p varies along a coordinate c (time, a state, an input, its size, how it changes),

    z = sum_q J_q d_q + J_p sum_j b_j cos(pi j rank(c)) + noise         rank: from 0 to 1, by the information on p

and whether b = 0 is asked by their scores, less what other numbers do as well (efficient scores, C. Rao, 1948; of numbers that vary: J.
Nyblom, JASA 84, 1989; B. Hansen, Journal of Policy Modeling 14, 1992). The sum of the first m squares is chi-square with m degrees; of
m = 1 to WAVES the least likely counts (J. Neyman, 1937; T. Ledwina, JASA 89, 1994), all that was tried paid for (Bonferroni), and under
variances over blocks of time of what is left beside them (H. White, 1980), too. What is sure is also beyond the same residual slid along
the recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.prediction import acting, first_steps
from s2r_runtime.trace.estimation.problem import evaluate, foretold, gain, slopes, without
from s2r_runtime.trace.hypotheses.basis import VELOCITIES, quieter, token_of
from s2r_runtime.trace.selection.basis_evidence import BLOCKS, Judged, Left
from s2r_runtime.trace.selection.evidence import margin

Array = NDArray[np.float64]

WAVES = 6
"""Terms of a coordinate: the last one has three periods."""

CELLS = 48
"""Of a coordinate, as many steps in each: eight to the shortest half wave."""

TIMES = 48
"""Blocks of time over which scores are compared."""

ALPHA = 1e-3
"""Chance that a number that is one number fails, as far as the noise's law is right."""

MORE = 0.05
"""Of what an effect explains that its variation must explain (`unnamed_alternatives`): a number that differs by a fifth of itself."""

TOLD, LITTLE = 0.05, 0.01
"""The same where no name is at stake, and what a number seems to go with is only told beside it: a number that differs by a tenth."""

LESS = math.log(TOLD / ALPHA)
"""Of the price, in nats, what is told costs less."""

LOOKED_AT = 6
"""That stand out most, and are looked at under variances over blocks of time."""

CLIPPED = 30.0
"""Standard deviations at which wild values are cut off."""

RECENT = (8, 32)
"""Steps over which an input's mean is taken: it changes where it is not at that."""

SINGULAR = 1e-4
"""Of the information on a number: less on a term of its variation is none."""


@dataclass(frozen=True)
class _Along:
    """A coordinate (n,), and the name of what it is (a token)."""

    name: str
    c: Array


@dataclass(frozen=True)
class _Scores:
    """z, weight (n, nx) and J (n, nx, k), whitened; by step: slope (n, k) and info (n, k, k)."""

    z: Array
    weight: Array
    j: Array
    slope: Array
    info: Array


@dataclass(frozen=True)
class _Varies:
    """Number p along a coordinate: waves (cells, m) over cells, the cell of each step (n,); -log of the chance of as much by chance."""

    p: int
    along: _Along
    waves: Array
    cell: NDArray[np.int64]
    surprise: float


@dataclass(frozen=True)
class Uneven:
    """How a number varies. sure: beyond ALPHA, and by MORE; else it is only told."""

    judged: Judged
    sure: bool


def uneven(left: Left) -> Uneven | None:
    """What varies most surely of the numbers of what was named, by as much as is told; None if nothing does."""
    fit = left.fit
    if not fit.free or left.given.floor.axes:
        return None
    moved = slopes(left.given, fit.model, fit.free)
    scores = _scores(left, moved)
    offered = [varies for along in _coordinates(left) for varies in _offered(scores, along)]
    price = math.log(max(len(offered), 1) * WAVES / ALPHA)
    best = sorted((v for v in offered if v.surprise > price - LESS), key=lambda v: -v.surprise)[:LOOKED_AT]
    found = [one for varies in best for one in [_judged(left, scores, moved, varies, price)] if one is not None]
    return max(found, key=lambda one: (one.sure, one.judged.gain), default=None)


def _scores(left: Left, moved: Array) -> _Scores:
    """moved: (n, nx, k) d(residual)/dp."""
    fit, joined = left.fit, left.given.steps.joined
    law = left.law or fit.colour
    z = np.clip(law(np.clip(fit.z, -CLIPPED, CLIPPED), joined), -CLIPPED, CLIPPED)
    j = law(fit.whiten(moved), joined)
    weight = noises.weight(z)
    weighted = j * weight[:, :, None]
    return _Scores(z, weight, j, np.einsum("kip,ki->kp", weighted, z), np.einsum("kip,kiq->kpq", weighted, j))


def _coordinates(left: Left) -> Iterator[_Along]:
    """Of what a number may be more here and less there."""
    given, model = left.given, left.fit.model
    y = quieter(given, left.fit.noise, left.r)
    act = acting(model, given.data).mean
    first = first_steps(given.data)
    begin = np.repeat(first[:-1], np.diff(first))
    if given.data.in_order:
        yield _Along("time", given.steps.t)
    for i, name in enumerate(model.states):
        if name in model.nominal.angles:
            angle = np.remainder(y[:, i], math.tau)
            yield _Along(token_of(model, name), angle)
        elif name in VELOCITIES:
            yield _Along("speed", y[:, i])
            yield _Along("speed", np.abs(y[:, i]))
        else:
            yield _Along(token_of(model, name), y[:, i])
    for i, name in enumerate(model.inputs):
        u = act[given.steps.place, i]
        yield _Along(name, u)
        yield _Along(name, np.abs(u))
        for steps in RECENT:
            changes = (act[:, i] - _recently(act[:, i], steps, begin))[given.steps.place]
            yield _Along(f"memory({name})", changes * np.sign(u))


def _recently(u: Array, steps: int, first: NDArray[np.int64]) -> Array:
    """Mean of the values (n,) before each, and of it. first: (n,) where the run of each begins."""
    total = np.concatenate([[0.0], np.cumsum(u)])
    end = np.arange(1, len(u) + 1)
    begin = np.maximum(end - steps, first)
    return np.asarray((total[end] - total[begin]) / (end - begin))


def _offered(scores: _Scores, along: _Along) -> Iterator[_Varies]:
    """Each number along a coordinate, at first look: by sums over its cells."""
    order = np.argsort(along.c, kind="stable")
    c = along.c[order]
    edges = np.unique(np.searchsorted(c, c[np.linspace(0, len(c) - 1, CELLS + 1).astype(int)]))  # values that are alike stay together
    if len(edges) <= 1:
        return
    info, slope = (np.add.reduceat(e[order], edges, axis=0) for e in (scores.info, scores.slope))
    everything = np.linalg.pinv(info.sum(axis=0), rcond=1e-12, hermitian=True)
    cell = np.empty(len(c), dtype=np.int64)
    cell[order] = np.repeat(np.arange(len(edges)), np.diff(np.append(edges, len(c))))
    for p in range(info.shape[1]):
        own = info[:, p, p]
        size = float(own.sum())
        if size <= 0.0:  # a number that these data do not feel
            continue
        rank = (np.cumsum(own) - 0.5 * own) / size
        waves = np.cos(math.pi * rank[:, None] * np.arange(1, min(WAVES, len(edges) - 1) + 1))
        beside = waves.T @ info[:, p] @ everything
        root = _root((waves * own[:, None]).T @ waves - beside @ (info[:, p].T @ waves), size)
        a = np.linalg.solve(root, waves.T @ slope[:, p] - beside @ slope.sum(axis=0))
        yield _Varies(p, along, waves, cell, _surprise(a**2)[0])


def _root(information: Array, size: float) -> Array:
    """(m, m) lower. size: information on the number itself; what has next to none of it counts for nothing."""
    ridge = SINGULAR * size
    return np.asarray(np.linalg.cholesky(0.5 * (information + information.T) + ridge * np.eye(len(information))))


def _surprise(squares: Array) -> tuple[float, int]:
    """(-log of the chance of as large a sum of the first m squares of normal values, m), of the m of which it is least."""
    from scipy.special import gammaincc

    m = np.arange(1, len(squares) + 1)
    chance = np.maximum(gammaincc(0.5 * m, 0.5 * np.cumsum(squares)), 1e-300)
    told = -np.log(chance) + 1e-9 * np.cumsum(squares)
    return float(np.max(told)), int(np.argmax(told)) + 1


def _judged(left: Left, scores: _Scores, moved: Array, varies: _Varies, price: float) -> Uneven | None:
    """Under variances over blocks of time; None if it may be chance then, or explains too little of what the effect does. Sure is what
    the same residual slid along the recording does not show.
    """
    p, terms, (n, nx, k) = varies.p, varies.waves[varies.cell], moved.shape
    j, z, w = scores.j.reshape(-1, k), scores.z.ravel(), scores.weight.ravel()
    x = (scores.j[:, :, p, None] * terms[:, None, :]).reshape(n * nx, -1)
    weighted = x * w[:, None]
    beside = np.linalg.pinv(scores.info.sum(axis=0), rcond=1e-12, hermitian=True) @ (j.T @ weighted)
    x -= j @ beside
    root = _root(x.T @ (x * w[:, None]), float(scores.info[:, p, p].sum()))
    along: Array = np.asarray(np.linalg.solve(root, x.T).T, dtype=np.float64)
    slope = along.T @ (w * z)
    m = _surprise(slope**2)[1]
    surprise, _ = _surprise(slope**2 / np.maximum(_varied(scores, along, slope, m), 1.0))
    nats = 0.5 * float(np.sum(slope[:m] ** 2) - m)
    place = left.fit.free[p].place
    without_it = without(left.fit.model, place)
    if surprise < price - LESS or foretold(left.given, without_it) is None:  # somebody's own model may not step without it
        return None
    share = nats / max(gain(left.fit, evaluate(left.given, without_it, left.fit.noise)), 1e-300)
    if share < LITTLE:
        return None
    sure = share >= MORE and min(varies.surprise, surprise) > price
    sure = sure and margin(along[:, :m].reshape(n, nx, m), scores.z, scores.weight, 0.0) > 0.0
    beta = np.linalg.solve(root[:m, :m].T, slope[:m])
    push = moved[:, :, p, None] * terms[:, None, :m] - moved @ beside[:, :m]
    judged = Judged(_token(left, varies.along, place), push, nats - m * math.log(n) / 2.0, 1.0, np.tile(beta, (BLOCKS, 1)))
    return Uneven(judged, sure)


def _varied(scores: _Scores, along: Array, slope: Array, m: int) -> Array:
    """Variances of scores over blocks of time, beside all that the first m terms and the other numbers explain: a variation that is there
    is no noise, and what one wave of it explains would be noise to the others. along: (n nx, terms), orthonormal; slope: of each.
    """
    j, z, w = scores.j.reshape(len(along), -1), scores.z.ravel(), scores.weight.ravel()
    moved = np.linalg.pinv(scores.info.sum(axis=0), rcond=1e-12, hermitian=True) @ (j.T @ (w * z))
    rest = z - along[:, :m] @ slope[:m] - j @ moved
    n, nx = scores.z.shape
    edges = np.unique(np.linspace(0, n, TIMES + 1).astype(int))[:-1] * nx
    a = np.add.reduceat(along * (w * rest)[:, None], edges, axis=0)
    return np.asarray(np.sum(a**2, axis=0) * len(edges) / max(len(edges) - 1 - m, 1))


def _token(left: Left, along: _Along, place: int) -> str:
    """As `basis` calls what varies."""
    model = left.fit.model
    a = model.effects[place]
    if a.channel not in model.inputs:
        return along.name
    if along.name == "time":
        return f"time*{a.channel}"
    if a.effect.hidden(1, model.nominal, a.channel, model.dt, a.p).size:
        return f"memory({a.channel})"
    return f"{a.channel}*{along.name}" if along.name in set(model.inputs) - {a.channel} else along.name
