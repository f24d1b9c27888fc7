"""A surface vessel with two thrusters: the robot of the families `unopened_robot`. Never to be opened by whoever changes the tracer.

Its motion is that of vessel_model.py, written a second time, in parts of a step (fourth-order Runge-Kutta). Sizes are those of small
research craft of 1 to 2.5 m (Clearpath Heron: 1.3 m, 28 kg; Maritime Robotics Otter: 2 m, 55 kg).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trace_sets.excitation import LAWS, Controller, Range
from trace_sets.noise import Noise
from trace_sets.plants import Numbers, Plant
from trace_sets.scale import Scale, log_uniform
from trace_sets.unopened_kinds import Drawn, Kind, runge_kutta
from trace_sets.world import Moment, TruthEffect

Array = NDArray[np.float64]
Rng = np.random.Generator

G = 9.81
"""m/s²."""
AIR = 1.2
"""kg/m³."""

LENGTHS = (1.2, 2.5)
"""m, of the hull."""
MASS_PER_CUBE = (5.5, 8.5)
"""kg/m³: mass over the cube of the hull's length."""


class OnVessel(TruthEffect):
    """Acts on the vessel's accelerations."""

    def force(self, s: Moment, x: Numbers, f: Numbers) -> None:
        """Changes [surge, sway, yaw] accelerations, m/s² and rad/s², in place. Evaluated four times a part: it has no memory."""


