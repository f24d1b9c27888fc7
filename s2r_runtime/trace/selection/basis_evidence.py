"""How a dictionary of terms is judged on what a model leaves (`lack_of_fit` says of which, and what follows from it).

r = sum_j beta_j X_j + noise        beta by ridge, its strength by the evidence; without the block of time that is judged
gain                                log likelihood of what is left, noise and colour re-estimated, less that without the terms; where
                                    what the model leaves wanders, no more than under the law of what is left with the terms
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.noise import Colour, Whitener
from s2r_runtime.trace.estimation.problem import Fit, Problem
from s2r_runtime.trace.selection.evidence import evidence

Array = NDArray[np.float64]

BLOCKS = 8
"""Of the cross-validation."""

SLOWLY, LINES = ("constant", "time"), ("wave",)
"""Dictionaries of what is slow, and of lines in the spectrum."""

LEADING = 48
"""Columns of a dictionary that are judged at most."""

MOST_SCATTER = 5.0
"""Scatter counts up to this: a dictionary that fits the structure only roughly leaves scores that scatter too."""

PASSES = 3
"""Of terms and noise in turn."""


@dataclass(frozen=True)
class Judged:
    """A dictionary X (n, nx, m) with its held-out gain and beta (BLOCKS, m) without each block. scatter: see `_scatter`."""

    token: str
    x: Array
    gain: float
    scatter: float
    betas: Array


@dataclass(frozen=True)
class Left:
    """What is to be explained. r: (n, nx); f: (n, nx, nx); block: (n,). clipped: (n, nx), whitened, wild values cut off but with the
    weight of any other; None if there are none. known: what was asked of it before (`random_fields`).

    What shows only when an input jumps is wild, and few: weights would take it for outliers. Whether outliers have to do with the inputs
    is told by sliding.
    """

    given: Problem
    fit: Fit
    r: Array
    f: Array
    block: NDArray[np.int64]
    clipped: Array | None
    known: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def law(self) -> Colour | None:
        """Of what is to be explained, where it wanders."""
        return noises.wandering(self.fit.z, self.given.steps.joined, self.fit.colour)


def first_look(left: Left, x: Array) -> float:
    """Log evidence of the dictionary under the model's own noise."""
    white = left.fit.whiten(x).reshape(-1, x.shape[2])
    z = left.fit.z.ravel()
    root = np.sqrt(noises.weight(z))
    weighted = white * root[:, None]
    told = evidence(weighted.T @ weighted, weighted.T @ (root * z)).log  # half the work of a product of two
    return told if left.clipped is None else max(told, evidence(white.T @ white, white.T @ left.clipped.ravel()).log)


def leading(left: Left, x: Array) -> Array:
    """The combinations of the columns that move the residual most, (n, nx, at most LEADING): the others are what a ridge would suppress."""
    if x.shape[2] <= LEADING:
        return x
    white = left.fit.whiten(x).reshape(-1, x.shape[2])
    _, vectors = np.linalg.eigh(white.T @ white)
    return np.asarray(x @ vectors[:, -LEADING:])


def judge(left: Left, token: str, x: Array) -> Judged:
    """Held-out gain. Several passes: what is left after one has less noise, under which the next one sees more. The first one takes
    no colour into account: the colour that is there may well be the structure.
    """
    whiten: Whitener = left.fit.whiten
    colour: Colour | None = None
    joined = left.given.steps.joined
    betas: Array | None = None
    gain, scatter = 0.0, 1.0
    for again in range(PASSES):
        betas_now = _betas(left, x, whiten, colour)
        betas = betas_now if betas is None else betas
        rest = left.r - np.einsum("kim,km->ki", x, betas_now[left.block])
        level = noises.estimate(rest, left.f, joined, left.given.floor)
        whiten = Whitener(level, left.f, joined)
        z = whiten(rest)
        colour = noises.colour(z, joined)
        reached = noises.log_likelihood(z, whiten, colour, joined)
        # without the terms, under the same noise: a better estimate of the noise alone is no structure
        bare = max(left.fit.coloured, *(noises.log_likelihood(whiten(left.r), whiten, c, joined) for c in (colour, left.fit.colour)))
        more = min(reached - bare, _beyond_wandering(left, token, z, whiten, colour))
        if more <= gain and again:
            break
        if more > gain:
            push = colour(whiten(left.r - rest), joined)
            z = colour(z, joined)
            gain, betas = more, betas_now
            scatter = _scatter(push * z * noises.weight(z), push, left.block)
    return Judged(token, x, gain, scatter, betas_now if betas is None else betas)


def _beyond_wandering(left: Left, token: str, z: Array, whiten: Whitener, colour: Colour) -> float:
    """Nats of terms that leave z, (n, nx), under the law of what they leave, if that wanders; infinite if nothing does.

    What is slow itself is held against what wanders by its own law: nothing else tells the two apart. A line in the spectrum is none that
    wanders.
    """
    joined = left.given.steps.joined
    if left.law is None or token in LINES:
        return np.inf
    law = noises.wandering(z, joined, colour) or colour
    reached = noises.log_likelihood(z, whiten, law, joined)
    if token in SLOWLY:
        return reached - noises.log_likelihood(left.fit.z, left.fit.whiten, left.law, joined)
    return np.inf if law is colour else reached - noises.log_likelihood(whiten(left.r), whiten, law, joined)


def _scatter(scores: Array, push: Array, block: NDArray[np.int64]) -> float:
    """How much more the scores of blocks scatter than white noise would let them, as a ratio of variances, at least 1: noise that
    wanders slowly looks like much else."""
    sums = np.bincount(block, scores.sum(axis=1), BLOCKS)
    return min(max(1.0, float(np.sum(sums**2) / max(float(np.sum(push**2)), 1e-300))), MOST_SCATTER)


def _betas(left: Left, x: Array, whiten: Whitener, colour: Colour | None) -> Array:
    """(BLOCKS, m) ridge solutions without each block."""
    joined = left.given.steps.joined
    m = x.shape[2]
    white, z = whiten(x), whiten(left.r)
    if colour is not None:
        white, z = colour(white, joined), colour(z, joined)
    white, z = white.reshape(-1, m), z.ravel()
    weighted = white * noises.weight(z)[:, None]
    edges = np.searchsorted(left.block, np.arange(BLOCKS + 1)) * left.r.shape[1]
    products, slopes = np.zeros((BLOCKS, m, m)), np.zeros((BLOCKS, m))
    for b, here in enumerate(slice(p, q) for p, q in pairwise(edges.tolist())):
        products[b], slopes[b] = white[here].T @ weighted[here], weighted[here].T @ z[here]
    product, slope = products.sum(axis=0), slopes.sum(axis=0)
    ridge = evidence(product, slope).ridge * np.eye(m)
    return np.stack([np.linalg.solve(product - products[b] + ridge, slope - slopes[b]) for b in range(BLOCKS)])
