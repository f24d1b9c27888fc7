"""Frames are decoded and the watch is measured again in a process of its own, beside the core: together they take as long as that does.

What it is told, messages as they were recorded and commands as the core gives them, goes through a pipe, a thousand at a time. What it
found comes back at the end, and counts as if it had been found here: the first difference is the one that stands first in the log.
"""

from __future__ import annotations

import multiprocessing
import pickle
import traceback
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.audit.findings import Findings
from s2r_runtime.audit.frames import Frames
from s2r_runtime.audit.watch import WatchReplay
from s2r_runtime.errors import S2RError
from s2r_runtime.messages import (
    AnalyticsChanged,
    Event,
    LinkChanged,
    Measured,
    ObservationRefused,
    Observed,
    OverrideChanged,
    Proposed,
    Send,
    SourceStopped,
)
from s2r_runtime.plugins import registry
from s2r_runtime.recording.channels import FRAME_IN
from s2r_runtime.recording.reading import Entry

if TYPE_CHECKING:
    from s2r_runtime.messages import Gap, Memory
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.profile import Profile

CALLS = 1000
"""Told at once: fewer cost more turns, more only memory."""
_TOLD = frozenset((Observed, ObservationRefused, Measured, LinkChanged, OverrideChanged, AnalyticsChanged, SourceStopped))
"""Events that matter there; of `Proposed` those by others."""
_ENCODE = msgspec.json.Encoder().encode
_SEND = msgspec.json.Decoder(Send)


