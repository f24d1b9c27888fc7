"""What a log tells, folded into what a report shows. One pass, in log order.

Times are seconds on the daemon's clock since the run's first event.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from s2r_runtime import messages as m
from s2r_runtime.core import stream

KEPT_POINTS = 60_000
"""Path and discrepancy points kept; a longer log is thinned by halves, so memory stays flat."""


@dataclass
class Thinned:
    """Rows kept evenly over an unknown length: every `stride`-th; when full, every second is dropped and the stride doubles."""

    rows: list[tuple[Any, ...]] = field(default_factory=list)
    stride: int = 1
    seen: int = 0

    def add(self, row: tuple[Any, ...]) -> None:
        """Takes a row."""
        if self.seen % self.stride == 0:
            self.rows.append(row)
            if len(self.rows) >= KEPT_POINTS:
                del self.rows[1::2]
                self.stride *= 2
        self.seen += 1


@dataclass
class Story:
    """Everything a page about a log needs."""

    settings: m.Settings | None = None
    started_unix_s: int = 0
    first_ns: int | None = None
    last_ns: int = 0
    gate: list[tuple[float, bool, str]] = field(default_factory=list)
    """(when, open, reason)"""
    sources: list[tuple[float, str]] = field(default_factory=list)
    """(when, who commands from then on): sampler, controller, recovery"""
    marks: list[tuple[float, str, str]] = field(default_factory=list)
    """(when, what, kind) with kind one of good, bad, plain"""
    samples: dict[int, list[m.SampleTaken]] = field(default_factory=dict)
    gaps: list[m.Gap] = field(default_factory=list)
    refused: list[tuple[m.Gap, float]] = field(default_factory=list)
    """(what was computed on a campaign whose samples depend on each other, how long it was driven for in this run, s)"""
    verifications: list[tuple[m.Verification, dict[str, list[float]]]] = field(default_factory=list)
    traces: list[dict[str, Any]] = field(default_factory=list)
    certificates: list[m.CertificateFacts] = field(default_factory=list)
    revoked: list[tuple[str, str]] = field(default_factory=list)
    episodes: list[m.EpisodeEnded] = field(default_factory=list)
    runs: list[m.EpisodeCounted] = field(default_factory=list)
    refusals: dict[str, int] = field(default_factory=dict)
    """reason -> refused commands"""
    poses: Thinned = field(default_factory=Thinned)
    """(t, state, whether the certified controller drives)"""
    discrepancies: Thinned = field(default_factory=Thinned)
    """(t, discrepancy, e-value, radius in force, verified radius)"""
    watched: dict[int, tuple[m.Gap, m.WatchStood]] = field(default_factory=dict)
    """epoch -> its gap, and where its watch stands at the end"""
    answers: list[tuple[float, str]] = field(default_factory=list)
    records: int = 0
    _campaign_began: float = 0.0
    _campaign_ended: float = 0.0
    _driving: bool = False
    _radius: float = 0.0
    _verified: float = 0.0

    def seconds(self, t_ns: int) -> float:
        """Since the first event, s."""
        return (t_ns - (self.first_ns or 0)) / 1e9


def tell(entries: Iterable[Any]) -> Story:
    """Folds log entries (objects with `.message`) into a story."""
    story = Story()
    for entry in entries:
        story.records += 1
        message = entry.message
        t_ns = getattr(message, "t_ns", None)
        if t_ns is not None:
            if story.first_ns is None:
                story.first_ns = t_ns
            story.last_ns = max(story.last_ns, t_ns)
        _take(story, message)
    return story


def _take(story: Story, message: Any) -> None:
    match message:
        case m.Observed(t_ns=t, observation=o) if not o.fault:
            story.poses.add((story.seconds(t), o.x, story._driving))
        case m.Send(t_ns=t, source=source):
            story._driving = source == "controller"
            if not story.sources or story.sources[-1][1] != source:
                story.sources.append((story.seconds(t), source))
        case m.Measured(t_ns=t, fault="", discrepancy=d, e_value=e):
            story.discrepancies.add((story.seconds(t), d, e, story._radius, story._verified))
            if message.epoch in story.watched:
                gap, stood = story.watched[message.epoch]
                story.watched[message.epoch] = (gap, stream.after(stood, message, gap.radius))
        case m.Decided(allow=False, reason=reason):
            story.refusals[reason] = story.refusals.get(reason, 0) + 1
        case m.SampleTaken(epoch=epoch):
            story.samples.setdefault(epoch, []).append(message)
        case m.Started(unix_s=unix_s, settings=settings, memory=memory):
            story.settings, story.started_unix_s, story._radius = settings, unix_s, memory.radius
            if memory.gap is not None:
                story.watched[memory.gap.epoch] = (memory.gap, stream.stood(memory))
        case m.GateChanged(t_ns=t, open=is_open, reason=reason):
            story.gate.append((story.seconds(t), is_open, reason))
        case m.EpisodeEnded():
            story.episodes.append(message)
        case m.EpisodeCounted():
            story.runs.append(message)
        case _:
            _take_decision(story, message)


def _take_decision(story: Story, message: Any) -> None:
    def mark(what: str, kind: str = "plain") -> None:
        story.marks.append((story.seconds(message.t_ns), what, kind))

    match message:
        case m.StartCampaign():
            story._campaign_began = story.seconds(message.t_ns)
        case m.CampaignFinished():
            story._campaign_ended = story.seconds(message.t_ns)
        case m.JobFinished(kind="gap", gap=m.Gap() as gap) if gap.white_reason.startswith(m.NOT_INDEPENDENT):
            story.refused.append((gap, story._campaign_ended - story._campaign_began))
            mark(f"campaign of epoch {gap.epoch} refused: its samples depend on each other", "bad")
        case m.EpochChanged(epoch=epoch, gap=None):
            mark(f"campaign of epoch {epoch} begins")
        case m.EpochChanged(epoch=epoch, gap=m.Gap() as gap):
            story.gaps.append(gap)
            story.watched[epoch] = (gap, m.WatchStood())
            story._radius = gap.radius
            mark(f"gap of epoch {epoch}: {gap.radius:.4g}")
        case m.AttemptSpent(attempt=attempt, radius=radius):
            mark(f"verification attempt {attempt} at radius {radius:.4g}")
        case m.JobFinished(kind="verify", verification=v, safety=safety) if v is not None:
            story.verifications.append((v, safety))
            mark(f"attempt {v.attempt} {'passed' if v.passed else 'failed'}", "good" if v.passed else "bad")
        case m.JobFinished(kind="trace", trace=trace) if trace is not None:
            story.traces.append(trace)
        case m.TraceEnded(stretch=stretch, verdict="", reason=reason):
            mark(f"no trace of the {stretch}: {reason}", "bad")
        case m.TraceEnded(stretch=stretch, verdict=verdict, proposal=proposal):
            mark(f"residual of the {stretch} traced: {verdict}" + ("; a repaired model is proposed" if proposal else ""))
        case m.ModelAdopted(by=by, proposed=proposed):
            who = "the profile" if by < 0 else f"user {by}"
            mark(f"{'the proposed' if proposed else 'another'} model adopted by {who}; a fresh campaign is due")
        case m.StartInputs(n=n):
            mark(f"given inputs are driven, {n} rows")
        case m.InputsFinished(n=n, complete=complete, detail=detail):
            mark(f"{n} rows driven" + ("" if complete else f", not all: {detail}"), "plain" if complete else "bad")
        case m.CertificateInstalled(facts=facts):
            story.certificates.append(facts)
            story._verified = facts.verified_radius
            mark(f"certificate {facts.id[7:15]}", "good")
        case m.RadiusGrew(radius=radius, verified_radius=verified):
            beyond = radius > verified
            if beyond or story._radius != radius:
                mark(f"gap grows to {radius:.4g}" + (", beyond what was verified" if beyond else ""), "bad" if beyond else "plain")
            story._radius = radius
        case m.AlarmRaised(e_value=e):
            mark(f"the watch raises an alarm (e-value {e:.3g})", "bad")
        case m.ChangeNoticed(kind="change"):
            mark("the watch notices a change: the gap is exceeded more often than before", "bad")
        case m.ChangeNoticed(kind="exchangeability"):
            mark("the discrepancies of this epoch's driving are not of one law")
        case m.Revoked(certificate_id=identity, reason=reason):
            story.revoked.append((identity, reason))
            mark(f"certificate {identity[7:15]} revoked: {reason}", "bad")
        case m.Requested(verb=verb):
            mark(f"operator: {verb}")
        case m.Answer(t_ns=t, text=text, final=True):
            story.answers.append((story.seconds(t), text))
        case _:
            pass
