"""Decodes the raw frames again, and encodes the commands again: what was acted on must be what came, what left what was decided."""

from __future__ import annotations

from collections import deque

import msgspec

from s2r_runtime.audit.findings import Findings
from s2r_runtime.daemon import transport_values
from s2r_runtime.daemon.transport_values import Inbound
from s2r_runtime.hookspecs import Transport
from s2r_runtime.messages import (
    Command,
    Event,
    Frame,
    LinkChanged,
    Observation,
    ObservationRefused,
    Observed,
    OverrideChanged,
    Proposed,
    RecorderChanged,
    Send,
)
from s2r_runtime.recording.reading import Entry

FAULT = "transport: "
DECODE_FAILED = f"{FAULT}decode "
"""How the daemon's event of a frame begins whose decoding failed there."""


class Frames:
    """One run's frames, through a transport of the log's own profile that is never opened."""

    def __init__(self, transport: Transport, nx: int, findings: Findings, *, counts_faults: bool = True) -> None:
        """nx: components of a state. counts_faults: whether the run's version counted refused observations, and noticed twins. One that
        did not took nothing else from the same frames.
        """
        self._counts_faults = counts_faults
        self._transport, self._nx, self._findings = transport, nx, findings
        self._due: deque[Inbound] = deque()
        self._source = 0
        self._sends: deque[Send] = deque()
        self._left: deque[tuple[Entry, Frame]] = deque()
        self._missing = 0  # commands without a frame, since which no fault of the link was recorded
        self._at_fault = False  # one was, since a frame left last

    def inbound(self, entry: Entry, frame: Frame) -> None:
        """A frame came. Everything that the one before was decoded to must have become an event by now."""
        self.commands_left()
        self._all_left(entry)
        self._events_are_there(entry)
        self._source = entry.index
        try:
            said = transport_values.decoded(self._transport, frame, self._nx).messages
            self._due.extend(one for one in said if self._counts_faults or not _came_later(one))
        except Exception:  # noqa: BLE001 - a plug-in's defect; the daemon took it for a lost link and went on, and so does this
            self._due.clear()
        self._findings.count("frames")

    def event(self, entry: Entry, event: Event) -> None:
        """An event: one that only a frame can have brought must be the next that a frame did bring."""
        self.commands_left()
        due = self._due[0] if self._due else None
        if isinstance(event, RecorderChanged) or (isinstance(event, LinkChanged) and event.detail.startswith(FAULT)):
            self._missing, self._at_fault = 0, True
        if isinstance(event, LinkChanged):
            if isinstance(due, LinkChanged) and (due.up, due.detail) == (event.up, event.detail):
                self._due.popleft()
            elif not event.up and event.detail.startswith(DECODE_FAILED) and due is not None:
                self._said_nothing(entry)
            return  # otherwise it is the daemon's own: a time-out
        told = _message(event)
        if told is None:
            return
        if isinstance(due, OverrideChanged | ObservationRefused):
            due = msgspec.structs.replace(due, t_ns=0)
        elif isinstance(due, Command):
            due = msgspec.structs.replace(due, source="external")
        if (
            told != due
            and isinstance(told, OverrideChanged)
            and told.kind == "emergency_stop"
            and told.detail.startswith(transport_values.DROPPED)
        ):
            return  # the daemon's own, for what it could not take: it stops more than the frames say, never less
        if told != due:
            what = f"this is not what frame {self._source} says"
            self._findings.differ(entry.index, entry.channel, what, entry.raw, due)
            self._due.clear()
            return
        self._due.popleft()

    def _said_nothing(self, entry: Entry) -> None:
        """The log says that a frame could not be decoded, and now it can: a call that hung then, or a lie. It hides no stop."""
        stop = next((one for one in self._due if isinstance(one, OverrideChanged)), None)
        if stop is not None:
            what = f"frame {self._source} could not be decoded, says this, and it is a stop"
            self._findings.differ(entry.index, entry.channel, what, entry.raw, stop)
        else:
            self._findings.cannot(f"frame {self._source}: it could not be decoded, says the log, and now it can")
        self._due.clear()

    def send(self, send: Send) -> None:
        """The core had this sent."""
        self._sends.append(send)

    def outbound(self, entry: Entry, frame: Frame) -> None:
        """A frame left."""
        self._left.append((entry, frame))

    def _events_are_there(self, entry: Entry) -> None:
        if self._due:
            what = f"frame {self._source} says more than the events that follow it"
            self._findings.differ(entry.index, entry.channel, what, None, self._due[0])
            self._due.clear()

    def _all_left(self, entry: Entry) -> None:
        """The daemon records a fault of the link before it takes the next frame: without one every command left."""
        if self._missing:
            what = f"{self._missing} commands before this frame did not leave, and no fault of the link is recorded"
            self._findings.differ(entry.index, entry.channel, what, None, None)
            self._missing = 0

    def end(self, entry: Entry | None, last_act: Send | None, *, clean: bool) -> None:
        """Nothing follows. last_act: the one command that the daemon gives on its own, when something in it breaks. clean: and
        nothing was cut.
        """
        if last_act is not None and self._left:
            self._sends.append(last_act)
        self.commands_left()
        if clean and entry is not None:
            self._events_are_there(entry)

    def commands_left(self) -> None:
        """Frames that left since the event before are its commands', in order. A command without a frame could not be sent: see
        `_all_left`.
        """
        while self._sends:
            encoded = self._encoded(self._sends.popleft())
            if self._left and _same(encoded, self._left[0][1]):
                self._left.popleft()
                self._at_fault = False
                self._findings.count("frames")
            else:
                self._missing += not self._at_fault
                self._findings.count("commands that did not leave")
        if self._left:
            entry, _ = self._left[0]
            self._findings.differ(entry.index, entry.channel, "a frame left that no command of the core makes", entry.raw, None)
            self._left.clear()

    def _encoded(self, send: Send) -> Frame | None:
        """Each command is encoded once, in order, as the daemon did: a transport may count them."""
        command = Command(send.seq, send.t_ns, send.source, send.u, send.obs_seq, send.ttl_ns)
        try:
            return transport_values.outbound(self._transport.encode(command))
        except Exception:  # noqa: BLE001 - it refused the command, or a plug-in's defect: nothing left then either
            return None


def _same(encoded: Frame | None, left: Frame) -> bool:
    """Whether these bytes left, to where they belong; when they left is the daemon's word."""
    return encoded is not None and (encoded.channel, encoded.data) == (left.channel, left.data)


def _came_later(message: Inbound) -> bool:
    """Whether an earlier version's transports never said this."""
    return isinstance(message, ObservationRefused) or (isinstance(message, OverrideChanged) and message.kind == "robot_twin")


def _message(event: Event) -> Inbound | None:
    """What a frame must have said for this event; None for events that do not come from frames."""
    if isinstance(event, Observed):
        observation: Observation = event.observation
        return observation
    if isinstance(event, Proposed) and event.command.source == "external":
        return event.command
    if isinstance(event, OverrideChanged | ObservationRefused):
        return msgspec.structs.replace(event, t_ns=0)
    return None
