"""The Robotarium's robot as a body: what its wheels make of commands, and what the cameras see of it.

One period of dt, for the pose (x, y, theta) and a command (v, w):

    latency    the command acts `latency` periods after it was given; until then the ones before it do
    wheels     right, left = v +- w track/2, each clipped to +-wheel_speed;  v = (right + left)/2,  w = (right - left)/track
    effects    what is wrong with this robot and stands in no data sheet, in the order in which it was switched on
    motion     exact: along the arc of (v, w);  euler: along the tangent at the period's start
    walls      the position is clamped to the arena: the robot stops at its wall, wheels spinning

    observation = pose + noise, theta in (-pi, pi]; of the pose that the effects on sensors make of it

Scalar arithmetic, because a robot in lockstep is asked for thousands of periods a second; effects of the library are batched over
arrays and cost some ten microseconds each, which a robot pays that has them. All randomness is seeded, and drawn once a period
whatever happens, so that one seed gives one robot.
"""

from __future__ import annotations

import math
import random
from typing import NamedTuple

from s2r_standins.faults import Fault, Library, Pose, Twist, parse_effect


class DataSheet(NamedTuple):
    """What is known about the robot. Speeds in m/s at the wheel, lengths in m, latency in periods, sigmas in m and rad."""

    dt: float = 0.033
    wheel_speed: float = 0.2
    track: float = 0.105
    latency: int = 1
    sigma_position: float = 0.0002
    sigma_heading: float = 0.001
    integration: str = "exact"
    walls: tuple[float, float] = (2.0, 1.4)
    """Half the arena's length and width, about its middle."""


class Body:
    """The robot's truth. `k`: periods since it was switched on; its clock is k dt."""

    def __init__(self, sheet: DataSheet, start: Pose, seed: int) -> None:
        self.sheet, self.pose, self.k = sheet, start, 0
        self._noise = random.Random(f"{seed}/noise")
        self._pending: list[Twist] = [(0.0, 0.0)] * sheet.latency
        self._faults: dict[str, Fault] = {}
        self._library: Library | None = None

    @property
    def now_s(self) -> float:
        """The robot's clock, s."""
        return self.k * self.sheet.dt

    @property
    def period_s(self) -> float:
        """The period of its link, s."""
        return self.sheet.dt

    @property
    def trouble(self) -> str:
        """Nothing can befall two wheels on a flat floor."""
        return ""

    def observe(self) -> Pose:
        """The pose as measured now; call once a period."""
        x, y, theta = self.pose if self._library is None else self._library.measured(self.pose)
        gauss, position = self._noise.gauss, self.sheet.sigma_position
        return (x + gauss(0.0, position), y + gauss(0.0, position), _wrapped(theta + gauss(0.0, self.sheet.sigma_heading)))

    def move(self, command: Twist) -> None:
        """One period under this command."""
        self._pending.append(command)
        twist = self._clipped(self._pending.pop(0))
        for fault in self._faults.values():
            twist = fault(self.pose, twist)
        before = self.pose
        if self._library is not None:
            twist = self._library.act(twist)
        after = self._moved(before, twist)
        if self._library is not None:
            after = self._library.correct(before, twist, after)
        length, width = self.sheet.walls
        self.pose = (min(max(after[0], -length), length), min(max(after[1], -width), width), _wrapped(after[2]))
        self.k += 1

    # ------------------------------------------------------------------ what is wrong with it

    def check(self, text: str) -> None:
        """Raises ConfigError if this is no effect that it can have."""
        parse_effect(text)

    def switch_on(self, text: str) -> str:
        """Begins an effect now; one of the same name and channel is replaced. Returns what it is. Raises ConfigError."""
        effect = parse_effect(text)
        if effect.fault is not None:
            self._faults[effect.key] = effect.fault
        else:
            known = self._library.specs if self._library else {}
            self._library = Library({**known, effect.key: effect.spec}, self.sheet.dt, arcs=self.sheet.integration == "exact")
        return effect.key

    def clear(self) -> None:
        """Ends all effects."""
        self._faults, self._library = {}, None

    # ------------------------------------------------------------------ the data sheet

    def _clipped(self, twist: Twist) -> Twist:
        v, w = twist
        limit, half = self.sheet.wheel_speed, 0.5 * self.sheet.track
        right, left = v + w * half, v - w * half
        if -limit <= right <= limit and -limit <= left <= limit:
            return twist
        right, left = min(max(right, -limit), limit), min(max(left, -limit), limit)
        return 0.5 * (right + left), (right - left) / self.sheet.track

    def _moved(self, pose: Pose, twist: Twist) -> Pose:
        (x, y, theta), (v, w), dt = pose, twist, self.sheet.dt
        if self.sheet.integration == "euler":
            return x + dt * v * math.cos(theta), y + dt * v * math.sin(theta), theta + dt * w
        half = 0.5 * dt * w  # the chord of an arc: at its middle heading, shortened by sin(half)/half
        chord = dt * v * (math.sin(half) / half if abs(half) > 1e-8 else 1.0)
        return x + chord * math.cos(theta + half), y + chord * math.sin(theta + half), theta + dt * w


def _wrapped(angle: float) -> float:
    """To (-pi, pi]."""
    angle = math.remainder(angle, 2.0 * math.pi)
    return angle if angle > -math.pi else math.pi
