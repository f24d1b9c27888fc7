"""Tracing in the loop: when the residual is traced, what becomes of a result, and who decides that a repaired model is used.

A trace is a job like any other: ordered here, done by a worker beside everything else, its result an event. It moves nothing by
itself. A model that it proposes is adopted by a person, or by the profile (`repair.adopt = "always"`) once nothing drives and no worker is
busy with the model in force. Adopting voids the gap: the next one comes from a fresh campaign, on which nothing was fitted (guarantee G6).

A gap that grows while a controller drives, or is exceeded more often than it was, is traced `repair.delay` later, when there is something
to see, or at once where the deployment ends; after a growth again only when it has grown by a tenth since.
"""

from __future__ import annotations

from s2r_runtime.core.drive import regate
from s2r_runtime.core.gaps import void_gap
from s2r_runtime.core.state import VERIFYING, Job, Turn, job
from s2r_runtime.messages import (
    ChangeNoticed,
    EpochChanged,
    Event,
    JobFinished,
    ModelAdopted,
    Proposal,
    RadiusGrew,
    Requested,
    StartJob,
    Stretch,
    TraceEnded,
)

GROWN = 1.1
"""A smaller growth of the radius is no news for the tracer."""
PROFILE = -1
"""Stands for the user where the profile decides."""
STRETCHES: dict[str, Stretch] = {"": "campaign", "campaign": "campaign", "drive": "drive", "inputs": "inputs"}


# ---------------------------------------------------------------- when


def begin_trace(turn: Turn, stretch: Stretch, request_id: int) -> None:
    """Traces the residual of the model in force in what was recorded until now."""
    gap, refused, model = turn.memory.gap, turn.memory.refused_campaign, turn.memory.model_digest
    epoch = refused.epoch if refused is not None and stretch == "campaign" else 0 if gap is None else gap.epoch
    one = Job(turn.state.next_job, "trace", request_id, epoch, digest=model, stretch=stretch)
    turn.add_job(one)
    rows = turn.settings.trace_rows
    turn.emit(StartJob(turn.now, one.id, "trace", epoch=one.epoch, digest=model, stretch=stretch, rows=rows))


def requested_trace(turn: Turn, request: Requested) -> None:
    """A person asks for it."""
    state, stretch = turn.state, STRETCHES.get(request.text)
    if stretch is None:
        turn.answer(request.request_id, 2, f"{request.text!r} can't be traced; there are: campaign, drive, inputs")
    elif stretch == "campaign" and turn.memory.gap is None and turn.memory.refused_campaign is None:
        turn.answer(request.request_id, 3, "there is no finished campaign to trace; sample first: s2r sample")
    elif stretch == "drive" and not state.driven:
        turn.answer(request.request_id, 3, "no controller has driven since the gap came into force and the daemon began; deploy one first")
    elif stretch == "inputs" and not state.excited:
        turn.answer(request.request_id, 3, "no inputs were driven since the daemon began; first: s2r sample PROFILE --inputs FILE.csv")
    elif job(state, "trace") is not None:
        turn.answer(request.request_id, 2, "the residual is being traced already")
    else:
        begin_trace(turn, stretch, request.request_id)


def follow(turn: Turn, event: Event) -> None:
    """At the end of every event: what it led to may be a reason to trace, or the moment to adopt what was proposed."""
    for output in tuple(turn.outputs):
        if isinstance(output, RadiusGrew):
            _growth_noticed(turn)
        elif isinstance(output, ChangeNoticed) and output.kind == "change":
            _change_noticed(turn)
        elif isinstance(output, EpochChanged) and output.gap is not None:
            _gap_found(turn, sampled=isinstance(event, JobFinished))
    _trace_if_due(turn)
    _adopt_if_quiet(turn)


def _gap_found(turn: Turn, *, sampled: bool) -> None:
    """A gap came into force. What was driven before was another epoch's. sampled: by a campaign of ours, not loaded with a certificate."""
    turn.set(driven=False, trace_due_ns=None, traced_radius=0.0)
    if sampled and turn.settings.trace_after_campaign and job(turn.state, "trace") is None:
        begin_trace(turn, "campaign", 0)


def _growth_noticed(turn: Turn) -> None:
    """The radius grew while a controller drives. There is little to see of it yet."""
    state = turn.state
    if turn.settings.trace_on_growth and state.trace_due_ns is None and turn.memory.radius >= GROWN * state.traced_radius:
        turn.set(trace_due_ns=turn.now + turn.settings.trace_delay_ns)


