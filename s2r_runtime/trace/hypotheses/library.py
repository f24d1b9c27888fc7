"""What a model could lack: every registered effect, on every channel, at every place in the list where it would differ.

An effect that commutes with what is there has one place, the end. It is tried before each effect that it does not commute with, too:
a gain before a limit is another thing than one behind it, and a limit before a lag another than one after it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.effects.classes import canonical
from s2r_runtime.hookspecs import Effect
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.parameters import Added
from s2r_runtime.trace.estimation.prediction import times
from s2r_runtime.trace.estimation.problem import insert
from s2r_runtime.trace.hypotheses.measured_forces import on_motion
from s2r_runtime.trace.hypotheses.starting_values import Leftover

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Candidate:
    """One effect at one place, with the values to begin from. replaced: place of an effect that it stands in for, or -1."""

    name: str
    channel: str
    place: int
    starts: tuple[AppliedEffect, ...]
    replaced: int = -1

    def models(self, model: ComposedModel) -> list[ComposedModel]:
        """The model with the effect, once a start."""
        if self.replaced >= 0:
            there = model.effects
            made = [Added(s.effect, s.channel, s.p, instead=there[self.replaced]) for s in self.starts]
            return [replace(model, effects=(*there[: self.replaced], a, *there[self.replaced + 1 :])) for a in made]
        return [insert(model, start, self.place) for start in self.starts]


def candidates(model: ComposedModel, data: Dataset, left: Leftover | None = None) -> list[Candidate]:
    """All that can be added to the model; what the tracer added already is not added again on the same channel. left: what it leaves, for
    those that begin there.
    """
    found = []
    taken = {(a.effect.name, a.channel) for a in model.effects if isinstance(a, Added)}
    t = times(data)
    given: dict[int, Array] = {}
    for name in registry().names("effects"):
        effect = registry().get("effects", name)
        if getattr(effect, "timed", False) and not data.in_order:
            continue
        for channel in effect.channels(model.nominal):
            if data.measured_forces and not on_motion(model, name, effect.stage, channel):
                continue
            if canonical(model.for_effects, name, channel) != (name, channel):
                continue  # the same thing under another name is looked for already
            if (name, channel) in taken or (channel == "*" and len(model.inputs) == 1 and len(effect.channels(model.nominal)) > 1):
                continue
            there = [i for i, a in enumerate(model.effects) if a.effect is effect]
            if getattr(effect, "once", False) and there:
                found += _instead(model, effect, channel, there[0], data.dt)
                continue
            for place in places(model, effect, channel):
                if place not in given:
                    given[place] = data.chains.through(model, _input_effects(model, place))
                starts = _starts(effect, given[place], model, channel, data.dt, t)
                if left is not None and place == len(model.effects):
                    starts += left.starts(effect, channel)
                if starts:
                    found.append(Candidate(name, channel, place, tuple(AppliedEffect(effect, channel, p) for p in starts)))
    return found


def _input_effects(model: ComposedModel, place: int) -> list[AppliedEffect]:
    return [a for a in model.effects[:place] if a.effect.stage == "input"]


def places(model: ComposedModel, effect: Effect, channel: str) -> list[int]:
    """The end, and before each effect that it does not commute with."""
    end = len(model.effects)
    if effect.stage != "input":
        return [end]
    return [end, *(i for i, a in enumerate(model.effects) if a.effect.stage == "input" and not commute(effect, channel, a, model))]


def commute(effect: Effect, channel: str, other: AppliedEffect, model: ComposedModel) -> bool:
    """Whether their order makes no difference (but for what is averaged within a step)."""
    here, there = _concerned(effect, channel, model), _concerned(other.effect, other.channel, model)
    if channel not in there and other.channel not in here and "*" not in {channel, other.channel}:
        return True
    if getattr(effect, "linear", False) and getattr(other.effect, "linear", False):
        return True
    for one, on, two in ((effect, channel, there), (other.effect, other.channel, here)):
        if getattr(one, "shift", False) and (on == "*" or two == {on}):
            return True
    return False


def _concerned(effect: Effect, channel: str, model: ComposedModel) -> set[str]:
    """The channel, and the inputs that what acts there depends on."""
    reads = getattr(effect, "reads", None)
    return {channel, *(reads(model.nominal, channel) if reads else ())}


def _instead(model: ComposedModel, effect: Effect, channel: str, place: int, dt: float) -> list[Candidate]:
    """Other values for an effect that may stand once only."""
    now = model.effects[place]
    if isinstance(now, Added):
        return []
    starts = [p for p in now.effect.starts(np.zeros((1, len(model.inputs))), model.nominal, channel, dt) if p != now.p]  # type: ignore[attr-defined]
    return (
        [Candidate(now.effect.name, channel, place, tuple(AppliedEffect(now.effect, channel, p) for p in starts), place)] if starts else []
    )


def _starts(effect: Effect, u: Array, model: ComposedModel, channel: str, dt: float, t: Array) -> list[dict[str, float | str]]:
    """The effect's own, else a grid between the neutral value and the bounds. t: of the rows of u, s."""
    if hasattr(effect, "starts") and getattr(effect, "timed", False):
        return list(effect.starts(u, model.nominal, channel, dt, t))
    if hasattr(effect, "starts"):
        return list(effect.starts(u, model.nominal, channel, dt))
    grids: list[dict[str, float | str]] = [{}]
    for p in getattr(effect, "parameters", ()):
        choices = getattr(effect, "choices", {}).get(p.name)
        if p.name in getattr(effect, "optional", ()):
            continue
        values: list[float | str] = list(choices) if choices else list(_between(p.neutral, p.low, p.high, u))
        grids = [{**g, p.name: v} for g in grids for v in values][:60]
    return grids


def _between(neutral: float | None, low: float, high: float, u: Array) -> list[float]:
    """Values on both sides of neutral, from a hundredth of the input's size up, inside the bounds."""
    size = float(np.max(np.abs(u), initial=0.0)) or 1.0
    middle = neutral if neutral is not None else 0.0
    tried = [middle + sign * size * share for share in (0.03, 0.1, 0.3, 1.0) for sign in (1.0, -1.0)]
    return [v for v in tried if low <= v <= high] or [low + 0.5 * (high - low)]
