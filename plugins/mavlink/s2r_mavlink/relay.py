"""A ground station, or somebody else's controller, that reaches the robot through the runtime: what may pass on to the robot.

The robot's frames go to everybody, as they came. The other way:

    ground      everything but what moves the robot in the mode in which the runtime drives it: setpoints, and commands to go somewhere.
                A person drives by changing the mode first, which the runtime sees and which stops it.
    companion   nothing but what is listed here: a sensor's pose, time, questions. A controller's place is behind the gate.

What would have moved the robot is recorded in the log, up to a number per second. Nobody passes with the robot's or the runtime's own
ids, and nobody faster than a robot's line can be. Frames pass unchanged, signature and all: the robot judges them itself.
"""

from __future__ import annotations

import select

from s2r_mavlink.dialect import COMMAND_INT, COMMAND_LONG, MESSAGES, SET_MESSAGE_INTERVAL
from s2r_mavlink.endpoints import OTHERS_MOST, Endpoint
from s2r_mavlink.frames import header, payload
from s2r_runtime.messages import Frame

KEPT_PER_SECOND = 32
BYTES_PER_SECOND, BURST_BYTES = 92_160, 4096
"""Passed on to the robot at most: what a serial line at 921 600 baud, the fastest in common use, carries. More only crowds out commands.
At once: some fifty of the longest frames.
"""
SECOND = 1_000_000_000

MANUAL_CONTROL, RC_CHANNELS_OVERRIDE, SET_MODE = 69, 70, 11
SETPOINTS = frozenset((82, 84, 86, 139))
"""SET_ATTITUDE_TARGET, SET_POSITION_TARGET_LOCAL_NED, SET_POSITION_TARGET_GLOBAL_INT, SET_ACTUATOR_CONTROL_TARGET."""
MISSION_ITEMS = frozenset((39, 73))
CURRENT_AT, GO_THERE_NOW = 35, 2
"""Byte `current` of a mission item's payload: 2 is no mission but "go there", for ArduPilot's GUIDED mode."""
GO_COMMANDS = frozenset((192, 213, 43_000, 43_001, 43_002))
"""DO_REPOSITION, NAV_SET_YAW_SPEED, GUIDED_CHANGE_SPEED, _ALTITUDE, _HEADING."""
REQUEST_DATA_STREAM = 66
MOVES = SETPOINTS | {MANUAL_CONTROL, RC_CHANNELS_OVERRIDE, SET_MODE}
"""What of a companion's is logged as an attempt to command; the rest that isn't listed below is dropped and counted."""

COMPANION_MAY = frozenset((0, 2, 4, 20, 21, 102, 103, 104, 111, 132, 232, 233, 253, 330, 331))
"""HEARTBEAT, SYSTEM_TIME, PING, PARAM_REQUEST_READ and _LIST, VISION_POSITION and _SPEED_ESTIMATE, VICON_POSITION_ESTIMATE, TIMESYNC,
DISTANCE_SENSOR, GPS_INPUT, GPS_RTCM_DATA, STATUSTEXT, OBSTACLE_DISTANCE, ODOMETRY.
"""
COMPANION_MAY_ASK = frozenset((510, 512, 519, 520))
"""GET_MESSAGE_INTERVAL, REQUEST_MESSAGE, REQUEST_PROTOCOL_VERSION, REQUEST_AUTOPILOT_CAPABILITIES."""


class Relay:
    """One side's endpoint. channel: `ground` or `companion`. reserved: (system, component) pairs that nobody there may bear.

    passed, refused (would have moved the robot), blocked (anything else that didn't pass): counts; disturbed: rates were asked for.
    """

    def __init__(self, channel: str, line: Endpoint, reserved: frozenset[tuple[int, int]]) -> None:
        self.channel, self.line, self._reserved = channel, line, reserved
        self._second = self._kept = 0
        self._room_bytes, self._room_ns = float(BURST_BYTES), 0
        self.passed = self.refused = self.blocked = self.unlogged = 0
        self.disturbed = False

    def open(self, poller: select.epoll) -> None:
        """Opens the endpoint."""
        self.line.open(poller)

    def take(self) -> tuple[list[bytes], list[Frame]]:
        """What came from there: (frames for the robot, refused ones for the log)."""
        through: list[bytes] = []
        kept: list[Frame] = []
        for source, arrival_ns, frames in self.line.read(OTHERS_MOST):
            self.line.accept(source, arrival_ns)
            for data in frames:
                facts = header(data)
                if (facts.system, facts.component) in self._reserved:
                    self.blocked += 1
                elif self._moves(facts.number, data):
                    self.refused += 1
                    if self._room(arrival_ns):
                        kept.append(Frame(arrival_ns, self.channel, data))
                elif (self.channel == "ground" or self._listed(facts.number, data)) and self._carried(data, arrival_ns):
                    self.passed += 1
                    through.append(data)
                else:
                    self.blocked += 1
        return through, kept

    def _moves(self, number: int, data: bytes) -> bool:
        if number in SETPOINTS:
            return True
        if number in MISSION_ITEMS:
            content = payload(data)
            return len(content) > CURRENT_AT and content[CURRENT_AT] == GO_THERE_NOW
        command = _command(number, data)
        if command in GO_COMMANDS:
            return True
        if number == REQUEST_DATA_STREAM or command == SET_MESSAGE_INTERVAL:
            self.disturbed = self.disturbed or self.channel == "ground"
        return self.channel == "companion" and (number in MOVES or (command is not None and command not in COMPANION_MAY_ASK))

    def _listed(self, number: int, data: bytes) -> bool:
        return number in COMPANION_MAY or _command(number, data) in COMPANION_MAY_ASK

    def _carried(self, data: bytes, now_ns: int) -> bool:
        """Whether the robot's line has room for it: a bucket of BURST_BYTES that fills at BYTES_PER_SECOND."""
        since_s = max(0, now_ns - self._room_ns) / SECOND
        self._room_bytes = min(float(BURST_BYTES), self._room_bytes + since_s * BYTES_PER_SECOND)
        self._room_ns = max(now_ns, self._room_ns)
        if len(data) > self._room_bytes:
            return False
        self._room_bytes -= len(data)
        return True

    def _room(self, now_ns: int) -> bool:
        """Whether the log takes one more: their number per second is bounded, so that a stranger can't fill the log."""
        if now_ns // SECOND != self._second:
            self._second, self._kept = now_ns // SECOND, 0
        self._kept += 1
        self.unlogged += self._kept > KEPT_PER_SECOND
        return self._kept <= KEPT_PER_SECOND


def _command(number: int, data: bytes) -> int | None:
    """The MAV_CMD of a COMMAND_LONG or COMMAND_INT."""
    if number not in (COMMAND_LONG, COMMAND_INT):
        return None
    return int(MESSAGES[number].unpack(payload(data))[7])
