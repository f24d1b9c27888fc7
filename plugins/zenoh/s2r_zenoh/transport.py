"""The Zenoh transport: one session toward the robot, another toward everybody else, and nothing that leads from one to the other.

    robot  --observation, override-->  robot side   |   controller side  --observation-->  onlookers
    robot  <------command-----------   (peer)       |   (peer)           <--proposal----   controllers: logged, refused

Each side listens, connects to a router, or both. The way to the robot's command key is closed twice: no session is linked with both
robot and controllers, and each lets in only the keys above. What a robot and a site must do for their part: docs/zenoh.md.
"""

from __future__ import annotations

import difflib
import math
import re
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec

from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Command, Frame, LinkChanged, LogHead
from s2r_zenoh import tls
from s2r_zenoh.sessions import Doorbell, Inbox, allow, session_config
from s2r_zenoh.wire import Decoded, Wire

if TYPE_CHECKING:
    import zenoh

_ENDPOINT = re.compile(r"[a-z0-9_-]+/\S+")
_PREFIX = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")
PROPOSALS_PER_SECOND = 32
PROPOSAL_MAX = 4096
"""Bytes: ten times what a command of twenty inputs takes. So all strangers together put 130 KB a second into the log at most."""
OVERRIDES_WAITING = 16
DEFAULTS: dict[str, Any] = {
    "robot_listen": "",
    "robot_connect": "",
    "controller_listen": "",
    "controller_connect": "",
    "key_prefix": "s2r/robot",
    "observation_timeout": 0.5,
    "lease": 2.0,
    "queue": 64,
    "robot_config": "",
    "controller_config": "",
    "tls_ca": "",
    "tls_certificate": "",
    "tls_key": "",
    "robot_names": [],
    "controller_names": [],
}


