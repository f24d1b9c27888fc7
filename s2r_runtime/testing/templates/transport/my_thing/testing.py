"""A robot's end of the transport, for its kit: as simple as can be, on ports of its own."""

import json
import select
import socket

from my_thing.transport import MyThingTransport
from s2r_runtime.messages import Command
from s2r_runtime.testing import TransportKit


class RobotEnd:
    """Sends what it is told to, and keeps what it hears."""

    def __init__(self, line, runtime):
        self._line, self._runtime = line, runtime

    def publish(self, seq, stamp_ns, x):
        self.publish_raw(json.dumps({"type": "observation", "seq": seq, "stamp_ns": stamp_ns, "x": x}).encode())

    def publish_raw(self, data):
        self._line.sendto(data[:65000], self._runtime)

    def received(self):
        commands = []
        while select.select([self._line], [], [], 0.05)[0]:
            p = json.loads(self._line.recv(65536))
            commands.append(Command(p["seq"], p["t_ns"], p["source"], tuple(p["u"]), p["obs_seq"], p["ttl_ns"]))
        return commands


class Rig:
    """A transport that is not open yet, and the robot's end that reaches it once it is."""

    states, inputs = ("x", "y", "theta"), ("v", "w")

    def __init__(self):
        self._line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._line.bind(("127.0.0.1", 0))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.options = {"port": port, "robot_host": "127.0.0.1", "robot_port": self._line.getsockname()[1]}
        self.transport = MyThingTransport(self.options, self.states, self.inputs)
        self.robot = RobotEnd(self._line, ("127.0.0.1", port))

    def twin(self):
        return RobotEnd(self._line, ("127.0.0.1", self.options["port"]))  # behind one address, as by a router

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._line.close()


class MyThingKit(TransportKit):
    """Everything that the runtime relies on. What the protocol can't carry, say here: see `TransportKit`."""

    rig = Rig
