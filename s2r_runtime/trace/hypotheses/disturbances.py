"""Does something happen for a while, and not before or after?

A robot slips where the floor is wet, a gust comes and goes: what is left is nothing for most of the time, and the same push, or the same
share of an input, for some of it. Noise that is estimated over all of the time takes that for colour, and terms that must foretell it
from other times (`basis_evidence`) cannot. So windows [a, b) are looked for one after the other, each the one that explains most,

    r = sum_w beta_w 1[a_w <= k < b_w] d_w + noise          d: a push in some direction, or what an input pushes

or all those together in which values stay wild, with one beta (commands that are lost now and then: `_lost`), or each of these with its own
(an actuator that sticks, now here, now there: `_each`). They count if the log likelihood, noise and colour re-estimated, is beyond that of
coloured noise alone by the price of having looked everywhere, log(windows x directions) + 1/2 log n for each (the price of a change at an
unknown time: N. Zhang, D. Siegmund, Biometrics 63, 2007), and by BEYOND, and beyond the evidence for a push in the same directions that
wanders: waves of all lengths, their amplitudes falling as their frequency grows, as an Ornstein-Uhlenbeck process has them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.noise import Whitener
from s2r_runtime.trace.estimation.prediction import acting
from s2r_runtime.trace.hypotheses.basis import pushes_by_token
from s2r_runtime.trace.selection.basis_evidence import BLOCKS, Judged, Left
from s2r_runtime.trace.selection.evidence import evidence

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Window = tuple[str, Array, float]

EDGES = 48
"""Times at which a window may begin or end; a finer grid follows around the best one."""

SHORTEST = 4
"""Steps of a window at least: less is an outlier."""

MOST, MOST_WILD, LOOKED_AT = 6, 12, 48
"""Windows; and of those in which values stay wild, and which are looked at for that, the longest first."""

PASSES = 3
"""Of waves and noise in turn."""

BEYOND = 50.0
"""Nats, all paid for, from which on windows count. Of 120 clean recordings whose noise is coloured or has tails the most was 32."""

CLIPPED, SEEN = 10.0, 30.0
"""Standard deviations at which wild values are cut off: in looking for windows, and in telling what these look like."""

WAVES = 48
"""Of a push that wanders: the shortest takes two of so many parts of the recording."""

LOOKS_LIKE = 0.9
"""Of what windows explain: a dictionary that has this share of it says what they may depend on, one that has more than all of it does."""


def episodes(left: Left) -> Judged | None:
    """The windows of what a model leaves; None if noise may have made them."""
    fit = left.fit
    pushes = pushes_by_token(left.given, fit.model, acting(fit.model, left.given.data))
    n = len(left.given.steps)
    price = math.log(0.5 * n**2 * max(len(pushes), 1)) + 0.5 * math.log(n)
    bare = max(fit.coloured, fit.white)
    best: Judged | None = None
    wild = _staying_wild(left)
    lost, each = _lost(wild, pushes), _each(left, wild, pushes)
    if lost:
        best, _, _ = _better(left, fit.whiten, lost, bare + price * max(len(wild), len(lost)), None)
        best, _, _ = _better(left, fit.whiten, each, bare + price * len(each), best)
    found: list[Window] = []
    whiten, rest = fit.whiten, left.r
    while pushes and len(found) < MOST:
        found.append(_window(whiten, rest, pushes))
        if found[-1][2] < price:
            break
        best, rest, whiten = _better(left, whiten, found, bare + price * len(found), best)
    if best is None:
        return None
    used = [push for token, push in pushes if token in {best.token, *(t for t, _, _ in found)}]
    return best if best.gain > max(_wandering(left, used), 0.0) + BEYOND else None


def _better(left: Left, whiten: Whitener, found: list[Window], least: float, best: Judged | None) -> tuple[Judged | None, Array, Whitener]:
    """These windows if they are beyond `least`, and better than the best so far; what they leave, and a whitener of that."""
    joined, x = left.given.steps.joined, np.stack([term for _, term, _ in found], axis=2)
    for _ in range(2):  # less noise is left than was thought
        betas = _solved(whiten(x), whiten(left.r))
        rest = left.r - x @ betas
        whiten = Whitener(noises.estimate(rest, left.f, joined, left.given.floor), left.f, joined)
    gain = _coloured(whiten, whiten(rest), joined) - least
    if gain > (BEYOND if best is None else best.gain):
        best = Judged(_most_of(found, whiten(x) * betas), x, gain, 1.0, np.tile(betas, (BLOCKS, 1)))
    return best, rest, whiten


def _staying_wild(left: Left) -> list[slice]:
    """Steps where some state is wild for SHORTEST steps on end; a measurement that is off is wild for two. (Whitened, all that follows a
    jump is wild.)
    """
    usual = np.maximum(np.median(np.abs(left.r), axis=0) / 0.6745, left.given.floor.one_step(left.f))
    wild = np.abs(left.r) > noises.OUTLIER * usual
    n, joined = len(wild), left.given.steps.joined
    on_end = [wild[k : n - SHORTEST + 1 + k] & (joined[k : n - SHORTEST + 1 + k, None] | (k == 0)) for k in range(SHORTEST)]
    begun = np.any(np.all(on_end, axis=0), axis=1)
    inside: Mask = np.zeros(n, dtype=bool)
    for k in range(SHORTEST):
        inside[k : n - SHORTEST + 1 + k] |= begun
    begins = np.flatnonzero(inside & ~(joined & np.append(False, inside[:-1])))
    ends = [int(np.argmin(np.append(inside[a:b], False))) + a for a, b in pairwise([*begins.tolist(), n])]
    return [slice(a, b) for a, b in zip(begins.tolist(), ends, strict=True)]


def _lost(wild: list[slice], pushes: list[tuple[str, Array]]) -> list[Window]:
    """(token, (n, nx) push, how many) where values stay wild, the same share of a push wherever that is: commands lost now and then."""
    windows = [(token, _within(wild, push), float(len(wild))) for token, push in pushes]
    return [w for w in windows if np.any(w[1])]


def _each(left: Left, wild: list[slice], pushes: list[tuple[str, Array]]) -> list[Window]:
    """(token, (n, nx) push, nats) of the push that explains most of it where values stay wild, each time another share: an actuator that
    sticks, now here, now there.
    """
    z = left.fit.whiten(left.r)
    found = []
    for where in sorted(wild, key=lambda steps: steps.start - steps.stop)[:LOOKED_AT]:
        there = [(token, _within([where], push)) for token, push in pushes]
        told = [
            (float(np.sum(x * z)) ** 2 / max(2.0 * float(np.sum(x * x)), 1e-300), i)
            for i, (_, p) in enumerate(there)
            if np.any(x := left.fit.whiten(p))
        ]
        if told:
            nats, i = max(told)
            found.append((*there[i], nats))
    return sorted(found, key=lambda window: -window[2])[:MOST_WILD]


def _within(where: list[slice], push: Array) -> Array:
    """(n, nx) a push in some steps only."""
    inside = np.zeros((len(push), 1), dtype=bool)
    for steps in where:
        inside[steps] = True
    return np.where(inside, push, 0.0)


def _most_of(found: list[Window], explained: Array) -> str:
    """The token whose windows explain most, (n, nx, windows), under the noise that they leave: the first one explained most under more."""
    size = np.sum(explained**2, axis=(0, 1))
    total = {token: float(sum(s for s, (t, _, _) in zip(size, found, strict=True) if t == token)) for token, _, _ in found}
    return max(total, key=lambda token: total[token])


def _wandering(left: Left, pushes: list[Array]) -> float:
    """Log evidence for pushes that wander, noise re-estimated, beyond that of coloured noise alone."""
    n, joined = len(left.given.steps), left.given.steps.joined
    phase = np.pi * (np.arange(n) + 0.5) / n
    waves = [np.cos(k * phase) / k for k in range(1, WAVES + 1)]
    x = np.stack([wave[:, None] * push / np.sqrt(np.mean(push**2)) for push in pushes for wave in waves], axis=2)
    whiten, z, best = left.fit.whiten, left.fit.z, -math.inf
    for _ in range(PASSES):
        white = whiten(x).reshape(-1, x.shape[2])
        weighted = white * noises.weight(z).reshape(-1, 1)
        product, slope = white.T @ weighted, weighted.T @ np.clip(whiten(left.r), -SEEN, SEEN).ravel()
        ridge = evidence(product, slope).ridge
        beta = np.linalg.solve(product + ridge * np.eye(len(slope)), slope)
        cost = 0.5 * float(np.linalg.slogdet(np.eye(len(slope)) + product / ridge)[1]) + 0.5 * ridge * float(beta @ beta)
        rest = left.r - x @ beta
        whiten = Whitener(noises.estimate(rest, left.f, joined, left.given.floor), left.f, joined)
        z = whiten(rest)
        best = max(best, _coloured(whiten, z, joined) - cost)
    return best - max(left.fit.coloured, left.fit.white)


def _coloured(whiten: Whitener, z: Array, joined: Mask) -> float:
    """Log likelihood of a whitened residual under noise of its own colour."""
    return noises.log_likelihood(z, whiten, noises.colour(z, joined), joined)


def may_depend_on(left: Left, found: Judged, dictionaries: list[tuple[str, Array]]) -> tuple[str, ...]:
    """Tokens, likeliest first: what windows are in itself, and the dictionary that says as much under the little noise that they leave. A
    place where the robot was once cannot be told from the time when it was there.
    """
    rest = left.r - found.x @ found.betas[0]
    joined = left.given.steps.joined
    whiten = Whitener(noises.estimate(rest, left.f, joined, left.given.floor), left.f, joined)
    z = np.clip(whiten(left.r), -SEEN, SEEN)
    explained = 0.5 * float(np.sum(z**2) - np.sum(np.clip(whiten(rest), -SEEN, SEEN) ** 2))
    sharp = replace(left, fit=replace(left.fit, whiten=whiten, z=z), clipped=None)
    most, token = max((_told(sharp, x), token) for token, x in dictionaries)
    if most < LOOKS_LIKE * explained:
        return (found.token,)
    return tuple(dict.fromkeys((token, found.token) if most > explained else (found.token, token)))


def _told(left: Left, x: Array) -> float:
    """Log evidence of a dictionary, wild values and all."""
    white = left.fit.whiten(x).reshape(-1, x.shape[2])
    return evidence(white.T @ white, white.T @ left.fit.z.ravel()).log


def _window(whiten: Whitener, r: Array, pushes: list[tuple[str, Array]]) -> Window:
    """(token, (n, nx) push in it, nats at first look) of the window that explains most of r."""
    n = len(r)
    z = np.clip(whiten(r), -CLIPPED, CLIPPED).ravel()
    edges = np.unique(np.linspace(0, n, EDGES + 1).astype(int))
    looked = [(*_best_of(whiten, z, push, edges), i) for i, (_, push) in enumerate(pushes)]
    _, a, b, i = max(looked)
    token, push = pushes[i]
    wide = max(1, n // EDGES)
    near = [np.arange(max(0, e - wide), min(n, e + wide) + 1) for e in (a, b)]
    edges = np.unique(np.concatenate([[a, b], *(e[:: max(1, len(e) // (EDGES // 2))] for e in near)]))
    value, a, b = _best_of(whiten, z, push, edges)
    inside = (np.arange(n) >= a) & (np.arange(n) < b)
    return token, np.where(inside[:, None], push, 0.0), value


def _best_of(whiten: Whitener, z: Array, push: Array, edges: NDArray[np.int64]) -> tuple[float, int, int]:
    """(nats, a, b) of the best window [a, b) between two edges: windows are differences of what begins at an edge."""
    begun = push[:, :, None] * (np.arange(len(push))[:, None] >= edges[None, :])[:, None, :]
    x = whiten(begun).reshape(-1, len(edges))
    product, slope = x.T @ x, x.T @ z
    size = np.diag(product)[:, None] + np.diag(product)[None, :] - 2.0 * product
    nats = 0.5 * (slope[:, None] - slope[None, :]) ** 2 / np.maximum(size, 1e-9 * max(float(np.max(size)), 1e-300))
    nats[edges[None, :] - edges[:, None] < SHORTEST] = 0.0
    i, j = np.unravel_index(int(np.argmax(nats)), nats.shape)
    return float(nats[i, j]), int(edges[i]), int(edges[j])


def _solved(x: Array, z: Array) -> Array:
    """Weighted least squares of z (n, nx) on x (n, nx, m): values that stay wild count for next to nothing."""
    white, wanted = x.reshape(-1, x.shape[2]), z.ravel()
    beta: Array = np.zeros(white.shape[1])
    for _ in range(3):
        weighted = white * noises.weight(np.clip(wanted - white @ beta, -CLIPPED, CLIPPED))[:, None]
        product = white.T @ weighted
        beta = np.asarray(np.linalg.solve(product + 1e-9 * np.diag(np.diag(product) + 1e-300), weighted.T @ wanted))
    return beta
