"""The daemon's side of the transport: frames in, messages out; commands in, frames out. What a transport raises ends here.

Also the daemon's clock: the host's monotonic one in real time; in lockstep the robot's own, as its newest observation shows it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from s2r_runtime.daemon.settings import ModelFacts
from s2r_runtime.errors import one_line
from s2r_runtime.hookspecs import Transport
from s2r_runtime.messages import Command, Decided, Frame, GateChanged, LinkChanged, Observation, OverrideChanged, Send
from s2r_runtime.plugins import registry
from s2r_runtime.profile import Profile

Inbound = Observation | Command | LinkChanged | OverrideChanged


class Clock:
    """`now`: ns, never backwards. In lockstep it stands still while the robot does; a robot that starts anew goes on where it was."""

    def __init__(self, *, lockstep: bool) -> None:
        self.lockstep = lockstep
        self._now = 0
        self._offset = 0
        self._last: tuple[int, int] = (-1, -1)

    def now(self) -> int:
        """The time that the core sees."""
        return self._now if self.lockstep else time.monotonic_ns()

    def seen(self, observation: Observation) -> None:
        """An observation came; in lockstep its stamp is the time."""
        if not self.lockstep or observation.fault:
            return
        last_seq, last_stamp = self._last
        if observation.seq < last_seq and observation.stamp_ns < last_stamp:  # both go back: the robot was started anew
            self._offset = self._now - observation.stamp_ns
        self._last = (observation.seq, observation.stamp_ns)
        self._now = max(self._now, observation.stamp_ns + self._offset)


class RobotLink:
    """A transport that never raises. A fault in it is a lost link, which closes the gate, until an observation gets through again.

    record: takes every frame, inbound ones before they are decoded.
    """

    def __init__(self, transport: Transport, record: Callable[[Frame], None]) -> None:
        self.transport = transport
        self._record = record
        self._fault = ""

    def open(self) -> None:
        """Connects. Raises ConfigError if that can never succeed."""
        self.transport.open()

    def fileno(self) -> int:
        """Readable when `receive` has something."""
        return self.transport.fileno()

    def receive(self) -> Iterator[tuple[int, Inbound]]:
        """(arrival on the host's clock, ns; what came), in order. The caller acts on each before it takes the next."""
        try:
            frames = self.transport.receive()
        except Exception as error:  # noqa: BLE001 - a plug-in's defect must not stop the gate
            for change in self._failed("receive", error):
                yield change.t_ns, change
            return
        for frame in frames:
            self._record(frame)
            try:
                messages = self.transport.decode(frame)
            except Exception as error:  # noqa: BLE001 - as above
                messages = list(self._failed("decode", error))
            for message in messages:
                if self._fault and isinstance(message, Observation):
                    self._fault = ""
                    yield frame.arrival_ns, LinkChanged(frame.arrival_ns, up=True, detail="the transport works again")
                yield frame.arrival_ns, message

    def poll(self, now_ns: int) -> Iterator[LinkChanged]:
        """Link lost or back, by the transport's own time-outs. now_ns: the host's clock."""
        try:
            yield from self.transport.poll(now_ns)
        except Exception as error:  # noqa: BLE001 - as above
            yield from self._failed("poll", error)

    def send(self, send: Send) -> Iterator[LinkChanged]:
        """The robot is told; the frame is recorded after it left."""
        try:
            frame = self.transport.encode(Command(send.seq, send.t_ns, send.source, send.u, send.obs_seq, send.ttl_ns))
            self.transport.send(frame)
        except Exception as error:  # noqa: BLE001 - as above
            yield from self._failed("send", error)
            return
        self._record(frame)

    def inform(self, record: GateChanged | Decided) -> None:
        """For people on the robot's side, if the transport tells them anything."""
        with contextlib.suppress(Exception):  # nobody's safety hangs on it
            if (inform := getattr(self.transport, "inform", None)) is not None:
                inform(record)

    def lines(self) -> list[str]:
        """For the journal, if the transport has anything to say."""
        with contextlib.suppress(Exception):  # as above
            if (lines := getattr(self.transport, "lines", None)) is not None:
                return [one_line(str(line)) for line in lines()]
        return []

    def counters(self) -> dict[str, int]:
        """The transport's counters."""
        try:
            return self.transport.counters()
        except Exception:  # noqa: BLE001 - numbers for a status line
            return {}

    def close(self) -> None:
        """Frees the transport."""
        try:
            self.transport.close()
        except Exception:  # noqa: BLE001 - on the way out there is nobody left to tell
            return

    def _failed(self, what: str, error: Exception) -> Iterator[LinkChanged]:
        """One event a fault, not one a call: a transport that fails at 100 Hz must not fill the log."""
        text = f"transport: {what} raised {type(error).__name__}: {error}"
        if text != self._fault:
            self._fault = text
            yield LinkChanged(time.monotonic_ns(), up=False, detail=text)


def link_of(profile: Profile, facts: ModelFacts, record: Callable[[Frame], None]) -> RobotLink:
    """The link that the profile describes, not opened yet. Raises ConfigError for an unknown transport or a bad option."""
    options = {name: value for name, value in profile.transport.items() if name != "name"}
    transport = registry().get("transports", str(profile.transport.get("name")))
    return RobotLink(transport(options, facts.states, facts.inputs), record)