def move(plant: Plant, x: Numbers, a: Numbers, h: float, moment: Moment) -> None:
    """One part of h seconds, in place. Forces of time are those at the part's middle."""
    p = plant.parameters
    pushing = [e for e in moment.world.effects if isinstance(e, OnVessel)]
    turning = [(e, moment.memories[k]) for k, e in moment.world.turning]
    noise = moment.wander[moment.i // moment.world.parts] if moment.wander is not None else [0.0, 0.0, 0.0]

    def rate(z: Numbers) -> Numbers:
        u, v, r = z[3:]
        surge = p["sway_mass"] * v * r - (p["surge_drag"] + p["surge_drag_2"] * abs(u)) * u + a[0] + a[1]
        sway = -p["surge_mass"] * u * r - (p["sway_drag"] + p["sway_drag_2"] * abs(v)) * v
        yaw = (p["surge_mass"] - p["sway_mass"]) * u * v - (p["yaw_drag"] + p["yaw_drag_2"] * abs(r)) * r
        yaw += 0.5 * p["beam"] * (a[1] - a[0])
        f = [surge / p["surge_mass"] + noise[0], sway / p["sway_mass"] + noise[1], yaw / p["yaw_inertia"] + noise[2]]
        for e in pushing:
            e.force(moment, z, f)
        q = [u, r, v, 0.0, 0.0]
        for e, m in turning:
            e.turn(moment, z, q, m)
        c, s = math.cos(z[2]), math.sin(z[2])
        return [q[0] * c - q[2] * s + q[3], q[0] * s + q[2] * c + q[4], q[1], *f]

    x[:] = runge_kutta(rate, x, h)


def draw_vessel(rng: Rng) -> Scale:
    """A hull, its thrusters, and a recording's size."""
    length = float(rng.uniform(*LENGTHS))
    mass = float(rng.uniform(*MASS_PER_CUBE)) * length**3
    top, beam = float(rng.uniform(1.0, 2.0)), float(rng.uniform(0.35, 0.5)) * length
    thrust = mass * float(rng.uniform(0.3, 0.7))
    linear, spin = float(rng.uniform(0.25, 0.5)), float(rng.uniform(0.5, 1.0))
    wide = float(rng.uniform(3.0, 5.0))
    p = {
        "surge_mass": mass * float(rng.uniform(1.05, 1.15)),
        "sway_mass": mass * float(rng.uniform(1.4, 1.9)),
        "yaw_inertia": mass * length**2 / 16.0 * float(rng.uniform(1.3, 1.8)),
        "surge_drag": linear * 2.0 * thrust / top,
        "sway_drag": wide * linear * 2.0 * thrust / top,
        "yaw_drag": linear * thrust * beam / spin,
        "surge_drag_2": (1.0 - linear) * 2.0 * thrust / top**2,
        "sway_drag_2": wide * (1.0 - linear) * 2.0 * thrust / top**2,
        "yaw_drag_2": (1.0 - linear) * thrust * beam / spin**2,
        "beam": beam,
    }
    states = ("x", "y", "theta", "surge", "sway", "yaw_rate")
    file = str(Path(__file__).with_name("vessel_model.py"))
    rounded = {name: float(f"{value:.4g}") for name, value in p.items()}
    plant = Plant("vessel", states, ("thrust_left", "thrust_right"), rounded, move=move, file=file)
    both = Range(-thrust, thrust)
    dt = float(rng.choice([0.04, 0.05, 0.1]))
    return Scale(plant, dt, 10, int(log_uniform(rng, 600, 2500)), (both, both), top, spin, float(rng.uniform(2.0, 6.0)))


def hull_length(s: Scale) -> float:
    """m; about, from the thrusters' distance."""
    return s.plant.parameters["beam"] / 0.425


def vessel_noise(rng: Rng, s: Scale, law: str) -> Noise:
    """Of an inertial unit with satellite positions: 5 to 20 mm, 0.1° to 0.4°, 1 to 3 cm/s, 0.05 to 0.3 °/s; small waves push the hull."""
    place, speed = float(rng.uniform(0.005, 0.02)), float(rng.uniform(0.01, 0.03))
    heading, turn = math.radians(rng.uniform(0.1, 0.4)), math.radians(rng.uniform(0.05, 0.3))
    sigma = np.array([place, place, heading, speed, speed, turn])
    chop = log_uniform(rng, 0.005, 0.03)
    if law == "coloured":
        return Noise(law, sigma, push=chop * np.array([1.0, 1.0, 0.7]), memory=float(rng.uniform(0.3, 1.0)))
    return Noise(law, sigma, push=chop * math.sqrt(0.05 / s.dt) * np.array([1.0, 1.0, 0.7])) if rng.random() < 0.6 else Noise(law, sigma)


def open_thrusts(s: Scale, law: str) -> Callable[[Rng, Array], Array]:
    """Mostly ahead, with turns both ways; intermittently astern."""

    def commands(rng: Rng, t: Array) -> Array:
        ahead = 0.35 + 0.65 * LAWS[law](rng, t, 2.0 * s.pace)
        turn = 0.5 * LAWS[law](rng, t, s.pace)
        return np.asarray(s.ranges[0].size * np.clip(np.column_stack([ahead - turn, ahead + turn]), -1.0, 1.0))

    return commands


def survey_reach(s: Scale) -> float:
    """m: half the side of the square in which the autopilot keeps."""
    return 4.0 * hull_length(s)


def autopilot(s: Scale) -> Callable[[Rng, Array], Controller]:
    """Heads for random waypoints in a square about the start: speed by feedforward and a gain, heading by a gain and the yaw rate's.

    Source: line-of-sight guidance with a PD heading autopilot, Fossen, 2011, chapters 10 and 12.
    """

    def commands(rng: Rng, t: Array) -> Controller:
        p, reach, most = s.plant.parameters, survey_reach(s), s.ranges[0].size
        points = rng.uniform(-reach, reach, (400, 2)).tolist()
        speeds = (s.speed * rng.uniform(0.35, 0.9, 400)).tolist()
        state = {"next": 0}
        omega = float(rng.uniform(0.8, 1.5))

        def steer(t: float, y: Numbers) -> Numbers:
            goal = points[state["next"] % len(points)]
            if math.hypot(goal[0] - y[0], goal[1] - y[1]) < hull_length(s):
                state["next"] += 1
                goal = points[state["next"] % len(points)]
            off = math.remainder(math.atan2(goal[1] - y[1], goal[0] - y[0]) - y[2], math.tau)
            wanted = speeds[state["next"] % len(speeds)] * max(math.cos(off), 0.2)
            moment = p["yaw_inertia"] * (omega**2 * off - 1.6 * omega * y[5])
            force = (p["surge_drag"] + p["surge_drag_2"] * abs(wanted)) * wanted + p["surge_mass"] * (wanted - y[3])
            turn = moment / p["beam"]
            return [min(max(0.5 * force + side * turn, -most), most) for side in (-1.0, 1.0)]

        return steer

    return commands


class AdvanceLoss(OnVessel):
    """A propeller gives less thrust the faster it moves through the water: T = T_nn n|n| - T_nu |n| u_a, with n from the commanded thrust.

    T - k sqrt(|T|) u_a,   u_a: surge at the thruster.   Source: Fossen, "Guidance and Control of Ocean Vehicles", 1994 (bilinear thruster
    model); Yoerger, Cooke, Slotine, IEEE J. Oceanic Eng. 15(3), 1990.
    """

    def __init__(self, plant: Plant, k: float) -> None:
        self.p, self.k = plant.parameters, k

    def force(self, s: Moment, x: Numbers, f: Numbers) -> None:
        for side, thrust in zip((-1.0, 1.0), s.acting, strict=True):
            arm = 0.5 * side * self.p["beam"]
            less = self.k * math.sqrt(abs(thrust)) * (x[3] + arm * x[5])
            f[0] -= less / self.p["surge_mass"]
            f[2] -= arm * less / self.p["yaw_inertia"]


def advance_loss(rng: Rng, s: Scale) -> Drawn:
    k = float(rng.uniform(0.15, 0.4)) * math.sqrt(s.ranges[0].size) / s.speed
    inputs = s.plant.inputs
    products = [f"{c}*{v}" for c in inputs for v in ("surge", "speed")]
    return Drawn(
        AdvanceLoss(s.plant, k),
        "propellers give less thrust the faster the hull moves",
        (*inputs, *products, "surge", "yaw_rate", "speed"),
        {"k": k},
    )


class RelativeWind(OnVessel):
    """Wind on the hull above the water, by its speed relative to the hull: gamma = -atan2(v_rw, u_rw), V² = u_rw² + v_rw².

    X = -rho/2 V² c_x cos(gamma) A_F,   Y = rho/2 V² c_y sin(gamma) A_L,   N = rho/2 V² c_n sin(2 gamma) A_L L

    Source: Fossen, "Handbook of Marine Craft Hydrodynamics and Motion Control", 2011, section 8.1 (signs with y to the left: gamma's).
    """

    def __init__(
        self, plant: Plant, wind: tuple[float, float], areas: tuple[float, float], shape: tuple[float, float, float], length: float
    ):
        self.p, self.wind, self.areas, self.shape, self.length = plant.parameters, wind, areas, shape, length

    def force(self, s: Moment, x: Numbers, f: Numbers) -> None:
        c, sine = math.cos(x[2]), math.sin(x[2])
        ahead, left = x[3] - (self.wind[0] * c + self.wind[1] * sine), x[4] - (self.wind[1] * c - self.wind[0] * sine)
        v2, gamma = ahead**2 + left**2, -math.atan2(left, ahead)
        half = 0.5 * AIR * v2
        f[0] -= half * self.shape[0] * math.cos(gamma) * self.areas[0] / self.p["surge_mass"]
        f[1] += half * self.shape[1] * math.sin(gamma) * self.areas[1] / self.p["sway_mass"]
        f[2] += half * self.shape[2] * math.sin(2.0 * gamma) * self.areas[1] * self.length / self.p["yaw_inertia"]


def relative_wind(rng: Rng, s: Scale) -> Drawn:
    length, speed, to = hull_length(s), float(rng.uniform(3.0, 9.0)), float(rng.uniform(0.0, math.tau))
    areas = (0.08 * length**2, 0.15 * length**2)
    shape = (float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.7, 0.95)), float(rng.uniform(0.05, 0.2)))
    return Drawn(
        RelativeWind(s.plant, (speed * math.cos(to), speed * math.sin(to)), areas, shape, length),
        "wind pushes on what stands above the water, by the heading against it",
        ("heading", "speed", "surge", "sway"),
        {"wind_m_s": speed, "to_rad": to, "c_x": shape[0], "c_y": shape[1], "c_n": shape[2]},
    )


