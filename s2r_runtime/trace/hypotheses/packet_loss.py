"""Are commands lost now and then?

A radio loses a packet, a bus is full: in some steps the robot goes on by the command before, or by none, and in the next one all is as it
should be. Each such step is wild by itself and counts as an outlier; a lag, a play or a delay takes up a part of the rest. So the steps are
asked one by one,

    r_k = c_k d_k + noise,      c_k in {0, 1},      d_k: where the other command leads, less where the one that was given does

c_k is 1 where that is likelier than not, the share of such steps known (a mixture of two, by turns of c and of share and noise), of the n
steps in which d is clearly beyond noise. It counts if the log likelihood, noise and colour re-estimated, is beyond what a model without it
leaves by the price of saying which steps these are, n H(share) with H the entropy of a coin of that share (J. Rissanen, Automatica 14,
1978), by BEYOND, and by far more than the same with d slid along the recording. A command that came late within its step is something
else: r is a part of d then, of any size.

A row that is one sample old leaves what no command at all leaves, and knows as much of commands. But the next one is right again, while a
robot that lost a command is somewhere else for good: rollouts over such steps must end where d has taken it. Where every command sets all
that is measured well enough (the speed of a wheel), the two cannot be told apart: alone that is no finding, but it takes away a name that
explains no more, which is neither of the two.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.noise import OUTLIER, Whitener
from s2r_runtime.trace.estimation.prediction import acting, advanced, rms, rollout, rollout_starts
from s2r_runtime.trace.hypotheses.disturbances import BEYOND
from s2r_runtime.trace.selection.basis_evidence import BLOCKS, Judged, Left

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CLEAR = 5.0
"""Standard deviations that d must be for it to be told whether a command was lost."""

BEGIN, MOST = 0.05, 0.5
"""Share of such steps that is begun with, and from which on it is not now and then: where most commands that change seem lost, they are
late.
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

AHEAD, HALF, SURE = (3, 4, 5, 6, 7), 0.5, 3.0
"""Steps later at which the robot must still be where d took it, how much of it must be left, and by how many standard deviations, from one
such step to the others.
"""

SLIDES, TWICE = 8, 2.0
"""Times that d is slid along the recording, and how many times what a slide explains there must be."""


@dataclass(frozen=True)
class _Offer:
    """d (n, nx), the tokens as which it is told, the nats that it explains where it acts, and in which steps (n,) that is. whole: whether
    r is all of d there, now and then.
    """

    d: Array
    tokens: tuple[str, ...]
    nats: float
    lost: Mask
    whole: bool

    @property
    def acted(self) -> Array:
        """(n, nx), what it does."""
        return np.where(self.lost[:, None], self.d, 0.0)


@dataclass(frozen=True)
class Lost:
    """What commands do that are lost, and the tokens as which that is told. sure: it is not rows that are old."""

    judged: Judged
    tokens: tuple[str, ...]
    sure: bool


def now_and_then(left: Left) -> Lost | None:
    """The steps in which commands were lost; None if noise may have made them."""
    if "lost" not in left.known:
        left.known["lost"] = _found(left)
    lost: Lost | None = left.known["lost"]
    return lost


def _found(left: Left) -> Lost | None:
    """The best offer that is sure; or a better one that is not, of the same steps: that commands were lost there, the sure one says. What
    is told of steps that were refuted is no doubt.
    """
    offers, refuted = _offered(left), np.zeros(len(left.r), dtype=bool)
    doubtful: tuple[Lost, Mask] | None = None
    price = math.log(max(len(offers), 1))
    for one in sorted((one for one in offers if one.whole), key=lambda one: -one.nats):
        gain = one.nats - price
        if gain <= BEYOND:
            break
        stays = _stays(left, one)
        if stays is False:
            refuted |= one.lost
        if stays is False or (stays is None and (doubtful is not None or _mostly(one.lost, refuted))):
            continue
        shifts = np.linspace(0.0, len(one.d), SLIDES + 2).astype(int)[1:-1]
        slid = (_explained(left, np.roll(one.d, int(shift), axis=0), ()) for shift in shifts)
        if gain > TWICE * max(other.nats if other.whole else 0.0 for other in slid):
            lost = Lost(Judged(one.tokens[0], one.acted[:, :, None], gain, 1.0, np.ones((BLOCKS, 1))), one.tokens, sure=bool(stays))
            if doubtful is None and not lost.sure:
                doubtful = lost, one.lost
            elif lost.sure:
                if doubtful is not None and doubtful[0].judged.gain > gain + BEYOND and _mostly(one.lost, doubtful[1]):
                    return replace(doubtful[0], sure=True)
                return lost
    return None if doubtful is None else doubtful[0]


