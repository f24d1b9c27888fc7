"""A robot's end of the Zenoh transport, for tests: real sessions on loopback, each on ports of its own.

from s2r_runtime.testing import TransportKit
from s2r_zenoh.testing import ZenohRig

class TestZenoh(TransportKit):
    rig = ZenohRig
"""

from __future__ import annotations

import json
import socket
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Self

import msgspec
import zenoh

from s2r_runtime.messages import Command
from s2r_zenoh.transport import ZenohTransport

STATES, INPUTS = ("x", "y", "theta"), ("v", "w")


def free_endpoint() -> str:
    """A TCP endpoint on loopback that nobody listens on."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{s.getsockname()[1]}"


@contextmanager
def session(mode: str, connect: str = "", listen: str = "", **settings: Any) -> Iterator[zenoh.Session]:
    """Anybody's session: as open as Zenoh makes it, but for multicast, which would find other tests. settings: / written as __."""
    config = zenoh.Config()
    chosen = {
        "mode": mode,
        "connect/endpoints": [connect] if connect else [],
        "listen/endpoints": [listen] if listen else [],
        # a client's open() waits until it is connected; a peer's does not
        "connect/timeout_ms": 10_000 if mode == "client" else -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/delay": 0,
        **{key.replace("__", "/"): value for key, value in settings.items()},
    }
    for key, value in chosen.items():
        config.insert_json5(key, json.dumps(value))
    opened = zenoh.open(config)
    try:
        yield opened
    finally:
        opened.close()  # type: ignore[no-untyped-call]


class Robot:
    """A robot's end: publishes what it is told to, and keeps what it hears. Opens its session when it first publishes."""

    def __init__(self, endpoint: str, mode: str = "peer", prefix: str = "s2r/robot") -> None:
        self.heard: deque[bytes] = deque(maxlen=1000)
        self._endpoint, self._mode, self._prefix = endpoint, mode, prefix
        self._stack = ExitStack()
        self._publishers: dict[str, zenoh.Publisher] = {}

    def close(self) -> None:
        """Ends the session, as a robot does that is switched off; it opens another when it publishes again."""
        self._publishers = {}
        self._stack.close()

    def _put(self, channel: str, data: bytes) -> None:
        if not self._publishers:
            opened = self._stack.enter_context(session(self._mode, connect=self._endpoint))
            opened.declare_subscriber(f"{self._prefix}/command", self._take)
            names = ("observation", "override")
            # the default drops what a busy machine's sending thread does not take within a millisecond
            waits = zenoh.CongestionControl.BLOCK
            self._publishers = {
                name: opened.declare_publisher(f"{self._prefix}/{name}", express=True, congestion_control=waits) for name in names
            }
        self._publishers[channel].put(data)

    def _take(self, sample: zenoh.Sample) -> None:
        self.heard.append(sample.payload.to_bytes())

    def publish(self, seq: int, stamp_ns: int, x: tuple[float, ...], boot: int = 0) -> None:
        """One observation; NaN and Infinity are written as they are."""
        # json, unlike msgspec, writes NaN and Infinity, as a careless robot does
        state = dict(zip(STATES, x, strict=True))
        self.publish_raw(json.dumps({"seq": seq, "stamp_ns": stamp_ns, "state": state, "boot": boot}).encode())

    def publish_raw(self, data: bytes) -> None:
        """These bytes, on the observation's key."""
        self._put("observation", data)

    def override(self, data: bytes) -> None:
        """These bytes, on the override's key."""
        self._put("override", data)

    def received(self) -> list[Command]:
        """Commands since the last call."""
        taken = [msgspec.json.decode(self.heard.popleft()) for _ in range(len(self.heard))]
        return [Command(c["seq"], c["t_ns"], c["source"], tuple(c["input"][n] for n in INPUTS), c["obs_seq"], c["ttl_ns"]) for c in taken]


class ZenohRig:
    """Transport and robot, peer to peer on loopback."""

    states, inputs = STATES, INPUTS

    def __init__(self, mode: str = "peer") -> None:
        self.endpoint, self.others = free_endpoint(), free_endpoint()
        self.options: dict[str, Any] = {
            "robot_listen": self.endpoint,
            "controller_listen": self.others,
            "observation_timeout": 0.3,
            "queue": 16,
        }
        self.transport = ZenohTransport(self.options, STATES, INPUTS)
        self.robot, self._mode = Robot(self.endpoint, mode), mode
        self._twins: list[Robot] = []

    def twin(self) -> Robot:
        """Another robot on the same keys, with a session of its own."""
        self._twins.append(Robot(self.endpoint, self._mode))
        return self._twins[-1]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.close()
        for robot in (self.robot, *self._twins):
            robot.close()
