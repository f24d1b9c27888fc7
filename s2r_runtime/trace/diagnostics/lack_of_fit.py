"""What is left in the residual of the final model, named by what it depends on.

A group is a set of dictionaries of terms (see `basis`), all of which depend on the same thing. A dictionary is judged like a
rival model: its terms are added to the step,

    r = sum_j beta_j X_j + noise,        beta by ridge, its strength by the evidence (`evidence`); without the block of time that is judged

and its gain is the log likelihood of what is left, with noise and colour re-estimated for it, less that of the model without it. The
best group is named, then those that add to it. A group counts only if it is beyond chance, and if the rollouts' errors fall
with it: structure that nobody would notice is none. Beyond chance: its gain is, the scatter of its scores over blocks of time
allowed for; or its evidence is out of reach of the same residual slid along the recording. Where no group counts, or foretells nothing
elsewhere and explains less, what happens for a while only is looked for (`disturbances`). A residual that is only correlated in time, or
wanders, whatever the inputs do, is `noise`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.diagnostics.parameter_constancy import uneven
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.initial_states import begun, measured
from s2r_runtime.trace.estimation.noise import Colour, Noise, Whitener
from s2r_runtime.trace.estimation.prediction import Mask, acting, covered, rms, rollout, rollout_starts, some_of
from s2r_runtime.trace.estimation.problem import FLOORED, Fit, Problem
from s2r_runtime.trace.estimation.problem import gain as explained
from s2r_runtime.trace.hypotheses.basis import dictionaries
from s2r_runtime.trace.hypotheses.disturbances import episodes, may_depend_on
from s2r_runtime.trace.hypotheses.measured_forces import about_inputs
from s2r_runtime.trace.hypotheses.packet_loss import Lost, now_and_then
from s2r_runtime.trace.hypotheses.random_fields import Field, as_noise, field, nats_of
from s2r_runtime.trace.selection.basis_evidence import BLOCKS, SLOWLY, Judged, Left, first_look, judge, leading
from s2r_runtime.trace.selection.basis_pairs import pairs
from s2r_runtime.trace.selection.evidence import evidence, margin

Array = NDArray[np.float64]

STARTS = 1200
"""Rollouts at most."""

ALPHA = 1e-3
"""Chance that clean data show structure, as far as the likelihood is right."""

FEW = 6
"""Dictionaries that are judged with their own noise, after a first look under the model's."""

WEIGHED = 12
"""Dictionaries, the best at first look, of which the likeliest is told where there is structure."""

NOTHING = 1.0
"""Nats at first look up to which a dictionary says nothing, and is not judged any closer."""

ALIKE = 3.0
"""Nats within which dictionaries say the same: the smallest one is named."""

ADDS = 0.1
"""A further group is named if it adds this share of what is explained already."""

MATTERS = 0.05
"""Structure counts if taking it up lowers some rollout error by this share."""

SLIDING = ("constant", "time", "wave")
"""What slides along with the residual, so that sliding tells nothing."""

SLOW = 3.0
"""Times the usual nats for those that are slow: noise that wanders foretells the next second well, whatever its cause."""

SEEN = 1.25
"""Times the evidence under the noise of the model that the gain of what is slow counts at most: where a position wanders a little, terms
that follow it make the noise of the process look like none, and all that comes after is foretold by that.
"""

MUCH = 0.3
"""Of what is left in a step: a dictionary that foretells more of it is told beside a name, although no rollout shows it, as is one that
rollouts show and that may be what wanders by itself.
"""

DOUBLED = 2.0
"""As MATTERS, for what happens for a while: some rollout's error is so many times what it is without. Noise that wanders makes less."""

CLIPPED = 10.0
"""Standard deviations at which a wild value is cut off where it is not taken for an outlier."""

MORE = 1.1
"""Times what effects explain that a dictionary must explain, for them to be the wrong ones: with noise of its own, each is a little off."""

BEYOND = 8.0
"""Nats by which the evidence must exceed that of every slide."""

