"""Kinds of the families `unopened` on masses that forces move. Never to be opened by whoever changes the tracer (unopened.py)."""

from __future__ import annotations

import math

import numpy as np

from trace_sets.plants import Numbers
from trace_sets.scale import Scale, log_uniform
from trace_sets.unopened_kinds import Drawn, Kind, per_input, runge_kutta
from trace_sets.world import Moment, TruthEffect

Rng = np.random.Generator


class FlexibleJoint(TruthEffect):
    """Motor and link are two masses with a spring between them (belt, harmonic drive); the link is what is measured.

    e'' = F / m_m - (k e + c e') (1 / m_m + 1 / m_l),   link: m_l q'' = k e + c e',   m_m + m_l = the model's mass

    Source: Spong, "Modeling and control of elastic joint robots", ASME J. Dyn. Syst. Meas. Control 109(4), 1987.
    """

    def __init__(self, motor: float, link: float, frequency: float, damping: float) -> None:
        self.motor, self.link = motor, link
        reduced, omega = motor * link / (motor + link), math.tau * frequency
        self.k, self.c = reduced * omega**2, 2.0 * damping * reduced * omega

    def memory(self) -> Numbers:
        return [0.0, 0.0, 0.0]

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        force = a[0]

        def rate(z: Numbers) -> Numbers:
            spring = self.k * z[0] + self.c * z[1]
            return [z[1], force / self.motor - spring / self.motor - spring / self.link, spring]

        after = runge_kutta(rate, [m[0], m[1], 0.0], s.h)
        m[:] = [after[0], after[1], 0.0]
        a[0] = after[2] / s.h * (self.motor + self.link) / self.link


def flexible_joint(rng: Rng, s: Scale) -> Drawn:
    mass = s.plant.parameters["mass"]
    motor = float(rng.uniform(0.2, 0.6)) * mass
    frequency, damping = min(log_uniform(rng, 3.0, 20.0), 0.4 / s.dt), float(rng.uniform(0.02, 0.12))
    return Drawn(
        FlexibleJoint(motor, mass - motor, frequency, damping),
        "the transmission is elastic: motor and link swing against each other",
        per_input(s, "memory({c})", "{c}"),
        {"motor_mass_kg": motor, "frequency_hz": frequency, "damping": damping},
    )


class Slosh(TruthEffect):
    """A tank is part of the load, and its liquid sloshes as a mass on a spring, one of its own an axis.

    z'' = -a - (2 zeta omega z' + omega² z),   (1 - mu) a = F / m + mu (2 zeta omega z' + omega² z)

    z: liquid against tank; mu: its share of the mass m. Source: Ibrahim, "Liquid Sloshing Dynamics", 2005 (equivalent mechanical
    models). A tank of 0.2 to 1 m sloshes at 2 to 0.8 Hz (omega² = pi g / length where deep), with a damping of 0.5 to 5 %.
    """

    def __init__(self, share: float, frequency: float, damping: float, axes: int) -> None:
        self.share, self.omega, self.damping, self.axes = share, math.tau * frequency, damping, axes

    def memory(self) -> Numbers:
        return [0.0] * (2 * self.axes)

    def act(self, s: Moment, a: Numbers, m: Numbers) -> None:
        for j in range(self.axes):  # a is per unit of mass here or not: all is linear in it
            push = a[j]

            def rate(z: Numbers, push: float = push) -> Numbers:
                back = 2.0 * self.damping * self.omega * z[1] + self.omega**2 * z[0]
                tank = (push + self.share * back) / (1.0 - self.share)
                return [z[1], -tank - back, tank]

            after = runge_kutta(rate, [m[2 * j], m[2 * j + 1], 0.0], s.h)
            m[2 * j], m[2 * j + 1] = after[0], after[1]
            a[j] = after[2] / s.h


