"""Kinds of the families `unopened` on robots with a heading. Never to be opened by whoever changes the tracer (unopened.py)."""

from __future__ import annotations

import math

import numpy as np

from trace_sets.plants import Numbers
from trace_sets.scale import Scale
from trace_sets.unopened_kinds import Drawn, Kind, per_input, runge_kutta
from trace_sets.world import Moment, TruthEffect

Rng = np.random.Generator

G = 9.81
"""m/s²."""


class BatterySag(TruthEffect):
    """Open-loop motor speed follows the battery's terminal voltage, of an equivalent circuit with one RC pair.

    z' = (r1 p - z) / tau,   u' = (1 - r0 p - z) u,   p = mean over inputs of |u| / u_max (share of full load)

    r0, r1: relative drops at full load, ohmic and by polarisation. Source: Chen, Rincón-Mora, "Accurate electrical battery model
    capable of predicting runtime and I-V performance", IEEE Trans. Energy Conversion 21(2), 2006: polarisation of seconds to minutes.
    """

    def __init__(self, r0: float, r1: float, tau: float, most: Numbers) -> None:
        self.r0, self.r1, self.tau, self.most = r0, r1, tau, most

    def memory(self) -> Numbers:
        return [0.0]

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        load = sum(abs(u) / most for u, most in zip(a, self.most, strict=True)) / len(a)
        goal = self.r1 * load
        middle = goal + (m[0] - goal) * math.exp(-0.5 * s.h / self.tau)
        m[0] = goal + (m[0] - goal) * math.exp(-s.h / self.tau)
        for j in range(len(a)):
            a[j] *= 1.0 - self.r0 * load - middle


def battery_sag(rng: Rng, s: Scale) -> Drawn:
    r0, r1, tau = float(rng.uniform(0.04, 0.12)), float(rng.uniform(0.05, 0.15)), float(rng.uniform(3.0, 30.0))
    product = "*".join(s.plant.inputs)
    states = tuple(s.plant.states[i] for i in s.plant.reached)
    return Drawn(
        BatterySag(r0, r1, tau, [r.size for r in s.ranges]),
        "the battery's voltage sags with the load, at once and over some seconds, and both drives slow down",
        (*per_input(s, "{c}", "memory({c})"), product, *states),
        {"r0": r0, "r1": r1, "time_constant_s": tau},
    )


class CastorSwing(TruthEffect):
    """A passive castor ahead of the driven axle swings round when the robot reverses or turns; its rolling resistance pulls aside.

    beta' = (a w cos(beta) - v sin(beta)) / d - w,   q = tanh(roll / v0),   roll = v cos(beta) + a w sin(beta)
    v  -> v - k_v q cos(beta),   w -> w - k_w q sin(beta)

    beta: its rolling direction in the body; a: pivot ahead of the axle, d: trail, m. k_v, k_w: speed droop of the motors under
    that load. Source: Campion, Bastin, d'Andréa-Novel, "Structural properties and classification of kinematic and dynamic models of
    wheeled mobile robots", IEEE TRA 12(1), 1996 (castor constraint).
    """

    def __init__(self, ahead: float, trail: float, k_v: float, k_w: float, v0: float) -> None:
        self.ahead, self.trail, self.k_v, self.k_w, self.v0 = ahead, trail, k_v, k_w, v0

    def memory(self) -> Numbers:
        return [0.3]

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        v, w = q[0], q[1]

        def rate(b: Numbers) -> Numbers:
            return [(self.ahead * w * math.cos(b[0]) - v * math.sin(b[0])) / self.trail - w]

        middle = runge_kutta(rate, m, 0.5 * s.h)
        m[:] = runge_kutta(rate, middle, 0.5 * s.h)
        c, sine = math.cos(middle[0]), math.sin(middle[0])
        rolls = math.tanh((v * c + self.ahead * w * sine) / self.v0)
        q[0] -= self.k_v * rolls * c
        q[1] -= self.k_w * rolls * sine