def _mostly(steps: Mask, of: Mask) -> bool:
    """Whether most of the steps (n,) are of others."""
    return bool(np.count_nonzero(steps & of) > 0.5 * np.count_nonzero(steps))


def nats_of_lost(left: Left) -> float:
    """What the best offer explains, whether it is enough to be told or not."""
    return max((one.nats for one in _offered(left)), default=0.0)


def _offered(left: Left) -> list[_Offer]:
    """All offers, as far as they explain anything."""
    if "offered" not in left.known:
        none = left.given.floor.axes or left.given.data.measured_forces
        left.known["offered"] = [] if none else [_explained(left, d, tokens) for d, tokens in _offers(left)]
    offered: list[_Offer] = left.known["offered"]
    return offered


def _stays(left: Left, one: _Offer) -> bool | None:
    """Whether robots are where d took them some steps later: half of it, and what is sure of that. None where it cannot be told."""
    given, model = left.given, left.fit.model
    act = acting(model, given.data)
    usual = np.maximum(np.median(np.abs(left.r - one.acted), axis=0) / 0.6745, given.floor.one_step(left.f))
    at, extra = given.steps.place[one.lost], np.zeros((len(act.mean), len(model.states)))
    extra[given.steps.place] = one.acted
    along, size = np.zeros((2, len(act.mean)))
    for ahead in AHEAD:
        starts = np.intersect1d(rollout_starts(given.data, ahead), at)
        starts = np.setdiff1d(starts, at - (ahead - 1))  # a rollout that ends on another such step shows that one
        if not len(starts):
            continue
        off, then = (rollout(model, given.data, act, starts, ahead, more).error for more in (None, extra))
        moved = model.difference(off, then) / usual
        plain = np.all(np.minimum(np.abs(off), np.abs(then)) < OUTLIER * usual, axis=1)  # not where a row is off besides
        along[starts] += np.sum(off / usual * moved, axis=1) * plain
        size[starts] += np.sum(moved * moved, axis=1) * plain
    if np.count_nonzero(size) < FEWEST:
        return None
    there = float(np.sum(along) / np.sum(size))
    scatter = SURE * float(np.linalg.norm(along - there * size) / np.sum(size))
    return None if abs(there - HALF) < scatter else there > HALF


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


def _explained(left: Left, d: Array, tokens: tuple[str, ...]) -> _Offer:
    """In which steps d acts, and the nats of that."""
    r, least = left.r, left.given.floor.one_step(left.f)
    share, rest = BEGIN, r
    lost = told = np.zeros(len(r), dtype=bool)
    for _ in range(PASSES):
        usual = np.maximum(np.median(np.abs(rest), axis=0) / 0.6745, least)
        told = np.sum((d / usual) ** 2, axis=1) > CLEAR**2
        nats = np.sum(noises.log_density((r - d) / usual) - noises.log_density(r / usual), axis=1)
        lost = np.asarray(told & (nats > math.log((1.0 - share) / share)))
        if not FEWEST <= np.count_nonzero(lost) <= MOST * np.count_nonzero(told):
            return _Offer(d, tokens, 0.0, lost, whole=False)
        share, rest = float(np.mean(lost[told])), r - np.where(lost[:, None], d, 0.0)
    on_end = float(np.mean(lost[1:][lost[:-1]]))
    there, size = np.sum((r * d / usual**2)[lost]), np.sum((d * d / usual**2)[lost])
    whole = on_end <= ON_END + (1.0 - ON_END) * share and abs(there / size - 1.0) <= WHOLE
    joined = left.given.steps.joined
    whiten = Whitener(noises.estimate(rest, left.f, joined, left.given.floor), left.f, joined)
    z = whiten(rest)
    colour = noises.colour(z, joined)
    reached = noises.log_likelihood(z, whiten, colour, joined)
    bare = max(left.fit.coloured, left.fit.white, noises.log_likelihood(whiten(r), whiten, colour, joined))  # a better noise is no loss
    which = -np.count_nonzero(told) * (share * math.log(share) + (1.0 - share) * math.log(1.0 - share))
    return _Offer(d, tokens, reached - bare - which, lost, bool(whole))
