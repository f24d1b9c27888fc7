"""The stand-in base as a body: two driven wheels that follow their commands, and what is measured of them.

One period of dt, for commanded wheel speeds u = (left, right) in rad/s:

    latency    u acts `latency` periods after it was given
    effects    what is wrong with this base and stands in no data sheet: inputs first, the step's after the motion, a sensor's last
    wheels     time_constant s' = u - s, exact for u constant over the period, each wheel clipped to +-wheel_limit
    motion     v = R (left + right) / 2, w = R (right - left) / track with the means over the period; along their arc

    observation = pose and wheel speeds + noise

Scalar arithmetic of its own, so that it shares no mistake with the runtime's models; the undeclared effects are the runtime's library.
"""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING, Any, NamedTuple

from s2r_runtime.errors import ConfigError
from s2r_runtime.modelspec import EffectSpec, ModelSpec

if TYPE_CHECKING:
    from s2r_runtime.models.composed import ComposedModel

Wheels = tuple[float, float]


class Sheet(NamedTuple):
    """What is known about the base. dt, time_constant in s, wheel_radius and track in m, wheel_limit in rad/s, latency in periods."""

    dt: float = 0.02
    wheel_radius: float = 0.1
    track: float = 0.4
    time_constant: float = 0.06
    latency: int = 1
    wheel_limit: float = 15.0
    sigma_position: float = 0.0003
    sigma_heading: float = 0.0005
    sigma_wheel: float = 0.002


class Measured(NamedTuple):
    """x, y m; theta rad in (-pi, pi]; left, right rad/s."""

    x: float
    y: float
    theta: float
    left: float
    right: float


class Base:
    """The robot's truth. start: x, y, theta. effects: `NAME[:CHANNEL] [PARAMETER=VALUE]...`, undeclared."""

    def __init__(self, sheet: Sheet, start: tuple[float, float, float], seed: int) -> None:
        self.sheet, self.pose, self.wheels = sheet, start, (0.0, 0.0)
        self._noise = random.Random(f"{seed}/noise")
        self._pending: list[Wheels] = [(0.0, 0.0)] * sheet.latency
        self._specs: dict[str, EffectSpec] = {}
        self._lacking: ComposedModel | None = None
        self._hidden: Any = ()

    # ------------------------------------------------------------------ what is wrong with it

    def switch_on(self, text: str) -> str:
        """Begins an effect now; one of the same name and channel is replaced. Returns what it is. Raises ConfigError."""
        words = text.split()
        name, _, channel = words[0].partition(":") if words else ("", "", "")
        parameters: dict[str, Any] = {}
        for word in words[1:]:
            key, equals, value = word.partition("=")
            if not equals:
                raise ConfigError(f"effect {text!r}: {word!r} must be PARAMETER=VALUE")
            try:
                parameters[key] = float(value)
            except ValueError:
                parameters[key] = value
        try:
            spec = EffectSpec(name, channel or "*", parameters)
        except ValueError as error:
            raise ConfigError(f"effect {text!r}: {error}") from None
        self._use({**self._specs, f"{name}:{spec.channel}": spec})
        return f"{name}:{spec.channel}"

    def clear(self) -> None:
        """Ends all effects."""
        self._specs, self._lacking = {}, None

    def _use(self, specs: dict[str, EffectSpec]) -> None:
        from s2r_runtime.models.composed import compose  # numpy: a base without such effects does without

        sheet = self.sheet
        parameters = {"wheel_radius": sheet.wheel_radius, "track": sheet.track}
        model = compose(ModelSpec("differential_drive", sheet.dt, parameters, tuple(specs.values())), "base")
        self._specs, self._lacking, self._hidden = specs, model, model.at_rest(1)

    # ------------------------------------------------------------------ one period

    def move(self, command: Wheels) -> None:
        """One period under this command."""
        self._pending.append(command)
        u = self._pending.pop(0)
        if self._lacking is not None:
            u = self._commanded(u)
        sheet = self.sheet
        keep, mean = 0.0, 0.0
        if sheet.time_constant > 0.0:
            ratio = sheet.dt / sheet.time_constant
            keep, mean = math.exp(-ratio), -math.expm1(-ratio) / ratio
        turned, after = [], []
        for s, wanted in zip(self.wheels, u, strict=True):
            wanted = min(max(wanted, -sheet.wheel_limit), sheet.wheel_limit)
            turned.append(wanted + (s - wanted) * mean)
            after.append(wanted + (s - wanted) * keep)
        x, y, theta = self.pose
        way = sheet.dt * sheet.wheel_radius * (turned[0] + turned[1]) / 2.0
        turn = sheet.dt * sheet.wheel_radius * (turned[1] - turned[0]) / sheet.track
        chord = way * (math.sin(turn / 2.0) / (turn / 2.0) if abs(turn) > 1e-9 else 1.0)
        pose = (x + chord * math.cos(theta + turn / 2.0), y + chord * math.sin(theta + turn / 2.0), theta + turn)
        if self._lacking is not None:
            pose = self._corrected((*self.pose, *self.wheels), (turned[0], turned[1]), (*pose, after[0], after[1]))
        self.pose, self.wheels = (pose[0], pose[1], math.remainder(pose[2], 2.0 * math.pi)), (after[0], after[1])

    def observe(self) -> Measured:
        """What is measured now; call once a period."""
        state: tuple[float, ...] = (*self.pose, *self.wheels)
        if self._lacking is not None:
            state = self._sensed(state)
        gauss, s = self._noise.gauss, self.sheet
        x, y = state[0] + gauss(0.0, s.sigma_position), state[1] + gauss(0.0, s.sigma_position)
        theta = math.remainder(state[2] + gauss(0.0, s.sigma_heading), 2.0 * math.pi)
        left, right = state[3] + gauss(0.0, s.sigma_wheel), state[4] + gauss(0.0, s.sigma_wheel)
        return Measured(x, y, theta, left, right)

    # ------------------------------------------------------------------ effects of the library

    def _commanded(self, u: Wheels) -> Wheels:
        import numpy as np

        assert self._lacking is not None  # noqa: S101 - the callers saw to it, here and below
        acting, _, self._hidden = self._lacking.act(np.array([u]), self._hidden)
        return float(acting[0, 0]), float(acting[0, 1])

    def _corrected(self, before: tuple[float, ...], u: Wheels, after: tuple[float, ...]) -> tuple[float, float, float]:
        import numpy as np

        assert self._lacking is not None  # noqa: S101
        m, x = self._lacking, np.array([after])
        for a in m.effects:
            if a.effect.stage == "step":
                x = a.effect.after_step(np.array([before]), np.array([u]), x, m.nominal, a.channel, m.dt, a.p)
        return float(x[0, 0]), float(x[0, 1]), float(x[0, 2])

    def _sensed(self, state: tuple[float, ...]) -> tuple[float, ...]:
        import numpy as np

        assert self._lacking is not None  # noqa: S101
        m, x = self._lacking, np.array([state])
        for a in m.effects:
            if a.effect.stage == "sensor":
                x = a.effect.to_measured(x, m.nominal, a.channel, a.p)
        return tuple(map(float, x[0]))