def castor_swing(rng: Rng, s: Scale) -> Drawn:
    trail = s.speed * float(rng.uniform(0.06, 0.15))
    ahead = trail * float(rng.uniform(3.0, 6.0))
    k_v, k_w = s.speed * float(rng.uniform(0.01, 0.03)), s.yaw * float(rng.uniform(0.04, 0.12))
    product = "*".join(s.plant.inputs)
    states = tuple(s.plant.states[i] for i in s.plant.reached)
    return Drawn(
        CastorSwing(ahead, trail, k_v, k_w, 0.03 * s.speed),
        "a castor wheel swings round after every reversal and pulls the nose aside until it trails",
        (*per_input(s, "{c}", "memory({c})"), product, *states),
        {"ahead_m": ahead, "trail_m": trail, "speed_loss": k_v, "yaw_loss": k_w},
    )


class EccentricWheel(TruthEffect):
    """One drive wheel is not mounted at its centre: its effective radius changes once a turn, as the wheel's angle goes.

    psi' = omega,   travel of that wheel times 1 + e cos(psi)

    Source: Borenstein, Feng, "Measurement and correction of systematic odometry errors in mobile robots", IEEE TRA 12(6), 1996
    (wheels out of round or off centre).
    """

    def __init__(self, wheel: int, share: float, phase: float, radius: float, track: float) -> None:
        self.wheel, self.share, self.phase, self.radius, self.track = wheel, share, phase, radius, track

    def memory(self) -> Numbers:
        return [self.phase]

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        omega = s.acting[self.wheel]
        more = self.radius * omega * self.share * math.cos(m[0] + 0.5 * s.h * omega)
        m[0] += s.h * omega
        q[0] += 0.5 * more
        q[1] += (more if self.wheel else -more) / self.track


def eccentric_wheel(rng: Rng, s: Scale) -> Drawn:
    wheel, share, phase = int(rng.integers(2)), float(rng.uniform(0.015, 0.06)), float(rng.uniform(-math.pi, math.pi))
    channel = s.plant.inputs[wheel]
    radius, track = s.plant.parameters["wheel_radius"], s.plant.parameters["track"]
    return Drawn(
        EccentricWheel(wheel, share, phase, radius, track),
        f"the wheel of {channel} is mounted off its centre: its radius changes once a turn",
        (channel, f"memory({channel})", s.plant.states[3 + wheel]),
        {"share": share, "phase_rad": phase, "wheel": float(wheel)},
    )


class CompassDeviation(TruthEffect):
    """The heading comes from a magnetometer near iron: measured = theta + b sin + c cos + d sin 2 theta + e cos 2 theta.

    Source: NGA, "Handbook of Magnetic Compass Adjustment", Pub. 226, 2004 (coefficients B to E; hard and soft iron).
    """

    def __init__(self, b: float, c: float, d: float, e: float) -> None:
        self.b, self.c, self.d, self.e = b, c, d, e

    def _off(self, theta: float) -> float:
        first = self.b * math.sin(theta) + self.c * math.cos(theta)
        return first + self.d * math.sin(2.0 * theta) + self.e * math.cos(2.0 * theta)

    def to_measured(self, x: Numbers, t: float) -> Numbers:
        return [*x[:2], x[2] + self._off(x[2]), *x[3:]]

    def to_true(self, x: Numbers, t: float) -> Numbers:
        theta = x[2]
        for _ in range(60):  # contracts: the deviation's slope is well below 1
            theta = x[2] - self._off(theta)
        return [*x[:2], theta, *x[3:]]


def compass_deviation(rng: Rng, s: Scale) -> Drawn:
    hard, soft = math.radians(rng.uniform(2.0, 10.0)), math.radians(rng.uniform(0.5, 3.0))
    where, round_ = float(rng.uniform(0.0, math.tau)), float(rng.uniform(0.0, math.tau))
    b, c, d, e = hard * math.cos(where), hard * math.sin(where), soft * math.cos(round_), soft * math.sin(round_)
    return Drawn(
        CompassDeviation(b, c, d, e),
        "the heading is a compass's near iron: its error changes with the heading",
        ("heading",),
        {"B_rad": b, "C_rad": c, "D_rad": d, "E_rad": e},
    )


