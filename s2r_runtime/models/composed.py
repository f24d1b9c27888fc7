"""A model as it is used: nominal step, parameter values, effects in order, hidden state where an effect has one.

    x, z -> x', z':   u_act, z' = effects of stage `input` (u, z);   x' = h(effects of stage `step` (nominal(h^-1(x), u_act)))

x: (n, nx), u: (n, nu), angles wrapped to (-pi, pi]. h: effects of stage `sensor`, true -> measured, in their order; x is the measured
state on both sides. The hidden state is a tuple of one array an effect, (n, nh); at rest it is what a long time at zero input
leaves (a campaign's full stop).

Effects of stage `step` apply in this order, and within it as listed: what changes the displacement of each wheel (`frame` says so); what
changes the motion of the body; what slides by that motion; all others (the scheme by which a pose is integrated among them); what adds to
the motion along the world's axes; and last, all together, the forces on axes (`push`): dry friction holds against the sum of all that
pulls.

u_act is the input's mean over the step. Where a nominal model says that a state is set to an input at once (`reached`: a wheel's
speed, a car's speed), that state is the input as it acts at the end of the step. What an effect makes of a held input may change within
the step (`within_step`: a lag, a delay by a part of a step). Where that meets such a state, or a later effect that is not linear,
the effects are run in SUBSTEPS parts of the step; its end is what the effects say of it (`at_end`: a lag, a rate limit, a delay), otherwise
the last part stands for it. Delays are worked out before all that does not mind, while the input is held yet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.bounded_file import read_bounded
from s2r_runtime.files.canonical import digest
from s2r_runtime.hookspecs import Effect, NominalModel, Parameter
from s2r_runtime.models.bound import BoundModel, bind, integrating, wrap
from s2r_runtime.models.file_model import load_file_model
from s2r_runtime.models.forces import Pushing, pushed
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry

Array = NDArray[np.float64]
Hidden = tuple[Array, ...]
T = TypeVar("T")

SUBSTEPS = 5
"""Parts of a step where one is not enough. What an effect does not say of the step's end (`at_end`) is then known to a tenth of a step."""

FRAMES = ("wheels", "body", "sliding", "", "world")
"""Where an effect on the step acts, in the order in which they apply."""

SETTLE_STEPS = 20_000
"""Steps after which an effect that is fed a constant counts as settled, whatever it does."""


def _never(dt: float, p: dict[str, Any]) -> bool:
    """An effect that does not say so changes nothing within a step."""
    return False


@dataclass(frozen=True)
class AppliedEffect:
    """An effect with its channel and parameter values."""

    effect: Effect
    channel: str
    p: dict[str, Any]

    @property
    def says_ends(self) -> bool:
        """Whether what acts at the end of a step may be another thing than what acts on average, though the input is held."""
        return hasattr(self.effect, "at_end")

    def ends(
        self,
        tables: tuple[Array, Array, Array],
        before: Array | None,
        again: Callable[[], Array],
        nominal: BoundModel,
        dt: Any,
        *,
        mixed: bool = False,
    ) -> Array:
        """What acts at the ends of steps of dt, (..., nu). tables: what came in, held over each; what acted on average; what came in at the
        ends (the first one itself, if that is all there is). before: hidden state at the start of one step; over time None, or when each
        row begins, (..., 1), of what is `timed`. again: the effect, applied to what came in at the ends. dt: s, or of each row, (..., 1).
        mixed: rows are parts of a step.
        """
        given, acting, end = tables
        if hasattr(self.effect, "at_end"):
            also = {"mixed": True} if mixed and getattr(self.effect, "takes_mixed_ends", False) else {}
            found = self.effect.at_end(tables, before, nominal, self.channel, dt, self.p, **also)
        elif end is given or self.effect.hidden(1, nominal, self.channel, float(np.min(dt)), self.p).size:
            found = acting  # what came in at the ends of the steps before is not kept
        else:
            found = again()
        changed = slice(None) if self.channel not in nominal.inputs else [nominal.inputs.index(self.channel)]
        after = end.copy()
        after[..., changed] = found[..., changed]
        return after


