"""The quadruped's walking controller, called every millisecond: a trot whose stance legs carry and whose swing legs catch the trunk.

phase p in [0, 1), period T; legs front left and rear right at p, the other two at p + 1/2. The first SWING of a leg's phase it swings, the
rest it stands. With (v, w) the command, slewed, and (V, U, W) forward, sideways and yaw speed, V and U from the legs
(`quadruped_odometry`), W from the gyro, smoothed over about a third of a stride:

    trim       (a, b, c) = integral of KI (v - V, 0 - U, w - W), bounded
    feet       (f, g, h) = (FEET_V v + FEET_OFFSET + a, b, FEET_W w + c): speeds of the stance feet under the trunk
    stance     foot in the trunk's axes: dp/dt = -(f, g) - h x p, at the trunk's height below the hip
    swing      from lift-off to touch-down on a cubic that leaves and arrives with the ground's speed, lifted by CLEARANCE sin^2;
               touch-down at neutral + ((f, g) + h x neutral) T_stance/2 + KP (V - v, U)      (Raibert's rule)
    load       the weight and a moment -K (roll, pitch) - D (rates), shared by the stance legs through their distance from the middle;
               a leg takes its share up and gives it off over the first and last RAMP of its stance
    slope      a lean that lasts is the floor's: it is not fought, and feet touch down that much downhill, plumb under the trunk

(0, 0) for a whole stride: all four feet stay down at the next double support, the phase waits, and trims are forgotten. Every stride has
a period and a touch-down error of its own, drawn from `rng`. Scalars only: at 1 kHz an array of four costs more than its four numbers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

from s2r_standins.quadruped_leg import DAMPING, ENDS, HIP_X, HIP_Y, SIDES, STIFFNESS, joints, torques
from s2r_standins.quadruped_odometry import Odometry

if TYPE_CHECKING:
    import random

DT = 0.001
PERIOD, PERIOD_JITTER = 0.47, 0.04
"""s; no multiple of a sampling period of 0.1 s, which would see the same few phases for ever. The jitter is relative, uniform."""
SWING = 0.4
CLEARANCE = 0.055
HEIGHT = 0.28
"""The abduction axis above the feet's middle, m."""
FOOT_Y = 0.12
BACK = 0.022
"""m by which the feet's middle is behind the hips' middle: there is the centre of mass, since all knees point back."""
LAGS = (0.0, 0.5, 0.5, 0.0)
HOME_X = tuple(end * HIP_X - BACK for end in ENDS)
"""Front left, front right, rear left, rear right: lag of the phase; where a foot stands."""
WEIGHT = 11.38 * 9.81
"""N, of the robot as it is known."""
SLEW_V, SLEW_W = 1.5, 3.0
"""m/s^2 and rad/s^2: faster changes of a command would be asked of the feet's grip."""
SMOOTHING, LEVELLING = 0.15, 0.5
"""s, of the measured speeds, and of the lean that is taken for the floor's."""
FEET_V, FEET_W, FEET_OFFSET = 0.84, 0.92, 0.007
"""How fast the stance feet go for a speed that is wanted (ratios, m/s): an unloaded robot whose feet go at the speed itself, without a
trim, walks 1.19 v - 0.008 m/s and turns 1.09 w, since swung legs pull the trunk along.
"""
KI_V, KI_W, TRIM_V, TRIM_W = 0.8, 1.0, 0.015, 0.05
"""1/s, and bounds in m/s and rad/s: a trim is for wear and the like. What is more is left to whoever steers, lest an odometry that is
wrong run away with it.
"""
KP = 0.12
"""s: how much farther a foot is put per m/s of speed in excess."""
K_TILT, D_TILT = 60.0, 5.0
"""N m/rad and N m s/rad."""
RAMP = 0.12
PLACEMENT = 0.003
"""m, standard deviation of a touch-down's error."""


class Sensed(NamedTuple):
    """What it knows of itself: direction of up in the trunk's axes (x, y), turning rates (rad/s), twelve joint angles (rad)."""

    up_x: float
    up_y: float
    gyro: tuple[float, float, float]
    angles: list[float]


