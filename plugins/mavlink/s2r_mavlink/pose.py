"""The robot's pose and motion from what it tells, in this software's frame.

MAVLink's local frame is x north, y east, z down, yaw clockwise from north (NED). Here x is north, y is west, theta counter-clockwise from
north (NWU): x = n, y = -e, theta = -yaw, w = -yaw rate; the heading's zero and the position's origin are the robot's own.

    x, y (m), theta (rad, in [-pi, pi]), speed (m/s along the heading), vx, vy (m/s along x and y), w (rad/s)

Sources, one of which the profile chooses: `local` LOCAL_POSITION_NED + ATTITUDE, `odometry` ODOMETRY, `vision` VISION_POSITION_ESTIMATE,
`gps` GLOBAL_POSITION_INT + ATTITUDE on the plane that touches the WGS84 ellipsoid at `origin`. Where position and attitude come in two
messages the attitude is carried on to the position's stamp with its own rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import itemgetter
from typing import Any, NamedTuple

from s2r_mavlink.dialect import ATTITUDE, BODY_FRAMES, GLOBAL_POSITION_INT, LOCAL_POSITION_NED, ODOMETRY, VISION_POSITION_ESTIMATE

QUANTITIES = ("x", "y", "theta", "speed", "vx", "vy", "w")
POSE_ONLY = ("x", "y", "theta")
NUMBER_MAX = 1e7
"""Largest magnitude of any quantity, SI units: no vehicle comes near, and sums of squares of such numbers stay finite."""
SKEW_MS = 100
"""An attitude farther from the position's stamp than this is not carried on: at 2 rad/s it would be a fifth of a radian."""

ELLIPSOID_AXIS_M = 6_378_137.0
ELLIPSOID_E2 = 6.694_379_990_141e-3
"""WGS84: half of the major axis, and the square of the first eccentricity."""
LOCAL_NED, LOCAL_FRD, LOCAL_FLU = 1, 20, 21

SOURCES: dict[str, tuple[int, ...]] = {
    "local": (LOCAL_POSITION_NED, ATTITUDE),
    "odometry": (ODOMETRY,),
    "vision": (VISION_POSITION_ESTIMATE,),
    "gps": (GLOBAL_POSITION_INT, ATTITUDE),
}
"""The messages of each source; the first of them is the one that brings an observation."""

Motion = tuple[float, float, float, float, float, float, float]


class Pose(NamedTuple):
    """What was told at `stamp_ns` (robot's clock), one number a state. `fault`: why it can't be used, or empty."""

    stamp_ns: int
    x: tuple[float, ...]
    fault: str = ""


