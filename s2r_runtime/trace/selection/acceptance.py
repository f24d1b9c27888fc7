"""Is an effect called for beyond chance?

gain          of a model over the one without the effect, the smaller of white and coloured (`scores`): "just more noise" and
              "coloured noise" are rivals
significant   gain > log(tried / alpha) + price                   (everything tried is paid for; `scores.Bar`)
relevant      rollouts get better, too                            (`relevance`)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.noise import Colour
from s2r_runtime.trace.estimation.parameters import bounds_of, values_of
from s2r_runtime.trace.estimation.problem import SCORE_BLOCKS, WIDEST, Fit, Problem, gain, objective, refine, scatter, sought
from s2r_runtime.trace.selection.change_points import happens
from s2r_runtime.trace.selection.relevance import relevant
from s2r_runtime.trace.selection.scores import STRICT, Bar, limited, name_of, names

Array = NDArray[np.float64]

WITHIN = 0.4
"""Of a step: what stamps off the grid can look like."""

SAME = 1e-3
"""Of the step in which a sensor reads: what moves all values by the same to so much is an offset."""

SOME = 4
"""Rounds of parameters under another law of noise."""

BY_CHANCE = 0.05
"""Chance that scores scatter less between blocks of time than their lower bound says."""


def accepted(given: Problem, fit: Fit, base: Fit, tried: int, horizon: int, bar: Bar = STRICT, ahead: float = 0.0) -> bool:
    """Significant and relevant. ahead: nats by which it foretells better what was not fitted."""
    return (
        limited(fit)
        and significant(given, fit, base, tried, bar, ahead)
        and _told_by_stamps(given, fit, base)
        and _beyond_rounding(given, fit, base)
        and happens(given, fit)
        and relevant(given, fit, base, horizon, bar)
    )


def _told_by_stamps(given: Problem, fit: Fit, base: Fit) -> bool:
    """False for a time within a step where rows do not lie on the step, or inputs moved on between them: stamps, averages and reality
    differ by that much. Of a robot that slides sideways that is not so: its position and heading are of one moment, whenever that was.
    """
    data = given.data
    if not (data.uneven or data.way or data.unplaced):
        return True
    there = names(base.model)
    values = values_of(fit.model, fit.free)
    new = [
        (bounds_of(fit.model, slot), value)
        for slot, value in zip(fit.free, values.tolist(), strict=True)
        if name_of(fit.model.effects[slot.place]) not in there and fit.model.effects[slot.place].effect.stage == "input"
    ]
    return all(p.unit != "s" or p.neutral != 0.0 or abs(value) > WITHIN * data.dt for p, value in new)


def _beyond_rounding(given: Problem, fit: Fit, base: Fit) -> bool:
    """False for an offset of a sensor that its rounding may be. In steps of q one value is off by up to q / 2, always by the same; n values
    alike often by q / sqrt(12 n) on average, and hardly ever by q / sqrt(n). What moves some values more than others is no offset.
    """
    there = names(base.model)
    for a in (fit.model.effects[place] for place in fit.added):
        if a.effect.stage != "sensor" or a.channel not in fit.model.states or name_of(a) in there:
            continue
        j = fit.model.states.index(a.channel)
        q = noises.quantum(given.steps.y0[:, j], given.steps.y1[:, j])
        if q > 0.0:
            share = np.unique(np.rint(given.steps.y0[:, j] / q), return_counts=True)[1] / len(given.steps)
            off = (a.effect.to_measured(given.steps.y0, fit.model.nominal, a.channel, a.p) - given.steps.y0)[:, j]
            if np.ptp(off) < SAME * q and abs(off[0]) < q * min(0.5, float(np.sqrt(np.sum(share**2)))):
                return False
    return True


def significant(given: Problem, fit: Fit, base: Fit, tried: int, bar: Bar = STRICT, ahead: float = 0.0) -> bool:
    """Beyond chance, everything tried paid for, and not by one step alone: that may be the error of a stamp. The gain shrunk by how
    much more than white noise the scores of blocks scatter.
    """
    needed = bar.needed(tried, fit.k - base.k, len(given.steps))
    reached = gain(fit, base) + ahead
    each = noises.log_density(fit.z).sum(axis=1) - noises.log_density(base.z).sum(axis=1)
    if reached - max(float(np.max(each, initial=0.0)), 0.0) <= needed:
        return False
    if reached <= needed:
        return False
    law, bare = (noises.wandering(f.z, given.steps.joined, f.colour) for f in (fit, base))
    if not _beyond_wandering(given, fit, base, law, bare, needed - ahead):
        return False
    if reached > WIDEST**2 * needed or not fit.free:
        return True
    there = names(base.model)
    new = [i for i, slot in enumerate(fit.free) if name_of(fit.model.effects[slot.place]) not in there]
    wanders = law is not None or bare is not None or any(sought(fit.model, fit.free[i]) for i in new)
    return reached > needed * _scattered(scatter(given, fit)[new], wanders)


def _scattered(ratios: Array, wanders: bool) -> float:
    """Times that scores of blocks scatter more than white noise, a ratio of variances, of the number that does most so: its lower bound
    (chi-squared, a degree of freedom a block, BY_CHANCE shared by all numbers). wanders: noise does so by another test, too, or an effect
    was found somewhere in time or among frequencies (`sought`), where noise does most: then all of it, once it is beyond chance.
    ratios: (k,) of standard deviations.
    """
    from scipy.special import gammaincinv

    most = float(np.max(ratios, initial=1.0)) ** 2
    by_chance = 2.0 * float(gammaincinv(0.5 * SCORE_BLOCKS, 1.0 - BY_CHANCE / max(len(ratios), 1))) / SCORE_BLOCKS
    return 1.0 if most <= by_chance else most if wanders else most / by_chance


def _beyond_wandering(given: Problem, fit: Fit, base: Fit, law: Colour | None, bare: Colour | None, needed: float) -> bool:
    """Whether an effect gains as much where what is left with it wanders: under the law of that, and with that law estimated without the
    effect, too. In closed loop inputs answer what wanders, a moment later: an effect on them then takes up a part of it. Under that law,
    estimates are those of the prediction error (L. Ljung, System identification, 1999, ch. 13: in closed loop right if the noise's law is).
    law, bare: what wanders with the effect, and without it (`residual_noise.wandering`).
    """
    joined = given.steps.joined
    if law is None and bare is not None:  # an effect explains more than the law of all that is left without it
        with_it, without = (noises.log_likelihood(f.z, f.whiten, c, joined) for f, c in ((fit, fit.colour), (base, bare)))
        return with_it - without > needed
    if law is None:
        return True
    if bare is not None:
        both = (noises.log_likelihood(f.z, f.whiten, c, joined) for f, c in ((fit, law), (base, bare)))
        if next(both) - next(both) <= needed:
            return False
    under = replace(fit, colour=law)
    reached = [
        float(np.sum(noises.log_density(objective(given, under, refine(given, under, m, iterations=SOME)))))
        for m in (fit.model, base.model)
    ]
    return reached[0] - reached[1] > needed
