"""Another quadruped behind the built-in one's profile, from docs/zenoh.md alone: no physics, and habits that the stand-in doesn't have.

    python other_walker.py ENDPOINT [HABIT=VALUE]...

In lockstep, one period `dt` a command. It walks as `swaying_walker`, and beside that, by habits (numbers):

    jitter     s, of its periods; its stamps, since 1970, tell what they were
    turns      its yaw counts whole turns
    numb       commands below so many m/s are none to it
    marches    it sways while it stands, and creeps ahead by so many m/s
    falls      at this second it lies down, and from there on, by `how`: 0 tells where it lies, 1 tells NaN, 2 begins to count anew
               without a boot number, on its feet, 3 tells of a trunk that turns where it lies
"""

from __future__ import annotations

import json
import math
import random
import sys
import time
from typing import Any

from swaying_walker import SwayingWalker

EPOCH_NS = 1_795_000_000_000_000_000
HABITS = {"dt": 1.0, "jitter": 0.0, "turns": 0.0, "numb": 0.0, "marches": 0.0, "falls": math.inf, "how": 0.0, "lag": 0.15}


class OtherWalker(SwayingWalker):
    """The body with its habits; one seed gives one robot."""

    def __init__(self, seed: int = 1, **habits: float) -> None:
        self.habit = {**HABITS, **habits}
        self.lag = self.habit["lag"]
        self.lies = False
        self._own = random.Random(f"{seed}/habits")
        super().__init__(seed=seed)

    def period(self) -> float:
        """How long its next period takes, s."""
        return self.habit["dt"] + (self._own.gauss(0.0, self.habit["jitter"]) if self.habit["jitter"] else 0.0)

    def walk(self, v: float, w: float, seconds: float) -> None:
        """A period under a command, as it takes it."""
        habit = self.habit
        if self.now_s >= habit["falls"] and habit["how"] != 2.0:
            self.lies = True
        if self.lies:
            self.now_s += seconds
            return
        v = v if abs(v) >= habit["numb"] else 0.0
        if habit["marches"] and not v and not w:
            v = habit["marches"]
        self.step(v, w, seconds)

    def tells(self) -> tuple[float, float, float]:
        """Its pose, measured."""
        x, y, theta = self.observe()
        if self.lies and self.habit["how"] == 3.0:
            theta = self._own.uniform(-math.pi, math.pi)
        return x, y, theta + (2.0 * math.pi * self._own.randrange(-2, 3) if self.habit["turns"] else 0.0)


def payload(robot: OtherWalker, seq: int, stamp_ns: int) -> bytes:
    """An observation, with more in it than was asked for."""
    x, y, theta = robot.tells()
    state: dict[str, float] = {"x": x, "y": y, "theta": theta, "z": 0.28, "roll": 0.01, **{f"joint_{i}": 0.1 * i for i in range(12)}}
    if robot.lies and robot.habit["how"] == 1.0:
        state = dict.fromkeys(state, math.nan)
    return json.dumps({"seq": seq, "stamp_ns": stamp_ns, "state": state}).encode()


def main(endpoint: str, *habits: str) -> None:
    """Until it is ended."""
    import zenoh

    named = {name: float(value) for name, _, value in (word.partition("=") for word in habits)}
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer",
        "connect/endpoints": [endpoint],
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": 2000,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    commands = session.declare_subscriber("s2r/robot/command", zenoh.handlers.RingChannel(1))
    here = session.declare_publisher("s2r/robot/observation", congestion_control=zenoh.CongestionControl.DROP, express=True)
    robot = OtherWalker(**named)
    seq, began_s = 0, 0.0
    while True:
        if robot.habit["how"] == 2.0 and robot.now_s >= robot.habit["falls"]:
            robot, seq, began_s = OtherWalker(2, **{**named, "falls": math.inf}), 0, 0.0
        data = payload(robot, seq, EPOCH_NS + round(1e9 * (robot.now_s - began_s)))
        here.put(data)
        v, w = answer(commands, seq, lambda data=data: here.put(data))
        robot.walk(v, w, robot.period())
        seq += 1


def answer(commands: Any, seq: int, again: Any) -> tuple[float, float]:
    """The command that answers observation `seq`, which is repeated while it does not come."""
    told = time.monotonic()
    while True:
        sample = commands.try_recv()
        if sample is None:
            if time.monotonic() - told > 0.1:
                told = time.monotonic()
                again()
            time.sleep(0.0002)
        elif (command := json.loads(sample.payload.to_bytes()))["obs_seq"] == seq:
            return command["input"]["v"], command["input"]["w"]


if __name__ == "__main__":
    main(*sys.argv[1:])
