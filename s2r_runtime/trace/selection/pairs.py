"""Two effects that hide each other: neither is what does best alone, or is seen at all.

A robot that takes a bias on an input for half of its friction shows neither. All pairs of starts are looked at without a fit: with columns
c_i of `screening` (what a start changes in the prediction, whitened, rows weighted by the noise's density), on a scale of 1, and what is
left, z,

    b = (c_i'z, c_j'z),  k = c_i'c_j:    nats of both = (b_i^2 - 2 k b_i b_j + b_j^2) / (2 (1 - k^2))

as far as effects enter linearly and their numbers stay inside their bounds. An effect of several numbers that all enter linearly (a slope
along x and y) counts with all its columns, as nats of a projection. The best few, their numbers paid for, are fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.parameters import bounds_of, slots_of, values_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, fitted, foretold, gain, insert, sought
from s2r_runtime.trace.hypotheses.library import candidates, places
from s2r_runtime.trace.hypotheses.starting_values import Leftover
from s2r_runtime.trace.selection.scores import STRICT, name_of, names
from s2r_runtime.trace.selection.screening import Probe, columns, probes_of
from s2r_runtime.trace.selection.stepwise import Selection
from s2r_runtime.trace.selection.ties import NEAR

Array = NDArray[np.float64]

TAKEN = 0.3, 3.0
"""Times what it does that a start may do that does not enter linearly."""

ALIKE = 0.9999
"""Square of the cosine between two columns from which on they are one."""

SPANNED = 1e-6
"""Of the largest singular value of an effect's columns, from which on one of them is there."""

FITTED = 4
"""Pairs that are fitted, of those with an effect that was chosen already (beside which anything makes a good pair), and of others."""


def two_together(given: Problem, chosen: Selection, foretells: Callable[[list[Fit]], list[float]]) -> Selection | None:
    """The two that explain most together. `called_for` goes on from them. None where no such two explain more than what was chosen, every
    start tried paid for, or where this is more than two already. foretells: nats by which each foretells what was not fitted better than
    the first one, which tells those apart that explain as much.
    """
    if len(chosen.fit.added) > 2:
        return None
    base, n = chosen.nominal, len(given.steps)

    def worth(fit: Fit) -> float:
        return gain(fit, base) - STRICT.price(fit.k - base.k, n)

    models = [model for pair in _promising(given, chosen) for model in _together(*pair)]
    fits = [fitted(given, base, model, 2) for model in models if foretold(given, model) is not None]  # each alone may be where both are not
    most = max((worth(fit) for fit in fits), default=-math.inf)
    if most - worth(chosen.fit) <= STRICT.needed(chosen.tried, 0, n):
        return None
    near = [fit for fit in fits if worth(fit) > most - NEAR]
    best = near[int(np.argmax([worth(fit) + ahead for fit, ahead in zip(near, foretells(near), strict=True)]))]
    return replace(chosen, fit=fitted(given, best, best.model), rivals=())


def _promising(given: Problem, chosen: Selection) -> list[tuple[Probe, Probe]]:
    """Pairs of different effects that explain most, as far as that is linear."""
    base, given = chosen.nominal, given.coarse
    before = given.predicted(base.model)
    probes = probes_of(base.model, candidates(base.model, given.data, Leftover(given, base)))
    root = np.sqrt(noises.weight(base.z.ravel()))
    found = [(probe, c * root[:, None]) for probe, c in columns(given, base, probes, before)]
    least = 1e-9 * max((float(np.linalg.norm(c)) for _, c in found), default=0.0)
    found = [(probe, c) for probe, c in found if np.linalg.norm(c) > least]
    if not found:  # a user's own model may step nowhere else
        return []
    z = root * base.z.ravel()
    ones, several = ([one for one in found if (one[1].shape[1] > 1) == more] for more in (False, True))
    size = np.array([np.linalg.norm(c) for _, c in ones])
    table = np.array([c[:, 0] for _, c in ones]).reshape(len(ones), len(z)) / size[:, None]
    ranges = np.array([_range(probe) for probe, _ in ones]).reshape(-1, 2) * size[:, None]
    spans = [_span(c) for _, c in several]
    nats = np.zeros((len(found), len(found)))
    nats[: len(ones), : len(ones)] = _nats(table, z, ranges)
    for i, span in enumerate(spans, len(ones)):
        nats[: len(ones), i] = _nats_beside(span, table, z, ranges)
        nats[len(ones) : i, i] = [_nats_of_spans(span, other, z) for other in spans[: i - len(ones)]]
    who = [probe for probe, _ in (*ones, *several)]
    price = np.array([STRICT.price(_numbers(probe), len(given.steps)) for probe in who])
    return _best(nats - price[:, None] - price, who, set(names(chosen.fit.model)))