class ZenohTransport:
    """Interface: `hookspecs.Transport`. options: see OPTIONS. Raises ConfigError for a bad one, naming what would be right."""

    OPTIONS: ClassVar[dict[str, str]] = {
        "robot_listen": "endpoint on which the robot reaches the runtime, such as tcp/127.0.0.1:7461",
        "robot_connect": "endpoint to connect to instead, or as well: a router on the robot's side, or a robot that listens",
        "controller_listen": "endpoint for onlookers and controllers of others; none: they have no way in",
        "controller_connect": "a router on their side; never the robot's",
        "key_prefix": f"keys are PREFIX/observation, PREFIX/command, PREFIX/proposal, PREFIX/override (default {DEFAULTS['key_prefix']})",
        "observation_timeout": f"s without an observation after which the link counts as lost (default {DEFAULTS['observation_timeout']})",
        "lease": f"s after which Zenoh gives up a peer that does not answer (default {DEFAULTS['lease']})",
        "queue": f"observations kept for a runtime that is late; older ones are dropped and counted (default {DEFAULTS['queue']})",
        "robot_config": "Zenoh configuration file to start from on the robot's side (certificates, passwords)",
        "controller_config": "the same on the other side",
        **tls.OPTIONS,
    }

    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        self._options = _checked(options)
        self._timeout_ns = round(self._options["observation_timeout"] * 1e9)
        # a robot without a boot number may count anew once its link counted as lost
        self._wire = Wire(states, inputs, restart_ns=self._timeout_ns)
        self._bell = Doorbell()
        self._observations = Inbox(self._bell, self._options["queue"])
        self._proposals = Inbox(self._bell, PROPOSALS_PER_SECOND, PROPOSALS_PER_SECOND, PROPOSAL_MAX)
        self._overrides = Inbox(self._bell, OVERRIDES_WAITING)
        self._sessions: list[zenoh.Session] = []
        self._command: zenoh.Publisher | None = None
        self._onlookers: zenoh.Publisher | None = None
        self._heads: list[zenoh.Publisher] = []
        self._sent = self._dropped_out = self._repeated = self._resent = 0
        self._newest, self._answer, self._to_show = b"", b"", b""
        self._encoded: tuple[bytes, int] = (b"", -1)
        self._heard_ns = 0
        self._up: bool | None = None

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Opens both sessions; returns at once, whether or not the robot is there. Raises ConfigError if an endpoint can't be used."""
        import zenoh

        prefix, lease = self._options["key_prefix"], self._options["lease"]
        keys = {name: f"{prefix}/{name}" for name in ("observation", "command", "proposal", "override", "log_head")}
        incoming = [keys["observation"], keys["override"]]
        drop = zenoh.CongestionControl.DROP  # a frozen robot must not stall us; BLOCK waits for it
        self._bell.open()
        try:
            robot = self._session("robot", [
                allow("robot_speaks", "ingress", ["put"], incoming),
                allow("runtime_hears", "egress", ["declare_subscriber"], incoming),
                allow("robot_hears", "ingress", ["declare_subscriber"], [keys["command"], keys["log_head"]]),
                allow("runtime_commands", "egress", ["put"], [keys["command"], keys["log_head"]]),
            ], lease)  # fmt: skip
            robot.declare_subscriber(keys["observation"], zenoh.handlers.Callback(self._observations.put, indirect=False))
            robot.declare_subscriber(keys["override"], zenoh.handlers.Callback(self._overrides.put, indirect=False))
            self._command = robot.declare_publisher(keys["command"], congestion_control=drop, express=True)
            self._heads.append(robot.declare_publisher(keys["log_head"], congestion_control=drop))
            if self._options["controller_listen"] or self._options["controller_connect"]:
                others = self._session("controller", [
                    allow("others_propose", "ingress", ["put"], [keys["proposal"]]),
                    allow("runtime_hears", "egress", ["declare_subscriber"], [keys["proposal"]]),
                    allow("others_hear", "ingress", ["declare_subscriber"], ["**"]),
                    allow("runtime_shows", "egress", ["put"], [keys["observation"], keys["log_head"]]),
                ], lease)  # fmt: skip
                others.declare_subscriber(keys["proposal"], zenoh.handlers.Callback(self._proposals.put, indirect=False))
                self._onlookers = others.declare_publisher(keys["observation"], congestion_control=drop, express=True)
                self._heads.append(others.declare_publisher(keys["log_head"], congestion_control=drop))
        except BaseException:
            self.close()
            raise
        self._heard_ns = time.monotonic_ns()

    def _session(self, side: str, rules: list[dict[str, Any]], lease_s: float) -> zenoh.Session:
        import zenoh

        listen, connect = self._options[f"{side}_listen"], self._options[f"{side}_connect"]
        whom, secured = tls.subject(self._options[f"{side}_names"]), tls.settings(self._options)
        config = session_config(listen, connect, lease_s, rules, self._options[f"{side}_config"], whom, secured)
        try:
            session = zenoh.open(config)
        except zenoh.ZError as error:
            raise ConfigError(f"transport.{side}_listen {listen!r}, {side}_connect {connect!r}: {error}") from None
        self._sessions.append(session)
        return session

    def close(self) -> None:
        """Closes both sessions (a process that leaves one open hangs at its end); may be called twice."""
        sessions, self._sessions = self._sessions, []
        self._command = self._onlookers = None
        self._heads = []
        for session in sessions:
            with suppress(Exception):  # the others must be closed all the same
                session.close()  # type: ignore[no-untyped-call]
        self._bell.close()

    # ------------------------------------------------------------------ in

    def fileno(self) -> int:
        """Readable when `receive` has something."""
        return self._bell.fileno()

    def receive(self) -> list[Frame]:
        """What came since the last call, oldest first; never blocks.

        A robot in lockstep repeats its observation until it is answered. Repeats are not frames: where the answer was given, it is
        sent once more, so a lost command costs a tenth of a second and nothing else. What it repeats though it is behind what came
        before is a frame each time: without a boot number only that tells, after a while, of a robot that started anew. What it repeats
        after the link was lost is a frame as well: what was observed before is forgotten then.
        """
        self._bell.answer()
        frames = []
        for arrival_ns, data in self._observations.take():
            self._heard_ns = arrival_ns
            if not self._newest:
                self._up = True  # `decode` says so, before anybody acts on the first observation
            if data == self._newest and data != self._wire.too_old and self._up is not False:
                self._repeated += 1
                self._send_again()
                continue
            self._newest, self._answer, self._to_show = data, b"", data
            frames.append(Frame(arrival_ns, "observation", data))
        extra = [Frame(arrival_ns, "override", data) for arrival_ns, data in self._overrides.take()]
        extra += [Frame(arrival_ns, "proposal", data) for arrival_ns, data in self._proposals.take()]
        return sorted(frames + extra, key=lambda frame: frame.arrival_ns) if extra else frames

    def decode(self, frame: Frame) -> list[Decoded]:
        """What an inbound frame means: see `Wire.decode`."""
        return self._wire.decode(frame)

    def poll(self, now_ns: int) -> list[LinkChanged]:
        """Link lost or back, by the time since the last observation, repeats included. now_ns: the host's monotonic clock."""
        self._show()
        silent_ns = now_ns - self._heard_ns
        if silent_ns <= self._timeout_ns:
            if self._up or not self._newest:
                return []
            self._up = True
            return [LinkChanged(now_ns, up=True)]
        if self._up is False:
            return []
        self._up = False
        where = self._options["robot_listen"] or self._options["robot_connect"]
        since = f"for {silent_ns * 1e-9:.2f} s" if self._newest else "yet"
        detail = f"no observation {since} on {self._options['key_prefix']}/observation over {where}"
        return [LinkChanged(now_ns, up=False, detail=detail + self._own_certificate())]

    def _own_certificate(self) -> str:
        """What of it explains that nobody is heard."""
        if not self._options["tls_ca"]:
            return ""
        from s2r_zenoh.own_certificate import invalidity

        invalid = invalidity(self._options, time.time())
        return f"; {invalid}" if invalid else ""

    # ------------------------------------------------------------------ out

    def encode(self, command: Command) -> Frame:
        """The frame of a command. Raises ValueError if it is not finite or not of shape (nu,)."""
        frame = Frame(command.t_ns, "command", self._wire.encode(command), inbound=False)
        self._encoded = (frame.data, command.obs_seq)
        return frame

    def send(self, frame: Frame) -> None:
        """Hands it to the robot; what can't be sent is dropped and counted, never waited for."""
        if self._encoded == (frame.data, self._wire.newest):
            self._answer = frame.data
        if self._put(frame.data):
            self._sent += 1
        self._show()

    def _send_again(self) -> None:
        if self._answer and self._put(self._answer):
            self._resent += 1

    def _put(self, data: bytes) -> bool:
        if self._command is not None:
            with suppress(Exception):  # a session that broke: the robot's time to live and our time-out deal with it
                self._command.put(data)
                return True
        self._dropped_out += 1
        return False

    def _show(self) -> None:
        """The newest observation to onlookers, after the robot has got its command."""
        if self._to_show and self._onlookers is not None:
            with suppress(Exception):  # nobody's safety hangs on it
                self._onlookers.put(self._to_show)
        self._to_show = b""

    def anchor(self, head: LogHead) -> None:
        """The head of the log's chain, to both sides: whoever keeps it knows later whether the log lacks its tail."""
        data = msgspec.json.encode(head)
        for publisher in self._heads:
            with suppress(Exception):  # it is on the daemon's journal too
                publisher.put(data)

    def counters(self) -> dict[str, int]:
        """Since construction. repeated: keep-alives; resent: commands sent again for them; old: observations behind a newer one."""
        return {
            "received": self._observations.received + self._proposals.received + self._overrides.received,
            "sent": self._sent,
            "dropped_in": self._observations.dropped + self._overrides.dropped + self._proposals.dropped,
            "dropped_out": self._dropped_out,
            "malformed": self._wire.malformed,
            "lost": self._wire.lost,
            "old": self._wire.old,
            "repeated": self._repeated,
            "resent": self._resent,
            "proposals": self._proposals.received,
            "proposals_dropped": self._proposals.dropped,
        }