class Gait:
    """State of the controller. `memory`, `recall`: all of it, as a value."""

    __slots__ = (
        "_c",
        "_error",
        "_foot",
        "_last",
        "_lift",
        "_moving",
        "_odometry",
        "_period",
        "_phase",
        "_rng",
        "_shares",
        "_smooth",
        "_still",
        "_swinging",
    )

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._phase = SWING + rng.random() * (0.5 - SWING) + rng.choice((0.0, 0.5))
        self._period = PERIOD
        self._still = math.inf
        self._moving = False
        self._c = [0.0] * 5  # slewed v, w; trims a, b, c
        self._smooth = [0.0] * 5  # speeds forward, sideways, of yaw; lean
        self._foot = [[HOME_X[i], SIDES[i] * FOOT_Y] for i in range(4)]
        self._lift = [[0.0, 0.0] for _ in range(4)]
        self._error = [[0.0, 0.0] for _ in range(4)]
        self._swinging = [False] * 4
        self._shares = [1.0] * 4
        self._odometry = Odometry()
        self._last: list[tuple[float, float, float]] = [self._stand(i) for i in range(4)]

    @staticmethod
    def _stand(i: int) -> tuple[float, float, float]:
        return joints(-BACK, SIDES[i] * (FOOT_Y - HIP_Y), -HEIGHT, SIDES[i])

    @staticmethod
    def stance() -> list[tuple[float, float, float]]:
        """Joint angles of a robot that stands, leg by leg."""
        return [Gait._stand(i) for i in range(4)]

    def memory(self) -> tuple[Any, ...]:
        """Everything that it goes on from, the generator apart."""
        odometry = self._odometry
        numbers = (self._phase, self._period, self._still, self._moving, odometry.forward, odometry.sideways)
        lists = (self._c, self._smooth, self._swinging, self._shares, self._last, odometry.known)
        pairs = (self._foot, self._lift, self._error)
        return (numbers, tuple(tuple(row) for row in lists), tuple(tuple(tuple(foot) for foot in pair) for pair in pairs))

    def recall(self, memory: tuple[Any, ...]) -> None:
        """Goes on from there."""
        numbers, lists, pairs = memory
        odometry = self._odometry
        self._phase, self._period, self._still, self._moving, odometry.forward, odometry.sideways = numbers
        self._c, self._smooth, self._swinging, self._shares, self._last, odometry.known = (list(row) for row in lists)
        self._foot, self._lift, self._error = ([list(foot) for foot in pair] for pair in pairs)

    def step(self, v: float, w: float, sensed: Sensed) -> list[float]:
        """Twelve servo commands in rad for the next millisecond, leg by leg."""
        self._pace(v, w)
        c, smooth = self._c, self._smooth
        c[0] += min(max(v - c[0], -SLEW_V * DT), SLEW_V * DT)
        c[1] += min(max(w - c[1], -SLEW_W * DT), SLEW_W * DT)
        up_x, up_y, gyro, angles = sensed
        roll_rate, pitch_rate, yaw_rate = gyro
        odometry = self._odometry
        odometry.update(DT, angles, gyro, self._shares)
        rate = DT / SMOOTHING
        smooth[0] += rate * (odometry.forward - smooth[0])
        smooth[1] += rate * (odometry.sideways - smooth[1])
        smooth[2] += rate * (yaw_rate - smooth[2])
        if self._moving:
            c[2] = min(max(c[2] + KI_V * DT * (c[0] - smooth[0]), -TRIM_V), TRIM_V)
            c[3] = min(max(c[3] - KI_V * DT * smooth[1], -TRIM_V), TRIM_V)
            c[4] = min(max(c[4] + KI_W * DT * (c[1] - smooth[2]), -TRIM_W), TRIM_W)
            vx, vy, turn = FEET_V * c[0] + FEET_OFFSET + c[2], c[3], FEET_W * c[1] + c[4]
        else:
            vx = vy = turn = 0.0
        lean = DT / LEVELLING
        smooth[3] += lean * (up_x - smooth[3])
        smooth[4] += lean * (up_y - smooth[4])
        moment_x = K_TILT * (smooth[4] - up_y) - D_TILT * roll_rate
        moment_y = K_TILT * (up_x - smooth[3]) - D_TILT * pitch_rate
        plumb_x, plumb_y = -HEIGHT * smooth[3], -HEIGHT * smooth[4]

        places: list[tuple[float, float, float]] = []
        shares = [0.0] * 4
        stance_s = (1.0 - SWING) * self._period
        for i in range(4):
            leg = self._phase + LAGS[i]
            leg -= leg >= 1.0
            foot = self._foot[i]
            if self._moving and leg < SWING:
                if not self._swinging[i]:
                    self._lift_off(i)
                home_x, home_y = HOME_X[i], SIDES[i] * FOOT_Y
                error = self._error[i]
                land_x = home_x + plumb_x + 0.5 * stance_s * (vx - turn * home_y) + KP * (smooth[0] - c[0]) + error[0]
                land_y = home_y + plumb_y + 0.5 * stance_s * (vy + turn * home_x) + KP * smooth[1] + error[1]
                # cubic from lift-off to landing, both with the ground's speed g seen from the trunk
                s, span = leg / SWING, SWING * self._period
                g_x, g_y = -span * (vx - turn * home_y), -span * (vy + turn * home_x)
                start_x, start_y = self._lift[i]
                blend = s * s * (3.0 - 2.0 * s)
                ease = s * (1.0 - s) * (1.0 - 2.0 * s)
                foot[0] = start_x + (land_x - start_x) * blend + g_x * ease
                foot[1] = start_y + (land_y - start_y) * blend + g_y * ease
                rise = math.sin(math.pi * s)
                places.append((foot[0], foot[1], CLEARANCE * rise * rise - HEIGHT))
            else:
                self._swinging[i] = False
                x, y = foot
                foot[0] -= DT * (vx - turn * y)
                foot[1] -= DT * (vy + turn * x)
                stood = (leg - SWING) / (1.0 - SWING) if self._moving else 0.5
                shares[i] = max(min(stood / RAMP, (1.0 - stood) / RAMP, 1.0), 0.0)
                places.append((foot[0], foot[1], -HEIGHT))
        self._shares = shares
        return self._servos(places, shares, moment_x, moment_y)

    def _servos(self, places: list[tuple[float, float, float]], shares: list[float], moment_x: float, moment_y: float) -> list[float]:
        total = sum(shares) or 1.0
        out: list[float] = []
        for i in range(4):
            x, y, z = places[i]
            side, share = SIDES[i], shares[i] / total
            q = joints(x - ENDS[i] * HIP_X, y - side * HIP_Y, z, side)
            last, self._last[i] = self._last[i], q
            load = share * (WEIGHT + moment_x * side / FOOT_Y - moment_y * ENDS[i] / HIP_X)
            hold = torques(q, side, 0.0, 0.0, max(load, 0.0)) if load > 0.0 else (0.0, 0.0, 0.0)
            out.extend(q[j] + (hold[j] + DAMPING * (q[j] - last[j]) / DT) / STIFFNESS for j in range(3))
        return out

    def _pace(self, v: float, w: float) -> None:
        """The phase one millisecond on; begins to walk, and ends at a double support when it was told to stand for a stride."""
        self._still = self._still + DT if v == 0.0 and w == 0.0 else 0.0
        if not self._moving:
            if self._still > 0.0:
                return
            self._moving = True
        before = self._phase
        self._phase += DT / self._period
        if self._phase >= 1.0:
            self._phase -= 1.0
            self._period = PERIOD * (1.0 + PERIOD_JITTER * (2.0 * self._rng.random() - 1.0))
        double = SWING + 0.5 * (0.5 - SWING)
        if self._still > PERIOD and (before < double <= self._phase or before < double + 0.5 <= self._phase):
            self._moving = False
            self._c = [0.0] * 5  # trims too: what one walk needed says little about the next

    def _lift_off(self, i: int) -> None:
        self._swinging[i] = True
        self._lift[i] = list(self._foot[i])
        self._error[i] = [self._rng.gauss(0.0, PLACEMENT), self._rng.gauss(0.0, PLACEMENT)]
