"""Floors, winds and sensors that no effect of the library names, though the tracer knows them unnamed: they change motion or readings."""

from __future__ import annotations

import math

from trace_sets.outside_shapes import Drawn, Pushing, Rng, Turning, either, usual_acceleration, usual_way
from trace_sets.plants import Numbers
from trace_sets.scale import Scale, log_uniform
from trace_sets.world import Moment, TruthEffect


def slip_patches(rng: Rng, s: Scale, size: float) -> Drawn:
    """Wheels slip on parts of the floor: stripes, so that every drive crosses some."""
    angle, loss = float(rng.uniform(-math.pi, math.pi)), min(0.4 * size, 0.8)
    wide = usual_way(s) * float(rng.uniform(0.4, 0.9))
    ax, ay, phase = math.tau * math.cos(angle) / wide, math.tau * math.sin(angle) / wide, float(rng.uniform(-3.0, 3.0))

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        if math.sin(ax * x[0] + ay * x[1] + phase) > 0.2:
            q[0] *= 1.0 - loss

    return Turning(f), {"position", "x", "y"}, {"loss": loss, "angle": angle, "wide": wide}


def heading_drag(rng: Rng, s: Scale, size: float) -> Drawn:
    """A carpet's pile: slower along one direction."""
    pile, loss = float(rng.uniform(-math.pi, math.pi)), min(0.35 * size, 0.9)

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        q[0] *= 1.0 - loss * max(math.cos(x[2] - pile), 0.0)

    return Turning(f), {"heading", "theta"}, {"loss": loss, "direction": pile}


def magnetic_floor(rng: Rng, s: Scale, size: float) -> Drawn:
    """The heading is pulled to a direction (a cable, a current over a hull)."""
    direction, pull = float(rng.uniform(-math.pi, math.pi)), size * 0.3 * max(s.yaw, 0.3)

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        q[1] -= pull * math.sin(2.0 * (x[2] - direction))

    return Turning(f), {"heading", "theta"}, {"pull": pull, "direction": direction}


def rolling_floor(rng: Rng, s: Scale, size: float) -> Drawn:
    """How well it turns changes smoothly over the floor."""
    wide, share = usual_way(s) * float(rng.uniform(0.6, 1.5)), min(0.5 * size, 0.9)

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        q[1] *= 1.0 - share * math.sin(math.tau * x[0] / wide) * math.cos(math.tau * x[1] / wide)

    return Turning(f), {"position", "x", "y"}, {"share": share, "wide": wide}


def spin_drift(rng: Rng, s: Scale, size: float) -> Drawn:
    """Castors: it goes sideways with the square of the yaw rate."""
    c = either(rng) * size * 0.3 * s.speed / max(s.yaw, 0.3) ** 2

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        q[2] += c * q[1] * abs(q[1])

    tokens = {s.plant.inputs[1]} if s.plant.name == "unicycle" else {*s.plant.inputs, *_products(s)}
    return Turning(f), tokens, {"coefficient": c}


def _products(s: Scale) -> set[str]:
    return {f"{a}*{b}" for a in s.plant.inputs for b in s.plant.inputs}


def gusts(rng: Rng, s: Scale, size: float) -> Drawn:
    """Wind that comes and goes, whatever is asked."""
    count = int(rng.integers(4, 10))
    begins, length = (s.duration * rng.uniform(0.0, 0.95, count)).tolist(), 0.05 * s.duration
    strong = size * 0.3 * (s.speed if s.plant.pose else usual_acceleration(s))
    angles = rng.uniform(-math.pi, math.pi, count).tolist()

    def wind(m: Moment) -> tuple[float, float]:
        blowing = [a for b, a in zip(begins, angles, strict=True) if b <= m.t < b + length]
        return strong * sum(math.cos(a) for a in blowing), strong * sum(math.sin(a) for a in blowing)

    def turn(m: Moment, x: Numbers, q: Numbers) -> None:
        east, north = wind(m)
        q[3] += east
        q[4] += north

    def push(m: Moment, x: Numbers, q: Numbers) -> None:
        for j, value in enumerate(wind(m)[: len(q)]):
            q[j] += value

    effect: TruthEffect = Turning(turn) if s.plant.pose else Pushing(push)
    return effect, {"time", "noise", "constant"}, {"speed": strong, "begins": begins}


def swell(rng: Rng, s: Scale, size: float) -> Drawn:
    """The ground tilts to and fro: a slope that varies with time."""
    frequency = log_uniform(rng, 2.5, 12.0) / s.duration
    strong = size * 0.35 * (s.speed if s.plant.pose else usual_acceleration(s))
    angle = float(rng.uniform(-math.pi, math.pi))

    def turn(m: Moment, x: Numbers, q: Numbers) -> None:
        q[0] += strong * math.sin(math.tau * frequency * m.t) * math.cos(x[2] - angle)

    def push(m: Moment, x: Numbers, q: Numbers) -> None:
        size_now = strong * math.sin(math.tau * frequency * m.t) * (1.0 + 0.5 * math.sin(0.37 * math.tau * frequency * m.t))
        q[0] += size_now * (math.cos(angle) if len(q) > 1 else 1.0)
        if len(q) > 1:
            q[1] += size_now * math.sin(angle)

    effect: TruthEffect = Turning(turn) if s.plant.pose else Pushing(push)
    return effect, {"time", "heading", "theta", "noise"} if s.plant.pose else {"time", "noise"}, {"frequency": frequency, "strong": strong}


