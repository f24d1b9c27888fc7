"""The shape of a residual: its mean in bins of what it may depend on, and how much of it that accounts for.

    components   of a model with a planar pose along and across the heading (and every other state); of another one its states
    variables    inputs, how they changed, their products, states, time; each with the token of `depends_on` that speaks of it
    mean         of the residual in bins of a variable; or, `per` an input, of how much of that input there is too much or too little there
    share        of the mean square that noise does not make: (mean square of the means - what chance makes of it) / (mean square - floor^2)

A shape is shown, it is not a name: that a residual follows a variable does not say why.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.diagnostics.rollout_error import Held
from s2r_runtime.trace.estimation.prediction import acting
from s2r_runtime.trace.hypotheses.basis import token_of

Array = NDArray[np.float64]

BINS = 24
"""Bins at most; each holds at least FEWEST transitions, so a mean is known to a sixth of the scatter."""

FEWEST = 30

OF_TIME = 6
"""Bins of time at most: whatever goes smoothly is a function of time in many."""

RECENT_S = (0.0, 0.1, 0.4, 1.5)
"""Times over which an input's past is averaged, s (0: the step before): a residual with memory follows how the input changed."""

BETTER = 0.1
"""Share by which a variable must account for more than a simpler thing: than a constant, or than without an input that it multiplies."""


@dataclass(frozen=True, eq=False)
class Component:
    """A part of the residual, (n,). floor: its rms by noise alone. turn: an angle, or a rate of one."""

    name: str
    unit: str
    said: str
    before: Array
    after: Array
    floor: float


@dataclass(frozen=True, eq=False)
class Variable:
    """What a residual may depend on, (n,). token: of `depends_on`; said: as a person says it."""

    name: str
    token: str
    unit: str
    said: str
    values: Array


@dataclass(frozen=True)
class Binned:
    """Means (B,) of a component over bins of a variable, with their standard errors. middle: mean of the variable in the bin."""

    middle: Array
    mean: Array
    error: Array
    size: Array
    """(B,) how much each mean counts: the number of values, or the sum of squares of what it is per."""


@dataclass(frozen=True)
class Shape:
    """A component against the variable that accounts for most of it (None: it is a constant). per: an input that the variable multiplies.

    share: of what noise does not make, 0 to 1.
    """

    component: Component
    variable: Variable | None
    per: Variable | None
    share: float

    @property
    def said(self) -> str:
        """What it follows, as a person says it."""
        if self.variable is None:
            return "is the same all the time"
        return f"is {self.per.said} times a factor that follows {self.variable.said}" if self.per else f"follows {self.variable.said}"


def components(model: ComposedModel, held: Held, before: Array, after: Array, floor: Array) -> list[Component]:
    """before, after: (n, nx) one-step residuals on what is held out; floor: (nx,)."""
    units: dict[str, str] = getattr(model.nominal, "units", {})
    states = model.states
    found = []
    pose = has_pose(model)
    if pose:
        x, y, theta = (states.index(name) for name in ("x", "y", "theta"))
        c, s = np.cos(held.steps.y0[:, theta]), np.sin(held.steps.y0[:, theta])
        least = float(np.sqrt(0.5 * (floor[x] ** 2 + floor[y] ** 2)))
        for name, said, a, b in (("along", "along the heading", c, s), ("across", "to the left of the heading", -s, c)):
            found.append(
                Component(name, units.get("x", ""), said, a * before[:, x] + b * before[:, y], a * after[:, x] + b * after[:, y], least)
            )
    for i, name in enumerate(states):
        if not (pose and name in {"x", "y"}):
            found.append(Component(name, units.get(name, ""), name, before[:, i], after[:, i], float(floor[i])))
    return found


def world(model: ComposedModel, before: Array, after: Array, floor: Array) -> list[Component]:
    """x and y of a model with a planar pose, in the world's axes; else nothing."""
    units: dict[str, str] = getattr(model.nominal, "units", {})
    names = ("x", "y") if has_pose(model) else ()
    columns = [(name, model.states.index(name)) for name in names]
    return [Component(name, units.get(name, ""), name, before[:, i], after[:, i], float(floor[i])) for name, i in columns]


def variables(model: ComposedModel, held: Held) -> list[Variable]:
    """All that a residual is looked at against: inputs, states, time."""
    units: dict[str, str] = getattr(model.nominal, "units", {})
    steps = held.steps
    u = acting(model, held.data, ()).mean[steps.place]
    found = [Variable(name, name, units.get(name, ""), name, u[:, j]) for j, name in enumerate(model.inputs)]
    for i, name in enumerate(model.states):
        values, about = steps.y0[:, i], token_of(model, name)
        if name in model.nominal.angles:
            values = np.asarray((values + np.pi) % (2.0 * np.pi) - np.pi)
        found.append(Variable(name, about, units.get(name, ""), "the heading" if about == "heading" else name, values))
    return [*found, Variable("time", "time", "s", "the time", steps.t)]