def _change_noticed(turn: Turn) -> None:
    """The gap is exceeded more often than it was, be it by little. There is little to see of it yet."""
    if turn.settings.trace_on_growth and turn.state.trace_due_ns is None:
        turn.set(trace_due_ns=turn.now + turn.settings.trace_delay_ns)


def _trace_if_due(turn: Turn) -> None:
    """Traces what a growth began: after the delay, or as soon as nobody drives who could show more."""
    state = turn.state
    if state.trace_due_ns is None or job(state, "trace") is not None:
        return
    if state.deployment is not None and turn.now < state.trace_due_ns:
        return
    turn.set(trace_due_ns=None, traced_radius=turn.memory.radius)
    if turn.memory.gap is not None and state.driven and not state.stopping:
        begin_trace(turn, "drive", 0)


# ---------------------------------------------------------------- what came of it


def trace_finished(turn: Turn, done: Job, event: JobFinished) -> None:
    """What the tracer says is a finding; that an effect is known and not adopted counts, and a model that it proposes waits."""
    trace = event.trace if event.trace is not None and not event.error else {}
    verdict = trace.get("verdict")
    refused = turn.memory.refused_campaign
    its = "refused " if done.stretch == "campaign" and refused is not None and refused.epoch == done.epoch else ""
    told = f"trace of the {its}{done.stretch}"
    if not isinstance(verdict, str):
        why = event.error or "the worker returned none"
        turn.emit(TraceEnded(turn.now, done.id, done.stretch, done.epoch, "", why))
        turn.answer(done.request_id, 1, f"no {told}: {why}")
        return
    if verdict in ("traced", "ambiguous") and not turn.memory.traced:
        turn.remember_later(traced=True)
    proposal = _proposal(turn, done, trace)
    if proposal is not None:
        turn.remember_later(proposal=proposal)
    turn.emit(TraceEnded(turn.now, done.id, done.stretch, done.epoch, verdict, proposal="" if proposal is None else proposal.digest))
    use = "; it proposes a model: s2r adopt" if proposal is not None else ""
    turn.answer(done.request_id, 0, f"{told} of epoch {done.epoch}: {verdict}{use}")


def _proposal(turn: Turn, done: Job, trace: dict[str, object]) -> Proposal | None:
    """The model that is proposed. The worker says whether it can be; only one effect with certainty makes one."""
    found = trace.get("proposal")
    if not isinstance(found, dict) or trace.get("verdict") != "traced" or found.get("proposed") is not True:
        return None
    digest, effects = found.get("digest"), found.get("effects")
    if not isinstance(digest, str) or not digest or digest == turn.memory.model_digest or done.digest != turn.memory.model_digest:
        return None
    named = tuple(one for one in effects if isinstance(one, str)) if isinstance(effects, list | tuple) else ()
    return Proposal(digest, done.digest, done.stretch, done.epoch, named)


# ---------------------------------------------------------------- adopting


def requested_adoption(turn: Turn, request: Requested) -> None:
    """A person wants this model."""
    state = turn.state
    if not request.digest:
        turn.answer(request.request_id, 2, "adopt needs a model")
    elif request.digest == turn.memory.model_digest:
        turn.answer(request.request_id, 0, "this model is in force already")
    elif state.deployment is not None or state.campaign is not None:
        turn.answer(request.request_id, 1, "refused: a model is adopted only while nothing drives; undeploy or cancel first")
    elif job(state, "gap", "trace", *VERIFYING) is not None:
        turn.answer(request.request_id, 1, "refused: the worker still works with the model in force")
    else:
        _adopt(turn, request.digest, request.by)
        turn.answer(request.request_id, 0, "model adopted; its gap is not known yet: s2r sample")


def _adopt_if_quiet(turn: Turn) -> None:
    """The profile's decision, where it is the profile's: as soon as nothing drives and no worker is busy with the model in force."""
    state, proposal = turn.state, turn.memory.proposal
    if proposal is None or turn.settings.adopt != "always" or proposal.base != turn.memory.model_digest:
        return
    busy = state.deployment is not None or state.campaign is not None or state.jobs or state.issuing is not None
    if not busy and not state.stopping and state.recorder_ok:
        _adopt(turn, proposal.digest, PROFILE)


def _adopt(turn: Turn, digest: str, by: int) -> None:
    proposed = turn.memory.proposal is not None and turn.memory.proposal.digest == digest
    void_gap(turn, "model_changed")
    turn.remember(model_digest=digest, proposal=None)
    turn.set(trace_due_ns=None, traced_radius=0.0, driven=False)
    turn.persist()
    turn.emit(ModelAdopted(turn.now, digest, by, proposed))
    regate(turn)
