"""The stand-in rover's truth: what its motors make of a target, in north and east.

One step of h, for a target (speed, turn rate), both clockwise and forward as MAVLink has them:

    ramp       the demanded speed moves toward the target by at most 1 m/s^2 h, the demanded turn rate by at most 2.09 rad/s^2 h
    motors     the speed follows its demand with a time constant of 0.1 s, the turn rate with 0.05 s
    motion     along the arc of the two

The figures are those of ArduPilot's Rover with skid steering in its own simulator; delays come from its loop and the link.
"""

from __future__ import annotations

import math
import random
from typing import NamedTuple


class Truth(NamedTuple):
    """north, east (m), yaw (rad, clockwise from north), speed (m/s), turn (rad/s, clockwise)."""

    north: float
    east: float
    yaw: float
    speed: float
    turn: float


class RoverBody:
    """start: (north, east, yaw). sigma: noise of the position estimate, m; of yaw a tenth of that, rad."""

    ACCELERATION = 1.0
    TURN_ACCELERATION = 2.09
    SPEED_LAG_S = 0.1
    TURN_LAG_S = 0.05

    def __init__(self, start: tuple[float, float, float], sigma: float, seed: int, turn_gain: float = 1.0) -> None:
        self.truth = Truth(*start, 0.0, 0.0)
        self._demand = (0.0, 0.0)
        self._sigma, self._turn_gain = sigma, turn_gain
        self._noise = random.Random(f"{seed}/rover")

    def stand(self) -> None:
        """It was switched off and on: it stands where it is."""
        self.truth = self.truth._replace(speed=0.0, turn=0.0)
        self._demand = (0.0, 0.0)

    def move(self, target: tuple[float, float], h: float) -> None:
        """One step of h, s."""
        speed_demand = _toward(self._demand[0], target[0], self.ACCELERATION * h)
        turn_demand = _toward(self._demand[1], self._turn_gain * target[1], self.TURN_ACCELERATION * h)
        self._demand = (speed_demand, turn_demand)
        north, east, yaw, speed, turn = self.truth
        speed += (speed_demand - speed) * (1.0 - math.exp(-h / self.SPEED_LAG_S))
        turn += (turn_demand - turn) * (1.0 - math.exp(-h / self.TURN_LAG_S))
        middle = yaw + 0.5 * h * turn
        north, east = north + h * speed * math.cos(middle), east + h * speed * math.sin(middle)
        self.truth = Truth(north, east, math.remainder(yaw + h * turn, 2.0 * math.pi), speed, turn)

    def estimate(self) -> Truth:
        """What its own filter makes of it."""
        north, east, yaw, speed, turn = self.truth
        gauss, sigma = self._noise.gauss, self._sigma
        return Truth(north + gauss(0.0, sigma), east + gauss(0.0, sigma), yaw + gauss(0.0, 0.1 * sigma), speed, turn)


def _toward(value: float, target: float, most: float) -> float:
    return value + min(max(target - value, -most), most)
