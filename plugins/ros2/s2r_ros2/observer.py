"""What the robot's messages about its pose mean: observations. Depends on the frames only (`hookspecs.Transport.decode`).

A message counts if it is exactly of its type, of the frames that the profile names (or that the first one had), of the publisher that is
listened to (rmw: its gid; another one is a fault as long as the first is heard), stamped, in order, and a pose on the plane; otherwise
nothing of it counts, and a faulty observation says why. One that is older than the newest is dropped and counted, one that took longer
than `max_age` beyond the fastest is faulty. Observations are numbered here: by one, and by one more for each that was lost (rmw: by the
sequence number; bridge, and transforms: by the stamps, if the profile says how far they are apart).
"""

from __future__ import annotations

from s2r_ros2.cdr import Malformed
from s2r_ros2.clock import RobotClock
from s2r_ros2.keys import Attached, attached, opened
from s2r_ros2.options import Options
from s2r_ros2.payloads import Located, decode_odometry, decode_pose_stamped, decode_transforms
from s2r_ros2.pose import Planar
from s2r_runtime.messages import Frame, LinkChanged, Observation

LOST_MOST = 1_000_000
"""Counted at once; more is no loss but another count."""


class Told:
    """The poses in payloads, as far as the message itself tells: its type, its frames, its numbers. Bags are read through this too."""

    def __init__(self, options: Options) -> None:
        self._kind = options.pose
        self._frame, self._child = options.frame.lstrip("/"), options.child_frame.lstrip("/")
        self._planar = Planar(options.quantities, options.max_tilt)
        self._stamped = options.stamp == "header"

    def poses(self, payload: bytes) -> list[tuple[int, tuple[float, ...]]]:
        """(stamp ns, states) of each pose that is meant. Raises Malformed."""
        if self._kind == "tf":
            ours = [at for at in decode_transforms(payload) if (at.frame.lstrip("/"), at.child.lstrip("/")) == (self._frame, self._child)]
        else:
            ours = [decode_odometry(payload) if self._kind == "odometry" else decode_pose_stamped(payload)]
        return [(self._stamp(at), self._states(at)) for at in ours]

    def _stamp(self, at: Located) -> int:
        if self._stamped and not at.stamp_ns:
            raise Malformed("its stamp is zero (stamp = arrival is for robots that do not stamp)")
        return at.stamp_ns

    def _states(self, at: Located) -> tuple[float, ...]:
        states = self._planar.states(at)
        frame, child = at.frame.lstrip("/"), at.child.lstrip("/")
        wanted = (self._frame or frame, self._child or child)
        if (frame, child) != wanted and self._kind != "tf":
            raise Malformed(f"it is of {child or 'the robot'} in {frame!r}, not of {wanted[1] or 'the robot'} in {wanted[0]!r}"[:200])
        self._frame, self._child = wanted
        return states


class Observer:
    """Counters: malformed, lost, foreign (nothing of ours in it); those of the clock are `clock`'s."""

    def __init__(self, options: Options) -> None:
        self._told = Told(options)
        self._rmw = options.layout == "rmw"
        self._counted = self._rmw and options.pose != "tf"  # who publishes transforms counts those of other frames too
        self._arrival = options.stamp == "arrival"
        self._silence_ns = round(options.observation_timeout * 1e9)
        self._max_age_ns = options.max_age * 1e9
        self._period_ns = options.period * 1e9
        self.clock = RobotClock(self._silence_ns)
        self._publisher: Attached | None = None
        self._seq = -1
        self.malformed = self.lost = self.foreign = 0

    @property
    def newest(self) -> int:
        """`seq` of the newest observation; -1 before the first."""
        return self._seq

    def robot_time(self, t_ns: int) -> int:
        """The robot's clock at the host's t_ns, as far as it is known: the newest stamp and what passed since its arrival."""
        if self.clock.newest is None:
            return 0
        s, a = self.clock.newest
        return s + min(max(t_ns - a, 0), self._silence_ns)

    def decode(self, frame: Frame) -> list[Observation | LinkChanged]:
        """What a message about the pose means."""
        try:
            extra, payload = opened(frame.data)
            publisher = attached(extra) if self._rmw else None
            poses = self._told.poses(payload)
            if poses and publisher is not None:
                self._same(publisher, frame.arrival_ns)
        except Malformed as error:
            self.malformed += 1
            return [self._fault(f"malformed {frame.channel}: {error}")]
        if not poses:
            self.foreign += 1
        said: list[Observation | LinkChanged] = []
        for stamp_ns, x in poses:
            said += self._observed(frame.arrival_ns if self._arrival else stamp_ns, frame.arrival_ns, x, publisher)
        return said

    def _same(self, publisher: Attached, arrival_ns: int) -> None:
        """Two publishers on one topic are two robots, or a robot and somebody who poses as it."""
        known, newest = self._publisher, self.clock.newest
        if known is not None and newest is not None and known.gid != publisher.gid and arrival_ns - newest[1] < self._silence_ns:
            raise Malformed("another publisher is on the topic")

    def _fault(self, why: str) -> Observation:
        stamp = self.clock.stamp() if self.clock.newest is not None else 0
        return Observation(max(self._seq, 0), stamp, (), fault=why)

    def _observed(self, s: int, a: int, x: tuple[float, ...], publisher: Attached | None) -> list[Observation | LinkChanged]:
        before = self.clock.newest
        if before is not None and s > before[0] and self._stands(publisher, a - before[1]):
            self.malformed += 1
            return [self._fault("malformed pose: its sequence number does not rise with its stamp")]
        verdict = self.clock.take(s, a)
        if verdict in ("old", "ahead"):
            return []
        lost = self._gap(s, before[0], publisher) if before is not None and verdict == "taken" else 0
        self._publisher = publisher
        self.lost += lost
        said: list[Observation | LinkChanged] = []
        if before is None:
            self._seq = 0
            said = [LinkChanged(a, up=True)]
        elif verdict == "restarted":
            self._seq += 2
            said = [LinkChanged(a, up=False, detail="the robot's clock was set, or began anew"), LinkChanged(a, up=True)]
        else:
            self._seq += 1 + lost
        late = self.clock.age_ns(s, a)
        if late > self._max_age_ns:
            return [*said, self._fault(f"came {late * 1e-9:.2f} s later than the fastest")]
        return [*said, Observation(self._seq, self.clock.stamp(), x)]

    def _stands(self, publisher: Attached | None, silent_ns: int) -> bool:
        """Whether a publisher that is known, and was not silent, counted no further. Two poses of one message have one number."""
        known = self._publisher
        if publisher is None or known is None or publisher is known or publisher.gid != known.gid:
            return False
        return publisher.sequence <= known.sequence and silent_ns < self._silence_ns

    def _gap(self, s: int, before: int, publisher: Attached | None) -> int:
        """How many were lost between two that came."""
        known = self._publisher
        lost = 0
        if self._counted:
            if publisher is not None and known is not None and publisher.gid == known.gid:
                lost = publisher.sequence - known.sequence - 1
        elif self._period_ns:
            lost = round((s - before) / self._period_ns) - 1
        return lost if 0 < lost <= LOST_MOST else 0
