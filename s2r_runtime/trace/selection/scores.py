"""Candidates for one more effect, looked at, then fitted, then scored.

gain    nats that a model explains beyond another one, noise re-estimated under both, white and coloured: the smaller one
price   k/2 log n for k parameters on n transitions
score   gain less price
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.trace.estimation.parameters import Added, bounds_of, values_of
from s2r_runtime.trace.estimation.problem import Fit, Problem, fitted, gain, under_noise
from s2r_runtime.trace.hypotheses.library import candidates
from s2r_runtime.trace.hypotheses.starting_values import Leftover
from s2r_runtime.trace.selection.screening import Screened, screen

Name = tuple[str, str]
"""(effect, channel)."""

FEW = 10
"""Effects that are fitted as composed models, after screening."""

PLACES = 2
"""Places in the list of effects that are fitted of one candidate."""

HOPELESS, HOPELESS_SHARE = 2.0, 0.2
"""A candidate that screening gives fewer nats, or less than this share of the best one's, is not fitted."""

FAR = 100.0
"""Bounds beyond it, and below its inverse, are there for form's sake: no robot's parameter is near them."""

GIVEN_UP = 1e-3
"""Of the largest number of its kind: one that is so small is none."""

FIRST_LOOK = 4
"""Candidates of the first look that are fitted, where there is a second one."""

ONWARD = 0.4
"""Of what the best candidate explains, or of what is needed: one that has less after a round of parameters and noise gets no second one. Of
625 such, of 998, none that was needed came to three fifths of the best one in another.
"""

KEPT = 12
"""Searches that are known at a time: a selection goes back to the models less one effect, of which there are at most five, and a second
look goes the way of the first one again.
"""

AS_MUCH = 3.0
"""Nats that a model may explain less than another one of the same effects (its noise was begun elsewhere) for a search beside it to do."""

REACHES = 0.3
"""Of what another model explains: a candidate that screening gives less will not come up to it. Of 114 that did best once they were
fitted, one had been given less than this share of what the best at first sight had.
"""


@dataclass(frozen=True)
class Scored:
    """A candidate that was tried, with its score in nats."""

    name: str
    channel: str
    score: float
    fit: Fit | None = None


@dataclass(frozen=True)
class Bar:
    """What an effect must clear. alpha: chance of naming anything where nothing is, as far as the likelihood is right; each: nats a
    parameter costs, None for Schwarz's price; share: by which some rollout's error must fall, so that somebody would notice.
    """

    alpha: float
    each: float | None = None
    share: float = 0.05

    def price(self, k: int, n: int) -> float:
        """Of k parameters on n transitions."""
        return k * (0.5 * math.log(max(n, 2)) if self.each is None else self.each)

    def needed(self, tried: int, k: int, n: int) -> float:
        """Nats of gain from which on an effect counts, everything tried paid for."""
        return math.log(max(tried, 1) / self.alpha) + self.price(k, n)


CONTENDS, SETTLES = 15.0, 6
"""Nats behind the best within which candidates are fitted on, and for how many rounds at most: where a number and the noise hang together
(a gain and how fast a pose drifts), two rounds leave more than that open.
"""

STRICT = Bar(1e-2)
"""One clean recording in a hundred may be given a name, and Schwarz's price is paid besides: the likelihood is never quite right."""

LENIENT, ALONE = Bar(0.3, 1.5), Bar(0.3, 1.5, 0.01)
"""For where structure is shown already, beside what was named and where nothing was: it shows in rollouts, so what leaves nothing of it may
do a little less on a part of the data.
"""


def at_first_look(given: Problem, fit: Fit, base: Fit) -> float:
    """Nats that a model explains beyond another one, as its effect is seen beside that one first: under the other one's noise, which has
    taken up most of what is large. At most what it explains once the noise is its own.
    """
    return min(gain(fit, base), under_noise(given, fit.model, base.noise).white - base.white)


