"""Runs the sampling campaigns again from their seeds, and finds every sample in the observations that were recorded."""

from __future__ import annotations

from collections import deque
from itertools import takewhile
from typing import Any

import msgspec

from s2r_runtime.audit.findings import Findings
from s2r_runtime.errors import ConfigError
from s2r_runtime.evidence.comparison import EARLY, EARLY_BEFORE, Campaign
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
"""Number of stored observations and commands to find a sample in; a hold has some dozens."""


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
        self._settings: Settings | None = None
        self._sampling = Sampling()
        self._short: set[int] = set()
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
        self._order, self._settings, self._sampling = order, settings, sampling
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

    def restarted(self) -> None:
        """The robot restarted, or the link to it was lost or found."""
        self._settle()
        if self._campaign is not None:
            self._campaign.restarted()

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
        self._stricter(event.digest)
        if self._campaign is not None and event.digest != self._campaign.digest:
            self._findings.differ(entry.index, entry.channel, "the campaign has other settings", entry.raw, self._campaign.digest)

    def _stricter(self, wanted: str) -> None:
        """A daemon that does not know yet that its model steps at any length takes none but whole steps, which is never wrong."""
        order, settings, campaign = self._order, self._settings, self._campaign
        if campaign is None or order is None or settings is None or not settings.any_step or campaign.digest == wanted:
            return
        strict = msgspec.structs.replace(settings, any_step=False)
        other = Campaign.from_settings(strict, self._sampling, n=order.n, epoch=order.epoch, seed=order.seed)
        if other.digest == wanted:
            if self._resumed is not None:
                self._resumed = {**self._resumed, "digest": wanted}
                other.restore(self._resumed)
            self._campaign, self._settings, self._snapshots[order.epoch] = other, strict, other.snapshot()

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
            told = CampaignFinished(event.t_ns, order.epoch, n, n >= order.n, rejected, "" if n >= order.n else event.detail)
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
        """The hold's start, x0, x1 and the hold's end must be observations, at their times, with nothing but the sample's input sent
        meanwhile.
        """
        first = sample.start_seq if sample.lasts_ns else sample.obs_seq0
        recent = takewhile(lambda o: o.seq >= first, reversed(self._observations))
        seen = {o.seq: o for o in recent if not o.fault}
        end = self._observations[-1] if self._observations else None
        problem = _misplaced(sample, seen, end) if sample.lasts_ns else self._misplaced_before(sample, seen, end)
        if not problem and end is not None:
            recent_sends = takewhile(lambda s: s.obs_seq >= first, reversed(self._sends))
            if any((s.u, s.source) != (sample.u, "sampler") for s in recent_sends if s.obs_seq < end.seq):
                problem = "another input was sent during the hold"
        if problem:
            self._findings.differ(entry.index, entry.channel, problem, entry.raw, None)
        else:
            self._findings.count("samples found in the observations")
            self._one_step(entry, sample, seen)

    def _misplaced_before(self, sample: SampleTaken, seen: dict[int, Observation], end: Observation | None) -> str:
        """What is wrong with the places of a sample that was taken under rules before `GRID`, or nothing."""
        start = seen.get(sample.obs_seq0)
        if start is None or (start.x, start.stamp_ns) != (sample.x0, sample.t0_ns):
            return "x0 is not the observation that it names"
        if not any(o.x == sample.x1 and self._after(start, o, 1) for o in seen.values()):
            return "x1 was not observed one period after x0"
        if sample.held and (end is None or end.x != sample.held or not self._after(start, end, sample.periods)):
            return "the state at the hold's end was not observed there"
        return ""

    def _after(self, start: Observation, end: Observation, periods: int) -> bool:
        dt = 0 if self._settings is None else self._settings.dt_ns
        return abs(end.stamp_ns - start.stamp_ns - periods * dt) <= EARLY_BEFORE * dt

    def _one_step(self, entry: Entry, sample: SampleTaken, seen: dict[int, Observation]) -> None:
        """By today's rule (guarantee G7): rules before `GRID` compared a transition a fifth too short or too long with a whole step."""
        if sample.lasts_ns or self._settings is None or sample.epoch in self._short:
            return
        dt = self._settings.dt_ns
        lasts = min((o.stamp_ns - sample.t0_ns for o in seen.values() if o.x == sample.x1 and o.stamp_ns > sample.t0_ns), default=dt)
        if abs(lasts - dt) > EARLY * dt:
            self._short.add(sample.epoch)
            took = f"x1 of sample {sample.index} was observed {lasts * 1e-9:.6g} s after x0 and compared with a step of {dt * 1e-9:g} s"
            what = f"the samples of epoch {sample.epoch} were not a step long: {took}; its gap is too small by about as much"
            self._findings.differ(entry.index, entry.channel, what, entry.raw, None)


def _misplaced(sample: SampleTaken, seen: dict[int, Observation], end: Observation | None) -> str:
    """What is wrong with a sample's places among the observations (by number), or nothing. How long it lasts is the campaign's to judge,
    which is run again.
    """
    start, x0 = seen.get(sample.start_seq), seen.get(sample.obs_seq0)
    if start is None or (start.x, start.stamp_ns) != (sample.start, sample.start_ns):
        return "the hold's start is not the observation that it names"
    if x0 is None or (x0.x, x0.stamp_ns) != (sample.x0, sample.t0_ns):
        return "x0 is not the observation that it names"
    if not any((o.x, o.stamp_ns) == (sample.x1, sample.t0_ns + sample.lasts_ns) for o in seen.values()):
        return "x1 was not observed when it says"
    if sample.held and (end is None or (end.x, end.stamp_ns) != (sample.held, sample.start_ns + sample.hold_ns)):
        return "the state at the hold's end was not observed when it says"
    return ""
