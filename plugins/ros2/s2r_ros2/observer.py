"""What the robot's messages about its pose mean: observations. Depends on the frames only (`hookspecs.Transport.decode`).

A message counts if it is exactly of its type, of the frames that the profile names (or that the first one had), of the publisher that is
listened to (rmw: its gid; another one is a fault as long as the first is heard), stamped, in order, and a pose on the plane; otherwise
nothing of it counts, and a faulty observation says why. One that is older than the newest is dropped and counted, one that took longer
than `max_age` beyond the fastest is faulty. Observations are numbered here: by one, and by one more for each that was lost (rmw: by the
sequence number; bridge, and transforms: by the stamps, if the profile says how far they are apart).

Two robots (`s2r_runtime.twins`). The publisher that is listened to goes on after another one was heard; or, where publishers can't be told
apart, stamps or sequence numbers go on in two tracks, or stamps come CROWDED times as often as the profile says.
"""

from __future__ import annotations

from collections import deque

from s2r_ros2.cdr import Malformed
from s2r_ros2.clock import RobotClock
from s2r_ros2.keys import Attached, attached, opened
from s2r_ros2.options import Options
from s2r_ros2.payloads import Located, decode_odometry, decode_pose_stamped, decode_transforms
from s2r_ros2.pose import Planar
from s2r_runtime.messages import Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged
from s2r_runtime.twins import Pair, Track

Said = Observation | ObservationRefused | LinkChanged | OverrideChanged

LOST_MOST = 1_000_000
"""Counted at once; more is no loss but another count."""
EARLY_NS = 500_000_000
"""By which a pose may be older than the first one and be no more than late."""
CROWDED, INTERVALS = 1.6, 16
"""A robot keeps its period within some percent; two robots halve it. Judged over so many intervals of stamps, which no network changes."""


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
        self._named, self._counts, self._crowd = Pair(), Pair(signs=2), Pair()
        self._track = Track(early=EARLY_NS, deep=1 << 62)
        self._stamps: deque[int] = deque(maxlen=INTERVALS + 1)
        self._repeats = options.pose == "tf"  # a transform is often published again as it was
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

    def decode(self, frame: Frame) -> list[Said]:
        """What a message about the pose means."""
        said: list[Said] = []
        try:
            extra, payload = opened(frame.data)
            publisher = attached(extra) if self._rmw else None
            poses = self._told.poses(payload)
            if poses and publisher is not None:
                said += self._same(publisher, frame.arrival_ns)
        except Malformed as error:
            self.malformed += 1
            return [self._fault(f"malformed {frame.channel}: {error}")]
        if not poses:
            self.foreign += 1
        for stamp_ns, x in poses:
            said += self._observed(frame.arrival_ns if self._arrival else stamp_ns, frame.arrival_ns, x, publisher)
        return said

    def _same(self, publisher: Attached, arrival_ns: int) -> list[Said]:
        """Two publishers on one topic are two robots, or a robot and somebody who poses as it. One that falls silent was restarted."""
        known, newest = self._publisher, self.clock.newest
        if known is None or newest is None:
            return []
        if known.gid == publisher.gid:
            if self._named.goes_on(arrival_ns):
                return [_twin(arrival_ns, f"publisher {known.gid.hex()} goes on after another one was heard")]
        elif arrival_ns - newest[1] < self._silence_ns:
            self._named.other()
            raise Malformed("another publisher is on the topic")
        else:
            self._named.forget()
        return []

    def _fault(self, why: str) -> Observation:
        stamp = self.clock.stamp() if self.clock.newest is not None else 0
        return Observation(max(self._seq, 0), stamp, (), fault=why)

    def _observed(self, s: int, a: int, x: tuple[float, ...], publisher: Attached | None) -> list[Said]:
        before = self.clock.newest
        if before is not None and s > before[0] and self._stands(publisher, a - before[1]):
            self.malformed += 1
            self._counts.other()
            return [self._fault("malformed pose: its sequence number does not rise with its stamp")]
        verdict = self.clock.take(s, a)
        if verdict == "old":
            return self._old(s, a, x)
        if verdict == "ahead":
            self._counts.other()
            return [ObservationRefused(a, "its stamp is from the future")]
        lost = self._gap(s, before[0], publisher) if before is not None and verdict == "taken" else 0
        self._publisher = publisher
        self.lost += lost
        said: list[Said] = []
        if before is None:
            self._seq = 0
            said = [LinkChanged(a, up=True)]
        elif verdict == "restarted":
            self._seq += 2
            self._forget()
            said = [LinkChanged(a, up=False, detail="the robot's clock was set, or began anew"), LinkChanged(a, up=True)]
        else:
            self._seq += 1 + lost
            said = self._two(s, a)
        self._track.accept(s, x)
        late = self.clock.age_ns(s, a)
        if late > self._max_age_ns:
            return [*said, self._fault(f"came {late * 1e-9:.2f} s later than the fastest")]
        return [*said, Observation(self._seq, self.clock.stamp(), x)]

    # ------------------------------------------------------------------ two robots, echoes, late messages

    def _old(self, s: int, a: int, x: tuple[float, ...]) -> list[Said]:
        """A pose that is not newer than the newest."""
        kind = self._track.judge(s, x)
        if kind == "echo":
            again = self._repeats and self.clock.newest is not None and s == self.clock.newest[0]
            return [] if again else [ObservationRefused(a, "an echo: this pose was heard before")]
        if kind == "late" and not self._crowds(s):
            return [ObservationRefused(a, "a late pose: a newer one was heard before")]
        self._counts.other()
        return [ObservationRefused(a, "a pose with an old stamp that the robot did not send when it was due")]

    def _crowds(self, s: int) -> bool:
        """Whether there is no room for a lost pose of this stamp between those that came."""
        earlier = max((one for one in self._stamps if one < s), default=None)
        later = min((one for one in self._stamps if one > s), default=None)
        return bool(self._period_ns) and earlier is not None and later is not None and later - earlier < 1.5 * self._period_ns

    def _two(self, s: int, a: int) -> list[Said]:
        """A pose was taken: is it one of two robots'?"""
        if self._counts.goes_on(a):
            return [_twin(a, "poses go on in two tracks of stamps or sequence numbers")]
        self._stamps.append(s)
        span, most = s - self._stamps[0], INTERVALS * self._period_ns / CROWDED
        if len(self._stamps) > INTERVALS and span < most:
            self._crowd.other()
            if self._crowd.goes_on(a):
                each, told = span * 1e-6 / INTERVALS, self._period_ns * 1e-6
                return [_twin(a, f"a pose comes every {each:.3g} ms, transport.period is {told:.3g} ms: two robots, or another period")]
        return []

    def _forget(self) -> None:
        self._track.forget()
        self._stamps.clear()
        self._counts.forget()
        self._named.forget()

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


def _twin(t_ns: int, why: str) -> OverrideChanged:
    return OverrideChanged(t_ns, "robot_twin", why)