@dataclass(frozen=True)
class ComposedModel:
    """A nominal model with effects. Batched: x (n, nx), u (n, nu)."""

    spec: ModelSpec
    nominal: BoundModel
    effects: tuple[AppliedEffect, ...]

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the nominal model's parameters."""
        return self.nominal.parameters

    @property
    def dt(self) -> float:
        """Step, s."""
        return self.spec.dt

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return self.nominal.states

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return self.nominal.inputs

    @property
    def angle_columns(self) -> list[int]:
        """Columns of x that wrap."""
        return [self.states.index(name) for name in self.nominal.angles]

    @cached_property
    def substeps(self) -> int:
        """Parts of a step in which the effects of stage `input` are run: 1 where that is exact."""
        chain = [a for a in self.effects if a.effect.stage == "input" and not self.pushes(a)]
        moving = [i for i, a in enumerate(chain) if getattr(a.effect, "within_step", _never)(self.dt, a.p)]
        if not moving:
            return 1
        straight = all(getattr(a.effect, "linear", False) for a in chain[moving[0] + 1 :])
        return SUBSTEPS if getattr(self.nominal, "reached", None) or not straight else 1

    @cached_property
    def _rest(self) -> Hidden:
        """Hidden state at rest of one rollout. An effect behind a bias rests at what the bias makes of zero input."""
        dt = self.dt / self.substeps
        acting = np.zeros((1, len(self.inputs)))
        rest: list[Array] = []
        for a in self.effects:
            z = a.effect.hidden(1, self.nominal, a.channel, dt, a.p)
            if a.effect.stage == "input":
                given = acting
                clock = 1 if getattr(a.effect, "timed", False) else 0  # its first column is the time
                for _ in range(SETTLE_STEPS if np.any(given) and z.size else 1):
                    z[:, :clock] = -dt  # the last step before the start
                    acting, after = a.effect.input_step(given, z, self.nominal, a.channel, dt, a.p)
                    settled = np.allclose(after[:, clock:], z[:, clock:], rtol=1e-12, atol=1e-15)
                    z = after
                    if settled:
                        break
            rest.append(z)
        return tuple(rest)

    def at_rest(self, n: int) -> Hidden:
        """Hidden state after a long time at zero input."""
        return tuple(np.repeat(z, n, axis=0) for z in self._rest)

    def act(self, u: Array, hidden: Hidden) -> tuple[Array, Array, Hidden]:
        """Commanded u over one step -> (mean over the step, at its end, hidden')."""
        parts = self.substeps
        dt = self.dt / parts
        mean = end = u
        for part in range(parts):
            end = acting = u
            after = list(hidden)
            for i, a in self._chain:
                given, before = acting, hidden[i]
                acting, after[i] = a.effect.input_step(given, before, self.nominal, a.channel, dt, a.p)
                again = partial(self._again, a, end, before)
                end = a.ends((given, acting, end), before, again, self.nominal, dt) if part == parts - 1 else acting
            hidden = tuple(after)
            mean = acting if part == 0 else mean + (acting - mean) / (part + 1)
        return mean, end, hidden

    @cached_property
    def _chain(self) -> list[tuple[int, AppliedEffect]]:
        """Effects of stage `input` in the order in which they are worked out, each with its place."""
        numbered = [(i, a) for i, a in enumerate(self.effects) if a.effect.stage == "input"]
        return delays_first(self.nominal, numbered, lambda pair: pair[1])

    def _again(self, a: AppliedEffect, u: Array, z: Array) -> Array:
        """What the effect makes of an input over a part of a step that begins at z."""
        acting, _ = a.effect.input_step(u, z, self.nominal, a.channel, self.dt / self.substeps, a.p)
        return acting

    @cached_property
    def uneven(self) -> bool:
        """Whether it takes steps of their own length each, all at once."""
        steps = (a.effect for a in self.effects if a.effect.stage == "step")
        return all(getattr(thing, "uneven", False) for thing in (self.nominal.shared, *steps))

    @cached_property
    def any_step(self) -> bool:
        """Whether it steps exactly at any length: `uneven`, with effects on inputs that are so, or that have no memory."""
        return self.uneven and all(self._any_length(a) for a in self.effects if a.effect.stage == "input")

    def _any_length(self, a: AppliedEffect) -> bool:
        if getattr(a.effect, "uneven", False):
            return True
        remembers = a.effect.hidden(1, self.nominal, a.channel, self.dt, a.p).size > 0
        return not remembers and not getattr(a.effect, "within_step", _never)(self.dt, a.p)

    def advance(self, x: Array, mean: Array, end: Array, lasts: Array | None = None) -> Array:
        """x one step later under an input that acts as `act` says; angles are not wrapped. lasts: (n,) s, of each step, if `uneven`."""
        dt: Any = self.dt if lasts is None else lasts
        x = self.true(x)
        x_next = self.nominal.step(x, mean, dt, self.parameters)
        if end is not mean:
            for state, name in getattr(self.nominal, "reached", {}).items():
                x_next[:, self.states.index(state)] = end[:, self.inputs.index(name)]
        return self.measured(self.corrected(x, mean, x_next, self.for_effects, dt))

    def corrected(self, x: Array, u: Array, x_next: Array, given: BoundModel, dt: Any = None) -> Array:
        """x_next (n, nx), true, as effects of stage `step` change it. given: how it was reached (`integration`); dt: `lasts`."""
        dt = self.dt if dt is None else dt
        changed: dict[str, float] | None = None
        for a in self._after:
            rebound = getattr(a.effect, "rebound", None)
            as_it_is = given if rebound is None or changed is None else replace(given, parameters=changed, schemes={})
            x_next = a.effect.after_step(x, u, x_next, as_it_is, a.channel, dt, a.p)
            changed = changed if rebound is None else rebound(as_it_is, a.channel, a.p)
        return pushed(x, u, x_next, given, self._forces, dt, changed) if self._forces else x_next

    def true(self, x: Array) -> Array:
        """Measured states (n, nx) -> true ones."""
        for a in reversed(self._sensors):
            x = a.effect.to_true(x, self.for_effects, a.channel, a.p)
        return x

    def measured(self, x: Array) -> Array:
        """True states (n, nx) -> measured ones."""
        for a in self._sensors:
            x = a.effect.to_measured(x, self.for_effects, a.channel, a.p)
        return x

    @cached_property
    def for_effects(self) -> BoundModel:
        """The nominal model as effects are given it on a step: they see the scheme by which the pose is integrated."""
        schemes = [a.effect.integrates(a.p) for a in self.effects if hasattr(a.effect, "integrates")]
        return integrating(self.nominal, schemes[-1]) if schemes else self.nominal

    def pushes(self, a: AppliedEffect) -> bool:
        """Whether an effect on the step is a force on an axis, which applies with all others of them."""
        pushes = getattr(a.effect, "pushes", None)
        return pushes is not None and bool(pushes(self.nominal, a.channel))

    @cached_property
    def _forces(self) -> tuple[Pushing, ...]:
        return tuple((a.effect, a.channel, a.p) for a in self.effects if self.pushes(a))

    @cached_property
    def _after(self) -> tuple[AppliedEffect, ...]:
        """Effects of stage `step` that are no forces, in the order in which they apply."""
        those = [a for a in self.effects if a.effect.stage == "step" and not self.pushes(a)]
        return tuple(
            sorted(those, key=lambda a: FRAMES.index(a.effect.frame(self.nominal, a.channel) if hasattr(a.effect, "frame") else ""))
        )

    @cached_property
    def _sensors(self) -> tuple[AppliedEffect, ...]:
        return tuple(a for a in self.effects if a.effect.stage == "sensor")

    def step(self, x: Array, u: Array, hidden: Hidden) -> tuple[Array, Hidden]:
        """One step: (x', hidden')."""
        mean, end, hidden = self.act(u, hidden)
        x_next = self.advance(x, mean, end)
        for column in self.angle_columns:
            x_next[:, column] = wrap(x_next[:, column])
        return x_next, hidden

    def hold(self, x: Array, u: Array, periods: int) -> Array:
        """State after u was held for that many steps from rest, (n, nx)."""
        hidden = self.at_rest(len(x))
        for _ in range(periods):
            x, hidden = self.step(x, u, hidden)
        return x

    def difference(self, measured: Array, predicted: Array) -> Array:
        """measured ⊖ predicted, (n, nx): angles wrapped to (-pi, pi]."""
        e = measured - predicted
        for column in self.angle_columns:
            e[:, column] = wrap(e[:, column])
        return e


