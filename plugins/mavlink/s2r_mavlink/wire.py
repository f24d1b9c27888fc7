"""What frames mean, and how a command is written. Depends on frames and what was decoded and encoded before, never on the link or a key.

Channels of frames:

    robot      a whole MAVLink frame of the robot's, as it came (checked, and its signature verified, where it came in: `Door`)
    ground,
    companion  a frame of somebody else that would move the robot: it was not passed on, it is logged and refused
    door       a note of what was noticed where frames come in: `dropped N`, `rejected ...`, `twin`, `alone`, `elsewhere`, `refused WHY`
    command    outbound: SET_POSITION_TARGET_LOCAL_NED in the body's frame, numbered by its command; link number and signature are put on it
               when it leaves

A command (v, w) is vx = v, vy = vz = 0 and yaw rate -w, type mask 1479: position, acceleration and yaw are ignored. ArduPilot's Rover takes
the speed from vx and vy together with the sign of vx, needs all acceleration bits masked and none of the velocity's (vz too).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

from s2r_mavlink.clock import RobotClock
from s2r_mavlink.dialect import (
    BODY_FRAMES,
    COMMAND_ACK,
    HEARTBEAT,
    MESSAGE_INTERVAL,
    MESSAGES,
    SET_POSITION_TARGET_LOCAL_NED,
    STATUSTEXT,
    TIMESYNC,
)
from s2r_mavlink.frames import build, header, is_frame, payload
from s2r_mavlink.options import INPUTS
from s2r_mavlink.pose import SOURCES, Pose, PoseSource
from s2r_mavlink.robot_state import RobotState, mode_number
from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged
from s2r_runtime.twins import AGAIN_NS, Pair, Track

Decoded = Observation | ObservationRefused | Command | LinkChanged | OverrideChanged
Fields = tuple[Any, ...]

BODY_NED = BODY_FRAMES[0]
VELOCITY_AND_YAW_RATE = 1479
IGNORES_VELOCITY, IGNORES_YAW_RATE = 1 | 2 | 4 | 8 | 16 | 32, 2048
NUMBER_MAX = 1e9
TWIN = "two robots answer to this system id"
ANSWERS_KEPT = 64
EARLY_NS = 500_000_000
"""By which an observation may be older than the first one and be no more than late."""
WHY_REFUSED = {"echo": "an echo of a message about the pose", "out_of_order": "a message about the pose that is out of order"}


class Wire:
    """Decodes and encodes for one robot. options: checked. heard: (number, fields) of what the robot answered, newest last.

    malformed, stale: observations that can't be used; ups: how often the link was said to be up.
    """

    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        self._inputs = inputs
        self._system, self._own = options["system"], options["own_component"]
        self._target = (options["system"], options["component"])
        self._max_age_ns = options["max_age"] * 1e9
        self.clock = RobotClock(round(options["observation_timeout"] * 1e9))
        self.pose = PoseSource(options["pose"], states, tuple(options["origin"]))
        self.robot = RobotState(*(mode_number(options[name]) if options[name] else None for name in ("mode", "stop_mode")))
        self.heard: deque[tuple[int, Fields]] = deque(maxlen=ANSWERS_KEPT)
        self.malformed = self.stale = 0
        self._seen = self._commands = 0
        self._twin = False
        self._twin_said_ns = -AGAIN_NS
        self._track, self._counts = Track(early=EARLY_NS, deep=1 << 62), Pair(signs=2)
        self.ups = 0
        self._columns = tuple(inputs.index(name) if name in inputs else None for name in INPUTS)
        takers: dict[int, Callable[[Fields, Frame], list[Decoded]]] = {
            HEARTBEAT: self._heartbeat,
            COMMAND_ACK: self._answer,
            MESSAGE_INTERVAL: self._note_interval,
            STATUSTEXT: self._note_text,
            TIMESYNC: self._time,
        }
        self._takers = takers
        self._pose_numbers = frozenset(SOURCES[options["pose"]])

    # ------------------------------------------------------------------ in

    def decode(self, frame: Frame) -> list[Decoded]:
        """See `hookspecs.Transport.decode`."""
        if frame.channel == "robot":
            return self._from_robot(frame)
        if frame.channel == "door":
            return self._noticed(frame)
        if frame.channel in ("ground", "companion"):
            return [self._refused(frame)]
        return []

    def _noticed(self, frame: Frame) -> list[Decoded]:
        """A note of the door's."""
        self._twin = frame.data == b"twin" or (self._twin and frame.data != b"alone")
        if frame.data == b"twin":
            return [*self._two_robots(frame.arrival_ns), self._faulty(TWIN)]
        if frame.data == b"elsewhere":
            return self._two_robots(frame.arrival_ns, f"{TWIN}, from two addresses")
        if frame.data.startswith(b"refused "):
            why = frame.data[8:].decode("ascii", "replace")
            return [ObservationRefused(frame.arrival_ns, WHY_REFUSED.get(why, f"a message about the pose: {why}")[:200])]
        return []

    def _two_robots(self, now_ns: int, why: str = TWIN) -> list[Decoded]:
        """Said again each second, as long as it is so."""
        if now_ns - self._twin_said_ns < AGAIN_NS:
            return []
        self._twin_said_ns = now_ns
        return [OverrideChanged(now_ns, "robot_twin", why)]

    def _from_robot(self, frame: Frame) -> list[Decoded]:
        data = frame.data
        if not is_frame(data):
            self.malformed += 1
            return []
        number = header(data).number
        message = MESSAGES.get(number)
        if message is None:
            return []
        content = payload(data)
        fields = message.unpack(content)
        if number in self._pose_numbers:
            pose = self.pose.take(number, fields)
            return [] if pose is None else self._observed(pose, content, frame.arrival_ns)
        taker = self._takers.get(number)
        return [] if taker is None else taker(fields, frame)

    def _observed(self, pose: Pose, content: bytes, now_ns: int) -> list[Decoded]:
        """A pose. content: the payload of the message that brought it."""
        verdict = self.clock.take(pose.stamp_ns, now_ns)
        if verdict in ("old", "ahead"):
            return [self._refusal(pose.stamp_ns, content, verdict, now_ns)]
        messages: list[Decoded] = []
        if self._twin or (verdict == "taken" and self._counts.goes_on(now_ns)):
            messages = self._two_robots(now_ns)
        if verdict == "restarted":
            self.pose.restarted()
            self._track.forget()
            self._counts.forget()
            messages += [LinkChanged(now_ns, up=False, detail="the robot's clock began anew"), *self.robot.restarted(now_ns)]
        if verdict == "restarted" or not self.ups:
            self.ups += 1
            messages.append(LinkChanged(now_ns, up=True))
        self._track.accept(pose.stamp_ns, content)
        messages.append(self._numbered(pose, self._fault(pose, now_ns)))
        return messages

    def _refusal(self, stamp_ns: int, content: bytes, verdict: str, now_ns: int) -> ObservationRefused:
        """A pose with a stamp that is not newer than the newest, or from the future."""
        kind = self._track.judge(stamp_ns, content) if verdict == "old" else "other"
        if kind == "other":
            self._counts.other()
        why = {"echo": "an echo of a pose", "late": "a late pose", "other": "a pose with a time since boot that is not the robot's"}[kind]
        return ObservationRefused(now_ns, why)

    def _fault(self, pose: Pose, now_ns: int) -> str:
        """Why the observation can't be used, or empty."""
        if pose.fault:
            self.malformed += 1
            return pose.fault
        if self._twin:
            return TWIN
        age_ns = self.clock.age_ns(pose.stamp_ns, now_ns)
        if age_ns > self._max_age_ns:
            self.stale += 1
            return f"it was {age_ns * 1e-9:.2f} s on its way"
        return self.robot.fault(now_ns)

    def _numbered(self, pose: Pose, fault: str) -> Observation:
        self._seen += 1
        return Observation(self._seen, self.clock.stamp(), pose.x, fault)

    def _faulty(self, fault: str) -> Observation:
        self._seen += 1
        return Observation(self._seen, self.clock.stamp() if self.ups else 0, (), fault)

    def _heartbeat(self, f: Fields, frame: Frame) -> list[Decoded]:
        return list(self.robot.heartbeat(f, frame.arrival_ns))

    def _answer(self, f: Fields, frame: Frame) -> list[Decoded]:
        command, result, system, component = f[0], f[1], f[4], f[5]
        if (system, component) == (self._system, self._own):
            self.robot.answer(command, result, frame.arrival_ns)
            self.heard.append((COMMAND_ACK, f))
        elif (system, component) == (0, 0):  # an older autopilot doesn't say whom it answers: good enough for a rate, not for a mode
            self.heard.append((COMMAND_ACK, f))
        return []

    def _note_interval(self, f: Fields, frame: Frame) -> list[Decoded]:
        self.heard.append((MESSAGE_INTERVAL, f))
        return []

    def _note_text(self, f: Fields, frame: Frame) -> list[Decoded]:
        self.heard.append((STATUSTEXT, f))
        return []

    def _time(self, f: Fields, frame: Frame) -> list[Decoded]:
        """An answered question about the time. What was asked is the host's clock then, so a made-up answer is one from the future or
        from long ago, and does not count.
        """
        if f[0] > 0:
            self.clock.answered(f[0], f[1], frame.arrival_ns)
        return []

    # ------------------------------------------------------------------ what others command

    def _refused(self, frame: Frame) -> Command:
        u: tuple[float, ...] = ()
        fault = "it is not a velocity with a yaw rate in the body's frame"
        if is_frame(frame.data) and header(frame.data).number == SET_POSITION_TARGET_LOCAL_NED:
            f = MESSAGES[SET_POSITION_TARGET_LOCAL_NED].unpack(payload(frame.data))
            mask, of_frame = f[12], f[15]
            if of_frame in BODY_FRAMES and not mask & (IGNORES_VELOCITY & ~7) and not mask & IGNORES_YAW_RATE:
                given = {"v": f[4], "w": -f[11]}
                u = tuple(given[name] for name in self._inputs)
                fault = "" if all(-NUMBER_MAX <= value <= NUMBER_MAX for value in u) else "it is no number"
        return Command(0, frame.arrival_ns, "external", () if fault else u, 0, 0, fault=fault)

    # ------------------------------------------------------------------ out

    def encode(self, command: Command) -> bytes:
        """The frame of a command, unsigned, numbered by its command. Raises ValueError if it is not finite or not of shape (nu,)."""
        if len(command.u) != len(self._inputs):
            raise ValueError(f"command has {len(command.u)} inputs, must have {len(self._inputs)}: {', '.join(self._inputs)}")
        if not all(map(math.isfinite, command.u)):
            raise ValueError(f"command is {command.u}, must be finite")
        v, w = (0.0 if column is None else command.u[column] for column in self._columns)
        if max(abs(v), abs(w)) > NUMBER_MAX:
            raise ValueError(f"command is {command.u}, must be finite and below {NUMBER_MAX:g}")
        time_ms = command.t_ns // 1_000_000 & 0xFFFFFFFF
        content = MESSAGES[SET_POSITION_TARGET_LOCAL_NED].pack(
            time_ms, 0.0, 0.0, 0.0, v, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0 - w, VELOCITY_AND_YAW_RATE, *self._target, BODY_NED
        )
        self._commands += 1
        return build(SET_POSITION_TARGET_LOCAL_NED, content, self._commands, self._system, self._own)