def rough_place(rng: Rng, s: Scale, size: float) -> Drawn:
    """Friction that depends on where the mass is."""
    n = s.plant.axes
    span = 1.5 * s.speed * s.pace
    c = size * 0.8 * usual_acceleration(s) / s.speed

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        for j in range(n):
            q[j] -= c * (0.5 + 0.5 * math.tanh(2.0 * x[0] / span)) * x[n + j]

    tokens = {"position", s.plant.states[0], "speed", *s.plant.states[n:]}
    return Pushing(f), tokens, {"coefficient": c, "span": span}


def cogging(rng: Rng, s: Scale, size: float) -> Drawn:
    """A force that alternates over the way."""
    span = 1.5 * s.speed * s.pace * float(rng.uniform(0.5, 1.2))
    c = size * 0.3 * usual_acceleration(s)

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        q[0] -= c * math.sin(math.tau * x[0] / span)

    return Pushing(f), {"position", s.plant.states[0]}, {"amplitude": c, "span": span}


def steep_drag(rng: Rng, s: Scale, size: float) -> Drawn:
    """Drag with the fifth power of the speed: nothing at first, a wall then."""
    n = s.plant.axes
    c = size * usual_acceleration(s) / s.speed**5

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        for j in range(n):
            v = x[n + j]
            q[j] -= min(c * abs(v) ** 5, 0.1 * abs(v) / m.world.h) * math.copysign(1.0, v)

    return Pushing(f), {"speed", *s.plant.states[n:]}, {"coefficient": c}


def gyroscopic(rng: Rng, s: Scale, size: float) -> Drawn:
    """Each axis is pushed by the other's speed."""
    c = either(rng) * size * 0.5 * usual_acceleration(s) / s.speed

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        vx, vy = x[2], x[3]
        q[0] -= c * vy
        q[1] += c * vx

    return Pushing(f), {"speed", "vx", "vy"}, {"coefficient": c}


def spring_with_end(rng: Rng, s: Scale, size: float) -> Drawn:
    """A bumper: nothing, and from a place on a stiff spring."""
    span = float(rng.uniform(0.2, 0.6)) * s.speed * s.pace
    k = size * 1.5 * usual_acceleration(s) / (s.speed * s.pace)

    def f(m: Moment, x: Numbers, q: Numbers) -> None:
        q[0] -= k * max(x[0] - span, 0.0)

    return Pushing(f), {"position", s.plant.states[0]}, {"stiffness": k, "from": span}


class DriftingHeading(TruthEffect):
    """A gyroscope's heading that leaves the true one steadily: measured = true + rate t."""

    def __init__(self, rate: float) -> None:
        self.rate = rate

    def to_measured(self, x: Numbers, t: float) -> Numbers:
        return [x[0], x[1], x[2] + self.rate * t, *x[3:]]

    def to_true(self, x: Numbers, t: float) -> Numbers:
        return [x[0], x[1], x[2] - self.rate * t, *x[3:]]


def gyro_drift(rng: Rng, s: Scale, size: float) -> Drawn:
    """A heading that drifts."""
    rate = either(rng) * min(size * float(rng.uniform(0.5, 1.5)), 3.0) / s.duration
    speeds = set(s.plant.inputs)
    return DriftingHeading(rate), {"time", "heading", "theta", "constant", *(f"time*{u}" for u in speeds)}, {"rate": rate}


class Lens(TruthEffect):
    """A camera above: measured position = true position (1 + k r²), about the origin."""

    def __init__(self, k: float) -> None:
        self.k = k

    def to_measured(self, x: Numbers, t: float) -> Numbers:
        grow = 1.0 + self.k * (x[0] ** 2 + x[1] ** 2)
        return [x[0] * grow, x[1] * grow, *x[2:]]

    def to_true(self, x: Numbers, t: float) -> Numbers:
        far = math.hypot(x[0], x[1])
        r = far
        for _ in range(60):  # r (1 + k r²) = far, by Newton
            r -= (r + self.k * r**3 - far) / (1.0 + 3.0 * self.k * r * r)
        share = r / far if far > 0.0 else 1.0
        return [x[0] * share, x[1] * share, *x[2:]]


def lens(rng: Rng, s: Scale, size: float) -> Drawn:
    """A lens that stretches what is far from its middle."""
    wide = 2.0 * usual_way(s)
    k = min(0.3 * size, 3.0) / wide**2
    return Lens(k), {"position", "x", "y"}, {"k": k}
