"""All of a recording under a model: what is left in it, and whether something without a name explains that better than what was named."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.split import part
from s2r_runtime.trace.diagnostics.block_influence import in_one_stretch
from s2r_runtime.trace.diagnostics.lack_of_fit import (
    ALIKE,
    MORE,
    Looks,
    Structure,
    as_told,
    best_unnamed,
    explains_more,
    lack_of_fit,
    left_of,
    lost_commands,
    still_left,
)
from s2r_runtime.trace.estimation.prediction import first_steps
from s2r_runtime.trace.estimation.problem import Fit, evaluate, fitted, gain, problem
from s2r_runtime.trace.hypotheses.dependence import about_states
from s2r_runtime.trace.hypotheses.packet_loss import Lost, nats_of_lost
from s2r_runtime.trace.hypotheses.random_fields import Field, beats, nats_of, nats_of_fit, wanders
from s2r_runtime.trace.selection.basis_evidence import Judged, Left
from s2r_runtime.trace.selection.input_confounding import opposed
from s2r_runtime.trace.selection.several_or_one import patchwork
from s2r_runtime.trace.selection.stepwise import Selection, crowded
from s2r_runtime.trace.selection.unnamed_alternatives import MORE as SHAPED
from s2r_runtime.trace.selection.unnamed_alternatives import Better, best_shape, better_shape
from s2r_runtime.trace.sensor_faults.detect import Checked

STRUCTURE_STEPS = 4000
"""Transitions that the lack of fit is tested on at most."""

CLEAR = 10.0
"""Nats from which on a dictionary tells what structure depends on."""

NEARLY = 0.4
"""Of what effects explain: dictionaries that give less at first look are not judged."""

LITTLE = 0.05
"""Of what effects explain: where no dictionary explains that much at first look of what they leave, none explains more than they do. Among
110 recordings with effects inside and outside the library, what they left had 0.4 of it or more wherever one did. Where speeds were not
measured, little looks like much at first look, and all are asked.
"""

SHORT = 1.05
"""Times what effects explain that the best dictionary must explain, and CLEAR more, for them to leave some of it: with noise of its own,
each is a little off.
"""

TWICE = 2.0
"""Times what the best dictionary explains that several together must explain to be told in its place: it does not do most of it."""

QUIET = 2.0
"""Nats of the best dictionary at first look below which no shape is asked about: it must explain as much as an effect to count. Of 51 made
recordings in which one did, the best dictionary had 4.8 or more.
"""

HALF = 0.5
"""Of what is told: a dictionary that foretells other blocks of time best, and is as likely as that, is told, too."""

SOMEWHAT = 0.2
"""The same where one dictionary is held against several names: at first look it sees little beside all that it is not about."""


class Whole:
    """All of a recording, and what the nominal model leaves of it: a test for structure needs no data that the fit never saw."""

    def __init__(self, checked: Checked, nominal: ComposedModel, horizon: int) -> None:
        everything = part(checked.data, checked.left_out, np.ones(first_steps(checked.data)[-1], dtype=bool), STRUCTURE_STEPS)
        self.given = problem(everything.data, everything.steps)
        self.nominal = evaluate(self.given, nominal)
        self._horizon = horizon
        self._known: dict[int, tuple[Fit, Structure]] = {}
        self._fitted: dict[int, tuple[Fit, Fit]] = {}

    @cached_property
    def _looks(self) -> Looks:
        return Looks(left_of(self.given, self.nominal))

    @cached_property
    def unnamed(self) -> Judged:
        """`best_unnamed`, for whatever was selected."""
        return best_unnamed(self._looks)

    def _unnamed_explains_more(self, fit: Fit, left: bool) -> bool:
        """What at first look comes nowhere near it will not come up to it."""
        if self._looks.most < NEARLY * gain(fit, self.nominal):
            return False
        return explains_more(self._looks, self.unnamed, fit, self._horizon, left=left)

    def structure(self, chosen: Selection) -> Structure:
        """What the chosen model leaves. It is asked again of a pair that a selection went on from and added nothing to."""
        fit = chosen.fit
        if id(fit) not in self._known:
            self._known[id(fit)] = fit, self._structure(fit)
        return self._known[id(fit)][1]

    def still(self, other: Selection, structure: Structure) -> bool:
        """Whether another selection clearly leaves what was told as structure before."""
        fit = self.everywhere(other.fit)
        return still_left(left_of(self.given, fit), structure.tokens, self.nominal, self._horizon)

    def falls_short(self, other: Selection) -> bool:
        """Whether another selection explains clearly less than the best that has no name: then it leaves what that explains beyond it."""
        told = max(gain(self.everywhere(other.fit), self.nominal), 0.0)
        return self._looks.most > told and self.unnamed.gain > SHORT * told + CLEAR

    def in_one_stretch(self, chosen: Selection) -> bool:
        """Whether a name comes from one stretch of the recording."""
        return in_one_stretch(self.given, self.everywhere(chosen.fit))

    def everywhere(self, fit: Fit) -> Fit:
        """Fitted to all of the recording: numbers of a part are a little off elsewhere, and that is no structure."""
        if id(fit) not in self._fitted:
            here = evaluate(self.given, fit.model)
            self._fitted[id(fit)] = fit, fitted(self.given, here, here.model, 2)
        return self._fitted[id(fit)][1]

    def _structure(self, chosen: Fit) -> Structure:
        if not chosen.added:
            return self._of_nominal()
        fit = self.everywhere(chosen)
        looks = Looks(left_of(self.given, fit))
        found = lack_of_fit(looks, self.nominal, self._horizon)
        if crowded(fit) or self._patchwork(fit):
            return replace(found, tokens=self._looks_like, matters=True, share=1.0)
        if (lost := self._lost) is not None and self._lost_alone(lost, fit, looks):
            return replace(found, tokens=lost.tokens, matters=True, share=1.0, for_a_while=True, nats=lost.judged.gain)
        if against := opposed(self.given, fit):
            return replace(found, tokens=tuple(dict.fromkeys((*against, *found.tokens))), matters=True, share=1.0)
        if (looks.most > ALIKE or found.matters) and self._explained_without(fit, looks, found):
            return replace(found, tokens=self._looks_like, matters=True, share=1.0)
        if found.matters and self._bent(found, fit):
            return replace(found, share=1.0)
        better = better_shape(self.given, fit, self._horizon)
        if better is None:
            return found
        if not better.shows:  # the repair is as good, whatever its name
            return replace(found, beside=tuple(dict.fromkeys((better.token, *found.beside))))
        return replace(found, tokens=(better.token,), matters=True, share=1.0, nameless=True)

    def _of_nominal(self) -> Structure:
        """What the model as given leaves."""
        found = lack_of_fit(self._looks, self.nominal, self._horizon)
        seen = found.matters and not found.for_a_while and not found.varies
        if seen and (self.unnamed.gain > CLEAR or self._together):
            tokens = self._looks_like
        elif seen and self._field is not None and self._field.beyond > CLEAR:
            tokens = self._looks_like  # it was seen by sliding only, which names what it tries
        else:
            tokens = () if self._shape is None else (self._shape.token,)
        more = (found.for_a_while or found.varies) and self._shape is not None and found.nats > self._shape.nats
        named = tuple(dict.fromkeys((*found.tokens, *tokens) if more else (*tokens, *found.tokens)))
        return replace(found, tokens=named, matters=True, share=1.0) if tokens else found

    def _patchwork(self, fit: Fit) -> bool:
        """Whether names are together no more than one dependence that has none."""
        if len(fit.added) < 2 or self._looks.most < SOMEWHAT * gain(fit, self.nominal):
            return False
        return patchwork(self.given, fit, self.nominal, self.unnamed)

    def _explained_without(self, fit: Fit, looks: Looks, found: Structure) -> bool:
        """Whether something without a name explains more than what was named. looks: at what that leaves."""
        least = 0.0 if self.given.floor.axes else LITTLE * gain(fit, self.nominal)
        if looks.most > least and self._unnamed_explains_more(fit, found.matters):
            return True
        return not self.given.floor.axes and self._no_name(found, looks.left)

    def _no_name(self, found: Structure, named: Left) -> bool:
        """Whether a field explains more than what was named, or a push that wanders as much."""
        if found.varies and self._field is not None and self._field.beyond > 0.0 and beats(self._field, self._looks.left, named):
            return True
        return wanders(self._looks.left, named)

    def _bent(self, found: Structure, best: Fit) -> bool:
        """Whether what is left goes with the very position, speed or heading that a named effect goes with, by as large a part of what was
        explained as that by which a shape must be better to win (`unnamed_alternatives`): then it is another curve. A spring is not what
        gravity does to a link.
        """
        least = SHAPED * max(gain(best, self.nominal), 0.0)
        left = {token for token, nats in found.gains.items() if token in found.tokens and nats > least}
        return bool(left) and bool(left & about_states(best.model, best.added, self.given.data, self.given.steps))

    @cached_property
    def _lost(self) -> Lost | None:
        """Commands that are lost, of what the nominal model leaves."""
        return lost_commands(self._looks.left, self.nominal, self._horizon)[0]

    def _lost_alone(self, lost: Lost, fit: Fit, looks: Looks) -> bool:
        """Whether commands that are lost explain by themselves what names do, whatever is lost beside these: a mean of what comes and what
        does not is a weaker input, or a later one. looks: at what the names leave.
        """
        named = max(fit.coloured, fit.white) - max(self.nominal.coloured, self.nominal.white)
        return lost.judged.gain + CLEAR > named + max(nats_of_lost(looks.left), 0.0)

    @property
    def likeliest(self) -> tuple[str, ...]:
        """What all that the nominal model lacks depends on most, if that is clear."""
        return self._looks_like if self.unnamed.gain > CLEAR or self._together else ()

    @cached_property
    def _looks_like(self) -> tuple[str, ...]:
        """What all that the nominal model lacks depends on most: by the likeliest dictionary, or by two that say little alone, or by a
        shape or a field that does better. All are weighed alike: by the likelihood under noise of their own, of any colour, less the
        price of their numbers. Where noise of some colour does nearly as well, or speeds were not measured, by what they foretell of
        other blocks of time.
        """
        left, shape, field = self._looks.left, self._shape, self._field
        each = {} if self.given.floor.axes else self._looks.weighed
        nats = max(each.values(), default=0.0)
        weighed = nats > CLEAR
        if weighed:
            tokens = tuple(token for token in each if each[token] > nats - ALIKE)
        else:
            tokens, nats = (self.unnamed.token,), self.unnamed.gain
        if self._together:
            both = self._together[-1]
            more = nats_of(left, both.x) if weighed else both.gain
            tokens, nats = (as_told(self._together), more) if more > nats + ALIKE else (tokens, nats)
        if shape is not None:
            more = nats_of_fit(left, shape.fit, shape.price) if weighed and shape.fit is not None else shape.nats
            tokens, nats = ((shape.token,), more) if more >= MORE * nats + ALIKE else (tokens, nats)
        if field is not None and field.nats > nats + (ALIKE if weighed else CLEAR):
            first = tokens[:1] if tokens[0] in field.tokens else ()
            tokens = tuple(dict.fromkeys((*first, *field.tokens)))
        foretells = weighed and self.unnamed.gain > CLEAR and each.get(self.unnamed.token, 0.0) > HALF * nats
        return tuple(dict.fromkeys((*tokens, self.unnamed.token))) if foretells else tokens

    @property
    def _together(self) -> list[Judged]:
        """Dictionaries that explain far more together than the best one does; none, if it does most of it."""
        chosen = self._looks.chosen[0]
        return chosen if len(chosen) > 1 and chosen[-1].gain >= TWICE * self.unnamed.gain + CLEAR else []

    @property
    def _field(self) -> Field | None:
        """The field that explains most of it."""
        return self._looks.field

    @cached_property
    def _shape(self) -> Better | None:
        """The shape that explains most of it; none where no dictionary says anything."""
        if self._looks.most < QUIET:
            return None
        return best_shape(self.given, self.nominal, self._horizon)
