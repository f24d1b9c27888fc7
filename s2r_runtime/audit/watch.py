"""Measures the stream again: observations and commands -> discrepancies and e-values, as the analytics process did (guarantee G5)."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import msgspec

from s2r_runtime.audit.findings import Findings, alike
from s2r_runtime.core import stream
from s2r_runtime.daemon.settings import fault_jump_of
from s2r_runtime.evidence.watch import Stream
from s2r_runtime.messages import Gap, Measured, Memory, Observation, Send, WatchStood
from s2r_runtime.profile import Profile
from s2r_runtime.recording.reading import Entry

if TYPE_CHECKING:
    from s2r_runtime.models.composed import ComposedModel


OVERDUE_NS = 5_000_000_000
"""In real time. A process that does not answer for two seconds is taken for dead, and that is recorded."""


class WatchReplay:
    """One run's watch. Replies may come late, but in order, and only a process that died leaves any out. In lockstep the daemon
    waits for them.
    """

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._stream: Stream | None = None
        self._begun: tuple[ComposedModel, Gap, Profile] | None = None
        self._stood: tuple[Gap, WatchStood] | None = None
        self._due: deque[Measured] = deque()
        """t_ns: of the observation."""
        self._lockstep = False
        self._sure = True
        self._behind = False
        self._rules = 0

    def begin(self, model: ComposedModel, gap: Gap, profile: Profile, memory: Memory, *, lockstep: bool, rules: int) -> None:
        """A controller starts. memory: the core's, which says where this epoch's watch stands. rules: the run's."""
        self._lockstep, self._sure, self._rules = lockstep, True, rules
        self._begun = (model, gap, profile)
        if self._stood is None or self._stood[0].epoch != gap.epoch:
            self._stood = (gap, stream.stood(memory))
        self._start()

    def end(self) -> None:
        """It is stopped; what was measured before may still come."""
        self._begun, self._stream = None, None

    def doubted(self) -> None:
        """The controller did not start; whether the watch had been told to begin cannot be seen."""
        self._sure = False

    def analytics(self, *, up: bool) -> None:
        """The process died, or is there again."""
        self._stream, self._behind = None, False
        if not up:
            self._due.clear()
        elif self._begun is not None:
            self._start()

    def late(self, *, behind: bool) -> None:
        """The process is behind the robot, or has caught up: what is due comes, later than else."""
        self._behind = behind

    def observed(self, entry: Entry, observation: Observation, t_ns: int) -> None:
        """The robot was seen there; before the core hears of it."""
        if self._stream is not None and self._begun is not None:
            self._demand(entry, t_ns)
            measured = self._stream.observed(observation)
            if measured is not None:
                self._due.append(msgspec.structs.replace(measured, t_ns=t_ns, epoch=self._begun[1].epoch))

    def restarted(self) -> None:
        """The robot started anew, or the link to it was lost or found."""
        if self._stream is not None:
            self._stream.restarted()

    def sent(self, send: Send) -> None:
        """The robot was told this."""
        if self._stream is not None:
            self._stream.sent(send)

    def measured(self, entry: Entry, event: Measured) -> None:
        """A discrepancy is recorded: it must be the next that is due."""
        if self._stood is not None and self._stood[0].epoch == event.epoch:
            gap, before = self._stood
            self._stood = (gap, stream.after(before, event, gap.radius))
        due = self._due.popleft() if self._due else None
        if due is None or not alike(due, msgspec.structs.replace(event, t_ns=due.t_ns)):
            what = "the discrepancy (or what the watch makes of it) is another one"
            self._findings.differ(entry.index, entry.channel, what, entry.raw, due)
            self._due.clear()
            return
        self._findings.count("discrepancies")

    def finish(self, entry: Entry | None, t_ns: int, *, clean: bool) -> None:
        """Nothing follows. clean: and nothing was cut."""
        if clean and entry is not None and self._stream is not None:
            self._demand(entry, t_ns)
        elif self._due and not clean:
            self._findings.lack(f"{len(self._due)} discrepancies of the last observations")

    def _demand(self, entry: Entry, t_ns: int) -> None:
        """While a controller is watched, what is due must have come by now."""
        if self._sure and not self._behind and self._due and (self._lockstep or t_ns - self._due[0].t_ns > OVERDUE_NS):
            self._findings.differ(entry.index, entry.channel, "a discrepancy before this is not recorded", None, self._due[0])
            self._due.clear()

    def _start(self) -> None:
        assert self._begun is not None  # noqa: S101 - callers checked
        assert self._stood is not None  # noqa: S101 - set with it
        model, gap, profile = self._begun
        stood = msgspec.structs.asdict(self._stood[1])
        alpha, watch = profile.guarantee.alpha, profile.watch
        jump = fault_jump_of(profile, model.states, tuple(model.nominal.angles), gap, self._rules)
        self._stream = Stream(model, gap, fault_jump=jump, alpha=alpha, run_length=watch.run_length, rules=self._rules, **stood)
