"""A runtime's end of a stand-in's link, written from docs/zenoh.md, without this project's transport; and the stand-in's process."""

from __future__ import annotations

import json
import os
import queue
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

PATIENCE_S = 60.0


class Talk:
    """A runtime's end of the link, written from the wire format."""

    def __init__(self, module: str, *arguments: str) -> None:
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{s.getsockname()[1]}"
        config = zenoh.Config()
        config.insert_json5("listen/endpoints", json.dumps([endpoint]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)
        self.inbox: queue.Queue[bytes] = queue.Queue()
        self.overrides: queue.Queue[bytes] = queue.Queue()
        self.session.declare_subscriber("s2r/robot/observation", lambda s: self.inbox.put(s.payload.to_bytes()))
        self.session.declare_subscriber("s2r/robot/override", lambda s: self.overrides.put(s.payload.to_bytes()))
        self.process = subprocess.Popen(
            [sys.executable, "-m", f"s2r_standins.{module}", "--connect", endpoint, "--parent", str(os.getpid()), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.last = -1
        self.seq = 0

    def close(self) -> None:
        self.process.terminate()
        self.process.communicate(timeout=PATIENCE_S)
        self.session.close()

    def observe(self) -> dict[str, Any]:
        """The next new observation."""
        while True:
            got: dict[str, Any] = json.loads(self.inbox.get(timeout=PATIENCE_S))
            if got["seq"] > self.last:
                self.last = got["seq"]
                return got

    def command(self, seen: dict[str, Any], v: float, w: float, **other: Any) -> None:
        self.seq += 1
        fields = {"seq": self.seq, "t_ns": seen["stamp_ns"], "obs_seq": seen["seq"], "ttl_ns": 10**8, "source": "sampler"}
        self.session.put("s2r/robot/command", json.dumps({**fields, "input": {"v": v, "w": w}, **other}))

    def say(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def reply(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        told: dict[str, Any] = json.loads(self.process.stdout.readline())
        return told


@contextmanager
def talk(module: str, *arguments: str) -> Iterator[Talk]:
    """With the stand-in `module` as a process of its own."""
    made = Talk(module, *arguments)
    try:
        yield made
    finally:
        made.close()


def drive(t: Talk, periods: int, v: float, w: float) -> list[dict[str, Any]]:
    """Answers every observation with (v, w); returns the observations, the one after the last answer included."""
    seen = [t.observe()]
    for _ in range(periods):
        t.command(seen[-1], v, w)
        seen.append(t.observe())
    return seen