def _checked(given: dict[str, Any]) -> dict[str, Any]:
    """Options with their defaults. Raises ConfigError."""
    for name, value in given.items():
        if name not in DEFAULTS:
            near = difflib.get_close_matches(name, DEFAULTS, 1, 0.6)
            hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(DEFAULTS)}"
            raise ConfigError(f"transport.{name} is not an option of the zenoh transport; {hint}")
        wanted = (int, float) if isinstance(DEFAULTS[name], float) else type(DEFAULTS[name])
        if isinstance(value, bool) or not isinstance(value, wanted):
            kind = {str: "text", int: "a whole number", float: "a number", list: "a list of text"}[type(DEFAULTS[name])]
            raise ConfigError(f"transport.{name} is {value!r}, must be {kind}")
    options = {**DEFAULTS, **given}
    for name in ("robot_listen", "robot_connect", "controller_listen", "controller_connect"):
        if options[name] and not _ENDPOINT.fullmatch(options[name]):
            raise ConfigError(f"transport.{name} is {options[name]!r}, must be an endpoint such as tcp/127.0.0.1:7461")
    for name in ("observation_timeout", "lease"):
        if not 0.0 < options[name] < math.inf:
            raise ConfigError(f"transport.{name} is {options[name]}, must be > 0 s")
    if options["queue"] < 1:
        raise ConfigError(f"transport.queue is {options['queue']}, must be >= 1")
    if not _PREFIX.fullmatch(options["key_prefix"]):
        raise ConfigError(f"transport.key_prefix is {options['key_prefix']!r}, must be names joined by /, without wildcards")
    if not options["robot_listen"] and not options["robot_connect"]:
        raise ConfigError("transport: the zenoh transport needs robot_listen or robot_connect")
    sides = [{options[f"{side}_listen"], options[f"{side}_connect"]} - {""} for side in ("robot", "controller")]
    if shared := sides[0] & sides[1]:
        raise ConfigError(
            f"transport: robot and controllers share {shared.pop()}; whoever reaches both carries commands past the gate, "
            "so each side needs an endpoint or router of its own"
        )
    tls.check(options)
    return options
