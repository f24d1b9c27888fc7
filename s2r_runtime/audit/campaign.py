"""Runs the sampling campaigns again from their seeds, and finds every sample in the observations that were recorded."""

from __future__ import annotations

from collections import deque
from itertools import takewhile
from typing import Any

import msgspec

from s2r_runtime.audit.findings import Findings
from s2r_runtime.comparison import STAMP_TOLERANCE, Campaign
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import (
    Ask,
    CampaignFinished,
    Command,
    Observation,
    Proposed,
    SampleTaken,
    Send,
    Settings,
    SourceStarted,
    SourceStopped,
    StartCampaign,
)
from s2r_runtime.profile import Sampling
from s2r_runtime.recording.reading import Entry

KEPT = 20_000
"""Observations and commands that are kept to find a sample in; a hold has some dozens."""


class CampaignReplay:
    """The campaigns of several runs of one robot: an interrupted one may go on in the next."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self.samples: dict[int, list[SampleTaken]] = {}
        self.rejected: dict[int, dict[str, int]] = {}
        self._snapshots: dict[int, dict[str, Any]] = {}
        self._without_frames: dict[int, int] = {}
        self.begin_run()

    def begin_run(self) -> None:
        """A new run begins: nothing of what was seen before it counts."""
        self._campaign: Campaign | None = None
        self._order: StartCampaign | None = None
        self._place = (0, "event/source_started")
        self._dt_ns = 0
        self._due: deque[SampleTaken | Proposed | SourceStopped] = deque()
        self._observations: deque[Observation] = deque(maxlen=KEPT)
        self._sends: deque[Send] = deque(maxlen=KEPT)
        self._reason = ""
        self._resumed: dict[str, Any] | None = None
        self._again: list[SampleTaken] = []
        self._asked: deque[tuple[Ask, Observation, int]] = deque()
        self._exact = True

    def end(self) -> None:
        """No run follows."""
        for epoch, n in self._without_frames.items():
            self._findings.lack(f"the frames behind {n} samples of campaign {epoch}, in an earlier log that was cut or not given")

    # ---- what the daemon did

    def observed(self, observation: Observation) -> None:
        """The robot was seen there."""
        self._observations.append(observation)

    def start(self, order: StartCampaign, settings: Settings, sampling: Sampling) -> None:
        """A campaign begins, or goes on."""
        self._order, self._dt_ns = order, settings.dt_ns
        self._campaign, self._doubtful = None, False
        self._due.clear()
        self._asked.clear()
        self._again.clear()
        try:
            campaign = Campaign.from_settings(settings, sampling, n=order.n, epoch=order.epoch, seed=order.seed)
            if order.resume:
                if order.epoch not in self._snapshots:
                    self._findings.lack(f"the beginning of campaign {order.epoch}, in an earlier log that was not given")
                    return
                self._resumed = self._snapshots[order.epoch]
                campaign.restore(self._resumed)
        except ConfigError:
            return  # it did not start: SourceStopped says so
        self._campaign = campaign
        self._snapshots[order.epoch] = campaign.snapshot()
        self.samples.setdefault(order.epoch, [])

    def ask(self, ask: Ask, ttl_ns: int) -> None:
        """The campaign was asked about the newest observation."""
        observation = self._observations[-1] if self._observations else None
        if self._campaign is None or observation is None or observation.seq != ask.obs_seq:
            return
        self._asked.append((ask, observation, ttl_ns))
        if self._resumed is None:
            self._settle()

    def _settle(self) -> None:
        """Answers what was asked. A campaign that goes on is first told where it stood: at the samples that were logged once more.

        The daemon kept those. It may have kept one that a crash cut from the log before; one that stands there it takes from there, since
        whoever draws again what he has seen may choose. The other counts may lack what a crash cut.
        """
        campaign, order = self._campaign, self._order
        if campaign is None or order is None:
            return
        if self._resumed is not None:
            taken, known = len(self._again), self.samples.get(order.epoch, ())
            if len(known) > taken:
                what = f"the campaign of epoch {order.epoch} goes on after {taken} samples, {len(known)} had been taken: it drew some again"
                self._findings.differ(*self._place, what, taken, len(known))
                self.samples[order.epoch] = list(self._again)
            if taken != self._resumed["index"]:
                self._exact = False
                campaign.restore({**self._resumed, "index": taken})
            self._resumed, self._snapshots[order.epoch] = None, campaign.snapshot()
        while self._asked:
            ask, observation, ttl_ns = self._asked.popleft()
            step = campaign.step(observation)
            if step.sample is not None:
                self._due.append(msgspec.structs.replace(step.sample, t_ns=0))
                self._snapshots[order.epoch] = campaign.snapshot()
            if step.done or step.failed:
                self._due.append(SourceStopped(0, "sampler", "finished", step.failed))
            else:
                self._due.append(Proposed(0, Command(0, ask.t_ns, "sampler", step.u, observation.seq, ttl_ns)))

    def decided(self, reason: str) -> None:
        """Why the command that is sent next, if it is the recovery's, is not the campaign's."""
        self._reason = reason

    def sent(self, send: Send) -> None:
        """A command left: the recovery's means that the campaign's did not act."""
        self._sends.append(send)
        self._settle()
        if send.source == "recovery" and self._campaign is not None:
            self._campaign.refused(send.obs_seq, self._reason)

    def doubted(self) -> None:
        """The disk refused the log: orders that had to be durable first may not have been carried out."""
        self._doubtful = self._campaign is not None

    # ---- what is recorded

    def started(self, entry: Entry, event: SourceStarted) -> None:
        """The sampler runs: with these settings."""
        self._place = (entry.index, entry.channel)
        if self._campaign is not None and event.digest != self._campaign.digest:
            self._findings.differ(entry.index, entry.channel, "the campaign has other settings", entry.raw, self._campaign.digest)

    def proposed(self, entry: Entry, event: Proposed) -> None:
        """The sampler's command."""
        self._settle()
        if self._campaign is not None:
            command = msgspec.structs.replace(event.command, seq=0)
            self._compare(entry, msgspec.structs.replace(event, t_ns=0, command=command), "campaign commands")

    def sample(self, entry: Entry, event: SampleTaken) -> None:
        """A sample: the campaign's, and the robot's."""
        kept = self.samples.setdefault(event.epoch, [])
        if event.again:
            if self._order is None or not self._order.resume:
                self._findings.differ(
                    entry.index, entry.channel, "a sample is logged once more, but its campaign began here", entry.raw, None
                )
            self._once_more(entry, event, kept)
            return
        self._settle()
        if self._campaign is not None:
            self._compare(entry, msgspec.structs.replace(event, t_ns=0), "samples")
        self._find(entry, event)
        kept.append(event)

    def _once_more(self, entry: Entry, event: SampleTaken, kept: list[SampleTaken]) -> None:
        """A sample of before the interruption: the same as it was, if that log was given."""
        self._again.append(event)
        told = next((one for one in kept if one.index == event.index), None)
        if told is None:
            kept.append(event)
            self._without_frames[event.epoch] = self._without_frames.get(event.epoch, 0) + 1
        elif msgspec.structs.replace(told, t_ns=0, again=True) != msgspec.structs.replace(event, t_ns=0):
            self._findings.differ(entry.index, entry.channel, "the sample was another one in the log before", entry.raw, told)

    def stopped(self, entry: Entry, event: SourceStopped) -> None:
        """The sampler ends: by itself as the campaign says, or because it was told to."""
        self._settle()
        if event.reason == "finished" and self._campaign is not None:
            self._compare(entry, msgspec.structs.replace(event, t_ns=0), "campaign ends")
        self._due.clear()

    def finished(self, entry: Entry, event: CampaignFinished) -> None:
        """What it says of itself."""
        self._settle()
        campaign, order = self._campaign, self._order
        if campaign is not None and order is not None:
            n = len(self.samples.get(order.epoch, ()))
            rejected = campaign.progress().rejected if self._exact else event.rejected
            told = CampaignFinished(event.t_ns, order.epoch, n, n >= order.n, rejected, event.detail)
            if told != event:
                self._findings.differ(entry.index, entry.channel, "the campaign ended otherwise", entry.raw, told)
        self.rejected[event.epoch] = event.rejected
        self._campaign = None

    def _compare(self, entry: Entry, event: SampleTaken | Proposed | SourceStopped, what: str) -> None:
        due = self._due.popleft() if self._due else None
        if due != event:
            if self._doubtful:
                self._findings.cannot(f"what campaign {self._order.epoch if self._order else 0} did while the log could not be written")
            else:
                self._findings.differ(entry.index, entry.channel, "the campaign gives something else here", entry.raw, due)
            self._campaign = None
            return
        self._findings.count(what)

    def _find(self, entry: Entry, sample: SampleTaken) -> None:
        """x0, x1 and the hold's end must be observations, at their times, with nothing but the sample's input sent in between."""
        recent = takewhile(lambda o: o.seq >= sample.obs_seq0, reversed(self._observations))
        seen = {o.seq: o for o in recent if not o.fault}
        start = seen.get(sample.obs_seq0)
        end = self._observations[-1] if self._observations else None
        problem = ""
        if start is None or (start.x, start.stamp_ns) != (sample.x0, sample.t0_ns):
            problem = "x0 is not the observation that it names"
        elif not any(o.x == sample.x1 and self._after(start, o, 1) for o in seen.values()):
            problem = "x1 was not observed one period after x0"
        elif sample.held and (end is None or end.x != sample.held or not self._after(start, end, sample.periods)):
            problem = "the state at the hold's end was not observed there"
        elif end is not None:
            recent_sends = takewhile(lambda s: s.obs_seq >= start.seq, reversed(self._sends))
            if any((s.u, s.source) != (sample.u, "sampler") for s in recent_sends if s.obs_seq < end.seq):
                problem = "another input was sent during the hold"
        if problem:
            self._findings.differ(entry.index, entry.channel, problem, entry.raw, None)
        else:
            self._findings.count("samples found in the observations")

    def _after(self, start: Observation, end: Observation, periods: int) -> bool:
        return abs(end.stamp_ns - start.stamp_ns - periods * self._dt_ns) <= STAMP_TOLERANCE * self._dt_ns
