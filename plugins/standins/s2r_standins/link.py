"""A robot's end of the Zenoh link: it says where it is and takes commands, the latest only (docs/zenoh.md).

A command is taken if it is well formed, newer than the last one (or the first after a second of silence: the runtime started
anew), and answers an observation no older than its time to live. Whatever is not is counted and ignored: a robot obeys one
sender, in order, on time, or it stops.
"""

from __future__ import annotations

import json
import math
import os
import select
import threading
import time

import msgspec
import zenoh

from s2r_runtime.errors import ConfigError

SILENCE_NS = 1_000_000_000


class Payload(msgspec.Struct, omit_defaults=True):
    """An observation as on the wire. `trouble`: why there is no state."""

    seq: int
    stamp_ns: int
    state: dict[str, float]
    boot: int
    trouble: str = ""


class CommandPayload(msgspec.Struct):
    """A command as on the wire. `source` is for onlookers."""

    seq: int
    t_ns: int
    obs_seq: int
    ttl_ns: int
    input: dict[str, float]
    source: str = ""


class Link:
    """One robot's session. Use as a context manager: a session left open keeps the process from ending.

    connect, listen: endpoints of a peer; router: endpoint of a router, then the robot is its client. lease_s: after so long the
    *robot's* side gives up a runtime that froze, which is sooner than the other side would notice.
    """

    def __init__(self, prefix: str, inputs: tuple[str, ...], *, connect: str = "", listen: str = "", router: str = "", boot: int) -> None:
        self._inputs, self._boot = inputs, boot
        self._decoder, self._encoder = msgspec.json.Decoder(CommandPayload), msgspec.json.Encoder()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._lock, self._latest = threading.Lock(), b""
        self._last: tuple[int, int] = (-1, -1)
        self._heard_ns = 0
        self.ignored = 0
        self.poller = select.poll()
        self.poller.register(self._bell, select.POLLIN)
        try:
            self._session = zenoh.open(_config(connect, listen, router))
        except zenoh.ZError as error:
            os.close(self._bell)
            raise ConfigError(f"endpoint {connect or listen or router}: {error}") from None
        self._session.declare_subscriber(f"{prefix}/command", zenoh.handlers.Callback(self._take, indirect=False))
        drop = zenoh.CongestionControl.DROP
        self._observations = self._session.declare_publisher(f"{prefix}/observation", congestion_control=drop, express=True)
        self._overrides = self._session.declare_publisher(f"{prefix}/override", congestion_control=drop, express=True)

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()  # type: ignore[no-untyped-call]
        with self._lock:
            os.close(self._bell)
            self._bell = -1

    @property
    def fileno(self) -> int:
        """Readable when a command waits."""
        return self._bell

    def encode(self, seq: int, stamp_ns: int, state: dict[str, float], trouble: str = "") -> bytes:
        """Payload of an observation."""
        return self._encoder.encode(Payload(seq, stamp_ns, state, self._boot, trouble))

    def publish(self, data: bytes) -> None:
        """Sends an observation; drops it where the link is congested."""
        self._observations.put(data)

    def stop_everything(self, detail: str) -> None:
        """The robot's emergency stop button."""
        self._overrides.put(self._encoder.encode({"kind": "emergency_stop", "detail": detail}))

    def _take(self, sample: zenoh.Sample) -> None:
        data = sample.payload.to_bytes()
        with self._lock:
            self._latest = data
            if self._bell >= 0:
                os.eventfd_write(self._bell, 1)

    def latest(self) -> CommandPayload | None:
        """The newest command that came since the last call and may be obeyed (the caller judges its age); else None."""
        try:
            os.eventfd_read(self._bell)
        except BlockingIOError:
            return None
        with self._lock:
            data, self._latest = self._latest, b""
        now_ns = time.monotonic_ns()
        try:
            command: CommandPayload = self._decoder.decode(data)
        except (msgspec.MsgspecError, UnicodeError, RecursionError):
            self.ignored += 1
            return None
        order = (command.t_ns, command.seq)
        known = all(math.isfinite(command.input.get(name, math.nan)) for name in self._inputs)
        if not known or (order <= self._last and now_ns - self._heard_ns < SILENCE_NS):
            self.ignored += 1
            return None
        self._last, self._heard_ns = order, now_ns
        return command


def _config(connect: str, listen: str, router: str) -> zenoh.Config:
    config = zenoh.Config()
    settings = {
        "mode": "client" if router else "peer",
        "connect/endpoints": [endpoint for endpoint in (connect, router) if endpoint],
        "listen/endpoints": [listen] if listen else [],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": 2000,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config
