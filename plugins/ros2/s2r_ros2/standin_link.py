"""The stand-in's end of Zenoh: its session, its publishers, and the newest command."""

from __future__ import annotations

import argparse
import json
import math
import secrets
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import zenoh
from s2r_zenoh.sessions import Doorbell

from s2r_ros2.cdr import Malformed
from s2r_ros2.interfaces import BOOL
from s2r_ros2.keys import GID, Layout, attached, attachment
from s2r_ros2.options import COMMANDS, POSES
from s2r_ros2.payloads import decode_twist, decode_twist_stamped
from s2r_runtime.errors import ConfigError


class Link:
    """Its node: sends topics, keeps the newest command. Use as a context manager."""

    def __init__(self, session: zenoh.Session, layout: Layout, o: argparse.Namespace) -> None:
        self._layout, self._stamped = layout, o.command == "twist_stamped"
        self._bell = Doorbell()
        self._bell.open()
        self._latest: tuple[bytes, bytes] | None = None
        self.ignored = 0
        self.begin()
        interface, usual = POSES[o.pose]
        drop = zenoh.CongestionControl.DROP
        pose, button = layout.key(o.pose_topic or usual, interface), layout.key("emergency_stop", BOOL)
        self._publishers = {
            name: session.declare_publisher(key, congestion_control=drop, express=True)
            for name, key in (("pose", pose), ("button", button))
        }
        command = layout.key(o.command_topic, COMMANDS[o.command])
        session.declare_subscriber(command, zenoh.handlers.Callback(self._take, indirect=False))

    def begin(self) -> None:
        """Starts anew: another publisher."""
        self._gid, self._counts = secrets.token_bytes(GID), {"pose": 0, "button": 0}

    def fileno(self) -> int:
        """Readable when a command waits."""
        return self._bell.fileno()

    def close(self) -> None:
        """Frees the descriptor."""
        self._bell.close()

    def put(self, name: str, payload: bytes, stamp_ns: int) -> None:
        """A payload on the topic `pose` or `button`."""
        self._counts[name] += 1
        extra = attachment(self._counts[name], stamp_ns, self._gid) if self._layout.kind == "rmw" else None
        self._publishers[name].put(payload, attachment=extra)

    def lose(self, name: str) -> None:
        """One that gets lost on its way."""
        self._counts[name] += 1

    def _take(self, sample: zenoh.Sample) -> None:
        extra = sample.attachment
        self._latest = (b"" if extra is None else extra.to_bytes(), sample.payload.to_bytes())
        self._bell.ring()

    def latest(self) -> tuple[float, float] | None:
        """The newest command (v, w) since the last call, if a node would take it."""
        self._bell.answer()
        held, self._latest = self._latest, None
        if held is None:
            return None
        try:
            if self._layout.kind == "rmw":
                attached(held[0])
            twist = decode_twist_stamped(held[1]) if self._stamped else decode_twist(held[1])
        except Malformed:
            self.ignored += 1
            return None
        if not math.isfinite(twist[0]) or not math.isfinite(twist[5]):
            self.ignored += 1
            return None
        return twist[0], twist[5]


@contextmanager
def node(o: argparse.Namespace) -> Iterator[zenoh.Session]:
    """The robot's session. A bridge is a router, which listens or connects; a node of rmw_zenoh is a peer of the robot's own router."""
    with ExitStack() as stack:
        if o.layout == "rmw" and not o.connect:
            stack.enter_context(_session("router", listen=o.listen))
            yield stack.enter_context(_session("peer", connect=o.listen))
        else:
            yield stack.enter_context(_session("peer" if o.connect else "router", o.connect, "" if o.connect else o.listen))


@contextmanager
def _session(mode: str, connect: str = "", listen: str = "") -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "connect/endpoints": [connect] if connect else [],
        "listen/endpoints": [listen] if listen else [],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        "scouting/multicast/enabled": False,
        "scouting/delay": 0,
        "transport/link/tx/lease": 2000,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        opened = zenoh.open(config)
    except zenoh.ZError as error:
        raise ConfigError(f"endpoint {connect or listen}: {error}") from None
    try:
        yield opened
    finally:
        opened.close()  # type: ignore[no-untyped-call]
