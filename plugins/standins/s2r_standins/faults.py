"""What can be wrong with a stand-in beyond its data sheet, named as `NAME[:CHANNEL] [PARAMETER=VALUE]...`.

Every effect that is installed for the runtime's models can be one (`input_gain:w gain=0.7`). Two more are here, of a kind that
no effect of that library has, so that it can be seen what a tracer says where it has no name to give:

    slip_patch x= y= radius= gain=      inside a disc of the floor the wheels slip: v and w act by the factor `gain`
    heading_ripple amplitude= waves=    while driving, yaw is pushed by amplitude v sin(waves theta), in rad/m: a floor with grooves
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from s2r_runtime.errors import ConfigError
from s2r_runtime.modelspec import EffectSpec, ModelSpec

if TYPE_CHECKING:
    from s2r_runtime.models.composed import ComposedModel

Pose = tuple[float, float, float]
Twist = tuple[float, float]
Fault = Callable[[Pose, Twist], Twist]


class ParsedEffect(NamedTuple):
    """`fault` for one of this module's own, else `spec`. key: name and channel."""

    key: str
    spec: EffectSpec
    fault: Fault | None


def parse_effect(text: str) -> ParsedEffect:
    """Raises ConfigError, naming what it must look like."""
    words = text.split()
    if not words:
        raise ConfigError("effect: is empty, must be NAME[:CHANNEL] [PARAMETER=VALUE]...")
    name, _, channel = words[0].partition(":")
    parameters: dict[str, Any] = {}
    for word in words[1:]:
        key, equals, value = word.partition("=")
        if not equals:
            raise ConfigError(f"effect {text!r}: {word!r} must be PARAMETER=VALUE")
        try:
            parameters[key] = json.loads(value) if value.startswith("[") else float(value)
        except ValueError:
            parameters[key] = value
    try:
        spec = EffectSpec(name, channel or "*", parameters)
    except ValueError as error:
        raise ConfigError(f"effect {text!r}: {error}") from None
    fault = _own(name, parameters, text) if name in _OWN else None
    if fault is None:
        Library({text: spec}, 1.0, arcs=True)  # says at once what is wrong with it
    return ParsedEffect(f"{name}:{spec.channel}", spec, fault)


class Library:
    """Effects of the runtime's library, composed as its models do it, on one robot. specs: by key, in the order in which they act; arcs:
    whether the robot moves along arcs of its own accord.
    """

    def __init__(self, specs: dict[str, EffectSpec], dt: float, *, arcs: bool) -> None:
        import numpy as np  # a robot without such effects does without numpy

        from s2r_runtime.models.bound import integrating
        from s2r_runtime.models.composed import compose

        self.specs, self._array = specs, np.array
        self._model: ComposedModel = compose(ModelSpec("unicycle", dt, effects=tuple(specs.values())), "robot")
        self._reached = integrating(self._model.nominal, "") if arcs else self._model.for_effects
        self._hidden = list(self._model.at_rest(1))

    def act(self, twist: Twist) -> Twist:
        """What the effects on inputs make of (v, w) over this period."""
        u = self._array([twist])
        for i, a in enumerate(self._model.effects):
            if a.effect.stage == "input":
                u, self._hidden[i] = a.effect.input_step(u, self._hidden[i], self._model.nominal, a.channel, self._model.dt, a.p)
        return float(u[0, 0]), float(u[0, 1])

    def correct(self, before: Pose, twist: Twist, after: Pose) -> Pose:
        """What the effects on the step make of the pose after it."""
        x = self._model.corrected(self._array([before]), self._array([twist]), self._array([after]), self._reached)
        return float(x[0, 0]), float(x[0, 1]), float(x[0, 2])

    def measured(self, pose: Pose) -> Pose:
        """What the effects on sensors make of the pose."""
        x = self._model.measured(self._array([pose]))
        return float(x[0, 0]), float(x[0, 1]), float(x[0, 2])


def _slip_patch(x: float, y: float, radius: float, gain: float) -> Fault:
    def act(pose: Pose, twist: Twist) -> Twist:
        inside = math.hypot(pose[0] - x, pose[1] - y) < radius
        return (gain * twist[0], gain * twist[1]) if inside else twist

    return act


def _heading_ripple(amplitude: float, waves: float) -> Fault:
    def act(pose: Pose, twist: Twist) -> Twist:
        return twist[0], twist[1] + amplitude * twist[0] * math.sin(waves * pose[2])

    return act


_OWN: dict[str, tuple[Callable[..., Fault], tuple[str, ...]]] = {
    "slip_patch": (_slip_patch, ("x", "y", "radius", "gain")),
    "heading_ripple": (_heading_ripple, ("amplitude", "waves")),
}


def _own(name: str, parameters: dict[str, Any], text: str) -> Fault:
    make, wanted = _OWN[name]
    if set(parameters) != set(wanted) or not all(isinstance(value, float) and math.isfinite(value) for value in parameters.values()):
        raise ConfigError(f"effect {text!r}: {name} takes the numbers {', '.join(wanted)}")
    return make(**parameters)
