"""Does the robot move otherwise at some places, headings, times or commands, in ways that a few terms cannot follow?

What its inputs do now, or a named effect does, is more here and less there (a floor that rolls, stripes on which wheels slip), by how much
is a smooth random function of a coordinate c (a Gaussian process, on bumps g_j over the cells that were visited):

    r = sum_j beta_j g_j(c) push + noise,      beta_j ~ N(0, tau^2)

Its evidence is the marginal likelihood, tau by maximum, noise re-estimated from what is left (Laplace's approximation, with the weights
of the noise's density; D. MacKay, Neural Computation 4(3), 1992). It needs no place to be visited twice. Whatever wanders by itself, the
wind, a load, follows such a function, too: a field counts only beyond noise of any colour, and beyond pushes that wander in time whatever
the inputs do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.body_frame_noise import BodyNoise, body_noise, whitener
from s2r_runtime.trace.estimation.noise import Whitener
from s2r_runtime.trace.estimation.parameters import free_of
from s2r_runtime.trace.estimation.prediction import acting
from s2r_runtime.trace.estimation.problem import Fit, slopes
from s2r_runtime.trace.hypotheses.basis import directions_of, own_pushes, quieter
from s2r_runtime.trace.selection.basis_evidence import BLOCKS, Judged, Left
from s2r_runtime.trace.selection.evidence import evidence

Array = NDArray[np.float64]
Marginal = tuple[float, Array]
"""(log marginal likelihood, slopes (m,))."""

CELLS = (12, 40, 120)
"""Visited cells at most, by how fine a field is."""

QUICKEST = 360
"""The same, of a push that wanders in time."""

SLOW = 2
"""Levels of CELLS in time: a battery, a motor's heat change a number slowly, a floor as quickly as one comes along. Where a robot never
comes back, nothing but this tells the two apart.
"""

GRIDS = (256, 192, 128, 96, 64, 48, 32, 24, 16, 12, 8, 6, 4, 3)
"""Cells along the longest axis that are tried."""

WIDE = 0.8
"""Standard deviation of a bump over the cells' spacing: neighbours overlap, and together are flat to a hundredth."""

SPARE = 3
"""Steps for each cell at least."""

CLIPPED = 30.0
"""Standard deviations at which wild values are cut off: under the little noise that a field leaves, all that it explains is wild."""

SAME = 0.9999
"""Cosine between two pushes from which on they are one."""

PASSES = 4
"""Of fields and noise in turn."""

LOOKS = 4.0
"""Nats at first look from which on a field is fitted with noise of its own."""

FITTED = 3
"""Fields that are; and pushes that wander, where they must show at first look."""

BESIDE = 3
"""Pushes that wander which a field is asked beside, in a direction each: a body in a plane has as many."""

FLIPS = 24
"""Draws of what is left with signs by chance, step by step: what fields would see in noise alone."""

SEEN, LOOKED_AT = 3.0, 8
"""Standard deviations above those from which on a field is looked at (the fields that were beyond their price stood out by 4 or more), and
how many are: the ones that stand out most.
"""

SURE = 10.0
"""Those from which on all are: where all have a mean in them that is there, the finest stands out least, and may explain most."""

DIRECTIONS = 4
"""Pushes that wander, in some direction and as quickly, that are looked at where they must show at first look."""

VANISHING = 1e-150
"""Of what is whitened: the tail of a bump falls off without end, and products of numbers whose squares underflow take a processor many
times as long as others.
"""

SETTLED = 0.5
"""Nats that a pass must gain for another one."""

ALPHA = 1e-3
"""Chance that noise shows a field, as far as likelihoods are right."""

MORE = 0.05
"""Of what effects explain that a field must explain beyond them, for them to be the wrong ones."""

CLEARLY, NEEDED = 20.0, 5.0
"""Nats by which a push that wanders must explain more than names do, and by which these must add to it, to be more than such a push."""

NEARLY = 0.25
"""Of what names explain, at first look: a push that wanders and has less will not come up to them."""

ALIKE = 3.0
"""Nats within which two coordinates say the same."""

BODY, ANGLES = {"x", "y", "theta"}, ("theta", "heading", "yaw")