class BankSuction(OnVessel):
    """A quay wall: water that runs faster between hull and wall draws the hull to it and turns its bow away, with u² and the nearness.

    Source: Norrbin, "Bank effects on a ship moving through a short dredged channel", 10th Symp. Naval Hydrodynamics, 1974 (with u²);
    exponential decay with the distance, over about a hull's length.
    """

    def __init__(self, pull: float, turn: float, reach: float, away: float, angle: float, least: float) -> None:
        self.pull, self.turned, self.reach, self.away, self.least = pull, turn, reach, away, least
        self.normal = (math.cos(angle), math.sin(angle))

    def force(self, s: Moment, x: Numbers, f: Numbers) -> None:
        """normal: toward the wall, which lies `away` m from the origin."""
        distance = max(self.away - (self.normal[0] * x[0] + self.normal[1] * x[1]), self.least)
        near = math.exp(-distance / self.reach) * x[3] ** 2
        c, sine = math.cos(x[2]), math.sin(x[2])
        aside = self.normal[1] * c - self.normal[0] * sine  # of the wall's direction, to the left of the hull
        f[1] += self.pull * near * aside
        f[2] -= self.turned * near * aside


def bank_suction(rng: Rng, s: Scale) -> Drawn:
    length, p, thrust = hull_length(s), s.plant.parameters, s.ranges[0].size
    pull = float(rng.uniform(0.15, 0.4)) * 2.0 * thrust / p["sway_mass"] / s.speed**2
    turn = float(rng.uniform(0.2, 0.5)) * thrust * p["beam"] / p["yaw_inertia"] / s.speed**2
    reach, angle = float(rng.uniform(1.0, 2.0)) * length, float(rng.uniform(0.0, math.tau))
    away = survey_reach(s) * float(rng.uniform(0.8, 1.0))
    return Drawn(
        BankSuction(pull, turn, reach, away, angle, 0.3 * length),
        "near a quay wall the hull is drawn to it and its bow turned away, the more the faster it moves",
        ("position", "speed", "surge", "heading"),
        {"pull_per_m": pull, "turn_per_m2": turn, "reach_m": reach, "away_m": away, "angle_rad": angle},
        law="closed",
    )