TOKENS = {"wave": "time"}
"""As which dictionaries are told that are none of a user's words."""

MOST_GROUPS = 3
"""Groups that are named at most."""

ROUNDED, SLACK = 0.99, 0.05
"""Share of a state's rows that must lie within half the step of its rounding, and how much more that may be: it is known from digits."""

NOISES, FARTHEST = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0), 4
"""Standard deviations of a sensor's noise before it rounds, over the step: noise that is larger leaves nothing of the rounding to see;
and how many steps away a reading may then be.
"""

WRONG = 100.0
"""Of so many readings one may be an outlier."""

VANISHING = 1e-24
"""Mean square of a term that is none."""

COLOURED = 0.2
"""Autoregression coefficient from which noise is called coloured."""


@dataclass(frozen=True)
class Structure:
    """tokens: docs/json.md's `depends_on`, most important first. matters: it shows in rollouts.

    share: part of all that the nominal model lacks which is still left (0 where there is nothing). gains: nats by group. nameless: what
    was named looks more like something that has no name (`unnamed_alternatives`). for_a_while: it comes and goes (`disturbances`). varies:
    it is a field (`random_fields`), or a number of what was named that varies (`parameter_constancy`). beside: what it may depend on
    besides, which no rollout shows. noise: what would be left beside the structure, and its colour; None where there is none that matters.
    nats: of what comes and goes, or varies.
    """

    tokens: tuple[str, ...]
    matters: bool
    share: float
    gains: dict[str, float]
    nameless: bool = False
    for_a_while: bool = False
    varies: bool = False
    beside: tuple[str, ...] = ()
    noise: tuple[Noise, Colour] | None = None
    nats: float = 0.0

    @property
    def likeliest(self) -> tuple[str, ...]:
        """The group that gains most, though not beyond doubt; nothing where chance would do as well."""
        best = max(self.gains, key=lambda token: self.gains[token], default="")
        return (_told(best),) if best and self.gains[best] > math.log(len(self.gains) / ALPHA) else ()


def lack_of_fit(looks: Looks, nominal: Fit, horizon: int) -> Structure:
    """Structure left by a model; how much of what `nominal` leaves that is."""
    left, found = looks.left, looks.found
    chosen, gains = looks.chosen
    varying = uneven(left)
    if varying is not None and left.given.data.measured_forces and about_inputs(left.fit.model, varying.judged.token):
        varying = None
    number = varying.judged if varying is not None and varying.sure else None
    coloured = ("noise",) if _coloured(left) else ()
    windows: Judged | None = None
    if chosen and chosen[-1].gain <= 0.0:  # it was seen by sliding only: that names what it tries
        windows = _for_a_while(left)
        others = [] if windows is None else [windows.gain]
        if left.fit.added and looks.field is not None and looks.field.beyond > 0.0:
            others.append(looks.field.nats)
        if others and max(others) > nats_of(left, chosen[-1].x):
            chosen = []
    lost, share = lost_commands(left, nominal, horizon)
    dropped: tuple[str, ...] = ()
    if lost is not None and lost.judged.gain > max((judged.gain for judged in chosen), default=0.0):
        if left.fit.added or not lost.sure:  # a delay is one, whatever comes later still now and then
            dropped = lost.tokens
        else:
            noise = _beside(left, lost.judged)
            return Structure(lost.tokens, True, share, gains, for_a_while=True, noise=noise, nats=lost.judged.gain)
    shows = False
    if chosen:
        shows, share = _weight_of(left, nominal, chosen[-1], horizon)
        if shows and not _wanders(left, chosen[-1], SLOW * math.log(len(looks.found) / ALPHA)):
            first = [] if number is None or number.gain <= chosen[-1].gain else [number]
            return Structure(as_told([*first, *chosen]), True, share, gains, noise=_beside(left, chosen[-1]))
    varied = looks.field
    told = [] if varied is None else [(varied.nats, varied.judged, varied.tokens, True)]
    if number is not None:
        gains[number.token] = max(gains.get(number.token, 0.0), number.gain)
        told.append((number.gain, number, (number.token,), False))
    for nats, judged, tokens, varies in sorted(told, key=lambda t: -t[0]):
        matters, share = _weight_of(left, nominal, judged, horizon)
        if matters and (not varies or varied is None or varied.beyond > 0.0):  # rollouts take less time than what it is beyond
            return Structure(tokens, True, share, gains, varies=varies, noise=_beside(left, judged), nats=nats)
    windows = None if chosen else windows or _for_a_while(left)
    matters, share = (False, 0.0) if windows is None else _weight_of(left, nominal, windows, horizon, DOUBLED)
    if windows is None or not matters:  # a number that may vary is told with the name, if no rollout shows it
        seen = as_told(chosen) if chosen and left.fit.added and (shows or _share_of(left, chosen[-1]) > MUCH) else ()
        also = () if varying is None else (varying.judged.token,)
        return Structure(coloured, False, 0.0, gains, beside=tuple(dict.fromkeys((*dropped, *also, *seen))))
    tokens = tuple(dict.fromkeys(map(_told, may_depend_on(left, windows, found))))
    return Structure(tokens, True, share, gains, for_a_while=True, noise=_beside(left, windows), nats=windows.gain)