def derived(model: ComposedModel, held: Held) -> list[Variable]:
    """How each input changed (over several times), and products of inputs."""
    units: dict[str, str] = getattr(model.nominal, "units", {})
    place = held.steps.place
    mean = acting(model, held.data, ()).mean
    found = []
    total = np.concatenate([np.zeros((1, mean.shape[1])), np.cumsum(mean, axis=0)])
    widths = dict.fromkeys(max(1, round(s / held.data.dt)) for s in RECENT_S)
    for j, name in enumerate(model.inputs):
        for width in widths:
            begin = np.maximum(place - width, 0)
            recent = (total[place, j] - total[begin, j]) / np.maximum(place - begin, 1)
            over = "in a step" if width == 1 else f"against its mean over {width * held.data.dt:.2g} s"
            found.append(Variable(f"change of {name}", f"memory({name})", units.get(name, ""), f"how {name} changes ({over})",
                                  np.where(place > 0, mean[place, j] - recent, 0.0)))  # fmt: skip
        for i in range(j):
            pair = f"{model.inputs[i]}*{name}"
            found.append(Variable(pair, pair, "", f"{model.inputs[i]} times {name}", mean[place, i] * mean[place, j]))
    return found


def binned(x: Array, e: Array, per: Array | None = None, most: int = BINS) -> Binned | None:
    """Means of e over bins of x with about as many values each; None if x takes one value only, or there are too few. per: (n,); then the
    slope of e on it in each bin.
    """
    count = min(most, len(x) // FEWEST)
    if count < 2 or float(np.ptp(x)) <= 1e-12 * max(float(np.max(np.abs(x))), 1e-300):
        return None
    by = np.ones(len(x)) if per is None else per
    place = _bins(x, count)
    size = np.asarray(np.bincount(place, by * by), dtype=np.float64)
    keep = (np.bincount(place) >= 5) & (size > 1e-6 * float(np.max(size, initial=0.0)))
    if np.count_nonzero(keep) < 2:
        return None
    size = np.maximum(size, 1e-300)
    mean = np.bincount(place, e * by) / size
    left = (e - mean[place] * by) * by
    error = np.sqrt(np.bincount(place, left * left)) / size
    middle = np.bincount(place, x) / np.maximum(np.bincount(place), 1)
    return Binned(middle[keep], mean[keep], error[keep], size[keep])


def _bins(x: Array, count: int) -> NDArray[np.int64]:
    """(n,) the bin of each value: values held for long get bins of their own, the others as many in each."""
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, count + 1)[1:-1]))
    place = np.searchsorted(edges, x, side="right")
    return np.asarray(np.unique(place, return_inverse=True)[1], dtype=np.int64)


def share(x: Array, e: Array, floor: float, per: Array | None = None, most: int = BINS) -> float:
    """Of e's mean square beyond the floor: what its means over bins of x account for, less what chance would."""
    bins = binned(x, e, per, most)
    return 0.0 if bins is None else _part(float(np.sum(bins.size * (bins.mean**2 - bins.error**2))) / len(e), e, floor)


def _part(accounted: float, e: Array, floor: float) -> float:
    total = float(np.mean(e**2))
    return min(1.0, max(0.0, accounted) / max(total - floor**2, 0.02 * total, 1e-300))


def shape_of(part: Component, over: Sequence[Variable], inputs: Sequence[Variable], *, after: bool = False) -> Shape:
    """The variable that accounts for most of a component; the simpler of two that account for about as much."""
    e = part.after if after else part.before
    constant = float(np.mean(e))
    best = Shape(part, None, None, _part(constant**2 - float(np.var(e)) / len(e), e, part.floor))
    shapes = [Shape(part, v, None, share(v.values, e, part.floor, None, _most(v))) for v in over]
    best = max([best, *(s for s in shapes if s.share > best.share + BETTER)], key=lambda s: s.share)
    pairs = [(v, u) for v in over for u in inputs if v.token != u.token and not v.token.startswith("memory")]
    shapes = [Shape(part, v, u, share(v.values, e, part.floor, u.values, _most(v))) for v, u in pairs]
    return max([best, *(s for s in shapes if s.share > best.share + BETTER)], key=lambda s: s.share)


def _most(v: Variable) -> int:
    """Bins of a variable."""
    return OF_TIME if v.name == "time" else BINS


def strongest(parts: Sequence[Component], over: Sequence[Variable], inputs: Sequence[Variable], *, after: bool = False) -> list[Shape]:
    """`shape_of` each component; the one with most beyond noise first (without a floor, the one that is accounted for best)."""
    shapes = [shape_of(part, over, inputs, after=after) for part in parts]
    return sorted(shapes, key=lambda s: -s.share * _loudness(s.component, after=after))


def clearest(parts: Sequence[Component], over: Sequence[Variable]) -> Shape:
    """Of what is left after the repair: the component and the variable, of these alone, that go together best, however little that is."""
    shapes = [Shape(part, v, None, share(v.values, part.after, part.floor, None, _most(v))) for part in parts for v in over]
    return max(shapes, key=lambda s: s.share)


def _loudness(part: Component, *, after: bool) -> float:
    return float(np.mean((part.after if after else part.before) ** 2)) / part.floor**2 if part.floor > 0.0 else 1.0


def of_tokens(tokens: Sequence[str], over: Sequence[Variable]) -> Iterator[tuple[str, list[Variable]]]:
    """What to draw for each token of `depends_on`; nothing for `constant` and `noise`, which have no variable."""
    for token in tokens:
        wanted = token.split("*") if token.startswith("time*") else [token]
        yield token, [v for v in over if v.token in wanted or v.name in wanted]


def has_pose(model: ComposedModel) -> bool:
    """Whether it has a planar pose."""
    return {"x", "y", "theta"} <= set(model.states)
