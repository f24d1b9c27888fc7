"""The deterministic heart: an event in, records and actions out (docs/decisions/0001, 5).

    state, outputs = handle(state, event)

A pure reducer: no clock, no I/O, no randomness. The first event must be Started; before it, nothing is ever sent. Replaying
the logged events from `initial()` gives the logged outputs, byte for byte; that is what an audit does.

What the daemon owes the core. Outputs take effect in their order, and before the next event is handled. `Persist` and
`GateChanged(open=True)` are durable before the outputs after them take effect: opening, counters and certificates are on disk
before they matter, while closing acts first and is logged next. Every `Ask` is answered by a `Proposed`, by the `SourceStopped` of that
source, or by an `AnswerLate`. A `Send` of the recovery command while a campaign runs means that another input than the campaign's acted:
the campaign must be told. Everything that happens comes as an event, in the order in which it is logged.

The parts: `state`, `drive` (instants, sends, the gate opening and closing), `faults` (of observations, counted), `sources` (who may
command), `gaps` (campaigns, gap, watch), `excitation` (given inputs), `repair` (traces, proposed models), `certificates` (attempts,
certificates), `runs` (counted, with their limits), `requests` (of a person), `gate` (the verdict on a command), `ledger` (what
is spent), `stream` (what is stored of the discrepancies), `wall_clock` (the time of day, for expiry), `status`.
"""

from __future__ import annotations

import msgspec

from s2r_runtime.core import certificates, drive, excitation, faults, gaps, repair, runs, sources, wall_clock
from s2r_runtime.core.requests import requested
from s2r_runtime.core.state import State, Turn
from s2r_runtime.core.status import status
from s2r_runtime.messages import (
    MEMORY_SCHEMA,
    AnalyticsChanged,
    Answer,
    AnswerLate,
    CampaignFinished,
    CertificateFailed,
    CertificatesDistrusted,
    CertificateStored,
    EpisodeEnded,
    EpisodeScored,
    Event,
    InputsFinished,
    JobFinished,
    LinkChanged,
    Measured,
    ObservationRefused,
    Observed,
    Output,
    OverrideChanged,
    Proposed,
    RecorderChanged,
    Requested,
    SampleTaken,
    SeedDrawn,
    SourceStarted,
    SourceStopped,
    Started,
    Stopping,
    Ticked,
    TraceEnded,
    WallClockRead,
)

__all__ = ["State", "handle", "initial", "status"]


def initial() -> State:
    """The state before anything happened: closed."""
    return State()


def handle(state: State, event: Event) -> tuple[State, tuple[Output, ...]]:
    """One event. The state is not changed; the outputs are in the order in which they are to take effect."""
    if state.settings is None or state.refusal or state.stopping:
        return _outside_a_run(state, event)
    turn = Turn(state, state.settings, event.t_ns)
    if event.t_ns < state.now_ns:
        sources.clock_stepped_back(turn)
    paused = event.t_ns - state.now_ns > state.settings.observation_timeout_ns and not state.settings.lockstep
    turn.set(now_ns=event.t_ns)
    if paused:  # the daemon stood still: what it saw last is stale, whatever this event brings
        drive.regate(turn)
    _dispatch(turn, event)
    sources.check_campaign(turn)
    excitation.follow_inputs(turn, event)
    repair.follow(turn, event)
    drive.wake(turn)
    runs.follow(turn, event)
    certificates.revoke_unsafe(turn)
    turn.persist()
    return turn.state, tuple(turn.outputs)


def _outside_a_run(state: State, event: Event) -> tuple[State, tuple[Output, ...]]:
    """Before Started, after Stopping, or with a memory that is not this robot's: nothing is ever sent."""
    if state.settings is None and isinstance(event, Started):
        return _started(state, event)
    if isinstance(event, Requested):
        code, text = (
            (78, state.refusal) if state.refusal else (1, "the daemon is stopping" if state.stopping else "the daemon has not started")
        )
        return state, (Answer(event.t_ns, event.request_id, code, text),)
    return state, ()


def _started(state: State, event: Started) -> tuple[State, tuple[Output, ...]]:
    settings, memory = event.settings, event.memory
    turn = Turn(state, settings, event.t_ns)
    turn.set(settings=settings, memory=memory, now_ns=event.t_ns, unix_s=event.unix_s, unix_ns=event.t_ns)
    wall_clock.begin(turn, event.unix_s)
    if memory.robot != settings.robot:
        sources.memory_refused(turn, f"the memory is of robot {memory.robot!r}, this is {settings.robot!r}")
    elif memory.schema != MEMORY_SCHEMA:
        sources.memory_refused(turn, f"the memory has schema {memory.schema}, this version has {MEMORY_SCHEMA}")
    else:
        if memory.model_digest != settings.model_digest:
            if memory.model_digest:
                gaps.void_gap(turn, "model_changed")
            turn.remember(model_digest=settings.model_digest, proposal=None)
        if memory.campaign_digest != settings.campaign_digest:
            if memory.campaign_digest:
                gaps.void_gap(turn, "profile_changed")
            turn.remember(campaign_digest=settings.campaign_digest)
        runs.restored(turn)
        turn.persist()
        drive.regate(turn)
    return turn.state, tuple(turn.outputs)