class Beside:
    """The process, for all runs. It begins with the first one."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._calls: list[tuple[Any, ...]] = []
        self._pipe: Connection | None = None
        self._process: Any = None
        self._file = ""
        self._quiet = True

    def run(
        self, transport: str, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...], *, counts_faults: bool = True
    ) -> None:
        """A run begins, with this transport. counts_faults: as in `Frames`."""
        if self._pipe is None:
            self._start()
        self._tell("run", transport, options, states, inputs, counts_faults)

    def frame(self, entry: Entry) -> None:
        """A frame is recorded."""
        self._quiet = False
        self._tell("frame", entry.index, entry.channel, entry.raw)

    def event(self, entry: Entry, event: Event) -> None:
        """An event is recorded."""
        kind = type(event)
        if kind in _TOLD or (kind is Proposed and event.command.source == "external"):  # type: ignore[union-attr]
            self._quiet = True
            self._tell("event", entry.index, entry.channel, entry.raw)
        elif not self._quiet:
            self._quiet = True
            self._tell("other")

    def sent(self, send: Send) -> None:
        """The core had this sent."""
        self._quiet = False
        self._tell("sent", _ENCODE(send))

    def begin(self, profile: Profile, gap: Gap, memory: Memory, *, lockstep: bool, rules: int) -> None:
        """A controller starts: see `WatchReplay.begin`. The process composes the model itself."""
        self._tell("begin", profile, gap, memory, lockstep, rules)

    def stop(self) -> None:
        """It is stopped."""
        self._tell("stop")

    def finish(self, last: Entry | None, last_act: Send | None, t_ns: int, *, clean: bool, stopped: bool) -> None:
        """The run is over."""
        place = (0, "") if last is None else (last.index, last.channel)
        self._tell("finish", *place, None if last_act is None else _ENCODE(last_act), t_ns, clean, stopped)

    def end(self) -> None:
        """Nothing follows: what it found is added to what was found here. Raises the S2RError that it met, RuntimeError if it failed."""
        if self._pipe is None:
            return
        self._calls.append(("over",))
        self._flush()
        try:
            found = self._pipe.recv()
        except (EOFError, OSError):
            found = "the process died"
        if isinstance(found, S2RError):
            raise found
        if not isinstance(found, Findings):
            raise RuntimeError(f"frames and watch could not be computed again: {found}")  # noqa: TRY004 - it says what went wrong there
        self.close()
        self._findings.add(found)

    def close(self) -> None:
        """Ends it, whatever it is doing."""
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
            self._process.kill()
            self._process.join()

    def _start(self) -> None:
        forking = multiprocessing.get_context("fork")  # what is loaded here need not be loaded again
        ours, theirs = forking.Pipe()
        self._process = forking.Process(target=_serve, args=(theirs, ours), daemon=True)
        self._process.start()
        theirs.close()
        self._pipe = ours

    def _tell(self, *call: Any) -> None:
        if self._file != self._findings.file:
            self._file = self._findings.file
            self._calls.append(("file", self._file))
        self._calls.append(call)
        if len(self._calls) >= CALLS:
            self._flush()

    def _flush(self) -> None:
        calls, self._calls = self._calls, []
        if self._pipe is not None:
            try:
                self._pipe.send_bytes(pickle.dumps(calls, pickle.HIGHEST_PROTOCOL))
            except OSError:
                return  # it failed, and said why: `end` reads that


class _Server:
    """In the process. Its methods are those that are told, by name."""

    def __init__(self) -> None:
        self.findings = Findings()
        self._models: dict[str, ComposedModel] = {}

    def file(self, name: str) -> None:
        self.findings.file = name

    def run(self, transport: str, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...], counts_faults: bool) -> None:
        made = registry().get("transports", transport)(options, states, inputs)
        self._frames = Frames(made, len(states), self.findings, counts_faults=counts_faults)
        self._watch = WatchReplay(self.findings)

    def frame(self, index: int, channel: str, raw: bytes) -> None:
        entry = Entry(index, channel, 0, raw)
        frame: Any = entry.message
        if _ENCODE(frame) != raw:
            self.findings.differ(index, channel, "this is not how a recorder writes it", raw, frame)
        if frame.inbound != (channel == FRAME_IN):
            self.findings.differ(index, channel, "it stands among the frames of the other direction", raw, frame)
        (self._frames.inbound if frame.inbound else self._frames.outbound)(entry, frame)

    def event(self, index: int, channel: str, raw: bytes) -> None:
        entry = Entry(index, channel, 0, raw)
        event: Any = entry.message
        self._frames.event(entry, event)
        match event:
            case Observed():
                self._watch.observed(entry, event.observation, event.t_ns)
            case Measured():
                self._watch.measured(entry, event)
            case LinkChanged():
                self._watch.restarted()
            case AnalyticsChanged(late=True):
                self._watch.late(behind=not event.up)
            case AnalyticsChanged():
                self._watch.analytics(up=event.up)
            case SourceStopped(source="controller", reason="start_failed"):
                self._watch.doubted()
            case _:
                pass

    def other(self) -> None:
        self._frames.commands_left()

    def sent(self, raw: bytes) -> None:
        send = _SEND.decode(raw)
        self._watch.sent(send)
        self._frames.send(send)

    def begin(self, profile: Profile, gap: Gap, memory: Memory, lockstep: bool, rules: int) -> None:
        from s2r_runtime.models.composed import compose

        key = profile.model.digest()
        if key not in self._models:
            self._models[key] = compose(profile.model)
        self._watch.begin(self._models[key], gap, profile, memory, lockstep=lockstep, rules=rules)

    def stop(self) -> None:
        self._watch.end()

    def finish(self, index: int, channel: str, last_act: bytes | None, t_ns: int, clean: bool, stopped: bool) -> None:
        entry = Entry(index, channel, 0, b"") if channel else None
        self._frames.end(entry, None if last_act is None else _SEND.decode(last_act), clean=clean and stopped)
        self._watch.finish(entry, t_ns, clean=clean)


def _serve(pipe: Connection, parents: Connection) -> None:
    parents.close()  # or this process would not see that the other one is gone
    server = _Server()
    try:
        while True:
            for name, *call in pickle.loads(pipe.recv_bytes()):  # noqa: S301 - from the process that forked this one
                if name == "over":
                    pipe.send(server.findings)
                    return
                getattr(server, name)(*call)
    except EOFError:
        return
    except S2RError as error:
        pipe.send(error)
    except BaseException:  # noqa: BLE001 - told to the other process, which fails with it
        pipe.send(traceback.format_exc())
