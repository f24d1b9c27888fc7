"""Do several names stand for one thing that has none?

With enough numbers, names together can follow what none of them means: a gyro that drifts, as a bias, a field of places and a rate limit.
What tells: it depends on one thing, and a dictionary of that (`basis`) explains as much as all of them together.

    patchwork    gain(dictionary) >= AS_MUCH gain(all names)     and     every gain(one name) <= MOSTLY gain(all names)
                 and some name is about something else than the dictionary

The dictionary's gain is that on blocks which its numbers never saw, that of the names on what they were fitted to. Two effects that are
there give two dependences, of which one dictionary has one; where both are about the same (dry friction and drag, about the speed; wheels
that slip and a bias of the steering, which turns a car the more, the faster it goes), one dictionary has both, and that says nothing
against them. A state that a model sets to what is commanded (a car's speed) is one thing with that command. Nor does it say anything
against a steady push, if what is commanded has two values: the square of that is one, too.
"""

from __future__ import annotations

from collections.abc import Iterator

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.estimation.problem import Fit, Problem, fitted, gain, without
from s2r_runtime.trace.hypotheses.basis import token_of
from s2r_runtime.trace.hypotheses.dependence import about, carried, only_pushes
from s2r_runtime.trace.selection.basis_evidence import Judged

AS_MUCH = 1.0
"""Of what all names explain: of two effects that are there, one dictionary explained up to 0.96, but for pairs of which one is MOSTLY
all; of one thing without a name (five made recordings), 0.84 and 1.05 to 1.45."""

CONSTANT = "constant"
"""What every effect that only pushes has in it."""

MOSTLY = 0.9
"""Of the same: a name that explains more by itself is what is there, whatever the others add."""


def patchwork(given: Problem, fit: Fit, nominal: Fit, unnamed: Judged) -> bool:
    """Whether the names of a fit are together no more than one dependence, which none of them alone is."""
    named = gain(fit, nominal)
    if len(fit.added) < 2 or unnamed.token == CONSTANT or unnamed.gain < AS_MUCH * named:
        return False
    atoms = set(unnamed.token.split("*"))
    seen = atoms | {atom.removeprefix("memory(").removesuffix(")") for atom in atoms}  # what an input was has in it what it is
    varied = [place for place in fit.added if not only_pushes(fit.model, place, given.data, given.steps)]
    each = [(about(fit.model, place, given.data, given.steps), carried(fit.model, place, given.data, given.steps)) for place in varied]
    if all(atoms <= _with_set(fit.model, one | more) or one <= seen for one, more in each):
        return False
    return all(gain(alone, nominal) <= MOSTLY * named for alone in _each_alone(given, fit))


def _with_set(model: ComposedModel, tokens: set[str]) -> set[str]:
    """With the states that are set to one of these inputs, as they are told."""
    return tokens | {token_of(model, state) for state, name in getattr(model.nominal, "reached", {}).items() if name in tokens}


def _each_alone(given: Problem, fit: Fit) -> Iterator[Fit]:
    for place in fit.added:
        model = fit.model
        for other in reversed(fit.added):
            model = model if other == place else without(model, other)
        yield fitted(given, fit, model, 2)
