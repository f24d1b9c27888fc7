"""The physics of the library's newer effects, written a second time from docs/effects.md: wheels, castor, rear tyres, joints, gears.

One class an effect, in parts of time. Two wheels that move by l and r times what they should: v' = a v + (b track/2) w and
w' = a w + (2 b/track) v, where a = (l + r)/2 and b = (r - l)/2. A castor stands `arm` behind the axle, so that it moves at
s = hypot(v, arm w). The motor behind a gear with backlash carries momentum to the link when it arrives.
"""

from __future__ import annotations

import math
from typing import Any

from trace_sets.library import OnInput, OnPlant, physics
from trace_sets.plants import Numbers, Plant
from trace_sets.world import Moment, TruthEffect

Values = dict[str, Any]


class WheelRadii(OnPlant):
    """Of a robot on two wheels: the wheels' own speeds, as measured, do not change."""

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        track = self.plant.parameters.get("track") or self.p["track"]
        left, right = (q[0] - 0.5 * track * q[1]) * self.p["left"], (q[0] + 0.5 * track * q[1]) * self.p["right"]
        q[0], q[1] = 0.5 * (left + right), (right - left) / track


class CastorDrag(OnPlant):
    """Friction of constant size against the castor's motion."""

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        speed = math.hypot(q[0], self.p["arm"] * q[1])
        if speed < 1e-12:
            return
        share = self.p["loss"] / speed
        lever = self.p["arm"] / self.plant.parameters["track"]
        q[0] *= max(1.0 - share, 0.0)
        q[1] *= max(1.0 - 4.0 * lever * lever * share, 0.0)


class RearSlip(OnPlant):
    """A car's rear tyres give way outwards."""

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        q[2] -= self.p["coefficient"] * q[0] * q[0] * q[1]


class SteeringRatio(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return self.p["ratio"] * u


class SteeringOffset(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return u + self.p["angle"]


class OnPosition(OnPlant):
    """A force that depends on where an axis stands."""

    def __init__(self, plant: Plant, channel: str, p: Values) -> None:
        super().__init__(plant, channel, p)
        self.axis = plant.states.index(channel)

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        q[self.axis] += self.force(x[self.axis]) / self.mass

    def force(self, q: float) -> float:
        """At this position."""
        raise NotImplementedError


class LinkGravity(OnPosition):
    def force(self, q: float) -> float:
        return float(-self.p["torque"] * math.sin(q - self.p["angle"]))


class TorqueRipple(OnPosition):
    def force(self, q: float) -> float:
        return float(self.p["amplitude"] * math.sin(math.tau * q / self.p["period"] + self.p["phase"]))


class LoadFriction(OnPlant):
    """Dry friction of a gear that carries the input's load."""

    def dry(self, s: Moment, x: Numbers, axis: int, speed: float) -> float:
        return float(self.p["coefficient"] * abs(s.acting[axis]) / self.mass) if axis == self.axis else 0.0


class StaticFriction(OnPlant):
    """Dry friction that fades as the axis moves."""

    def dry(self, s: Moment, x: Numbers, axis: int, speed: float) -> float:
        return float(self.p["force"] * math.exp(-((speed / self.p["velocity"]) ** 2)) / self.mass) if axis == self.axis else 0.0


class GearBacklash(OnInput):
    """The link feels nothing while the motor crosses the gap, and all of its momentum when it arrives.

    m: side where motor and link touch (0: in the gap), how far across (0 to width), momentum gathered. While they are apart the
    motor moves against the link with momentum/share of the inertia: the gap in these units is `width`.
    """

    def memory(self) -> Numbers:
        return [1.0, self.p["width"], 0.0]

    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        inertia, width = self.plant.parameters["mass"], self.p["width"]
        side, across, gathered = m
        if side * u >= 0.0 and side != 0.0:
            return u
        after = gathered + u * s.h
        across += 0.5 * s.h * (gathered + after) / inertia
        if 0.0 < across < width:
            m[:] = [0.0, across, after]
            return 0.0
        m[:] = [1.0, width, 0.0] if across >= width else [-1.0, 0.0, 0.0]
        return after / s.h


NEWER: dict[str, type[OnInput] | type[OnPlant]] = {
    "wheel_radius_scale": WheelRadii,
    "castor_drag": CastorDrag,
    "rear_slip": RearSlip,
    "steering_ratio": SteeringRatio,
    "steering_offset": SteeringOffset,
    "link_gravity": LinkGravity,
    "torque_ripple": TorqueRipple,
    "load_friction": LoadFriction,
    "static_friction": StaticFriction,
    "gear_backlash": GearBacklash,
}


def newer_physics(plant: Plant, name: str, channel: str, p: Values) -> TruthEffect:
    """The effect, be it a newer one or not."""
    return NEWER[name](plant, channel, p) if name in NEWER else physics(plant, name, channel, p)