def best_candidates(
    given: Problem,
    base: Fit,
    few: int = FEW,
    bar: Bar = STRICT,
    against: float = 0.0,
    known: Scored | None = None,
    refused: Collection[Name] = (),
) -> tuple[list[Scored], int]:
    """The candidates for one more effect, fitted, best score first; and how many starts were looked at. against: nats that
    they must come up to, `at_first_look`. known: one of them that is fitted already. refused: those that need not be asked again.
    """
    search = _search(given, base)
    scored: dict[tuple[str, str], Scored] = {}
    if known is not None:
        scored[known.name, known.channel] = known
    screened, looked_at = search.fitted(few, REACHES * against, known, refused)
    for s, fit in looked_at:
        value = gain(fit, base) - bar.price(fit.k - base.k, len(given.steps))
        key = s.of
        if key not in scored or value > scored[key].score:
            scored[key] = Scored(*key, value, fit)
    best = max((s.score for s in scored.values()), default=0.0)
    close = [one for one in scored.values() if one.score > best - CONTENDS] if best > 0.0 else []
    for one in close if len(close) > 1 else ():
        if one.fit is not None and one is not known:
            fit = search.settled(one.fit)
            scored[one.name, one.channel] = replace(one, score=gain(fit, base) - bar.price(fit.k - base.k, len(given.steps)), fit=fit)
    for s in screened:
        scored.setdefault(s.of, Scored(*s.of, min(s.value, 0.0)))
    return sorted(scored.values(), key=lambda s: (s.fit is None, -s.score)), search.tried


def overlooked(given: Problem, base: Fit, found: Sequence[Scored], bar: Bar, needed: float) -> list[Scored]:
    """Candidates that looked hopeless only beside those which were fitted, where these turned out to be none; best score first. needed: of
    nats, for one of them at first sight.
    """
    refused = {(s.name, s.channel) for s in found if s.fit is not None}
    best = max((s.value for s in _search(given, base).screened if s.of not in refused), default=0.0)
    if not refused or best < needed:
        return []
    return best_candidates(given, base, bar=bar, against=needed, refused=refused)[0]


class _Search:
    """What was looked at and fitted beside one model. It is asked for more than once: under another bar, for what does better than an
    effect that was found, and for what does as well.
    """

    def __init__(self, given: Problem, base: Fit) -> None:
        self.base = base
        self._given = given
        self._offered = candidates(base.model, given.data, Leftover(given, base))
        self._first, self.tried = screen(given, base, self._offered)
        self._fits: dict[int, tuple[object, Fit]] = {}

    @property
    def screened(self) -> list[Screened]:
        """All, at first sight."""
        return self._first

    def fitted(
        self, few: int, least: float, known: Scored | None = None, refused: Collection[Name] = ()
    ) -> tuple[list[Screened], list[tuple[Screened, Fit]]]:
        """All as screened but those refused, and those fitted that screening makes promising. least: nats. known: one that is fitted
        already.
        """
        screened = [s for s in self._first if s.of not in refused]
        promising = [(s, self.base) for s in _promising(screened, few, least)]
        if self._given.floor.axes and promising:
            quiet, everything = self._quietly
            screened = [s for s in everything if s.of not in refused]
            promising = [*promising[:FIRST_LOOK], *((s, quiet) for s in _promising(screened, few, 0.0))]
        if self._given.bends:  # a first look is about where another model has the states
            promising = [(s, self._quietly[0]) for s in _promising(self._quietly[1], len(screened), -math.inf)]
        looked_at: list[tuple[Screened, Fit]] = []
        there = gain(known.fit, self.base) if known is not None and known.fit is not None else 0.0
        for s, under in promising:
            if known is not None and s.of == (known.name, known.channel):
                continue
            most = max(there, *(gain(fit, self.base) for _, fit in looked_at), 0.0)
            looked_at.append((s, self._refined(s, under, s.start, 2, lambda fit, most=most: self._hopeless(fit, most))))  # type: ignore[misc]
        return screened, looked_at

    def _hopeless(self, fit: Fit, most: float) -> bool:
        """Whether another round will bring a candidate neither near the best one, which has so many nats, nor to where it counts."""
        needed = STRICT.needed(self.tried, fit.k - self.base.k, len(self._given.steps))
        return not self._given.floor.axes and gain(fit, self.base) < ONWARD * max(most, needed)

    def settled(self, fit: Fit) -> Fit:
        """One of these, fitted on."""
        return self._refined(fit, fit, fit.model, SETTLES)

    @cached_property
    def _quietly(self) -> tuple[Fit, list[Screened]]:
        """The model under the noise that the best candidate leaves, and the candidates under that. Where a speed was not measured, nearly
        all that a model lacks can be taken for noise that pushes: under that, candidates look alike, and none looks like much.
        """
        fit = fitted(self._given, self.base, self._first[0].start, 2)
        quiet = under_noise(self._given, self.base.model, fit.noise) if fit.white > self.base.white else self.base
        return quiet, screen(self._given, quiet, self._offered)[0]

    def _refined(
        self, of: object, under: Fit, model: ComposedModel, rounds: int, hopeless: Callable[[Fit], bool] = lambda fit: False
    ) -> Fit:
        """Known by the identity of what it is of, which is kept with it: no other object takes its place."""
        if id(of) not in self._fits:
            self._fits[id(of)] = of, fitted(self._given, under, model, rounds, hopeless)
        return self._fits[id(of)][1]


