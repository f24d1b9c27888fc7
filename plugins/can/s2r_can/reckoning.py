"""When the pose is reckoned on: the wheels' messages as they come, and the odometry that they drive."""

from __future__ import annotations

from collections.abc import Iterable

from s2r_can.layout import Group, Layout
from s2r_can.odometry import Odometry
from s2r_can.options import Options

Pose = tuple[float, float, float]

MAX_STEP_NS = 1_000_000_000
"""A pose is not reckoned over longer silences."""


def odometry_of(options: Options) -> Odometry | None:
    """What reckons the pose, if the profile wants that."""
    o = options.dead_reckoning
    if not o:
        return None
    return Odometry(track=o.get("track", 0.0), radius=o.get("wheel_radius", 0.0), start=o.get("start", (0.0, 0.0, 0.0)))


class Reckoning:
    """values: where the speeds are, SI. `last`: the group with which a set of speeds is complete; None where nothing is reckoned."""

    def __init__(self, layout: Layout, odometry: Odometry | None, values: list[float]) -> None:
        self._at, self._values = layout.reckoning, values
        self._odometry = odometry if layout.reckoning else None
        used = set(layout.reckoning.values())
        self._groups = [group for group in layout.groups if used & set(group.into)]
        self.last = self._groups[-1] if self._groups else None
        self._known: set[int] = set()
        self._last_ns: int | None = None

    @property
    def pose(self) -> Pose:
        """Where the robot is."""
        return self._odometry.pose if self._odometry is not None else (0.0, 0.0, 0.0)

    def forget(self, groups: Iterable[Group]) -> None:
        """What these say is not known any more."""
        self._known.difference_update(group.index for group in groups)

    def rest(self) -> None:
        """How the robot moved until now is not known: the pose goes on from where it was."""
        self._last_ns = None

    def came(self, group: Group, now_ns: int) -> Pose | None:
        """A group came; where that moved the pose, the pose."""
        odometry, values, at = self._odometry, self._values, self._at
        self._known.add(group.index)
        if odometry is None or group is not self.last or not all(g.index in self._known for g in self._groups):
            return None
        last_ns, self._last_ns = self._last_ns, now_ns
        heading = values[at["heading"]] if "heading" in at else None
        v, w = (values[at["speed"]], 0.0) if "speed" in at else odometry.wheels(values[at["left"]], values[at["right"]])
        if "yaw_rate" in at:
            w = values[at["yaw_rate"]]
        if last_ns is None or not 0 <= now_ns - last_ns <= MAX_STEP_NS:
            odometry.rest(heading)
            last_ns = now_ns
        odometry.move((v, w), (now_ns - last_ns) * 1e-9, heading)
        return odometry.pose
