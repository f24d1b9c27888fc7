"""A first look at every candidate, linear in cost: which are worth a fit?

Every start of every candidate is one column c: what it changes in the prediction, whitened under the present model's noise. With J the
sensitivities of what the present model's own parameters do (they may move aside for the newcomer),

    value = max over delta of  sum log density(z - c - J delta)  -  sum log density(z)           least squares, the density's weights

An effect that enters linearly needs no grid: its columns, one a number, are scaled by the same least squares. So are all sizes
together of one that does as much more as they are larger (`homogeneous`: a force, and a larger one at rest): a curve of the right shape
that is ten times too large is worse than nothing.

What bends (a delay, a play) is nearly linear between nothing and a start only: of starts that look good by that, the best one is that which
explains most as it stands. A delay of twenty steps that is sought from fifteen ends at a smaller maximum beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.parameters import Free, bounds_of, inside, slots_of, values_of, with_values
from s2r_runtime.trace.estimation.problem import Fit, Problem, foretold, foretold_by, refine, sensitivities
from s2r_runtime.trace.hypotheses.library import Candidate

Array = NDArray[np.float64]

STEPS_ON = 2
"""Gauss-Newton steps from the best start of an effect with several numbers: enough to show whether it leads anywhere."""

HOPELESS = 50.0
"""Nats, or those of the best start if they are more, by which a start is worse than nothing that two steps will not make worth a fit: one
of 397 such came to more than a fifth of the best, where that had more than 7 nats. By a quiet sensor even a limit that is a twentieth too
low is: of those, the one is followed that would be worth most if it did less of the same.
"""

WORTH = 10.0
"""Nats that a start must promise for doing less: no effect counts that explains fewer."""

PROMISING = 0.2
"""Of what the best start explains: one that explains less is not looked at in its fuller form."""

ALOOK = 3
"""Starts of an effect that are looked at as they stand."""

CHUNK = 48
"""Columns that are whitened together: few enough to stay in the cache of a small machine."""


@dataclass(frozen=True)
class Screened:
    """A candidate's best start, with what it would gain in nats under the present noise."""

    value: float
    candidate: Candidate
    start: ComposedModel
    less: float = -math.inf
    """Nats that it would gain if it did only a part of what it does, as no values of its own may say."""

    @property
    def of(self) -> tuple[str, str]:
        """(effect, channel)."""
        return self.candidate.name, self.candidate.channel


@dataclass(frozen=True)
class Probe:
    """A start. models: one a column; free: the slots that the columns scale, each one or all by the only one, none where the start is taken
    as it is; values: names of the effect's parameters that the start holds.
    """

    candidate: Candidate
    start: ComposedModel
    models: tuple[ComposedModel, ...]
    free: Free
    values: tuple[str, ...]


def screen(given: Problem, base: Fit, found: Sequence[Candidate], hopeless: float = HOPELESS) -> tuple[list[Screened], int]:
    """Every candidate with its best start, best first; and how many starts were looked at. hopeless: nats below nothing from which on a
    start is not followed, if the best one has no more than that above.
    """
    given = given.coarse
    probes = probes_of(base.model, found)
    before = given.predicted(base.model)
    white = replace(base, colour=noises.no_colour(base.z.shape[1]))  # what looks like colour may be what an effect explains
    aside = _Aside(base.z.ravel(), sensitivities(given, white, base.model, base.free))
    level = float(np.sum(noises.log_density(aside.z)))
    found_of: dict[tuple[str | int, ...], list[Screened]] = {}  # by set of parameters: more of them may do no better at the start
    for probe, c in columns(given, base, probes, before):
        value, start = aside.look(probe, c)
        less = -math.inf if probe.free else aside.less(c)
        key: tuple[str | int, ...] = (probe.candidate.name, probe.candidate.channel, probe.candidate.place, *sorted(probe.values))
        if np.isfinite(value):
            found_of.setdefault(key, []).append(Screened(value - level, probe.candidate, start, less - level))
    best = {key: sorted(several, key=lambda s: -s.value)[:ALOOK] for key, several in found_of.items()}
    enough = max(PROMISING * max((several[0].value for several in best.values()), default=0.0), 0.0)
    first = {
        key: _as_it_stands(given, white, aside, before, several, level) if several[0].value > enough else several[0]
        for key, several in best.items()
    }
    first = {key: s for key, s in first.items() if foretold(given, s.start) is not None}  # as it was scaled
    least = -max(max((s.value for s in first.values()), default=0.0), hopeless)
    moved = {
        key: max((_moved_on(given, white, aside, before, one, level) for one in _shapes(s, best[key])), key=lambda s: s.value)
        if s.value > least
        else s
        for key, s in first.items()
    }
    enough = max(PROMISING * max((s.value for s in moved.values()), default=0.0), WORTH)
    for key, s in moved.items():
        too_much = max(found_of[key], key=lambda s: s.less)
        if too_much.less > max(s.value, enough):
            other = _moved_on(given, white, aside, before, too_much, level)
            moved[key] = other if other.value > s.value else s
    moved_on = [*moved.values()]
    enough = max(PROMISING * max((s.value for s in moved_on), default=0.0), 0.0)
    more = [_moved_on(given, white, aside, before, s, level) for s in _fuller(s for s in moved_on if s.value > enough)]
    return sorted([*moved_on, *more], key=lambda s: -s.value), len(probes) + len(more)


