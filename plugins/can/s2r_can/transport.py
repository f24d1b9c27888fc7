"""The CAN transport: the gate between two interfaces.

    robot's bus  --frames-->  robot side   |   controller side  --the robot's frames-->  everybody else
    robot's bus  <--commands--------       |                    <--command frames------  everybody else: logged, refused

Nothing that comes in on the controllers' side goes out on the robot's. What nobody can do is keep another node from sending on a bus that
it is connected to: the robot must have its bus to itself, but for this computer (docs/can.md). A command that another node sends on
the robot's bus all the same is heard, and taken for a manual override.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any, ClassVar

from s2r_can.addresses import Addresses
from s2r_can.commander import Commander
from s2r_can.database import Database
from s2r_can.inbox import Bell, Inbox, Metronome
from s2r_can.listening import layout_of
from s2r_can.observer import Decoded, Observer
from s2r_can.options import OPTIONS, Options, checked, named
from s2r_can.port import Port
from s2r_can.proposals import Proposals
from s2r_can.reckoning import odometry_of
from s2r_can.records import BUS_OFF, ERROR, EXTENDED, STOPS, Record, packed, records
from s2r_runtime.messages import Command, Frame, LinkChanged, Observation

PROPOSALS_PER_SECOND = 32
ERRORS_PER_SECOND = STRANGERS_PER_SECOND = 32


class CanTransport:
    """Interface: `hookspecs.Transport`. options: see OPTIONS. Raises ConfigError for a bad one, naming what would be right."""

    OPTIONS: ClassVar[dict[str, str]] = OPTIONS

    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        self._options: Options = checked(options)
        self._layout = layout_of(self._options, Database(self._options.dbc, named(self._options)), states, inputs)
        self._timeout_ns = round(self._options.observation_timeout * 1e9)
        self._cycle_ns = round(self._options.command_cycle * 1e9)
        self._observer = Observer(self._layout, states, odometry_of(self._options), self._timeout_ns)
        self._commander = Commander(self._layout, inputs)
        self._proposals = Proposals(self._layout, inputs)
        self._bell = Bell()
        self._inbox = Inbox(self._bell, self._options.queue)
        self._others = Inbox(self._bell, PROPOSALS_PER_SECOND)
        self._commands = self._layout.commands
        self._addresses = Addresses(self._layout.inbound, self._layout.sources)
        self._ring = self._keys()
        self._robot: Port | None = None
        self._controllers: Port | None = None
        self._metronome: Metronome | None = None
        self._due_ns = self._until_ns = 0
        self._encoded: tuple[bytes, int] = (b"", 0)
        self._unheard = self._copies = self._forwarded = self._proposed = self._ignored = self._heard_ns = 0
        self._up: bool | None = None
        self._past = dict.fromkeys(("received", "sent", "dropped", "errors", "opened"), 0)

    def _keys(self) -> dict[int, bool]:
        """Keys of frames that are kept -> whether the daemon is to come for them at once: for what stops the robot, and for the trigger."""
        layout = self._layout
        urgent = {value for _, value in layout.overrides}
        keys = {
            m.key: any(group is layout.trigger or urgent & set(group.into) for group in m.groups) for m in layout.inbound.values()
        }  # fmt: skip
        return {**keys, **dict.fromkeys(layout.commands, True)}

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Begins to open both interfaces and returns at once, whether or not they are there. Raises ConfigError if they can never be."""
        o = self._options
        everything = bool(o.controller) and o.forward == "all"
        self._bell.open()
        self._robot = Port("robot", o.robot, self._from_robot, None if everything else [_filter(key) for key in self._ring])
        self._controllers = Port("controller", o.controller, self._from_controllers) if o.controller else None
        self._heard_ns = time.monotonic_ns()
        try:
            for port in (self._controllers, self._robot):
                if port is not None:
                    port.open()
            if self._cycle_ns:
                self._metronome = Metronome(self._bell)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Closes both; may be called twice."""
        if self._metronome is not None:
            self._metronome.close()
        for port in (self._robot, self._controllers):
            if port is not None:
                port.close()
        self._past = self._totals()
        self._robot = self._controllers = self._metronome = None
        self._bell.close()

    def fileno(self) -> int:
        """Readable when `receive` has something."""
        return self._bell.fileno()

    # ------------------------------------------------------------------ in

    def _from_robot(self, record: Record) -> None:
        """On the port's thread: keeps what this profile reads, and passes on what the other side may hear."""
        ring = self._ring.get(self._addresses.message(record.key))
        if ring is not None:  # of a stranger's commands some will do
            self._inbox.put(record, ring=ring, per_second=STRANGERS_PER_SECOND if record.key in self._commands else 0)
        elif record.key & ERROR and record.key & BUS_OFF:  # it follows a storm of other errors, and must not be lost in it
            self._inbox.put(record._replace(flags=record.flags | STOPS), ring=True, vital=True)
        elif record.key & ERROR:
            self._inbox.put(record, ring=True, per_second=ERRORS_PER_SECOND)
        else:
            self._unheard += 1
        others = self._controllers
        if others is None or record.key & ERROR or record.key in self._commands:
            return
        if self._options.forward == "all" or (self._options.forward == "named" and ring is not None):
            self._forwarded += others.send(record)

    def _from_controllers(self, record: Record) -> None:
        if record.key in self._commands:
            self._proposed += 1
            self._others.put(record, ring=True, per_second=PROPOSALS_PER_SECOND)
        else:
            self._ignored += 1

    def receive(self) -> list[Frame]:
        """What came since the last call, oldest first; never blocks. A frame ends with what makes an observation."""
        self._bell.answer()
        frames = self._repeat()
        batch: list[Record] = []
        for record in self._inbox.take():
            batch.append(record)
            if self._ring.get(self._addresses.message(record.key), True):
                frames.append(_frame("robot", batch))
                batch = []
        if batch:
            frames.append(_frame("robot", batch))
        frames += [_frame("controllers", [record]) for record in self._others.take()]
        return frames

    def decode(self, frame: Frame) -> list[Decoded]:
        """What an inbound frame means: records of the robot's bus, a proposal, or a copy of a command that left here."""
        said: list[Decoded] = []
        if frame.channel == "robot":
            said = self._observer.decode(frame.data)
            for message in said:
                if isinstance(message, Observation):
                    if not message.fault:
                        self._heard_ns = frame.arrival_ns
                elif isinstance(message, LinkChanged):
                    self._up = message.up
        elif frame.channel == "controllers":
            said = [*self._proposals.decode(frame, self._observer.newest[0])]
        elif frame.channel == "copy":
            self._commander.repeated()
        return said

    def poll(self, now_ns: int) -> list[LinkChanged]:
        """Link lost or back, by the time since the last observation, and by what the interface says. now_ns: the host's monotonic clock."""
        trouble = (self._robot.trouble or self._robot.refuses(self._timeout_ns * 1e-9)) if self._robot is not None else ""
        silent_ns = now_ns - self._heard_ns
        if silent_ns <= self._timeout_ns and not trouble:
            if self._up is not False or self._observer.bus_off or self._observer.newest[0] < 0:
                return []
            self._up = True
            return [LinkChanged(now_ns, up=True)]
        if self._up is False or (self._up is None and silent_ns <= self._timeout_ns):
            return []
        self._up = False
        detail = trouble or self._silence(now_ns, silent_ns)
        self._heard_ns = min(self._heard_ns, now_ns - self._timeout_ns - 1)  # only what comes from now on brings it back
        return [LinkChanged(now_ns, up=False, detail=detail)]

    def _silence(self, now_ns: int, silent_ns: int) -> str:
        """Why there is no observation."""
        seen = self._observer.newest[0] >= 0
        since = f"for {silent_ns * 1e-9:.2f} s" if seen else "yet"
        missing = []
        for group in self._layout.groups:
            at_ns = self._observer.times[group.index]
            if at_ns is None:
                missing.append(f"{group.label} (no good frame)")
            elif group.max_age_ns is not None and now_ns - at_ns > max(group.max_age_ns, silent_ns // 2):
                missing.append(f"{group.label} (last {(now_ns - at_ns) * 1e-9:.2f} s ago)")
        return f"no observation {since}" + (f"; missing: {', '.join(missing)}" if missing else "")

    # ------------------------------------------------------------------ out

    def encode(self, command: Command) -> Frame:
        """The frames of a command. Raises ValueError if it is not finite, not of shape (nu,), or its signals can't hold it."""
        data = self._commander.encode(command)
        self._encoded = (data, command.ttl_ns)
        return Frame(command.t_ns, "command", data, inbound=False)

    def send(self, frame: Frame) -> None:
        """Hands it to the robot's bus; what can't be sent is dropped and counted, never waited for."""
        self._send(frame.data)
        if self._metronome is not None and frame.data == self._encoded[0]:
            now_ns = time.monotonic_ns()
            self._due_ns, self._until_ns = now_ns + self._cycle_ns, now_ns + self._encoded[1]
            self._metronome.at(self._due_ns if self._due_ns < self._until_ns else None)

    def _send(self, data: bytes) -> None:
        for record in records(data):
            if self._robot is not None:
                self._robot.send(record)
            else:
                self._past["dropped"] += 1

    def _repeat(self) -> list[Frame]:
        """Sends the last command once more if that is due. The copy comes first in what is received, so that whoever encodes the next
        command has decoded it, and counts on from it; an audit does the same.
        """
        now_ns = time.monotonic_ns()
        if self._metronome is None or not self._due_ns or now_ns < self._due_ns:
            return []
        if now_ns >= self._until_ns:
            self._due_ns = 0
            return []
        data = self._commander.copy()
        self._send(data)
        self._copies += 1
        self._due_ns = max(self._due_ns + self._cycle_ns, now_ns)
        self._metronome.at(self._due_ns if self._due_ns < self._until_ns else None)
        return [Frame(now_ns, "copy", data)]

    # ------------------------------------------------------------------ counts

    def _totals(self) -> dict[str, int]:
        counts = self._robot.counts if self._robot is not None else {}
        return {name: past + counts.get(name, 0) for name, past in self._past.items()}

    def counters(self) -> dict[str, int]:
        """Since construction; explained in docs/can-reference.md."""
        totals = self._totals()
        counts = dict(self._observer.counts)
        counts["foreign"] += self._unheard
        return {
            "received": totals["received"],
            "sent": totals["sent"],
            "dropped_in": self._inbox.dropped + self._others.dropped,
            "dropped_out": totals["dropped"],
            **counts,
            "copies": self._copies,
            "proposals": self._proposed,
            "proposals_dropped": self._others.dropped,
            "ignored": self._ignored,
            "forwarded": self._forwarded,
            "interface_errors": totals["errors"],
            "opened": totals["opened"],
        }


def _frame(channel: str, batch: Iterable[Record]) -> Frame:
    held = list(batch)
    return Frame(held[-1].stamp_ns, channel, b"".join(map(packed, held)))


def _filter(key: int) -> dict[str, Any]:
    extended = bool(key & EXTENDED)
    return {"can_id": key & 0x1FFFFFFF, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended}
