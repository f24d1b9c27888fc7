"""Are commands lost now and then?

A radio loses a packet, a bus is full: in some steps the robot goes on by the command before, or by none, and in the next one all is as it
should be. Each such step is wild by itself and counts as an outlier; a lag, a play or a delay takes up a part of the rest. So the steps are
asked one by one,

    r_k = c_k d_k + noise,      c_k in {0, 1},      d_k: where the other command leads, less where the one that was given does

c_k is 1 where that is likelier than not, the share of such steps known (a mixture of two, by turns of c and of share and noise). It counts
if the log likelihood, noise and colour re-estimated, is beyond what a model without it leaves by the price of saying which steps these are,
n H(share) with H the entropy of a coin of that share (J. Rissanen, Automatica 14, 1978), by BEYOND, and by far more than the same with d
slid along the recording: outliers of a sensor know nothing of commands. A command that came late within its step is something else: r is a
part of d then, of any size.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.trace import residual_noise as noises
from s2r_runtime.trace.episodes import BEYOND
from s2r_runtime.trace.lack_of_fit_judged import BLOCKS, Judged, Left
from s2r_runtime.trace.residual import acting, advanced, rms
from s2r_runtime.trace.residual_noise import Whitener

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BEGIN, MOST, CLEAR = 0.05, 0.5, 5.0
"""Share of steps that is begun with, and from which on it is not now and then; also of those in which d is so many standard deviations, and
could be told: where most commands that change seem lost, they are late.
"""

FEWEST = 8
"""Steps below which a few outliers may lie so by chance."""

PASSES = 5
"""Of which steps, and share and noise, in turn."""

WHOLE = 0.07
"""Of d, by which r may differ from it over all such steps."""

ON_END = 0.3
"""Share of such steps, beyond what chance makes, that may follow one another: what goes on is no packet that was lost (an end stop).
"""

SLIDES, TWICE = 8, 2.0
"""Times that d is slid along the recording, and how many times what a slide explains there must be."""


@dataclass(frozen=True)
class Lost:
    """What commands do that are lost, and the tokens as which that is told."""

    judged: Judged
    tokens: tuple[str, ...]


def now_and_then(left: Left) -> Lost | None:
    """The steps in which commands were lost; None if noise may have made them."""
    if "lost" not in left.known:
        left.known["lost"] = _found(left)
    lost: Lost | None = left.known["lost"]
    return lost


def _found(left: Left) -> Lost | None:
    if left.given.floor.axes or left.given.data.measured_forces:
        return None
    offers = list(_offers(left))
    found = [(*_explained(left, d), d, tokens) for d, tokens in offers]
    nats, lost, d, tokens = max(found, key=lambda one: one[0], default=(0.0, np.zeros(0, bool), np.zeros(0), ()))
    gain = nats - math.log(max(len(offers), 1))
    if gain <= BEYOND:
        return None
    shifts = np.linspace(0.0, len(d), SLIDES + 2).astype(int)[1:-1]
    if gain <= TWICE * max(_explained(left, np.roll(d, int(shift), axis=0))[0] for shift in shifts):
        return None
    return Lost(Judged(tokens[0], np.where(lost[:, None], d, 0.0)[:, :, None], gain, 1.0, np.ones((BLOCKS, 1))), tokens)


def _offers(left: Left) -> Iterator[tuple[Array, tuple[str, ...]]]:
    """((n, nx) d, tokens) of the command before, and of none, on all inputs and on each."""
    given, model = left.given, left.fit.model
    act, steps = acting(model, given.data), given.steps
    before = np.concatenate([act.mean[:1], act.mean[:-1]])  # of a run's first step that is another run's: one step of many
    to = given.predicted(model)
    inputs = range(len(model.inputs))
    for which in [*([[*inputs]] if len(model.inputs) > 1 else []), *([j] for j in inputs)]:
        for other, token in ((before, "memory({})"), (0.0 * before, "{}")):
            shift = np.zeros_like(act.mean)
            shift[:, which] = (other - act.mean)[:, which]
            try:
                d = model.difference(advanced(model, steps.y0, act.moved(shift), steps.place), to)
            except ConfigError:  # a user's own model may give no numbers for a command that is none
                continue
            if np.all(np.isfinite(d)) and np.any(d):
                size = rms(shift)
                yield d, tuple(token.format(model.inputs[j]) for j in sorted(which, key=lambda j: -size[j]) if size[j] > 0.0)


def _explained(left: Left, d: Array) -> tuple[float, Mask]:
    """Nats of the steps in which d acts, and which (n,) these are."""
    r, n = left.r, len(left.r)
    least = left.given.floor.one_step(left.f)
    share, rest = BEGIN, r
    lost = np.zeros(n, dtype=bool)
    for _ in range(PASSES):
        usual = np.maximum(np.median(np.abs(rest), axis=0) / 0.6745, least)
        nats = np.sum(noises.log_density((r - d) / usual) - noises.log_density(r / usual), axis=1)
        lost = np.asarray(nats > math.log((1.0 - share) / share))
        count = int(np.count_nonzero(lost))
        if not FEWEST <= count <= MOST * n:
            return 0.0, lost
        share, rest = count / n, r - np.where(lost[:, None], d, 0.0)
    on_end = float(np.mean(lost[1:] & lost[:-1])) / share
    told = np.sum((d / usual) ** 2, axis=1) > CLEAR**2
    if on_end > ON_END + (1.0 - ON_END) * share or np.count_nonzero(lost & told) > MOST * np.count_nonzero(told):
        return 0.0, lost
    there, size = np.sum((r * d / usual**2)[lost]), np.sum((d * d / usual**2)[lost])
    if not abs(there / size - 1.0) <= WHOLE:
        return 0.0, lost
    joined = left.given.steps.joined
    whiten = Whitener(noises.estimate(rest, left.f, joined, left.given.floor), left.f, joined)
    z = whiten(rest)
    colour = noises.colour(z, joined)
    reached = noises.log_likelihood(z, whiten, colour, joined)
    bare = max(left.fit.coloured, left.fit.white, noises.log_likelihood(whiten(r), whiten, colour, joined))  # a better noise is no loss
    which = -n * (share * math.log(share) + (1.0 - share) * math.log(1.0 - share))
    return reached - bare - which, lost
