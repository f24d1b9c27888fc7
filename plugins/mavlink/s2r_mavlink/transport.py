"""The MAVLink transport: between the autopilot and everybody who would like to drive it.

    autopilot  --pose, heartbeats, answers-->  runtime  <--everything, but setpoints--  ground station (a person)
               <--velocity, yaw rate---------           <--nothing that moves---------  companion (other people's controllers)

One thread, the daemon's own: whatever is sent, heartbeats too, is sent by a call of the daemon's loop. What the owner of a robot sets, and
what is promised: docs/mavlink.md.
"""

from __future__ import annotations

import select
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

from s2r_mavlink import dialect
from s2r_mavlink.asking import STOPS, Asking
from s2r_mavlink.door import Door
from s2r_mavlink.endpoints import ROBOT_MOST, SHOWN_MOST, endpoint
from s2r_mavlink.frames import build, newest, packed, payload
from s2r_mavlink.options import MEANINGS, checked
from s2r_mavlink.pose import SOURCES
from s2r_mavlink.relay import Relay
from s2r_mavlink.signing import Signing, default_state, read_key
from s2r_mavlink.wire import Decoded, Wire
from s2r_runtime.messages import Command, Decided, Frame, GateChanged, LinkChanged

SHARE_NS = 4_000_000
"""Of one call: a line is not read any more after so long."""
TEXT_BYTES = 50
TEXT_NS = 1_000_000_000
SAME_TEXT_NS = 10_000_000_000
WARNING, NOTICE = 4, 5
"""MAV_SEVERITY of what is told: closed, open."""


