"""Zenoh sessions that let through what they are for and nothing else, and the queue behind a subscription.

Found out on Zenoh 1.10 and held by tests:
- a session forwards between a client and anybody else that it is linked with, so robot and controllers get a session each;
- an access-control rule that *denies* a key does not match a put on a wildcard (`**` reaches a subscriber of every key), and the
  subject `interfaces: ["*"]` matches no link at all: so everything is denied, and named keys are allowed, for a subject without
  attributes, which is every link;
- a subscription's default channel, undrained, starves its neighbours, and its queue grows stale: a callback into a bounded
  deque that drops its oldest does neither.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2r_runtime.errors import ConfigError
from s2r_zenoh.wire import PAYLOAD_MAX

if TYPE_CHECKING:
    import zenoh


def session_config(
    listen: str,
    connect: str,
    lease_s: float,
    rules: list[dict[str, Any]],
    file: str,
    subject: dict[str, Any] | None = None,
    more: dict[str, Any] | None = None,
) -> zenoh.Config:
    """Configuration of one side's session. rules: what may pass (see `allow`), and subject: for whom (default: every link). file: a Zenoh
    configuration to start from (for certificates and passwords); what keeps others out is set after it, and `more` last. Raises
    ConfigError if the file can't be used.

    A session that connects is a router toward what it connects to: routers do not forward between two peers, and a client's
    open() would wait for its router.
    """
    import zenoh

    try:
        config = zenoh.Config.from_file(file) if file else zenoh.Config()
    except zenoh.ZError as error:
        raise ConfigError(f"{Path(file)}: not a Zenoh configuration: {error}") from None
    whom = subject or {"id": "every_link"}
    access = {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [whom],
        "policies": [{"rules": [rule["id"] for rule in rules], "subjects": [whom["id"]]}],
    }
    settings = {
        "mode": "router" if connect else "peer",
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
        # whoever is not there yet, or went away, is sought again soon; open() does not wait for it
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        # nobody is introduced to anybody: a robot that learned of a controller would link with it directly
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # ms that a router waits for whom it finds, before open() returns
        "adminspace/enabled": False,
        "transport/link/tx/lease": round(1000 * lease_s),
        "access_control": access,
        **(more or {}),
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def allow(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    """One rule: these messages may pass in this direction (`ingress` or `egress`, seen from here) on these key expressions."""
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}


class Doorbell:
    """A descriptor that is readable after `ring` until `answer`. -1 while it is not open; rings are then not heard."""

    def __init__(self) -> None:
        self._fd = -1
        self._lock = threading.Lock()

    def open(self) -> None:
        """Makes the descriptor."""
        with self._lock:
            if self._fd < 0:
                self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """The descriptor."""
        return self._fd

    def ring(self) -> None:
        """Makes it readable; from any thread, also after `close` (a callback may still be on its way)."""
        with self._lock:
            if self._fd >= 0:
                os.eventfd_write(self._fd, 1)

    def answer(self) -> None:
        """Makes it unreadable until the next `ring`."""
        if self._fd >= 0:
            with suppress(BlockingIOError):
                os.eventfd_read(self._fd)

    def close(self) -> None:
        """Frees the descriptor; may be called twice."""
        with self._lock:
            if self._fd >= 0:
                os.close(self._fd)
                self._fd = -1


class Inbox:
    """What a subscription received: at most `capacity` payloads, of which the oldest give way, counted in `dropped`.

    `per_second`: more than that are dropped at the door (0: no such limit), so that a stranger cannot fill the log. longest: bytes of a
    payload; a longer one is cut to this length and a byte, which no decoder takes for a message.
    """

    def __init__(self, bell: Doorbell, capacity: int, per_second: int = 0, longest: int = PAYLOAD_MAX) -> None:
        self._bell, self._capacity, self._per_second, self._longest = bell, capacity, per_second, longest
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._lock = threading.Lock()
        self._second, self._in_second = 0, 0
        self.received = self.dropped = 0

    def put(self, sample: zenoh.Sample) -> None:
        """Callback of the subscription, on Zenoh's thread."""
        arrival_ns = time.monotonic_ns()
        data = self.content(sample)
        with self._lock:
            self.received += 1
            if self._per_second and self._over_rate(arrival_ns // 1_000_000_000):
                self.dropped += 1
                return
            quiet = not self._waiting
            if len(self._waiting) >= self._capacity:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((arrival_ns, data))
        if quiet:
            self._bell.ring()

    def content(self, sample: zenoh.Sample) -> bytes:
        """What is kept of a sample: its payload. For others to override."""
        return sample.payload.to_bytes()[: self._longest + 1]

    def take(self) -> list[tuple[int, bytes]]:
        """What waited, oldest first: (arrival on the host's monotonic clock, content)."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
        return taken

    def _over_rate(self, second: int) -> bool:
        if second != self._second:
            self._second, self._in_second = second, 0
        self._in_second += 1
        return self._in_second > self._per_second