@dataclass(frozen=True)
class Field:
    """token: what it depends on; also: what others that say the same do. x: (n, nx, m) bumps times a push; beta: (m,).

    nats: beyond the model's own noise of any colour.
    """

    token: str
    also: tuple[str, ...]
    x: Array
    beta: Array
    nats: float
    weighed: Callable[[], float]

    @cached_property
    def beyond(self) -> float:
        """Nats beyond noise and what wanders by itself, less the price of having looked. Few ask, and it takes longer than all the rest."""
        return self.weighed()

    @property
    def judged(self) -> Judged:
        """As a dictionary that was judged, for rollouts."""
        return Judged(self.token, self.x, self.nats, 1.0, np.tile(self.beta, (BLOCKS, 1)))

    @property
    def tokens(self) -> tuple[str, ...]:
        """Likeliest first."""
        return tuple(dict.fromkeys((self.token, *self.also)))


@dataclass(frozen=True)
class _Offer:
    """One field that may be: its token, bumps (n, m) and push (n, nx)."""

    token: str
    bumps: Array
    push: Array

    @property
    def x(self) -> Array:
        """(n, nx, m) on a scale of 1."""
        x = self.push[:, :, None] * self.bumps[:, None, :]
        return np.asarray(x / math.sqrt(max(float(np.mean(x * x)), 1e-300)))


def field(left: Left) -> Field | None:
    """The field that explains most of what a model leaves, if it is beyond noise of its own colour."""
    bare = bare_nats(left)
    looked, tried = _looked(left, _offered(left), bare, LOOKED_AT, SURE)
    kept = [(offer, first) for nats, offer, first in looked if nats > LOOKS][:FITTED]
    if not kept:
        return None
    fitted = sorted(((*_marginal(left, offer.x, PASSES, first), offer) for offer, first in kept), key=lambda f: -f[0])
    price = math.log(tried / ALPHA)
    paid = [f for f in fitted if f[0] - bare >= price]
    body = body_noise(left) if paid else None
    best = next((f for f in paid if body is None or _beside(left, body, f[2].x) >= price), None)
    if best is None:
        return None
    nats, beta, told = best
    also = tuple(offer.token for other, _, offer in fitted if offer is not told and nats >= other > nats - ALIKE)
    return Field(told.token, also, told.x, beta, nats - bare, lambda: _beyond(left, nats - price, told.x, beta, price))


def _beside(left: Left, body: BodyNoise, x: Array) -> float:
    """Nats of a field beside noise along the body, some of which a field takes up. It is asked of one that has its price, before it is
    asked what wanders, which takes ten times as long.
    """
    return _marginal(left, x, PASSES, body=body)[0] - _under_any_law(body.z, body.whiten, left)


def _beyond(left: Left, nats: float, x: Array, beta: Array, price: float) -> float:
    """What `beyond` says of a field that has so many nats less its price: beyond pushes that wander, or, if that is none, beside them."""
    beyond = nats - max(bare_nats(left), wandering_nats(left))
    return beyond if beyond > 0.0 else _beside_pushes(left, x, beta) - price


def _beside_pushes(left: Left, x: Array, beta: Array) -> float:
    """Nats of a field, fitted to beta alone, beside the pushes that wander most: both may be there, and a push that is free to follow time
    closely follows a field, too, and leaves more than both leave. One that adds nothing to the best of them is asked no further.
    """
    pushes = [_scaled(push.x, own) for _, push, own in _pushes(left)]
    if not pushes:
        return -math.inf
    own, alone = _scaled(x, beta), max(bare_nats(left), wandering_nats(left))
    for some in (pushes[:1], pushes) if len(pushes) > 1 else (pushes,):
        beside = _marginal(left, np.concatenate([*some, own], axis=2), PASSES)[0]
        if beside <= alone:
            return beside - alone
    return beside - max(alone, _marginal(left, np.concatenate(pushes, axis=2), PASSES)[0])


def _scaled(x: Array, beta: Array) -> Array:
    """x (n, nx, m) such that its slopes beta (m,) are of size 1: what is fitted together has one ridge."""
    return np.asarray(x * math.sqrt(max(float(np.mean(beta * beta)), 1e-300)))


def _looked(
    left: Left, offered: Iterable[_Offer], bare: float, most: int, sure: float = math.inf
) -> tuple[list[tuple[float, _Offer, Marginal]], int]:
    """(nats at first look, offer, its first pass), the best first, of those that stand out most, or beyond doubt; and how many were
    offered.
    """
    ranked, tried = _standing_out(left, offered)
    passed = [(offer, _marginal(left, offer.x, 1)) for k, (far, offer) in enumerate(ranked) if k < most or far > sure]
    return sorted(((first[0] - bare, offer, first) for offer, first in passed), key=lambda look: -look[0]), tried


