"""Robots that send JSON over UDP, one object a datagram. SI units, states and inputs in the model's order.
observation  {"type": "observation", "seq": 7, "stamp_ns": 231000000, "x": [0.1, 0.2, 0.3]}     its count, its clock, its state
command      {"type": "command", "seq": 9, "obs_seq": 7, "ttl_ns": 100000000, "u": [0.1, 0.0], ...}  void ttl_ns after it came
"""

import contextlib
import math
import socket
import time

import msgspec

from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Frame, LinkChanged, Observation
from s2r_runtime.twins import Numbered

SO_RXQ_OVFL = 40  # Linux, socket(7): each datagram says how many were dropped before it, because the queue was full
LOST_NS = 500_000_000  # without an observation for so long, the link is down


class MyThingTransport:
    OPTIONS = {"port": "UDP port on which the robot reaches the runtime", "robot_host": "where the robot is", "robot_port": "its port"}

    def __init__(self, options, states, inputs):
        if wrong := set(options) ^ set(self.OPTIONS):
            raise ConfigError(f"transport.{min(wrong)}: the options of my_thing are {', '.join(self.OPTIONS)}, no more and no less")
        self._here, self._robot = ("", options["port"]), (options["robot_host"], options["robot_port"])
        self._nx, self._nu, self._others = len(states), len(inputs), Numbered()  # others: a second robot under this one's name
        self._socket = self._up = self._newest = self._answer = None
        self._last, self._decoded_ns, self._heard_ns = (-1, -1), 0, 0  # of the newest observation: seq and stamp, arrivals
        self._counts = dict.fromkeys(("received", "sent", "dropped_in", "dropped_out", "malformed", "lost"), 0)

    def open(self):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        try:
            self._socket.bind(self._here)
            self._socket.connect(self._robot)  # nobody else is heard
        except (OSError, TypeError, OverflowError) as error:
            raise ConfigError(f"transport: port {self._here[1]}, robot {self._robot}: {error}") from None
        self._heard_ns = time.monotonic_ns()

    def fileno(self):
        return self._socket.fileno()

    def receive(self):
        frames = []
        with contextlib.suppress(BlockingIOError, ConnectionRefusedError):  # nothing more, or the robot is not there
            while len(frames) < 1000:
                data, more, _, _ = self._socket.recvmsg(65536, socket.CMSG_SPACE(4))
                self._heard_ns = time.monotonic_ns()
                for _, _, dropped in more:
                    self._counts["dropped_in"] = int.from_bytes(dropped, "little")
                if data != self._newest:
                    self._newest, self._answer = data, None
                    frames.append(Frame(self._heard_ns, "observation", data))
                elif self._answer:  # the robot still waits: the command was lost on its way
                    self.send(self._answer)
        self._counts["received"] += len(frames)
        return frames

    def decode(self, frame):
        try:
            o = msgspec.json.decode(frame.data, type=Observation)
            if not (0 <= o.seq < 1 << 62 and 0 <= o.stamp_ns < 1 << 62 and len(o.x) == self._nx and all(map(math.isfinite, o.x))):
                raise ValueError("no observation of this robot")
        except (ValueError, RecursionError):  # msgspec's errors are ValueErrors
            self._counts["malformed"] += 1
            return []
        if frame.arrival_ns - self._decoded_ns > LOST_NS:
            self._last, self._others = (-1, -1), Numbered()  # it was silent: it may have been started anew, and counts from 0
        if o.seq <= self._last[0] or o.stamp_ns <= self._last[1]:
            return self._others.dropped(o.seq, o.stamp_ns, o.x, frame.arrival_ns)  # late, an echo, or another's
        self._counts["lost"] += o.seq - self._last[0] - 1 if self._last[0] >= 0 else 0
        self._last, self._decoded_ns = (o.seq, o.stamp_ns), frame.arrival_ns
        return [*self._others.taken(o.seq, o.stamp_ns, o.x, frame.arrival_ns), Observation(o.seq, o.stamp_ns, o.x)]

    def poll(self, now_ns):
        silent = now_ns - self._heard_ns > LOST_NS
        up = False if silent else True if self._last[0] >= 0 else self._up
        changed, self._up = up != self._up, up
        return [LinkChanged(now_ns, up=up, detail="nothing is heard of the robot" if silent else "")] if changed else []

    def encode(self, command):
        if len(command.u) != self._nu or not all(map(math.isfinite, command.u)):
            raise ValueError(f"u is {command.u}, must be {self._nu} finite inputs")
        return Frame(command.t_ns, "command", msgspec.json.encode(command), inbound=False)

    def send(self, frame):
        self._answer = frame
        try:
            self._counts["sent"] += self._socket.send(frame.data) > 0
        except OSError:  # the robot's time to live deals with it
            self._counts["dropped_out"] += 1

    def counters(self):
        return dict(self._counts)

    def close(self):
        self._socket = self._socket and self._socket.close()
