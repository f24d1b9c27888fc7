"""Hypotheses that suggested inputs must separate, each fitted to the recording.

The competing explanations of an ambiguous result; else the reported effects and the closest alternatives; else every effect of the library,
at a small start value of the search, against the others and against no effect.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.data.split import part
from s2r_runtime.trace.diagnostics.rollout_error import Held
from s2r_runtime.trace.estimation.parameters import Added, bounds_of, free_of, slots_of, values_of
from s2r_runtime.trace.estimation.prediction import first_steps
from s2r_runtime.trace.estimation.problem import Fit, Problem, evaluate, fitted, gain, insert, problem, without
from s2r_runtime.trace.hypotheses.library import candidates
from s2r_runtime.trace.reporting.found import Found
from s2r_runtime.trace.selection.scores import best_candidates, name_of

if TYPE_CHECKING:
    from s2r_runtime.trace.reporting.result import TraceResult

STEPS = 4000
"""Maximum number of transitions that hypotheses are fitted on."""

SMALL = 3
"""Of the start values of the search, sorted by size, the one at a third: smaller ones matter little, larger ones are obvious."""

CLOSEST, LOOKED_AT = 3, 8
"""Number of closest alternatives that are used, and that are fitted."""


@dataclass(frozen=True)
class Hypotheses:
    """fits: the models, the selected one first; names: for the text; instead: of each, what it replaces in the selected one. every: whether
    all pairs must be separated (any may be true), or only the others from the selected one.
    """

    fits: tuple[Fit, ...]
    names: tuple[str, ...]
    instead: tuple[str, ...]
    every: bool

    def named(self, i: int, j: int) -> tuple[str, str]:
        """Names of a pair, i < j."""
        return self.instead[j] if i == 0 else self.names[i], self.names[j]


def ground(held: Held) -> Problem:
    """All transitions of the recording, thinned."""
    everything = np.ones(first_steps(held.data)[-1], dtype=bool)
    few = part(held.data, held.left_out, everything, STEPS)
    return problem(few.data, few.steps)


def competing_hypotheses(r: TraceResult, given: Problem) -> Hypotheses | None:
    """Competing or closest explanations; None if the result has neither (then `library`)."""
    best = evaluate(given, r.model)
    if r.rivals:
        found = [(_said(f.name, f.channel), _with(given, best, f)) for f in r.rivals]
        others = [(name, fit) for name, fit in found if fit is not None]
    elif r.effects and not r.blind:
        same = {(f.name, f.channel) for f in (*r.effects, *r.ambiguous_with)}
        others = [(name, fit) for name, key, fit in _closest(given, best) if key not in same][:CLOSEST]
    else:
        return None
    if not others:
        return None
    fits = (best, *(fit for _, fit in others))
    lost = [_effects(best) - _effects(fit) for fit in fits]
    instead = tuple(" and ".join(_said(*key) for key in sorted(keys)) for keys in lost)
    return Hypotheses(fits, ("", *(name for name, _ in others)), instead, every=bool(r.rivals))


def _effects(fit: Fit) -> set[tuple[str, str]]:
    return {name_of(fit.model.effects[i]) for i in fit.added}


def library(base: Fit, rich: Dataset) -> Hypotheses:
    """One model for each effect on each channel, at a small start value of the search on a rich excitation."""
    found: dict[tuple[str, str], ComposedModel] = {}
    for candidate in candidates(base.model, rich):
        key = candidate.name, candidate.channel
        models = candidate.models(base.model)
        if key not in found and models:
            place = candidate.place if candidate.replaced < 0 else candidate.replaced
            sized = sorted((_size(m, place), i) for i, m in enumerate(models))
            found[key] = models[sized[len(sized) // SMALL if sized[-1][0] > 0.0 else -1][1]]
    fits = [replace(base, model=m, free=free_of(m)) for m in found.values()]
    names = ("no effect", *(_said(*key) for key in found))
    return Hypotheses((base, *fits), names, ("no effect",) * len(names), every=True)


def _size(model: ComposedModel, place: int) -> float:
    slots = tuple(slots_of(model.effects[place], place))
    neutral = np.array([bounds_of(model, s).neutral or 0.0 for s in slots])
    return float(np.max(np.abs(values_of(model, slots) - neutral), initial=0.0))


def _with(given: Problem, best: Fit, found: Found) -> Fit | None:
    """Selected model with one effect replaced by another, in the place with the highest likelihood."""
    effect = registry().get("effects", found.name)
    added = Added(effect, found.channel, found.values)
    models = [insert(without(best.model, place), added, at) for place in best.added for at in sorted({place, len(best.model.effects) - 1})]
    fits = [evaluate(given, model, best.noise) for model in models]
    fits.sort(key=lambda fit: -fit.white)
    return fitted(given, fits[0], fits[0].model, 1) if fits else None


def _closest(given: Problem, best: Fit) -> Iterator[tuple[str, tuple[str, str], Fit]]:
    """Fitted models with another effect instead of a reported one, the closest first."""
    found = []
    for place in best.added:
        base = fitted(given, best, without(best.model, place), 1)
        found += [(gain(s.fit, best), s.name, s.channel, s.fit) for s in best_candidates(given, base, LOOKED_AT)[0] if s.fit is not None]
    for _, name, channel, fit in sorted(found, key=lambda f: -f[0]):
        yield _said(name, channel), (name, channel), fit


def _said(name: str, channel: str) -> str:
    return f"{name} on {channel}"
