"""Commands to the robot, and what others command. The bytes depend on commands and on what was decoded before: an audit repeats them."""

from __future__ import annotations

import hashlib
import math

from s2r_ros2.cdr import Malformed
from s2r_ros2.keys import attached, attachment, envelope, opened
from s2r_ros2.observer import Observer
from s2r_ros2.options import TWIST_FIELDS, Options
from s2r_ros2.payloads import decode_twist, decode_twist_stamped, encode_twist, encode_twist_stamped
from s2r_ros2.pose import NUMBER_MAX
from s2r_runtime.messages import Command, Frame


class Commander:
    """inputs: the model's names. The stamp of a command is the robot's time as its newest observation tells it."""

    def __init__(self, options: Options, inputs: tuple[str, ...], observer: Observer) -> None:
        self._inputs, self._observer = inputs, observer
        self._columns = tuple(TWIST_FIELDS.index(field) for field in options.fields)
        self._stamped, self._frame = options.command == "twist_stamped", options.command_frame
        self._rmw = options.layout == "rmw"
        # opaque to those who get it (rmw_zenoh makes it of the liveliness token); the same from start to start, so that it can be audited
        self._gid = hashlib.sha256(f"s2r {options.node} {options.command_topic}".encode()).digest()[:16]
        self._sequence = 0
        self.malformed = 0

    def encode(self, command: Command) -> bytes:
        """The frame of a command. Raises ValueError if it is not finite or not of shape (nu,)."""
        if len(command.u) != len(self._inputs):
            raise ValueError(f"command has {len(command.u)} inputs, must have {len(self._inputs)}: {', '.join(self._inputs)}")
        if not all(map(math.isfinite, command.u)):
            raise ValueError(f"command is {command.u}, must be finite")
        twist = [0.0] * len(TWIST_FIELDS)
        for column, value in zip(self._columns, command.u, strict=True):
            twist[column] = value
        now_ns = self._observer.robot_time(command.t_ns)
        payload = encode_twist_stamped(now_ns, self._frame, tuple(twist)) if self._stamped else encode_twist(tuple(twist))
        self._sequence += 1
        return envelope(attachment(self._sequence, now_ns, self._gid) if self._rmw else b"", payload)

    def proposal(self, frame: Frame) -> Command:
        """Somebody else's command."""
        try:
            extra, payload = opened(frame.data)
            sequence = attached(extra).sequence if self._rmw else 0
            twist = decode_twist_stamped(payload) if self._stamped else decode_twist(payload)
            u = tuple(twist[column] for column in self._columns)
            for name, value in zip(self._inputs, u, strict=True):
                if not -NUMBER_MAX <= value <= NUMBER_MAX:
                    raise Malformed(f"{name} is {value:g}")
        except Malformed as error:
            self.malformed += 1
            return Command(0, frame.arrival_ns, "external", (), 0, 0, fault=f"malformed proposal: {error}")
        return Command(sequence, frame.arrival_ns, "external", u, max(self._observer.newest, 0), 0)