SIZES = ("wheel_radius", "track", "wheel_base", "mass", "inertia")
"""Parameters of which no body has none: what it does would be no number, or nothing."""


def delays_first(nominal: BoundModel, chain: Sequence[T], of: Callable[[T], AppliedEffect]) -> list[T]:
    """A chain with each delay before what does not mind being delayed: the same, but what comes in is held yet, so that it is known to
    the instant what acts at the end of a step. As it is, where nothing depends on that.
    """
    found = list(chain)
    for i in range(1, len(found) if getattr(nominal, "reached", None) else 0):
        while i and getattr(of(found[i]).effect, "shift", False) and _waits(nominal, of(found[i - 1]), of(found[i]).channel):
            found[i - 1 : i + 1] = found[i], found[i - 1]
            i -= 1
    return found


def _waits(nominal: BoundModel, a: AppliedEffect, channel: str) -> bool:
    """Whether an effect may come after a delay on a channel as well as before it."""
    if getattr(a.effect, "timed", False) or getattr(a.effect, "shift", False):
        return False
    reads = getattr(a.effect, "reads", None)
    touched = {a.channel, *(reads(nominal, a.channel) if reads else ())}
    return channel == "*" or touched == {channel} or (channel not in touched and "*" not in touched)


def compose(spec: ModelSpec, where: str = "model", nominal_model: NominalModel | None = None) -> ComposedModel:
    """The model that a spec describes. nominal_model: instead of the one of that name, where nothing is registered under it.

    Raises ConfigError (unknown names with the nearest known one, bad parameters).
    """
    shared = nominal_model or (load_file_model(spec, where) if spec.name.endswith(".py") else _registered("models", spec.name, where))
    for name in spec.parameters:
        if name not in shared.parameters:
            known = ", ".join(shared.parameters) or "none"
            raise ConfigError(f"{where}.parameters.{name}: model {spec.name!r} has no such parameter; it has: {known}")
        if name in SIZES and not 0.0 < spec.parameters[name] < math.inf:
            raise ConfigError(f"{where}.parameters.{name} is {spec.parameters[name]:g}, must be > 0 and finite")
    nominal = bind(shared, spec.parameters)
    applied: list[AppliedEffect] = []
    for index, entry in enumerate(spec.effects):
        effect: Effect = _registered("effects", entry.name, f"{where}.effects[{index}]")
        place = f"{where}.effects[{index}] ({entry.name})"
        channels = effect.channels(nominal)
        if not channels:
            raise ConfigError(f"{place}: acts on nothing that the model {spec.name} has; docs/effects.md says on what each effect acts")
        if entry.channel not in channels:
            raise ConfigError(f"{place}: channel is {entry.channel!r}, must be one of: {', '.join(channels)}")
        if getattr(effect, "once", False) and any(a.effect is effect for a in applied):
            raise ConfigError(f"{place}: is there twice, must be there once")
        applied.append(AppliedEffect(effect, entry.channel, _effect_parameters(effect, entry, nominal, place)))
    return ComposedModel(spec, nominal, tuple(applied))