class LensDistortion(TruthEffect):
    """A camera above the floor measures the position; its lens is not fully corrected: p' = c + (p - c) (1 + k |p - c|²).

    Source: Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971 (radial distortion, first term).
    """

    def __init__(self, x: float, y: float, k: float) -> None:
        self.x, self.y, self.k = x, y, k

    def to_measured(self, x: Numbers, t: float) -> Numbers:
        dx, dy = x[0] - self.x, x[1] - self.y
        scale = 1.0 + self.k * (dx * dx + dy * dy)
        return [self.x + dx * scale, self.y + dy * scale, *x[2:]]

    def to_true(self, x: Numbers, t: float) -> Numbers:
        dx, dy = x[0] - self.x, x[1] - self.y
        far = math.hypot(dx, dy)
        r = far
        for _ in range(40):  # Newton; the distortion grows with the distance
            r -= (r + self.k * r**3 - far) / (1.0 + 3.0 * self.k * r * r)
        share = r / far if far > 1e-12 else 1.0
        return [self.x + dx * share, self.y + dy * share, *x[2:]]


def lens_distortion(rng: Rng, s: Scale) -> Drawn:
    reach = s.speed * max(s.pace, 8.0 * s.dt) + 0.5 * min(2.0, s.speed * min(2.0 * s.pace, 0.25 * s.duration))
    k = float(rng.uniform(0.015, 0.06)) / reach**2
    x, y = (float(rng.uniform(-0.4, 0.4)) * reach for _ in range(2))
    return Drawn(
        LensDistortion(x, y, k),
        "a camera above measures the position, and its lens stretches the picture toward the edges",
        ("position",),
        {"x_m": x, "y_m": y, "k_per_m2": k},
        law="closed",
    )


class CurveGovernor(TruthEffect):
    """Firmware slows the robot in curves so that the lateral acceleration stays below a limit: |v| <= a_max / |w|.

    Trucks that carry loads have such a limit for their stability. A like rule, by curvature: Macenski, Singh, Martín, Ginés, "Regulated
    pure pursuit for robot path tracking", Autonomous Robots 47, 2023.
    """

    def __init__(self, most: float) -> None:
        self.most = most

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        if abs(a[0] * a[1]) > self.most:
            a[0] = math.copysign(self.most / abs(a[1]), a[0])


def curve_governor(rng: Rng, s: Scale) -> Drawn:
    most = float(rng.uniform(0.15, 0.5)) * s.speed * s.ranges[1].size
    return Drawn(
        CurveGovernor(most),
        "firmware slows the robot in curves to keep the lateral acceleration below a limit",
        ("v*w", "v", "w"),
        {"acceleration": most},
    )


class MastSway(TruthEffect):
    """What is measured is a marker on a flexible mast: its speed ahead e follows the base's v as a lightly damped oscillator.

    d' = e - v,   e' = -omega² d - 2 zeta omega (e - v)

    d: the marker ahead of its place on the base, m. Source: base-excited oscillator, Meirovitch, "Fundamentals of Vibrations", 2001
    (base motion). The mast bends lengthwise only; that the body turns meanwhile is not carried over to d.
    """

    def __init__(self, frequency: float, damping: float) -> None:
        self.omega, self.damping = math.tau * frequency, damping

    def memory(self) -> Numbers:
        return [0.0, 0.0]

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        v = q[0]

        def rate(z: Numbers) -> Numbers:
            return [z[1] - v, -(self.omega**2) * z[0] - 2.0 * self.damping * self.omega * (z[1] - v)]

        before = m[0]
        m[:] = runge_kutta(rate, m, s.h)
        q[0] += (m[0] - before) / s.h


def mast_sway(rng: Rng, s: Scale) -> Drawn:
    frequency = min(float(rng.uniform(1.0, 5.0)), 0.3 / s.dt)
    damping = float(rng.uniform(0.03, 0.2))
    return Drawn(
        MastSway(frequency, damping),
        "the tracked marker sits on a mast that sways when the robot speeds up or brakes",
        per_input(s, "{c}", "memory({c})"),
        {"frequency_hz": frequency, "damping": damping},
    )