def lost_commands(left: Left, nominal: Fit, horizon: int) -> tuple[Lost | None, float]:
    """Commands that are lost, if some rollout shows it, and what share of all that the nominal model lacks that is."""
    lost = now_and_then(left)
    matters, share = (False, 0.0) if lost is None else _weight_of(left, nominal, lost.judged, horizon)
    return (lost, share) if matters else (None, 0.0)


def _told(token: str) -> str:
    return TOKENS.get(token, token)


def still_left(left: Left, tokens: tuple[str, ...], nominal: Fit, horizon: int) -> bool:
    """Whether dictionaries of these tokens show structure that matters: where another model left it, little time tells that this one does.
    False says nothing.
    """
    looks = Looks(left, tokens)
    chosen = looks.chosen[0] if looks.looked else []
    sure = chosen and chosen[-1].gain > SLOW * math.log(len(looks.found) / ALPHA)
    return bool(sure) and _weight_of(left, nominal, chosen[-1], horizon)[0]


def _coloured(left: Left) -> bool:
    """Whether noise clearly has a colour: it remembers, or wanders. Not where it is steadier than white noise; nor where the process has no
    more than its least noise, and neighbours pull apart: of a sensor more precise than any model is meant to be.
    """
    colour, noise = left.fit.colour, left.fit.noise
    there = (noise.q > FLOORED * left.given.floor.q) | (colour.coefficients.sum(axis=1) >= 0.0)
    wanders = left.law is not None and np.any(left.law.slow.sum(axis=1)[there] > 0.0)
    return bool(wanders or np.any(colour.strength[there] > COLOURED))


def _for_a_while(left: Left) -> Judged | None:
    """What happens for a while and in no other block of time, if rows are in order."""
    return episodes(left) if left.given.data.in_order else None


def _wanders(left: Left, judged: Judged, enough: float) -> bool:
    """Whether what foretells fewer than `enough` nats elsewhere (none, if only sliding shows it) is rather a push that wanders: in a short
    drive places and headings are as slow as time is, and slides know nothing of what wanders. Not what sliding shows by far of wild values
    without the colour of the noise, for which what wanders has no use: commands that are lost now and then.
    """
    if judged.gain > enough or left.given.floor.axes or not as_noise(left, judged):
        return False
    if judged.token in SLIDING or left.clipped is None:
        return True
    joined, white = left.given.steps.joined, left.fit.whiten(judged.x)
    laws = [left.fit.colour, *([] if left.law is None else [left.law])]
    equal = np.ones_like(left.clipped)
    return any(margin(law(white, joined), law(left.clipped, joined), equal, BEYOND) <= SLOW * BEYOND for law in laws)


