"""What several tied explanations have in common.

Where a bias, a gain, a deadband and a limit of one input explain the same, the data have a single number to say about that input: whatever
depends on it and comes out as that number would do, with a name in the library or without one. Of these only what they share is known.

So it is of a spring and a cubic one that pull against each other on one position: the first terms of a sine (gravity, cogging) are that,
and of whatever else turns over not far from where the robot was. What it does beyond, these terms do not say.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from s2r_runtime.effects.classes import same
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.prediction import Steps
from s2r_runtime.trace.estimation.problem import Fit
from s2r_runtime.trace.hypotheses.dependence import about
from s2r_runtime.trace.selection.scores import name_of

SEVERAL = 3
"""Explanations that tie, from which on none is believed to be the one: two may be just the two that are there."""


def any_shape_of(fit: Fit, rivals: Sequence[Fit], data: Dataset, steps: Steps) -> tuple[str, ...]:
    """Tokens of what most explanations of one thing depend on, if these are several; of an input and its memory, that memory. rivals: fits
    with one effect of `fit` replaced by another.
    """
    shared: set[str] = set()
    for place in fit.added:
        mine = name_of(fit.model.effects[place])
        gone = [other for other in rivals if all(name_of(other.model.effects[i]) != mine for i in other.added)]
        explained = _each_once([(fit, place), *((other, _other(other, fit)) for other in gone)])
        if len(explained) >= SEVERAL:
            count = Counter(token for one in explained for token in _about(*one, data, steps))
            most = max(count.values(), default=0)
            shared |= {token for token in count if count[token] == most >= SEVERAL}
    if _turns_over(fit):
        shared.add("position")
    return tuple(sorted(token for token in shared if f"memory({token})" not in shared))


def _turns_over(fit: Fit) -> bool:
    """Whether a linear and a cubic spring that were found pull against each other."""
    found = [fit.model.effects[place] for place in fit.added]
    fields = [a.p["matrix"] for a in found if a.effect.name == "position_field"]
    cubes = [(a.channel, float(a.p["coefficient"])) for a in found if a.effect.name == "cubic_stiffness"]
    return any(c in ("x", "y") and field["xy".index(c)]["xy".index(c)] * cube > 0.0 for field in fields for c, cube in cubes)


def _each_once(explained: list[tuple[Fit, int]]) -> list[tuple[Fit, int]]:
    """Without other names of the same thing (`effects.classes`); that of an input stays."""
    kept, known = [], set()
    for fit, place in sorted(explained, key=lambda one: one[0].model.effects[one[1]].channel not in one[0].model.inputs):
        a = fit.model.effects[place]
        if name_of(a) not in known:
            kept.append((fit, place))
            known |= {(name, channel) for name, channel, _ in same(fit.model.nominal, a.effect.name, a.channel, a.p)}
    return kept


def _about(fit: Fit, place: int, data: Dataset, steps: Steps) -> set[str]:
    """What an effect is about. Drag on an input is about that, which trying does not show where it is the same all the time."""
    return about(fit.model, place, data, steps) | ({fit.model.effects[place].channel} & {*fit.model.inputs})


def _other(rival: Fit, fit: Fit) -> int:
    """The place of the effect that a fit does not have."""
    there = {name_of(fit.model.effects[place]) for place in fit.added}
    return next(place for place in rival.added if name_of(rival.model.effects[place]) not in there)
