"""A robot as a process of its own, at the end of a real link: Zenoh, MAVLink over UDP, or CAN. It can be told to lie.

    python link_robot.py FOLDER '{"kind": "zenoh", "endpoint": "tcp/127.0.0.1:7000"}'

The physics are those of `loop_robot`; what the link says is made by each plug-in's own test kit, by other libraries than the transport's
where there are any. It publishes every DT, stops when the last command is older than TTL_S, and notes every command that it heard in
FOLDER/applied.jsonl. A line on stdin is what it does next, as JSON:

    {"lie": {"x": [...], "later": 0, "behind_s": 0, "times": 5}}    the next observations are spoiled like this
    {"garbage": [0, 1, 8, 64]}                                      bytes that mean nothing, of these lengths
    {"away": 1.5}                                                   it leaves the link for so long, and comes back
    {"reboot": true}                                                it counts, and its clock begins, from zero
    {"hand": true}                                                  a person presses its button, or takes it over
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import select
import signal
import time
from pathlib import Path
from typing import Any

from loop_robot import saturated

DT = 0.033
TTL_S = 0.5
LATE_S = 1.0
"""A robot that was stopped for longer does not make up for it."""


def end_of(options: dict[str, Any]) -> Any:
    """The kit's robot for this link."""
    if options["kind"] == "zenoh":
        from s2r_zenoh.testing import Robot as ZenohRobot

        return ZenohRobot(options["endpoint"])
    if options["kind"] == "can":
        from s2r_can.testing import CLASSIC
        from s2r_can.testing import Robot as CanRobot

        return CanRobot(options["bus"], CLASSIC)
    return MavlinkEnd(options["port"])


class MavlinkEnd:
    """The kit's robot on UDP, which can leave its line and come back."""

    def __init__(self, port: int) -> None:
        self._port, self._robot, self.hands = port, None, False

    def _open(self) -> Any:
        from s2r_mavlink.rover_lines import UdpLine
        from s2r_mavlink.testing import Robot

        if self._robot is None:
            self._robot = Robot(UdpLine("127.0.0.1", self._port))
        return self._robot

    def publish(self, seq: int, stamp_ns: int, x: tuple[float, ...]) -> None:
        robot = self._open()
        if self.hands:  # somebody has it in MANUAL
            robot.line.write(robot.pack(robot.heartbeat(mode=0)))
        robot.publish(seq, stamp_ns, x)

    def publish_raw(self, data: bytes) -> None:
        self._open().publish_raw(data)

    def received(self) -> list[Any]:
        return list(self._open().received())

    def close(self) -> None:
        if self._robot is not None:
            self._robot.line.close()
            self._robot = None


class LinkRobot:
    """One robot, its link and what it is told to do."""

    def __init__(self, folder: Path, options: dict[str, Any]) -> None:
        self.kind, self.end = options["kind"], end_of(options)
        self.x, self.acting, self.u = [0.0, 0.0, 0.0], (0.0, 0.0), (0.0, 0.0)
        self.seq, self.stamp_ns, self.until_s, self.away_s = 1, 10**9, 0.0, 0.0
        self.lie: dict[str, Any] = {}
        self.said = b""
        self.random = random.Random(options.get("seed", 1))
        self.applied = (folder / "applied.jsonl").open("a", buffering=1)

    def run(self) -> None:
        due = time.monotonic()
        while True:
            if time.monotonic() >= self.away_s:
                with contextlib.suppress(OSError):
                    self.publish()
            due = max(due + DT, time.monotonic() - LATE_S)
            while (left := due - time.monotonic()) > 0.0:
                if select.select([0], [], [], min(left, 0.01))[0]:
                    self.obey()
                if time.monotonic() >= self.away_s:
                    with contextlib.suppress(OSError):
                        self.listen()
            self.step()

    def publish(self) -> None:
        noisy = [value + self.random.gauss(0.0, 1e-4) for value in self.x]
        seq, stamp_ns, x = self.seq, self.stamp_ns, (noisy[0], noisy[1], math.remainder(noisy[2], math.tau))
        if self.lie.get("times", 0) > 0:
            self.lie["times"] -= 1
            seq, stamp_ns = max(0, seq + self.lie.get("later", 0)), max(0, stamp_ns - round(1e9 * self.lie.get("behind_s", 0.0)))
            x = tuple(map(float, self.lie.get("x", x)))
            for _ in range(self.lie.get("copies", 0)):
                self.end.publish(seq, stamp_ns, x)
        self.end.publish(seq, stamp_ns, x)

    def listen(self) -> None:
        for command in self.end.received():
            self.u, self.until_s = tuple(command.u), time.monotonic() + TTL_S
            self.applied.write(json.dumps({"u": self.u, "at": time.monotonic()}) + "\n")

    def step(self) -> None:
        v, w = self.acting
        self.acting = saturated(*(self.u if time.monotonic() < self.until_s else (0.0, 0.0)))
        middle = self.x[2] + 0.5 * w * DT
        self.x = [self.x[0] + v * DT * math.cos(middle), self.x[1] + v * DT * math.sin(middle), self.x[2] + w * DT]
        self.seq += 1
        self.stamp_ns += round(DT * 1e9)

    def obey(self) -> None:
        """What stands on stdin, all of it: what a buffer of Python's held no `select` would tell of."""
        data = os.read(0, 65536)
        if not data:
            os._exit(0)
        *lines, self.said = (self.said + data).split(b"\n")
        for line in lines:
            self.do(json.loads(line))

    def do(self, told: dict[str, Any]) -> None:
        if "lie" in told:
            self.lie = {"times": 5, **told["lie"]}
        elif "garbage" in told:
            for size in told["garbage"]:
                self.end.publish_raw(self.random.randbytes(size))
        elif "away" in told:
            self.end.close()
            self.away_s = time.monotonic() + told["away"]
        elif "reboot" in told:
            self.seq, self.stamp_ns = 1, 10**9
        elif self.kind == "zenoh":
            if told["hand"]:
                self.end.override(b'{"kind": "emergency_stop", "detail": "button"}')
        elif self.kind == "can":
            self.end.stop = int(told["hand"])
        else:
            self.end.hands = told["hand"]


def main() -> None:
    """Until it is killed, or nobody talks to it any more."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("options", type=json.loads)
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    LinkRobot(arguments.folder, arguments.options).run()


if __name__ == "__main__":
    main()