def _beside(left: Left, judged: Judged) -> tuple[Noise, Colour]:
    """Noise and colour of what is left beside a dictionary."""
    joined = left.given.steps.joined
    rest = left.r - np.einsum("kim,km->ki", judged.x, judged.betas[left.block])
    level = noises.estimate(rest, left.f, joined, left.given.floor, left.fit.noise)
    return level, noises.colour(Whitener(level, left.f, joined)(rest), joined)


@dataclass(frozen=True)
class Looks:
    """A first look at what dictionaries say of what a model leaves. only: of these tokens; of all, if None."""

    left: Left
    only: tuple[str, ...] | None = None

    @cached_property
    def found(self) -> list[tuple[str, Array]]:
        """The dictionaries."""
        return dictionaries_of(self.left)

    @cached_property
    def looked(self) -> list[tuple[float, int]]:
        """(nats, place in `found`), the best first."""
        asked = [i for i, (token, _) in enumerate(self.found) if self.only is None or _told(token) in self.only]
        return sorted(((first_look(self.left, self.found[i][1]), i) for i in asked), reverse=True)

    @property
    def most(self) -> float:
        """Nats of the best one at first look."""
        return self.looked[0][0] if self.looked else 0.0

    @cached_property
    def chosen(self) -> tuple[list[Judged], dict[str, float]]:
        """Groups that explain it, the last one with the columns of all, and nats by group."""
        return _forward(self) if self.found else ([], {})

    @cached_property
    def field(self) -> Field | None:
        """The smooth random field that explains most of what is left; none is looked for where a speed was not measured."""
        return None if self.left.given.floor.axes else field(self.left)

    @cached_property
    def weighed(self) -> dict[str, float]:
        """Nats of WEIGHED dictionaries by what they depend on, on a field's scale, the most first. What holds in all blocks of time gains
        most where one is foretold from the others (`judged`): of what depends on a place that was visited once, that says little.
        """
        nats: dict[str, float] = {}
        for first, i in self.looked[:WEIGHED]:
            if first > NOTHING:
                token, x = self.found[i]
                token = _told(token)
                nats[token] = max(nats.get(token, -math.inf), nats_of(self.left, leading(self.left, x)))
        return dict(sorted(nats.items(), key=lambda pair: -pair[1]))

    @cached_property
    def judged(self) -> list[Judged]:
        """The FEW best of them with their own noise; the best one only, where none says anything."""
        looked = _best_of_each(self.looked, self.found)[:FEW]
        kept = [i for nats, i in looked if nats > NOTHING] or [i for _, i in looked[:1]]
        return [judge(self.left, self.found[i][0], leading(self.left, self.found[i][1])) for i in kept]


def as_told(chosen: Sequence[Judged]) -> tuple[str, ...]:
    """Their tokens, as they are told."""
    return tuple(dict.fromkeys(_told(judged.token) for judged in chosen))


def best_unnamed(looks: Looks) -> Judged:
    """The dictionary that explains most without any effect's name, under the token that is told."""
    most = max(j.gain for j in looks.judged)
    best = min((j for j in looks.judged if j.gain >= most - ALIKE), key=lambda j: (j.x.shape[2], -j.gain))
    return replace(best, token=_told(best.token), gain=most)


def explains_more(looks: Looks, unnamed: Judged, fit: Fit, horizon: int, *, left: bool) -> bool:
    """Whether a dictionary beats the effects of `fit` clearly, in likelihood and in rollouts: these took up structure that is not theirs.
    left: whether they leave some that matters. What effects change is judged as a dictionary of one term is.
    """
    given, nominal = looks.left.given, looks.left.fit
    changed = looks.left.r - given.residual(fit.model)
    x = _columns([changed], np.ones(changed.shape[1]))
    mine = max(explained(fit, nominal), judge(looks.left, "", x).gain if x.shape[2] else 0.0)
    if unnamed.gain <= MORE * mine + ALIKE * (1.0 if left else 3.0):
        return False
    return any(  # by a share of what the nominal model lacks: less is how steps are cut
        np.any(named**2 - after**2 > MATTERS * np.maximum(bare**2 - after**2, named**2))
        for named, bare, after in _rollouts(looks.left, fit, unnamed, horizon)
    )