def _numbers(probe: Probe) -> int:
    """Of its effect, as `Fit.k` counts them."""
    c, model = probe.candidate, probe.start
    place = c.place if c.replaced < 0 else c.replaced
    slots = list(slots_of(model.effects[place], place))
    return max(len(slots), 1) + sum(sought(model, slot) for slot in slots)


def _span(c: Array) -> Array:
    """(p, n), orthonormal, of what columns (n, p) span."""
    u, s, _ = np.linalg.svd(c, full_matrices=False)
    return np.asarray(u[:, s > SPANNED * s[0]].T)


def _nats_beside(span: Array, c: Array, z: Array, ranges: Array) -> Array:
    """(m,) what a span (p, n) explains of z (n,) together with each of c (m, n); 0 where that takes the latter out of its range (m, 2)."""
    k, own = c @ span.T, span @ z
    apart = 1.0 - np.minimum(np.sum(k * k, axis=1), ALIKE)
    beta = (c @ z - k @ own) / apart
    inside = (beta >= ranges[:, 0]) & (beta <= ranges[:, 1]) & (apart > 1.0 - ALIKE)
    return np.asarray(np.where(inside, 0.5 * (own @ own + beta * beta * apart), 0.0))


def _nats_of_spans(one: Array, other: Array, z: Array) -> float:
    """What two spans (p, n) explain of z (n,) together."""
    rest = other - other @ one.T @ one
    own, more = one @ z, rest @ z
    return 0.5 * float(own @ own + more @ np.linalg.pinv(rest @ rest.T, rcond=1.0 - ALIKE, hermitian=True) @ more)


def _nats(c: Array, z: Array, ranges: Array) -> Array:
    """(m, m) what two columns of c (m, n) explain together of z (n,); 0 where that takes one of them out of its range (m, 2)."""
    k, b = c @ c.T, c @ z
    apart = 1.0 - np.minimum(k * k, ALIKE)
    beta = (b[:, None] - k * b) / apart  # [i, j]: of i, beside j
    inside = (beta >= ranges[:, :1]) & (beta <= ranges[:, 1:])
    nats = 0.5 * (b[:, None] * beta + b * beta.T)
    return np.asarray(np.where(inside & inside.T & (k * k < ALIKE), nats, 0.0))


def _range(probe: Probe) -> tuple[float, float]:
    """Scales of a probe's column at which its number is inside its bounds; behind a kink it is no line for long."""
    if not probe.free:
        return TAKEN
    slot = probe.free[0]
    p, value = bounds_of(probe.start, slot), float(values_of(probe.start, (slot,))[0])
    neutral = p.neutral or 0.0
    away = value - neutral
    if away == 0.0:
        return 0.0, 0.0
    low, high = sorted(((p.low - neutral) / away, (p.high - neutral) / away))
    return (max(low, 0.0), min(high, TAKEN[1])) if p.kink else (low, high)


def _best(nats: Array, who: list[Probe], chosen: set[tuple[str, str]]) -> list[tuple[Probe, Probe]]:
    """The best pairs, FITTED of either kind, each (effect, channel) with another one once."""
    one, other = np.triu_indices(len(who), 1)
    upper = nats[one, other]
    kept: dict[frozenset[tuple[str, str]], tuple[Probe, Probe]] = {}
    places_left = {True: FITTED, False: FITTED}
    for i in np.argsort(-upper).tolist():
        pair = who[one[i]], who[other[i]]
        key = frozenset((p.candidate.name, p.candidate.channel) for p in pair)
        known = bool(key & chosen)
        if upper[i] <= 0.0 or not any(places_left.values()):
            break
        if len(key) == 2 and key not in kept and places_left[known]:
            kept[key] = pair
            places_left[known] -= 1
    return list(kept.values())


def _together(one: Probe, other: Probe) -> list[ComposedModel]:
    """The model with both, in each order that makes a difference."""
    c, there = other.candidate, one.start.effects
    a = other.start.effects[c.place if c.replaced < 0 else c.replaced]
    if c.replaced < 0:
        return [insert(one.start, a, place) for place in places(one.start, a.effect, a.channel)]
    if name_of(there[c.replaced]) != name_of(a):  # the first one stands before it
        return []
    return [replace(one.start, effects=(*there[: c.replaced], a, *there[c.replaced + 1 :]))]