def _search(given: Problem, base: Fit) -> _Search:
    """The one beside a model of the same effects that explains as much, if there was one; the last KEPT are known. What is fitted beside it
    has numbers and noise of its own: where these began makes no difference.
    """
    key = tuple((*name_of(a), isinstance(a, Added), _texts(a)) for a in base.model.effects)
    there = given.searches.pop(key, None)
    if not isinstance(there, _Search) or base.white > there.base.white + AS_MUCH:
        there = _Search(given, base)
    given.searches[key] = there
    while len(given.searches) > KEPT:
        given.searches.pop(next(iter(given.searches)))
    return there


def _texts(a: AppliedEffect) -> tuple[tuple[str, str], ...]:
    """Parameters that are no numbers: with another scheme, or from another input, it is another model."""
    return tuple(sorted((name, value) for name, value in a.p.items() if isinstance(value, str)))


def rescored(found: Sequence[Scored], base: Fit, n: int, bar: Bar) -> list[Scored]:
    """The same candidates under another bar. base: the model that they were fitted beside."""
    again = [s if s.fit is None else replace(s, score=gain(s.fit, base) - bar.price(s.fit.k - base.k, n)) for s in found]
    return sorted(again, key=lambda s: (s.fit is None, -s.score))


def _promising(screened: Sequence[Screened], few: int, least: float) -> list[Screened]:
    """The best of so many (effect, channel), each at its two best places in the list; least: nats, -inf for all of them."""
    kept: list[Screened] = []
    places: dict[tuple[str, str], int] = {}
    for s in screened:
        key = s.of
        hopeless = math.isfinite(least) and s.value <= max(HOPELESS, least, HOPELESS_SHARE * screened[0].value)
        if hopeless or (key not in places and len(places) == few):
            break
        places[key] = places.get(key, 0) + 1
        if places[key] <= PLACES:
            kept.append(s)
    return kept


def limited(fit: Fit) -> bool:
    """False if a number has run off to its bound: friction without limit says that nothing moves, not why; and a curve of several
    numbers, one of which it had to give up, is not that curve.
    """
    return not any(unlimited(fit, place) for place in fit.added)


def unlimited(fit: Fit, place: int) -> bool:
    """Whether that is so of the effect at this place."""
    ends = [bounds_of(fit.model, slot) for slot in fit.free]
    values = values_of(fit.model, fit.free).tolist()
    largest = max(
        (abs(v) for slot, v, p in zip(fit.free, values, ends, strict=True) if slot.place == place and p.neutral == 0.0), default=0.0
    )
    for slot, v, p in zip(fit.free, values, ends, strict=True):
        if slot.place != place:
            continue
        if (v >= 0.99 * p.high and p.high >= FAR) or (v <= 0.99 * p.low and p.low <= -FAR):
            return True
        if p.neutral is None and 0.0 < p.low <= 1.0 / FAR and v <= 2.0 * p.low:
            return True
        effect = fit.model.effects[slot.place].effect
        several = sum(other.place == slot.place for other in fit.free) > 1
        given_up = p.neutral is not None and p.neutral in (p.low, p.high) and abs(v - p.neutral) <= GIVEN_UP * largest
        if several and given_up and not getattr(effect, "additive", False):
            return True
    return False


def names(model: ComposedModel) -> tuple[tuple[str, str], ...]:
    """(effect, channel) of what was added, sorted."""
    return tuple(sorted(name_of(a) for a in model.effects if isinstance(a, Added)))


def name_of(a: AppliedEffect) -> tuple[str, str]:
    """(effect, channel)."""
    return a.effect.name, a.channel
