"""Noise that pushes a robot along its body: a wheeled robot's wheels slip, and its motors pull, along the way that it heads.

By state, such noise is as large in x as in y wherever the robot heads, and what goes along the body, here more and there less, explains
some of it. Of the variances q of x and y, less their floors, a share s is that of a push p along or across the body, by the likelihood:

    Q = diag(q) - s diag(q - floor) + s sum(q - floor) p p',      |p| = 1: over all headings alike, the trace stays

What goes on from step to step is none of this, but a push that wanders (`random_fields`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.forces import POSE
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.noise import Noise, Whitener
from s2r_runtime.trace.estimation.prediction import acting
from s2r_runtime.trace.hypotheses.basis import directions_of
from s2r_runtime.trace.selection.basis_evidence import Left

Array = NDArray[np.float64]

SHARES = (0.5, 0.8, 0.95)
"""That are tried: what little is left of a variance keeps the other direction from being known exactly."""

CLEARLY = 10.0
"""Nats that one must bring, of the six that are offered: a chance of one in thousands."""

WIDTHS, FLIPS, GOES_ON = (3, 10, 30, 100), 24, 3.0
"""Steps over which sums of what pushes are taken, to see whether it goes on; draws of the signs of steps, for what chance makes of such
sums; standard deviations above that from which on it does.
"""


@dataclass(frozen=True)
class BodyNoise:
    """push: (n, nx), of length 1. share: of the variances of the states that it moves. whiten, z: of what is left, and that, whitened."""

    push: Array
    share: float
    whiten: Whitener
    z: Array


def body_noise(left: Left) -> BodyNoise | None:
    """The likeliest of what a model leaves; None if noise by state does as well, or what pushes along the body goes on."""
    model = left.fit.model
    if not {*model.states} >= POSE or left.given.floor.axes:
        return None
    plain = Whitener(left.fit.noise, left.f, left.given.steps.joined)  # the fit's own may be of steps from other states (`bends`)
    most, best = _log_likelihood(plain, plain(left.r)) + CLEARLY, None
    body, _ = directions_of(left.given, model, acting(model, left.given.data))
    for push in body[:2]:
        shared = [(share, whiten := whitener(left, left.fit.noise, push, share), whiten(left.r)) for share in SHARES]
        share, whiten, z = max(shared, key=lambda of: _log_likelihood(*of[1:]))
        found = BodyNoise(push, share, whiten, z)
        if (nats := _log_likelihood(whiten, z)) > most and not _goes_on(found):
            most, best = nats, found
    return best


def whitener(left: Left, noise: Noise, push: Array, share: float) -> Whitener:
    """Of noise by state, a share of which pushes along there."""
    moved = np.any(push, axis=0)
    spare = np.where(moved, share * np.maximum(noise.q - left.given.floor.q, 0.0), 0.0)
    return Whitener(Noise(noise.q - spare, noise.r), left.f, left.given.steps.joined, push=np.sqrt(np.sum(spare)) * push)


def _goes_on(found: BodyNoise) -> bool:
    """Whether what pushes along there in one step does so in the next ones: score test of a variance of sums over WIDTHS steps."""
    z = np.clip(found.z, -noises.OUTLIER, noises.OUTLIER)[:, :, None]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(z), 1, FLIPS))
    along = np.einsum("ki,kis->ks", found.push, found.whiten.back(np.concatenate([z, z * signs], axis=2)))
    total = np.cumsum(np.concatenate([np.zeros((1, 1 + FLIPS)), along]), axis=0)
    for width in (w for w in WIDTHS if 3 * w < len(z)):
        size = np.sum((total[width:] - total[:-width]) ** 2, axis=0)
        if size[0] > np.mean(size[1:]) + GOES_ON * np.std(size[1:]):
            return True
    return False


def _log_likelihood(whiten: Whitener, z: Array) -> float:
    return float(np.sum(noises.log_density(z))) - whiten.logdet
