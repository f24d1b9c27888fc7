"""Runs the core again over the recorded events: every output must be the recorded one, byte for byte."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import msgspec

from s2r_runtime.audit.findings import Findings, close
from s2r_runtime.audit.older import as_recorded
from s2r_runtime.core import reducer as core
from s2r_runtime.core.state import State
from s2r_runtime.messages import Event, GateChanged, Output, Send
from s2r_runtime.recording.channels import CHANNELS
from s2r_runtime.recording.reading import Entry

_ENCODE = msgspec.json.Encoder().encode


class CoreReplay:
    """One run's core. After a difference it stops: what follows would only follow from that."""

    def __init__(self, findings: Findings) -> None:
        self.state: State = core.initial()
        self._findings = findings
        self._due: deque[Output] = deque()
        self.stopped = False
        self._last: Entry | None = None
        self._events = self._outputs = 0

    def event(self, entry: Entry, event: Event) -> tuple[Output, ...]:
        """Handles an event; the outputs, in the core's order."""
        if self._due and not self.stopped:
            self._differ(entry, "an output of the event before is not recorded", None, self._due[0])
        if self.stopped:
            return ()
        self.state, outputs = core.handle(self.state, event)
        self._due.extend(outputs)
        self._last = entry
        self._events += 1
        return outputs

    def output(self, entry: Entry) -> None:
        """Compares a recorded output with the one that is due."""
        if self.stopped:
            return
        if not self._due:
            self._differ(entry, "an output is recorded that the core does not give", entry.raw, None)
            return
        due, self._last = self._due.popleft(), entry
        if CHANNELS[entry.channel] is not type(due) or not self._same(_ENCODE(due), entry):
            self._differ(entry, "the core gives another output here", entry.raw, due)
            return
        self._outputs += 1

    def _same(self, due: bytes, entry: Entry) -> bool:
        """On another platform up to rounding; but no other text that some reader would take for it."""
        if as_recorded(due, entry.raw):
            return True
        if self._findings.same_platform or _ENCODE(entry.message) != entry.raw:
            return False
        return close(msgspec.json.decode(due), msgspec.json.decode(entry.raw))

    def end(self, *, complete: bool) -> None:
        """Nothing follows. complete: so the last event's outputs must be there."""
        for what, n in (("events", self._events), ("outputs", self._outputs)):
            if n:
                self._findings.count(what, n)
        if not self._due or self.stopped:
            return
        if complete and self._last is not None:
            self._differ(self._last, "an output of the last event is not recorded", None, self._due[0])
        else:
            self._findings.lack(f"{len(self._due)} outputs of the last event")

    def _differ(self, entry: Entry, what: str, recorded: object, recomputed: object) -> None:
        self.stopped = True
        self._findings.differ(entry.index, entry.channel, what, recorded, recomputed)


def in_effect_order(outputs: tuple[Output, ...]) -> Sequence[Output]:
    """The order in which the daemon carries outputs out: where the gate closes, the commands come first."""
    if len(outputs) < 2 or not any(isinstance(output, GateChanged) and not output.open for output in outputs):
        return outputs
    sends: list[Output] = [output for output in outputs if isinstance(output, Send)]
    return sends + [output for output in outputs if not isinstance(output, Send)]