class PoseSource:
    """Puts a pose together from messages. states: the model's names, in its order. `unpaired`: positions without a heading."""

    def __init__(self, source: str, states: tuple[str, ...], origin: tuple[float, float]) -> None:
        columns = [QUANTITIES.index(name) for name in states]
        self._pick: Callable[[Motion], tuple[float, ...]] = (
            itemgetter(*columns) if len(columns) > 1 else lambda motion: (motion[columns[0]],)
        )
        self._states = states
        self._attitude: tuple[int, float, float] | None = None
        self._resets: int | None = None
        self._origin = origin
        lat = math.radians(origin[0])
        bend = 1.0 - ELLIPSOID_E2 * math.sin(lat) ** 2
        self._north_m = ELLIPSOID_AXIS_M * (1.0 - ELLIPSOID_E2) / bend**1.5 * math.radians(1e-7)
        self._east_m = ELLIPSOID_AXIS_M * math.cos(lat) / math.sqrt(bend) * math.radians(1e-7)
        takers = {
            LOCAL_POSITION_NED: self._local,
            ODOMETRY: self._odometry,
            VISION_POSITION_ESTIMATE: self._vision,
            GLOBAL_POSITION_INT: self._gps,
        }
        self._lead = SOURCES[source][0]
        self._take = takers[self._lead]
        self.unpaired = 0

    def restarted(self) -> None:
        """The robot began anew: nothing from before goes together with what comes now."""
        self._attitude, self._resets = None, None

    def take(self, number: int, fields: tuple[Any, ...]) -> Pose | None:
        """One message of this source. A pose, if it brought one."""
        if number == self._lead:
            return self._take(fields)
        # one that is a little late is no news; one that is far behind shows that the one kept was wrong
        if number == ATTITUDE and (self._attitude is None or not 0 < self._attitude[0] - fields[0] <= SKEW_MS):
            self._attitude = (fields[0], fields[3], fields[6])
        return None

    # ------------------------------------------------------------------ one a source

    def _local(self, f: tuple[Any, ...]) -> Pose | None:
        time_boot_ms, north, east, _, v_north, v_east, _ = f
        heading = self._heading(time_boot_ms)
        return heading and self._made(time_boot_ms * 1_000_000, north, east, *heading, v_north, v_east)

    def _gps(self, f: tuple[Any, ...]) -> Pose | None:
        time_boot_ms, lat, lon = f[:3]
        heading = self._heading(time_boot_ms)
        north, east = (lat - 1e7 * self._origin[0]) * self._north_m, (lon - 1e7 * self._origin[1]) * self._east_m
        return heading and self._made(time_boot_ms * 1_000_000, north, east, *heading, 0.01 * f[5], 0.01 * f[6])

    def _odometry(self, f: tuple[Any, ...]) -> Pose | None:
        qw, qx, qy, qz = f[4:8]
        yaw = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        frame, child, resets = f[56], f[57], f[58]
        sign = -1.0 if frame == LOCAL_FLU else 1.0  # its y is to the left already, its yaw counter-clockwise
        north, east, yaw = f[1], sign * f[2], sign * yaw
        ahead, right = f[8], sign * f[9]
        if child in BODY_FRAMES or frame == LOCAL_FLU:
            v_north = ahead * math.cos(yaw) - right * math.sin(yaw)
            v_east = ahead * math.sin(yaw) + right * math.cos(yaw)
        else:
            v_north, v_east = ahead, right
        fault = "" if frame in (LOCAL_NED, LOCAL_FRD, LOCAL_FLU) else f"ODOMETRY is in frame {frame}, must be in 1, 20 or 21"
        if not 0.5 < qw * qw + qx * qx + qy * qy + qz * qz < 2.0:
            fault = "ODOMETRY has no attitude"
        return self._made(f[0] * 1000, north, east, yaw, sign * f[13], v_north, v_east, fault or self._reset(resets))

    def _vision(self, f: tuple[Any, ...]) -> Pose | None:
        return self._made(f[0] * 1000, f[1], f[2], f[6], 0.0, 0.0, 0.0, self._reset(f[28]))

    # ------------------------------------------------------------------ what they share

    def _heading(self, time_boot_ms: int) -> tuple[float, float] | None:
        """(yaw, yaw rate) at that time, clockwise."""
        if self._attitude is None or abs(time_boot_ms - self._attitude[0]) > SKEW_MS:
            self.unpaired += 1
            return None
        at_ms, yaw, rate = self._attitude
        return yaw + rate * 1e-3 * (time_boot_ms - at_ms), rate

    def _reset(self, count: int) -> str:
        """An estimator that starts anew jumps; it counts how often."""
        before, self._resets = self._resets, count
        return "the position estimate was reset" if before is not None and before != count else ""

    def _made(
        self, stamp_ns: int, north: float, east: float, yaw: float, yaw_rate: float, v_north: float, v_east: float, fault: str = ""
    ) -> Pose:
        if not -NUMBER_MAX <= yaw <= NUMBER_MAX:  # also false for NaN, which trigonometry would pass on or refuse
            return Pose(stamp_ns, (), "the heading is no number")
        theta = -math.remainder(yaw, 2.0 * math.pi)
        speed = v_north * math.cos(yaw) + v_east * math.sin(yaw)
        x = self._pick((north, -east, theta, speed, v_north, -v_east, -yaw_rate))
        for name, value in zip(self._states, x, strict=True):
            if not -NUMBER_MAX <= value <= NUMBER_MAX:
                return Pose(stamp_ns, (), f"{name} is no number below {NUMBER_MAX:g}")
        return Pose(stamp_ns, x, fault)
