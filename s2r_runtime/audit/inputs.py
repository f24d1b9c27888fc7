"""Drives given inputs again: what the sampler commanded must be, row after row, what is in the file that is attached to the log."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import msgspec

from s2r_runtime.audit.findings import Findings
from s2r_runtime.daemon.given_inputs import GivenInputs, parse_inputs
from s2r_runtime.errors import ConfigError
from s2r_runtime.files.canonical import digest
from s2r_runtime.messages import Ask, Command, InputsFinished, Observation, Proposed, SourceStarted, SourceStopped, StartInputs
from s2r_runtime.recording.layout import Attached
from s2r_runtime.recording.reading import Entry

if TYPE_CHECKING:
    from collections.abc import Mapping

    from s2r_runtime.profile import Profile


class InputsReplay:
    """One run's. `driving`: whether the sampler drives given inputs now."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._order: StartInputs | None = None
        self._given: GivenInputs | None = None
        self._row = 0
        self._finished = False
        self._due: deque[Proposed | SourceStopped] = deque()

    @property
    def driving(self) -> bool:
        """As it says."""
        return self._order is not None

    def start(
        self, entry: Entry, order: StartInputs, profile: Profile, inputs: tuple[str, ...], attachments: Mapping[str, Attached]
    ) -> None:
        """They are to be driven. inputs: names, in the model's order."""
        self._order, self._given, self._row, self._finished = order, None, 0, False
        self._due.clear()
        attached, problem = attachments.get(f"inputs/{order.digest}"), ""
        if attached is None:
            problem = "the inputs that are driven are not attached"
        elif digest(attached.data) != order.digest:
            problem = "the inputs that are attached are not those that were driven"
        else:
            try:
                self._given = parse_inputs(attached.data, "attached inputs", inputs, profile.inputs, profile.model.dt, profile.columns)
            except ConfigError as error:
                problem = f"the inputs that are driven may not be: {error}"
            if self._given is not None and len(self._given.rows) != order.n:
                problem, self._given = "the inputs have another number of rows", None
        if problem:
            self._findings.differ(entry.index, entry.channel, problem, order, None)

    def ask(self, ask: Ask, observation: Observation | None, ttl_ns: int) -> None:
        """The sampler was asked about the newest observation."""
        given = self._given
        if given is None or observation is None or observation.seq != ask.obs_seq:
            return
        if self._row == len(given.rows):
            self._due.append(SourceStopped(0, "sampler", "finished", ""))
            return
        u = given.rows[self._row]
        self._row += 1
        self._due.append(Proposed(0, Command(0, ask.t_ns, "sampler", u, observation.seq, ttl_ns)))

    def started(self, entry: Entry, event: SourceStarted) -> None:
        """The sampler runs: with these."""
        if self._given is not None and event.digest != self._given.digest:
            self._findings.differ(entry.index, entry.channel, "other inputs are driven than were asked for", event, self._given.digest)

    def proposed(self, entry: Entry, event: Proposed) -> None:
        """The sampler's command."""
        if self._given is None:
            return
        due = self._due.popleft() if self._due else None
        if due != msgspec.structs.replace(event, t_ns=0, command=msgspec.structs.replace(event.command, seq=0)):
            self._findings.differ(entry.index, entry.channel, "this is not the next row of the inputs that are attached", event, due)
            self._given = None
            return
        self._findings.count("commands of given inputs")

    def stopped(self, entry: Entry, event: SourceStopped) -> None:
        """The sampler ends."""
        self._finished = event.reason == "finished"
        if self._given is not None and self._finished:
            due = self._due.popleft() if self._due else None
            if due != msgspec.structs.replace(event, t_ns=0):
                self._findings.differ(entry.index, entry.channel, "the inputs that are attached do not end here", event, due)
                self._given = None
        if event.reason == "start_failed":
            self._order = self._given = None

    def finished(self, entry: Entry, event: InputsFinished) -> None:
        """What it says of itself."""
        if self._given is not None:
            told = InputsFinished(event.t_ns, self._given.digest, self._row, self._finished, "" if self._finished else event.detail)
            if told != event:
                self._findings.differ(entry.index, entry.channel, "the inputs ended otherwise", event, told)
        self._order = self._given = None