def left_of(given: Problem, fit: Fit) -> Left:
    """What a model leaves."""
    n = len(given.steps)
    block = np.minimum(np.arange(n) * BLOCKS // n, BLOCKS - 1)
    wild = np.any(np.abs(fit.z) > noises.OUTLIER)
    return Left(given, fit, given.residual(fit.model), given.jacobian(fit.model), block, _clipped(fit.z) if wild else None)


def dictionaries_of(left: Left) -> list[tuple[str, Array]]:
    """Those for what a model leaves; terms that vanish are dropped."""
    given, fit = left.given, left.fit
    spread = np.ones(left.r.shape[1]) if given.floor.axes else fit.noise.one_step(left.f)
    offered = dictionaries(given, fit.model, acting(fit.model, given.data), fit.noise, left.r)
    if given.data.measured_forces:  # what is left is the noise of the inputs
        offered = ((token, terms) for token, terms in offered if not about_inputs(fit.model, token))
    return [(token, x) for token, terms in offered if (x := _columns(terms, spread)).shape[2]]


def _clipped(z: Array) -> Array:
    """Cut off at CLIPPED, on a scale of at least 1."""
    cut = np.clip(z, -CLIPPED, CLIPPED)
    return np.asarray(cut / np.maximum(np.sqrt(np.mean(cut**2, axis=0)), 1.0))


def _columns(terms: Sequence[Array], spread: Array) -> Array:
    """Terms (n, nx) side by side, (n, nx, m), each as large as the noise (nx,) of the states that it pushes; those that vanish are dropped.
    A ridge is the same for all: on any other scale it lets nothing push a state that is noisier than others.
    """
    table = np.array(terms)  # a column after the other in memory: whitening and products run along columns
    size = np.einsum("mki,mki->mi", table, table) / table[0].size
    there = np.sum(size, axis=1) > VANISHING
    if not np.all(there):
        table, size = table[there], size[there]
    table /= np.sqrt(size @ spread**-2.0)[:, None, None]
    return np.asarray(table.transpose(1, 2, 0))


def _forward(looks: Looks) -> tuple[list[Judged], dict[str, float]]:
    """The best group, or the best two together, then those that add to it; the last one holds the columns of all."""
    left, judged = looks.left, looks.judged
    threshold = math.log(len(looks.found) / ALPHA)
    gains = {token: 0.0 for token, _ in looks.found}
    for j in judged:
        gains[j.token] = max(gains[j.token], j.gain)
    strengths = [_strength(left, j, threshold) for j in judged]
    strongest = max(strength for strength, _ in strengths)
    chosen: list[Judged] = []
    if strongest > 0.0:
        first = min((j for s, j in strengths if s >= strongest - ALIKE), key=lambda j: (j.x.shape[2], -j.gain))
        chosen = _onward(left, [first], _others(judged, gains, threshold, {first.token}), threshold)
    for both in pairs(left, looks.looked, looks.found, 2.0 * threshold, ADDS):
        needed = 2.0 * threshold * both[1].scatter * (SLOW if {j.token for j in both} & {*SLOWLY} else 1.0)
        if both[1].gain > max(needed, strongest, chosen[-1].gain + ALIKE if chosen else 0.0):
            chosen = _onward(left, both, _others(judged, gains, threshold, {j.token for j in both}), threshold)
    return chosen, gains


def _others(judged: Sequence[Judged], gains: dict[str, float], threshold: float, named: set[str]) -> list[Judged]:
    """Dictionaries of groups that say something by themselves, and are not named yet."""
    return [j for j in judged if gains[j.token] > threshold and j.token not in named]


def _onward(left: Left, chosen: list[Judged], rest: list[Judged], threshold: float) -> list[Judged]:
    """With the groups that add to those chosen, the best first."""
    while rest and len(chosen) < MOST_GROUPS:
        before = chosen[-1]
        judged = [judge(left, j.token, np.concatenate([before.x, j.x], axis=2)) for j in rest]
        best = max(judged, key=lambda j: j.gain)
        if best.gain - before.gain < max(threshold * best.scatter, ADDS * before.gain):
            break
        chosen = [*chosen, best]
        rest = [j for j in rest if j.token != best.token]
    return chosen


def _strength(left: Left, j: Judged, threshold: float) -> tuple[float, Judged]:
    """Nats by which a dictionary is beyond chance, of whichever test shows it most clearly; 0 if none does. Where it is only sliding that
    shows it, with its betas on all rows: what happens once, or in one place, is not foretold from elsewhere.
    """
    slow = j.token in SLOWLY
    needed = threshold * j.scatter * (SLOW if slow else 1.0)
    gained = min(j.gain, SEEN * first_look(left, j.x)) if slow else j.gain
    foretold = j.gain if gained > needed else 0.0
    if j.token in SLIDING:
        return foretold, j
    white, z = left.fit.whiten(j.x), left.fit.z
    ways = [(z, noises.weight(z))]
    if left.clipped is not None:
        ways.append((left.clipped, np.ones_like(left.clipped)))
    beyond = [margin(white, z, weight, threshold) for z, weight in ways]
    if left.law is not None and max(beyond) > BEYOND:  # in closed loop, inputs answer what wanders: that tie, slides would break
        joined = left.given.steps.joined
        under = [margin(left.law(white, joined), left.law(z, joined), weight, threshold) for z, weight in ways]
        beyond = [min(pair) for pair in zip(beyond, under, strict=True)]
    best = int(np.argmax(beyond))
    if beyond[best] <= max(BEYOND, foretold):
        return foretold, j
    if foretold:
        return beyond[best], j
    weight = ways[best][1]
    x, push = white.reshape(-1, white.shape[2]), np.clip(left.fit.z, -CLIPPED, CLIPPED).ravel()
    weighted = x * weight.reshape(-1, 1)
    product, slope = x.T @ weighted, weighted.T @ push
    beta = evidence(product, slope).beta(slope)
    return beyond[best], replace(j, betas=np.tile(beta, (BLOCKS, 1)))


def _best_of_each(looked: list[tuple[float, int]], found: Sequence[tuple[str, Array]]) -> list[tuple[float, int]]:
    """The two best dictionaries of the first group, and the best one of each other group: many of one would leave no place for others."""
    seen: list[str] = []
    kept = []
    for look, i in looked:
        token = found[i][0]
        if token not in seen or (token == seen[0] and seen.count(token) < 2):
            kept.append((look, i))
        seen.append(token)
    return kept


def _weight_of(left: Left, nominal: Fit, judged: Judged, horizon: int, least: float = 1.0 + MATTERS) -> tuple[bool, float]:
    """Whether the structure shows in rollouts, errors being so many times larger without it, and what share of all that the nominal model
    lacks it is.
    """
    matters, worst, share = False, 1.0 + MATTERS, 0.0
    told = ~_to_their_rounding(left, judged)
    for before, now, after in _rollouts(left, nominal, judged, horizon):
        for b, n, a in zip(before[told], now[told], after[told], strict=True):
            matters = matters or bool(n > least * a)
            if a > 0.0 and max(b, n) > worst * a:
                worst, share = max(b, n) / a, max(n * n - a * a, 0.0) / max(b * b - a * a, n * n - a * a)
    return matters, share


def _share_of(left: Left, judged: Judged) -> float:
    """Of what is left in a step of some state, noise included, the share (of squares) that a dictionary foretells elsewhere in time."""
    if judged.gain <= 0.0:
        return 0.0
    rest = left.r - np.einsum("kim,km->ki", judged.x, judged.betas[left.block])
    return float(np.max(1.0 - np.sum(rest**2, axis=0) / np.maximum(np.sum(left.r**2, axis=0), 1e-300)))


def _to_their_rounding(left: Left, judged: Judged) -> Mask:
    """(nx,) whether a state that an input sets is foretold to half the step in which it is rounded, or as well by its rounding as by a
    structure: what is left goes with the input, as the digits that rounding cuts off do. Of others the next value depends on the last
    one's rounding, too.
    """
    model, steps = left.fit.model, left.given.steps
    found = np.zeros(left.r.shape[1], dtype=bool)
    for j in [model.states.index(state) for state in getattr(model.nominal, "reached", {}) if state in model.states]:
        step = noises.quantum(steps.y0[:, j], steps.y1[:, j])
        if step > 0.0:
            r = left.r[:, j]
            rest = r - np.einsum("km,km->k", judged.x[:, j], judged.betas[left.block])
            within = float(np.quantile(np.abs(r), ROUNDED)) <= 0.5 * step * (1.0 + SLACK)
            found[j] = within or float(rms(beyond_rounding(r, step))) <= (1.0 + MATTERS) * float(rms(rest))
    return found


def beyond_rounding(r: Array, step: float) -> Array:
    """r (n,), by which readings are off a state x that is known, less what a sensor is expected to be off by that rounds after some noise:

    P(reading k) = Phi((k + step/2 - x) / s) - Phi((k - step/2 - x) / s),    s: of NOISES, the likeliest; one in WRONG is anything
    """
    from scipy.special import ndtr

    if not np.any(r):
        return r
    anything = step / WRONG / (2.0 * float(np.max(np.abs(r))) + step)

    def cell(off: Array, s: float) -> Array:
        return np.asarray(ndtr((off + 0.5 * step) / s) - ndtr((off - 0.5 * step) / s))

    s = step * max(NOISES, key=lambda share: float(np.sum(np.log((1.0 - 1.0 / WRONG) * cell(r, step * share) + anything))))
    near = r - step * np.rint(r / step)  # of the reading nearest to the state
    around = near[:, None] + step * np.arange(-FARTHEST, FARTHEST + 1)
    return np.asarray(r - np.sum(around * cell(around, s), axis=1))


def _rollouts(left: Left, other: Fit, judged: Judged, horizon: int) -> Iterator[tuple[Array, Array, Array]]:
    """(nx,) rms at the end of rollouts of some lengths: of another model, of the one that leaves this, and of that with the structure."""
    data, steps, model = left.given.data, left.given.steps, left.fit.model
    act, act_other = acting(model, data), acting(other.model, data)
    last, there = covered(steps, len(act.mean))
    more = np.einsum("kim,km->ki", judged.x, judged.betas[left.block])
    extra = more[last]
    begins = _begins(left, other, more)
    for ahead in sorted({1, max(1, horizon // 4), horizon}):
        starts = some_of(rollout_starts(data, ahead, within=there), ahead, STARTS)
        if len(starts) < 10:
            continue
        yield (
            rms(measured(data, rollout(other.model, data, act_other, starts, ahead, begun=begins[0]).error)),
            rms(measured(data, rollout(model, data, act, starts, ahead, begun=begins[1]).error)),
            rms(measured(data, rollout(model, data, act, starts, ahead, extra, begins[2]).error)),
        )


def _begins(left: Left, other: Fit, more: Array) -> tuple[Array | None, Array | None, Array | None]:
    """Where rollouts begin: of another model, of the one that leaves this, and of that with the structure, each under its own noise."""
    given, fit = left.given, left.fit
    if not given.floor.axes:
        return None, None, None
    level = noises.estimate(left.r - more, left.f, given.steps.joined, given.floor, fit.noise)
    whiten = Whitener(level, left.f, given.steps.joined)
    better = replace(fit, noise=level, whiten=whiten, z=whiten(left.r - more))
    return begun(given, other), begun(given, fit), begun(given, better)