def _registered(kind: str, name: str, where: str) -> Any:
    try:
        return registry().get(kind, name)
    except ConfigError as error:
        raise ConfigError(f"{where}.name: {error}") from None


def takes(effect: Effect, nominal: NominalModel, channel: str) -> tuple[str, ...]:
    """Names of the parameters that an effect has on this channel."""
    return effect.takes(nominal, channel) if hasattr(effect, "takes") else tuple(p.name for p in effect.parameters)


def words(effect: Effect, channel: str, nominal: NominalModel, parameter: str) -> tuple[str, ...] | None:
    """What a parameter may say that is no number; None for one that is."""
    if parameter in getattr(effect, "named", ()):
        return tuple(name for name in nominal.inputs if name != channel)
    said: tuple[str, ...] | None = getattr(effect, "choices", {}).get(parameter)
    return said


def _effect_parameters(effect: Effect, entry: EffectSpec, nominal: NominalModel, where: str) -> dict[str, Any]:
    given: dict[str, Any] = entry.parameters
    there = takes(effect, nominal, entry.channel)
    known = {p.name: p for p in effect.parameters if p.name in there}
    for name, value in given.items():
        if name not in known:
            raise ConfigError(f"{where}: has no parameter {name!r}; it has: {', '.join(known)}")
        bounds = known[name]
        if bounds.shape or isinstance(value, list):
            _check_matrix(value, bounds, where)
            continue
        allowed = words(effect, entry.channel, nominal, name)
        if allowed is not None and value not in allowed:
            raise ConfigError(f"{where}: {name} is {value!r}, must be one of: {', '.join(allowed)}")
        if allowed is None and isinstance(value, str):
            raise ConfigError(f"{where}: {name} is {value!r}, must be a number")
        if isinstance(value, int | float) and not bounds.low <= value <= bounds.high:
            raise ConfigError(f"{where}: {name} is {value}, must be in [{bounds.low}, {bounds.high}] {bounds.unit}")
    optional = getattr(effect, "optional", ())
    if missing := [name for name in known if name not in given and name not in optional]:
        raise ConfigError(f"{where}: lacks the parameter {', '.join(missing)}")
    if wrong := getattr(effect, "wrong", lambda p: "")(given):
        raise ConfigError(f"{where}: {wrong}")
    return dict(given)


def _check_matrix(value: object, bounds: Parameter, where: str) -> None:
    """Raises ConfigError unless the value has the parameter's shape, and its entries are within bounds."""
    rows, columns = bounds.shape or (0, 0)
    if not rows:
        raise ConfigError(f"{where}: {bounds.name} is {value!r}, must be a number")
    if not isinstance(value, list) or len(value) != rows or any(len(row) != columns for row in value):
        raise ConfigError(f"{where}: {bounds.name} is {value!r}, must be {rows} rows of {columns} numbers")
    if outside := [v for row in value for v in row if not bounds.low <= v <= bounds.high]:
        raise ConfigError(f"{where}: {bounds.name} has {outside[0]}, must be in [{bounds.low}, {bounds.high}] {bounds.unit}")


def resolve_source(spec: ModelSpec, base: Path) -> ModelSpec:
    """Makes a file model's path absolute (relative to `base`) and fills in its source digest."""
    if not spec.name.endswith(".py"):
        return spec
    path = (base / spec.name).resolve()
    return msgspec.structs.replace(spec, name=str(path), source_digest=digest(read_bounded(path)))