class Waves(OnVessel):
    """Long-crested irregular waves, first-order forces: the hull follows the water's surge along the waves, in part.

    acceleration along the waves = c sum of a_i omega_i² sin(omega_i t - k_i s + phi_i),   k = omega² / g,   s: place along the waves;
    yaw by the difference between bow and stern.   Source: Fossen, 2011, section 8.2; peak of a lake's or harbour's wind sea.
    """

    def __init__(self, waves: list[tuple[float, float, float]], angle: float, share: float, yaw: float, length: float) -> None:
        self.waves, self.share, self.yaw, self.length = waves, share, yaw, length
        self.along = (math.cos(angle), math.sin(angle))

    def _push(self, place: float, t: float) -> float:
        return sum(a * w * w * math.sin(w * t - w * w / G * place + phi) for w, a, phi in self.waves)

    def force(self, s: Moment, x: Numbers, f: Numbers) -> None:
        c, sine = math.cos(x[2]), math.sin(x[2])
        ahead, left = self.along[0] * c + self.along[1] * sine, self.along[1] * c - self.along[0] * sine
        place, t = self.along[0] * x[0] + self.along[1] * x[1], s.t + 0.5 * s.h
        half = 0.25 * self.length * ahead
        bow, stern = self._push(place + half, t), self._push(place - half, t)
        push = 0.5 * self.share * (bow + stern)
        f[0] += push * ahead
        f[1] += push * left
        f[2] += self.yaw * self.share * (bow - stern) * left / self.length


def waves(rng: Rng, s: Scale) -> Drawn:
    height, peak, angle = float(rng.uniform(0.04, 0.15)), float(rng.uniform(1.8, 3.2)), float(rng.uniform(0.0, math.tau))
    omegas = peak * np.sort(rng.uniform(0.8, 1.4, 6))
    strength = np.exp(-1.25 * (peak / omegas) ** 4) * (peak / omegas) ** 5
    a = 0.25 * height * math.sqrt(2.0) * np.sqrt(strength / strength.sum())
    each = list(zip(omegas.tolist(), a.tolist(), rng.uniform(0.0, math.tau, 6).tolist(), strict=True))
    share = float(rng.uniform(0.5, 0.9))
    return Drawn(
        Waves(each, angle, share, float(rng.uniform(1.0, 2.0)), hull_length(s)),
        "waves from one side push and turn the hull, by its heading and by when and where it meets them",
        ("time", "position", "heading", "noise"),
        {"significant_height_m": height, "peak_rad_s": peak, "angle_rad": angle, "share": share},
    )


VESSEL: tuple[Kind, ...] = tuple(Kind(("vessel",), draw) for draw in (advance_loss, relative_wind, bank_suction, waves))
"""In numerical order."""