def _standing_out(left: Left, offered: Iterable[_Offer]) -> tuple[list[tuple[float, _Offer]], int]:
    """(standard deviations above chance, offer) of those that stand out, the first one most; and how many were offered."""
    flipped = _flipped(left)
    every = list(offered)
    along = {id(offer.push): np.einsum("ki,kis->ks", offer.push, flipped) for offer in {id(o.push): o for o in every}.values()}
    scored = [(_stands_out(offer, along[id(offer.push)]), offer) for offer in every]  # the same pushes go with many coordinates
    return sorted((pair for pair in scored if pair[0] > SEEN), key=lambda pair: -pair[0]), len(every)


def _flipped(left: Left) -> Array:
    """(n, nx, 1 + FLIPS) S^-1 r, wild values weighted down; then the same with the sign of each step by chance."""
    z = left.fit.z
    push = np.clip(z, -CLIPPED, CLIPPED) * noises.weight(z)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(z), 1, FLIPS))
    return left.fit.whiten.back(np.concatenate([push[:, :, None], push[:, :, None] * signs], axis=2))


def _stands_out(offer: _Offer, along: Array) -> float:
    """Score test of tau = 0: standard deviations by which the size of the slopes, each on the scale that chance gives it, is above that by
    chance. It needs no whitened bumps, so a field that is not there costs next to nothing (X. Lin, Biometrika 84, 1997, on such tests).
    along: (n, 1 + FLIPS), what was `_flipped` along its push.
    """
    slopes = offer.bumps.T @ along
    size = np.sum(slopes**2 / np.maximum(np.mean(slopes[:, 1:] ** 2, axis=1, keepdims=True), 1e-300), axis=0)
    return float((size[0] - np.mean(size[1:])) / max(float(np.std(size[1:])), 1e-300))


def beats(field: Field, nominal: Left, named: Left) -> bool:
    """Whether a field in what the nominal model leaves explains more than what was named does, and a push that wanders beside it."""
    mine = max(bare_nats(named), wandering_nats(named)) - bare_nats(nominal)
    return field.nats - mine > MORE * abs(mine) + math.log(1.0 / ALPHA)


def wanders(nominal: Left, named: Left) -> bool:
    """Whether a push that wanders in time explains clearly more than what was named, and this nothing beside it."""
    bare, alone = bare_nats(nominal), bare_nats(named)
    without = wandering_nats(nominal, NEARLY * (alone - bare))
    if without - alone <= CLEARLY:
        return False
    beside = wandering_nats(named)  # with the names, it does as well as alone at least, unless it was not found
    return beside - alone >= NEEDED and beside - without < NEEDED


def as_noise(left: Left, judged: Judged) -> bool:
    """Whether a push that wanders explains what a dictionary does, and more, or noise of some colour what only sliding shows."""
    nats = nats_of(left, judged.x)
    return max(nats, judged.gain) <= 0.0 or wandering_nats(left) > bare_nats(left) + max(nats, 0.0) + ALIKE


def nats_of(left: Left, x: Array) -> float:
    """What a dictionary x (n, nx, m) explains as a field is judged: beyond noise of any colour, by its marginal likelihood, with noise of
    its own.
    """
    return _marginal(left, x, PASSES)[0] - bare_nats(left)


def nats_of_fit(left: Left, fit: Fit, price: float) -> float:
    """The same of another model, the numbers of which cost so much."""
    return _under_any_law(fit.z, fit.whiten, left) - bare_nats(left) - price


def bare_nats(left: Left) -> float:
    """Log likelihood of what a model leaves, under noise of whatever colour is likeliest."""
    if "bare" not in left.known:
        left.known["bare"] = _under_any_law(left.fit.z, left.fit.whiten, left)
    bare: float = left.known["bare"]
    return bare


def wandering_nats(left: Left, least: float = 0.0) -> float:
    """The same with a push that wanders in time, in whichever direction that is likeliest. least: nats that it must have at first look if
    they are more than LOOKS, else it is not looked at any closer.
    """
    bare = bare_nats(left)
    if least <= LOOKS or "pushes" in left.known:
        return max((nats for nats, _, _ in _pushes(left)), default=bare)
    looked, _ = _looked(left, _wandering(left), bare, DIRECTIONS)
    kept = [(offer, first) for nats, offer, first in looked if nats > least][:FITTED]
    return max((_marginal(left, offer.x, PASSES, first)[0] for offer, first in kept), default=bare)