def slosh(rng: Rng, s: Scale) -> Drawn:
    share, damping = float(rng.uniform(0.05, 0.3)), float(rng.uniform(0.005, 0.05))
    frequency = float(rng.uniform(0.8, 2.0))
    return Drawn(
        Slosh(share, frequency, damping, s.plant.axes),
        "a half-full tank is part of the load: the liquid sloshes back and forth",
        per_input(s, "memory({c})", "{c}"),
        {"share": share, "frequency_hz": frequency, "damping": damping},
    )


def _mass(s: Scale) -> float:
    return s.plant.parameters.get("mass", 1.0)


class BackEmfLimit(TruthEffect):
    """The supply's voltage limits the motor: no more force than F_s (1 - v / v_n) ahead, nor F_s (1 + v / v_n) back.

    Source: torque-speed line of a DC motor, Fitzgerald, Kingsley, Umans, "Electric Machinery", 2003.
    """

    def __init__(self, stall: float, free: float, mass: float) -> None:
        self.stall, self.free, self.mass = stall, free, mass

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        n = len(q)
        for j in range(n):
            share = x[n + j] / self.free
            force = min(max(s.acting[j], -self.stall * (1.0 + share)), self.stall * (1.0 - share))
            q[j] += (force - s.acting[j]) / self.mass


def back_emf_limit(rng: Rng, s: Scale) -> Drawn:
    stall, free = float(rng.uniform(0.9, 1.5)) * s.ranges[0].size, float(rng.uniform(0.8, 1.8)) * s.speed
    states = [s.plant.states[j] for j in s.plant.velocity]
    own = [token for c, v in zip(s.plant.inputs, states, strict=True) for token in (c, v, f"{c}*{v}", f"{c}*speed")]
    return Drawn(
        BackEmfLimit(stall, free, _mass(s)),
        "the supply's voltage limits the motor: the faster it runs, the less force it can give ahead",
        (*own, "speed"),
        {"stall_force": stall, "free_speed": free},
    )


class GearEfficiency(TruthEffect):
    """A gear loses part of the power that flows through it, whichever way: the load gets eta F while driven, F / eta while it drives.

    F -> F eta^(tanh(v / v0) sign F).   Source: Wang, Kim, "Directional efficiency in geared transmissions: characterization of
    backdrivability towards improved proprioceptive control", IEEE ICRA 2015.
    """

    def __init__(self, efficiency: float, v0: float, mass: float) -> None:
        self.log, self.v0, self.mass = math.log(efficiency), v0, mass

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        force = s.acting[0]
        share = math.exp(self.log * math.tanh(x[1] / self.v0) * math.copysign(1.0, force))
        q[0] += force * (share - 1.0) / self.mass


def gear_efficiency(rng: Rng, s: Scale) -> Drawn:
    efficiency, v0 = float(rng.uniform(0.6, 0.92)), 0.02 * s.speed
    return Drawn(
        GearEfficiency(efficiency, v0, _mass(s)),
        "the gear loses a share of the power: friction in proportion to the force, against the motion",
        ("force", "speed", "qd", "force*speed", "force*qd"),
        {"efficiency": efficiency, "smooth_below": v0},
    )


class ColdGrease(TruthEffect):
    """Cold grease: viscous friction that decays as the gear warms up, F = -c exp(-t / tau) v.

    Source: Bittencourt, Axelsson, "Modeling and experiment design for identification of wear in a robot joint under load and temperature
    uncertainties", IEEE/ASME Trans. Mechatronics 19(5), 2014 (viscous part over temperature; warm-up by an exponential).
    """

    def __init__(self, coefficient: float, tau: float, mass: float) -> None:
        self.coefficient, self.tau, self.mass = coefficient, tau, mass

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        q[0] -= self.coefficient / self.mass * math.exp(-s.t / self.tau) * x[1]


