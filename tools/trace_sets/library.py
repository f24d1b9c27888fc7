"""The physics of the effects that a tracer should know by name, said a second time.

One class an effect, in parts of time where the library filters whole steps. Names, parameters, signs and units are the
library's: a deadband is zero within ± width and u ∓ width outside; a backlash's width is the whole play; offsets are measured minus
true; times count from the recording's first stamp; friction on the double integrator is per unit mass.
"""

from __future__ import annotations

import math
from typing import Any

from trace_sets.plants import Numbers, Plant
from trace_sets.world import Moment, TruthEffect

Values = dict[str, Any]


class OnInput(TruthEffect):
    """On one input, or on all (`*`)."""

    def __init__(self, plant: Plant, channel: str, p: Values) -> None:
        self.p = p
        self.plant = plant
        self.columns = list(range(len(plant.inputs))) if channel == "*" else [plant.inputs.index(channel)]

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        for place, j in enumerate(self.columns):
            a[j] = self.one(s, a[j], m, place)

    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        """u -> what acts."""
        return u


class Gain(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return self.p["gain"] * u


class GainAsymmetry(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return u * (self.p["gain_positive"] if u > 0.0 else self.p["gain_negative"])


class Bias(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return u + self.p["bias"]


class Delay(OnInput):
    """Reads the command itself, so it stands first on its channel."""

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        for j in self.columns:
            a[j] = s.command(j, self.p["delay"] / s.world.h)


class Lag(OnInput):
    def memory(self) -> Numbers:
        return [0.0] * len(self.columns)

    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        time_constant = self.p["time_constant"]
        keep = math.exp(-s.h / time_constant)
        before = m[place]
        m[place] = u + (before - u) * keep
        return u + (before - u) * (1.0 - keep) * time_constant / s.h


class RateLimit(OnInput):
    def memory(self) -> Numbers:
        return [0.0] * len(self.columns)

    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        up = self.p["rate"] * s.h
        down = self.p.get("rate_down", self.p["rate"]) * s.h
        before = m[place]
        m[place] = before + min(max(u - before, -down), up)
        return 0.5 * (before + m[place])


class Saturation(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return min(max(u, self.p["low"]), self.p["high"])


class WheelSaturation(OnInput):
    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        limit, track = self.p["speed"], self.p["track"]
        left = min(max(a[0] - 0.5 * track * a[1], -limit), limit)
        right = min(max(a[0] + 0.5 * track * a[1], -limit), limit)
        a[0], a[1] = 0.5 * (left + right), (right - left) / track


class Deadband(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return math.copysign(max(abs(u) - self.p["width"], 0.0), u)


class Backlash(OnInput):
    """The output stays until the input has crossed the play, and then is dragged along half a play behind it."""

    def memory(self) -> Numbers:
        return [0.0] * len(self.columns)

    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        half = 0.5 * self.p["width"]
        m[place] = min(max(m[place], u - half), u + half)
        return m[place]


class Coupling(OnInput):
    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        a[self.columns[0]] += self.p["coefficient"] * a[self.plant.inputs.index(self.p["from"])]


class GainDrift(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return u * (1.0 + self.p["rate"] * s.t)


class RegimeChange(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return u * (self.p["gain"] if s.t >= self.p["time"] else 1.0)


class Periodic(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        middle = s.t + 0.5 * s.h
        return u + self.p["amplitude"] * math.sin(math.tau * self.p["frequency"] * middle + self.p["phase"])


class InputDrag(OnInput):
    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        return u - self.p["coefficient"] * u * abs(u)


class MassChange(OnInput):
    """The same force on another mass: as if the force were smaller."""

    def one(self, s: Moment, u: float, m: Numbers, place: int) -> float:
        ratio = self.p["ratio"] if "ratio" in self.p else self.p["mass"] / self.plant.parameters["mass"]
        return u / ratio


class OnPlant(TruthEffect):
    """Acts on the motion."""

    def __init__(self, plant: Plant, channel: str, p: Values) -> None:
        self.p = p
        self.plant = plant
        self.channel = channel
        self.mass = plant.parameters.get("mass", 1.0)
        self.axis = (
            plant.velocity.index(plant.states.index(channel))
            if channel in plant.states and plant.states.index(channel) in plant.velocity
            else -1
        )


class ConstantDisturbance(OnPlant):
    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        if self.channel == "world":
            q[3] += self.p["x"]
            q[4] += self.p["y"]
        else:
            q[0] += self.p["x"]
            q[2] += self.p["y"]

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        q[0] += self.p["x"] / self.mass
        if len(q) > 1:
            q[1] += self.p["y"]


class Slope(OnPlant):
    """Speed (or acceleration) along the body from a tilt of the world."""

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        heading = x[2] + 0.5 * s.h * q[1] if s.frozen is None else s.frozen  # that of the part's move
        q[0] += self.p["x"] * math.cos(heading) + self.p["y"] * math.sin(heading)


class LateralSlip(OnPlant):
    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        q[2] += self.p["coefficient"] * q[0] * q[1]


class LongitudinalSlip(OnPlant):
    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        q[0] *= 1.0 - self.p["ratio"]


class TrackScale(OnPlant):
    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        q[1] *= self.p["gain"]


class Understeer(OnPlant):
    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        base = self.plant.parameters["wheel_base"]
        q[1] *= base / (base + self.p["coefficient"] * q[0] * q[0])


class PositionField(OnPlant):
    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        (a, b), (c, d) = self.p["matrix"]
        q[3] += a * x[0] + b * x[1]
        q[4] += c * x[0] + d * x[1]


class Viscous(OnPlant):
    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        v = x[self.plant.axes + self.axis]
        c = self.p["coefficient"] if "coefficient" in self.p else self.p["coefficient_positive" if v > 0.0 else "coefficient_negative"]
        q[self.axis] -= c * v / self.mass


class Drag(OnPlant):
    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        v = x[self.plant.axes + self.axis]
        q[self.axis] -= self.p["coefficient"] * v * abs(v) / self.mass


class Coulomb(OnPlant):
    def dry(self, s: Moment, x: Numbers, axis: int, speed: float) -> float:
        if axis != self.axis:
            return 0.0
        force = self.p["force"] if "force" in self.p else self.p["force_positive" if speed > 0.0 else "force_negative"]
        return force / self.mass


class Stribeck(OnPlant):
    def dry(self, s: Moment, x: Numbers, axis: int, speed: float) -> float:
        if axis != self.axis:
            return 0.0
        more = (self.p["static_force"] - self.p["force"]) * math.exp(-((speed / self.p["velocity"]) ** 2))
        return (self.p["force"] + more) / self.mass


class CubicStiffness(OnPlant):
    def __init__(self, plant: Plant, channel: str, p: Values) -> None:
        super().__init__(plant, channel, p)
        self.axis = plant.states.index(channel)

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        q[self.axis] -= self.p["coefficient"] * x[self.axis] ** 3 / self.mass


class Offset(OnPlant):
    """Of a sensor: measured minus true."""

    def __init__(self, plant: Plant, channel: str, p: Values) -> None:
        super().__init__(plant, channel, p)
        self.state = plant.states.index(channel)
        self.off = p["angle"] if "angle" in p else p["offset"]

    def to_measured(self, x: Numbers, t: float) -> Numbers:
        y = list(x)
        y[self.state] += self.off
        return y

    def to_true(self, x: Numbers, t: float) -> Numbers:
        y = list(x)
        y[self.state] -= self.off
        return y


class LeverArm(OnPlant):
    """The measured point lies at (x, y) in the body."""

    def _shifted(self, x: Numbers, sign: float) -> Numbers:
        c, s = math.cos(x[2]), math.sin(x[2])
        return [x[0] + sign * (self.p["x"] * c - self.p["y"] * s), x[1] + sign * (self.p["x"] * s + self.p["y"] * c), *x[2:]]

    def to_measured(self, x: Numbers, t: float) -> Numbers:
        return self._shifted(x, 1.0)

    def to_true(self, x: Numbers, t: float) -> Numbers:
        return self._shifted(x, -1.0)


PHYSICS: dict[str, type[OnInput] | type[OnPlant]] = {
    "input_gain": Gain,
    "input_gain_asymmetry": GainAsymmetry,
    "input_bias": Bias,
    "input_delay": Delay,
    "input_lag": Lag,
    "input_rate_limit": RateLimit,
    "input_saturation": Saturation,
    "wheel_saturation": WheelSaturation,
    "input_deadband": Deadband,
    "input_backlash": Backlash,
    "input_coupling": Coupling,
    "input_gain_drift": GainDrift,
    "regime_change": RegimeChange,
    "periodic_disturbance": Periodic,
    "mass_change": MassChange,
    "viscous_friction": Viscous,
    "coulomb_friction": Coulomb,
    "stribeck_friction": Stribeck,
    "cubic_stiffness": CubicStiffness,
    "constant_disturbance": ConstantDisturbance,
    "gravity_slope": Slope,
    "lateral_slip": LateralSlip,
    "longitudinal_slip": LongitudinalSlip,
    "track_scale": TrackScale,
    "understeer": Understeer,
    "heading_offset": Offset,
    "sensor_offset": Offset,
    "sensor_lever_arm": LeverArm,
    "position_field": PositionField,
}
"""Name -> class. `quadratic_drag` is two: on an input, and on a velocity state. `integration_scheme` is a property of the World."""


def physics(plant: Plant, name: str, channel: str, p: Values) -> TruthEffect:
    """The effect as something that happens to the plant."""
    if name == "quadratic_drag":
        return InputDrag(plant, channel, p) if channel in plant.inputs else Drag(plant, channel, p)
    return PHYSICS[name](plant, channel, p)