def _pushes(left: Left) -> list[tuple[float, _Offer, Array]]:
    """(log likelihood, push, slopes) of BESIDE pushes that wander, in a direction each, as quickly as is likeliest, the best first. All
    that stand out are fitted: at first look, the noise has all in it that wanders.
    """
    if "pushes" not in left.known:
        ranked, _ = _standing_out(left, _wandering(left))
        found = sorted(((*_marginal(left, offer.x, PASSES), offer) for _, offer in ranked), key=lambda f: -f[0])
        best = {id(offer.push): (nats, offer, beta) for nats, beta, offer in reversed(found)}
        left.known["pushes"] = sorted(best.values(), key=lambda f: -f[0])[:BESIDE]
    pushes: list[tuple[float, _Offer, Array]] = left.known["pushes"]
    return pushes


def _wandering(left: Left) -> Iterator[_Offer]:
    """Pushes that may wander, in each direction."""
    given, model = left.given, left.fit.model
    body, world = directions_of(given, model, acting(model, given.data))
    when = np.arange(len(given.steps), dtype=float)[:, None]
    return _over("time", when, (*body, *world), (*CELLS, QUICKEST))


def _offered(left: Left) -> Iterator[_Offer]:
    """Fields, each from coarse to fine."""
    given, model = left.given, left.fit.model
    act = acting(model, given.data)
    y = quieter(given, left.fit.noise, left.r)
    u = act.mean[given.steps.place]
    body, world = directions_of(given, model, act)
    commanded = not given.data.measured_forces
    own = [u[:, [j]] * push for j, push in enumerate(own_pushes(given, model, act))] if commanded else []
    named = _named(left)
    moved = _apart([*_moved(left), *named] if set(model.states) >= BODY else [*own, *named])
    for place in _places(model.states, y):
        yield from _over("position", place, moved)  # floors have stripes and hills of all sizes
        yield from _over("position", place, world if {*model.states} >= BODY else [*body, *world])
    for name in ANGLES:
        if name in model.states:
            angle = y[:, model.states.index(name)]
            yield from _over("heading", np.column_stack([np.cos(angle), np.sin(angle)]), [*moved, *body])
    for j, name in enumerate(model.inputs if commanded else ()):
        size = max(float(np.max(np.abs(u[:, j]))), 1e-12)
        if given.data.in_order:
            yield from _over(f"time*{name}", given.steps.t[:, None], [own[j]], CELLS[:SLOW])
        for i, other in enumerate(model.inputs):
            token = name if i == j else f"{other}*{name}" if i < j else f"{name}*{other}"
            yield from _over(token, u[:, [j]] / size, [own[i]])
    if named and given.data.in_order:
        yield from _over("time", given.steps.t[:, None], named, CELLS[:SLOW])


def _over(token: str, coordinate: Array, pushes: Sequence[Array], cells: Sequence[int] = CELLS) -> Iterator[_Offer]:
    pushes = [push for push in pushes if np.any(push)]
    for bumps in _bumps(coordinate, cells) if pushes else ():
        yield from (_Offer(token, bumps, push) for push in pushes)


def _places(states: Sequence[str], y: Array) -> list[Array]:
    """Positions, and axis by axis: what goes with one alone is said by far fewer numbers."""
    columns = [i for i, name in enumerate(states) if name in {"x", "y", "z", "q"}]
    alone = [y[:, [i]] for i in columns] if len(columns) > 1 else []
    return [*([y[:, columns]] if columns else []), *alone]


def _moved(left: Left) -> list[Array]:
    """(n, nx) how the model goes, and how it turns, in each step."""
    model, steps = left.fit.model, left.given.steps
    way = model.difference(steps.y1, steps.y0) - left.r
    on, about = np.zeros_like(way), np.zeros_like(way)
    columns = [model.states.index(name) for name in ("x", "y")]
    on[:, columns] = way[:, columns]
    about[:, model.states.index("theta")] = way[:, model.states.index("theta")]
    return [on, about]


def _apart(pushes: list[Array]) -> list[Array]:
    """Less those that are another one on another scale."""
    kept: list[Array] = []
    for push in pushes:
        size = float(np.linalg.norm(push))
        if size > 0.0 and all(abs(float(np.sum(push * other))) < SAME * size * float(np.linalg.norm(other)) for other in kept):
            kept.append(push)
    return kept


def _named(left: Left) -> list[Array]:
    """(n, nx) what a change of each number does that the data put into the model."""
    model = left.fit.model
    free = free_of(model)
    table = slopes(left.given, model, free) if free else np.zeros((*left.r.shape, 0))
    return [table[:, :, k] for k in range(table.shape[2])]