def cold_grease(rng: Rng, s: Scale) -> Drawn:
    coefficient, tau = _mass(s) * float(rng.uniform(0.1, 0.5)) / s.pace, float(rng.uniform(0.15, 0.5)) * s.duration
    return Drawn(
        ColdGrease(coefficient, tau, _mass(s)),
        "the gear's grease is cold at first: viscous friction that fades as it warms up",
        ("speed", "qd", "time", "time*speed", "time*qd"),
        {"coefficient": coefficient, "time_constant_s": tau},
    )


class Cogging(TruthEffect):
    """Detent force of an iron-core linear motor: periodic in the position, with a second harmonic.

    F = -A (sin(2 pi q / p + phi) + h sin(4 pi q / p)).   Source: Zhu, Howe, "Influence of design parameters on cogging torque in permanent
    magnet machines", IEEE Trans. Energy Conversion 15(4), 2000: some per cent of the rated force.
    """

    def __init__(self, size: float, second: float, pitch: float, phase: float, mass: float) -> None:
        self.size, self.second, self.pitch, self.phase, self.mass = size, second, pitch, phase, mass

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        angle = math.tau * x[0] / self.pitch
        q[0] -= self.size / self.mass * (math.sin(angle + self.phase) + self.second * math.sin(2.0 * angle))


def cogging(rng: Rng, s: Scale) -> Drawn:
    size, second = float(rng.uniform(0.02, 0.1)) * s.ranges[0].size, float(rng.uniform(0.1, 0.4))
    pitch = s.speed * max(float(rng.uniform(0.1, 0.6)) * s.pace, 6.0 * s.dt)
    phase = float(rng.uniform(0.0, math.tau))
    return Drawn(
        Cogging(size, second, pitch, phase, _mass(s)),
        "the motor cogs: its magnets pull toward rest positions, one every pole pitch",
        ("position", "q"),
        {"force": size, "second": second, "pitch_m": pitch, "phase_rad": phase},
    )


class FanJet(TruthEffect):
    """A fan or an open door blows across part of the room: a jet of Gaussian profile pushes what flies through it.

    a = A exp(-d² / (2 b²)) along the jet,   d: distance from its axis.   Source: Rajaratnam, "Turbulent Jets", 1976
    (Gaussian velocity profile of plane jets); widening along the axis is left out.
    """

    def __init__(self, size: float, width: float, angle: float, off: float) -> None:
        self.size, self.width, self.off = size, width, off
        self.cos, self.sin = math.cos(angle), math.sin(angle)

    def push(self, s: Moment, x: Numbers, q: Numbers) -> None:
        distance = self.cos * x[1] - self.sin * x[0] - self.off
        push = self.size * math.exp(-0.5 * (distance / self.width) ** 2)
        q[0] += push * self.cos
        q[1] += push * self.sin


def fan_jet(rng: Rng, s: Scale) -> Drawn:
    reach = s.speed * max(s.pace, 8.0 * s.dt)
    size, width = float(rng.uniform(0.08, 0.35)) * s.ranges[0].size, float(rng.uniform(0.25, 0.6)) * reach
    angle, off = float(rng.uniform(0.0, math.tau)), float(rng.uniform(-0.4, 0.4)) * reach
    return Drawn(
        FanJet(size, width, angle, off),
        "a fan's jet crosses part of the room and pushes the robot aside while it is in it",
        ("position",),
        {"acceleration": size, "width_m": width, "angle_rad": angle, "off_m": off},
        law="closed",
    )


MASSES: tuple[Kind, ...] = (
    Kind(("joint",), flexible_joint),
    Kind(("joint", "double_integrator"), slosh),
    Kind(("joint", "double_integrator"), back_emf_limit),
    Kind(("joint",), gear_efficiency),
    Kind(("joint",), cold_grease, {"rate": (10.0, 20.0, 25.0), "steps": (1200, 3000)}),
    Kind(("joint",), cogging),
    Kind(("double_integrator",), fan_jet),
)
"""In numerical order, after those of poses."""
