"""What an effect is about: the inputs and states on which what it does depends, by the names that `depends_on` has for them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.prediction import Acting, Steps, acting, advanced, rms
from s2r_runtime.trace.estimation.problem import without
from s2r_runtime.trace.hypotheses.basis import token_of

Array = NDArray[np.float64]

MOTION = {"position", "speed", "heading"}

VARIES = 0.05
"""Share by which what an effect does must change along a state or an input for it to be about that."""


def about(model: ComposedModel, place: int, data: Dataset, steps: Steps) -> set[str]:
    """Tokens of one thing each (an input, its memory, time, or as `about_states`) on which an effect of a model depends. Of what acts on an
    input its own word is taken; of all else it is tried.
    """
    a = model.effects[place]
    found = {"time"} if getattr(a.effect, "timed", False) else set()
    if not _filters(model, place):
        return found | _tried(model, place, data, steps, of_states=True) | _tried(model, place, data, steps, of_states=False)
    names = model.inputs if a.channel == "*" else (a.channel,)
    reads = a.effect.reads(model.nominal, a.channel) if hasattr(a.effect, "reads") else ()
    return found | {*names, *reads} | ({f"memory({name})" for name in names} if remembers(model, a) else set())


def remembers(model: ComposedModel, a: AppliedEffect) -> bool:
    """Whether what acts by an effect on an input depends on what was asked before. What is timed has the time among what it hides."""
    hidden = a.effect.hidden(1, model.nominal, a.channel, model.dt, a.p).size if a.effect.stage == "input" else 0
    return bool(hidden > int(getattr(a.effect, "timed", False)))


def carried(model: ComposedModel, place: int, data: Dataset, steps: Steps) -> set[str]:
    """Tokens of one thing each on which it depends what the model makes of an effect on an input: a bias of the steering turns a car the
    more, the faster it goes. None of what does not act on an input.
    """
    if not _filters(model, place):
        return set()
    return _tried(model, place, data, steps, of_states=True) | _tried(model, place, data, steps, of_states=False)


def about_states(model: ComposedModel, places: tuple[int, ...], data: Dataset, steps: Steps) -> set[str]:
    """Which of position, speed and heading what these effects do to the robot depends on: friction and drag on a speed, a spring on a
    position. An effect on an input is about none, nor is a sensor's. Other states may be anything, and are left out.
    """
    plant = [place for place in places if model.effects[place].effect.stage != "sensor" and not _filters(model, place)]
    return MOTION & set().union(*(_tried(model, place, data, steps, of_states=True) for place in plant))


def only_pushes(model: ComposedModel, place: int, data: Dataset, steps: Steps) -> bool:
    """Whether what an effect does, seen from the robot, is the same in every step of a recording, whatever it is about."""
    pair = (model, without(model, place))
    done = _done(pair, steps.y0, [acting(m, data).at(steps.place) for m in pair])
    return bool(np.all(np.std(done, axis=0) <= VARIES * rms(done)))


def _filters(model: ComposedModel, place: int) -> bool:
    """Whether an effect changes what is commanded; some that do may also act on a speed."""
    a = model.effects[place]
    return a.effect.stage == "input" and (a.channel == "*" or a.channel in model.inputs)


def _tried(model: ComposedModel, place: int, data: Dataset, steps: Steps, *, of_states: bool) -> set[str]:
    """Of states, or of inputs, those that change what an effect does, seen from the robot, if they are elsewhere by as much as usual."""
    pair, y = (model, without(model, place)), steps.y0
    acts = [acting(m, data).at(steps.place) for m in pair]
    moved = rms(model.difference(steps.y1, y))
    size = np.where(moved > 0.0, moved, np.inf)  # what never changes tells nothing
    usual = _done(pair, y, acts) / size
    enough = VARIES * float(np.linalg.norm(usual))
    found, names = set(), model.states if of_states else model.inputs
    for j, name in enumerate(names):
        by = np.eye(len(names))[j] * (1.0 if name in model.nominal.angles else float(np.std((y if of_states else acts[1].mean)[:, j])))
        try:
            there = _done(pair, y + by, acts) if of_states else _done(pair, y, [act.moved(by) for act in acts])
        except ConfigError:  # a user's own model may give no numbers there
            continue
        if np.linalg.norm(there / size - usual) > enough:
            found.add(token_of(model, name))
    return found


def _done(pair: Sequence[ComposedModel], y: Array, acts: Sequence[Acting]) -> Array:
    """(n, nx) what a model does in a step that another one does not, each under its own inputs; of a robot with a heading along it and
    across it.
    """
    model = pair[0]
    done = model.difference(*(advanced(m, y, act, slice(None)) for m, act in zip(pair, acts, strict=True)))
    if {"x", "y", "theta"} <= set(model.states):
        i, j, k = (model.states.index(name) for name in ("x", "y", "theta"))
        c, s = np.cos(y[:, k]), np.sin(y[:, k])
        done[:, i], done[:, j] = c * done[:, i] + s * done[:, j], c * done[:, j] - s * done[:, i]
    return np.asarray(done)