def _bumps(c: Array, at_most: Sequence[int]) -> Iterator[Array]:
    """(n, cells) bumps over where c (n, d) was, the coarse ones first."""
    span = float(np.max(np.ptp(c, axis=0)))
    from_least, before, found = c - c.min(axis=0), 0, {}
    for most in at_most if span > 0.0 else ():
        for along in GRIDS:
            if along not in found:
                found[along] = _cells(from_least * (along / span), along)
            cells = found[along]
            if len(cells) <= min(most, len(c) // SPARE):
                break
        if before < len(cells) <= min(most, len(c) // SPARE):
            before = len(cells)
            away = from_least[:, None, :] * (along / span) - cells
            yield np.exp(-0.5 * np.sum((away / WIDE) ** 2, axis=2))


def _cells(place: Array, along: int) -> Array:
    """(cells, d) whole numbers nearest to places (n, d) between 0 and `along`, each once."""
    sides = (along + 1) ** np.arange(place.shape[1])[::-1]
    numbers = np.unique(np.rint(place).astype(np.int64) @ sides)
    return np.asarray(numbers[:, None] // sides % (along + 1), dtype=np.float64)


def _marginal(left: Left, x: Array, passes: int, first: Marginal | None = None, body: BodyNoise | None = None) -> Marginal:
    """(log marginal likelihood, beta (m,)) of x (n, nx, m), the best of some passes of beta and noise in turn. What is left is judged, and
    its price is taken, under one noise. first: what the first pass said, if that was asked before. body: a share of the noise goes there.
    """
    joined = left.given.steps.joined
    whiten, z = (left.fit.whiten, left.fit.z) if body is None else (body.whiten, body.z)
    best, told, rest = -math.inf, np.asarray(np.zeros(x.shape[2])), left.r
    columns = np.asfortranarray(x.reshape(-1, x.shape[2]))  # as whitening takes them: they are copied once, not in every pass
    if first is not None:
        best, told = first
        rest = left.r - (columns @ told).reshape(left.r.shape)
    for again in range(0 if first is None else 1, passes):
        if again:
            noise = noises.estimate(rest, left.f, joined, left.given.floor)
            whiten = Whitener(noise, left.f, joined) if body is None else whitener(left, noise, body.push, body.share)
            z = whiten(rest)
        before, root = best, np.sqrt(noises.weight(np.clip(z, -CLIPPED, CLIPPED)))
        weighted = whiten.columns(columns)
        weighted *= root.reshape(-1, 1)
        np.copyto(weighted, 0.0, where=np.abs(weighted) < VANISHING)
        product = weighted.T @ weighted  # half the work of a product of two
        slope = weighted.T @ (root * np.clip(whiten(left.r), -CLIPPED, CLIPPED)).ravel()
        told_by = evidence(product, slope)
        beta = told_by.beta(slope)
        rest = left.r - (columns @ beta).reshape(left.r.shape)
        z = whiten(rest)
        less = _less(left, z)
        size = np.sum(np.einsum("km,km->k", weighted, weighted).reshape(left.r.shape), axis=0)
        finer = float(np.sum(size / less**2) / max(float(np.sum(size)), 1e-300))
        price = told_by.price(finer) + 0.5 * told_by.ridge * float(beta @ beta)
        nats = _under_any_law(z / less, whiten, left) - price - len(z) * float(np.sum(np.log(less)))
        if nats > best:
            best, told = nats, beta
        if best < before + SETTLED:
            break
    return best, told


def _less(left: Left, z: Array) -> Array:
    """(nx,) times the noise of the model that what is left, whitened by it to z, still has: estimated noise in short."""
    least = left.given.floor.one_step(left.f) / left.fit.noise.one_step(left.f)
    return np.asarray(np.clip(np.sqrt(np.mean(np.clip(z, -4.0, 4.0) ** 2, axis=0)), np.minimum(least, 1.0), 1.0))


def _under_any_law(z: Array, whiten: Whitener, left: Left) -> float:
    """Log likelihood of a whitened residual under white noise, or coloured, or such as wanders. What a smooth function was fitted to
    wanders less than white noise does afterwards: that is the fit's own doing, and no law of the noise.
    """
    joined = left.given.steps.joined
    colour = noises.colour(z, joined)
    law = noises.wandering(z, joined, colour)
    law = law and noises.no_steadier(law, colour, np.ones(z.shape[1], dtype=bool))
    laws = (noises.no_colour(z.shape[1]), colour, law)
    return max(noises.log_likelihood(z, whiten, law, joined) for law in laws if law is not None)