def _dispatch(turn: Turn, event: Event) -> None:
    match event:
        case Observed():
            before = turn.state.observation
            faults.note(turn, event.observation)
            drive.observed(turn, event.observation)
            faults.judge(turn, event.observation, before)
        case Proposed():
            drive.proposed(turn, event.command)
        case AnswerLate():
            drive.answer_late(turn, event)
        case Ticked():
            _ticked(turn)
        case Measured():
            gaps.measured(turn, event)
        case Requested():
            requested(turn, event)
        case SourceStarted():
            sources.source_started(turn, event)
        case SourceStopped():
            deployment = turn.state.deployment
            runs.stopped(turn, event)
            sources.source_stopped(turn, event)
            if event.source == "controller" and event.reason == "inconsistent" and deployment is not None:
                certificates.revoke_controller(turn, deployment.digest, "controller_inconsistent")
        case OverrideChanged():
            sources.override(turn, event)
        case ObservationRefused():
            faults.refused(turn, event.detail)
        case LinkChanged():
            sources.link_changed(turn, event)
        case Stopping():
            _stopping(turn, event)
        case _:
            _noted(turn, event)


def _noted(turn: Turn, event: Event) -> None:
    """Events that come now and then."""
    match event:
        case WallClockRead():
            wall_clock.read(turn, event.unix_s)
        case RecorderChanged():
            turn.set(recorder_ok=event.ok, recorder_late=event.late and not event.ok)
        case AnalyticsChanged():
            turn.set(analytics_up=event.up)
        case SampleTaken():
            campaign = turn.state.campaign
            if campaign is not None and not campaign.inputs and campaign.epoch == event.epoch:
                turn.set(campaign=msgspec.structs.replace(campaign, taken=event.index + 1))
        case SeedDrawn():
            certificates.seed_drawn(turn, event)
        case EpisodeEnded():
            turn.set(episodes=turn.state.episodes + 1)
            runs.ended(turn, event)
            certificates.revoke_unsafe(turn)
        case EpisodeScored():
            runs.scored(turn, event)
        case CampaignFinished():
            gaps.campaign_finished(turn, event)
        case InputsFinished():
            excitation.inputs_finished(turn, event)
        case JobFinished():
            _job_finished(turn, event)
        case CertificateStored(gap=None):
            certificates.certificate_stored(turn, event)
        case CertificateStored(gap=gap) if gap is not None:
            gaps.certificate_loaded(turn, event, gap)
        case CertificatesDistrusted():
            certificates.distrusted(turn, event)
        case CertificateFailed():
            certificates.certificate_failed(turn, event)
        case _:
            return  # a second Started: this run has its settings
    drive.regate(turn)


def _ticked(turn: Turn) -> None:
    asked = turn.state.asked
    if asked is not None and drive.overdue(turn):
        if asked.source == "controller":
            sources.fail_controller(turn, "deadline", "no answer within the command's time to live", tell=True)
        else:
            drive.recover_now(turn)
    drive.regate(turn)
    drive.keep_recovering(turn)


def _stopping(turn: Turn, event: Stopping) -> None:
    """The last event: everything stops, what is open is answered, the memory is written."""
    turn.set(stopping=True)
    sources.halt(turn, "stopping", event.detail)
    pending = {one.request_id: None for one in (*turn.state.jobs, *filter(None, (turn.state.issuing,))) if one.purpose != "deploy"}
    for request_id in pending:
        turn.answer(request_id, 1, "the daemon stopped before this was done")
    for one in turn.state.jobs:
        if one.purpose == "trace":
            turn.emit(TraceEnded(turn.now, one.id, one.stretch, one.epoch, "", "the daemon stopped before it was done"))
    turn.set(jobs=(), issuing=None)
    wall_clock.end(turn)
    turn.remember()


def _job_finished(turn: Turn, event: JobFinished) -> None:
    done = next((one for one in turn.state.jobs if one.id == event.job_id), None)
    if done is None:
        return
    turn.drop_job(done)
    if done.purpose == "gap":
        gaps.gap_finished(turn, done, event)
    elif done.purpose == "trace":
        repair.trace_finished(turn, done, event)
    else:
        certificates.verification_finished(turn, done, event)