def _as_it_stands(given: Problem, white: Fit, aside: _Aside, before: Array, starts: Sequence[Screened], level: float) -> Screened:
    """Of starts of one effect, the best one first, that which explains most as it stands. What scaling promised of any is kept: a fit goes
    on from where this one is.
    """
    first = starts[0]
    place = _place(first)
    slots = slots_of(first.start.effects[place], place)
    if len(starts) < 2 or len(slots) != 1 or not bounds_of(first.start, slots[0]).kink or bounds_of(first.start, slots[0]).neutral is None:
        return first
    best, most = first, -np.inf
    for s in starts:
        there = foretold(given, s.start)
        value = -np.inf if there is None else aside.look(Probe(s.candidate, s.start, (s.start,), (), ()), _column(white, there - before))[0]
        if value > most:
            best, most = s, value
    return replace(best, value=max(first.value, most - level))


def _shapes(s: Screened, starts: Sequence[Screened]) -> list[Screened]:
    """Starts to go on from: the best one, or every one of an effect that scales in shape. The scale says little of the shape there: dry
    friction that is larger at rest is plain dry friction, if the speed at which it falls is next to none, and stays that.
    """
    return list(starts) if getattr(s.start.effects[_place(s)].effect, "homogeneous", False) else [s]


def _place(s: Screened) -> int:
    """Of the effect in its model's list."""
    return s.candidate.place if s.candidate.replaced < 0 else s.candidate.replaced


def _column(white: Fit, moved: Array) -> Array:
    """(n nx, 1) of what a model changes in the prediction, (n, nx)."""
    return white.whiten(moved).reshape(-1, 1)


def _fuller(found: Iterable[Screened]) -> Iterator[Screened]:
    """The same with more numbers, where an effect has a fuller form that does the same to begin with."""
    for s in found:
        place = _place(s)
        there = s.start.effects
        fuller = getattr(there[place].effect, "fuller", None)
        values = fuller(there[place].p) if fuller else None
        if values is not None:
            effects = (*there[:place], replace(there[place], p=values), *there[place + 1 :])
            yield replace(s, start=replace(s.start, effects=effects))


def probes_of(model: ComposedModel, found: Sequence[Candidate]) -> list[Probe]:
    """Every start of every candidate beside a model."""
    return [probe for c in found for probe in _probes(c, model)]


def columns(given: Problem, base: Fit, probes: Sequence[Probe], before: Array) -> Iterator[tuple[Probe, Array]]:
    """Each probe with what it changes in the prediction, `before` (n, nx), whitened: (n nx, models). A user's own model may not step
    everywhere; what it cannot step is left out.
    """
    for chunk in _chunks(probes):
        whole: list[Probe] = []
        moved: list[Array] = []
        foretold_there = iter(foretold_by(given, [m for probe in chunk for m in probe.models]))
        for probe in chunk:
            there = [one - before for one in islice(foretold_there, len(probe.models)) if one is not None]
            if len(there) == len(probe.models):
                whole.append(probe)
                moved += there
        if not whole:
            continue
        table = base.whiten(np.array(moved).transpose(1, 2, 0)).reshape(before.size, -1)
        at = 0
        for probe in whole:
            yield probe, table[:, at : at + len(probe.models)]
            at += len(probe.models)


def _moved_on(given: Problem, white: Fit, aside: _Aside, before: Array, s: Screened, level: float) -> Screened:
    """An effect of several numbers, or of one that has no neutral value, some steps on from its best start: no scale brings it in place."""
    place = _place(s)
    slots = tuple(slots_of(s.start.effects[place], place))
    scales = all(bounds_of(s.start, slot).neutral is not None for slot in slots)
    if scales and (len(slots) < 2 or getattr(s.start.effects[place].effect, "additive", False)):
        return s
    start = refine(given, white, s.start, slots, STEPS_ON)
    column = _column(white, given.predicted(start) - before)
    value, _ = aside.look(Probe(s.candidate, start, (start,), (), ()), column)
    return Screened(value - level, s.candidate, start) if value - level > s.value else s


