"""A robot with the quadruped's interface and none of its physics: a unicycle that lags, under-tracks, and sways with its stride.

    v' = (gain_v v_cmd - v) / lag,  w likewise        the body's path
    pose = path + stride's sway, sideways and in heading, of period `stride`, as long as it moves

For tests of what is built on the quadruped, where its physics need not be there, and are slow.
"""

from __future__ import annotations

import copy
import math
import random
from typing import Any

Pose = tuple[float, float, float]


class SwayingWalker:
    """Interface: `s2r_standins.quadruped_body.Quadruped`, as far as it is used."""

    lag, gain_v, gain_w, stride, sway, roll = 0.15, 0.97, 0.95, 0.43, 0.006, 0.015

    def __init__(self, start: Pose = (0.0, 0.0, 0.0), seed: int = 1) -> None:
        self.fallen = ""
        self.reset(seed, start)

    def reset(self, seed: int, start: Pose = (0.0, 0.0, 0.0)) -> None:
        self._random = random.Random(seed)
        self._path, self._v, self._w, self.now_s = start, 0.0, 0.0, 0.0
        self._phase = self._random.uniform(0.0, 2.0 * math.pi)

    def step(self, v: float, w: float, seconds: float) -> Pose:
        n = max(1, round(seconds / 0.01))
        dt = seconds / n
        for _ in range(n):
            x, y, theta = self._path
            self._v += dt / self.lag * (self.gain_v * v - self._v)
            self._w += dt / self.lag * (self.gain_w * w - self._w)
            self._path = (x + dt * self._v * math.cos(theta), y + dt * self._v * math.sin(theta), theta + dt * self._w)
            self._phase += 2.0 * math.pi * dt / self.stride * self._random.uniform(0.95, 1.05)
            self.now_s = round(self.now_s + dt, 9)
        return self.pose()

    def pose(self) -> Pose:
        x, y, theta = self._path
        moving = min(1.0, (abs(self._v) / 0.05 + abs(self._w) / 0.1))
        aside = moving * self.sway * math.sin(self._phase)
        turned = theta + moving * self.roll * math.sin(self._phase + 1.0)
        return (x - aside * math.sin(theta), y + aside * math.cos(theta), math.remainder(turned, 2.0 * math.pi))

    def observe(self) -> Pose:
        x, y, theta = self.pose()
        gauss = self._random.gauss
        return (x + gauss(0.0, 0.0005), y + gauss(0.0, 0.0005), math.remainder(theta + gauss(0.0, 0.002), 2.0 * math.pi))

    def place(self, x: float, y: float, theta: float) -> None:
        self._path = (x, y, theta)

    def state(self) -> Any:
        return copy.deepcopy(self.__dict__)

    def restore(self, state: Any) -> None:
        self.__dict__.update(copy.deepcopy(state))
