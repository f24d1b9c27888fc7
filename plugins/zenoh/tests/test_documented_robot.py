"""docs/zenoh.md is enough to write a robot from: its robot drives, and its router lets only the runtime command."""

from __future__ import annotations

import re
import select
import threading
import time
from pathlib import Path
from typing import Any

from s2r_zenoh.testing import free_endpoint
from s2r_zenoh.transport import ZenohTransport

from s2r_runtime.messages import Command, Observation

DOCS = Path(__file__).parents[3] / "docs" / "zenoh.md"


def block(language: str, which: int) -> str:
    """The which-th fenced block of that language."""
    found: list[str] = re.findall(rf"^```{language}\n(.*?)^```$", DOCS.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return found[which]


def test_robot_of_the_docs_drives_and_stops_when_its_commands_end() -> None:
    made: dict[str, Any] = {}
    exec(compile(block("python", 0), str(DOCS), "exec"), made)  # noqa: S102 - the docs' own code
    endpoint, stopped = free_endpoint(), []
    transport = ZenohTransport({"robot_listen": endpoint}, ("x",), ("v",))
    robot = threading.Thread(target=lambda: stopped.append(made["drive"](endpoint, 100)))
    seen: list[Observation] = []
    try:
        transport.open()
        robot.start()
        while robot.is_alive():
            select.select([transport.fileno()], [], [], 0.02)
            for message in (m for frame in transport.receive() for m in transport.decode(frame)):
                if isinstance(message, Observation):
                    seen.append(message)
                    if message.x[0] < 0.05:  # and then nobody commands it any more
                        ttl_ns = 100_000_000
                        transport.send(transport.encode(Command(len(seen), time.monotonic_ns(), "controller", (0.5,), message.seq, ttl_ns)))
    finally:
        robot.join()
        transport.close()
    assert len(seen) > 50
    assert 0.05 <= stopped[0] <= 0.05 + 0.5 * 0.2, "it stopped within the last command's time to live and a few periods"
    assert not any(o.fault for o in seen)


def test_every_option_and_counter_is_documented() -> None:
    page = DOCS.read_text(encoding="utf-8")
    transport = ZenohTransport({"robot_listen": "tcp/127.0.0.1:7461"}, ("x",), ("v",))
    assert [name for name in (*transport.OPTIONS, *transport.counters()) if f"`{name}`" not in page] == []
