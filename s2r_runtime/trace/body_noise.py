"""Noise that pushes a robot along its body: a wheeled robot's wheels slip, and its motors pull, along the way that it heads.

By state, such noise is as large in x as in y wherever the robot heads, and a push that wanders from step to step seems to explain much of
what is left. What does go on from step to step is such a push, and no noise of this kind. The variances q of the states that a push p along
the body moves are its own by a share s, which the likelihood chooses:

    Q = (1 - s) diag(q) + s c p p',      c such that the trace, over all steps, stays
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace import residual_noise as noises
from s2r_runtime.trace.lack_of_fit_judged import Left
from s2r_runtime.trace.lack_of_fit_terms import directions_of
from s2r_runtime.trace.residual import acting
from s2r_runtime.trace.residual_noise import Noise, Whitener

Array = NDArray[np.float64]

SHARES = (0.5, 0.8, 0.95, 0.99)
"""Of a state's variance of the process that are tried: what little is left of it keeps the other directions from being known exactly."""

CLEARLY = 4.0
"""Nats that it must bring."""

WIDTHS, FLIPS, SEEN = (3, 10, 30, 100, 300), 24, 3.0
"""Steps over which sums of white noise along a push are no larger than chance makes them, with the sign of each step by chance; draws of
that; standard deviations above them from which on it goes on.
"""


@dataclass(frozen=True)
class BodyNoise:
    """What whitens the residual of a model. push: (n, nx), None if its noise has no such direction; white: that, and z (n, nx) whitened."""

    left: Left
    push: Array | None
    share: float
    white: tuple[Whitener, Array]

    def of(self, noise: Noise, rest: Array) -> tuple[Whitener, Array]:
        """The same of what something else leaves, with its noise by state: that may have taken up what pushed along the body."""
        shares = (0.0,) if self.push is None else (0.0, self.share)
        whiteners = [_whitener(self.left, noise, self.push if share else None, share) for share in shares]
        return max(((whiten, whiten(rest)) for whiten in whiteners), key=lambda white: _log_likelihood(*white))


def body_noise(left: Left) -> BodyNoise:
    """The likeliest of what a model leaves; asked for once."""
    if "body noise" not in left.known:
        left.known["body noise"] = _likeliest(left)
    found: BodyNoise = left.known["body noise"]
    return found


def _likeliest(left: Left) -> BodyNoise:
    fit = left.fit
    best, most = BodyNoise(left, None, 0.0, (fit.whiten, fit.z)), _log_likelihood(fit.whiten, fit.z) + CLEARLY
    if left.given.floor.axes:
        return best
    body, _ = directions_of(left.given, fit.model, acting(fit.model, left.given.data))
    for push in body:
        if np.count_nonzero(np.any(push, axis=0)) < 2:
            continue  # a state's own variance
        before = -np.inf
        for share in SHARES:
            whiten = _whitener(left, fit.noise, push, share)
            z = whiten(left.r)
            nats = _log_likelihood(whiten, z)
            if nats > most:
                best, most = BodyNoise(left, push, share, (whiten, z)), nats
            if nats < before:
                break
            before = nats
    return BodyNoise(left, None, 0.0, (fit.whiten, fit.z)) if best.push is not None and _goes_on(best.push, *best.white) else best


def _goes_on(push: Array, whiten: Whitener, z: Array) -> bool:
    """Whether what pushes along there in one step does so in the next ones: score test of a variance of sums over WIDTHS steps."""
    wild = np.clip(z, -noises.OUTLIER, noises.OUTLIER)[:, :, None]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(z), 1, FLIPS))
    along = np.einsum("ki,kis->ks", push, whiten.back(np.concatenate([wild, wild * signs], axis=2)))
    total = np.cumsum(np.concatenate([np.zeros((1, 1 + FLIPS)), along]), axis=0)
    for width in WIDTHS:
        size = np.sum((total[width:] - total[:-width]) ** 2, axis=0)
        if len(z) > 3 * width and size[0] > np.mean(size[1:]) + SEEN * np.std(size[1:]):
            return True
    return False


def _whitener(left: Left, noise: Noise, push: Array | None, share: float) -> Whitener:
    joined = left.given.steps.joined
    if push is None:
        return Whitener(noise, left.f, joined)
    moved = np.any(push, axis=0)
    own = share * float(np.sum(noise.q[moved])) / float(np.mean(np.sum(push * push, axis=1)))
    return Whitener(Noise(np.where(moved, (1.0 - share) * noise.q, noise.q), noise.r, noise.axes), left.f, joined, push=np.sqrt(own) * push)


def _log_likelihood(whiten: Whitener, z: Array) -> float:
    return float(np.sum(noises.log_density(z))) - whiten.logdet
