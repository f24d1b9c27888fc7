"""The daemon's side of the transport: frames in, messages out; commands in, frames out. What a transport raises, or gives that it may not,
ends here: a link that is down, with the plug-in and the call named. A call that hangs puts the transport out of use (`hang_guard`).

What `receive` gave and nobody can take may have held an emergency stop, so it counts as one: it latches, until a person clears it.

Also the daemon's clock: the host's monotonic one in real time; in lockstep the robot's own, as its newest observation shows it.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import TypeVar

from s2r_runtime.daemon import transport_values as values
from s2r_runtime.daemon.hang_guard import CALL_S, OPEN_S, HangGuard, Hung
from s2r_runtime.daemon.settings import ModelFacts
from s2r_runtime.daemon.transport_values import Inbound
from s2r_runtime.errors import ConfigError, PluginError, S2RError, one_line
from s2r_runtime.hookspecs import Transport
from s2r_runtime.messages import Command, Decided, Frame, GateChanged, LinkChanged, LogHead, Observation, OverrideChanged, Send
from s2r_runtime.plugins import registry
from s2r_runtime.profile import Profile

Result = TypeVar("Result")

CALM_NS = 1_000_000_000
"""Without a flood, after which a link that was flooded is used again."""
TOLD_AGAIN_NS = 100_000_000
"""Between two stops for dropped input: a transport that floods at every call must not fill the log."""
METHODS = ("open", "fileno", "receive", "decode", "poll", "encode", "send", "counters", "close")


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
    """A transport that never raises and never hangs. A fault in it is a lost link, which closes the gate, until the call that failed
    works again and an observation gets through. After a hang nothing more is asked of it: `out_of_use`.

    named: the transport and who made it, for people. nx: components of a state. record: takes every frame, inbound ones before they are
    decoded.
    """

    def __init__(self, transport: Transport, named: str, nx: int, record: Callable[[Frame], None], guard: HangGuard) -> None:
        self.transport = transport
        self._named, self._nx, self._record, self._guard = named, nx, record, guard
        self._faults: dict[str, str] = {}
        self._down = False
        self._calm_ns = 0
        self._flooded = 0
        self._dropped = ""
        self._tell_ns = 0
        self._fileno = -1
        self._news: list[LinkChanged] = []
        self._journal: list[str] = []
        self._waiting: deque[Frame] = deque()
        self.out_of_use = False

    @property
    def trouble(self) -> str:
        """What is wrong with the transport itself; empty while it does what it should."""
        return "; ".join(self._faults.values())

    def open(self) -> None:
        """Connects. Raises ConfigError if that can never succeed."""
        doing = "open"
        try:
            self._ask(doing, self.transport.open, limit_s=OPEN_S)
            doing = "fileno"
            self._fileno = values.descriptor(self._ask(doing, self.transport.fileno))
        except ConfigError:
            raise
        except BaseException as error:  # noqa: BLE001 - a plug-in's defect must not stop the daemon, which keeps the gate closed
            self.refuse(doing, error)

    def fileno(self) -> int:
        """Readable when `receive` has something; -1 if there is nothing to wait for."""
        return self._fileno

    def refuse(self, what: str, error: BaseException) -> None:
        """Nothing more is asked of this transport."""
        self.out_of_use = True
        self._news += self._failed(what, error)

    def receive(self, until_ns: float = math.inf) -> Iterator[tuple[int, Inbound]]:
        """(arrival on the host's clock, ns; what came), in order. The caller acts on each before it takes the next, and takes them all.
        until_ns: after that time no further frame is begun; the rest comes with the next call (`waits`).
        """
        if not self._waiting:
            yield from self._take()
        while self._waiting and not self.out_of_use:
            frame = self._waiting.popleft()
            self._record(frame)
            yield from self._passed_on(frame, self._decoded(frame))
            if time.monotonic_ns() >= until_ns:
                return

    @property
    def waits(self) -> bool:
        """Whether frames came that were not decoded yet."""
        return bool(self._waiting) and not self.out_of_use

    def _take(self) -> Iterator[tuple[int, Inbound]]:
        """What the transport has; yields what became of input that could not be taken."""
        if self.out_of_use:
            return
        given: object = None
        try:
            given = self._ask("receive", self.transport.receive)
            frames = values.frames(given, time.monotonic_ns())
        except BaseException as error:  # noqa: BLE001 - a plug-in's defect must not stop the gate
            yield from self._spoilt(given, error)
            return
        if time.monotonic_ns() >= self._calm_ns:
            self._faults.pop("receive", None)
        self._waiting.extend(frames)

    def _spoilt(self, given: object, error: BaseException) -> Iterator[tuple[int, Inbound]]:
        """What becomes of input that could not be taken. given: what the transport gave, None if nothing."""
        if given is not None:
            self._dropped = one_line(f"{values.DROPPED}{error}; what was dropped may have been a stop")
            for stop in self._dropped_input():
                yield stop.t_ns, stop
        for change in self._failed("receive", error):
            yield change.t_ns, change

    def _decoded(self, frame: Frame) -> list[Inbound]:
        """What a frame says, and that the transport could not tell, where it couldn't."""
        messages: list[Inbound] = []
        try:
            messages, fault = self._ask("decode", values.decoded, self.transport, frame, self._nx)
        except BaseException as error:  # noqa: BLE001 - as above
            messages += self._failed("decode", error)
        else:
            if fault is None:
                self._faults.pop("decode", None)
            else:
                messages += self._failed("decode", fault)
        return messages

    def _passed_on(self, frame: Frame, messages: list[Inbound]) -> Iterator[tuple[int, Inbound]]:
        """Them, and what they mean for a transport that was at fault: down until something usable came."""
        for message in messages:
            if self._down and not self._faults and isinstance(message, Observation):
                self._down = False
                self._journal.append(f"{self._named} works again")
                yield frame.arrival_ns, LinkChanged(frame.arrival_ns, up=True, detail="the transport works again")
            yield frame.arrival_ns, message
            if self._faults and isinstance(message, LinkChanged) and message.up:  # it may hear its robot, and be of no use yet
                yield frame.arrival_ns, LinkChanged(frame.arrival_ns, up=False, detail=f"transport: {self.trouble}")

    def poll(self, now_ns: int) -> Iterator[LinkChanged | OverrideChanged]:
        """Link lost or back, by the transport's own time-outs; and a stop for input that was dropped. now_ns: the host's clock."""
        news, self._news = self._news, []
        yield from news
        yield from self._dropped_input()
        if self.out_of_use:
            return
        try:
            changes = values.link_changes(self._ask("poll", self.transport.poll, now_ns))
        except BaseException as error:  # noqa: BLE001 - as above
            yield from self._failed("poll", error)
            return
        self._faults.pop("poll", None)
        yield from (change for change in changes if not (change.up and self._faults))

    def send(self, send: Send) -> Iterator[LinkChanged]:
        """The robot is told; the frame is recorded after it left."""
        if self.out_of_use:
            return
        command = Command(send.seq, send.t_ns, send.source, send.u, send.obs_seq, send.ttl_ns)
        try:
            frame = values.outbound(self._ask("encode", self.transport.encode, command))
        except BaseException as error:  # noqa: BLE001 - as above
            yield from self._failed("encode", error)
            return
        self._faults.pop("encode", None)
        try:
            self._ask("send", self.transport.send, frame)
        except BaseException as error:  # noqa: BLE001 - as above
            yield from self._failed("send", error)
            return
        self._faults.pop("send", None)
        self._record(frame)

    def inform(self, record: GateChanged | Decided) -> None:
        """For people on the robot's side, if the transport tells them anything."""
        self._aside("inform", record)

    def anchor(self, head: LogHead) -> None:
        """The head of the log's chain, for whoever keeps it."""
        self._aside("anchor", head)

    def lines(self) -> list[str]:
        """For the journal: what became of the transport, and what it has to say itself."""
        own, self._journal = self._journal, []
        given: object = self._aside("lines")
        try:
            said = [] if given is None else values.lines(given)
        except BaseException:  # noqa: BLE001 - nobody's safety hangs on it
            said = []
        return [one_line(line) for line in own + said]

    def counters(self) -> dict[str, int]:
        """The transport's counters."""
        given: object = self._aside("counters")
        try:
            found = {} if given is None else values.counters(given)
        except TypeError:
            found = {}
        return found | ({"flooded": self._flooded} if self._flooded else {})

    def close(self) -> None:
        """Frees the transport; one that hung is left as it is."""
        if not self.out_of_use:
            self._aside("close", limit_s=OPEN_S)

    # ------------------------------------------------------------------ asking

    def _ask(self, what: str, function: Callable[..., Result], *args: object, limit_s: float = 0.0) -> Result:
        return self._guard.call(f"{self._named}: {what}", limit_s or CALL_S, function, *args)

    def _aside(self, what: str, *args: object, limit_s: float = 0.0) -> object:
        """What nobody's safety hangs on, as long as it returns. None where it isn't there, or failed."""
        if self.out_of_use or (function := getattr(self.transport, what, None)) is None:
            return None
        try:
            given: object = self._ask(what, function, *args, limit_s=limit_s)
        except Hung as error:
            self.refuse(what, error)
        except BaseException:  # noqa: BLE001 - it is only for people
            return None
        else:
            return given
        return None

    def _dropped_input(self) -> Iterator[OverrideChanged]:
        """The stop that stands for all that was dropped since the last one."""
        now_ns = time.monotonic_ns()
        if self._dropped and now_ns >= self._tell_ns:
            detail, self._dropped = self._dropped, ""
            self._tell_ns = now_ns + TOLD_AGAIN_NS
            yield OverrideChanged(now_ns, "emergency_stop", detail)

    def _failed(self, what: str, error: BaseException) -> Iterator[LinkChanged]:
        """One event a fault, not one a call: a transport that fails at 100 Hz must not fill the log."""
        now_ns = time.monotonic_ns()
        self.out_of_use = self.out_of_use or isinstance(error, Hung)
        if isinstance(error, values.Flood):
            self._flooded += 1
            self._calm_ns = now_ns + CALM_NS
        if what in self._faults:
            return
        self._down = True
        plain = isinstance(error, Hung | values.Flood)
        said = one_line(f"{what} {error}" if plain else f"{what} raised {type(error).__name__}: {error}")
        self._faults[what] = said
        self._journal.append(f"{self._named}: {said}" + ("; out of use until the daemon starts anew" if self.out_of_use else ""))
        yield LinkChanged(now_ns, up=False, detail=f"transport: {said}")


def link_of(profile: Profile, facts: ModelFacts, record: Callable[[Frame], None], guard: HangGuard) -> RobotLink:
    """The link that the profile describes, not opened yet. Raises ConfigError for an unknown transport or a bad option."""
    options = {name: value for name, value in profile.transport.items() if name != "name"}
    name = str(profile.transport.get("name"))
    make = registry().get("transports", name)
    named = f"transport {name!r} of {registry().offered('transports', name).distribution}"
    try:
        transport = guard.call(f"{named}: construction", OPEN_S, make, options, facts.states, facts.inputs)  # it may read files of its own
    except S2RError:
        raise
    except BaseException as error:  # noqa: BLE001 - a plug-in's defect, said as one
        raise PluginError(one_line(f"{named} cannot be made: {type(error).__name__}: {error}")) from None
    if missing := [method for method in METHODS if not callable(getattr(transport, method, None))]:
        raise PluginError(f"{named} lacks {', '.join(missing)}: see Transport in s2r_runtime/hookspecs.py")
    return RobotLink(transport, named, len(facts.states), record, guard)