class TyreRelaxation(TruthEffect):
    """A tyre's side force builds up over a distance: the steering acts as delta, with delta' = |v| / sigma (steer - delta).

    Source: Pacejka, "Tyre and Vehicle Dynamics", 2012 (relaxation length); Rajamani, "Vehicle Dynamics and Control", 2012.
    """

    def __init__(self, length: float) -> None:
        self.length = length

    def memory(self) -> Numbers:
        return [0.0]

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        goal, share = a[0], abs(a[1]) * s.h / self.length
        a[0] = goal + (m[0] - goal) * math.exp(-0.5 * share)
        m[0] = goal + (m[0] - goal) * math.exp(-share)


def tyre_relaxation(rng: Rng, s: Scale) -> Drawn:
    length = float(rng.uniform(0.15, 0.4)) * s.plant.parameters["wheel_base"]
    return Drawn(
        TyreRelaxation(length),
        "side force of the front tyres builds up over a distance rolled, so steering is delayed, the more so at low speed",
        ("memory(steer_cmd)", "steer_cmd", "steer_cmd*speed_cmd"),
        {"relaxation_length_m": length},
    )


class GripLimit(TruthEffect):
    """Tyres give no more side force than the road's grip: a = v w saturates at mu g, smoothly as a brush tyre does.

    w -> w / (1 + (v w / (mu g))⁴)^(1/4).   Source: Rajamani, "Vehicle Dynamics and Control", 2012 (brush model; the yaw rate
    that the road allows, mu g / v).
    """

    def __init__(self, mu: float) -> None:
        self.most = mu * G

    def turn(self, s: Moment, x: Numbers, q: Numbers, m: Numbers) -> None:
        q[1] /= (1.0 + (q[0] * q[1] / self.most) ** 4) ** 0.25


def grip_limit(rng: Rng, s: Scale) -> Drawn:
    mu = float(rng.uniform(0.15, 0.8))
    return Drawn(
        GripLimit(mu),
        "the tyres reach the road's grip in fast curves, and the car turns no faster",
        ("steer_cmd*speed_cmd", "steer_cmd", "speed_cmd", "speed"),
        {"friction": mu},
    )


class SteeringLinkage(TruthEffect):
    """A servo's horn pulls a tie rod and does not stand square to it: delta = asin((sin(u + s0) - sin s0) / cos s0).

    Right for small angles; s0: how far the horn is off square. Source: slider-crank displacement, Norton, "Design of Machinery", 2012,
    with a long rod.
    """

    def __init__(self, off: float) -> None:
        self.off = off

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        share = (math.sin(a[0] + self.off) - math.sin(self.off)) / math.cos(self.off)
        a[0] = math.asin(min(max(share, -1.0), 1.0))


def steering_linkage(rng: Rng, s: Scale) -> Drawn:
    off = math.radians(rng.uniform(6.0, 25.0)) * float(rng.choice([-1.0, 1.0]))
    return Drawn(
        SteeringLinkage(off),
        "the steering servo's horn is not square to its rod: the wheel angle is a curved function of the command",
        ("steer_cmd", "steer_cmd*speed_cmd"),
        {"off_square_rad": off},
    )


WHEELED = ("unicycle", "differential_drive")

POSES: tuple[Kind, ...] = (
    Kind(WHEELED, battery_sag),
    Kind(WHEELED, castor_swing),
    Kind(("differential_drive",), eccentric_wheel),
    Kind(("unicycle", "bicycle", "differential_drive"), compass_deviation),
    Kind(WHEELED, lens_distortion),
    Kind(("unicycle",), curve_governor),
    Kind(WHEELED, mast_sway),
    Kind(("bicycle",), tyre_relaxation),
    Kind(("bicycle",), grip_limit),
    Kind(("bicycle",), steering_linkage),
)
"""In numerical order."""