def _chunks(probes: Sequence[Probe]) -> Iterator[list[Probe]]:
    chunk: list[Probe] = []
    for probe in probes:
        chunk.append(probe)
        if sum(len(p.models) for p in chunk) >= CHUNK:
            yield chunk
            chunk = []
    if chunk:
        yield chunk


def _probes(candidate: Candidate, model: ComposedModel) -> Iterator[Probe]:
    for start in candidate.models(model):
        place = candidate.place if candidate.replaced < 0 else candidate.replaced
        slots = tuple(slots_of(start.effects[place], place))
        held = tuple(start.effects[place].p)
        neutral = [bounds_of(start, s).neutral for s in slots]
        sizes = tuple(s for s, v in zip(slots, neutral, strict=True) if v is not None)
        if len(sizes) == 1:  # from nothing at all to the start, whatever else it holds (when, how often)
            yield Probe(candidate, start, (start,), sizes, held)
            continue
        if sizes and getattr(start.effects[place].effect, "additive", False):  # what else it has stays as it begins
            alone = [_alone(start, sizes, i, [bounds_of(start, s).neutral for s in sizes]) for i in range(len(sizes))]
            if all(m is not None for m in alone):
                yield Probe(candidate, start, tuple(m for m in alone if m is not None), sizes, held)
                continue
        if len(sizes) > 1 and getattr(start.effects[place].effect, "homogeneous", False):  # in the shape that the start has
            yield Probe(candidate, start, (start,), sizes, held)
            continue
        yield Probe(candidate, start, (start,), (), held)


def _alone(start: ComposedModel, slots: Free, i: int, neutral: Sequence[float | None]) -> ComposedModel | None:
    """One number as at the start, the others at their neutral values."""
    values = values_of(start, slots)
    return with_values(start, slots, np.array([values[j] if j == i else neutral[j] or 0.0 for j in range(len(slots))]))


class _Aside:
    """z of the present model, and how its own parameters move aside. z: (m,), j: (m, k)."""

    def __init__(self, z: Array, j: Array) -> None:
        self.z = z
        self._w = noises.weight(self.z)
        self._tables: dict[int, tuple[Array, Array]] = {0: (j, j * self._w[:, None])}

    def look(self, probe: Probe, c: Array) -> tuple[float, ComposedModel]:
        """Log density of what the probe leaves, and the model that it means."""
        best = self._left(self.z - c[:, 0], *self._tables[0]) if c.shape[1] == 1 else (-np.inf, np.zeros(0))
        value, start = best[0], probe.start
        if probe.free:
            scaled, beta = self._left(self.z, *self._beside(c))
            neutral = np.array([bounds_of(start, s).neutral or 0.0 for s in probe.free])
            size = beta[: c.shape[1]]
            values = neutral + size * (values_of(start, probe.free) - neutral)
            other = with_values(start, probe.free, inside(start, probe.free, values))
            bent = any(bounds_of(start, s).kink for s in probe.free)  # then it is nearly linear between nothing and the start only
            if other is not None and scaled > value and (not bent or np.all((size > 0.0) & (size < 1.0))):
                value, start = scaled, other
        return value, start

    def less(self, c: Array) -> float:
        """Log density of what is left by a part of c (m, 1); none if that is no part."""
        value, beta = self._left(self.z, *self._beside(c))
        return value if 0.0 < beta[0] < 1.0 else -math.inf

    def _beside(self, c: Array) -> tuple[Array, Array]:
        """c (m, a) and what moves aside, side by side, and the same weighted: tables that are filled again for the next c."""
        j, jw = self._tables[0]
        own = c.shape[1]
        if own not in self._tables:
            self._tables[own] = np.hstack([c, j]), np.hstack([c, jw])
        x, xw = self._tables[own]
        x[:, :own] = c
        np.multiply(c, self._w[:, None], out=xw[:, :own])
        return x, xw

    def _left(self, z: Array, x: Array, xw: Array) -> tuple[float, Array]:
        """Log density of z less its least squares on x (m, k), weighted: xw; the coefficients."""
        if not x.shape[1]:
            return float(np.sum(noises.log_density(z))), np.zeros(0)
        product = xw.T @ x
        if len(product) == 1:  # as it mostly is
            only = np.asarray(xw.T @ z / max(float(product[0, 0]), 1e-300), dtype=np.float64)
            return float(np.sum(noises.log_density(z - x @ only))), only
        product += 1e-10 * np.diag(np.diag(product))
        try:
            beta = np.linalg.solve(product, xw.T @ z)
        except np.linalg.LinAlgError:  # a column of nothing
            beta = np.linalg.lstsq(product, xw.T @ z, rcond=1e-12)[0]
        return float(np.sum(noises.log_density(z - x @ beta))), np.asarray(beta)