class MavlinkTransport:
    """Interface: `hookspecs.Transport`. options: see OPTIONS. Raises ConfigError for a bad one, naming what would be right."""

    OPTIONS: ClassVar[dict[str, str]] = MEANINGS

    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        self._options = checked(options, states, inputs)
        o = self._options
        self._system, self._own = o["system"], o["own_component"]
        self._timeout_ns = round(o["observation_timeout"] * 1e9)
        self._wire = Wire(o, states, inputs)
        autopilot = (self._system, o["component"])
        robot = frozenset((autopilot, (self._system, o["pose_component"] or o["component"])))
        self._door = Door(robot, autopilot, frozenset(SOURCES[o["pose"]]), o["queue"])
        self._line = endpoint(o["robot"], many=False)
        reserved = robot | {(self._system, self._own)}
        self._relays = [Relay(side, endpoint(o[side], many=True), reserved) for side in ("ground", "companion") if o[side]]
        self._sides: deque[Relay | None] = deque((None, *self._relays))  # None: the robot's
        self._asking = Asking(o, self._wire, self._door.told, self._tell_robot)
        self._poller: select.epoll | None = None
        self._sequence = 0
        self._source = ""
        self._sent = self._dropped_out = self._overflowed = 0
        self._up: bool | None = None
        self._ups = 0
        self._opened_ns = 0
        self._texts: dict[str, int] = {}
        self._text_ns = -TEXT_NS

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Opens what is there, reads the key; returns at once. Raises ConfigError for what can never work."""
        self.close()
        self._poller = select.epoll()
        try:
            if self._options["signing_key_file"]:
                key = read_key(Path(self._options["signing_key_file"]).expanduser())
                state = self._options["signing_state"]
                self._door.signing = Signing(key, Path(state).expanduser() if state else default_state(key), time.time())
            self._line.open(self._poller)
            for relay in self._relays:
                relay.open(self._poller)
        except BaseException:
            self.close()
            raise
        self._opened_ns = time.monotonic_ns()

    def close(self) -> None:
        """Puts the robot aside if the profile says so, and frees everything; may be called twice."""
        if self._poller is None:
            return
        with suppress(Exception):  # everything must be freed all the same
            self._asking.leave()
        for line in (self._line, *(relay.line for relay in self._relays)):
            with suppress(OSError):
                line.close()
        if self._door.signing is not None:
            self._door.signing.close()
        self._poller.close()
        self._poller = None

    # ------------------------------------------------------------------ in

    def fileno(self) -> int:
        """Readable when `receive` has something."""
        return -1 if self._poller is None else self._poller.fileno()

    def receive(self) -> list[Frame]:
        """What came since the last call, oldest first; never blocks. What others send to the robot passes on here too."""
        if self._poller is None:
            return []
        ready = {number for number, _ in self._poller.poll(0)}
        until_ns = time.monotonic_ns() + SHARE_NS
        frames: list[Frame] = []
        for _ in range(len(self._sides)):
            if time.monotonic_ns() > until_ns:  # the next call begins with the line that was not read
                break
            relay = self._sides[0]
            self._sides.rotate(-1)
            if not ready.isdisjoint((self._line if relay is None else relay.line).descriptors()):
                frames += self._from_robot() if relay is None else self._from_others(relay)
        frames += self._door.notes(time.monotonic_ns())
        return frames

    def _from_robot(self) -> list[Frame]:
        pieces = self._line.read(ROBOT_MOST)
        frames = self._door.come_in(self._line, pieces)
        self._show([data for piece in pieces if not self._line.is_other(piece.source) for data in piece.frames])
        return frames + self._overflow()

    def _from_others(self, relay: Relay) -> list[Frame]:
        through, refused = relay.take()
        for data in through:
            self._line.write(data)
        return refused

    def _show(self, frames: list[bytes]) -> None:
        """The robot's newest frames to everybody else, unchanged; those that came together go together, as each write costs more than a
        frame.
        """
        for data in packed(newest(frames, SHOWN_MOST)) if self._relays else []:
            for relay in self._relays:
                relay.line.write(data)

    def _overflow(self) -> list[Frame]:
        """What the kernel dropped, because nobody came for it."""
        gone = self._line.overflowed - self._overflowed
        self._overflowed += gone
        return [Frame(time.monotonic_ns(), "door", b"dropped %d" % gone)] if gone > 0 else []

    def decode(self, frame: Frame) -> list[Decoded]:
        """What a frame means: see `Wire.decode`."""
        return self._wire.decode(frame)

    def poll(self, now_ns: int) -> list[LinkChanged]:
        """Keeps lines connected, asks what is to be asked, sends the heartbeat. The link is lost when no observation comes."""
        if self._poller is None:
            return []
        self._line.maintain(now_ns)
        for relay in self._relays:
            relay.line.maintain(now_ns)
            if relay.disturbed:
                relay.disturbed = False
                self._asking.rates.begin()
        self._asking.tick(now_ns)
        self._answer_questions(now_ns)
        heard_ns = self._wire.clock.heard_ns
        silent_ns = now_ns - (heard_ns or self._opened_ns)
        if self._wire.ups != self._ups:  # `decode` said so
            self._ups, self._up = self._wire.ups, True
        if silent_ns <= self._timeout_ns:
            if self._up or not heard_ns:
                return []
            self._up = True
            return [LinkChanged(now_ns, up=True)]
        if self._up is False:
            return []
        self._up = False
        since = f"for {silent_ns * 1e-9:.2f} s" if heard_ns else "yet"
        return [LinkChanged(now_ns, up=False, detail=f"no observation {since} from system {self._system} over {self._line.text}")]

    def _answer_questions(self, now_ns: int) -> None:
        while self._door.questions:
            asked = self._door.questions.popleft()
            self._tell_robot(dialect.TIMESYNC, dialect.MESSAGES[dialect.TIMESYNC].pack(now_ns, asked, self._system, 0))

    # ------------------------------------------------------------------ out

    def encode(self, command: Command) -> Frame:
        """The frame of a command. Raises ValueError if it is not finite or not of shape (nu,)."""
        frame = Frame(command.t_ns, "command", self._wire.encode(command), inbound=False)
        self._source = command.source
        return frame

    def send(self, frame: Frame) -> None:
        """Numbers and signs it for the line; what can't be sent is dropped and counted, never waited for."""
        if self._source in ("controller", "sampler"):
            self._asking.driven(time.monotonic_ns())
        if self._tell_robot(dialect.SET_POSITION_TARGET_LOCAL_NED, payload(frame.data)):
            self._sent += 1
        else:
            self._dropped_out += 1

    def _tell_robot(self, number: int, content: bytes) -> bool:
        if self._poller is None:
            return False
        data = self._written(number, content)
        if number in (dialect.HEARTBEAT, dialect.STATUSTEXT):
            for relay in self._relays:
                relay.line.write(data)
        return self._line.write(data)

    def _written(self, number: int, content: bytes) -> bytes:
        """The next frame of ours."""
        signing = self._door.signing
        self._sequence = self._sequence + 1 & 0xFF
        data = build(number, content, self._sequence, self._system, self._own, signed=signing is not None)
        return data if signing is None else signing.sign(data, time.time())

    # ------------------------------------------------------------------ telling people

    def inform(self, record: GateChanged | Decided) -> None:
        """The gate's state, or a command that it refused, as a STATUSTEXT for whoever watches: a second apart, the same one ten."""
        if isinstance(record, GateChanged):
            self._asking.gate("" if record.open else record.reason)
            text = "s2r: gate open" if record.open else f"s2r: gate closed: {record.reason}"
            severity = NOTICE if record.open or record.reason not in STOPS else WARNING
        elif record.allow:
            return
        else:
            text, severity = f"s2r: refused {record.source}: {record.reason}", WARNING
        now_ns = time.monotonic_ns()
        if now_ns - self._text_ns < TEXT_NS or now_ns - self._texts.get(text, -SAME_TEXT_NS) < SAME_TEXT_NS:
            return
        self._text_ns = now_ns
        self._texts = {told: at for told, at in self._texts.items() if now_ns - at < SAME_TEXT_NS} | {text: now_ns}
        said = text.encode("ascii", "replace")[:TEXT_BYTES]
        self._tell_robot(dialect.STATUSTEXT, dialect.MESSAGES[dialect.STATUSTEXT].pack(severity, said, 0, 0))

    def lines(self) -> list[str]:
        """For the journal, since the last call: rates that were granted, what the robot says, who took it over."""
        return self._asking.journal.take()

    def counters(self) -> dict[str, int]:
        """Since construction. See docs/mavlink.md."""
        clock, door = self._wire.clock, self._door
        counts = {
            "received": door.received,
            "sent": self._sent,
            "dropped_in": door.dropped + self._line.overflowed,
            "dropped_out": self._dropped_out,
            "overflowed": self._line.overflowed,
            "malformed": self._line.malformed + self._wire.malformed,
            "lost": door.lost,
            "old": clock.old,
            "ahead": clock.ahead,
            "stale": self._wire.stale,
            "restarts": clock.restarts,
            "unpaired": self._wire.pose.unpaired,
            "out_of_order": door.out_of_order,
            "repeated": door.repeated,
            "reconnected": max(0, self._line.opened - 1),
            "round_trip_us": clock.round_trip_ns // 1000,
            "clock_offset_ms": clock.offset_ns // 1_000_000,
        }
        counts |= {f"rejected_{name}": count for name, count in door.rejected.items()}
        for relay in self._relays:
            for name in ("passed", "refused", "blocked", "unlogged"):
                counts[f"{relay.channel}_{name}"] = getattr(relay, name)
        for rate in self._asking.rates.all:
            counts[f"interval_us_{rate.name}"] = round(1000.0 * min(rate.granted_ms, 1e9))
        return counts
