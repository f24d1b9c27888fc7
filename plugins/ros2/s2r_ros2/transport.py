"""The ROS 2 transport: what `s2r_zenoh` is to robots that speak Zenoh, for robots that speak ROS 2 over it.

    robot  --pose, override topics-->  robot side   |   controller side  --pose topic-->      onlookers, ROS nodes of others
    robot  <------command topic------               |                    <--command topic---  controllers: logged, refused
    robot  -------command topic----->  ears: a command of another node on the robot's side counts as a manual override

Each side is a Zenoh session of its own that lets in the keys above by name and nothing else (`s2r_zenoh.sessions`). The ears are a third
one, which can let commands in because it lets nothing out; they are there where the runtime connects to the robot (robot_connect). Which
keys those are: `keys`. What a gate can't keep off a ROS 2 graph: docs/ros2.md.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar

from s2r_zenoh.sessions import Doorbell, Inbox, allow, session_config

from s2r_ros2.cdr import PAYLOAD_MAX, Malformed
from s2r_ros2.commander import Commander
from s2r_ros2.graph import declare, rules
from s2r_ros2.inboxes import PER_SECOND, POSE_MAX, Ears, Mail, Stops
from s2r_ros2.keys import opened
from s2r_ros2.observer import Observer
from s2r_ros2.options import MEANINGS, Options, checked
from s2r_ros2.payloads import decode_bool
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, ObservationRefused, OverrideChanged

if TYPE_CHECKING:
    import zenoh

Decoded = Observation | ObservationRefused | Command | LinkChanged | OverrideChanged

OVERRIDES_WAITING = 16
LOOK_NS = 1_000_000_000
FIRST_LOOK_NS = 3_000_000_000
"""After opening: sooner, a robot that is there may not have said so yet."""


class Ros2Transport:
    """Interface: `hookspecs.Transport`. options: see OPTIONS. Raises ConfigError for a bad one, naming what would be right."""

    OPTIONS: ClassVar[dict[str, str]] = MEANINGS

    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        self._options: Options = checked(options, states, inputs)
        self._timeout_ns = round(self._options.observation_timeout * 1e9)
        self._observer = Observer(self._options)
        self._commander = Commander(self._options, inputs, self._observer)
        self._bell = Doorbell()
        longest = PAYLOAD_MAX if self._options.pose == "tf" else POSE_MAX
        self._poses = Mail(self._bell, self._options.queue, longest=longest)
        self._proposals = Mail(self._bell, PER_SECOND, PER_SECOND)
        self._strangers = Ears(self._bell)
        self._overrides = {kind: Stops(self._bell, OVERRIDES_WAITING, longest=POSE_MAX) for kind in self._options.overrides}
        self._wanted = self._options.child_frame.lstrip("/").encode() if self._options.pose == "tf" else b""
        self._sessions: list[zenoh.Session] = []
        self._tokens: list[zenoh.LivelinessToken] = []
        self._command: zenoh.Publisher | None = None
        self._onlookers: zenoh.Publisher | None = None
        self._sent = self._dropped_out = self._malformed = self._unheard = 0
        self._heard_ns = self._looked_ns = self._opened_ns = 0
        self._to_show = b""
        self._up: bool | None = None
        self._matched: bool | None = None

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Opens the sessions; returns at once, whether or not the robot is there. Raises ConfigError if an endpoint can't be used."""
        o, keys = self._options, self._options.keys
        pose, command = keys.key(o.pose_topic, o.pose_type), keys.key(o.command_topic, o.command_type)
        stops = {kind: keys.key(topic, "std_msgs/msg/Bool") for kind, topic in o.overrides.items()}
        incoming = [pose, *stops.values()]
        graph = rules(o)
        self._bell.open()
        try:
            robot = self._session("robot", o.robot_listen, o.robot_connect, [
                allow("robot_speaks", "ingress", ["put"], incoming),
                allow("runtime_hears", "egress", ["declare_subscriber"], incoming),
                allow("robot_hears", "ingress", ["declare_subscriber"], [command]),
                allow("runtime_commands", "egress", ["put"], [command]),
                *graph,
            ])  # fmt: skip
            _subscribe(robot, pose, self._poses)
            for kind, key in stops.items():
                _subscribe(robot, key, self._overrides[kind])
            self._command = _publisher(robot, command)
            self._tokens += declare(robot, o, o.command_topic, o.pose_topic)
            if o.robot_connect:
                ears = self._session("robot", "", o.robot_connect, [
                    allow("others_command", "ingress", ["put"], [command]),
                    allow("runtime_hears", "egress", ["declare_subscriber"], [command]),
                ])  # fmt: skip
                _subscribe(ears, command, self._strangers)
            if o.controller_listen or o.controller_connect:
                others = self._session("controller", o.controller_listen, o.controller_connect, [
                    allow("others_propose", "ingress", ["put"], [command]),
                    allow("runtime_hears", "egress", ["declare_subscriber"], [command]),
                    allow("others_hear", "ingress", ["declare_subscriber"], ["**"]),
                    allow("runtime_shows", "egress", ["put"], [pose]),
                    *graph,
                ])  # fmt: skip
                _subscribe(others, command, self._proposals)
                self._onlookers = _publisher(others, pose)
                self._tokens += declare(others, o, o.pose_topic, o.command_topic)
        except BaseException:
            self.close()
            raise
        self._heard_ns = self._opened_ns = time.monotonic_ns()

    def _session(self, side: str, listen: str, connect: str, allowed: list[dict[str, Any]]) -> zenoh.Session:
        import zenoh

        file = self._options.robot_config if side == "robot" else self._options.controller_config
        try:
            session = zenoh.open(session_config(listen, connect, self._options.lease, allowed, file))
        except zenoh.ZError as error:
            raise ConfigError(f"transport.{side}_listen {listen!r}, {side}_connect {connect!r}: {error}") from None
        self._sessions.append(session)
        return session

    def close(self) -> None:
        """Closes the sessions (a process that leaves one open hangs at its end); may be called twice."""
        sessions, self._sessions = self._sessions, []
        self._command = self._onlookers = None
        self._tokens = []
        for session in sessions:
            with suppress(Exception):  # the others must be closed all the same
                session.close()  # type: ignore[no-untyped-call]
        self._bell.close()

    # ------------------------------------------------------------------ in

    def fileno(self) -> int:
        """Readable when `receive` has something."""
        return self._bell.fileno()

    def receive(self) -> list[Frame]:
        """What came since the last call, oldest first; never blocks."""
        self._bell.answer()
        frames = []
        for arrival_ns, data in self._poses.take():
            if self._wanted and self._wanted not in data:  # other transforms of the robot's
                self._unheard += 1
                continue
            self._to_show = data
            frames.append(Frame(arrival_ns, "pose", data))
        extra = [Frame(arrival_ns, kind, data) for kind, mail in self._overrides.items() for arrival_ns, data in mail.take()]
        extra += [Frame(arrival_ns, "proposal", data) for arrival_ns, data in self._proposals.take()]
        extra += [Frame(arrival_ns, "stranger", data) for arrival_ns, data in self._strangers.take()]
        return sorted(frames + extra, key=lambda frame: frame.arrival_ns) if extra else frames

    def decode(self, frame: Frame) -> list[Decoded]:
        """What an inbound frame means. Never raises."""
        if frame.channel == "pose":
            said = self._observer.decode(frame)
            for message in said:
                if isinstance(message, LinkChanged):
                    self._up = message.up
                elif isinstance(message, Observation) and not message.fault:
                    self._heard_ns = frame.arrival_ns
            return [*said]
        if frame.channel == "proposal":
            return [self._commander.proposal(frame)]
        if frame.channel == "stranger":
            topic = self._options.keys.name(self._options.command_topic)
            return [OverrideChanged(frame.arrival_ns, "manual_override", f"another node commands {topic} on the robot's side")]
        if frame.channel in self._overrides:
            return self._override(frame)
        return []

    def _override(self, frame: Frame) -> list[Decoded]:
        """Garbage on a topic that stops the robot stops the robot: that is the side to err on."""
        kind: Any = frame.channel
        topic = self._options.overrides[frame.channel]
        try:
            pressed = decode_bool(opened(frame.data)[1])
        except Malformed as error:
            self._malformed += 1
            return [OverrideChanged(frame.arrival_ns, "emergency_stop", f"malformed {topic}: {error}")]
        return [OverrideChanged(frame.arrival_ns, kind, topic)] if pressed else []

    def poll(self, now_ns: int) -> list[LinkChanged]:
        """Link lost or back, by the time since the last good observation. now_ns: the host's monotonic clock."""
        self._show()
        silent_ns = now_ns - self._heard_ns
        if silent_ns <= self._timeout_ns:
            if self._up is not False or self._observer.newest < 0:
                return []
            self._up = True
            return [LinkChanged(now_ns, up=True)]
        if self._up is False:
            return []
        self._up = False
        o = self._options
        since = f"for {silent_ns * 1e-9:.2f} s" if self._observer.newest >= 0 else "yet"
        key = o.keys.key(o.pose_topic, o.pose_type)
        return [LinkChanged(now_ns, up=False, detail=f"no good pose {since} on {key} over {o.robot_listen or o.robot_connect}")]

    def lines(self) -> list[str]:
        """For the journal: whether anybody on the robot's side takes commands. Looked at once a second."""
        now_ns = time.monotonic_ns()
        if self._command is None or now_ns - self._looked_ns < LOOK_NS:
            return []
        self._looked_ns = now_ns
        status: Any = self._command.matching_status  # its stub says bool
        matched = bool(status.matching)
        if matched == self._matched or (not matched and self._matched is None and now_ns - self._opened_ns < FIRST_LOOK_NS):
            return []
        self._matched = matched
        o = self._options
        key = o.keys.key(o.command_topic, o.command_type)
        return [f"the robot {'subscribes' if matched else 'does not subscribe'} to {key}"]

    # ------------------------------------------------------------------ out

    def encode(self, command: Command) -> Frame:
        """The frame of a command. Raises ValueError if it is not finite or not of shape (nu,)."""
        return Frame(command.t_ns, "command", self._commander.encode(command), inbound=False)

    def send(self, frame: Frame) -> None:
        """Hands it to the robot; what can't be sent is dropped and counted, never waited for."""
        extra, payload = opened(frame.data)
        sent = False
        if self._command is not None:
            self._strangers.sent(frame.data)
            with suppress(Exception):  # a session that broke: the robot's own time-out and ours deal with it
                self._command.put(payload, attachment=extra or None)
                sent = True
        self._sent += sent
        self._dropped_out += not sent
        self._show()

    def _show(self) -> None:
        """The newest pose to onlookers, after the robot has got its command."""
        if self._to_show and self._onlookers is not None:
            extra, payload = opened(self._to_show)
            with suppress(Exception):  # nobody's safety hangs on it
                self._onlookers.put(payload, attachment=extra or None)
        self._to_show = b""

    def counters(self) -> dict[str, int]:
        """Since construction; explained in docs/ros2.md."""
        seen = self._observer
        inboxes = [self._poses, self._proposals, self._strangers, *self._overrides.values()]
        return {
            "received": sum(box.received for box in inboxes),
            "sent": self._sent,
            "dropped_in": sum(box.dropped for box in inboxes),
            "dropped_out": self._dropped_out,
            "malformed": seen.malformed + self._commander.malformed + self._malformed,
            "lost": seen.lost,
            "old": seen.clock.old,
            "ahead": seen.clock.ahead,
            "restarts": seen.clock.restarts,
            "foreign": seen.foreign + self._unheard,
            "proposals": self._proposals.received,
            "proposals_dropped": self._proposals.dropped,
        }


def _subscribe(session: zenoh.Session, key: str, inbox: Inbox) -> None:
    import zenoh

    session.declare_subscriber(key, zenoh.handlers.Callback(inbox.put, indirect=False))


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """A frozen robot must not stall us: BLOCK would wait for it."""
    import zenoh

    return session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP, express=True)
